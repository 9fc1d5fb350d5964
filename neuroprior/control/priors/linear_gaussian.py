"""What priors share whose next vector is Gaussian and linear in the last ones: closed forms, and moments of windows."""

from abc import abstractmethod
from collections.abc import Callable, Hashable, Sequence
from math import log, pi
from typing import Any, NamedTuple, Self, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from neuroprior._checks import check_count
from neuroprior._random import generator_on
from neuroprior.control.priors.compiled_sampling import draw_linear
from neuroprior.control.priors.vector_prior import GaussianForecast, VectorPrior, censored_log_prob
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.plans.folds import divisible, fair_split
from neuroprior.plans.sequences import check_validation

MIN_STD = 1e-3
"""Of half a dimension's range: the standard deviations of priors are at least so large, see `min_std`."""

MIN_STD_SHARE, ROUNDING = 1e-2, 2.0**-24
"""The share of the standard deviation of the vectors that is enough where bounds are wide; and the error of single
precision, as a share of a number.
"""

HELD_OUT = 0.2
"""Share of the plans (or groups) on which settings are chosen."""

MAX_UNCENSORED_SHARE, EM_STEPS, EM_CHANGE = 0.005, 50, 1e-4
"""The share of vectors at the bounds of a dimension up to which they count as they are; for more, the most steps of EM,
and the change of a vector with which it ends."""

MAX_NUMBERS_AT_ONCE = 2**21
"""Numbers of the covariances, and of the predictions, of several settings that are computed together."""

Key = TypeVar("Key", bound=Hashable)


class WindowMoments(NamedTuple):
    """A Gaussian over W successive vectors, the oldest first, in units of half the range from its middle."""

    mean: Tensor
    """`[W * D]`, float64."""

    covariance: Tensor
    """`[W * D, W * D]`, or where the dimensions are independent `[D, W, W]`; float64, positive semi-definite."""

    ridge: float = 0.0
    """Added to the variances of the past, as a share of their mean."""


class LinearTables(NamedTuple):
    """S linear predictions of the next vector; row h of each: with h vectors known, the last h of M, oldest first."""

    weights: Tensor
    """`[S, M + 1, M * D, D]`."""

    offset: Tensor
    """`[S, M + 1, D]`."""

    std: Tensor
    """`[S, M + 1, D]`."""

    coupling: Tensor
    """`[S, M + 1, D, D]`, below the diagonal: what each dimension adds to the means of those after it."""


class LinearGaussianPrior(VectorPrior):
    """The next vector is a censored Gaussian whose mean is linear in the last `memory` vectors.

    Where fewer are there, at the beginning of plans, the mean is linear in these. Everything is computed in units of
    half the range, from the middle of the range. `state` is the vectors read so far, at most `memory` of them,
    `[N, h, D]`.

    A subclass writes `learn`, which calls `set_window`, where need be with what `mean_nats_of` chose.
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
        shapes = ((memory * size, size), (size,), (size,), (size, size))
        for name, shape in zip(LinearTables._fields, shapes, strict=True):
            self.register_buffer(name, torch.full((memory + 1, *shape), float(name == "std"), device=self.device))

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"memory": self.memory}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        check_count("memory", learned["memory"], 4 * self.action_size**2)
        self._allocate(learned["memory"])

    def set_window(self, moments: WindowMoments) -> None:
        """Predict the last of W successive vectors from those before it, as a Gaussian over all of them has it."""
        tables = predictions([moments], self)
        self._allocate(tables.offset.shape[1] - 1)
        for name, rows in tables._asdict().items():
            getattr(self, name).copy_(rows[0])

    @torch.no_grad()
    def mean_nats_of(
        self, settings: Sequence[Key], moments: Callable[[Key], WindowMoments], plans: VectorPlans, skip: int = 0
    ) -> dict[Key, float]:
        """The mean log-density of a vector of `plans` for each setting, nats; -inf where it is not a number.

        Args:
            settings: those to compare.
            moments: makes the Gaussian of a setting; of equally many vectors for all.
            plans: with at least one vector that counts.
            skip: first vectors of each plan, which are read and do not count.
        """
        nats_by_setting: dict[Key, float] = {}
        values, mask = self.scaled(plans.actions), plans.mask()
        mask[:, :skip] = False
        rest = list(settings)
        while rest:
            first = moments(rest[0])
            at_once = max(MAX_NUMBERS_AT_ONCE // max(first.mean.numel() ** 2, values.numel()), 1)
            chunk, rest = rest[:at_once], rest[at_once:]
            tables = predictions([first, *map(moments, chunk[1:])], self)
            nats = linear_nats(tables, values, self.half_range).masked_fill(~mask, 0)
            means = (nats.double().sum((1, 2)) / mask.sum()).nan_to_num(nan=float("-inf"), neginf=float("-inf"))
            nats_by_setting |= dict(zip(chunk, means.tolist(), strict=True))
        return nats_by_setting

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
        half, h = self.half_range, state.shape[1]
        start = (self._depth - h) * self.action_size
        mean = self.scaled(state).flatten(1) @ self.weights[h, start:] + self.offset[h]
        coupling = half[:, None] * self.coupling[h] / half
        forecast = GaussianForecast(
            (self.middle + half * mean)[:, None], half * self.std[h], self.action_low, self.action_high, None, coupling
        )
        return forecast, state

    def continuations(
        self, num_plans: int, length: int, past: Tensor, context: Tensor | None, generator: torch.Generator
    ) -> Tensor:
        if self.device.type != "cpu":
            return super().continuations(num_plans, length, past, context, generator)
        depth, size, batch = self._depth, self.action_size, len(past)
        num_past = min(past.shape[1], depth)
        vectors = torch.empty(batch * num_plans, num_past + length, size)
        vectors[:, :num_past] = self.scaled(past[:, past.shape[1] - num_past :]).repeat_interleave(num_plans, 0)
        noise = torch.randn(batch * num_plans, length, size, generator=generator)
        draw_linear(self, vectors, num_past, noise)
        return self.unscaled(vectors[:, num_past:]).view(batch, num_plans, length, size)

    def action_log_probs(self, plans: VectorPlans) -> Tensor:
        self.check_plans(plans)
        plans = plans.to(self.device)
        tables = LinearTables(self.weights[None], self.offset[None], self.std[None], self.coupling[None])
        return linear_nats(tables, self.scaled(plans.actions), self.half_range)[0].masked_fill(~plans.mask(), 0)

    def fit(self, plans: VectorPlans, *, generator: torch.Generator | None = None) -> Self:
        plans = self.training_plans(plans)
        self.learn(plans, generator_on(generator, "cpu"))
        return self

    @abstractmethod
    def learn(self, plans: VectorPlans, generator: torch.Generator) -> None:
        """Fit to plans with at least one vector; choices are made on held-out plans that `generator` draws."""


def rounding(prior: VectorPrior, mean: Tensor) -> Tensor:
    """By how much scaled vectors near `mean [..., D]` may be wrong: as vectors were rounded, and as they are scaled."""
    return ROUNDING * ((prior.middle / prior.half_range).abs() + mean.abs())


def is_constant(std: Tensor, error: Tensor) -> Tensor:
    """Which dimensions have vectors that differ by rounding alone, by their standard deviations and its `error`."""
    return std <= 2 * error


def min_std(std: Tensor, error: Tensor) -> Tensor:
    """The least standard deviations of predictions, in units of half the range, as all here.

    Without them predictions could be infinitely likely. Where bounds are wide, `MIN_STD` is more than the vectors
    vary by, so that a share of what they vary by is taken. Constant dimensions have `MIN_STD`.

    Args:
        std: of the vectors.
        error: of their rounding.
    """
    share = (MIN_STD_SHARE * std).maximum(error)
    return share.masked_fill(is_constant(std, error), torch.inf).clamp(max=MIN_STD)


def predictions(moments: Sequence[WindowMoments], prior: VectorPrior) -> LinearTables:
    """The next vector of a `prior` given those before it in a window, for each of S Gaussians over windows.

    Where all of the window's past is known, predictions are made `steady`.
    """
    size = prior.action_size
    mean = torch.stack([each.mean for each in moments]).double()
    covariance = torch.stack([each.covariance for each in moments]).double()
    ridge = torch.tensor([each.ridge for each in moments], dtype=torch.double, device=mean.device)
    error = rounding(prior, mean[:, -size:])
    if covariance.dim() == 3:
        return _predictions(mean, covariance, ridge, error)
    each = mean.unflatten(1, (-1, size)).mT.flatten(0, 1)
    alone = _predictions(each, covariance.flatten(0, 1), ridge.repeat_interleave(size), error.flatten()[:, None])
    weights, offset, std = (table[..., 0].unflatten(0, (-1, size)).movedim(1, -1) for table in alone[:3])
    return LinearTables(weights.diag_embed().flatten(2, 3), offset, std, torch.zeros_like(std).diag_embed())


def _predictions(mean: Tensor, covariance: Tensor, ridge: Tensor, error: Tensor) -> LinearTables:
    """Those of `mean [S, W * D]`, `covariance [S, W * D, W * D]`, `ridge [S]` and the `error [S, D]` of rounding."""
    size = error.shape[1]
    memory = mean.shape[1] // size - 1
    last, eye = slice(memory * size, None), torch.eye(size, dtype=torch.double, device=mean.device)
    spread = covariance[:, last, last].diagonal(dim1=1, dim2=2).clamp(min=0).sqrt()
    least = min_std(spread, error).square()
    rows = []
    for h in range(memory + 1):
        past = slice((memory - h) * size, memory * size)
        past_covariance, cross, now = covariance[:, past, past], covariance[:, past, last], covariance[:, last, last]
        level = past_covariance.diagonal(dim1=1, dim2=2).mean(1, keepdim=True).nan_to_num() * ridge[:, None]
        level = level + 1e-3 * least.repeat(1, h)
        weights = torch.linalg.solve(past_covariance + torch.diag_embed(level), cross)
        if h == memory > 0:
            weights = steady(weights)
        # The mean square of what is left, which with a ridge is more than the conditional variance.
        shared = cross.mT @ weights
        residual = now - shared - shared.mT + weights.mT @ past_covariance @ weights
        residual = (residual + residual.mT) / 2
        # Rounding may leave it slightly indefinite.
        lifted = (-torch.linalg.eigvalsh(residual)[:, :1]).clamp(min=0) + least
        lower = torch.linalg.cholesky(residual + torch.diag_embed(lifted))
        std = lower.diagonal(dim1=1, dim2=2)
        # x = m + unit @ (std * noise): each dimension's mean given those before it, not given their noise
        coupling = (eye - torch.linalg.inv(lower / std[:, None])).tril(-1)
        offset = mean[:, last] - (mean[:, None, past] @ weights)[:, 0]
        rows.append((functional.pad(weights, (0, 0, past.start, 0)), offset, std, coupling))
    return LinearTables(*(torch.stack(each, 1).float() for each in zip(*rows, strict=True)))


def steady(weights: Tensor) -> Tensor:
    """Linear predictions `[S, h * D, D]`, oldest first, so that plans do not run away from their mean exponentially.

    Estimates from few vectors may do so, by chance, though no vector went there. The powers of the recursion then grow
    like those of its spectral radius r > 1, and what lag k adds is divided by r^k, so that the radius is 1.
    """
    number, rows, size = weights.shape
    recursion = torch.zeros(number, rows, rows, dtype=weights.dtype)
    recursion[:, size:, :-size] = torch.eye(rows - size, dtype=weights.dtype)
    recursion[:, :, -size:] = weights.nan_to_num(0, 0, 0).cpu()
    radius = torch.linalg.eigvals(recursion).abs().amax(1).clamp(min=1).to(weights)
    lag = torch.arange(rows // size, 0, -1, device=weights.device).repeat_interleave(size)
    steadied: Tensor = weights / radius[:, None, None] ** lag[:, None]
    return steadied


def linear_nats(tables: LinearTables, values: Tensor, half_range: Tensor) -> Tensor:
    """Nats `[S, N, L]`, in the units of the bounds, of scaled `values [N, L, D]`, each given those before it."""
    num, length, size = values.shape
    depth = tables.offset.shape[1] - 1
    ones = torch.ones_like(half_range)

    def scores(now: Tensor, history: Tensor, h: int) -> Tensor:
        """Nats `[S, R]` of `now [R, D]` after `history [R, h * D]`."""
        weights = tables.weights[:, h, (depth - h) * size :]
        means = (history @ weights.transpose(0, 1).flatten(1)).unflatten(1, (len(weights), size)).transpose(0, 1)
        means = means + tables.offset[:, None, h]
        means = means + (now - means) @ tables.coupling[:, h].mT
        each = censored_log_prob(now, means, tables.std[:, None, h], -ones, ones)
        return (each - (now.abs() < 1) * half_range.log()).sum(-1)

    nats = values.new_empty(len(tables.offset), num, length)
    for t in range(min(depth, length)):
        nats[:, :, t] = scores(values[:, t], values[:, :t].flatten(1), t)
    if length > depth:
        windows = values[:, : length - 1].unfold(1, depth, 1).mT if depth else values[:, :, None, :0]
        late = scores(values[:, depth:].flatten(0, 1), windows.flatten(0, 1).flatten(1), depth)
        nats[:, :, depth:] = late.view(len(nats), num, length - depth)
    return nats


def held_out_split(
    plans: VectorPlans, generator: torch.Generator, share: float = HELD_OUT
) -> tuple[VectorPlans, VectorPlans]:
    """Plans to learn from and plans to choose on, see `fair_split`; where there is a single vector, it is both.

    Raises:
        ValueError: `share` is not between 0 and 1.
    """
    check_validation(share)
    plans = divisible(plans[plans.mask().any(1)])
    return fair_split(plans, share, generator, divide_groups=True) if int(plans.mask().sum()) > 1 else (plans, plans)


def window_moments(windows: Tensor) -> WindowMoments:
    """Those of `windows [M, W, D]`, M >= 1, where a last vector at a bound counts as what may lie beyond it."""
    past, (last, variance) = windows[:, :-1].flatten(1).double(), beyond_bounds(windows)
    flat = torch.cat([past, last], 1)
    mean = flat.mean(0)
    centred = flat - mean
    covariance = centred.T @ centred / len(flat)
    covariance.diagonal()[past.shape[1] :] += variance
    return WindowMoments(mean, covariance)


def beyond_bounds(windows: Tensor) -> tuple[Tensor, Tensor]:
    """What the last vectors of `windows [M, W, D]` would be without bounds, in a linear regression on those before.

    Expectation maximisation for censored regression (Amemiya 1984, Tobit models: a survey, section 4).

    Returns:
        Their expectations `[M, D]`, of values inside the bounds these values, and the mean of their variances `[D]`.
    """
    past, last = windows[:, :-1].flatten(1).double(), windows[:, -1].double()
    at, side = last.abs() >= 1, last.sign()
    variance = torch.zeros_like(last)
    if float(at.double().mean(0).max()) < MAX_UNCENSORED_SHARE:
        return last, variance[0] * 0
    past = past - past.mean(0)
    covariance = past.T @ past / len(past)
    covariance.diagonal().add_(covariance.diagonal().mean().nan_to_num() * 1e-3 + 1e-9)
    solved, value = torch.linalg.solve(covariance, past.T) / len(past), last
    for _ in range(EM_STEPS):
        before, middle = value, value.mean(0)
        mean = middle + past @ (solved @ (value - middle))
        std = ((value - mean).square() + variance).mean(0).sqrt().clamp(min=MIN_STD)
        away = (1 - side * mean) / std
        rate = (-away.square() / 2 - torch.special.log_ndtr(-away) - log(2 * pi) / 2).exp()
        value = torch.where(at, mean + side * std * rate, last)
        variance = torch.where(at, std.square() * (1 + away * rate - rate.square()).clamp(min=0), 0.0)
        if float((value - before).abs().max()) < EM_CHANGE:
            break
    return value, variance.mean(0)


def moments_or_white(windows: Tensor, values: Tensor, memory: int) -> WindowMoments:
    """Those of windows `[M, memory + 1, D]`; where there is none, those of white noise like `values`.

    Of no more windows than vectors in one, white noise that spreads as each dimension of `values [S, D]` does makes up
    for those that are missing: without it, what a few windows do not show would be taken for impossible.
    """
    if not len(windows):
        mean, covariance, _ = window_moments(values[:, None])
        eye = torch.eye(memory + 1, dtype=torch.double, device=values.device)
        return WindowMoments(mean.repeat(memory + 1), torch.kron(eye, covariance))
    moments = window_moments(windows)
    missing = memory + 2 - len(windows)
    if missing <= 0:
        return moments
    white, variances = values.double().mean(0).repeat(memory + 1), values.double().var(0, correction=0)
    share, apart = missing / (missing + len(windows)), white - moments.mean
    mixed = torch.lerp(moments.covariance, variances.repeat(memory + 1).diag(), share)
    return WindowMoments(torch.lerp(moments.mean, white, share), mixed + share * (1 - share) * apart.outer(apart))
