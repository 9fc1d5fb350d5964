"""One cell of `python -m eval compare --planners`: several planners with the same priors and as many model steps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from eval.compare.curves import ROLLOUTS, TEMPERATURES, Starts, worth
from eval.compare.run import Contest, Contestant
from eval.compare.settings import Settings
from eval.worlds.suite import TASKS, Task
from neuroprior import FrontierPlanner, MCTSPlanner, Planner, Prior, SamplingPlanner, World, execute
from neuroprior.planners import CrossEntropyPlanner, DistinctPlanner

ORDERS = (3,)
"""Of the Markov priors that planners are compared with."""

CHANCE, ONLY_CHANCE = {"sampling", "cross-entropy", "halving", "replanning"}, {"halving", "replanning"}
"""Planners for worlds with chance, and those that are nothing new in worlds without."""

COURSES = 8
"""From each start, in which a closed loop is followed: what it is worth cannot be computed."""


@dataclass(frozen=True)
class PlannerSettings(Settings):
    """All that decides the results of a cell, beside its world and seed; `sees`: one, or none for the last of a world.

    Attributes:
        planners: some of `PLANNERS`.
    """

    planners: tuple[str, ...] = ()


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


def run_planners(task: Task, seed: int, settings: PlannerSettings) -> dict[str, Any]:
    """Collect, fit, grow, and plan with each planner and prior in the worlds of one seed.

    Args, raises: see `eval.compare.run.run_cell`.

    Returns:
        `entries`, each of a planner and prior: by number of plans the `share` of the oracle, the `model_steps` that
        were taken, and the `seconds` of a decision.
    """
    begin = perf_counter()
    contest = Contest(task, seed, replace(settings, sees=settings.sees or task.sights[-1:]), ORDERS)
    entries = []
    for one in contest.grown():
        for name in settings.planners:
            if suits(name, contest.worlds.held_out):
                entries.append(_entry(contest, one, name))
    cell: dict[str, Any] = {"world": task.name, "seed": seed, "about": task.about, "num_plans": settings.num_plans}
    return cell | {"entries": entries, "seconds": perf_counter() - begin}


def _entry(contest: Contest, one: Contestant, name: str) -> dict[str, Any]:
    """What a planner with a prior reaches; the temperature is chosen for both, in the validation worlds."""
    length, generator = contest.task.length, contest.generator
    heat = 1.0
    if one.label != "uniform":
        chosen_at, most = contest.chosen_at[length], max(contest.settings.num_plans)
        shares = {t: _planned(chosen_at, name, one.prior, most, t, generator)["share"] for t in TEMPERATURES}
        heat = max(shares, key=lambda t: shares[t])
    found = [
        _planned(contest.starts, name, one.prior, number, heat, generator) for number in contest.settings.num_plans
    ]
    return entry_of(name, one, heat, found)


def entry_of(name: str, one: Contestant, temperature: float, found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What is kept of a planner and prior: what `planned` told with each number of plans."""
    entry = {"planner": name, "prior": one.label, "sees": one.sees, "rounds": one.rounds, "temperature": temperature}
    return entry | {what: [some[what] for some in found] for what in ("share", "model_steps", "seconds")}


def _planned(
    starts: Starts, name: str, prior: Prior, num_plans: int, temperature: float, generator: torch.Generator
) -> dict[str, Any]:
    """What a planner of this name reaches, see `planned`."""
    how: dict[str, Any] = starts.task.scoring | {"temperature": temperature}
    if starts.world.stochastic:
        how["num_rollouts"] = ROLLOUTS
    if name == "replanning":
        # All decisions together take no more steps than one of the others, but for at least one plan each.
        number = max(num_plans // starts.length, 1)
        return replanned(starts, PLANNERS[name](prior, starts.length, number, **how), generator)
    return planned(starts, PLANNERS[name](prior, starts.length, num_plans, **how), generator)


def replanned(starts: Starts, planner: Planner, generator: torch.Generator) -> dict[str, Any]:
    """What `planned` tells, of as many actions as a plan has, each the first of a new plan; the mean of `COURSES`."""
    begin = perf_counter()
    state = starts.state.repeat_interleave(COURSES, 0)
    done = execute(planner, starts.world, state, starts.length, 1, generator)
    seconds = (perf_counter() - begin) / len(state)
    score = planner.score(done.rewards.double(), done.states[:, -1]).view(-1, COURSES).mean(1)
    return {"share": starts.share(score), "model_steps": done.model_steps, "seconds": seconds}


def planned(starts: Starts, planner: Planner, generator: torch.Generator) -> dict[str, Any]:
    """The share of the oracle that a planner's decisions reach, their model steps and seconds, for each start."""
    begin = perf_counter()
    decision = planner.plan(starts.world, starts.state, generator)
    seconds = (perf_counter() - begin) / len(starts.state)
    score: Tensor = decision.score
    if starts.world.stochastic:
        score = worth(starts.task, starts.world, starts.state, decision.plan[:, None].long())[:, 0]
    return {"share": starts.share(score), "model_steps": decision.model_steps, "seconds": seconds}


def check_planners(planners: Sequence[str], worlds: Sequence[str]) -> None:
    """Raise ValueError where there is no planner, or none that suits one of the worlds."""
    if not planners:
        raise ValueError("planners: at least one is expected")
    for world in worlds:
        if set(planners) & CHANCE and set(planners) - ONLY_CHANCE:
            continue  # something for worlds with chance, and for those without: some worlds take long to make
        if not any(suits(name, TASKS[world].worlds(0).held_out) for name in planners):
            raise ValueError(f"planners: none of {' '.join(planners)} is for {world}; leave it out, or add sampling")


def suits(name: str, world: World) -> bool:
    """Whether a planner can plan in a world, and is not there what another one is, too."""
    return name in CHANCE if world.stochastic else name not in ONLY_CHANCE
