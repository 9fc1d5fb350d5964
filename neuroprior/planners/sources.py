"""Several sources of candidates: which share of them each prior draws follows how often it had the best one."""

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from neuroprior.priors.uniform import UniformPrior
from neuroprior.sampling.stepping import Steppable, Stepper
from neuroprior.worlds.world import World

MIN_SHARE = 0.05
"""Each source draws at least this share of the candidates, or half of an equal share where that is less."""

LAST_CALL_WEIGHT = 0.3
"""The weight of the last call of `plan` in the shares of the next one; those before count less and less."""


class Sources:
    """K priors that draw a planner's candidates together, a uniform one always among them.

    In each world they begin with equal shares. After each call the share of a source moves towards the share of
    decisions in which the best candidate was its own. One that is better grows to all but the floors. Where the world
    changes, what then finds the best candidates grows again.
    Where all candidates are equally good, shares become equal.

    Args:
        priors: of the same number of actions. A uniform prior is added where there is none.

    Attributes:
        priors: the K priors.

    Raises:
        ValueError: there is none, one is no prior, or they differ in their number of actions.

    Example:
        >>> sources, world = Sources([MarkovPrior(4, 1)]), gridworld(5, 5, seed=0)
        >>> sources.counts(world, 16)
        [8, 8]
        >>> sources.learn(world, torch.tensor([3.0, 0.0]))
        >>> sources.counts(world, 16)
        [10, 6]
    """

    def __init__(self, priors: Sequence[Steppable]) -> None:
        if not priors:
            raise ValueError("`prior` must be a prior, or one or more of them, got none")
        for prior in priors:
            if not isinstance(prior, Steppable):
                raise ValueError(f"`prior` must be priors with num_actions, start and step, got {type(prior).__name__}")
        sizes = sorted({prior.num_actions for prior in priors})
        if len(sizes) > 1:
            raise ValueError(f"`prior` must be priors of the same number of actions, got {sizes}")
        uniform = [] if any(isinstance(prior, UniformPrior) for prior in priors) else [UniformPrior(sizes[0])]
        if uniform:
            uniform[0].to(Stepper(priors[0]).device)
        self.priors = [*priors, *uniform]
        self._shares: WeakKeyDictionary[World, Tensor] = WeakKeyDictionary()

    def shares(self, world: World) -> Tensor:
        """The present shares in a world: float64 `[K]`, which sum to 1."""
        number = len(self.priors)
        return self._shares.get(world, torch.full((number,), 1 / number, dtype=torch.float64))

    def counts(self, world: World, num_plans: int) -> list[int]:
        """How many of so many candidates each source draws, at least one.

        Raises:
            ValueError: there are fewer candidates than sources.
        """
        number = len(self.priors)
        if num_plans < number:
            raise ValueError(f"`num_plans` must be at least {number}, one for each source, got {num_plans}")
        due = 1 + self.shares(world) * (num_plans - number)
        counts = due.floor().long()
        # What is left by rounding goes to the largest remainders.
        left = num_plans - int(counts.sum())
        counts[(due - counts).argsort(descending=True, stable=True)[:left]] += 1
        return [int(count) for count in counts]

    def learn(self, world: World, wins: Tensor) -> None:
        """Take note of the decisions in which each source had the best candidate.

        Args:
            world: in which they were made.
            wins: `[K]`; where several sources had equally good ones, each has its part.
        """
        total = float(wins.sum())
        if total == 0:
            return
        floor = min(MIN_SHARE, 0.5 / len(self.priors))
        after = (1 - LAST_CALL_WEIGHT) * self.shares(world) + LAST_CALL_WEIGHT * wins.double().cpu() / total
        after = after.clamp(min=floor)
        spare = after - floor
        self._shares[world] = floor + spare / spare.sum() * (1 - len(self.priors) * floor)
