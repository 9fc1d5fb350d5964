"""`python -m eval depth`: how deep to plan, and who should choose it: every fixed horizon against a chosen one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from jsonargparse.typing import PositiveInt

from eval.compare.horizon import HorizonPlanner
from eval.compare.planners import ORDERS, planned, planner_document
from eval.compare.run import Contest, Settings
from eval.worlds import runs
from eval.worlds.starts import starts_of
from eval.worlds.suite import TASKS, WorldName
from neuroprior._folders import claim_out
from neuroprior.planners import Planner, SamplingPlanner

WORLDS = ("grid", "four_rooms", "egocentric", "goal_maze", "taxi", "frozen_lake")

CHOSEN = "chosen"
"""The planner that chooses its horizon, in tables."""


@dataclass(frozen=True)
class DepthSettings(Settings):
    """As `Settings`, with the longest horizon."""

    length: int = 64


@claim_out
def depth(
    worlds: Sequence[WorldName] = WORLDS,
    num_plans: Sequence[runs.PowerOfTwo] = (4, 16, 64),
    seeds: PositiveInt = 20,
    length: runs.PowerOfTwo = 64,
    starts: PositiveInt = 32,
    training_starts: PositiveInt = 1000,
    seed: runs.Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/depth",
) -> None:
    """How deep should one plan: many short plans or few long ones, and can the scores show which?

    With as many steps in a model of the world, planners sample from the same prior: plans of 2, 4, 8 actions and so on,
    and plans whose horizon is chosen by the scores of the first of them. All plans may end after any of their actions.
    Prints the normalised score, in % of the optimum of the longest plans; writes tables (CSV), results.json and
    report.html to a folder. Interrupted, the same command goes on.

    Args:
        worlds: to plan in, deterministic ones.
        num_plans: numbers of the longest plans, powers of two; the steps that these take are spent in every way.
        seeds: repeats in each world, each with worlds and priors of its own; intervals are over them.
        length: actions in the longest plans, a power of two from 2.
        starts: held-out starts to plan from.
        training_starts: starts from which plans are collected to learn from.
        seed: of everything random.
        processes: how many runs, a world and a seed each, are done at a time; all cores by default.
        dask: address of a Dask scheduler, tcp://host:port, whose workers do the runs.
        out: folder for the report and for finished runs.
    """
    runs.check_distinct(worlds=worlds, num_plans=num_plans)
    if length < 2:
        raise ValueError(f"`length` must be a power of two from 2, got {length}")
    for world in worlds:
        if TASKS[world].worlds(0).held_out.stochastic:
            raise ValueError(f"`worlds` must be deterministic ones, got {world}")
    settings = DepthSettings(tuple(num_plans), ("markov",), (), 9, 1, starts, training_starts, seed, length=length)
    report = partial(planner_document, baseline=CHOSEN, title="How deep to plan")
    runs.run_experiment("depth", depth_run, report, settings, worlds, seeds, out, processes, dask)


def depth_run(run: runs.Run, settings: DepthSettings) -> dict[str, Any]:
    """Collect plans, fit priors, extend their horizons, and plan with every horizon in one seed's worlds.

    Returns, raises: see `eval.compare.planners.planner_run`.
    """
    task = replace(TASKS[run.world], any_prefix=True)
    contest = Contest(run, task, replace(settings, context=task.contexts[-1:]), ORDERS)
    how: dict[str, Any] = {"objective": task.objective, "discount": task.discount}
    longest = settings.length
    starts = starts_of(task, contest.worlds.held_out, settings.starts, longest, contest.generator)
    entries: list[dict[str, Any]] = []
    for one in contest.after_curriculum():
        for horizon in [*(2**k for k in range(1, longest.bit_length())), None]:
            for number in settings.num_plans:
                planner: Planner = HorizonPlanner(one.prior, longest, number, **how)
                if horizon:
                    more = longest // horizon
                    planner = SamplingPlanner(one.prior, horizon, number * more, any_prefix=True, **how)
                name = f"{horizon} actions" if horizon else CHOSEN
                entry = {"planner": name, "prior": one.label, "context": one.context, "num_plans": number}
                entries.append(entry | planned(starts, planner, contest.generator))
    return run._asdict() | {"about": task.about, "entries": entries}
