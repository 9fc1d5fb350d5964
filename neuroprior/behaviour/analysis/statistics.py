"""Statistics of comparisons: confidence intervals, paired differences, aggregates over worlds, corrected p-values.

All intervals are made in one way: Student's t over independent units, the units being whatever was drawn independently
(the seeds of a world, animals, folds of a cross-validation, plans), with one number for each. `mean_interval`,
`paired_difference`, `ratio_difference` and the two aggregates over worlds are that interval of different numbers.

It is exact for normal values. A unit's number is here mostly a mean over many starts, plans or actions, and bounded (a
share, a normalised score), so that 10 to 20 units suffice: in simulations the nominal 95 % interval of such values
covers the mean in 93 to 95 % of all cases with 10 or 20 units, and in 91 to 93 % where the values pile up at a bound
(Beta(1, 9)). The bias-corrected and accelerated bootstrap, which assumes no distribution, covers less there (about 90 %
with 10 units), as it takes the spread of few values for the true one. No method helps where rare outliers decide the
mean: if one seed in ten fails, ten seeds contain no failure in a third of all cases, and the interval is too narrow.
`tests/behaviour/analysis/test_statistics.py` repeats the simulations.

Exceptions are intervals of what is no mean: `share_interval` (Wilson) for a share of independent yes-or-no trials,
those of counts (`motifs`) and rank correlations (`drift`), and, in the comparison of priors, of medians and best ones.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy import special, stats
from torch import Tensor

from neuroprior._checks import check_count, check_level, check_sizes

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


def best_of(scores: Tensor, baselines: Sequence[int] | None = None) -> Tensor:
    """Where each planner was at least as good as every baseline, so that ties count for each (Hyvärinen, Table 1).

    Args:
        scores: `[K, ...]`: the scores of K planners on the same starts.
        baselines: the numbers of the planners to compare with; None for all K.

    Returns:
        `[K, ...]` bool.

    Raises:
        ValueError: a baseline that is not there or none, or a score that is NaN.

    Example:
        >>> best_of(torch.tensor([[0.9, 0.5], [0.8, 0.7]])).tolist()
        [[True, False], [False, True]]
    """
    scores = torch.as_tensor(scores)
    numbers = range(len(scores)) if baselines is None else list(baselines)
    if not len(numbers) or not all(0 <= number < len(scores) for number in numbers):
        raise ValueError(f"baselines: one or more of 0 to {len(scores) - 1} are expected, not {list(numbers)}")
    if scores.isnan().any():
        raise ValueError(f"scores{scores.isnan().nonzero()[0].tolist()}: NaN is no score")
    return scores >= scores[list(numbers)].amax(0)


def mean_interval(values: ArrayLike, level: float = 0.95) -> Interval:
    """The mean of independent values `[G]`, G >= 2, with Student's interval.

    Args:
        values: one number for each world, subject or fold: whatever is independent.
        level: of confidence.

    Raises:
        ValueError: a level that is not between 0 and 1, or fewer than two values.

    Example:
        >>> mean_interval([1.0, 2.0, 3.0, 4.0]).mean
        2.5
    """
    check_level(level)
    values = _vector("values", values)
    mean, error = float(values.mean()), float(stats.sem(values))
    half = float(special.stdtrit(len(values) - 1, (1 + level) / 2)) * error
    return Interval(mean, mean - half, mean + half)


def mean_intervals(frame: Any, by: str | Sequence[str], value: str, level: float = 0.95) -> Any:
    """The mean of a column of a table with Student's interval, for each group of rows; see `mean_interval`.

    Args:
        frame: a pandas frame with a row for each independent unit of each group.
        by: the column or columns that define the groups.
        value: the column of which the means are taken; missing values are left out.
        level: of confidence.

    Returns:
        A pandas frame with a row for each group, in order of appearance: the columns `by`, then `mean`, `low`, `high`
        and `n`, the number of units. `low` and `high` are NaN for fewer than two units.

    Raises:
        ValueError: a level that is not between 0 and 1, or a column that is not there.

    Example:
        >>> import pandas as pd
        >>> frame = pd.DataFrame({"model": ["a", "a", "b", "b"], "bits": [1.0, 1.2, 0.8, 0.9]})
        >>> list(mean_intervals(frame, "model", "bits")["mean"].round(2))
        [1.1, 0.85]
    """
    check_level(level)
    by = [by] if isinstance(by, str) else list(by)
    if not hasattr(frame, "columns"):
        raise ValueError(f"frame: a pandas frame is expected, not {type(frame).__name__}")
    if missing := [name for name in [*by, value] if name not in frame.columns]:
        raise ValueError(f"frame: no column {missing[0]!r}; there are {', '.join(map(str, frame.columns))}")
    groups = frame.groupby(by, sort=False, dropna=False)[value]
    found = groups.agg(mean="mean", error="sem", n="count")
    half = special.stdtrit(found["n"] - 1, (1 + level) / 2) * found["error"]
    found = found.assign(low=found["mean"] - half, high=found["mean"] + half)
    return found[["mean", "low", "high", "n"]].reset_index()


def interquartile_mean(values: ArrayLike, level: float = 0.95) -> Interval:
    """The mean over the middle half of W worlds, with Student's interval over G seeds.

    An aggregate over worlds that a single easy or hard world does not decide (Agarwal et al. 2021, Deep reinforcement
    learning at the edge of the statistical precipice): for each seed the int(W / 4) highest and as many lowest worlds
    are left out and the others averaged, which gives G independent numbers.

    Args:
        values: `[W, G]`, G >= 2: normalised scores. Seed g of one world is independent of seed g of another, and the
            seeds of a world are exchangeable.
        level: of confidence.

    Raises:
        ValueError: a level that is not between 0 and 1, another shape, fewer than two seeds, or values that are not
            finite.

    Example:
        >>> interquartile_mean([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [90.0, 90.0]])
        Interval(mean=1.5, low=1.5, high=1.5)
    """
    return mean_interval(stats.trim_mean(_matrix("values", values), 0.25, axis=0), level)


def interquartile_gap(first: ArrayLike, second: ArrayLike, level: float = 0.95) -> Interval:
    """How much higher the `interquartile_mean` of `first` is than that of `second`, paired by seed.

    Args:
        first: `[W, G]`, G >= 2: scores in W worlds with G seeds.
        second: `[W, G]`: of the other method, with the same worlds and seeds.
        level: of confidence.

    Raises:
        ValueError: a level that is not between 0 and 1, unequal shapes, fewer than two seeds, or values that are not
            finite.

    Example:
        >>> interquartile_gap([[1.0, 2.0, 3.0, 4.0]], [[0.0, 1.0, 2.0, 3.0]])
        Interval(mean=1.0, low=1.0, high=1.0)
    """
    a, b = _alike(first, second)
    gap = stats.trim_mean(a, 0.25, axis=0) - stats.trim_mean(b, 0.25, axis=0)
    # Rounded, so that differences that are equal but for rounding errors have no spread.
    return mean_interval(np.round(gap, 12), level)


def probability_of_improvement(first: ArrayLike, second: ArrayLike, level: float = 0.95) -> Interval:
    """The share of worlds in which `first` is better than `second`, with Student's interval over seeds.

    The probability that the first method has the higher score in a world drawn at random (Agarwal et al. 2021); a tie
    counts one half. The interval is cut at 0 and 1.

    Args:
        first: `[W, G]`, G >= 2: scores in W worlds with G seeds, as for `interquartile_mean`.
        second: `[W, G]`: of the other method, with the same worlds and seeds.
        level: of confidence.

    Raises:
        ValueError: a level that is not between 0 and 1, unequal shapes, fewer than two seeds, or values that are not
            finite.

    Example:
        >>> probability_of_improvement([[3.0, 4.0]], [[1.0, 2.0]])
        Interval(mean=1.0, low=1.0, high=1.0)
    """
    a, b = _alike(first, second)
    mean, low, high = mean_interval(((a > b) + (a == b) / 2).mean(0), level)
    return Interval(mean, max(low, 0.0), min(high, 1.0))


def share_interval(successes: int, trials: int, level: float = 0.95) -> Interval:
    """A share of independent trials, with Wilson's interval.

    Only for single trials that are each a success or not. Trials that share a world, a seed or a subject are not
    independent: take the `mean_interval` of their shares.

    Args:
        successes: how many of the trials succeeded.
        trials: how many there were, at least 1.
        level: of confidence.

    Raises:
        ValueError: a level that is not between 0 and 1, no trials, or more successes than trials.

    Example:
        >>> share_interval(9, 10).mean
        0.9
    """
    check_count("successes", successes, 0)
    check_sizes(trials=trials)
    if successes > trials:
        raise ValueError(f"successes: at most {trials}, the number of trials, is expected, not {successes}")
    check_level(level)
    low, high = stats.binomtest(successes, trials).proportion_ci(level, method="wilson")
    return Interval(successes / trials, float(low), float(high))


def paired_difference(first: ArrayLike, second: ArrayLike, level: float = 0.95) -> Difference:
    """The mean of `first - second`, values `[G]` of the same G worlds (subjects, folds), with Student's paired test.

    Args:
        first, second: `[G]` each, G >= 2, in the same order.
        level: of confidence.

    Raises:
        ValueError: a level that is not between 0 and 1, different numbers of values, or fewer than two.

    Example:
        >>> found = paired_difference([0.7, 0.8, 0.9, 0.8], [0.6, 0.6, 0.8, 0.7])
    """
    a, b = _vector("first", first), _vector("second", second)
    if len(a) != len(b):
        raise ValueError(f"second: {len(a)} values are expected, as many as in first, not {len(b)}")
    mean, low, high = mean_interval(a - b, level)
    spread, near = np.ptp(a - b), rounding(first, second) * max(np.abs(a).max(), np.abs(b).max())
    if spread <= near:
        return _without_spread(0.0 if spread > 0 and abs(mean) <= near else mean, len(a))
    return Difference(mean, low, high, float(stats.ttest_rel(a, b).pvalue))


def ratio_difference(totals: ArrayLike, sizes: ArrayLike, level: float = 0.95) -> Difference:
    """The ratio of two sums over independent units, such as bits per action over plans of unequal lengths.

    The interval is Student's, on the residuals of the units from the common ratio (Cochran 1977, section 6.3).

    Args:
        totals: `[G]`: the part of each of G >= 2 units in the numerator; differences for a paired comparison.
        sizes: `[G]`: its part in the denominator; none negative.
        level: of confidence.

    Returns:
        The ratio with its interval, and the p-value of a ratio of 0 (two-sided).

    Raises:
        ValueError: a level that is not between 0 and 1, fewer than two units, unequal numbers of totals and sizes, or
            sizes that sum to 0.

    Example:
        >>> found = ratio_difference([-2.0, -3.0], [10.0, 10.0])
    """
    check_level(level)
    above, below = _vector("totals", totals), _vector("sizes", sizes)
    if len(above) != len(below):
        raise ValueError(f"sizes: {len(above)} are expected, as many as totals, not {len(below)}")
    if (below < 0).any() or below.sum() <= 0:
        raise ValueError("sizes: numbers of at least 0 with a positive sum are expected")
    units, ratio = len(above), float(above.sum() / below.sum())
    error = float(np.sqrt(units / (units - 1) * ((above - ratio * below) ** 2).sum()) / below.sum())
    if error == 0 or np.abs(above - ratio * below).max() <= rounding(totals, sizes) * np.abs(above).max():
        return _without_spread(ratio, units)
    half = float(special.stdtrit(units - 1, (1 + level) / 2)) * error
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
        raise ValueError(f"p_values: shape [M] is expected, not {list(values.shape)}")
    wrong = np.flatnonzero(~((values >= 0) & (values <= 1)))
    if len(wrong):
        raise ValueError(f"p_values[{wrong[0]}]: a probability between 0 and 1 is expected, not {values[wrong[0]]}")
    tests = len(values) if tests is None else tests
    check_count("tests", tests, 0)
    if tests < len(values):
        raise ValueError(f"tests: at least {len(values)}, the number of p-values, is expected, not {tests}")
    order = np.argsort(values, kind="stable")
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(np.maximum.accumulate(values[order] * (tests - np.arange(len(values)))), 1)
    return corrected


def _on_cpu(values: Any) -> Any:
    """An array in place of a tensor; all else as it is."""
    return values.cpu().numpy() if isinstance(values, torch.Tensor) else values


def _matrix(name: str, values: ArrayLike) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    matrix = np.asarray(_on_cpu(values), dtype=np.float64)
    if matrix.ndim != 2 or matrix.shape[0] < 1 or matrix.shape[1] < 2:
        raise ValueError(
            f"{name}: shape [W, G] is expected, with one world and two seeds at least, not {list(matrix.shape)}"
        )
    wrong = np.argwhere(~np.isfinite(matrix))
    if len(wrong):
        raise ValueError(f"{name}{wrong[0].tolist()}: {matrix[tuple(wrong[0])]} is not a finite number")
    return matrix


def _alike(first: ArrayLike, second: ArrayLike) -> list[np.ndarray[tuple[int, int], np.dtype[np.float64]]]:
    """Two matrices of equal shape."""
    a, b = _matrix("first", first), _matrix("second", second)
    if a.shape != b.shape:
        raise ValueError(f"second: shape {list(a.shape)}, that of first, is expected, not {list(b.shape)}")
    return [a, b]


def _vector(name: str, values: ArrayLike) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    try:
        vector = np.asarray(_on_cpu(values), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: numbers, shape [G], are expected ({error})") from error
    if vector.ndim != 1 or len(vector) < 2:
        raise ValueError(f"{name}: at least two values, shape [G], are expected, not {list(vector.shape)}")
    wrong = np.flatnonzero(np.isnan(vector))
    if len(wrong):
        raise ValueError(f"{name}[{wrong[0]}]: NaN is no number; leave it out")
    return vector
