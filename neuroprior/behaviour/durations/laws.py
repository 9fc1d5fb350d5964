"""Laws of durations above 0: each fitted to many sets of durations at once by maximum likelihood.

The parameters are those of scipy.stats with `loc` 0. They are fitted for all sets together, from sums over each set,
because a model of A actions needs up to A * A fits, and as many more for each part of the plans that is held out.
"""

from collections.abc import Callable, Sequence
from math import log, pi, sqrt
from typing import Literal, NamedTuple, get_args

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

CUT_OFF_STEPS, CONVERGED_CUT_OFF = 100, 1e-6
"""Most steps until a law of durations that were cut off stays, and the relative change that counts as none."""

SHAPE_STEP = 1e-4
"""Relative change of a gamma law's shape by which its probabilities are differentiated."""

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
    cut_off: Tensor  # [n] bool: it is only known to be at least so long

    def sums(self, values: Tensor) -> Tensor:
        """`[C, ...]`: the sum of `values [n, ...]` over each set."""
        return values.new_zeros(self.number, *values.shape[1:]).index_add_(0, self.cell, values)

    def mean(self, values: Tensor) -> Tensor:
        """`[C, ...]`: the mean of `values [n, ...]` over each set; NaN for an empty one."""
        number = self.sums(torch.ones_like(self.log))
        return self.sums(values) / number.view(-1, *[1] * (values.dim() - 1))

    def share_ended(self) -> Tensor:
        """`[C]`: the share of durations that were not cut off; at least one is counted."""
        return self.mean(1 - self.cut_off.double()).maximum(1 / self.sums(torch.ones_like(self.log)))

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
    return (sets.mean(sets.log.exp()) / sets.share_ended())[:, None]


def _fit_moments(
    sets: Sets, moments: Tensor, maximise: Callable[[Tensor], Tensor], expect: Callable[[Tensor], Tensor]
) -> Tensor:
    """Maximise the likelihood of a law `[C, K]` that depends on the means `[C, 2]` of `moments [n, 2]`.

    What was cut off has the moments of longer durations of the law so far (Dempster, Laird and Rubin 1977): `expect`
    has these from the parameters of each.
    """
    fit = maximise(sets.mean(moments))
    for _ in range(CUT_OFF_STEPS if bool(sets.cut_off.any()) else 0):
        moments[sets.cut_off] = expect(fit[sets.cell[sets.cut_off]])
        before, fit = fit, maximise(sets.mean(moments))
        if not bool(((fit - before).abs() > CONVERGED_CUT_OFF * fit.abs()).any()):
            break
    return fit


def _gamma(sets: Sets) -> Tensor:
    """From the means of durations and of their logarithms."""
    least, time = sets.least(sets.center()[0]), sets.log.exp()
    longer, log_longer = time[sets.cut_off], sets.log[sets.cut_off]

    def maximise(means: Tensor) -> Tensor:
        """Newton's method for the shape (Minka 2002, Estimating a gamma distribution)."""
        mean, center = means.unbind(-1)
        excess = (mean.log() - center).clamp(min=1e-12)
        shape = (3 - excess + ((excess - 3).square() + 24 * excess).sqrt()) / (12 * excess)
        for _ in range(NEWTON_STEPS):
            slope = shape.square() * (1 / shape - torch.polygamma(1, shape))
            shape = 1 / (1 / shape + (-excess + shape.log() - torch.digamma(shape)) / slope)
            shape = shape.clamp(max=least.square().reciprocal())
        return torch.stack([shape, mean / shape], -1)

    def expect(of: Tensor) -> Tensor:
        shape, scale = of.unbind(-1)
        at, step = longer / scale, SHAPE_STEP * shape
        above = torch.special.gammaincc(shape, at).clamp(min=torch.finfo(torch.double).tiny)
        mean = scale * (shape + (shape * at.log() - at - torch.lgamma(shape)).exp() / above)
        more, less = (torch.special.gammaincc(shape + sign * step, at) for sign in (1, -1))
        log_mean = scale.log() + torch.digamma(shape) + (more - less) / (2 * step * above)
        return torch.stack([mean.maximum(longer), log_mean.maximum(log_longer).minimum(mean.log())], -1)

    return _fit_moments(sets, torch.stack([time, sets.log], -1), maximise, expect)


def _weibull(sets: Sets) -> Tensor:
    """Newton's method for the shape, from that of a Gumbel variable with the spread of the logarithms."""
    center, spread = sets.center()
    away = sets.log - center[sets.cell]
    most = pi / sqrt(6) / sets.least(center)
    shape, share = pi / sqrt(6) / spread, sets.share_ended()
    ended = sets.mean(away.masked_fill(sets.cut_off, 0)) / share
    top = away.new_zeros(sets.number).scatter_reduce_(0, sets.cell, away, "amax")
    for _ in range(NEWTON_STEPS):
        weight = (shape[sets.cell] * (away - top[sets.cell])).exp()
        total = sets.sums(weight)
        first, second = sets.sums(weight * away) / total, sets.sums(weight * away.square()) / total
        step = (first - 1 / shape - ended) / (second - first.square() + shape.square().reciprocal())
        before, shape = shape, (shape - step).maximum(shape / 2).minimum(shape * 2).minimum(most)
        if not bool(((shape - before).abs() > CONVERGED * shape).any()):
            break
    weight = (shape[sets.cell] * (away - top[sets.cell])).exp()
    return torch.stack([shape, (center + top + (sets.mean(weight) / share).log() / shape).exp()], -1)


def _lognormal(sets: Sets) -> Tensor:
    center = sets.center()[0]
    away = sets.log - center[sets.cell]
    longer = away[sets.cut_off]

    def maximise(means: Tensor) -> Tensor:
        mean, square = means.unbind(-1)
        return torch.stack([mean, (square - mean.square()).clamp(min=0).sqrt().maximum(sets.least(center + mean))], -1)

    def expect(of: Tensor) -> Tensor:
        return torch.stack(_longer_moments(longer, of[:, 0], of[:, 1])[1:], -1)

    mean, spread = _fit_moments(sets, torch.stack([away, away.square()], -1), maximise, expect).unbind(-1)
    return torch.stack([center + mean, spread], -1)


def _longer_moments(value: Tensor, mean: Tensor, spread: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of normal variables above `value`: the log-probability of that, and then their mean and mean square."""
    away = (value - mean) / spread
    above = torch.special.log_ndtr(-away)
    hazard = (-away.square() / 2 - log(2 * pi) / 2 - above).exp()
    first = mean + spread * hazard
    return above, first, mean * first + spread * (spread + value * hazard)


def _two_lognormal(sets: Sets) -> Tensor:
    """Expectation maximisation on standardised logarithms, from two halves around their mean."""
    center, spread = sets.center()
    value = (sets.log - center[sets.cell]) / spread[sets.cell]
    ended = _condense(value[~sets.cut_off], sets.cell[~sets.cut_off], sets.number)
    longer = _condense(value[sets.cut_off], sets.cell[sets.cut_off], sets.number)
    at_once = max(AT_ONCE // max(ended[0].shape[1] + longer[0].shape[1], 1), 1)
    parts = zip(*(each.split(at_once) for each in (*ended, *longer, center, spread)), strict=True)
    return torch.cat([_two_normal(sets, *batch) for batch in parts])


def _two_normal(
    sets: Sets, value: Tensor, number: Tensor, longer: Tensor, longer_number: Tensor, center: Tensor, spread: Tensor
) -> Tensor:
    """The parameters `[C, 5]` from standardised values `[C, M]`, each of `number` durations, likewise `longer` ones."""
    center, spread = center[:, None], spread[:, None]
    powers = torch.stack([torch.ones_like(value), value, value.square()], -1)
    share = value.new_full((len(value), 2), 0.5)
    spreads, means = share, value.new_tensor([-1.0, 1.0]).expand(len(value), 2)
    for _ in range(CUT_OFF_STEPS if longer.shape[1] else EM_STEPS):
        # The logarithm of how much likelier a value is in the first part is a polynomial of the value.
        narrow = spreads.square().reciprocal()
        terms = [share.log() - spreads.log() - narrow * means.square() / 2, narrow * means, -narrow / 2]
        odds = (powers @ torch.stack(terms, 1).diff(dim=2).neg())[..., 0]
        parts = torch.stack([odds.sigmoid(), odds.neg().sigmoid()], 1) * number[:, None]
        total, first, second = (parts @ powers).unbind(-1)
        if longer.shape[1]:
            above, *moments = _longer_moments(longer[:, None], means[..., None], spreads[..., None])
            parts = (above + share.log()[..., None]).softmax(1) * longer_number[:, None]
            total = total + parts.sum(-1)
            first, second = (
                so_far + (parts * one).sum(-1) for so_far, one in zip((first, second), moments, strict=True)
            )
        share = (total / total.sum(-1, keepdim=True)).clamp(0.01, 0.99)
        means = first / total.clamp(min=1e-9)
        # A part that shrinks to a few durations would be infinitely likely.
        least = (sets.least(center + spread * means) / spread).clamp(min=0.05)
        spreads = (second / total.clamp(min=1e-9) - means.square()).clamp(min=0).sqrt().maximum(least)
    means, spreads = center + spread * means, spread * spreads
    return torch.stack([share[:, 0] / share.sum(-1), means[:, 0], spreads[:, 0], means[:, 1], spreads[:, 1]], -1)


def _condense(values: Tensor, cell: Tensor, sets: int) -> tuple[Tensor, Tensor]:
    """At most `MOST_VALUES` means `[C, M]` of neighbours in each set, and how many values each is of; 0: of none."""
    order = values.argsort()
    order = order[cell[order].argsort(stable=True)]
    cell = cell[order]
    size = cell.bincount(minlength=sets)
    most = min(int(size.max()), MOST_VALUES) if len(size) else 0
    rank = torch.arange(len(cell), device=cell.device) - (size.cumsum(0) - size)[cell]
    place = cell * most + rank * size.clamp(max=MOST_VALUES)[cell] // size[cell]
    number = values.new_zeros(sets * most).index_add_(0, place, torch.ones_like(values))
    sums = torch.zeros_like(number).index_add_(0, place, values[order])
    return (sums / number.clamp(min=1)).view(sets, most), number.view(sets, most)


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

    quantiles = special.gammaincinv(of[..., 0].cpu().numpy(), number.cpu().numpy())
    return torch.as_tensor(quantiles, device=number.device) * of[..., 1]


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


def fit_laws(sets: Sets, laws: Sequence[LawName]) -> Tensor:
    """`[K, C, MOST_PARAMETERS]`: the parameters of K laws, by name, in each set; those of an empty set are NaN."""
    fits = [LAWS[law].fit(sets) for law in laws]
    return torch.stack([functional.pad(parameters, (0, MOST_PARAMETERS - parameters.shape[-1])) for parameters in fits])


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
    for number, functions in enumerate(LAWS.values()):
        chosen = law == number
        if bool(chosen.any()):
            out[chosen] = getattr(functions, what)(values[chosen], parameters[chosen])
    return out
