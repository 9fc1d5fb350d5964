"""`python -m eval options`: do modes that persist, as options, help a planner that samples?"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypeAlias

from jsonargparse.typing import PositiveInt

from eval.options.report import options_document
from eval.options.run import LABYRINTH, OptionSettings, options_run
from eval.worlds import runs
from eval.worlds.labyrinth import check_fits
from eval.worlds.suite import TASKS
from neuroprior._folders import claim_out
from neuroprior.behaviour.reporting.document import write_figures

WORLDS = (LABYRINTH, "four_rooms", "goal_maze")
"""Worlds that are planned in by default."""

OFFERED = (LABYRINTH, *(name for name, task in TASKS.items() if task.feature_sets and name != "mid_plan"))
"""Worlds in which features are observed that can be numbered."""

OptionWorld: TypeAlias = Literal[OFFERED]  # type: ignore[valid-type]


@claim_out
def options(
    worlds: Sequence[OptionWorld] = WORLDS,
    seeds: PositiveInt = 5,
    lengths: Sequence[PositiveInt] = (8, 16, 32, 64),
    num_plans: Sequence[PositiveInt] = (4, 16, 64),
    modes: Sequence[PositiveInt] = (2, 3, 5),
    starts: PositiveInt = 63,
    training_starts: PositiveInt = 1000,
    seed: runs.Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/options",
) -> None:
    """Do modes that persist, as options, help a planner that samples?

    Chains, priors with hidden modes and macro-actions learn from the same plans: in the labyrinth those of the mice, in
    other worlds those of a planner that tries all short plans. Then a planner draws candidates from each. Prints
    tables; writes them (CSV), results.json, report.html and figures to a folder. Interrupted, the same command goes on.

    Args:
        worlds: to plan in.
        seeds: repeats in each world, each with held-out plans, priors and candidates of its own; intervals are over
            them.
        lengths: moves in a plan in the labyrinth; in other worlds it is the world's.
        num_plans: numbers of candidate plans.
        modes: numbers of modes.
        starts: nodes of the labyrinth to plan from, drawn anew in each repeat; in other worlds four times as many.
        training_starts: plans to learn from are collected from so many starts, and from several times as many in worlds
            where most starts lead nowhere; of the mice's plans four fifths are always learned from.
        seed: of everything random.
        processes: how many runs, a world and a seed each, are done at a time; all cores by default.
        dask: address of a Dask scheduler, tcp://host:port, whose workers do the runs.
        out: folder for the report and for finished runs.
    """
    runs.check_distinct(worlds=worlds, lengths=lengths, num_plans=num_plans, modes=modes)
    if LABYRINTH in worlds:
        check_fits(starts, lengths)
    numbers, plan_lengths, kinds = (tuple(sorted(values)) for values in (num_plans, lengths, modes))
    settings = OptionSettings(numbers, plan_lengths, kinds, starts, training_starts, seed)
    how = worlds, seeds, out, processes, dask
    document = runs.run_experiment("options", options_run, options_document, settings, *how)
    write_figures(Path(out), document.figures)
