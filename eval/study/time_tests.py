"""Studies with known drift, order and durations: how often what the report says of time is starred, rightly or not."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch

from neuroprior._statistics import LEVEL
from neuroprior.behaviour import Recordings, duration_survival, how_far_back, rate_drift, share_interval
from neuroprior.behaviour.reporting.document import table
from neuroprior.behaviour.reporting.page import Table
from neuroprior.behaviour.study import BEHAVIOURS, FADING, LONGER, NEXT, RITUAL, RITUAL_WEIGHT, SECONDS, SPREAD

ANIMALS, SESSIONS = 12, 2
TOGETHER = 10
"""Studies of one job."""

ANIMAL_SPREAD = 0.2
"""Standard deviation, over animals, of the logits of transitions and of the logarithms of median durations."""

DRIFT_SPREAD = 0.5
"""Standard deviation, over animals, of the change of the logits of behaviours over a session."""

FADE = 0.4
"""Fall of the logit of the behaviour that fades, over a session."""

ORDER_SPREAD = 0.5
"""Standard deviation, over the two behaviours before, of logits of order 2."""

CUT_OFF = 0.05
"""Share of bouts in which the animal gets out of view; the next one is not seen."""

SOURCES: dict[str, dict[str, str]] = {
    "order 1": dict.fromkeys(("drift, any", "lag 2", "lag 3", "survival, any"), "alarms"),
    "order 1, animals drift": dict.fromkeys(("drift, any", "survival, any"), "alarms"),
    "order 2": {"drift, any": "alarms", "lag 2": "power", "lag 3": "alarms", "survival, any": "alarms"},
    "one ritual": {"drift, any": "alarms", "lag 2": "power", "lag 3": "alarms", "survival, any": "alarms"},
    f"{FADING[0]} fades": {f"drift, {FADING[0]}": "power", "survival, any": "alarms"},
    f"{LONGER[0]} lasts longer": {
        "drift, any": "alarms",
        "lag 2": "alarms",
        f"survival, {LONGER[0]}": "power",
        "survival, others": "alarms",
    },
}
"""The tests that are counted of each source, and what their stars are."""


@dataclass(frozen=True)
class Batch:
    """Some simulated studies of one source."""

    source: str
    number: int

    def __str__(self) -> str:
        return f"time-{self.source.replace(',', '').replace(' ', '-')}-{self.number}"


def timed_study(seed: int, source: str, actions: int) -> pd.DataFrame:
    """Return the events of a study, as `neuroprior.behaviour.simulated_study` has them, half of the animals treated.

    The next behaviour depends on the last one; of order 2 it depends on the last two, in a ritual only after "eat,
    drink". Bouts are cut off at random. Behaviours become rarer or commoner over a session where they fade, or where
    animals drift.
    """
    random = np.random.default_rng(seed)
    shape = (ANIMALS, SESSIONS, actions)
    logits = np.log(np.array([NEXT[name] for name in BEHAVIOURS]) + 1e-9)
    logits = logits + ANIMAL_SPREAD * random.standard_normal((ANIMALS, 1, 8, 8))
    change = np.zeros((ANIMALS, 8))
    if source == "order 1, animals drift":
        change += DRIFT_SPREAD * random.standard_normal(change.shape)
    if source == f"{FADING[0]} fades":
        change[:, BEHAVIOURS.index(FADING[0])] -= FADE
    first, second, third = (BEHAVIOURS.index(name) for name in RITUAL)
    of_two = ORDER_SPREAD * random.standard_normal((8, 8, 8)) * (source == "order 2")
    of_two[first, second, third] += np.log(RITUAL_WEIGHT) * (source == "one ritual")
    behaviours, drawn = np.zeros(shape, np.int64), random.random(shape)
    animal = np.arange(ANIMALS)[:, None]
    for step in range(actions):
        before, last = (behaviours[..., max(step - back, 0)] for back in (2, 1))
        odds = np.exp(logits[animal, 0, last] + of_two[before, last] + change[:, None] * step / actions).cumsum(-1)
        behaviours[..., step] = (odds < drawn[..., step, None] * odds[..., -1:]).sum(-1)
    drug = np.broadcast_to((random.permutation(ANIMALS) < ANIMALS // 2)[:, None, None], shape)
    medians = np.array(SECONDS) * np.exp(ANIMAL_SPREAD * random.standard_normal((ANIMALS, 1, 8)))
    seconds = np.take_along_axis(np.broadcast_to(medians, (ANIMALS, SESSIONS, 8)), behaviours, -1)
    seconds = seconds * np.exp(SPREAD * random.standard_normal(shape))
    if source == f"{LONGER[0]} lasts longer":
        seconds *= np.where(drug & (behaviours == BEHAVIOURS.index(LONGER[0])), LONGER[1], 1)
    cut_off = random.random(shape) < CUT_OFF
    start = seconds.cumsum(-1) - seconds
    stop = start + seconds * np.where(cut_off, random.random(shape), 1)
    labels = np.array(BEHAVIOURS, dtype=object)[behaviours]
    labels[..., 1:][cut_off[..., :-1]] = None
    subject, session, _ = np.indices(shape)
    columns = {"animal": subject, "session": session + 1, "behaviour": labels, "start": start, "stop": stop}
    columns |= {"treatment": np.where(drug, "drug", "saline"), "observer": np.full(shape, "A")}
    frame = pd.DataFrame({name: values.ravel() for name, values in columns.items()})
    return frame.assign(animal=[f"m{number + 1:02d}" for number in frame["animal"]])


def tested(numbers: dict[str, int], batch: Batch) -> list[dict[str, Any]]:
    """The corrected p-value of each test in each study of a batch."""
    rows = []
    first = batch.number * TOGETHER
    for number in range(first, min(first + TOGETHER, numbers["time_studies"])):
        seed = numbers["seed"] + number
        recordings = recordings_of(timed_study(seed, batch.source, numbers["actions"]))
        plans = recordings.plans(compare="treatment", reference="saline")
        drift = rate_drift(recordings).frame().set_index("behaviour")["p_corrected"]
        lags = how_far_back(plans, max_lag=3).corrected
        survival = duration_survival(plans, numbers["permutations"], torch.Generator().manual_seed(seed))
        lasts = pd.Series({name: corrected for name, (_, corrected) in survival.tests.items()})
        p_values = {"drift, any": drift.min(), f"drift, {FADING[0]}": drift[FADING[0]]}
        p_values |= {"lag 2": lags[1], "lag 3": lags[2], "survival, any": lasts.min()}
        p_values |= {f"survival, {LONGER[0]}": lasts[LONGER[0]], "survival, others": lasts.drop(LONGER[0]).min()}
        rows += [{"study": seed, "test": test, "p": float(p_values[test])} for test in SOURCES[batch.source]]
    return rows


def recordings_of(events: pd.DataFrame) -> Recordings:
    """Return what `neuroprior.behaviour.read` finds in a simulated study, without its checks, which take longer."""
    missing = events["behaviour"].isna().to_numpy()
    recording = (events["animal"] + " " + events["session"].astype(str)).factorize()[0]
    fragment = np.cumsum((np.diff(recording, prepend=-1) != 0) | missing | np.append(False, missing[:-1]))
    columns = {"animal": "subject", "session": "recording"}
    kept = events[~missing].rename(columns=columns).drop(columns="observer").astype({"recording": str})
    factors = [name for name in ("treatment", "sex") if name in events]
    return Recordings(
        kept.reset_index(drop=True), np.unique(fragment[~missing], return_inverse=True)[1], "s", (), factors
    )


def share_starred(results: list[tuple[Batch, list[dict[str, Any]]]]) -> pd.DataFrame:
    """A row for each source and test: the share of studies in which it is starred, with Wilson's interval."""
    frame = pd.DataFrame([{"source": job.source} | row for job, rows in results for row in rows])
    rows = []
    for (source, test), one in frame.groupby(["source", "test"], sort=False):
        share = share_interval(int((one["p"] < LEVEL).sum()), len(one))._asdict()
        kind = SOURCES[str(source)][str(test)]
        names = {"mean": "starred", "low": "starred_low", "high": "starred_high"}
        row = {"source": source, "test": test, "stars_are": kind, "studies": len(one)}
        rows.append(row | {names[name]: value for name, value in share.items()})
    return pd.DataFrame(rows)


def starred_table(frame: pd.DataFrame) -> Table:
    """The shares of `share_starred` in %."""
    columns: dict[str, Any] = {"source": "source", "star": "test"}
    for kind, heading in (("alarms", "false alarms, %"), ("power", "power, %")):
        columns[heading] = lambda row, kind=kind: (
            f"{100 * row.starred:.1f} ({100 * row.starred_low:.1f} to {100 * row.starred_high:.1f})"
            if row.stars_are == kind
            else ""
        )
    caption = (
        f"Share of {frame['studies'].iloc[0]} studies of {ANIMALS} animals with a star: p < {LEVEL}, corrected for the"
        " behaviours, with 95 % intervals (Wilson). drift: of the share of a behaviour. lag: what an earlier behaviour"
        " adds. survival: log-rank test. any: of at least one behaviour."
    )
    return table(frame, columns, caption, "Drift, lags and survival", "llrr")
