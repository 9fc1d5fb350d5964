"""Synergies: vectors lie near a plane of few dimensions."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

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
    """

    def __init__(self, action_low: Any, action_high: Any, num_components: int | None = None) -> None:
        super().__init__(action_low, action_high)
        self.num_components = num_components

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"num_components": self.num_components}

    def learn(self, plans: VectorPlans, generator: torch.Generator) -> None:
        number = self.num_components
        if number is None:
            learning, held_out = held_out_split(plans, generator)
            nats = self.mean_nats_of(range(1, self.action_size + 1), self._moments(learning), held_out)
            number = max(nats, key=nats.__getitem__)
        self.set_window(self._moments(plans)(number))

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
