"""The runs of an experiment, a world and a seed each, and statistics over the seeds of each world.

All intervals are Student's, over the seeds of a world: these are what is independent.
"""

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from jsonargparse.typing import extend_base_type, restricted_number_type

from eval.worlds.aggregates import interquartile_gap, interquartile_mean, mean_intervals, probability_of_improvement
from neuroprior._files import read_json
from neuroprior._jobs import JobRun
from neuroprior._statistics import holm, paired_difference
from neuroprior.behaviour.reporting.document import Column, Document, publish, table
from neuroprior.behaviour.reporting.page import Table

MAKERS = ("gymnasium", "minigrid", "mujoco")
"""Packages of which another version may make other worlds."""

Seed = restricted_number_type("Seed", int, [(">=", 0), ("<", 2**40)], docstring="A seed of everything random.")


def _check_power(_: type, value: Any) -> None:
    if int(value) not in [2**k for k in range(21)]:
        raise ValueError(f"{value} does not conform to restriction: a power of two from 1 to 2**20")


PowerOfTwo = extend_base_type("PowerOfTwo", int, _check_power, "A power of two.")


class Run(NamedTuple):
    """A world, by its name, and the number of a seed."""

    world: str
    seed: int

    @property
    def name(self) -> str:
        """Its name in messages and files."""
        return f"{self.world}-{self.seed}"


def runs_of(worlds: Sequence[str], seeds: int) -> list[Run]:
    """A run for each of `seeds` seeds and each of the worlds; an experiment that is cut off has some of all worlds."""
    return [Run(world, seed) for seed in range(seeds) for world in worlds]


def read_run(path: Path) -> dict[str, Any]:
    """The result of a finished run.

    Raises:
        ValueError: the file holds something else.
        OSError: it cannot be read.
    """
    result = read_json(path)
    if not isinstance(result, dict) or path.stem != f"{result.get('world')}-{result.get('seed')}":
        raise ValueError(f"{path}: the result of another run, or of none")
    return result


def run_experiment(
    name: str,
    work: Callable[..., dict[str, Any]],
    report: Callable[[list[dict[str, Any]], dict[str, Any], str], Document],
    settings: Any,
    worlds: Sequence[str],
    seeds: int,
    out: str,
    processes: int | None,
    dask: str | None,
) -> Document:
    """Do the runs of an experiment that are not finished yet, then print and write its report.

    Args:
        name: of the experiment.
        work: does a run, `work(run, settings=settings)`.
        report: makes the document, of the results in the order of `runs_of`, what was asked, and the command line.
        settings: a dataclass; its property `asked`, if it has one, says what distinguishes finished runs.
        worlds, seeds: see `runs_of`.
        out: the folder of the experiment; finished runs are kept in `runs` below it.
        processes, dask: see `neuroprior._jobs.JobRun.do`.
    """
    asked = {"command": name, **(settings.asked if hasattr(settings, "asked") else asdict(settings))}
    run = partial(work, settings=settings)
    jobs = JobRun(run, Path(out) / "runs", asked, name=attrgetter("name"), load=read_run, packages=MAKERS)
    results = jobs.do(runs_of(worlds, seeds), processes=processes, dask=dask, title=name)
    shown = {"worlds": list(worlds), "seeds": seeds} | asdict(settings)
    document = report(results, shown, command_line(name.split()[0]))
    publish(document, Path(out))
    return document


def command_line(command: str) -> str:
    """What was typed to run an experiment, or its command alone where it was called from Python."""
    words = sys.argv[1:] if sys.argv[1:2] == [command] else [command]
    return "python -m eval " + shlex.join(words)


def check_distinct(**options: Sequence[Any]) -> None:
    """Raise ValueError, naming the option, where a list is empty or holds something twice."""
    for name, values in options.items():
        if not values:
            raise ValueError(f"`{name}` must have at least one")
        if len(set(values)) < len(values):
            raise ValueError(f"{name}: each may be given once, not {' '.join(map(str, values))}")


def frame_of(results: Sequence[Mapping[str, Any]], key: str = "entries") -> pd.DataFrame:
    """The rows that the results of runs hold under `key`, each with the world and the seed of its run."""
    return pd.DataFrame([{"world": one["world"], "seed": one["seed"], **row} for one in results for row in one[key]])


def seed_means(frame: pd.DataFrame, by: Sequence[str], value: str, others: Sequence[str] = ()) -> pd.DataFrame:
    """Means over the rows of each group, one for each seed.

    Returns:
        A row for each group: columns `by`, `value` with its interval (`low`, `high`), the number of `seeds`, `others`.
    """
    intervals: pd.DataFrame = mean_intervals(frame, by, value).rename(columns={"mean": value, "n": "seeds"})
    means = frame.groupby(list(by), sort=False, dropna=False)[list(others)].mean()
    return intervals.join(means.reset_index(drop=True))


def paired_differences(pairs: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """How much higher `first` is than `second`, paired by seed, for each group of rows; see `paired_difference`.

    Args:
        pairs: a row a seed of each group: the columns `by`, one of which is `world`, `first` and `second`.
        by: the columns that define the groups.

    Returns:
        A row for each group of at least two seeds: the columns `by`, `difference`, `low`, `high`, `p_value` of the
        two-sided test, and `p_holm`, corrected for all tests in the same world.
    """
    rows = [
        (*place, *paired_difference(group["first"], group["second"]))
        for place, group in pairs.groupby(list(by), sort=False)
        if len(group) > 1
    ]
    gaps = pd.DataFrame(rows, columns=[*by, "difference", "low", "high", "p_value"])
    return gaps.assign(p_holm=gaps.groupby("world")["p_value"].transform(holm))


def across_worlds(pairs: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """`first` and `second` over several worlds: interquartile means, and how often `first` is higher.

    Args:
        pairs: see `paired_differences`; of one row a world, seed and group.
        by: the columns that define the groups, without `world`.

    Returns:
        A row for each group with at least two worlds, and two seeds that all its worlds have: the columns `by`;
        `worlds` and `seeds`, how many; `first` and `second`, the interquartile means over worlds, and `difference`, how
        much higher the first is; `improvement`, the probability that `first` is higher in a world drawn at random; each
        with its `_low` and `_high`.
    """
    rows = []
    for place, group in pairs.groupby(list(by), sort=False):
        first, second = (group.pivot(index="world", columns="seed", values=side) for side in ("first", "second"))
        seeds = first.columns[first.notna().all() & second.notna().all()]
        if len(first) > 1 and len(seeds) > 1:
            a, b = first[seeds].to_numpy(), second[seeds].to_numpy()
            aggregates = (interquartile_mean(a), interquartile_mean(b), interquartile_gap(a, b))
            rows.append((*place, *a.shape, *chain(*aggregates, probability_of_improvement(a, b))))
    names = [name + end for name in ("first", "second", "difference", "improvement") for end in ("", "_low", "_high")]
    return pd.DataFrame(rows, columns=[*by, "worlds", "seeds", *names])


def significance(gaps: pd.DataFrame, what: str) -> str:
    """How many of `paired_differences` are significant, in one line."""
    if gaps.empty:
        return f"{what}: differences need at least two seeds."
    clear = gaps.loc[gaps["p_holm"] < 0.05, "difference"]
    return (
        f"{what}: {len(clear)} of {len(gaps)} differences are significant (p < 0.05, Holm's correction for all tests in"
        f" a world): {(clear > 0).sum()} positive, {(clear <= 0).sum()} negative."
    )


def table_by(
    rows: pd.DataFrame,
    names: Mapping[str, str],
    by: str,
    cells: Sequence[str],
    caption: str = "",
    title: str = "",
    timed: int | None = None,
) -> Table:
    """A table with a row for each value of the columns `names`, by heading, and a column for each number in `by`.

    Args:
        rows: those that are shown.
        names: the columns that name a row of the table, by heading.
        by: the column of the numbers.
        cells: the text of each of `rows`.
        caption, title: see `Table`.
        timed: a number in `by`: of its rows the milliseconds of a decision are shown in a last column.
    """
    labels = list(names.values())
    wide = rows.assign(cell=cells).pivot_table("cell", labels, by, aggfunc="first").rename(columns="{:,}".format)
    columns = dict(names) | {number: number for number in wide.columns}
    if timed is not None:
        times = rows[rows[by] == timed].set_index(labels)["seconds_per_decision"]
        wide, columns = wide.assign(ms=1000 * times), columns | {"ms": "ms:.3g"}
    in_order = rows[labels].drop_duplicates().merge(wide.reset_index(), on=labels)
    return table(in_order, columns, caption, title, "l" * len(names) + "r" * (len(columns) - len(names)))


def difference_table(
    gaps: pd.DataFrame, title: str, names: Mapping[str, Column], unit: str, factor: float = 1
) -> Table:
    """`paired_differences` of one world as a table; `names`: the columns that name a row, by heading."""
    columns = dict(names) | {
        "difference": lambda row: f"{factor * row['difference']:+.1f}",
        "95 % interval": lambda row: f"{factor * row['low']:+.1f} to {factor * row['high']:+.1f}",
        "p": lambda row: f"{row['p_holm']:.3f}" if row["p_holm"] >= 0.001 else "< .001",
    }
    caption = f"Differences in {unit}, paired by seed; p: corrected for all tests in this world (Holm)."
    return table(gaps, columns, caption, title, "l" * len(names) + "rrr")


def across_table(
    across: pd.DataFrame, names: Mapping[str, Column], first: str, second: str, unit: str, factor: float, how: str = ""
) -> Table:
    """`across_worlds` as a table; `names`: the columns that name a row, by heading; `first`, `second`: headings.

    `how` goes into its title. The number of worlds has a column where it differs.
    """
    numbers = across["worlds"].unique()
    title = f"Over {numbers[0]} worlds" if len(numbers) == 1 else "Over worlds"
    columns = dict(names) | ({"worlds": "worlds"} if len(numbers) > 1 else {})
    columns |= {
        first: lambda row: plus_minus(row, "first", factor, ends="first_"),
        second: lambda row: plus_minus(row, "second", factor, ends="second_"),
        "difference": lambda row: plus_minus(row, "difference", factor, sign="+", ends="difference_"),
        "P(better)": lambda row: "{improvement:.2f} ({improvement_low:.2f} to {improvement_high:.2f})".format(**row),
    }
    caption = (
        f"Interquartile means over worlds of {unit}, their difference, paired by seed, and the probability of"
        " improvement in a world drawn at random;"
        " Student's 95 % intervals over seeds."
    )
    return table(across, columns, caption, f"{title}{how}", "l" * len(names) + "r" * (len(columns) - len(names)))


def over_seeds(rows: pd.DataFrame) -> str:
    """What the intervals of rows are, for a caption."""
    seeds = rows["seeds"].max()
    return f"±: half of Student's 95 % interval over {seeds} seeds." if seeds > 1 else "A single seed."


def plus_minus(row: Any, name: str, factor: float = 1, digits: int = 1, sign: str = "", ends: str = "") -> str:
    """A mean with the longer side of its interval, the columns `low` and `high` after `ends`, where it has one."""
    mean, low, high = (factor * row[one] for one in (name, f"{ends}low", f"{ends}high"))
    if pd.isna(mean):
        return ""
    text = f"{round(mean, digits) + 0:{sign}.{digits}f}"  # no minus before 0.0
    return text if pd.isna(low) else f"{text} ±{max(high - mean, mean - low):.{digits}f}"
