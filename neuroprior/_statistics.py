"""Statistics of comparisons: confidence intervals, paired differences, corrected p-values.

All intervals are made in one way: Student's t over independent units, the units being whatever was drawn independently
(the seeds of a world, animals, folds of a cross-validation, plans), with one number for each. `mean_interval`,
`paired_difference` and `ratio_difference` are that interval of different numbers.

It is exact for normal values. A unit's number is here mostly a mean over many starts, plans or actions, and bounded (a
share, a normalised score), so that 10 to 20 units suffice: in simulations the nominal 95 % interval of such values
covers the mean in 93 to 95 % of all cases with 10 or 20 units, and in 91 to 93 % where the values pile up at a bound
(Beta(1, 9)). The bias-corrected and accelerated bootstrap, which assumes no distribution, covers less there (about 90 %
with 10 units), as it takes the spread of few values for the true one. No method helps where rare outliers decide the
mean: if one seed in ten fails, ten seeds contain no failure in a third of all cases, and the interval is too narrow.
`tests/eval/worlds/test_aggregates.py` repeats the simulations.

Exceptions are intervals of what is no mean: `share_interval` (Wilson) for a share of independent yes-or-no trials,
those of counts (`motifs`) and rank correlations (`drift`), and, in the comparison of priors, of medians and best ones.
Where units count unequally (transitions, features of conditions, how long bouts last), the error is that of leaving out
one unit at a time, and the degrees of freedom are those of as many units as there would be of equal weights.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike

from neuroprior._checks import check_count, check_sizes

LEVEL = 0.05
"""P-values below this are significant."""

ENOUGH_UNITS = 5
"""Independent units below which no verdict is drawn: intervals are given, and nothing is called significant."""


ROUNDING = 2.0**-40
"""Differences of less than this share of the numbers that they are between are rounding errors; see `rounding`."""


class Interval(NamedTuple):
    """An estimate with its confidence interval."""

    mean: float
    low: float
    high: float


class Difference(NamedTuple):
    """A mean with its confidence interval, and the two-sided p-value of the hypothesis that it is 0."""

    mean: float
    low: float
    high: float
    p_value: float


def mean_interval(values: ArrayLike) -> Interval:
    """The mean of independent values `[G]`, G >= 2, with Student's interval.

    Args:
        values: one number for each world, subject or fold: whatever is independent.

    Raises:
        ValueError: fewer than two values.

    Example:
        >>> mean_interval([1.0, 2.0, 3.0, 4.0]).mean
        2.5
    """
    from scipy import special, stats  # here and below where it is needed: it takes a second to import

    values = _vector("values", values)
    mean, error = float(values.mean()), float(stats.sem(values))
    half = float(special.stdtrit(len(values) - 1, 0.975)) * error
    return Interval(mean, mean - half, mean + half)


def share_interval(successes: int, trials: int) -> Interval:
    """A share of independent trials, with Wilson's interval.

    Only for single trials that are each a success or not. Trials that share a world, a seed or a subject are not
    independent: take the `mean_interval` of their shares.

    Args:
        successes: how many of the trials succeeded.
        trials: how many there were, at least 1.

    Raises:
        ValueError: no trials, or more successes than trials.

    Example:
        >>> share_interval(9, 10).mean
        0.9
    """
    from scipy import stats

    check_count("successes", successes, 0)
    check_sizes(trials=trials)
    if successes > trials:
        raise ValueError(f"`successes` must be at most {trials}, the number of trials, got {successes}.")
    low, high = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return Interval(successes / trials, float(low), float(high))


def paired_difference(first: ArrayLike, second: ArrayLike) -> Difference:
    """The mean of `first - second`, values `[G]` of the same G worlds (subjects, folds), with Student's paired test.

    Args:
        first, second: `[G]` each, G >= 2, in the same order.

    Raises:
        ValueError: different numbers of values, or fewer than two.

    Example:
        >>> found = paired_difference([0.7, 0.8, 0.9, 0.8], [0.6, 0.6, 0.8, 0.7])
    """
    from scipy import stats

    a, b = _vector("first", first), _vector("second", second)
    if len(a) != len(b):
        raise ValueError(f"`second` must have {len(a)} values, as many as `first`, got {len(b)}.")
    mean, low, high = mean_interval(a - b)
    spread, near = np.ptp(a - b), rounding(first, second) * max(np.abs(a).max(), np.abs(b).max())
    if spread <= near:
        return _without_spread(0.0 if spread > 0 and abs(mean) <= near else mean, len(a))
    return Difference(mean, low, high, float(stats.ttest_rel(a, b).pvalue))


def ratio_difference(totals: ArrayLike, sizes: ArrayLike) -> Difference:
    """The ratio of two sums over independent units, such as bits per action over plans of unequal lengths.

    The interval is Student's, on the residuals of the units from the common ratio (Cochran 1977, section 6.3).

    Args:
        totals: `[G]`: the part of each of G >= 2 units in the numerator; differences for a paired comparison.
        sizes: `[G]`: its part in the denominator; none negative.

    Returns:
        The ratio with its interval, and the p-value of a ratio of 0 (two-sided).

    Raises:
        ValueError: fewer than two units, unequal numbers of totals and sizes, or
            sizes that sum to 0.

    Example:
        >>> found = ratio_difference([-2.0, -3.0], [10.0, 10.0])
    """
    from scipy import special

    above, below = _vector("totals", totals), _vector("sizes", sizes)
    if len(above) != len(below):
        raise ValueError(f"`sizes` must have {len(above)} values, as many as `totals`, got {len(below)}.")
    if (below < 0).any() or below.sum() <= 0:
        raise ValueError("`sizes` must be at least 0, with a sum above 0.")
    units, ratio = len(above), float(above.sum() / below.sum())
    error = float(np.sqrt(units / (units - 1) * ((above - ratio * below) ** 2).sum()) / below.sum())
    if error == 0 or np.abs(above - ratio * below).max() <= rounding(totals, sizes) * np.abs(above).max():
        return _without_spread(ratio, units)
    half = float(special.stdtrit(units - 1, 0.975)) * error
    return Difference(ratio, ratio - half, ratio + half, float(2 * special.stdtr(units - 1, -abs(ratio) / error)))


def rounding(*values: Any) -> float:
    """The share of numbers to which differences between them are rounding errors: two units of their last place.

    It is `ROUNDING` in double precision, for what is a sum of many such numbers.
    """
    kinds = [np.asarray(_on_cpu(one)).dtype for one in values]
    return max([ROUNDING, *(2 * float(np.finfo(kind).eps) for kind in kinds if kind.kind == "f")])


def _without_spread(mean: float, units: int) -> Difference:
    """A mean of equal values, of which Student's test would be certain: a sign test, as few may agree at random."""
    return Difference(mean, mean, mean, 1.0 if mean == 0 else 2.0 ** (1 - units))


def holm(p_values: ArrayLike, tests: int | None = None) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """P-values corrected for the number of tests: Holm's step-down Bonferroni procedure (Holm 1979, section 3).

    The tests may depend on each other in any way: if all null hypotheses are true, any corrected p-value is below 0.05
    with a probability of at most 0.05.

    Args:
        p_values: `[M]`, between 0 and 1; M may be 0.
        tests: how many there were in all, at least M, where these are the smallest p-values; None: M.

    Returns:
        `[M]` float64, in the order given; each at least its own p-value and at most 1.

    Raises:
        ValueError: another shape, a value that is no probability, or fewer tests than values.

    Example:
        >>> holm([0.01, 0.04, 0.03]).tolist()
        [0.03, 0.06, 0.06]
    """
    values = np.asarray(_on_cpu(p_values), dtype=np.float64)
    if values.ndim != 1:
        raise ValueError(f"`p_values` must have the shape [M], got {list(values.shape)}.")
    wrong = np.flatnonzero(~((values >= 0) & (values <= 1)))
    if len(wrong):
        raise ValueError(f"`p_values[{wrong[0]}]` must be from 0 to 1, got {values[wrong[0]]}.")
    tests = len(values) if tests is None else tests
    check_count("tests", tests, 0)
    if tests < len(values):
        raise ValueError(f"`tests` must be at least {len(values)}, the number of p-values, got {tests}.")
    order = np.argsort(values, kind="stable")
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(np.maximum.accumulate(values[order] * (tests - np.arange(len(values)))), 1)
    return corrected


def _on_cpu(values: Any) -> Any:
    """An array in place of a tensor; all else as it is."""
    return values.cpu().numpy() if isinstance(values, torch.Tensor) else values


def _vector(name: str, values: ArrayLike) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    try:
        vector = np.asarray(_on_cpu(values), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be numbers of shape [G] ({error}).") from error
    if vector.ndim != 1 or len(vector) < 2:
        raise ValueError(f"`{name}` must be two numbers or more, shape [G], got {list(vector.shape)}.")
    wrong = np.flatnonzero(np.isnan(vector))
    if len(wrong):
        raise ValueError(f"`{name}[{wrong[0]}]` must be a number, got nan.")
    return vector


def interval_words(low: float, high: float, form: str, before: str = "") -> str:
    """Return an interval for a table or, with `before`, a sentence: "0.1 to 0.3"; "" where there is none (NaN)."""
    return "" if np.isnan(low) else f"{before}{low:{form}} to {high:{form}}"


def p_words(value: float) -> str:
    """Return a p-value for a sentence: "p = .012", "p < .0001"."""
    if value < 1e-4:
        return "p < .0001"
    return f"p = {value:.2g}".replace("0.", ".", 1)
