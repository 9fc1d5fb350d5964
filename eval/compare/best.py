"""The best of some priors against the best of others, when which ones are the best has to be found out too."""

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from neuroprior.analysis.statistics import Difference

Array = NDArray[np.float64]


def best_difference(first: Array, second: Array, level: float = 0.95) -> Difference:
    """The best of K alternatives against the best of M others, values of the same G >= 2 seeds; more is better.

    The difference is between those chosen by `chosen`. Its interval and p-value are those of the difference between
    the truly best ones, whichever they are: the first has the better one where one of them is better than every one of
    the second by one-sided paired t-tests at (1 - level) / 2K (intersection-union: Berger 1982; Bonferroni over the
    K), and the second likewise with M. Differences of tests over the chosen ones alone would be called significant too
    often: the choices depend on each other. With K = M = 1 this is Student's paired test.

    Args:
        first: `[K, G]`.
        second: `[M, G]`.
        level: of confidence.
    """
    seeds = np.arange(first.shape[1])
    # Rounded, so that differences that are all the same are seen to be.
    mean = float(np.round(first[chosen(first), seeds] - second[chosen(second), seeds], 9).mean())
    gaps = np.round(first[:, None] - second[None], 9)
    means, errors, numbers = gaps.mean(-1), stats.sem(gaps, axis=-1), gaps.shape
    ways = np.array(numbers[:2])
    reach = stats.t.ppf(1 - (1 - level) / 2 / ways, len(seeds) - 1)
    low = (means - reach[0] * errors).min(1).max()
    high = (means + reach[1] * errors).max(0).min()
    above, below = (_one_sided(sign * means, errors, len(seeds)) for sign in (1, -1))
    # An estimate from two choices may, once in hundreds of times, lie beside what holds for the best.
    mean = min(max(mean, float(low)), float(high))
    p_value = 2 * min(ways[0] * above.max(1).min(), ways[1] * below.max(0).min())
    return Difference(mean, float(low), float(high), float(min(p_value, 1)))


def _one_sided(means: Array, errors: Array, number: int) -> Array:
    """P-values of means above 0; of values without any spread, those of a sign test, since few may agree by chance."""
    spread = np.divide(means, errors, out=np.zeros_like(means), where=errors > 0)
    found: Array = np.where(errors > 0, stats.t.sf(spread, number - 1), np.where(means > 0, 2.0**-number, 1))
    return found


def halves(number: int) -> NDArray[np.bool_]:
    """`[2, number]`: every other seed, and the rest."""
    first = np.arange(number) % 2 == 0
    return np.stack([first, ~first])


def chosen(values: Array) -> NDArray[np.int64]:
    """Of K alternatives `[K, G]` the best for each seed, by the mean over the half that the seed is not in: `[G]`.

    A choice among noisy means favours what it chooses; what the choice has not seen tells its worth without favour
    (cross-fitting: Chernozhukov et al. 2018, definition 3.1). One alternative needs no choice; else G is at least 2.
    """
    if len(values) == 1:
        return np.zeros(values.shape[1], dtype=np.int64)
    best = np.array([values[:, half].mean(1).argmax() for half in halves(values.shape[1])])
    mine: NDArray[np.int64] = best[halves(values.shape[1])[0].astype(int)]
    return mine
