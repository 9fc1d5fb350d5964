"""`python -m eval grow`: what priors gain from the horizon curriculum, in which they learn from ever longer plans."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import pandas as pd
from jsonargparse.typing import PositiveInt
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from eval.compare.command import KINDS, Kind, TrainingStarts
from eval.compare.run import Settings, curriculum_run
from eval.worlds.runs import (
    MAKERS,
    PowerOfTwo,
    Seed,
    across_table,
    across_worlds,
    check_distinct,
    command_line,
    difference_table,
    paired_differences,
    plus_minus,
    runs_of,
    significance,
)
from eval.worlds.suite import TASKS, Context, WorldName, check_contexts
from neuroprior._jobs import JobRun
from neuroprior.analysis.statistics import mean_intervals
from neuroprior.report.document import Document, publish, records, table, write_frames
from neuroprior.report.drawing import WIDTH, band, drawn, expect_some, legend, lines, panels
from neuroprior.report.page import FigureBox, Section, Table

ROUNDS = 4
"""Rounds at most, where no lengths are given."""

PRIOR = ["world", "prior", "sees"]
NAMES = {"prior": "prior", "context": "sees"}
ACROSS = {"round": "rounds of the curriculum", "length": "actions in a plan"}


def grow(
    worlds: Sequence[WorldName] = tuple(TASKS),
    lengths: Sequence[PositiveInt] | None = None,
    seeds: PositiveInt = 5,
    num_plans: PowerOfTwo = 256,
    kinds: Sequence[Kind] = KINDS,
    context: Sequence[Context] = ("none",),
    steps: PositiveInt = 600,
    starts: PositiveInt = 32,
    training_starts: TrainingStarts = 1000,
    seed: Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/grow",
) -> None:
    """How much do priors gain by planning with them, learning from those plans, and planning longer?

    All plans of a few actions can be tried; longer ones cannot. In each world, for each seed, priors learn from short
    plans, propose longer ones, learn from the best of these, and so on. Prints the normalised score after each round;
    writes tables (CSV), results.json and report.html to a folder. Interrupted, the same command goes on.

    Args:
        worlds: to plan in.
        lengths: actions in the plans of each round, each longer than the one before; by default those of the world.
        seeds: repeats in each world, each with worlds and priors of its own; intervals are over them.
        num_plans: candidate plans, a power of two.
        kinds: of priors.
        context: of priors: none, what is observed at the start (initial), or before each action (per-step).
        steps: of training of each neural prior in a round, at most.
        starts: held-out starts to plan from.
        training_starts: starts from which plans are collected to learn from, in each round; several times as many in
            worlds where most starts lead nowhere.
        seed: of everything random.
        processes: how many runs, a world and a seed each, are done at a time; all cores by default.
        dask: address of a Dask scheduler, tcp://host:port, whose workers do the runs.
        out: folder for the report and for finished runs.
    """
    check_distinct(worlds=worlds, kinds=kinds, context=context)
    check_contexts(worlds, context)
    longer = tuple(lengths or ())
    if list(longer) != sorted(set(longer)):
        raise ValueError(f"lengths: each longer than the one before is expected, not {' '.join(map(str, longer))}")
    for world in worlds:
        if longer and longer[0] <= TASKS[world].depth:
            depth = TASKS[world].depth
            raise ValueError(f"lengths: more than {depth} is expected first: in {world} all plans of {depth} are tried")
    rounds = len(longer) or ROUNDS
    how = (tuple(kinds), tuple(context), rounds, steps, starts, training_starts, seed)
    settings = Settings((num_plans,), *how, lengths=longer)
    folder, asked = Path(out), {"command": "grow", **settings.asked}
    work = partial(curriculum_run, settings=settings)
    jobs = JobRun(work, folder / "runs", asked, name=attrgetter("name"), packages=MAKERS)
    results = jobs.do(runs_of(worlds, seeds), processes=processes, dask=dask, title="grow")
    told = {"worlds": list(worlds), "seeds": seeds} | asdict(settings)
    document = curriculum_document(results, told, command_line("grow"))
    publish(document, folder)
    write_frames(folder, {"grow": pd.DataFrame(document.results["rows"])})


def curriculum_document(results: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], command: str) -> Document:
    """The tables and figures of the results of `curriculum_run`."""
    frame = pd.DataFrame([{k: one[k] for k in ("world", "seed")} | entry for one in results for entry in one["growth"]])
    rows, pairs = curriculum_rows(frame), first_and_last(frame)
    gaps, across = paired_differences(pairs, PRIOR), across_worlds(pairs, PRIOR[1:])
    tables, boxes = [], []
    for world, own in rows.groupby("world", sort=False):
        tables += curriculum_tables(own)
        if len(here := gaps[gaps["world"] == world]):
            above = f"{world}: after the last round minus before the first, plans of {own['length'].max()} actions"
            tables.append(difference_table(here, above, NAMES, "normalised score, % of the optimum", 100))
        caption = f"{world}: {own['num_plans'].iloc[0]:,} candidates for each start; bands: 95 % intervals over seeds."
        alt = f"Normalised score in {world} against rounds and actions in a plan; the numbers are in the tables."
        boxes.append(FigureBox(curriculum_figure(own), caption, alt))
    if len(across):
        unit = "the normalised score of the longest plans, % of the optimum"
        tables.append(across_table(across, NAMES, "after", "before", unit, 100))
    lead = significance(gaps, "Normalised scores after the last round of the curriculum against before the first")
    sections = [
        Section("Normalised score against rounds and length of plans", [], figures=boxes),
        Section("Tables", [], tables),
    ]
    frames = {"gains": gain_rows(pairs, gaps), "across": across}
    more = {"rows": records(rows), "words": [lead]}
    return Document("Horizon curriculum", lead, sections, frames, settings, command, more)


def curriculum_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """The normalised score with its interval over seeds, a row a world, prior, round, and length and number of plans."""
    found = mean_intervals(frame, [*PRIOR, "round", "length", "num_plans"], "share")
    return found.rename(columns={"mean": "oracle_share", "n": "seeds"})


def first_and_last(frame: pd.DataFrame) -> pd.DataFrame:
    """A row a world, prior and seed: its score with the longest plans after the last round, `first`, and before the
    first round, `second`.
    """
    longest = frame[frame["length"] == frame.groupby("world")["length"].transform("max")]
    by = [*PRIOR, "seed"]
    ends = longest.sort_values("round", kind="stable").groupby(by, sort=False)
    found = ends.agg(first=("share", "last"), second=("share", "first"), length=("length", "max"), rounds=("round", "max"))
    return found.reset_index()


def gain_rows(pairs: pd.DataFrame, gaps: pd.DataFrame) -> pd.DataFrame:
    """The mean gain of `first_and_last` with its interval over seeds, a row a world and prior."""
    gains = pairs.assign(gain=pairs["first"] - pairs["second"])
    found = mean_intervals(gains, [*PRIOR, "length", "rounds"], "gain").rename(columns={"mean": "gain", "n": "seeds"})
    return found.merge(gaps[[*PRIOR, "p_value", "p_holm"]], "left", PRIOR)


def views(rows: pd.DataFrame) -> Iterator[tuple[str, str, pd.DataFrame]]:
    """The rows of a world by round with the longest plans, and by length after the last round.

    Yields:
        The column that varies, what does not, in words, and the rows.
    """
    longest, last = rows["length"].max(), rows["round"].max()
    yield "round", f"plans of {longest} actions", rows[rows["length"] == longest]
    yield "length", f"after {last} rounds", rows[rows["round"] == last]


def curriculum_tables(rows: pd.DataFrame) -> Iterator[Table]:
    """The normalised scores in one world, a table a view."""
    world, number, seeds = (rows[name].iloc[0] for name in ("world", "num_plans", "seeds"))
    over = f"; ±: half of Student's 95 % interval over {seeds} seeds." if seeds > 1 else "; a single seed."
    for by, fixed, own in views(rows):
        own = own.assign(score=[plus_minus(row, "oracle_share", 100) for _, row in own.iterrows()])
        cells = own.pivot_table("score", ["prior", "sees"], by, aggfunc="first", sort=False).sort_index(axis=1)
        cells = cells.rename(columns=str)
        caption = f"Normalised score, % of the optimum, by {ACROSS[by]}; {number:,} candidates{over}"
        columns = NAMES | {name: name for name in cells.columns}
        yield table(cells.reset_index(), columns, caption, f"{world}, {fixed}", "ll" + "r" * len(cells.columns))


@drawn
def curriculum_figure(rows: pd.DataFrame) -> Figure:
    """Normalised score of one world's priors, a panel a view, a line a prior.

    Raises:
        ValueError: there are no rows.
    """
    expect_some("rows", rows)
    figure, axes = panels(1, 2, (WIDTH, 3.4), sharey=True)
    for panel, (by, fixed, own) in zip(axes, views(rows), strict=True):
        own = own.assign(name=own["prior"] + own["sees"].map(lambda sees: "" if sees == "none" else f", {sees}"))
        names = list(dict.fromkeys(own["name"]))
        for name, (color, line) in zip(names, lines(names), strict=True):
            points = own[own["name"] == name][[by, "oracle_share", "low", "high"]].sort_values(by)
            band(panel, list(points.itertuples(index=False, name=None)), color, name, line)
        panel.set_xticks(sorted(set(own[by])))
        panel.set_xlabel(ACROSS[by])
        panel.set_title(fixed)
        panel.grid(axis="y")
    axes[0].set_ylabel("normalised score, % of the optimum")
    axes[0].yaxis.set_major_formatter(PercentFormatter(1, symbol=""))
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure
