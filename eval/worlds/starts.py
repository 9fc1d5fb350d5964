"""Starts of a world of the suite, and what plans from there are worth on a scale from a reference to the optimum."""

from dataclasses import dataclass

import torch
from torch import Tensor

from eval.worlds.suite import Task, best_score
from neuroprior import TabularWorld, World
from neuroprior.planners import expected_score

DRAWN, AGAIN = 20, 9
"""For each start that is wanted so many are drawn, and, if too few of them are of use, so many times again."""

CLOSE = 1e-6
"""A score this near to the optimum is optimal."""


@dataclass(frozen=True, eq=False)
class Starts:
    """B starts of a world, with the best score that can be reached from each.

    Attributes:
        task: what is optimised.
        world: the held-out world, or the validation world.
        state: `[B, ...]`.
        length: number of actions in a plan.
        best: `[B]`: the optimal scores.
        reference: the score that counts as 0: 0 if rewards are never negative, else the mean score of a single plan of
            random moves.
    """

    task: Task
    world: World
    state: Tensor
    length: int
    best: Tensor
    reference: float

    def normalised(self, score: Tensor) -> float:
        """The normalised score of scores `[B]`: 0 for the reference, 1 for the optimum."""
        gained, most = (values.double() - self.reference for values in (score, self.best))
        return float(gained.mean() / most.mean())

    def reached(self, score: Tensor) -> dict[str, float]:
        """Of scores of decisions, `[B, D]` or `[B]`: the normalised score, the share of optimal ones, and the mean."""
        score = score.double().view(len(self.best), -1)
        optimal = (score >= self.best[:, None] - CLOSE).double().mean()
        return {"share": self.normalised(score.mean(1)), "at_oracle": float(optimal), "score": float(score.mean())}


def starts_of(task: Task, world: World, number: int, length: int, generator: torch.Generator) -> Starts:
    """Random starts; if rewards are never negative, only those with an optimum above 0.

    Raises:
        ValueError: there are hardly any.
    """
    costs = isinstance(world, TabularWorld) and float(world.reward.min()) < 0
    states, bests = [], []
    for _ in range(1 + AGAIN):
        drawn = world.reset(DRAWN * number, generator)
        gain = best_score(task, world, drawn, length)
        useful = (gain > 0) | costs
        states.append(drawn[useful])
        bests.append(gain[useful])
        if sum(map(len, states)) >= number:
            break
    state, best = torch.cat(states), torch.cat(bests)
    if len(state) < number:
        tried = (1 + AGAIN) * DRAWN * number
        raise ValueError(f"only {len(state)} of {tried} starts are such that a plan of {length} actions gains")
    reference = 0.0
    if costs:
        plans = torch.randint(world.num_actions, (len(state), 1, length), generator=generator)
        reference = float(worth(task, world, state, plans).mean())
    return Starts(task, world, state[:number], length, best[:number], reference)


def worth(task: Task, world: World, state: Tensor, plans: Tensor) -> Tensor:
    """The exact mean scores `[B, P]` of plans in a table."""
    assert isinstance(world, TabularWorld)
    return expected_score(world, state, plans, objective=task.objective, discount=task.discount)
