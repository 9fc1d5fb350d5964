"""Noise as a prior over vectors: white, or coloured as planners draw it."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_count
from neuroprior.control.priors.linear_gaussian import (
    LinearGaussianPrior,
    WindowMoments,
    is_constant,
    rounding,
    window_moments,
)
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.control.worlds.continuous_world import check_positive


class NoisePrior(LinearGaussianPrior):
    """Coloured noise: each dimension is an independent Gaussian process with power 1 / f ** exponent.

    With exponent 0 this is white noise, with 2 about a random walk; planners such as iCEM draw their candidates so
    (Pinneri et al., 2020). Given vectors before, the noise goes on from them. The process is periodic in 2 (`memory` +
    1) steps, and its slowest part has that period.

    Args:
        action_low, action_high: D numbers each: the bounds.
        exponent: of the spectrum, from 0; None: the one with the highest likelihood in `fit`.
        scale: standard deviation, in units of half the range; None: each dimension's own in `fit` (1 before that).
        memory: vectors that predictions depend on.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> noise = NoisePrior([-1.0], [1.0], exponent=2.0, scale=0.3)
        >>> noise.sample(4, 20, generator=torch.Generator().manual_seed(0)).shape
        torch.Size([1, 4, 20, 1])
    """

    exponents = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
    """Those that `fit` tries; the first is white noise."""

    def __init__(
        self,
        action_low: Any,
        action_high: Any,
        exponent: float | None = 0.0,
        scale: float | None = None,
        memory: int = 30,
    ) -> None:
        super().__init__(action_low, action_high)
        check_count("memory", memory)
        if exponent is not None:
            check_positive(zero=True, exponent=exponent)
        if scale is not None:
            check_positive(scale=scale)
        self._arguments = {"exponent": exponent, "scale": scale, "memory": memory}
        self.exponent = exponent or 0.0
        start = torch.zeros(self.action_size), torch.full((self.action_size,), scale or 1.0)
        self.set_window(self._moments(*start, self.exponent))

    @property
    def config(self) -> dict[str, Any]:
        return super().config | self._arguments

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"exponent": self.exponent}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        self.exponent = float(learned["exponent"])

    def _moments(self, mean: Tensor, scale: Tensor, exponent: float) -> WindowMoments:
        memory = int(self._arguments["memory"] or 0) if exponent else 0
        lags = torch.arange(memory + 1, dtype=torch.double, device=mean.device)
        frequency = (lags + 1) / (2 * (memory + 1))
        power = frequency**-exponent
        shape = (power[:, None] * torch.cos(2 * torch.pi * frequency[:, None] * lags)).sum(0) / power.sum()
        toeplitz = shape[(lags[:, None] - lags).abs().long()] if exponent else torch.ones_like(lags)[:, None]
        return WindowMoments(mean.double().repeat(memory + 1), scale.double().square()[:, None, None] * toeplitz)

    def learn(self, plans: VectorPlans, generator: torch.Generator) -> None:
        values = self.scaled(plans.actions)[plans.mask()]
        mean, covariance, _ = window_moments(values[:, None])
        std = covariance.diagonal().sqrt()
        # A constant has the least standard deviation of predictions.
        std = std.masked_fill(is_constant(std, rounding(self, mean)), 0)
        if self._arguments["scale"] is not None:
            mean, std = torch.zeros_like(mean), torch.full_like(std, self._arguments["scale"])
        moments = partial(self._moments, mean, std)
        if self._arguments["exponent"] is None:
            # Windows of `memory` + 1 vectors for coloured noise, of 1 for white.
            white, coloured = self.exponents[:1], self.exponents[1:]
            nats = self.mean_nats_of(white, moments, plans) | self.mean_nats_of(coloured, moments, plans)
            self.exponent = max(nats, key=nats.__getitem__)
        self.set_window(moments(self.exponent))
