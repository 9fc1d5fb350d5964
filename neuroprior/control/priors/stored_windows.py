"""Stored windows: a plan continues as the stored plans did whose past was nearest to its own."""

from itertools import product
from typing import Any, Self

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_memory, check_sizes
from neuroprior._random import generator_on
from neuroprior.control.priors.linear_gaussian import held_out_split, min_std, rounding
from neuroprior.control.priors.vector_prior import GaussianForecast, VectorPrior, censored_log_prob
from neuroprior.control.vector_plans import VectorPlans

BANDWIDTHS = (0.0125, 0.025, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Bandwidths of the match of the past that `fit` tries; the least are for vectors that take up a small part of the
range."""

NOISES = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
"""Standard deviations around the stored vectors that `fit` tries."""

MAX_LEAST_NOISE, FINE_NOISE = 0.02, 0.08
"""The least noise that is tried; a lesser one only where it is `FINE_NOISE` standard deviations of the vectors or more.
The least bandwidth is 2.5 times as large."""

BANDWIDTH, NOISE = 0.2, 0.1
"""The bandwidth and the noise before `fit`, and where no plans can be held out to choose them on."""

MAX_EXTENT_STDS = 32
"""Distances are in units of half the range, or of so many standard deviations of the stored vectors if that is less:
what is tried would be too coarse for vectors that take up a small part of the range.
"""

MAX_WINDOWS_CHOSEN_WITH, MAX_VECTORS_CHOSEN_ON = 1_000, 500
"""The most stored windows with which, and the most held-out vectors on which, bandwidths are chosen; in the end all
windows are stored.
"""


class StoredWindows(VectorPrior):
    """A nearest-neighbour prior: segments of executed plans are followed, with noise.

    A segment of `horizon` vectors is one of the stored ones, the more probable the nearer the vectors before it are to
    the present past: with probability proportional to exp(-d / (2 bandwidth ** 2)), d the sum of squared differences
    over the last `match` vectors. It is followed with independent Gaussian noise, and then the next one is chosen. As
    which segment is being followed is not known, a vector's density is that of a mixture, weighted by how well each
    segment predicted the vectors since it began. Distances are in units of half the range, or of 32 standard
    deviations of the stored vectors where that is less; in the same units in all dimensions, or in proportion to the
    standard deviation of each, if that predicts held-out plans better.

    `read` begins a new segment after the past. `state` is `[N, 2 + match * D + M]`: vectors known, place in the
    segment, the last vectors, and the log-weights of M stored segments.

    Args:
        action_low, action_high: D numbers each: the bounds.
        match: vectors of the past that are compared.
        horizon: vectors of a segment.
        max_windows: segments that are stored at most; of more, as many evenly spaced ones.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> plans = VectorPlans(torch.linspace(-1, 1, 40).expand(8, 40)[..., None], [-1.0], [1.0])
        >>> StoredWindows([-1.0], [1.0], horizon=10).fit(plans).sample(
        ...     3, 20, generator=torch.Generator().manual_seed(0)
        ... ).shape
        torch.Size([1, 3, 20, 1])
    """

    tables = ("extent",)

    segments: Tensor

    extent: Tensor
    """`[D]`: the units of distances as shares of half the range."""

    def __init__(
        self,
        action_low: Any,
        action_high: Any,
        match: int = 4,
        horizon: int = 20,
        max_windows: int = 10_000,
    ) -> None:
        super().__init__(action_low, action_high)
        check_sizes(horizon=horizon, max_windows=max_windows)
        check_count("match", match)
        self.match, self.horizon, self.max_windows = match, horizon, max_windows
        self.bandwidth, self.noise = BANDWIDTH, NOISE
        self.memory = match
        # Before anything is learned, one segment in the middle of the range.
        self.register_buffer("segments", torch.zeros(1, match + horizon, self.action_size))
        self.register_buffer("extent", torch.ones(self.action_size))

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"match": self.match, "horizon": self.horizon, "max_windows": self.max_windows}

    @property
    def learned(self) -> dict[str, Any]:
        sizes = {"bandwidth": self.bandwidth, "noise": self.noise, "num_segments": len(self.segments)}
        return super().learned | sizes

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        number = learned["num_segments"]
        check_sizes(num_segments=number)
        shape = (number, self.match + self.horizon, self.action_size)
        check_memory(4 * shape[0] * shape[1] * shape[2], num_segments=number)
        self.bandwidth, self.noise = float(learned["bandwidth"]), float(learned["noise"])
        if not (0 < self.bandwidth < float("inf") and 0 < self.noise < float("inf")):
            raise ValueError(f"`bandwidth` and `noise` must be above 0, got {self.bandwidth} and {self.noise}")
        self.register_buffer("segments", torch.zeros(shape, device=self.device))

    def tables_fit(self) -> bool:
        return self.extent.shape == (self.action_size,) and bool((self.extent > 0).all())

    def fit(self, plans: VectorPlans, *, generator: torch.Generator | None = None) -> Self:
        plans = self.training_plans(plans)
        learning, held_out = held_out_split(plans, generator_on(generator, "cpu"))
        if not len(learning.windows(self.match + self.horizon)):
            # Too few to hold any out: on those that are stored the least noise would look best.
            self.bandwidth, self.noise = BANDWIDTH, NOISE
            self._store(plans, self.max_windows, False)
            return self
        lengths, order = held_out.mask().sum(1).sort(descending=True, stable=True)
        enough = max(int((lengths.cumsum(0) <= MAX_VECTORS_CHOSEN_ON).sum()), 1)
        held_out = held_out[order[:enough]].steps(0, MAX_VECTORS_CHOSEN_ON)
        nats: dict[tuple[float, float, bool], float] = {}
        for each in (False, True):
            least = self._store(learning, min(self.max_windows, MAX_WINDOWS_CHOSEN_WITH), each)
            bandwidths = [self.bandwidth] if nats else [one for one in BANDWIDTHS if one >= 2.5 * least]
            for self.bandwidth, self.noise in product(bandwidths, [one for one in NOISES if one >= least]):
                nats[self.bandwidth, self.noise, each] = self._mean_nats(held_out)
            self.bandwidth, self.noise, in_proportion = max(nats, key=nats.__getitem__)
        self._store(plans, self.max_windows, in_proportion)
        return self

    @torch.no_grad()
    def _mean_nats(self, plans: VectorPlans) -> float:
        """The mean log-density of a vector of `plans`, nats; -inf where it is not a number."""
        total = float(self.action_log_probs(plans).double().sum() / plans.mask().sum())
        return total if total == total else float("-inf")

    def _store(self, plans: VectorPlans, most: int, in_proportion: bool) -> float:
        """Store the windows; the units of distances may be in proportion to the spread of each dimension.

        Returns:
            The least noise to try, at most `MAX_LEAST_NOISE`: not below `min_std` in any dimension.
        """
        size = self.match + self.horizon
        windows = plans.windows(size)
        if not len(windows):
            raise ValueError(
                f"`plans` must have one of {size} vectors, `match` and `horizon` together, got at most"
                f" {int(plans.mask().sum(1).max())}"
            )
        if len(windows) > most:
            windows = windows[torch.linspace(0, len(windows) - 1, most).round().long()]
        self.register_buffer("segments", self.scaled(windows).to(self.device))
        variance = self.segments.var((0, 1), correction=0)
        std, stds, means = variance.mean().sqrt(), variance.sqrt(), self.segments.mean((0, 1))
        error = rounding(self, means)
        least = min_std(std, error.min())
        extent = (MAX_EXTENT_STDS * std).maximum(least / MAX_LEAST_NOISE).clamp(max=1)
        if in_proportion and std > 0:
            least = min_std(stds, error)
            extent = (extent * stds / std).maximum(least / MAX_LEAST_NOISE)
        self.extent = extent.expand(self.action_size).contiguous()
        return min(float((least / extent).max().maximum(FINE_NOISE * std / extent.mean())), MAX_LEAST_NOISE)

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        empty = torch.zeros(batch_size, 2 + self.match * self.action_size, device=self.device)
        return self._begin(empty)

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        size = self.match * self.action_size
        num_past, place = int(state[0, 0]) if len(state) else 0, int(state[0, 1]) if len(state) else 0
        value = self.scaled(action)
        past = torch.cat([state[:, 2 : 2 + size], value], 1)[:, self.action_size :]
        head = torch.tensor([min(num_past + 1, self.match), place + 1], device=self.device).expand(len(state), 2)
        if place + 1 == self.horizon:
            return self._begin(torch.cat([head, past], 1))
        ones = torch.ones(self.action_size, device=self.device)
        due = self.segments[:, self.match + place]
        nats = censored_log_prob(value[:, None], due, self.noise * self.extent * ones, -ones, ones).sum(-1)
        weights = (state[:, 2 + size :] + nats).log_softmax(-1)
        return self._forecast(torch.cat([head, past, weights], 1), place + 1)

    def read(self, past: Tensor, context: Tensor | None = None) -> tuple[GaussianForecast, Tensor]:
        head = torch.tensor([min(past.shape[1], self.match), 0], device=self.device).expand(len(past), 2)
        return self._begin(torch.cat([head, self._last(past)], 1))

    def _last(self, past: Tensor) -> Tensor:
        """The end of `past [N, T, D]` by which segments are found, scaled: `[N, match * D]`, 0 where there is none."""
        num_past = min(past.shape[1], self.match)
        last = self.scaled(past[:, past.shape[1] - num_past :])
        return torch.nn.functional.pad(last, (0, 0, self.match - num_past, 0)).flatten(1)

    def _begin(self, state: Tensor) -> tuple[GaussianForecast, Tensor]:
        """A new segment, after the past in `state [N, 2 + match * D]`."""
        num_past = int(state[0, 0]) if len(state) else 0
        head = torch.tensor([num_past, 0], device=self.device).expand(len(state), 2)
        return self._forecast(torch.cat([head, state[:, 2:], self._matches(state[:, 2:], num_past)], 1), 0)

    def _matches(self, past: Tensor, num_past: int) -> Tensor:
        """The log-weights `[N, M]` of segments after `past [N, match * D]`, whose last `num_past` vectors count."""
        recent, stored = (
            # From one of the vectors: dimensions that hardly vary would be lost in rounding.
            ((vectors[:, self.match - num_past :] - self.segments[0, 0]) / (self.bandwidth * self.extent)).flatten(1)
            for vectors in (past.unflatten(1, (self.match, self.action_size)), self.segments[:, : self.match])
        )
        distances = recent.square().sum(-1)[:, None] + stored.square().sum(-1) - 2 * recent @ stored.T
        return (-distances / 2).log_softmax(-1)

    def _forecast(self, state: Tensor, place: int) -> tuple[GaussianForecast, Tensor]:
        mean = self.unscaled(self.segments[:, self.match + place]).expand(len(state), -1, -1)
        weights = state[:, 2 + self.match * self.action_size :]
        return GaussianForecast(
            mean, self.noise * self.extent * self.half_range, self.action_low, self.action_high, weights
        ), state

    def continuations(
        self, num_plans: int, length: int, past: Tensor, context: Tensor | None, generator: torch.Generator
    ) -> Tensor:
        """Whole segments at once: which is followed is drawn at its beginning, and not known afterwards."""
        batch, num_past, last = len(past), min(past.shape[1], self.match), self._last(past)
        weights = self._matches(last, num_past)
        parts: list[Tensor] = []
        for at in range(0, length, self.horizon):
            times = num_plans if not parts else 1
            chosen = torch.multinomial(weights.exp(), times, replacement=True, generator=generator).flatten()
            steps = min(self.horizon, length - at)
            mean = self.segments[chosen, self.match : self.match + steps]
            noise = torch.randn(mean.shape, generator=generator, device=mean.device)
            parts.append((mean + self.noise * self.extent * noise).clamp(-1, 1))
            if at + steps < length:
                last = last.repeat_interleave(times, 0)
                last = torch.cat([last, parts[-1].flatten(1)], 1)[:, steps * self.action_size :]
                num_past = min(num_past + steps, self.match)
                weights = self._matches(last, num_past)
        return self.unscaled(torch.cat(parts, 1)).view(batch, num_plans, length, self.action_size)
