"""Shares of best, intervals and paired differences, against hand-computed cases and simulated coverage."""

import numpy as np
import pytest
import torch

from neuroprior.analysis.statistics import best_of, mean_interval, paired_difference, share_interval


def test_ties_count_for_each() -> None:
    scores = torch.tensor([[1.0, 2.0, 3.0], [1.0, 1.0, 5.0], [0.0, 2.0, 9.0]])
    assert best_of(scores).tolist() == [[True, True, False], [True, False, False], [False, True, True]]
    assert best_of(scores, [0, 1]).tolist() == [[True, True, False], [True, False, True], [False, True, True]]


def test_mean_interval_is_students() -> None:
    # t(0.975, 3) = 3.1824; the standard error of 1, 2, 3, 4 is sqrt(5/3) / 2.
    half = 3.182446 * (5 / 3) ** 0.5 / 2
    assert mean_interval([1, 2, 3, 4]) == pytest.approx((2.5, 2.5 - half, 2.5 + half))


def test_share_interval_is_wilsons() -> None:
    z, n = 1.959964, 10
    centre, half = (0.2 + z**2 / 2 / n) / (1 + z**2 / n), z / (1 + z**2 / n) * (0.16 / n + z**2 / 4 / n**2) ** 0.5
    assert share_interval(2, 10) == pytest.approx((0.2, centre - half, centre + half), abs=1e-6)


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


@pytest.mark.parametrize("call", [lambda: mean_interval([1.0]), lambda: paired_difference([1, 2], [1, 2, 3])])
def test_too_few_values(call) -> None:
    with pytest.raises(ValueError, match="values"):
        call()


@pytest.mark.parametrize(("successes", "trials"), [(3, 2), (-1, 2), (0, 0)])
def test_impossible_shares(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match="share_interval"):
        share_interval(successes, trials)
