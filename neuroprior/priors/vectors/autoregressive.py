"""Vector autoregressions: the Markov chains of continuous actions."""

from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_count
from neuroprior.plans.vector_plans import VectorPlans
from neuroprior.priors.vectors.linear_gaussian import (
    LinearGaussianPrior,
    best_of,
    held_out_split,
    mean_nats,
    moments_or_white,
)

RIDGES = (1e-5, 1e-3, 1e-1)
"""Added to the variances of the past, as shares of the mean variance; held-out likelihood chooses."""


class AutoregressivePrior(LinearGaussianPrior):
    """A vector autoregression of order p, by ridge regression over all plans: the Markov chain of this setting.

    Args:
        action_low, action_high: D numbers each: the bounds.
        order: p, vectors that predictions depend on; None: the one of `orders` that predicts held-out plans best. The
            ridge is always chosen so. Where there are no more windows of p + 1 vectors than numbers in one, white
            noise makes up for those that are missing.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> plans = VectorPlans(torch.linspace(-1, 1, 20).expand(8, 20)[..., None], [-1.0], [1.0])
        >>> AutoregressivePrior([-1.0], [1.0], order=1).fit(plans).sample(
        ...     5, 10, generator=torch.Generator().manual_seed(0)
        ... ).shape
        torch.Size([1, 5, 10, 1])
    """

    orders: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12, 16)
    """Those that `fit` tries."""

    def __init__(self, action_low: Any, action_high: Any, order: int | None = None) -> None:
        super().__init__(action_low, action_high)
        if order is not None:
            check_count("order", order)
        self.order = order

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"order": self.order}

    def learn(self, plans: VectorPlans, generator: torch.Generator) -> None:
        orders = self.orders if self.order is None else (self.order,)
        learning, held_out = held_out_split(plans, generator)
        scores: dict[tuple[int, float], float] = {}
        for order in orders:
            windows = self.scaled(learning.windows(order + 1))
            if scores and len(windows) <= (order + 1) * self.action_size:
                break
            moments = _moments(windows, self.scaled(learning.actions)[learning.mask()], order)
            for ridge in RIDGES:
                self.set_window(*moments, ridge)
                scores[order, ridge] = mean_nats(self, held_out)
        order, ridge = best_of(scores)
        windows = self.scaled(plans.windows(order + 1))
        self.set_window(*_moments(windows, self.scaled(plans.actions)[plans.mask()], order), ridge)


def _moments(windows: Tensor, values: Tensor, order: int) -> tuple[Tensor, Tensor]:
    """Mean and covariance of windows `[M, order + 1, D]`, from at least as many as have a covariance of full rank.

    Those that are missing are made up for by white noise that spreads as each dimension of `values [S, D]` does:
    without it, what a few windows do not show would be taken for impossible.
    """
    mean, covariance = moments_or_white(windows, values, order)
    missing = windows.shape[1] * windows.shape[2] + 1 - len(windows)
    if missing <= 0:
        return mean, covariance
    white, variances = (each.repeat(order + 1) for each in (values.double().mean(0), values.double().var(0, False)))
    share, apart = missing / (missing + len(windows)), white - mean
    mixed = torch.lerp(covariance, variances.diag(), share) + share * (1 - share) * apart.outer(apart)
    return torch.lerp(mean, white, share), mixed
