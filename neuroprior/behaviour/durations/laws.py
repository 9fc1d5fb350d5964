"""Laws of durations above 0: each fitted to many sets of durations at once by maximum likelihood.

The parameters are those of scipy.stats with `loc` 0. They are fitted for all sets together, from sums over each set,
because a model of A actions needs up to A * A fits, and as many more for each part of the plans that is held out.
"""

from collections.abc import Callable, Sequence
from math import log, pi, sqrt
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

LawName = Literal["exponential", "gamma", "lognormal", "weibull", "two-lognormal"]

LAW_NAMES: tuple[LawName, ...] = get_args(LawName)

MOST_PARAMETERS = 5

LEAST_SPREAD = 0.01
"""Least standard deviation of the logarithm of a duration: durations that are all the same vary by this much."""

NEWTON_STEPS, EM_STEPS = 20, 50

MOST_VALUES = 150
"""The most values of a set that a mixture is fitted to; of more durations, means of neighbours."""

NODES, CUT_OFF_STEPS, CONVERGED_CUT_OFF = 16, 50, 1e-6
"""Longer durations that one stands for that was cut off; most steps until their law stays, and how near it must be."""

CONVERGED = 1e-10
"""Relative change of a parameter in a Newton step with which iteration ends."""

AT_ONCE = 2**16
"""Such values of several sets that are in the processor's cache together."""

ROUNDED = 1 / sqrt(12)
"""Standard deviation of what is lost when numbers are rounded to the next multiple of 1."""


class Sets(NamedTuple):
    """Durations in C sets."""

    log: Tensor  # [n] float64: their logarithms
    cell: Tensor  # [n] int64: the set of each
    number: int  # C
    resolution: float  # what durations are multiples of; 0: of nothing
    weight: Tensor | None = None  # [n] float64: how often each counts; None: once

    def sums(self, values: Tensor) -> Tensor:
        """`[C, ...]`: the sum of `values [n, ...]` over each set."""
        if self.weight is not None:
            values = values * self.weight.view(-1, *[1] * (values.dim() - 1))
        return values.new_zeros(self.number, *values.shape[1:]).index_add_(0, self.cell, values)

    def mean(self, values: Tensor) -> Tensor:
        """`[C]`: the mean of `values [n]` over each set; NaN for an empty one."""
        return self.sums(values) / self.sums(torch.ones_like(values))

    def center(self) -> tuple[Tensor, Tensor]:
        """`[C]`: the mean and the standard deviation of the logarithms, the latter of at least `least`."""
        mean = self.mean(self.log)
        spread = self.mean((self.log - mean[self.cell]).square()).sqrt()
        return mean, spread.maximum(self.least(mean))

    def least(self, mean: Tensor) -> Tensor:
        """The least standard deviation of logarithms around `mean`.

        Durations that were rounded hold each value many times; a law that is narrower than the rounding would be
        infinitely likely there, and say nothing of time.
        """
        return (ROUNDED * self.resolution * (-mean).exp()).clamp(min=LEAST_SPREAD, max=1.0)


class Law(NamedTuple):
    """A law of durations; parameters stand in the last dimension, in the order of `names`."""

    names: tuple[str, ...]
    fit: Callable[[Sets], Tensor]  # [C, K]
    log_density: Callable[[Tensor, Tensor], Tensor]  # of durations [...] above 0, with parameters [..., K]
    cdf: Callable[[Tensor, Tensor], Tensor]  # likewise
    quantile: Callable[[Tensor, Tensor], Tensor]  # of numbers [...] between 0 and 1: durations of this law


def resolution(durations: Tensor) -> float:
    """What durations are multiples of, such as the time between two frames; 0 where they are no such multiples.

    Args:
        durations: `[n]`, above 0.
    """
    values = durations.double().unique()
    gaps = values.diff(prepend=values.new_zeros(1))
    gaps = gaps[gaps > 1e-5 * values.max()] if len(values) else gaps
    if len(values) < 2:
        return 0.0
    step = float(gaps[gaps < 1.5 * gaps.min()].mean())
    return step if bool(((values / step - (values / step).round()).abs() < 0.05).all()) else 0.0


def _exponential(sets: Sets) -> Tensor:
    return sets.mean(sets.log.exp())[:, None]


def _gamma(sets: Sets) -> Tensor:
    """Newton's method for the shape (Minka 2002, Estimating a gamma distribution)."""
    mean, center = sets.mean(sets.log.exp()), sets.center()[0]
    excess = (mean.log() - center).clamp(min=1e-12)
    shape = (3 - excess + ((excess - 3).square() + 24 * excess).sqrt()) / (12 * excess)
    for _ in range(NEWTON_STEPS):
        slope = shape.square() * (1 / shape - torch.polygamma(1, shape))
        shape = 1 / (1 / shape + (-excess + shape.log() - torch.digamma(shape)) / slope)
        shape = shape.clamp(max=sets.least(center).square().reciprocal())
    return torch.stack([shape, mean / shape], -1)


def _weibull(sets: Sets) -> Tensor:
    """Newton's method for the shape, from that of a Gumbel variable with the spread of the logarithms."""
    center, spread = sets.center()
    away = sets.log - center[sets.cell]
    most = pi / sqrt(6) / sets.least(center)
    shape = pi / sqrt(6) / spread
    top = away.new_zeros(sets.number).scatter_reduce_(0, sets.cell, away, "amax")
    for _ in range(NEWTON_STEPS):
        weight = (shape[sets.cell] * (away - top[sets.cell])).exp()
        total = sets.sums(weight)
        first, second = sets.sums(weight * away) / total, sets.sums(weight * away.square()) / total
        step = (first - 1 / shape) / (second - first.square() + shape.square().reciprocal())
        before, shape = shape, (shape - step).maximum(shape / 2).minimum(shape * 2).minimum(most)
        if not bool(((shape - before).abs() > CONVERGED * shape).any()):
            break
    weight = (shape[sets.cell] * (away - top[sets.cell])).exp()
    return torch.stack([shape, (center + top + sets.mean(weight).log() / shape).exp()], -1)


def _lognormal(sets: Sets) -> Tensor:
    return torch.stack(sets.center(), -1)


def _two_lognormal(sets: Sets) -> Tensor:
    """Expectation maximisation on standardised logarithms, from two halves around their mean."""
    center, spread = sets.center()
    value, number = _condensed((sets.log - center[sets.cell]) / spread[sets.cell], sets)
    at_once = max(AT_ONCE // max(value.shape[1], 1), 1)
    parts = zip(*(each.split(at_once) for each in (value, number, center, spread)), strict=True)
    return torch.cat([_two_normal(sets, *part) for part in parts])


def _two_normal(sets: Sets, value: Tensor, number: Tensor, center: Tensor, spread: Tensor) -> Tensor:
    """The parameters `[C, 5]` from standardised values `[C, M]` that stand for `number [C, M]` durations each."""
    center, spread = center[:, None], spread[:, None]
    powers = torch.stack([torch.ones_like(value), value, value.square()], -1)
    share = value.new_full((len(value), 2), 0.5)
    spreads, means = share, value.new_tensor([-1.0, 1.0]).expand(len(value), 2)
    for _ in range(EM_STEPS):
        # The logarithm of how much likelier a value is in the first part is a polynomial of the value.
        narrow = spreads.square().reciprocal()
        terms = [share.log() - spreads.log() - narrow * means.square() / 2, narrow * means, -narrow / 2]
        odds = (powers @ torch.stack(terms, 1).diff(dim=2).neg())[..., 0]
        parts = torch.stack([odds.sigmoid(), odds.neg().sigmoid()], 1) * number[:, None]
        total, first, second = (parts @ powers).unbind(-1)
        share = (total / total.sum(-1, keepdim=True)).clamp(0.01, 0.99)
        means = first / total.clamp(min=1e-9)
        # A part that shrinks to a few durations would be infinitely likely.
        least = (sets.least(center + spread * means) / spread).clamp(min=0.05)
        spreads = (second / total.clamp(min=1e-9) - means.square()).clamp(min=0).sqrt().maximum(least)
    means, spreads = center + spread * means, spread * spreads
    return torch.stack([share[:, 0] / share.sum(-1), means[:, 0], spreads[:, 0], means[:, 1], spreads[:, 1]], -1)


def _condensed(values: Tensor, sets: Sets) -> tuple[Tensor, Tensor]:
    """At most `MOST_VALUES` means `[C, M]` of neighbours in each set, and how many values each is of; 0: of none."""
    order = values.argsort()
    order = order[sets.cell[order].argsort(stable=True)]
    cell = sets.cell[order]
    size = cell.bincount(minlength=sets.number)
    most = min(int(size.max()), MOST_VALUES) if len(size) else 0
    rank = torch.arange(len(cell), device=cell.device) - (size.cumsum(0) - size)[cell]
    place = cell * most + rank * size.clamp(max=MOST_VALUES)[cell] // size[cell]
    weight = torch.ones_like(values) if sets.weight is None else sets.weight[order]
    number = values.new_zeros(sets.number * most).index_add_(0, place, weight)
    sums = torch.zeros_like(number).index_add_(0, place, weight * values[order])
    return (sums / number.clamp(min=1e-12)).view(sets.number, most), number.view(sets.number, most)


def _normal(value: Tensor, mean: Tensor, spread: Tensor) -> Tensor:
    return -((value - mean) / spread).square() / 2 - spread.log() - log(2 * pi) / 2


def _gamma_log_density(time: Tensor, of: Tensor) -> Tensor:
    shape, scale = of[..., 0], of[..., 1]
    return (shape - 1) * time.log() - time / scale - torch.lgamma(shape) - shape * scale.log()


def _weibull_log_density(time: Tensor, of: Tensor) -> Tensor:
    shape, away = of[..., 0], time.log() - of[..., 1].log()
    return shape.log() - time.log() + shape * away - (shape * away).exp()


def _two_log_density(time: Tensor, of: Tensor) -> Tensor:
    parts = [_normal(time.log(), of[..., 1], of[..., 2]), _normal(time.log(), of[..., 3], of[..., 4])]
    return torch.logaddexp(of[..., 0].log() + parts[0], torch.log1p(-of[..., 0]) + parts[1]) - time.log()


def _two_cdf(time: Tensor, of: Tensor) -> Tensor:
    first, second = (torch.special.ndtr((time.log() - of[..., k]) / of[..., k + 1]) for k in (1, 3))
    below: Tensor = of[..., 0] * first + (1 - of[..., 0]) * second
    return below


def _two_quantile(number: Tensor, of: Tensor) -> Tensor:
    """Of the part that the number chooses; the rest of the number is uniform again."""
    share = of[..., 0]
    first = number < share
    rest = torch.where(first, number / share, (number - share) / (1 - share))
    mean, spread = (torch.where(first, of[..., k], of[..., k + 2]) for k in (1, 2))
    time: Tensor = (mean + spread * torch.special.ndtri(rest)).exp()
    return time


def _gamma_quantile(number: Tensor, of: Tensor) -> Tensor:
    from scipy import special

    found = special.gammaincinv(of[..., 0].cpu().numpy(), number.cpu().numpy())
    return torch.as_tensor(found, device=number.device) * of[..., 1]


LAWS: dict[LawName, Law] = {
    "exponential": Law(
        ("scale",),
        _exponential,
        lambda time, of: -time / of[..., 0] - of[..., 0].log(),
        lambda time, of: -torch.expm1(-time / of[..., 0]),
        lambda number, of: -of[..., 0] * torch.log1p(-number),
    ),
    "gamma": Law(
        ("shape", "scale"),
        _gamma,
        _gamma_log_density,
        lambda time, of: torch.special.gammainc(of[..., 0], time / of[..., 1]),
        _gamma_quantile,
    ),
    "lognormal": Law(
        ("log_mean", "log_sd"),
        _lognormal,
        lambda time, of: _normal(time.log(), of[..., 0], of[..., 1]) - time.log(),
        lambda time, of: torch.special.ndtr((time.log() - of[..., 0]) / of[..., 1]),
        lambda number, of: (of[..., 0] + of[..., 1] * torch.special.ndtri(number)).exp(),
    ),
    "weibull": Law(
        ("shape", "scale"),
        _weibull,
        _weibull_log_density,
        lambda time, of: -torch.expm1(-((time / of[..., 1]) ** of[..., 0])),
        lambda number, of: of[..., 1] * (-torch.log1p(-number)) ** (1 / of[..., 0]),
    ),
    "two-lognormal": Law(
        ("share", "log_mean", "log_sd", "log_mean_2", "log_sd_2"),
        _two_lognormal,
        _two_log_density,
        _two_cdf,
        _two_quantile,
    ),
}
"""By name, those with fewer parameters first."""


def fit_laws(sets: Sets, laws: Sequence[LawName], cut_off: Tensor) -> Tensor:
    """`[K, C, MOST_PARAMETERS]`: the parameters of K laws in each set; those of an empty set are NaN.

    Args:
        sets: of durations.
        laws: names of K laws.
        cut_off: bool `[n]`: the durations that are only known to be at least so long.
    """
    fits = [_fit_cut_off(LAWS[law], sets, cut_off) if bool(cut_off.any()) else LAWS[law].fit(sets) for law in laws]
    return torch.stack([functional.pad(own, (0, MOST_PARAMETERS - own.shape[-1])) for own in fits])


def _fit_cut_off(law: Law, sets: Sets, cut_off: Tensor) -> Tensor:
    """The maximum of the likelihood of durations, and of the survival of those that were cut off, `[C, K]`.

    Expectation maximisation (Dempster, Laird and Rubin 1977): each of the latter stands for `NODES` longer ones of the
    law so far, those of Gauss and Laguerre, by which the mean of an exponential law is exact.
    """
    nodes, weights = (torch.from_numpy(values) for values in np.polynomial.laguerre.laggauss(NODES))
    least, cell = sets.log[cut_off].exp()[:, None], sets.cell[cut_off]
    cells = torch.cat([sets.cell[~cut_off], cell.repeat_interleave(NODES)])
    weight = torch.cat([torch.ones_like(sets.log[~cut_off]), weights.repeat(len(cell))])
    fit = law.fit(sets)
    for _ in range(CUT_OFF_STEPS):
        of = fit[cell][:, None].expand(-1, NODES, -1)
        number = 1 - (1 - law.cdf(least.expand(-1, NODES), of)) * (-nodes).exp()
        times = law.quantile(number.clamp(max=1 - 2.0**-53), of).maximum(least)
        values = torch.cat([sets.log[~cut_off], times.log().flatten()])
        longer = Sets(values, cells, sets.number, sets.resolution, weight)
        before, fit = fit, law.fit(longer)
        if not bool(((fit - before).abs() > CONVERGED_CUT_OFF * fit.abs()).any()):
            break
    return fit


def log_likelihood(law: Law, time: Tensor, cut_off: Tensor, parameters: Tensor) -> Tensor:
    """The log-density of durations `[n]`; of those that were cut off the log-probability that they are longer."""
    likely = law.log_density(time, parameters)
    likely[cut_off] = log_survival(law.cdf(time[cut_off], parameters[cut_off]))
    return likely


def log_survival(cdf: Tensor) -> Tensor:
    """The log-probability of more than durations of which `cdf` is the probability of at most these."""
    return torch.log1p(-cdf.clamp(max=1 - 2.0**-53))


def by_law(what: Literal["log_density", "cdf", "quantile"], law: Tensor, values: Tensor, parameters: Tensor) -> Tensor:
    """A function of laws, each value `[n]` under its own `law [n]`, a number in `LAWS`, and `parameters [n, ...]`."""
    out = torch.empty_like(values)
    for number, known in enumerate(LAWS.values()):
        here = law == number
        if bool(here.any()):
            out[here] = getattr(known, what)(values[here], parameters[here])
    return out
