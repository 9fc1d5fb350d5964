"""Rank correlation of a few or many values with the order in which they came, and its mean over groups."""

from functools import cache
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from neuroprior.analysis.statistics import Difference, ratio_difference

FEWEST_RANKED = 3
"""Values without which there is no correlation to test."""

EXACT = 7
"""Values up to which the p-value is that of all their orders."""


def rank_correlation(values: NDArray[np.float64]) -> Difference:
    """Spearman's rank correlation of values with their order; 0 where all are equal.

    Args:
        values: `[K]`, K at least `FEWEST_RANKED`.

    Returns:
        The correlation with its 95 % interval (Fisher's; -1 to 1 where it tells nothing), and the p-value of 0: that of
        all orders up to `EXACT` values, else Student's approximation.
    """
    num = len(values)
    if (values == values[0]).all():
        return Difference(0.0, -1.0, 1.0, 1.0)
    ranks = stats.rankdata(values)
    ranks = (ranks - ranks.mean()) / np.linalg.norm(ranks - ranks.mean())
    order = np.arange(num) - (num - 1) / 2
    order /= np.linalg.norm(order)
    correlation = round(float(order @ ranks), 12)  # so that a perfect one is 1
    if num <= EXACT:  # Student's approximation would call three plans in a row certain
        every = order[_orders(num)] @ ranks
        p_value = float((np.abs(every) >= abs(correlation) - 1e-9).mean())
    else:
        t = correlation * np.sqrt((num - 2) / max(1 - correlation**2, 1e-12))
        p_value = float(2 * stats.t.sf(abs(t), num - 2))
    if num <= FEWEST_RANKED or abs(correlation) == 1:
        return Difference(correlation, -1.0, 1.0, p_value)
    # 1.06: the variance for ranks (Fieller, Hartley and Pearson 1957).
    centre, half = np.arctanh(correlation), stats.norm.ppf(0.975) * np.sqrt(1.06 / (num - 3))
    return Difference(correlation, float(np.tanh(centre - half)), float(np.tanh(centre + half)), p_value)


def mean_correlation(correlations: list[float]) -> Difference:
    """Student's mean of the correlations of two groups or more, with an interval within -1 and 1."""
    mean, low, high, p_value = ratio_difference(correlations, np.ones(len(correlations)))
    if len(set(correlations)) == 1 and mean != 0:
        # Those of few plans are often the same by chance: what then counts is how often all signs are.
        return Difference(mean, -1.0, 1.0, 2.0 ** (1 - len(correlations)))
    return Difference(mean, max(low, -1.0), min(high, 1.0), p_value)


@cache
def _orders(num: int) -> NDArray[np.int64]:
    """All orders of a few plans, `[num!, num]`."""
    return np.array(list(permutations(range(num))))
