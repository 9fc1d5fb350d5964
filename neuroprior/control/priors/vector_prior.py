"""The interface of a prior over vectors in time, and what it predicts: a distribution over the next vector."""

from abc import abstractmethod
from math import log, pi
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from neuroprior._checks import check_memory, check_same_names, check_sizes, kind_of
from neuroprior._random import generator_on
from neuroprior.control.vector_plans import (
    VectorPlans,
    as_floats,
    check_bounds,
    check_finite,
    check_vectors,
)
from neuroprior.plans.sequences import expand_context
from neuroprior.priors.saved import SavedModule

INNERMOST = 1 - 2**-24
"""The largest float32 number below 1."""


class GaussianForecast(NamedTuple):
    """A distribution over the next vector, for N rows: a mixture of K censored Gaussians.

    Vectors are between bounds, and a share of them lies on the bounds (an actuator saturates). A distribution is
    therefore *censored*: inside the bounds it is a density, and at a bound it is the probability of being there, of
    all that would lie beyond. `log_prob` is the logarithm of the density with respect to length inside the bounds plus
    a unit mass at each bound, in each dimension; over these it integrates to one.

    In the last component dimension d may depend on those before it as they are, between the bounds: its mean is
    `mean[d] + coupling[d, :d] @ (vector[:d] - mean[:d])`, its standard deviation `std[d]`. Each dimension is then a
    censored Gaussian by itself, and the density of the vector is exact.

    Attributes:
        mean: `[N, K, D]`.
        std: `[N, K, D]` or broadcast to it, above 0.
        low, high: `[D]`, the bounds.
        log_weights: `[N, K]`, logarithms of the components' probabilities; None: there is one component.
        coupling: `[D, D]` or `[N, D, D]`, strictly lower triangular, of the last component; None: all dimensions are
            independent, as they are in the other components.
    """

    mean: Tensor
    std: Tensor
    low: Tensor
    high: Tensor
    log_weights: Tensor | None = None
    coupling: Tensor | None = None

    def log_prob(self, vector: Tensor) -> Tensor:
        """Nats `[N]` of `vector [N, D]`."""
        mean = self.mean
        if self.coupling is not None:
            last = mean[:, -1]
            last = last + (self.coupling @ (vector - last)[..., None])[..., 0]
            mean = torch.cat([mean[:, :-1], last[:, None]], 1)
        each = censored_log_prob(vector[:, None], mean, self.std, self.low, self.high).sum(-1)
        if self.log_weights is None:
            return each[:, 0]
        return (each + self.log_weights.log_softmax(-1)).logsumexp(-1)

    def sample(self, generator: torch.Generator) -> Tensor:
        """Independent vectors `[N, D]` between the bounds."""
        mean = self.mean
        several = self.log_weights is not None
        uniform = torch.rand(len(mean), generator=generator, device=mean.device) if several else None
        noise = torch.randn(mean[:, 0].shape, generator=generator, device=mean.device, dtype=mean.dtype)
        return self.drawn(uniform, noise)

    def drawn(self, uniform: Tensor | None, noise: Tensor) -> Tensor:
        """The vectors `[N, D]` that random numbers make.

        Args:
            uniform: `[N]`, uniform from 0 to 1: choose the component; None: there is one.
            noise: `[N, D]`, standard normal.
        """
        last, row = self.mean.shape[1] - 1, torch.arange(len(self.mean), device=self.mean.device)
        chosen = torch.zeros_like(row)
        if uniform is not None and self.log_weights is not None:
            up_to = self.log_weights.softmax(-1).cumsum(-1)
            chosen = torch.searchsorted(up_to, uniform[:, None] * up_to[:, -1:])[:, 0].clamp(max=last)
        mean = self.mean[row, chosen]
        noise = noise * self.std.expand(self.mean.shape)[row, chosen]
        if self.coupling is None:
            return (mean + noise).clamp(self.low, self.high)
        coupling = self.coupling * (chosen == last)[:, None, None]
        parts: list[Tensor] = []
        for d in range(mean.shape[-1]):
            centre = mean[:, d]
            if d:
                before = torch.stack(parts, -1) - mean[:, :d]
                centre = centre + (coupling[:, d, :d] * before).sum(-1)
            parts.append((centre + noise[:, d]).clamp(self.low[d], self.high[d]))
        return torch.stack(parts, -1)

    def repeat_interleave(self, times: int) -> "GaussianForecast":
        """The same distribution `times` times a row, `[N * times]` rows."""

        def repeat(values: Tensor | None) -> Tensor | None:
            return None if values is None else values.repeat_interleave(times, 0)

        mean = self.mean.repeat_interleave(times, 0)
        std = self.std.expand_as(self.mean).repeat_interleave(times, 0)
        coupling = self.coupling if self.coupling is None or self.coupling.dim() == 2 else repeat(self.coupling)
        return GaussianForecast(mean, std, self.low, self.high, repeat(self.log_weights), coupling)


def censored_log_prob(value: Tensor, mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Log-density of Gaussians inside the bounds; at a bound the log-probability of all that lies beyond it.

    Args:
        value, mean, std: broadcast to `[..., D]`; what is beyond the bounds counts as at them.
        low, high: `[D]`.
    """
    below, above = value <= low, value >= high
    inside = -0.5 * ((value - mean) / std).square() - std.log() - 0.5 * log(2 * pi)
    if not (below | above).any():
        return inside
    # Where a value is at no bound its tail is not used; a finite argument there keeps gradients finite.
    tail = torch.where(below, (low - mean) / std, torch.where(above, (mean - high) / std, 0.0))
    tails: Tensor = torch.special.log_ndtr(tail)
    return torch.where(below | above, tails, inside)


class VectorPrior(SavedModule):
    """A distribution over sequences of vectors between bounds.

    A subclass writes `start`, `step` and `fit`. `state` is ONE tensor whose first dimension is the batch, so reordering
    or branching is `state[index]`; its other dimensions are up to the prior, and may grow. The rows of one state have
    the same number of vectors behind them.

    `context` is the features `[N, C]` of the state in which the next action is chosen, for a prior with `context_size`.

    Args:
        action_low, action_high: D numbers each: the bounds.
        context_size: C, for a prior that takes features.

    Raises:
        ValueError: an argument is out of range.
    """

    action_size: int
    """D."""

    action_names: tuple[str, ...] | None
    """Names of the D dimensions, as they were in the plans that it learned from, or None."""

    memory: int | None = None
    """How many of the last vectors predictions depend on, at most; None if on all."""

    action_low: Tensor
    """`[D]`, the lower bounds."""

    action_high: Tensor
    """`[D]`, the upper bounds."""

    middle: Tensor
    """`[D]`, the middle of the range."""

    half_range: Tensor
    """`[D]`, half the range: the unit of standard deviations."""

    def __init__(self, action_low: Any, action_high: Any, context_size: int | None = None) -> None:
        super().__init__()
        self.action_names = None
        low, high = as_floats("action_low", action_low).clone(), as_floats("action_high", action_high).clone()
        check_bounds(low, high)
        if context_size is not None:
            check_sizes(context_size=context_size)
        self.action_size, self.context_size = len(low), context_size
        self.register_buffer("action_low", low, persistent=False)
        self.register_buffer("action_high", high, persistent=False)
        self.register_buffer("middle", (low + high) / 2, persistent=False)
        self.register_buffer("half_range", (high - low) / 2, persistent=False)

    def scaled(self, vectors: Tensor) -> Tensor:
        """`vectors [..., D]` in units of half the range, from its middle: -1 and 1 at the bounds, and there alone.

        Rounding would otherwise turn the probability of being at a bound into a density beside it.
        """
        inside = ((vectors - self.middle) / self.half_range).clamp(-INNERMOST, INNERMOST)
        above = torch.where(vectors >= self.action_high, 1.0, inside)
        return torch.where(vectors <= self.action_low, -1.0, above)

    def unscaled(self, scaled: Tensor) -> Tensor:
        """The vectors between the bounds that are `scaled [..., D]`: at a bound just where these are at -1 or 1."""
        inside = (self.middle + self.half_range * scaled).clamp(self.action_low, self.action_high)
        above = torch.where(scaled >= 1, self.action_high, inside)
        return torch.where(scaled <= -1, self.action_low, above)

    @property
    def device(self) -> torch.device:
        """Where the prior computes."""
        return self.action_low.device

    @property
    def takes_context(self) -> bool:
        """True for a prior whose predictions depend on a context."""
        return self.context_size is not None

    @property
    def config(self) -> dict[str, Any]:
        """The constructor's arguments that make a prior like this one (JSON values); subclasses add their own."""
        sizes = {"action_low": self.action_low.tolist(), "action_high": self.action_high.tolist()}
        return sizes | ({} if self.context_size is None else {"context_size": self.context_size})

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"action_names": None if self.action_names is None else list(self.action_names)}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        names = learned["action_names"]
        self.action_names = None if names is None else tuple(map(str, names))

    @abstractmethod
    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        """Before the first vector.

        Args:
            batch_size: N.
            context: `[N, C]`; None for a prior without context.

        Returns:
            The distribution of the first vector, and the state `[N, ...]`.
        """

    @abstractmethod
    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        """After one more vector.

        Args:
            action: `[N, D]` between the bounds.
            state: as `start` or `step` returned it.
            context: `[N, C]`: that of the next vector; None: the last one goes on.
        """

    @abstractmethod
    def fit(self, plans: VectorPlans, *, generator: torch.Generator | None = None) -> Self:
        """Learn from executed plans.

        Args:
            plans: with the same bounds, and features as context where this prior takes them.
            generator: source of randomness, where learning needs one.

        Raises:
            ValueError: plans that this prior cannot learn from.
        """

    def read(self, past: Tensor, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        """After the vectors `past [N, T, D]`, T >= 0, of which the last `memory` are read.

        Args:
            past: vectors that were executed.
            context: `[N, T + 1, C]`, one before each vector and that of the next; None for a prior without context.
        """
        steps = past.shape[1] if self.memory is None else min(past.shape[1], self.memory)
        past = past[:, past.shape[1] - steps :]
        if context is not None:
            context = context[:, context.shape[1] - steps - 1 :]
        forecast, state = self.start(len(past), None if context is None else context[:, 0])
        for t in range(steps):
            forecast, state = self.step(past[:, t], state, None if context is None else context[:, t + 1])
        return forecast, state

    @torch.no_grad()
    def sample(
        self,
        num_plans: int,
        length: int,
        context: Tensor | None = None,
        *,
        past: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Plans that go on after each of B pasts, independent given these: `[B, num_plans, length, D]`.

        Args:
            num_plans: P, for each past.
            length: L.
            context: `[B, C]`, of all steps of the plans; `[B, T + 1, C]`, see `read`, of which the last goes on; None
                for a prior without context.
            past: `[B, T, D]`, the vectors executed before, T >= 0; None: plans begin (B = 1, or as many as contexts).
            generator: source of randomness.

        Raises:
            ValueError: an argument is out of range, or does not fit this prior.
        """
        check_sizes(num_plans=num_plans, length=length)
        check_memory(4 * num_plans * length * self.action_size, num_plans=num_plans, length=length)
        if context is not None:
            context = as_floats("context", context).to(self.device)
        batch = len(context) if context is not None and context.dim() else 1
        past = torch.zeros(batch, 0, self.action_size) if past is None else as_floats("past", past)
        past = past.to(self.device)
        if past.dim() != 3:
            raise ValueError(f"`past` must have shape [B, T, {self.action_size}], got {list(past.shape)}")
        check_vectors("past", past, self.action_low, self.action_high)
        self.check_context(context, len(past))
        steps = past.shape[1] + 1
        if context is not None:
            context = expand_context(context, steps)
            if context.shape[1] != steps:
                raise ValueError(
                    f"`context` must have shape {[len(past), steps, self.context_size]}, one before each vector of the"
                    f" past and that of the next, got {list(context.shape)}"
                )
            check_finite("context", context)
        return self.continuations(num_plans, length, past, context, generator_on(generator, self.device))

    def continuations(
        self, num_plans: int, length: int, past: Tensor, context: Tensor | None, generator: torch.Generator
    ) -> Tensor:
        """As `sample`, with checked arguments and a context per step; a subclass may draw whole plans at once here."""
        forecast, state = self.read(past, context)
        forecast, state = forecast.repeat_interleave(num_plans), state.repeat_interleave(num_plans, 0)
        vectors = [forecast.sample(generator)]
        for _ in range(length - 1):
            forecast, state = self.step(vectors[-1], state)
            vectors.append(forecast.sample(generator))
        plans: Tensor = torch.stack(vectors, 1)
        return plans.view(len(past), num_plans, length, self.action_size)

    def log_prob(self, plans: VectorPlans) -> Tensor:
        """Nats `[N]` of plans, a censored density; see `GaussianForecast`.

        Raises:
            ValueError: plans with other bounds, or another context than this prior's.
        """
        return self.action_log_probs(plans).sum(-1)

    def action_log_probs(self, plans: VectorPlans) -> Tensor:
        """Nats `[N, L]` of each vector given those before it; 0 beyond a plan's end.

        Raises:
            ValueError: plans with other bounds, or another context than this prior's.
        """
        self.check_plans(plans)
        plans = plans.to(self.device)
        actions, context = plans.actions, plans.context
        if not plans.max_length or not len(plans):
            return torch.zeros(actions.shape[:2], device=self.device)
        forecast, state = self.start(len(plans), None if context is None else context[:, 0])
        parts = [forecast.log_prob(actions[:, 0])]
        for t in range(1, plans.max_length):
            forecast, state = self.step(actions[:, t - 1], state, None if context is None else context[:, t])
            parts.append(forecast.log_prob(actions[:, t]))
        return torch.stack(parts, 1).masked_fill(~plans.mask(), 0)

    def check_context(self, context: Tensor | None, num_plans: int) -> None:
        """Raise ValueError unless `context` is `[num_plans, C]` or `[num_plans, T, C]`, or None for a prior without."""
        if self.context_size is None:
            if context is not None:
                raise ValueError("`context` must be None for a prior without (plans.without_context())")
        elif (
            context is None
            or context.dim() not in (2, 3)
            or len(context) != num_plans
            or context.shape[-1] != self.context_size
        ):
            raise ValueError(
                f"`context` must be features [{num_plans}, {self.context_size}], or such per step, got"
                f" {None if context is None else list(context.shape)}"
            )

    def check_plans(self, plans: VectorPlans) -> None:
        """Raise ValueError unless `plans` have this prior's names and bounds, and its kind of context."""
        if not isinstance(plans, VectorPlans):
            raise ValueError(f"`plans` must be VectorPlans, got {kind_of(plans)}")
        self.check_same_bounds(plans, "the plans")
        check_same_names("action_names", self.action_names, plans.action_names, "the plans", "this prior")
        self.check_context(plans.context, len(plans))

    def check_same_bounds(self, other: Any, what: str) -> None:
        """Raise ValueError unless the bounds of `other`, plans or a world, are those of this prior.

        A hundred-thousandth of the range makes no difference.
        """
        for name in ("action_low", "action_high"):
            bound, theirs = getattr(self, name), getattr(other, name).to(self.device)
            if bound.shape != theirs.shape or not bool(((bound - theirs).abs() <= 2e-5 * self.half_range).all()):
                raise ValueError(
                    f"`{name}` of {what} must be that of the prior, {bound.tolist()}, got {theirs.tolist()}"
                )

    @property
    def learns_anew(self) -> bool:
        """Whether `fit` forgets what was learned before, so that the plans may have other names."""
        return True

    def training_plans(self, plans: VectorPlans) -> VectorPlans:
        """`plans` that this prior can learn from, at least one with a vector; without context if it takes none.

        It keeps their names.

        Raises:
            ValueError: these are not `VectorPlans` with this prior's bounds and context, or have no vector.
        """
        if isinstance(plans, VectorPlans) and not self.takes_context:
            plans = plans.without_context()
        action_names = self.action_names
        self.action_names = None if self.learns_anew else action_names
        try:
            self.check_plans(plans)
            if not plans.mask().any():
                raise ValueError("`plans` must have a vector to learn from, got none")
        except ValueError:
            self.action_names = action_names
            raise
        if plans.action_names is not None:
            self.action_names = tuple(map(str, plans.action_names))
        return plans[plans.mask().any(1)].trimmed().to(self.device)
