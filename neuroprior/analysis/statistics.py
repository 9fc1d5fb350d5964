"""Statistics of comparisons: shares of best, confidence intervals, paired differences. Needs scipy (`[programs]`)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy import stats
from torch import Tensor


class Interval(NamedTuple):
    """An estimate with its confidence interval."""

    mean: float
    low: float
    high: float


class Difference(NamedTuple):
    """A mean with its confidence interval, and the p-value of its being 0 (two-sided)."""

    mean: float
    low: float
    high: float
    p_value: float


def best_of(scores: Tensor, rivals: Sequence[int] | None = None) -> Tensor:
    """Where each planner was best: at least as good as every rival, so that ties count for each (Hyvärinen, Table 1).

    Args:
        scores: `[K, ...]`: the scores of K planners on the same starts.
        rivals: the planners to be compared with; None: all K.

    Returns:
        `[K, ...]` bool.
    """
    return scores >= (scores if rivals is None else scores[list(rivals)]).amax(0)


def mean_interval(values: ArrayLike, level: float = 0.95) -> Interval:
    """The mean of independent values `[G]`, G >= 2, with Student's interval.

    Args:
        values: one number a world, a subject or a fold: whatever is independent.
        level: of confidence.

    Raises:
        ValueError: fewer than two values.
    """
    values = _vector("values", values)
    mean, error = float(values.mean()), float(stats.sem(values))
    half = float(stats.t.ppf((1 + level) / 2, len(values) - 1)) * error
    return Interval(mean, mean - half, mean + half)


def share_interval(successes: int, trials: int, level: float = 0.95) -> Interval:
    """A share of independent trials, with Wilson's interval.

    Raises:
        ValueError: no trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"share_interval: {successes} successes of {trials} trials")
    low, high = stats.binomtest(successes, trials).proportion_ci(level, method="wilson")
    return Interval(successes / trials, float(low), float(high))


def paired_difference(first: ArrayLike, second: ArrayLike, level: float = 0.95) -> Difference:
    """The mean of `first - second`, values `[G]` of the same G worlds (subjects, folds), with Student's paired test.

    Raises:
        ValueError: different numbers of values, or fewer than two.
    """
    a, b = _vector("first", first), _vector("second", second)
    if len(a) != len(b):
        raise ValueError(f"paired_difference: {len(a)} and {len(b)} values are no pairs")
    mean, low, high = mean_interval(a - b, level)
    if np.ptp(a - b) == 0:
        return Difference(mean, low, high, 1.0 if mean == 0 else 2.0 ** (1 - len(a)))
    return Difference(mean, low, high, float(stats.ttest_rel(a, b).pvalue))


def ratio_difference(totals: ArrayLike, sizes: ArrayLike, level: float = 0.95) -> Difference:
    """The ratio of two sums over independent units, such as bits per action over plans of unlike length.

    The interval is Student's, on the residuals of the units from the common ratio (Cochran 1977, section 6.3).

    Args:
        totals: `[G]`: what each of G >= 2 units adds to the sum above; of differences, for a paired comparison.
        sizes: `[G]`: what it adds to the sum below; none negative.
        level: of confidence.

    Returns:
        The ratio with its interval, and the p-value of a ratio of 0 (two-sided).

    Raises:
        ValueError: fewer than two units, unlike numbers of totals and sizes, or sizes that sum to nothing.
    """
    above, below = _vector("totals", totals), _vector("sizes", sizes)
    if len(above) != len(below):
        raise ValueError(f"ratio_difference: {len(above)} totals and {len(below)} sizes")
    if (below < 0).any() or below.sum() <= 0:
        raise ValueError("sizes: numbers of at least 0 with a positive sum are expected")
    units, ratio = len(above), float(above.sum() / below.sum())
    error = float(np.sqrt(units / (units - 1) * ((above - ratio * below) ** 2).sum()) / below.sum())
    half = float(stats.t.ppf((1 + level) / 2, units - 1)) * error
    if error == 0:
        # No spread at all: by a sign test, since few units may agree by chance.
        return Difference(ratio, ratio, ratio, 1.0 if ratio == 0 else 2.0 ** (1 - units))
    return Difference(ratio, ratio - half, ratio + half, float(2 * stats.t.sf(abs(ratio) / error, units - 1)))


def holm(p_values: ArrayLike) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """P-values corrected for the number of tests: Holm's step-down Bonferroni procedure (Holm 1979, section 3).

    The tests may depend on each other in any way: what stays below 0.05 holds for all of them together with a
    probability of at least 0.95.

    Args:
        p_values: `[M]`, between 0 and 1; M may be 0.

    Returns:
        `[M]` float64, in the order given; each at least its own p-value and at most 1.

    Raises:
        ValueError: another shape, or a value that is no probability.
    """
    values = np.asarray(p_values.cpu().numpy() if isinstance(p_values, torch.Tensor) else p_values, dtype=np.float64)
    if values.ndim != 1:
        raise ValueError(f"p_values: shape [M] is expected, not {list(values.shape)}")
    wrong = np.flatnonzero(~((values >= 0) & (values <= 1)))
    if len(wrong):
        raise ValueError(f"p_values[{wrong[0]}]: a probability between 0 and 1 is expected, not {values[wrong[0]]}")
    order = np.argsort(values, kind="stable")
    corrected = np.empty_like(values)
    corrected[order] = np.minimum(np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1)), 1)
    return corrected


def _vector(name: str, values: ArrayLike) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    if isinstance(values, torch.Tensor):
        values = values.cpu().numpy()
    vector = np.asarray(values, dtype=np.float64)
    if vector.ndim != 1 or len(vector) < 2:
        raise ValueError(f"{name}: at least two values, shape [G], are expected, not {list(vector.shape)}")
    return vector
