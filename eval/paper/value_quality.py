"""How the gain of the priors depends on how wrong the values are: every way to be wrong that the paper names."""

from typing import Any

import torch
from scipy.stats import spearmanr
from torch import Tensor

from eval.paper.first_simulation import Report, over_groups
from eval.paper.second_simulation import Task, ceiling, empty_world, objective, planners_for, pursue, random_starts
from neuroprior import Prior
from neuroprior.values import network_approximation, q_learning, tile_approximation, value_iteration

STARTS = 600
"""Starts for each level, at the most."""

AGENTS = 20
"""Value functions of each kind and level that has any chance in it; they share the starts."""


def families(task: Task, generator: torch.Generator) -> dict[str, dict[str, Tensor]]:
    """Value functions `[V, S]` of each kind, from what should be worse to better: kind -> level -> values."""
    world = empty_world(task, 1)
    exact = value_iteration(world, goal=task.goal)
    places = world.coordinates(torch.arange(world.num_states)).double()

    def learned(steps: int) -> Tensor:
        return q_learning(
            world,
            task.goal,
            num_agents=AGENTS,
            steps=steps,
            initial_scale=task.initial_scale,
            generator=generator,
        ).amax(-1)

    def network(steps: int) -> Tensor:
        return network_approximation(exact.expand(AGENTS, -1), places, steps=steps, generator=generator)

    def moved(distance: int) -> Tensor:
        old = (places[:, 0] == task.size // 2) & (places[:, 1] == task.size // 2 - distance)
        return value_iteration(world, goal=int(old.nonzero()[0]))

    half = task.size // 2
    distances = sorted({half, half * 3 // 4, half // 2, 1} - {0}, reverse=True)
    q_steps = [max(round(task.q_steps * share), 1) for share in (0.1, 0.3, 1, 3)]
    return {
        "Q-learning": {f"{steps:,}": learned(steps) for steps in q_steps},
        "sweeps": {f"{sweeps}": value_iteration(world, goal=task.goal, sweeps=sweeps) for sweeps in (2, 5, 8, 12)},
        "tiles": {f"{side}": tile_approximation(exact, places, side).round(decimals=9) for side in (10, 7, 5, 3)},
        "network": {f"{steps}": network(steps) for steps in (2, 3, 5, 10)},
        "moved goal": {f"{distance}": moved(distance) for distance in distances},
    }


def measure(task: Task, priors: dict[str, Prior], report: Report) -> list[dict[str, Any]]:
    """Success of each planner under each value function, and how good the value functions are.

    Quality is the rank correlation (Spearman) between the approximate and the true values of all cells but the goal:
    what a planner that compares values can see of them. Intervals are over value functions, or over starts where there
    is but one.
    """
    # Not the learners of the table over again.
    generator = torch.Generator().manual_seed(task.seed + 1)
    exact = value_iteration(empty_world(task, 1), goal=task.goal)[0]
    other = torch.arange(len(exact)) != task.goal
    rows = []
    for kind, levels in families(task, generator).items():
        report(f"values: {kind}")
        for level, values in levels.items():
            quality = sum(_rank_correlation(v[other], exact[other]) for v in values) / len(values)
            number = -(-min(task.starts, STARTS) // len(values))
            world = empty_world(task, len(values))
            # The same starting cells for every level, so that levels differ by their values alone.
            states = random_starts(task, len(values), number, torch.Generator().manual_seed(task.seed))
            row: dict[str, Any] = {"kind": kind, "level": level, "quality": quality}
            for name, planner in planners_for(priors, task, objective(values, task.goal)).items():
                done = pursue(planner, world, states.flatten(), task.goal, task.max_plans, generator)
                share = over_groups(done.reached.view(states.shape))
                row |= {name: share.mean, f"{name} low": share.low, f"{name} high": share.high}
            rows.append(row | {"ceiling": float(ceiling(world, states, task).double().mean())})
    return rows


def _rank_correlation(first: Tensor, second: Tensor) -> float:
    # Values that are all the same order nothing: a correlation of 0.
    return 0.0 if float(first.std()) < 1e-9 else float(spearmanr(first, second).statistic)
