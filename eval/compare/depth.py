"""`python -m eval depth`: how deep to plan, and who should choose it: every fixed horizon against a chosen one."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from rich.console import Console

from eval.compare import planner_report
from eval.compare import run as compare_cell
from eval.compare.command import check, command
from eval.compare.curves import starts_of
from eval.compare.jobs import Study, cells_of, run_cells
from eval.compare.planners import ORDERS, entry_of, planned
from eval.compare.run import Contest
from eval.compare.settings import Settings
from eval.worlds.suite import TASKS, Task
from neuroprior import Planner, Prior, SamplingPlanner
from neuroprior.planners import HorizonPlanner

WORLDS = ("grid", "four_rooms", "egocentric", "goal_maze", "taxi", "frozen_lake")

LISTS: dict[str, dict[str, Any]] = {
    "worlds": {"default": list(WORLDS), "choices": tuple(TASKS), "help": "worlds to plan in, without chance"},
    "num_plans": {"type": int, "default": [4, 16, 64], "help": "numbers of the longest plans, powers of two"},
}
"""Options that take several words."""

ABOUT = (
    "How deep to plan",
    "Many short plans or few long ones, for as many steps in a model of the world: can what they score tell?",
)

CHOSEN = "chosen"
"""The planner that chooses its horizon, in tables."""

VERSION = 2
"""Of the way in which a cell is done; counts up with each change of it."""


@dataclass(frozen=True)
class DepthSettings(Settings):
    """All that decides the results of a cell, beside its world and seed.

    Attributes:
        length: the longest horizon.
    """

    length: int = 64


def depth(
    worlds: list[str] = list(WORLDS),  # noqa: B006
    num_plans: list[int] = [4, 16, 64],  # noqa: B006
    seeds: int = 20,
    length: int = 64,
    starts: int = 32,
    training_starts: int = 1000,
    seed: int = 0,
    processes: int | None = None,
    out: str = "runs/depth",
) -> None:
    """How deep should one plan: many short plans or few long ones, and can what they score tell?

    With as many steps in a model of the world, planners sample from the same prior: plans of 2, 4, 8 actions and so on,
    and plans whose horizon is chosen by what the first of them scored. All plans may end after any of their actions.
    Prints the share of the oracle of the longest plans; writes tables (CSV), results.json and report.html to a folder.
    Interrupted, the same command goes on.

    Args:
        worlds: to plan in, without chance.
        num_plans: numbers of the longest plans, powers of two; the steps that these take are spent in every way.
        seeds: repeats in each world, each with worlds and priors of its own; intervals are over them.
        length: actions in the longest plans, a power of two.
        starts: held-out starts to plan from.
        training_starts: from so many starts plans are collected to learn from.
        seed: of everything random.
        processes: how many cells, a world and a seed each, are done at a time; all cores by default, and a single one
            in each process that torchrun started.
        out: folder for the report, and for finished cells, from which an interrupted run goes on.
    """
    if length < 2 or length & (length - 1):
        raise ValueError(f"length: a power of two from 2 is expected, not {length}")
    settings = DepthSettings(tuple(num_plans), ("markov",), (), 9, 1, starts, training_starts, seed, length=length)
    check(worlds, seeds, processes, settings)
    for world in worlds:
        if TASKS[world].worlds(0).held_out.stochastic:
            raise ValueError(f"worlds: one without chance is expected, not {world}")
    folder = Path(out)
    study = Study.prepare(folder, settings, run_depth, compare_cell.recipe() + str(VERSION))
    cells = run_cells(study, cells_of(worlds, seeds), processes)
    if cells is not None:
        told = {"worlds": list(worlds), "seeds": seeds} | asdict(settings)
        planner_report.write_report(cells, told, folder, Console(), command("depth"), CHOSEN, ABOUT)


def run_depth(task: Task, seed: int, settings: DepthSettings) -> dict[str, Any]:
    """Collect, fit, grow, and plan with every horizon in the worlds of one seed.

    Args, raises: see `eval.compare.run.run_cell`.

    Returns:
        `entries`, as `eval.compare.planners.run_planners` gives them.
    """
    begin = perf_counter()
    task = replace(task, any_prefix=True)
    contest = Contest(task, seed, replace(settings, sees=task.sights[-1:]), ORDERS)
    starts = starts_of(task, contest.worlds.held_out, settings.starts, settings.length, contest.generator)
    entries = []
    for one in contest.grown():
        for name, makes in _planners(one.prior, task, settings):
            found = [planned(starts, planner, contest.generator) for planner in makes]
            entries.append(entry_of(name, one, 1.0, found))
    cell: dict[str, Any] = {"world": task.name, "seed": seed, "about": task.about, "num_plans": settings.num_plans}
    return cell | {"entries": entries, "seconds": perf_counter() - begin}


def _planners(prior: Prior, task: Task, settings: DepthSettings) -> Iterator[tuple[str, list[Planner]]]:
    """Names, and planners for each number of plans."""
    how: dict[str, Any] = {"objective": task.objective, "discount": task.discount}
    horizons = [2**k for k in range(1, settings.length.bit_length())]
    for horizon in horizons:
        more = settings.length // horizon
        yield (
            f"{horizon} actions",
            [SamplingPlanner(prior, horizon, number * more, any_prefix=True, **how) for number in settings.num_plans],
        )
    yield CHOSEN, [HorizonPlanner(prior, settings.length, number, **how) for number in settings.num_plans]
