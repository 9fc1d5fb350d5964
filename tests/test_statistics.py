"""Intervals, paired differences and corrected p-values, against hand-computed cases and simulated coverage."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from neuroprior._statistics import (
    holm,
    mean_interval,
    paired_difference,
    ratio_difference,
    share_interval,
)
from tests.support.sources import refuses


def test_intervals_by_hand():
    """Student's t(0.975, 3) = 3.1824, the standard error of 1, 2, 3, 4 is sqrt(5/3) / 2; and Wilson's."""
    half = 3.182446 * (5 / 3) ** 0.5 / 2
    assert mean_interval([1, 2, 3, 4]) == pytest.approx((2.5, 2.5 - half, 2.5 + half))
    z, n = 1.959964, 10
    centre, half = (0.2 + z**2 / 2 / n) / (1 + z**2 / n), z / (1 + z**2 / n) * (0.16 / n + z**2 / 4 / n**2) ** 0.5
    assert share_interval(2, 10) == pytest.approx((0.2, centre - half, centre + half), abs=1e-6)


def test_intervals_cover_at_their_level():
    # 2,000 intervals of 95 %: their hits are binomial, and 1,900 - 5 standard deviations is 1,851 (p < 1e-6).
    draws = np.random.default_rng(0).normal(3, 2, (2000, 12))
    hits = sum(low <= 3 <= high for _, low, high in map(mean_interval, draws))
    assert 1851 < hits < 1949


def test_paired_difference():
    first, second = torch.tensor([3.0, 5.0, 8.0, 4.0]), torch.tensor([2.0, 5.0, 6.0, 3.0])
    found = paired_difference(first, second)
    assert (found.mean, found.low, found.high) == pytest.approx(mean_interval(first - second))
    # t = 1 / (sqrt(2/3) / 2) with 3 degrees of freedom.
    assert found.p_value == pytest.approx(0.0917, abs=1e-3)
    assert paired_difference([1, 2], [1, 2]).p_value == 1
    # Without spread, a sign test: five of five the same way, or the other.
    assert paired_difference([3.0] * 5, [1.0] * 5) == (2, 2, 2, 2 * 0.5**5)


def test_a_ratio_of_sums_by_hand():
    """Residuals -1.2, -1.8 and 3 about 12 / 15; t(0.975, 2) = 4.3027. With equal sizes it is the mean's interval."""
    found, error = ratio_difference([2, 3, 7], [4, 6, 5]), (1.5 * (1.44 + 3.24 + 9)) ** 0.5 / 15
    assert found[:3] == pytest.approx((0.8, 0.8 - 4.302653 * error, 0.8 + 4.302653 * error))
    assert found.p_value == pytest.approx(2 * stats.t.sf(0.8 / error, 2))
    # one of the units has just the ratio of all
    assert ratio_difference([1, 2, 3], [10, 10, 10])[:3] == pytest.approx([v / 10 for v in mean_interval([1, 2, 3])])


def test_holm_by_hand():
    """Of all tests, or of the smallest of more; each at least its own, at most 1, and in the order given."""
    assert holm([0.04, 0.01, 0.03]).tolist() == pytest.approx([0.06, 0.03, 0.06])
    assert holm([0.01, 0.2], tests=5).tolist() == pytest.approx([0.05, 0.8])
    assert holm(torch.tensor([0.9, 0.5, 0.6])).tolist() == [1, 1, 1]
    assert holm([]).tolist() == []


@pytest.mark.parametrize("kind", [list, torch.tensor, lambda values: torch.tensor(values, dtype=torch.double)])
def test_differences_that_are_equal_but_for_rounding_have_no_spread(kind: Callable[[list[float]], Any]):
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
        (lambda: mean_interval(["a", "b"]), "`values` must be numbers"),
        (lambda: mean_interval([1.0]), "`values` must be two numbers or more"),
        (lambda: mean_interval([1.0, np.nan]), "`values[1]` must be a number, got nan"),
        (lambda: paired_difference([1, 2], {}), "`second` must be numbers"),
        (lambda: paired_difference([1, 2], [1, 2, 3]), "`second` must have 2 values, as many as `first`, got 3"),
        (lambda: ratio_difference([1, 2], [1, -1]), "`sizes` must be at least 0"),
        (lambda: share_interval(3, 2), "`successes` must be at most 2"),
        (lambda: share_interval(-1, 2), "successes"),
        (lambda: share_interval(0, 0), "trials"),
        (lambda: holm([[0.1]]), "`p_values` must have the shape [M], got [1, 1]"),
        (lambda: holm([0.1, 1.5]), "`p_values[1]` must be from 0 to 1, got 1.5"),
        (lambda: holm([0.1, 0.2], tests=1), "`tests` must be at least 2"),
        (lambda: holm([0.01], tests=2.5), "tests"),
    ],
)
def test_what_cannot_be_is_refused(call: Callable[[], object], message: str):
    with refuses(message):
        call()
