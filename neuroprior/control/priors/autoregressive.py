"""Vector autoregressions: the Markov chains of continuous actions."""

from collections.abc import Callable
from itertools import pairwise, product
from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_memory
from neuroprior._random import draw_seed
from neuroprior.control.priors.linear_gaussian import (
    LinearGaussianPrior,
    WindowMoments,
    held_out_split,
    moments_or_white,
)
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.plans.folds import divisible, folds, num_units, ungrouped

SHARES = (1.0, 0.3, 0.1, 0.0)
"""Shares by which what different dimensions have in common is reduced: with few vectors it is mostly chance. Held-out
likelihood chooses; of equals it takes the first."""

NUM_FOLDS, MAX_VECTORS_IN_FOLDS = 5, 500
"""Parts that are held out in turn, of so many vectors at most: one part alone would say too little."""

ENOUGH_WINDOWS = 20
"""Windows for each number in one from which nothing is reduced."""

RIDGES = (1e-5, 1e-3, 1e-1)
"""Added to the variances of the past, as shares of the mean variance; held-out likelihood chooses."""


class AutoregressivePrior(LinearGaussianPrior):
    """A vector autoregression of order p, by ridge regression over all plans: the Markov chain of this setting.

    Args:
        action_low, action_high: D numbers each: the bounds.
        order: p, vectors that predictions depend on; None: the one of `orders` that predicts held-out plans best (0
            where vectors are as good as independent, or too few follow one another to say). The ridge is always chosen
            so and, with few vectors, how much of the covariances between dimensions is taken over.

    Raises:
        ValueError: an argument is out of range, or (from `fit`) the order is not below the length of the longest plan.

    Example:
        >>> plans = VectorPlans(torch.linspace(-1, 1, 20).expand(8, 20)[..., None], [-1.0], [1.0])
        >>> AutoregressivePrior([-1.0], [1.0], order=1).fit(plans).sample(
        ...     5, 10, generator=torch.Generator().manual_seed(0)
        ... ).shape
        torch.Size([1, 5, 10, 1])
    """

    orders: tuple[int, ...] = (0, 1, 2, 3, 4, 6, 8, 12, 16)
    """Those that `fit` tries."""

    def __init__(self, action_low: Any, action_high: Any, order: int | None = None) -> None:
        super().__init__(action_low, action_high)
        if order is not None:
            check_count("order", order)
            check_memory(8 * ((order + 1) * self.action_size) ** 2, order=order)
        self.order = order

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"order": self.order}

    def learn(self, plans: VectorPlans, generator: torch.Generator) -> None:
        orders = self.orders if self.order is None else (self.order,)
        longest = int(plans.mask().sum(1).max())
        if self.order and self.order >= longest:
            raise ValueError(f"`order` must be below the length of the longest plan, {longest}, got {self.order}")
        parts = self._parts(plans, generator)
        total = sum(int(held_out.mask()[:, skip:].sum()) for _, held_out, skip in parts)
        scores: dict[tuple[int, float, float], float] = {}
        for order in orders:
            numbers = (order + 1) * self.action_size
            fewest = min(int((learning.mask().sum(1) - order).clamp(min=0).sum()) for learning, *_ in parts)
            if order > 1 and scores and fewest <= numbers:
                break
            few = self.action_size > 1 and fewest < ENOUGH_WINDOWS * numbers
            tried = list(product(SHARES if few else SHARES[-1:], RIDGES))
            scores |= {(order, *each): 0.0 for each in tried}
            for learning, held_out, skip in parts:
                weight = int(held_out.mask()[:, skip:].sum()) / total
                mean_nats = self.mean_nats_of(tried, self._moments(learning, order), held_out, skip)
                for each, nats in mean_nats.items():
                    scores[order, *each] += weight * nats
        order, share, ridge = max(scores, key=scores.__getitem__)  # of equals the first
        self.set_window(self._moments(plans, order)((share, ridge)))

    def _moments(self, plans: VectorPlans, order: int) -> Callable[[tuple[float, float]], WindowMoments]:
        """Makes the Gaussian of windows of `plans` for a share of `SHARES` and a ridge."""
        windows, values = self.scaled(plans.windows(order + 1)), self.scaled(plans.actions)[plans.mask()]
        mean, covariance, _ = moments_or_white(windows, values, order)
        return lambda setting: WindowMoments(mean, self._shrink_shared(covariance, setting[0]), setting[1])

    def _parts(self, plans: VectorPlans, generator: torch.Generator) -> list[tuple[VectorPlans, VectorPlans, int]]:
        """Plans to learn from, plans to choose on, and how many vectors of these are only read.

        Of few vectors all are held out once, part by part; where most are in one plan, it is cut into parts, and where
        most are in one group, plans are held out instead of groups.
        """
        plans = divisible(plans[plans.mask().any(1)])
        lengths = plans.mask().sum(1)
        longest, total = int(lengths.max()), int(lengths.sum())
        if plans.group is not None:
            group = plans.group.unique(return_inverse=True)[1]
            if 2 * int(group.bincount(lengths).max()) > total:
                plans = ungrouped(plans)
        if total < 2 or total > MAX_VECTORS_IN_FOLDS:
            return [(*held_out_split(plans, generator), 0)]
        if 2 * longest > total:
            at = [round(longest * k / NUM_FOLDS) for k in range(NUM_FOLDS + 1)]
            return [self._hold_out(ungrouped(plans), *each) for each in pairwise(at) if each[0] < each[1]]
        splits = folds(plans, min(num_units(plans), NUM_FOLDS), draw_seed(generator))
        return [(plans[learned], plans[left_out], 0) for learned, left_out in splits]

    def _hold_out(self, plans: VectorPlans, first: int, end: int) -> tuple[VectorPlans, VectorPlans, int]:
        """The plans without a part of the longest, this part behind the vectors before it, and how many these are."""
        lengths = plans.mask().sum(1)
        row, longest = int(lengths.argmax()), int(lengths.max())
        behind = plans.actions[row : row + 1].roll(-end, 1)
        lengths[row] = first
        both = torch.cat([lengths, lengths.new_tensor([longest - end])])
        learning = VectorPlans(torch.cat([plans.actions, behind]), plans.action_low, plans.action_high, both)
        num_before = min(first, max(self.orders) if self.order is None else self.order)
        return learning[both > 0], plans[row : row + 1].steps(first - num_before, end), num_before

    def _shrink_shared(self, covariance: Tensor, share: float) -> Tensor:
        """The covariance of windows with that share of what different dimensions have in common taken away."""
        dimension = torch.arange(len(covariance), device=covariance.device) % self.action_size
        return torch.where(dimension[:, None] == dimension, covariance, (1 - share) * covariance)
