"""`python -m eval study`: do the tests of conditions, drift, lags and survival find what is there, and nothing else?"""

from dataclasses import asdict, dataclass
from functools import partial
from math import ceil
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from jsonargparse.typing import NonNegativeInt, PositiveInt
from scipy import stats

from eval.study import time_tests
from eval.study.time_tests import recordings_of
from neuroprior._folders import claim_out
from neuroprior._jobs import JobRun
from neuroprior.behaviour import compare_conditions, share_interval, simulated_study
from neuroprior.behaviour.reporting.document import Document, publish, table
from neuroprior.behaviour.reporting.page import Section, Table
from neuroprior.behaviour.study import LONGER, MOVED

LEVEL = 0.05
TOGETHER = 10
"""Studies of one job."""

PLANTED = {("transitions", MOVED[0], MOVED[1]), ("transitions", MOVED[0], MOVED[2]), ("durations", LONGER[0])}
"""The features that the treatment changes; shares of actions and of longer sequences change as a consequence."""

DESIGNS: dict[str, dict[str, Any]] = {
    "6 against 6": {"animals": 12},
    "6 against 6, sessions alike": {"animals": 12, "alike": True},
    "12 against 12": {"animals": 24},
    "5 against 11, unequal lengths": {"animals": 16, "treated": 5, "unequal": 10.0},
    "8 paired": {"animals": 8, "within": True},
    "8 paired, sessions alike": {"animals": 8, "within": True, "alike": True},
    "8 against 8 in two sexes": {"animals": 16, "sex_effect": 0.5},
    "the same, sex not named": {"animals": 16, "sex_effect": 0.5},
}
"""Options of `neuroprior.behaviour.simulated_study` for each design."""

WITHOUT_STRATA = ("the same, sex not named",)

STAR, INTERACTION = "any star", "interaction with sex"


@dataclass(frozen=True)
class Batch:
    """Some simulated studies of one design."""

    design: str
    effect: bool
    number: int

    def __str__(self) -> str:
        name = self.design.replace(",", "").replace("%", "percent").replace(" ", "-")
        return f"{'effect' if self.effect else 'none'}-{name}-{self.number}"


@claim_out
def study(
    studies: NonNegativeInt = 1000,
    with_effect: PositiveInt = 200,
    time_studies: NonNegativeInt = 200,
    actions: PositiveInt = 100,
    permutations: PositiveInt = 999,
    seed: NonNegativeInt = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/study",
) -> None:
    """Simulated studies with known truth: how often each test finds an effect that is there, or is not.

    Animals with two sessions each; see `neuroprior.behaviour.simulated_study`.

    Args:
        studies: simulated studies without an effect, for each design; 0: conditions are not compared.
        with_effect: simulated studies with one.
        time_studies: simulated studies of drift, lags and survival, for each source; 0: none.
        actions: behaviours in each session.
        permutations: random ones of each test at most.
        seed: of the first study; the others follow.
        processes: how many run at a time; all cores by default.
        dask: address of a Dask scheduler; None: this machine.
        out: folder for tables (CSV), `results.json` and `report.html`.
    """
    numbers = {"studies": studies, "with_effect": with_effect, "time_studies": time_studies, "actions": actions}
    numbers |= {"permutations": permutations, "seed": seed}
    sections, frames, folder = list[Section](), dict[str, pd.DataFrame](), Path(out) / "jobs"
    if studies:
        jobs = [
            Batch(design, effect, number)
            for effect in (True, False)
            for design in DESIGNS
            for number in range(-(-(with_effect if effect else studies) // TOGETHER))
        ]
        run = JobRun(partial(compared, numbers), folder, numbers)
        job_rows = run.do(jobs, processes=processes, dask=dask, title="studies")
        rows = [asdict(job) | row for job, batch in zip(jobs, job_rows, strict=True) for row in batch]
        frame = pd.DataFrame(
            rows, columns=["design", "effect", "kind", "study", "level", "test", "p_value", "p_corrected", "feature"]
        )
        frames["tests"] = _shares(frame[frame["kind"] == "test"])
        frames["features"] = _features(frame[frame["kind"] == "feature"], with_effect)
        tables = [_test_table(frames["tests"], studies), _feature_table(frames["features"])]
        sections.append(Section("Conditions", tables=tables))
    if time_studies:
        batches = [
            time_tests.Batch(source, number)
            for source in time_tests.SOURCES
            for number in range(-(-time_studies // time_tests.TOGETHER))
        ]
        timed = JobRun(partial(time_tests.tested, numbers), folder, numbers)
        results = timed.do(batches, processes=processes, dask=dask, title="studies of time")
        frames["time"] = time_tests.share_starred(list(zip(batches, results, strict=True)))
        sections.append(Section("Time", tables=[time_tests.starred_table(frames["time"])]))
    publish(
        Document(
            "Simulated studies of behaviour",
            f"{studies} studies of conditions without an effect for each design, {with_effect} with one;"
            f" {time_studies} of drift, lags and survival for each source",
            sections,
            frames,
            numbers,
            keys={"tests": "rows"},
        ),
        Path(out),
    )


def compared(numbers: dict[str, int], batch: Batch) -> list[dict[str, Any]]:
    """The p-values of every test in each study of a batch, and the features that were found to differ."""
    total = numbers["with_effect"] if batch.effect else numbers["studies"]
    first = batch.number * TOGETHER
    strata: list[str] | None = [] if batch.design in WITHOUT_STRATA else None
    rows = []
    for number in range(first, min(first + TOGETHER, total)):
        seed = numbers["seed"] + number
        events = simulated_study(seed, effect=batch.effect, actions=numbers["actions"], **DESIGNS[batch.design])
        plans = recordings_of(events).plans(compare="treatment", reference="saline", strata=strata)
        names = list(plans.action_names or ())
        one = compare_conditions(plans, numbers["permutations"], torch.Generator().manual_seed(seed))
        starred = any(bool(one.significant(family).any()) for family in one.families)
        tests = one.tests | {"all together": (one.p_value, one.p_value), STAR: (1.0 - starred, 1.0 - starred)}
        tests |= {} if one.interaction is None else {INTERACTION: (one.interaction.p_value, one.interaction.p_value)}
        level = (ceil(LEVEL / one.smallest_p - 1e-9) - 1) * one.smallest_p
        common = {"study": seed, "level": level}
        rows += [
            {"kind": "test", **common, "test": name, "p_value": p, "p_corrected": c} for name, (p, c) in tests.items()
        ]
        for family in one.families:
            for feature in one.significant(family).nonzero()[:, 0].tolist():
                spelled = " ".join(names[action] for action in family.features[feature].tolist())
                rows.append({"kind": "feature", **common, "test": family.name, "feature": spelled})
    return rows


def _shares(tests: pd.DataFrame) -> pd.DataFrame:
    """A row for each design and test: the shares of studies with p < 0.05 without an effect, and with one (corrected).

    `level` is the largest p-value below 0.05 that is possible. All shares have Wilson's interval.
    """
    rows = []
    for (design, test), design_tests in tests.groupby(["design", "test"], sort=False):
        null, effect = design_tests[~design_tests["effect"]], design_tests[design_tests["effect"]]
        row = {"design": design, "test": test, "level": design_tests["level"].iloc[0], "studies": len(null)}
        for name, p_values in (("alarms", null["p_value"]), ("power", effect["p_corrected"])):
            values = share_interval(int((p_values < LEVEL).sum()), len(p_values))
            row |= dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))
        rows.append(row)
    return pd.DataFrame(rows)


def _features(features: pd.DataFrame, studies: int) -> pd.DataFrame:
    """In how many studies with an effect each changed feature is found, and any transition or duration that is not."""
    candidates = features[features["effect"] & features["test"].isin(["transitions", "durations"])]
    candidates = candidates.assign(
        planted=(candidates["test"] + " " + candidates["feature"]).isin([" ".join(words) for words in PLANTED])
    )
    rows = []
    for design in DESIGNS:
        in_design = candidates[candidates["design"] == design]
        for test, *names in sorted(PLANTED):
            matching = in_design[(in_design["test"] == test) & (in_design["feature"] == " ".join(names))]
            rows.append((design, f"{test}: {' '.join(names)}", True, matching["study"].nunique()))
        rows.append(
            (design, "any other transition or duration", False, in_design[~in_design["planted"]]["study"].nunique())
        )
    frame = pd.DataFrame(rows, columns=["design", "feature", "planted", "found"])
    shares = pd.DataFrame([share_interval(number, studies)._asdict() for number in frame["found"]])
    shares = shares.rename(columns={"mean": "power", "low": "power_low", "high": "power_high"})
    return pd.concat([frame, shares], axis=1).assign(studies=studies)


def _test_table(frame: pd.DataFrame, studies: int) -> Table:
    most = stats.binom.ppf(0.975, studies, LEVEL) / studies
    columns: dict[str, Any] = {
        "design": lambda row: "" if row.test != frame["test"].iloc[0] else str(row.design),
        "test": "test",
        "false alarms, %": lambda row: _percent(row, "alarms") + ("*" if row.alarms > most else " "),
        "power, %": lambda row: _percent(row, "power"),
    }
    caption = (
        f"Shares of studies with p < {LEVEL} without an effect, and with one (corrected), with 95 % intervals (Wilson)."
        f" *: above {100 * most:.1f} %, which happens in one of 40 exact tests. Any star: of a feature, corrected for"
        " all features and families. The effect does not depend on the sex."
    )
    return table(frame, columns, caption, "False alarms, and effects found, by test", "llrr")


def _percent(row: Any, name: str) -> str:
    share, low, high = (100 * row[column] for column in (name, f"{name}_low", f"{name}_high"))
    return f"{share:.1f} ({low:.1f} to {high:.1f})"


def _feature_table(frame: pd.DataFrame) -> Table:
    columns: dict[str, Any] = {
        "design": "design",
        "feature": "feature",
        "found, %": lambda row: _percent(row, "power"),
    }
    caption = "Share of studies with an effect in which the feature is significant (corrected)."
    return table(frame, columns, caption, "Effects found, by feature", "llr")
