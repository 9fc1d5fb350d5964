"""Synergies: actions lie near a plane of few dimensions, of windows over time or of single vectors."""

from collections.abc import Callable
from itertools import product
from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior.control.priors.linear_gaussian import (
    LinearGaussianPrior,
    WindowMoments,
    best_of,
    check_order,
    held_out_split,
    is_constant,
    moments_or_white,
    rounding,
    window_moments,
)
from neuroprior.control.vector_plans import VectorPlans

RIDGE = 1e-5
"""Added to the variances of the past, as a share of their mean."""


class WindowSynergies(LinearGaussianPrior):
    """Synergies over time: windows of W vectors lie near a plane of few dimensions, with Gaussian coordinates.

    The principal components of all windows (probabilistic PCA: Tipping and Bishop, 1999) are patterns over time and
    dimensions together, near motor synergies (time-varying ones: d'Avella et al., 2003). The next vector is predicted
    from the vectors before it in the window, in closed form. The covariance is shrunk towards that of white noise, by
    the share that predicts held-out plans best.

    Args:
        action_low, action_high: D numbers each: the bounds.
        num_components: patterns; None: as many as predict held-out plans best.
        window: W, vectors in a window, at least 2.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> plans = VectorPlans(torch.sin(torch.linspace(0, 9, 40)).expand(8, 40)[..., None], [-1.0], [1.0])
        >>> WindowSynergies([-1.0], [1.0], num_components=2, window=5).fit(plans).sample(2, 10).shape
        torch.Size([1, 2, 10, 1])
    """

    def __init__(self, action_low: Any, action_high: Any, num_components: int | None = None, window: int = 20) -> None:
        super().__init__(action_low, action_high)
        check_sizes(window=window)
        if window < 2:
            raise ValueError(f"window: an integer of at least 2 is expected, not {window}")
        if num_components is not None:
            check_sizes(num_components=num_components)
        self.num_components, self.window = num_components, window
        self.explained: tuple[float, ...] = ()

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"num_components": self.num_components, "window": self.window}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"explained": list(self.explained)}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        self.explained = tuple(float(share) for share in learned["explained"])

    def learn(self, plans: VectorPlans, generator: torch.Generator) -> None:
        window = min(self.window, int(plans.mask().sum(1).max()))
        most = window * self.action_size
        learning, held_out = held_out_split(plans, generator)
        numbers = [k for k in COMPONENTS if k < most] or [most]
        numbers = numbers if self.num_components is None else [min(self.num_components, most)]
        settings = list(product(numbers, SHRINKAGES))
        best = best_of(self.mean_nats_of(settings, self._moments(learning, window), held_out))
        moments = self._moments(plans, window)
        self.set_window(moments(best))
        self.explained = explained_shares(moments((most, 0.0)).covariance)

    def _moments(self, plans: VectorPlans, window: int) -> Callable[[tuple[int, float]], WindowMoments]:
        """Makes the Gaussian of windows of `plans` for a number of components and a share of white noise."""
        values = self.scaled(plans.actions)[plans.mask()]
        mean, covariance, _ = moments_or_white(self.scaled(plans.windows(window)), values, window - 1)
        white = torch.diag(values.double().var(0, correction=0).repeat(window))
        both = varying(self, values, window)
        sizes, components = torch.linalg.eigh(covariance)

        def moments(setting: tuple[int, float]) -> WindowMoments:
            number, share = setting
            # What components leave is the same in all directions, but a constant stays one.
            return WindowMoments(mean, torch.lerp(principal(sizes, components, number) * both, white, share))

        return moments


COMPONENTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Numbers of components that are tried."""

SHRINKAGES = (0.3, 1e-1, 1e-2, 1e-4)
"""Shares of white noise in the covariance of windows that are tried: the fewer plans, the more helps. Held-out
likelihood chooses; of equals it takes the first."""


class StepSynergies(LinearGaussianPrior):
    """Synergies per step: each vector lies near a plane of few dimensions, whose coordinates are an autoregression.

    The principal components of single vectors are patterns over dimensions at one time (time-invariant synergies); the
    contrast to `WindowSynergies`.

    Args:
        action_low, action_high: D numbers each: the bounds.
        num_components: patterns, at most D; None: as many as predict held-out plans best.
        order: of the autoregression of the coordinates; 0: independent in time.

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

    def __init__(self, action_low: Any, action_high: Any, num_components: int | None = None, order: int = 1) -> None:
        super().__init__(action_low, action_high)
        check_order(order, self.action_size)
        if num_components is not None:
            check_sizes(num_components=num_components)
            if num_components > self.action_size:
                raise ValueError(f"num_components: at most {self.action_size}, one a dimension, not {num_components}")
        self.num_components, self.order = num_components, order
        self.explained: tuple[float, ...] = ()

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"num_components": self.num_components, "order": self.order}

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
            numbers = range(1, self.action_size + 1)
            number = best_of(self.mean_nats_of(numbers, self._moments(learning), held_out))
        self.set_window(self._moments(plans)(number))
        self.explained = explained_shares(window_moments(self.scaled(plans.windows(1))).covariance)

    def _moments(self, plans: VectorPlans) -> Callable[[int], WindowMoments]:
        """Makes the Gaussian of windows of `plans` whose vectors lie near a plane of so many dimensions."""
        values = self.scaled(plans.actions)[plans.mask()]
        covariance = window_moments(values[:, None]).covariance
        components = torch.linalg.eigh(covariance)[1]
        window, size = self.order + 1, self.action_size
        whole, joint, _ = moments_or_white(self.scaled(plans.windows(window)), values, self.order)
        both = varying(self, values, window)

        def moments(number: int) -> WindowMoments:
            # The coordinates keep their covariance over time; what is beside the plane is white, and the same in all
            # directions.
            vectors = components[:, -number:]
            each, eye = (torch.eye(n, dtype=torch.double, device=components.device) for n in (window, size))
            plane = torch.kron(each, vectors @ vectors.T)
            beside = covariance.trace() - (vectors.T @ covariance @ vectors).trace()
            white = eye - vectors @ vectors.T
            level = beside / max(size - number, 1)
            noise = torch.kron(each, level * white)
            return WindowMoments(whole, (plane @ joint @ plane + noise) * both, RIDGE)

        return moments


def varying(prior: LinearGaussianPrior, values: Tensor, window: int) -> Tensor:
    """`[W * D, W * D]`: 1 between dimensions of windows of W vectors that vary in `values [S, D]`, 0 for constants."""
    error = rounding(prior, values.double().mean(0))
    varies = ~is_constant(values.double().std(0, correction=0), error).repeat(window)
    return (varies[:, None] & varies).double()


def principal(values: Tensor, vectors: Tensor, number: int) -> Tensor:
    """A covariance `[n, n]` with all but its `number` largest components made equal (probabilistic PCA).

    Args:
        values, vectors: `[n]`, ascending, and `[n, n]`: its eigenvalues and eigenvectors.
        number: components that are kept.
    """
    values = values.clamp(min=0)
    number = min(number, len(values))
    rest = values[: len(values) - number]
    kept = values.clone()
    if len(rest):
        kept[: len(rest)] = rest.mean()
    rebuilt: Tensor = (vectors * kept) @ vectors.T
    return rebuilt


def explained_shares(covariance: Tensor) -> tuple[float, ...]:
    """The share of the variance that the first 1, 2, ... principal components explain."""
    values = torch.linalg.eigvalsh(covariance).flip(0).clamp(min=0)
    total = values.sum()
    return tuple((values.cumsum(0) / total).tolist()) if total > 0 else (1.0,) * len(values)
