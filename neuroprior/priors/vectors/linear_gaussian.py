"""What priors share whose next vector is Gaussian and linear in the last ones: closed forms, and moments of windows."""

import sys
from abc import abstractmethod
from collections.abc import Hashable, Mapping
from dataclasses import replace
from typing import Any, Self, TypeVar

import torch
from torch import Tensor

from neuroprior._checks import check_count
from neuroprior._compiled import compiled
from neuroprior._random import generator_on
from neuroprior.plans.folds import divisible, ungrouped
from neuroprior.plans.sequences import check_validation
from neuroprior.plans.vector_plans import VectorPlans
from neuroprior.priors.vectors.vector_prior import GaussianForecast, VectorPrior, censored_log_prob

LEAST_STD = 1e-3
"""Of half a dimension's range: the standard deviations of priors are at least so large."""

HELD_OUT = 0.2
"""Share of the plans (or groups) on which settings are chosen."""


Key = TypeVar("Key", bound=Hashable)


class LinearGaussianPrior(VectorPrior):
    """The next vector is a censored Gaussian whose mean is linear in the last `memory` vectors.

    Where fewer are there, at the beginning of plans, the mean is linear in these. Everything is computed in units of
    half the range, from the middle of the range. `state` is the vectors read so far, at most `memory` of them,
    `[N, h, D]`.

    A subclass writes `learn`, which calls `set_window`.
    """

    weights: Tensor
    offset: Tensor
    std: Tensor
    coupling: Tensor

    def __init__(self, action_low: Any, action_high: Any) -> None:
        super().__init__(action_low, action_high)
        self._allocate(0)

    def _allocate(self, memory: int) -> None:
        self.memory, size = memory, self.action_size
        # Row h of each: with h vectors known, the last h of `memory`, oldest first.
        shapes = {
            "weights": (memory + 1, memory * size, size),
            "offset": (memory + 1, size),
            "std": (memory + 1, size),
            "coupling": (memory + 1, size, size),
        }
        for name, shape in shapes.items():
            self.register_buffer(name, torch.full(shape, float(name == "std"), device=self.device))

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"memory": self.memory}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        check_count("memory", learned["memory"], 4 * self.action_size**2)
        self._allocate(learned["memory"])

    def set_window(self, mean: Tensor, covariance: Tensor, ridge: float = 0.0) -> Self:
        """Predict the last of W successive vectors from those before it, as a Gaussian over all of them has it.

        Args:
            mean: `[W * D]`, in units of half the range from its middle, the oldest vector first.
            covariance: `[W * D, W * D]`, positive semi-definite.
            ridge: added to the variances of the past, as a share of their mean.
        """
        size = self.action_size
        memory = len(mean) // size - 1
        self._allocate(memory)
        mean, covariance = mean.double(), covariance.double()
        last = slice(memory * size, None)
        least = LEAST_STD**2 * torch.eye(size, dtype=torch.double, device=mean.device)
        for h in range(memory + 1):
            past = slice((memory - h) * size, memory * size)
            known, cross = covariance[past, past], covariance[past, last]
            if h:
                level = known.diagonal().mean() * ridge + LEAST_STD**2 * 1e-3
                weights = torch.linalg.solve(
                    known + level * torch.eye(h * size, dtype=torch.double, device=mean.device), cross
                )
            else:
                weights = cross
            rest = covariance[last, last] - cross.T @ weights
            if ridge:  # the mean square of what is left, which with a ridge is more than the conditional variance
                rest = covariance[last, last] - cross.T @ weights - weights.T @ cross + weights.T @ known @ weights
            lower = torch.linalg.cholesky((rest + rest.T) / 2 + _lifted(rest) + least)
            std = lower.diagonal()
            unit = lower / std
            self.weights[h, past] = weights.to(self.weights)
            self.offset[h] = (mean[last] - mean[past] @ weights).to(self.offset)
            self.std[h] = std.to(self.std)
            # x = m + unit @ (std * noise): each dimension's mean given those before it, not given their noise
            inverse = torch.linalg.inv(unit)
            eye = torch.eye(size, dtype=torch.double, device=mean.device)
            self.coupling[h] = (eye - inverse).tril(-1).to(self.coupling)
        return self

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        return self._forecast(torch.zeros(batch_size, 0, self.action_size, device=self.device))

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        state = torch.cat([state, action[:, None]], 1)
        return self._forecast(state[:, state.shape[1] - min(state.shape[1], self._depth) :])

    @property
    def _depth(self) -> int:
        assert self.memory is not None
        return self.memory

    def _forecast(self, state: Tensor) -> tuple[GaussianForecast, Tensor]:
        mean = self._means(self.scaled(state), state.shape[1])
        half, h = self.half_range, state.shape[1]
        coupling = half[:, None] * self.coupling[h] / half
        forecast = GaussianForecast(
            (self.middle + half * mean)[:, None], half * self.std[h], self.action_low, self.action_high, None, coupling
        )
        return forecast, state

    def _means(self, history: Tensor, h: int) -> Tensor:
        """Means `[..., D]`, scaled, after `history [..., h, D]`."""
        start = (self._depth - h) * self.action_size
        means: Tensor = history.flatten(-2) @ self.weights[h, start:] + self.offset[h]
        return means

    def continuations(
        self, num_plans: int, length: int, past: Tensor, context: Tensor | None, generator: torch.Generator
    ) -> Tensor:
        depth, size, batch = self._depth, self.action_size, len(past)
        known = min(past.shape[1], depth)
        vectors = torch.empty(batch * num_plans, known + length, size, device=self.device)
        vectors[:, :known] = self.scaled(past[:, past.shape[1] - known :]).repeat_interleave(num_plans, 0)
        noise = torch.randn(batch * num_plans, length, size, generator=generator, device=self.device)
        able = vectors.device.type == "cpu" and vectors.dtype == self.weights.dtype == torch.float32
        fast = compiled("neuroprior.priors.vectors.compiled_sampling") if able else None
        (fast or sys.modules[__name__]).draw_linear(self, vectors, known, noise)
        return self.unscaled(vectors[:, known:]).view(batch, num_plans, length, size)

    def action_log_probs(self, plans: VectorPlans) -> Tensor:
        self.check_plans(plans)
        values, depth = self.scaled(plans.actions), self._depth
        num, length, _ = values.shape
        parts = [self._scores(values[:, t], self._means(values[:, :t], t), t) for t in range(min(depth, length))]
        if length > depth:
            history = (
                values[:, : length - 1].unfold(1, depth, 1).transpose(2, 3) if depth else values[:, :, None][:, :, :0]
            )
            late = self._scores(values[:, depth:], self._means(history, depth), depth)
            parts += list(late.unbind(1))
        if not parts:
            return torch.zeros(num, length, device=self.device)
        return torch.stack(parts, 1).masked_fill(~plans.mask(), 0)

    def _scores(self, values: Tensor, means: Tensor, h: int) -> Tensor:
        """Nats `[...]` of scaled `values [..., D]`, in the units of the bounds."""
        means = means + (values - means) @ self.coupling[h].T
        ones = torch.ones_like(self.half_range)
        each = censored_log_prob(values, means, self.std[h], -ones, ones)
        nats: Tensor = (each - (values.abs() < 1) * self.half_range.log()).sum(-1)
        return nats

    def fit(self, plans: VectorPlans, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        self.check_settings(settings)
        plans = self.training_plans(plans)
        self.learn(plans, generator_on(generator, "cpu"))
        return self

    @abstractmethod
    def learn(self, plans: VectorPlans, generator: torch.Generator) -> None:
        """Fit to plans with at least one vector; choices are made on held-out plans that `generator` draws."""


def draw_linear(prior: LinearGaussianPrior, vectors: Tensor, known: int, noise: Tensor) -> None:
    """Fill in `vectors [N, known + L, D]`, scaled, behind the first `known`, by standard normal `noise [N, L, D]`."""
    depth, coupled = prior.memory or 0, bool(prior.coupling.any())
    for t in range(known, vectors.shape[1]):
        h = min(t, depth)
        mean = prior._means(vectors[:, t - h : t], h)
        free, coupling = mean + noise[:, t - known] * prior.std[h], prior.coupling[h]
        if not coupled:
            vectors[:, t] = free.clamp(-1, 1)
            continue
        now = vectors[:, t]
        now[:, 0] = free[:, 0].clamp(-1, 1)
        for d in range(1, vectors.shape[2]):
            now[:, d] = (free[:, d] + (now[:, :d] - mean[:, :d]) @ coupling[d, :d]).clamp(-1, 1)


def _lifted(rest: Tensor) -> Tensor:
    """What makes a covariance that rounding left slightly indefinite positive definite."""
    lowest = torch.linalg.eigvalsh((rest + rest.T) / 2)[0]
    lifted: Tensor = (-lowest).clamp(min=0) * torch.eye(len(rest), dtype=rest.dtype, device=rest.device)
    return lifted


def held_out_split(
    plans: VectorPlans, generator: torch.Generator, share: float = HELD_OUT
) -> tuple[VectorPlans, VectorPlans]:
    """Plans to learn from and plans to choose on; where there is a single vector, it is both.

    Groups stay together, unless they are so unequal that a share of them is no such share of the vectors. Where the
    plans are, the end of the longest is held out instead.

    Raises:
        ValueError: `share` is not between 0 and 1.
    """
    check_validation(share)
    plans = divisible(plans[plans.mask().any(1)])
    lengths = plans.mask().sum(1)
    total, longest = int(lengths.sum()), int(lengths.max()) if len(lengths) else 0
    if total < 2:
        return plans, plans
    for some in (plans,) if plans.group is None else (plans, ungrouped(plans)):
        learning, held_out = some.split(share, generator)
        if share / 2 <= int(held_out.mask().sum()) / total <= (1 + share) / 2:
            return learning, held_out
    cut = longest - max(min(round(share * total), longest // 2), 1)
    if longest - cut < share / 2 * total:
        return learning, held_out
    row = int(lengths.argmax())
    lengths[row] = cut
    return replace(plans, lengths=lengths), plans[row : row + 1].steps(cut)


@torch.no_grad()
def mean_nats(prior: VectorPrior, plans: VectorPlans) -> float:
    """The mean log-density of a vector of `plans`, nats; -inf where it is not a number."""
    total = float(prior.action_log_probs(plans).double().sum() / plans.mask().sum().clamp(min=1))
    return total if total == total else float("-inf")


def best_of(scores: Mapping[Key, float]) -> Key:
    """The key with the highest score; of equals the first."""
    return max(scores, key=lambda each: scores[each])


def window_moments(windows: Tensor) -> tuple[Tensor, Tensor]:
    """Mean `[W * D]` and covariance `[W * D, W * D]`, in float64, of `windows [M, W, D]`, M >= 1."""
    flat = windows.flatten(1).double()
    mean = flat.mean(0)
    centred = flat - mean
    return mean, centred.T @ centred / len(flat)


def moments_or_white(windows: Tensor, values: Tensor, memory: int) -> tuple[Tensor, Tensor]:
    """Mean and covariance of windows `[M, memory + 1, D]`; where there is none, those of white noise like `values`.

    Of no more windows than vectors in one, white noise that spreads as each dimension of `values [S, D]` does makes up
    for those that are missing: without it, what a few windows do not show would be taken for impossible.
    """
    if not len(windows):
        mean, covariance = window_moments(values[:, None])
        eye = torch.eye(memory + 1, dtype=torch.double, device=values.device)
        return mean.repeat(memory + 1), torch.kron(eye, covariance)
    mean, covariance = window_moments(windows)
    missing = memory + 2 - len(windows)
    if missing <= 0:
        return mean, covariance
    white, variances = values.double().mean(0).repeat(memory + 1), values.double().var(0, correction=0)
    share, apart = missing / (missing + len(windows)), white - mean
    mixed = torch.lerp(covariance, variances.repeat(memory + 1).diag(), share)
    return torch.lerp(mean, white, share), mixed + share * (1 - share) * apart.outer(apart)
