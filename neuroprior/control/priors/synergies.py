"""Synergies: vectors lie near a plane of few dimensions."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior.control.priors.linear_gaussian import (
    LinearGaussianPrior,
    WindowMoments,
    held_out_split,
    is_constant,
    moments_or_white,
    rounding,
    window_moments,
)
from neuroprior.control.vector_plans import VectorPlans

RIDGE = 1e-5
"""Added to the variances of the past, as a share of their mean."""


class StepSynergies(LinearGaussianPrior):
    """Synergies: each vector lies near a plane of few dimensions, whose coordinates are an autoregression of order 1.

    The principal components of single vectors are patterns over dimensions at one time (time-invariant synergies).

    Args:
        action_low, action_high: D numbers each: the bounds.
        num_components: patterns, at most D; None: as many as predict held-out plans best.

    Attributes:
        explained: the share of the variance that the first 1, 2, ... principal components explain; empty before `fit`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> movement = torch.linspace(-1, 1, 20)[:, None] * torch.rand(
        ...     8, 1, 3, generator=torch.Generator().manual_seed(0)
        ... )
        >>> prior = StepSynergies([-1.0] * 3, [1.0] * 3, num_components=1).fit(
        ...     VectorPlans(movement, [-1.0] * 3, [1.0] * 3)
        ... )
        >>> prior.sample(2, 10).shape
        torch.Size([1, 2, 10, 3])
    """

    def __init__(self, action_low: Any, action_high: Any, num_components: int | None = None) -> None:
        super().__init__(action_low, action_high)
        if num_components is not None:
            check_sizes(num_components=num_components)
            if num_components > self.action_size:
                raise ValueError(
                    f"`num_components` must be at most {self.action_size}, one a dimension, got {num_components}"
                )
        self.num_components = num_components
        self.explained: tuple[float, ...] = ()

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"num_components": self.num_components}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"explained": list(self.explained)}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        self.explained = tuple(float(share) for share in learned["explained"])

    def learn(self, plans: VectorPlans, generator: torch.Generator) -> None:
        number = self.num_components
        if number is None:
            learning, held_out = held_out_split(plans, generator)
            nats = self.mean_nats_of(range(1, self.action_size + 1), self._moments(learning), held_out)
            number = max(nats, key=nats.__getitem__)
        self.set_window(self._moments(plans)(number))
        values = torch.linalg.eigvalsh(window_moments(self.scaled(plans.windows(1))).covariance).flip(0).clamp(min=0)
        self.explained = tuple((values.cumsum(0) / values.sum()).nan_to_num(1.0).tolist())

    def _moments(self, plans: VectorPlans) -> Callable[[int], WindowMoments]:
        """Makes the Gaussian of two successive vectors of `plans` that lie near a plane of so many dimensions."""
        values, size = self.scaled(plans.actions)[plans.mask()], self.action_size
        covariance = window_moments(values[:, None]).covariance
        components = torch.linalg.eigh(covariance)[1]
        mean, joint, _ = moments_or_white(self.scaled(plans.windows(2)), values, 1)
        varies = ~is_constant(values.double().std(0, correction=0), rounding(self, values.double().mean(0))).repeat(2)
        both: Tensor = varies[:, None] & varies
        eye, two = (torch.eye(n, dtype=torch.double, device=components.device) for n in (size, 2))

        def moments(number: int) -> WindowMoments:
            # The coordinates keep their covariance over time; what is beside the plane is white, and the same in all
            # directions. Constants stay constant.
            vectors = components[:, -number:]
            onto = vectors @ vectors.T
            plane = torch.kron(two, onto)
            level = (covariance.trace() - (onto @ covariance).trace()) / max(size - number, 1)
            noise = torch.kron(two, level * (eye - onto))
            return WindowMoments(mean, (plane @ joint @ plane + noise) * both, RIDGE)

        return moments
