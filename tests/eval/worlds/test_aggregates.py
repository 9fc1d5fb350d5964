"""Aggregates over worlds and tables of means, against hand-computed cases and simulated coverage."""

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from eval.worlds.aggregates import interquartile_gap, interquartile_mean, mean_intervals, probability_of_improvement
from neuroprior._statistics import mean_interval


def test_interquartile_means_are_paired_by_seed():
    """Of five worlds one is left out at each end, of four worlds too: whichever these are for a seed."""
    values = np.array([[0.0, 9.0, 2.0], [1.0, 1.0, 1.0], [2.0, 0.0, 0.0], [3.0, 2.0, 3.0], [50.0, 3.0, -50.0]])
    assert interquartile_mean(values) == pytest.approx(mean_interval([2, 2, 1]))
    first = np.array([[0.0, 1, 2], [3, 4, 5], [5, 6, 7], [9, 9, 9]])
    second = np.array([[2.0, 3, 5], [2, 3, 5], [8, 7, 9], [1, 0, 0]])
    assert interquartile_gap(first, second) == pytest.approx(mean_interval([4 - 2, 5 - 3, 6 - 5]))


def test_probability_of_improvement():
    first = np.array([[1.0, 2.0], [3.0, 1.0], [5.0, 5.0], [0.0, 1.0]])
    second = np.array([[0.0, 1.0], [3.0, 1.0], [4.0, 6.0], [1.0, 0.0]])
    # Better in 2 of 4 with one tie: 2.5; and the same with the other seed.
    assert probability_of_improvement(first, second) == pytest.approx((0.625, 0.625, 0.625))
    assert probability_of_improvement(second, first).mean == pytest.approx(0.375)
    # 3/4 and 1/4 with one degree of freedom: far wider than the possible.
    wide = np.array([[2, 0], [2, 0], [1, 1], [2, 0]])
    assert probability_of_improvement(wide, np.ones((4, 2))) == (0.5, 0.0, 1.0)
    assert probability_of_improvement(first + 9, second) == (1, 1, 1)


def test_aggregates_cover_at_their_level():
    # 14 worlds of unequal means and spread; 600 intervals, of which 0.945 hold the truth but for 1e-6.
    draw, repeats, seeds = np.random.default_rng(0), 600, 10
    level, spread = np.linspace(0, 1, 14)[:, None], np.linspace(0.02, 0.2, 14)[:, None]
    # The truth, of 10**5 seeds: its error is a hundredth of that of an interval.
    truth = float(stats.trim_mean(level + spread * draw.standard_normal((14, 10**5)), 0.25, axis=0).mean())
    better = float(stats.norm.cdf(0.05 / (spread * 2**0.5)).mean())
    held = np.zeros(2)
    for _ in range(repeats):
        first, second = level + spread * draw.standard_normal((2, 14, seeds))
        low, high = interquartile_mean(first)[1:]
        held[0] += low <= truth <= high
        low, high = probability_of_improvement(first + 0.05, second)[1:]
        held[1] += low <= better <= high
    assert (held >= stats.binom.ppf(1e-6, repeats, 0.945)).all()


def test_mean_intervals_of_a_frame():
    columns = {"world": [*"bbaabc"], "prior": [*"xxxxx", None], "score": [1.0, 2.0, 5.0, np.nan, 6.0, 3.0]}
    found = mean_intervals(pd.DataFrame(columns), ["world", "prior"], "score")
    assert found.columns.tolist() == ["world", "prior", "mean", "low", "high", "n"]
    assert found.world.tolist() == ["b", "a", "c"]
    assert found.n.tolist() == [3, 1, 1]
    assert tuple(found.loc[0, ["mean", "low", "high"]]) == pytest.approx(mean_interval([1, 2, 6]))
    assert found["mean"].tolist() == [3, 5, 3]
    assert found.loc[1:, ["low", "high"]].isna().all(axis=None)


Draw = Callable[[np.random.Generator, tuple[int, int]], np.ndarray]

BOUNDED = [
    # The values of units, their mean, and the least coverage of the nominal 95 % with 10 and with 20 units.
    pytest.param(lambda r, s: r.binomial(200, 0.9, s) / 200, 0.9, 0.94, 0.94, id="200 trials"),
    pytest.param(
        lambda r, s: r.binomial(200, r.beta(18, 2, s)) / 200, 0.9, 0.925, 0.93, id="200 trials, overdispersed"
    ),
    pytest.param(lambda r, s: r.beta(8, 2, s), 0.8, 0.93, 0.935, id="skewed"),
    pytest.param(lambda r, s: r.beta(1, 9, s), 0.1, 0.905, 0.92, id="at a bound"),
    pytest.param(lambda r, s: r.beta(0.5, 0.5, s), 0.5, 0.93, 0.94, id="two modes"),
    pytest.param(
        lambda r, s: r.binomial(200, np.where(r.random(s) < 0.3, 0.7, 0.9)) / 200, 0.84, 0.92, 0.93, id="a third fails"
    ),
]


@pytest.mark.parametrize("repeats", [4000, pytest.param(200_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("units", [10, 20])
@pytest.mark.parametrize(("draw", "mean", "least_of_10", "least_of_20"), BOUNDED)
def test_coverage_for_bounded_values(
    draw: Draw, mean: float, least_of_10: float, least_of_20: float, units: int, repeats: int
):
    """A correct interval misses the quantile with a probability of 1e-6: in 12 cases that is once in 80,000 runs."""
    frame = pd.DataFrame(draw(np.random.default_rng(units), (repeats, units))).melt(ignore_index=False)
    found = mean_intervals(frame.reset_index(), "index", "value")
    assert (found.n == units).all()
    hits = ((found.low <= mean + 1e-12) & (mean <= found.high + 1e-12)).sum()
    assert hits >= stats.binom.ppf(1e-6, repeats, least_of_10 if units == 10 else least_of_20)
