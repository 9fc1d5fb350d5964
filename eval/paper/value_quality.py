"""How the gain of the priors depends on how wrong the values are: every way to be wrong that the paper names."""

from dataclasses import replace
from typing import Any

import pandas as pd
import torch
from scipy.stats import spearmanr
from torch import Tensor

from eval.paper.planners import Finished, PaperSettings, make_planners, over_groups
from eval.paper.second_simulation import ceiling, empty_world, learned_values, objective, pursue, random_starts
from eval.paper.values import network_approximation, tile_approximation
from neuroprior import Prior
from neuroprior.planners import value_iteration

STARTS = 600
"""Starts for each level, at the most."""

AGENTS = 20
"""Value functions of each kind and level that is random; they share the starts."""


def families(settings: PaperSettings, generator: torch.Generator) -> dict[str, dict[str, Tensor]]:
    """Value functions `[V, S]` of each kind, from what should be worse to better: kind -> level -> values."""
    world = empty_world(settings, 1)
    exact = value_iteration(world, goal=settings.goal)
    places = world.coordinates(torch.arange(world.num_states)).double()

    def learned(steps: int) -> Tensor:
        return learned_values(replace(settings, q_steps=steps), AGENTS, generator)

    def network(steps: int) -> Tensor:
        return network_approximation(exact.expand(AGENTS, -1), places, steps=steps, generator=generator)

    def moved(distance: int) -> Tensor:
        old = (places[:, 0] == settings.size // 2) & (places[:, 1] == settings.size // 2 - distance)
        return value_iteration(world, goal=int(old.nonzero()[0]))

    half = settings.size // 2
    distances = sorted({half, half * 3 // 4, half // 2, 1} - {0}, reverse=True)
    q_steps = [max(round(settings.q_steps * share), 1) for share in (0.1, 0.3, 1, 3)]
    return {
        "Q-learning": {f"{steps:,}": learned(steps) for steps in q_steps},
        "sweeps": {f"{sweeps}": value_iteration(world, goal=settings.goal, sweeps=sweeps) for sweeps in (2, 5, 8, 12)},
        "tiles": {f"{side}": tile_approximation(exact, places, side).round(decimals=9) for side in (10, 7, 5, 3)},
        "network": {f"{steps}": network(steps) for steps in (2, 3, 5, 10)},
        "moved goal": {f"{distance}": moved(distance) for distance in distances},
    }


def measure(settings: PaperSettings, priors: dict[str, Prior], finished: Finished) -> pd.DataFrame:
    """Success of each planner under each value function, and how good the value functions are.

    Intervals are over value functions, or over starts where there is but one. `finished` is called for each of five
    kinds. The GRU stands for networks: a transformer takes five times as long.
    """
    priors = {name: prior for name, prior in priors.items() if name != "transformer"}
    # Not the learners of the table over again.
    generator = torch.Generator().manual_seed(settings.seed + 1)
    exact = value_iteration(empty_world(settings, 1), goal=settings.goal)[0]
    rows = []
    for kind, levels in families(settings, generator).items():
        for level, values in levels.items():
            number = -(-min(settings.starts, STARTS) // len(values))
            world = empty_world(settings, len(values))
            # The same starting cells for every level, so that levels differ by their values alone.
            states = random_starts(settings, len(values), number, torch.Generator().manual_seed(settings.seed))
            row: dict[str, Any] = {"kind": kind, "level": level, "quality": quality(values, exact, settings.goal)}
            for name, planner in make_planners(priors, settings, objective(values, settings.goal)).items():
                done = pursue(planner, world, states.flatten(), settings.goal, settings.max_plans, generator)
                share = over_groups(done.reached.view(states.shape))
                row |= {name: share.mean, f"{name} low": share.low, f"{name} high": share.high}
            rows.append(row | {"ceiling": float(ceiling(world, states, settings).double().mean())})
        finished(f"values: {kind}")
    return pd.DataFrame(rows)


def quality(values: Tensor, exact: Tensor, goal: int) -> float:
    """The mean rank correlation (Spearman) of value functions `[V, S]` with the true one `[S]`, the goal left out.

    A planner compares values, so that their order is all that matters. Values that are all equal count as 0.
    """
    other = torch.arange(len(exact)) != goal
    return sum(
        0.0 if float(estimate[other].std()) < 1e-9 else float(spearmanr(estimate[other], exact[other]).statistic)
        for estimate in values
    ) / len(values)
