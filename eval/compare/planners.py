"""`python -m eval compare --planners`: several planners with the same priors and as many model steps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, TypeAlias

import torch

from eval.compare.curves import ROLLOUTS, TEMPERATURES, Starts, worth
from eval.compare.planner_report import planner_document
from eval.compare.run import Contest, Contestant, Settings
from eval.worlds import runs
from eval.worlds.suite import TASKS
from neuroprior.planners import (
    CrossEntropyPlanner,
    DistinctPlanner,
    FrontierPlanner,
    MCTSPlanner,
    Planner,
    SamplingPlanner,
    execute,
)
from neuroprior.report.document import publish
from neuroprior.worlds import World

ORDERS = (3,)
"""Orders of the Markov priors that planners are compared with."""

PLANNERS: dict[str, Callable[..., Planner]] = {
    "sampling": SamplingPlanner,
    "distinct": DistinctPlanner,
    "frontier": FrontierPlanner,
    "mcts": MCTSPlanner,
    "cross-entropy": CrossEntropyPlanner,
    "halving": partial(SamplingPlanner, halving=True),
    "replanning": partial(SamplingPlanner, halving=True),
}
"""By their names in tables; "replanning" is halving in a closed loop, planning anew after each action."""

PlannerName: TypeAlias = Literal[tuple(PLANNERS)]  # type: ignore[valid-type]

STOCHASTIC, ONLY_STOCHASTIC = {"sampling", "cross-entropy", "halving", "replanning"}, {"halving", "replanning"}
"""Planners for stochastic worlds, and those that plan like another one in deterministic worlds."""

TRAJECTORIES = 8
"""From each start with "replanning", whose score is no single plan's and so cannot be computed."""


@dataclass(frozen=True)
class PlannerSettings(Settings):
    """As `Settings`, with some of `PLANNERS`; no `context`: the last of each world's."""

    planners: tuple[str, ...] = ()


def compare_planners(
    settings: PlannerSettings,
    worlds: Sequence[str],
    seeds: int,
    out: str,
    processes: int | None = None,
    dask: str | None = None,
) -> None:
    """Compare planners and publish the report; see `eval.compare.command.compare`.

    Raises:
        ValueError: a planner is given twice, or no planner suits one of the worlds.
    """
    runs.check_distinct(planners=settings.planners)
    given = set(settings.planners)
    for world in worlds:
        if given & STOCHASTIC and given - ONLY_STOCHASTIC:
            continue  # whatever the world is: some take long to make
        held_out = TASKS[world].worlds(0).held_out
        if not any(suits(name, held_out) for name in settings.planners):
            names = " ".join(settings.planners)
            raise ValueError(f"planners: none of {names} is for {world}; leave it out, or add sampling")
    found = runs.finished("compare --planners", planner_run, settings, worlds, seeds, out, processes, dask)
    publish(planner_document(*found, runs.command_line("compare")), Path(out))


def planner_run(run: runs.Run, settings: PlannerSettings) -> dict[str, Any]:
    """Collect plans, fit priors, extend their horizons, and plan with each planner and prior, in one seed's worlds.

    Returns:
        `entries`, one of each planner, prior and number of plans: `share` (the normalised score), the `model_steps`
        that were taken, and the `seconds` of a decision.

    Raises:
        ValueError: see `eval.compare.run.compare_priors`.
    """
    task = TASKS[run.world]
    contest = Contest(task, run.seed, replace(settings, context=settings.context or task.contexts[-1:]), ORDERS)
    entries = []
    for one in contest.after_curriculum():
        for name in settings.planners:
            if suits(name, contest.worlds.held_out):
                entries += _entries(contest, one, name)
    return {"world": run.world, "seed": run.seed, "about": task.about, "entries": entries}


def suits(name: str, world: World) -> bool:
    """Whether a planner can plan in a world, and is not there what another one is, too."""
    return name in STOCHASTIC if world.stochastic else name not in ONLY_STOCHASTIC


def _entries(contest: Contest, one: Contestant, name: str) -> list[dict[str, Any]]:
    """What a planner reaches with a prior; the temperature is chosen for both, in the validation worlds."""
    length, generator = contest.task.length, contest.generator

    def reached(starts: Starts, number: int, temperature: float) -> dict[str, Any]:
        how: dict[str, Any] = starts.task.scoring | {"temperature": temperature}
        if starts.world.stochastic:
            how["num_rollouts"] = ROLLOUTS
        if name != "replanning":
            return planned(starts, PLANNERS[name](one.prior, starts.length, number, **how), generator)
        # All decisions together take no more steps than one of the others, but for at least one plan each.
        planner = PLANNERS[name](one.prior, starts.length, max(number // starts.length, 1), **how)
        return replanned(starts, planner, generator)

    best = 1.0
    if one.label != "uniform":
        most = max(contest.settings.num_plans)
        shares = {t: reached(contest.validation_at[length], most, t)["share"] for t in TEMPERATURES}
        best = max(shares, key=lambda t: shares[t])
    label = {"planner": name, "prior": one.label, "sees": one.sees, "temperature": best}
    return [
        label | {"num_plans": number} | reached(contest.starts, number, best) for number in contest.settings.num_plans
    ]


def planned(starts: Starts, planner: Planner, generator: torch.Generator) -> dict[str, Any]:
    """The normalised score of a planner's decisions, and their model steps and seconds for each start."""
    begin = perf_counter()
    decision = planner.plan(starts.world, starts.state, generator)
    seconds = (perf_counter() - begin) / len(starts.state)
    score = decision.score
    if starts.world.stochastic:
        score = worth(starts.task, starts.world, starts.state, decision.plan[:, None].long())[:, 0]
    return {"share": starts.normalised(score), "model_steps": decision.model_steps, "seconds": seconds}


def replanned(starts: Starts, planner: Planner, generator: torch.Generator) -> dict[str, Any]:
    """As `planned`, of as many actions as a plan has, each the first of a new plan; the mean of `TRAJECTORIES`."""
    begin = perf_counter()
    state = starts.state.repeat_interleave(TRAJECTORIES, 0)
    done = execute(planner, starts.world, state, starts.length, 1, generator)
    seconds = (perf_counter() - begin) / len(state)
    score = planner.score(done.rewards.double(), done.states[:, -1]).view(-1, TRAJECTORIES).mean(1)
    return {"share": starts.normalised(score), "model_steps": done.model_steps, "seconds": seconds}
