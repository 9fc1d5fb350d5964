"""Aggregates over worlds with Student's interval over seeds, and tables of means.

An aggregate over worlds that a single easy or hard world does not decide: Agarwal et al. 2021, Deep reinforcement
learning at the edge of the statistical precipice. Values are `[W, G]`, normalised scores in W worlds with G >= 2 seeds.
Seed g of one world is independent of seed g of another, and each seed gives one number.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import special, stats

from neuroprior._statistics import Interval, mean_interval

Array = NDArray[np.float64]


def interquartile_mean(values: Array) -> Interval:
    """Averages over the middle half of W worlds: without the int(W / 4) highest, and as many lowest, of each seed."""
    return mean_interval(stats.trim_mean(values, 0.25, axis=0))


def interquartile_gap(first: Array, second: Array) -> Interval:
    """Says how much higher the `interquartile_mean` of `first` is than that of `second`, paired by seed."""
    gap = stats.trim_mean(first, 0.25, axis=0) - stats.trim_mean(second, 0.25, axis=0)
    # Rounded, so that differences that are equal but for rounding errors have no spread.
    return mean_interval(np.round(gap, 12))


def probability_of_improvement(first: Array, second: Array) -> Interval:
    """Returns the share of worlds in which `first` is better than `second`; a tie counts one half."""
    mean, low, high = mean_interval(((first > second) + (first == second) / 2).mean(0))
    return Interval(mean, max(low, 0.0), min(high, 1.0))


def mean_intervals(frame: pd.DataFrame, by: str | Sequence[str], value: str) -> pd.DataFrame:
    """Averages a column of a table in each group of rows; see `mean_interval`.

    Args:
        frame: a row for each independent unit of each group.
        by: the column or columns that define the groups.
        value: the column of which the means are taken; missing values are left out.

    Returns:
        A row for each group, in order of appearance: the columns `by`, then `mean`, `low`, `high` and `n`, the number
        of units. `low` and `high` are NaN for fewer than two units.
    """
    by = [by] if isinstance(by, str) else list(by)
    means = frame.groupby(by, sort=False, dropna=False)[value].agg(mean="mean", error="sem", n="count")
    half = special.stdtrit(means["n"] - 1, 0.975) * means["error"]
    means = means.assign(low=means["mean"] - half, high=means["mean"] + half)
    columns: pd.DataFrame = means[["mean", "low", "high", "n"]].reset_index()
    return columns
