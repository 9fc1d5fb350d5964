"""Shares of best, intervals and paired differences, against hand-computed cases and simulated coverage."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from neuroprior.behaviour.analysis.statistics import (
    best_of,
    holm,
    interquartile_gap,
    interquartile_mean,
    mean_interval,
    mean_intervals,
    paired_difference,
    probability_of_improvement,
    ratio_difference,
    share_interval,
)


def test_ties_count_for_each() -> None:
    scores = torch.tensor([[1.0, 2.0, 3.0], [1.0, 1.0, 5.0], [0.0, 2.0, 9.0]])
    assert best_of(scores).tolist() == [[True, True, False], [True, False, False], [False, True, True]]
    assert best_of(scores, [0, 1]).tolist() == [[True, True, False], [True, False, True], [False, True, True]]


def test_mean_interval_is_students() -> None:
    # t(0.975, 3) = 3.1824; the standard error of 1, 2, 3, 4 is sqrt(5/3) / 2.
    half = 3.182446 * (5 / 3) ** 0.5 / 2
    assert mean_interval([1, 2, 3, 4]) == pytest.approx((2.5, 2.5 - half, 2.5 + half))


HIGH, LOW = np.array([[3.0, 5, 8, 4], [1.0, 2, 9, 4], [0.0, 7, 1, 2]]), np.array([[2.0, 6, 6, 3]] * 3)


@pytest.mark.parametrize(
    "interval",
    [
        lambda level: mean_interval(HIGH[0], level),
        lambda level: interquartile_mean(HIGH, level),
        lambda level: interquartile_gap(HIGH, LOW, level),
        lambda level: probability_of_improvement(HIGH, LOW, level),
        lambda level: paired_difference(HIGH[0], LOW[0], level),
        lambda level: ratio_difference(HIGH[0], LOW[0], level),
    ],
)
def test_widths_are_those_of_the_level(interval: Callable[[float], tuple[float, ...]]) -> None:
    """With four units, quantiles of Student's t of three degrees of freedom; none of these intervals is cut."""
    wide, narrow = interval(0.5), interval(0.2)
    assert wide[0] == narrow[0]
    assert wide[3:] == narrow[3:]  # the p-value
    for k, sign in ((1, -1), (2, 1)):
        assert sign * (narrow[k] - narrow[0]) > 0
        assert (wide[k] - wide[0]) / (narrow[k] - narrow[0]) == pytest.approx(
            stats.t.ppf(0.75, 3) / stats.t.ppf(0.6, 3)
        )


def test_interquartile_gap_is_paired_by_seed() -> None:
    """Of four worlds the highest and the lowest are left out, of each method's own: 4 - 2, 5 - 3 and 6 - 5."""
    first = [[0.0, 1, 2], [3, 4, 5], [5, 6, 7], [9, 9, 9]]
    second = [[2.0, 3, 5], [2, 3, 5], [8, 7, 9], [1, 0, 0]]
    assert interquartile_gap(first, second) == pytest.approx(mean_interval([4 - 2, 5 - 3, 6 - 5]))
    with pytest.raises(ValueError, match=r"second: shape \[4, 3\], that of first, is expected, not \[3, 3\]"):
        interquartile_gap(first, second[1:])


def test_share_interval_is_wilsons() -> None:
    z, n = 1.959964, 10
    centre, half = (0.2 + z**2 / 2 / n) / (1 + z**2 / n), z / (1 + z**2 / n) * (0.16 / n + z**2 / 4 / n**2) ** 0.5
    assert share_interval(2, 10) == pytest.approx((0.2, centre - half, centre + half), abs=1e-6)
    sure = math.erf(1 / math.sqrt(2))  # of one standard deviation: z = 1
    centre, half = 0.25 / 1.1, (0.016 + 1 / 400) ** 0.5 / 1.1
    assert share_interval(2, 10, sure) == pytest.approx((0.2, centre - half, centre + half))


def test_intervals_cover_at_their_level() -> None:
    # 2,000 intervals of 95 %: their hits are binomial, and 1,900 - 5 standard deviations is 1,851 (p < 1e-6).
    draws = np.random.default_rng(0).normal(3, 2, (2000, 12))
    hits = sum(low <= 3 <= high for _, low, high in map(mean_interval, draws))
    assert 1851 < hits < 1949


def test_paired_difference() -> None:
    first, second = torch.tensor([3.0, 5.0, 8.0, 4.0]), torch.tensor([2.0, 5.0, 6.0, 3.0])
    found = paired_difference(first, second)
    assert (found.mean, found.low, found.high) == pytest.approx(mean_interval(first - second))
    # t = 1 / (sqrt(2/3) / 2) with 3 degrees of freedom.
    assert found.p_value == pytest.approx(0.0917, abs=1e-3)
    assert paired_difference([1, 2], [1, 2]).p_value == 1
    # Without spread, a sign test: five of five the same way, or the other.
    assert paired_difference([3.0] * 5, [1.0] * 5) == (2, 2, 2, 2 * 0.5**5)


@pytest.mark.parametrize("call", [lambda: mean_interval([1.0]), lambda: paired_difference([1, 2], [1, 2, 3])])
def test_too_few_values(call) -> None:
    with pytest.raises(ValueError, match="values"):
        call()


@pytest.mark.parametrize(("successes", "trials"), [(3, 2), (-1, 2), (0, 0)])
def test_impossible_shares(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match=r"successes|trials"):
        share_interval(successes, trials)


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


def hits(draw: Draw, mean: float, units: int, repeats: int) -> int:
    """How many of so many intervals hold the mean."""
    frame = pd.DataFrame(draw(np.random.default_rng(units), (repeats, units))).melt(ignore_index=False)
    found = mean_intervals(frame.reset_index(), "index", "value")
    assert len(found) == repeats
    assert (found.n == units).all()
    return int(((found.low <= mean + 1e-12) & (mean <= found.high + 1e-12)).sum())


@pytest.mark.parametrize("repeats", [4000, pytest.param(200_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("units", [10, 20])
@pytest.mark.parametrize(("draw", "mean", "least_of_10", "least_of_20"), BOUNDED)
def test_coverage_for_bounded_values(
    draw: Draw, mean: float, least_of_10: float, least_of_20: float, units: int, repeats: int
) -> None:
    # A correct interval misses the quantile with a probability of 1e-6: in 12 cases that is once in 80,000 runs.
    least = least_of_10 if units == 10 else least_of_20
    assert hits(draw, mean, units, repeats) >= stats.binom.ppf(1e-6, repeats, least)


def test_mean_intervals_of_a_frame() -> None:
    frame = pd.DataFrame(
        {
            "world": ["b", "b", "a", "a", "b", "c"],
            "prior": ["x", "x", "x", "x", "x", None],
            "score": [1.0, 2.0, 5.0, np.nan, 6.0, 3.0],
        }
    )
    found = mean_intervals(frame, ["world", "prior"], "score")
    assert found.columns.tolist() == ["world", "prior", "mean", "low", "high", "n"]
    assert found.world.tolist() == ["b", "a", "c"]
    assert found.n.tolist() == [3, 1, 1]
    assert tuple(found.loc[0, ["mean", "low", "high"]]) == pytest.approx(mean_interval([1, 2, 6]))
    assert found["mean"].tolist() == [3, 5, 3]
    assert found.loc[1:, ["low", "high"]].isna().all(axis=None)
    assert mean_intervals(frame, "world", "score", level=0.5).high[0] == pytest.approx(
        mean_interval([1, 2, 6], 0.5).high
    )


def test_interquartile_mean() -> None:
    # Of five worlds one is left out at each end, whichever these are for a seed.
    values = np.array([[0.0, 9.0, 2.0], [1.0, 1.0, 1.0], [2.0, 0.0, 0.0], [3.0, 2.0, 3.0], [50.0, 3.0, -50.0]])
    assert interquartile_mean(values) == pytest.approx(mean_interval([2, 2, 1]))
    assert interquartile_mean(torch.tensor(values[:3]), 0.9) == pytest.approx(mean_interval([1, 10 / 3, 1], 0.9))


def test_probability_of_improvement() -> None:
    first = np.array([[1.0, 2.0], [3.0, 1.0], [5.0, 5.0], [0.0, 1.0]])
    second = np.array([[0.0, 1.0], [3.0, 1.0], [4.0, 6.0], [1.0, 0.0]])
    # Better in 2 of 4 with one tie: 2.5; and the same with the other seed.
    assert probability_of_improvement(first, second) == pytest.approx((0.625, 0.625, 0.625))
    assert probability_of_improvement(second, first).mean == pytest.approx(0.375)
    # 3/4 and 1/4 with one degree of freedom: far wider than the possible.
    assert probability_of_improvement([[2, 0], [2, 0], [1, 1], [2, 0]], np.ones((4, 2)), 0.95) == (0.5, 0.0, 1.0)
    assert probability_of_improvement(first + 9, second) == (1, 1, 1)


def test_aggregates_cover_at_their_level() -> None:
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


@pytest.mark.parametrize("values", [[1.0, 2.0], [[1.0], [2.0]], np.zeros((0, 3)), [[1.0, float("nan")]]])
def test_aggregates_refuse_other_values(values: list[float]) -> None:
    with pytest.raises(ValueError, match="values"):
        interquartile_mean(values)
    with pytest.raises(ValueError, match="first"):
        probability_of_improvement(values, values)


def test_improvement_needs_equal_shapes() -> None:
    with pytest.raises(ValueError, match="second: shape"):
        probability_of_improvement(np.zeros((3, 2)), np.zeros((2, 2)))


@pytest.mark.parametrize("kind", [list, torch.tensor, lambda values: torch.tensor(values, dtype=torch.double)])
def test_differences_that_are_equal_but_for_rounding_have_no_spread(kind: Callable[[list[float]], Any]) -> None:
    """Student's test would be certain of three of them; a sign test is not."""
    one, other = kind([0.7, 0.8, 0.9]), kind([0.6, 0.7, 0.8])
    found = paired_difference(one, other)
    assert found == (pytest.approx(0.1), pytest.approx(0.1), pytest.approx(0.1), 0.25)
    assert paired_difference(one, one) == (0, 0, 0, 1)
    ratio = ratio_difference(kind([0.1, 0.2, 0.3]), kind([1.0, 2.0, 3.0]))
    assert ratio == (pytest.approx(0.1), pytest.approx(0.1), pytest.approx(0.1), 0.25)
    # a spread that is small but there is tested as ever, and so are small differences between large numbers
    large = kind([2.0**20 + k for k in range(20)])
    assert paired_difference([one + 1 for one in large], large)[::3] == (1, 2.0**-19)
    some = kind([1e6 + 10 * k + 0.75 * (k % 2) for k in range(20)])
    mean, *_, p_value = paired_difference(some, kind([1e6 + 10 * k for k in range(20)]))
    assert (mean, p_value) == (pytest.approx(0.375), pytest.approx(0.00034, rel=0.05))
    apart = paired_difference(kind([0.7, 0.8, 0.9001]), other)
    expected = stats.ttest_rel(np.asarray([0.7, 0.8, 0.9001]), np.asarray([0.6, 0.7, 0.8])).pvalue
    assert apart.p_value == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mean_interval(["a", "b"]), "^values: numbers, shape .G., are expected"),
        (lambda: paired_difference([1, 2], {}), "^second: "),
        (lambda: holm([0.01], tests=2.5), "^`tests` must be an integer"),  # type: ignore[arg-type]
        (lambda: holm([0.01], tests="a"), "^`tests` must be an integer"),  # type: ignore[arg-type]
    ],
)
def test_what_are_no_numbers_is_said(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_scores_in_a_list() -> None:
    assert best_of([[0.9, 0.5], [0.8, 0.7]]).tolist() == [[True, False], [False, True]]  # type: ignore[arg-type]
