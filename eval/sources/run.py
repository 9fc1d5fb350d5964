"""One run of `python -m eval sources`: decisions with each source of candidates alone, and with all together."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from eval.worlds.runs import Run
from neuroprior._random import draw_seed
from neuroprior.comparison import trial
from neuroprior.comparison.contestants import fit_prior
from neuroprior.planners import SamplingPlanner
from neuroprior.priors import UniformPrior
from neuroprior.sampling import Steppable
from neuroprior.worlds import cube, four_rooms, from_gymnasium, gridworld, maze

SOURCES = ("uniform", "markov", "gru", "combined")
"""Of candidates, each alone; together they are "shared"."""

PARTS = ("all calls", "second half of the calls")

STARTS_PER_PLAN = 4
"""Plans are collected from so many times as many starts, since only those better than random are learned from."""

gymnasium = partial(from_gymnasium, progress=False)
WORLDS = {
    "grid": (lambda seed: gridworld(20, 20, "torus", num_worlds=20, seed=seed), 10),
    "four_rooms": (lambda seed: four_rooms(num_layouts=3, seed=seed), 10),
    "maze": (lambda seed: maze(13, 13, num_layouts=3, seed=seed), 10),
    "cube": (lambda seed: cube(scramble=6, reward="distance"), 6),
    "taxi": (lambda seed: gymnasium("Taxi-v4"), 10),
    "cliff": (lambda seed: gymnasium("CliffWalking-v1", starts="any"), 10),
    "frozen_lake": (lambda seed: gymnasium("FrozenLake-v1", is_slippery=False, starts="any"), 8),
    "slippery": (lambda seed: gymnasium("FrozenLake-v1", is_slippery=True, starts="any"), 8),
    "door_key": (lambda seed: gymnasium("MiniGrid-DoorKey-5x5-v0", seeds=range(8), starts="any"), 12),
    "key_corridor": (lambda seed: gymnasium("MiniGrid-KeyCorridorS3R1-v0", seeds=range(4), starts="any"), 12),
    "cart_pole": (lambda seed: gymnasium("CartPole-v1", seeds=range(40)), 12),
}
"""By name: a function of a seed that makes the world, and the actions in a plan."""


@dataclass(frozen=True)
class SourceSettings:
    """All that decides the results of a run, beside its world and seed; see `eval.sources.command.sources`."""

    plans: tuple[int, ...]
    calls: int
    starts: int
    num_plans: int
    seed: int


def run_sources(run: Run, settings: SourceSettings) -> dict[str, Any]:
    """Fit priors to plans of one world, then decide with each source alone and with all.

    Where fewer plans are asked for, they are the first of the others.

    Returns:
        `entries`, one of each number of `plans` and `part` of the calls: how many were `learned` from, and normalised
        scores by source; `note`: why there are none, or "".
    """
    make, length = WORLDS[run.world]
    world = make(settings.seed * 10_000 + run.seed)
    generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + run.seed)
    numbers = settings.starts * settings.calls, STARTS_PER_PLAN * max(settings.plans)
    design = trial.Design(world, None, {}, {}, (settings.num_plans,), length, *numbers, training_budget=256)
    training, state, _ = trial.draw_starts(design, generator)
    collected = trial.training_plans(design, training, generator)
    if collected is None:
        return run._asdict() | {"entries": [], "note": "too few plans were better than random ones"}
    plan_seed, score_seed = draw_seed(generator), draw_seed(generator)

    def scores_with(prior: Steppable | Sequence[Steppable]) -> Tensor:
        planner = SamplingPlanner(prior, length, settings.num_plans, num_rollouts=8 if world.stochastic else None)
        drawn = torch.Generator().manual_seed(plan_seed)
        plans = torch.cat([planner.plan(world, batch, drawn).plan for batch in state.split(settings.starts)])
        return trial.true_scores(world, state, plans[:, None], score_seed)[:, 0]

    random = trial.random_scores(world, state, length, trial.RANDOM_PLANS, generator, score_seed)
    uniform, best = scores_with(UniformPrior(world.num_actions)), trial.optimum(world, state, length)
    entries = []
    for asked in settings.plans:
        plans = collected[:asked]
        learned = ("combined", "gru", "markov")
        priors = {name: fit_prior(name, plans, world.num_actions, generator) for name in learned}
        scores = {"uniform": uniform} | {name: scores_with(prior) for name, prior in priors.items()}
        scores["shared"] = scores_with(list(priors.values()))
        highest = torch.stack(list(scores.values())).amax(0) if best is None else best.double()
        for calls, first in zip(PARTS, (0, settings.starts * (settings.calls // 2)), strict=True):
            room = float((highest - random)[first:].sum())
            if room <= 0:
                return run._asdict() | {"entries": [], "note": "no plan is better than random ones"}
            shares = {name: float((score - random)[first:].sum()) / room for name, score in scores.items()}
            entries.append({"plans": asked, "learned": len(plans), "part": calls, **shares})
    return run._asdict() | {"entries": entries, "note": ""}
