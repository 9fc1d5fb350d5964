"""`python -m eval curriculum`: what priors gain from learning in rounds from ever longer plans."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import pandas as pd
from jsonargparse.typing import PositiveInt

from eval.compare.command import KINDS, Kind, TrainingStarts
from eval.compare.figures import View, score_panels
from eval.compare.run import Settings, curriculum_run
from eval.worlds import runs
from eval.worlds.suite import TASKS, Context, WorldName, check_contexts
from neuroprior._folders import claim_out
from neuroprior.behaviour.reporting.document import Document
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table

ROUNDS = 4
"""Rounds at most, where no lengths are given."""

PRIOR = ["world", "prior", "context"]
NAMES = {"prior": "prior", "context": "context"}


@claim_out
def curriculum(
    worlds: Sequence[WorldName] = tuple(TASKS),
    lengths: Sequence[PositiveInt] | None = None,
    seeds: PositiveInt = 5,
    num_plans: runs.PowerOfTwo = 256,
    kinds: Sequence[Kind] = KINDS,
    context: Sequence[Context] = ("none",),
    steps: PositiveInt = 600,
    starts: PositiveInt = 32,
    training_starts: TrainingStarts = 1000,
    seed: runs.Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/curriculum",
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
    runs.check_distinct(worlds=worlds, kinds=kinds, context=context)
    check_contexts(worlds, context)
    longer = tuple(lengths or ())
    if list(longer) != sorted(set(longer)):
        raise ValueError(f"`lengths` must each be longer than the one before, got {' '.join(map(str, longer))}")
    for world in worlds:
        if longer and longer[0] <= TASKS[world].depth:
            depth = TASKS[world].depth
            raise ValueError(f"`lengths` must begin above {depth}: in {world} all plans of {depth} are tried")
    how = (tuple(kinds), tuple(context), len(longer) or ROUNDS, steps, starts, training_starts, seed)
    settings = Settings((num_plans,), *how, lengths=longer)
    runs.run_experiment(
        "curriculum", curriculum_run, curriculum_document, settings, worlds, seeds, out, processes, dask
    )


def curriculum_document(results: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], command: str) -> Document:
    """The tables and figures of the results of `curriculum_run`."""
    frame = runs.frame_of(results, "curriculum").rename(columns={"share": "oracle_share"})
    rows = runs.seed_means(frame, [*PRIOR, "round", "length", "num_plans"], "oracle_share")
    pairs = first_and_last(frame)
    gaps, across = runs.paired_differences(pairs, PRIOR), runs.across_worlds(pairs, PRIOR[1:])
    gains = runs.seed_means(pairs.assign(gain=pairs["first"] - pairs["second"]), [*PRIOR, "length", "rounds"], "gain")
    tables: list[Table] = []
    boxes = []
    for world, scores in rows.groupby("world", sort=False):
        tables += curriculum_tables(scores)
        if len(world_gaps := gaps[gaps["world"] == world]):
            above = f"{world}: after the last round minus before the first, plans of {scores['length'].max()} actions"
            tables.append(runs.difference_table(world_gaps, above, NAMES, "normalised score, % of the optimum", 100))
        caption = (
            f"{world}: {scores['num_plans'].iloc[0]:,} candidates for each start; bands: 95 % intervals over seeds."
        )
        alt = f"Normalised score in {world} against rounds and actions in a plan; the numbers are in the tables."
        boxes.append(FigureBox(score_panels(list(views(scores)), 3.4), caption, alt))
    if len(across):
        unit = "the normalised score of the longest plans, % of the optimum"
        tables.append(runs.across_table(across, NAMES, "after", "before", unit, 100))
    lead = runs.significance(gaps, "Normalised scores after the last round of the curriculum against before the first")
    sections = [
        Section("Normalised score against rounds and length of plans", figures=boxes),
        Section("Tables", tables=tables),
    ]
    gains = gains.merge(gaps[[*PRIOR, "p_value", "p_holm"]], "left", PRIOR)
    frames = {"curriculum": rows, "gains": gains, "across": across}
    return Document(
        "Horizon curriculum",
        lead,
        sections,
        frames,
        settings,
        command,
        {"words": [lead]},
        keys={"curriculum": "rows"},
    )


def first_and_last(frame: pd.DataFrame) -> pd.DataFrame:
    """A row a world, prior and seed: its score with the longest plans after the last round (`first`) and before."""
    longest = frame[frame["length"] == frame.groupby("world")["length"].transform("max")]
    ends = longest.sort_values("round", kind="stable").groupby([*PRIOR, "seed"], sort=False)
    last = ends.last().rename(columns={"oracle_share": "first", "round": "rounds"})
    return last.assign(second=ends["oracle_share"].first()).reset_index()


def views(rows: pd.DataFrame) -> Iterator[View]:
    """Of one world's rows those with the longest plans, by round, and those after the last round, by length."""
    names = [f"{prior}, {context}".removesuffix(", none") for prior, context in rows[PRIOR[1:]].to_numpy()]
    rows, longest, last = rows.assign(name=names), rows["length"].max(), rows["round"].max()
    for title, panel_rows, across, label in (
        (f"plans of {longest} actions", rows[rows["length"] == longest], "round", "rounds of the curriculum"),
        (f"after {last} rounds", rows[rows["round"] == last], "length", "actions in a plan"),
    ):
        yield View(title, panel_rows, across, label, sorted(set(panel_rows[across])))


def curriculum_tables(rows: pd.DataFrame) -> Iterator[Table]:
    """The normalised scores in one world, a table a view."""
    world, number = rows["world"].iloc[0], rows["num_plans"].iloc[0]
    for view in views(rows):
        caption = f"Normalised score, % of the optimum, by {view.label}; {number:,} candidates. {runs.over_seeds(rows)}"
        cells = [runs.plus_minus(row, "oracle_share", 100) for _, row in view.rows.iterrows()]
        yield runs.table_by(view.rows, NAMES, view.across, cells, caption, f"{world}, {view.title}")
