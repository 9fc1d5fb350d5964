"""`python -m eval study`: does the comparison of conditions find what is there, and nothing else?"""

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from jsonargparse.typing import NonNegativeInt, PositiveInt
from scipy import stats

from neuroprior._jobs import JobRun
from neuroprior.behaviour import Columns, compare_conditions, read, share_interval, simulated_study
from neuroprior.behaviour.report.document import Document, publish, table
from neuroprior.behaviour.report.page import Section, Table
from neuroprior.behaviour.study import LONGER, MOVED

LEVEL = 0.05
TOGETHER = 10
"""Studies of one job."""

COLUMNS = Columns(behaviour="behaviour", recording="session", subject="animal", factors="treatment")

PLANTED = {("transitions", MOVED[0], MOVED[1]), ("transitions", MOVED[0], MOVED[2]), ("durations", LONGER[0])}
"""The features that the treatment changes; shares of actions and of longer sequences change as a consequence."""


@dataclass(frozen=True)
class Batch:
    """Some simulated studies of one kind."""

    effect: bool
    within: bool
    alike: bool
    number: int

    def __str__(self) -> str:
        words = ["effect" if self.effect else "none", self.design, *["alike"] * self.alike]
        return f"{'-'.join(words)}-{self.number}"

    @property
    def design(self) -> str:
        return "within" if self.within else "between"


def study(
    studies: PositiveInt = 200,
    with_effect: PositiveInt = 50,
    seed: NonNegativeInt = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/study",
) -> None:
    """Simulated studies with known truth: how often each test of conditions finds an effect that is there, or is not.

    Twelve animals, two sessions each: six of them treated, or each once; see `neuroprior.behaviour.simulated_study`.

    Args:
        studies: simulated studies without an effect, for each design.
        with_effect: simulated studies with one.
        seed: of the first study; the others follow.
        processes: how many run at a time; all cores by default.
        dask: address of a Dask scheduler; None: this machine.
        out: folder for tables (CSV), `results.json` and `report.html`.
    """
    jobs = [
        Batch(effect, within, alike, number)
        for effect, alike in ((True, False), (False, False), (False, True))
        for within in (False, True)
        for number in range(-(-(with_effect if effect else studies) // TOGETHER))
    ]
    numbers = {"studies": studies, "with_effect": with_effect, "seed": seed}
    run = JobRun(partial(compared, numbers), Path(out) / "jobs", numbers)
    found = run.do(jobs, processes=processes, dask=dask, title="studies")
    rows = [asdict(job) | row for job, some in zip(jobs, found, strict=True) for row in some]
    frame = pd.DataFrame(rows).drop(columns="number")
    frame["design"] = frame["within"].map({True: "within", False: "between"})
    tests = frame[frame["kind"] == "test"].drop(columns=["kind", "feature"])
    alarms, power = _shares(tests[~tests["effect"]], "p"), _shares(tests[tests["effect"]], "corrected")
    features = _features(frame[frame["kind"] == "feature"], with_effect)
    publish(
        Document(
            "Simulated studies of conditions",
            f"{studies} studies without an effect for each design, {with_effect} with one; 12 animals, 2 sessions each",
            [Section("Conditions", tables=[_alarm_table(alarms), _power_table(power), _feature_table(features)])],
            {"false_alarms": alarms, "power": power, "features": features},
            numbers,
            keys={"false_alarms": "rows"},
        ),
        Path(out),
    )


def compared(numbers: dict[str, int], batch: Batch) -> list[dict[str, Any]]:
    """The p-values of every test in each study of a batch, and the features that were found to differ."""
    total = numbers["with_effect"] if batch.effect else numbers["studies"]
    first = batch.number * TOGETHER
    rows = []
    for number in range(first, min(first + TOGETHER, total)):
        seed = numbers["seed"] + number
        events = simulated_study(seed, effect=batch.effect, within=batch.within, alike=batch.alike)
        plans = read(events, COLUMNS).plans()
        names = list(plans.action_names or ())
        one = compare_conditions(plans, generator=torch.Generator().manual_seed(seed))
        tests = one.tests | {"all together": (one.p_value, one.p_value)}
        rows += [{"kind": "test", "study": seed, "test": t, "p": p, "corrected": c} for t, (p, c) in tests.items()]
        for family in one.families:
            for feature in one.significant(family).nonzero()[:, 0].tolist():
                spelled = " ".join(names[action] for action in family.features[feature].tolist())
                rows.append({"kind": "feature", "study": seed, "test": family.name, "feature": spelled})
    return rows


def _shares(tests: pd.DataFrame, column: str) -> pd.DataFrame:
    """The share of studies in which each test is significant, with its interval."""
    rows = []
    for (design, alike, test), own in tests.groupby(["design", "alike", "test"], sort=False):
        share, low, high = share_interval(int((own[column] < LEVEL).sum()), len(own))
        row = {"design": design, "sessions_alike": alike, "test": test, "studies": len(own)}
        rows.append(row | {"share": share, "low": low, "high": high})
    return pd.DataFrame(rows)


def _features(found: pd.DataFrame, studies: int) -> pd.DataFrame:
    """In how many studies with an effect each changed feature is found, and any transition or duration that is not."""
    own = found[found["effect"] & found["test"].isin(["transitions", "durations"])]
    own = own.assign(planted=(own["test"] + " " + own["feature"]).isin([" ".join(words) for words in PLANTED]))
    rows = []
    for design in ("between", "within"):
        some = own[own["design"] == design]
        for test, *names in sorted(PLANTED):
            here = some[(some["test"] == test) & (some["feature"] == " ".join(names))]
            rows.append((design, f"{test}: {' '.join(names)}", True, here["study"].nunique()))
        rows.append((design, "any other transition or duration", False, some[~some["planted"]]["study"].nunique()))
    frame = pd.DataFrame(rows, columns=["design", "feature", "planted", "found"])
    shares = pd.DataFrame([share_interval(number, studies)._asdict() for number in frame["found"]])
    return pd.concat([frame, shares.rename(columns={"mean": "share"})], axis=1).assign(studies=studies)


def _alarm_table(frame: pd.DataFrame) -> Table:
    studies = int(frame["studies"].iloc[0])
    low, high = stats.binom.interval(0.95, studies, LEVEL)
    outside = ~frame["share"].between(low / studies, high / studies)
    cells = (100 * frame["share"]).map("{:.1f}".format) + outside.map({True: "*", False: " "})
    caption = (
        f"Share of studies without an effect with p < {LEVEL}, %. Of {studies} exact tests {100 * low / studies:.1f} to"
        f" {100 * high / studies:.1f} % are below it with a probability of 95 %; *: outside of that."
    )
    return _wide(frame.assign(cell=cells), "False alarms", caption)


def _power_table(frame: pd.DataFrame) -> Table:
    caption = f"Share of studies with an effect with a corrected p < {LEVEL}, %; 95 % intervals over studies (Wilson)."
    return _wide(frame.assign(cell=[_percent(row) for _, row in frame.iterrows()]), "Effects found, by test", caption)


def _wide(frame: pd.DataFrame, title: str, caption: str) -> Table:
    """A row a test, a column a design."""
    cells = frame.assign(where=frame["design"] + frame["sessions_alike"].map({True: "\nalike", False: ""}))
    wide = cells.pivot(index="test", columns="where", values="cell").reindex(cells["test"].unique())
    wide = wide[cells["where"].unique()].reset_index()
    return table(wide, {name: name for name in wide.columns}, caption, title, "l" + "r" * (len(wide.columns) - 1))


def _percent(row: Any) -> str:
    return f"{100 * row.share:.1f} ({100 * row.low:.1f} to {100 * row.high:.1f})"


def _feature_table(frame: pd.DataFrame) -> Table:
    columns: dict[str, Any] = {
        "design": "design",
        "feature": "feature",
        "found, %": _percent,
    }
    caption = "Share of studies with an effect in which the feature is significant (corrected)."
    return table(frame, columns, caption, "Effects found, by feature", "llr")
