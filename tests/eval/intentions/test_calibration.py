"""Calibration by hand, of forecasters that know their probabilities, and of one that is too sure by a known amount."""

import math

import pytest
import torch
from scipy import stats

from eval.intentions.calibration import calibration_error, count_forecasts, filled_bins
from neuroprior._statistics import ratio_difference, share_interval
from tests.support.sources import FALSE_ALARM, seeded


def of_units(log_probs: torch.Tensor, outcome: torch.Tensor, unit: torch.Tensor, bins: int = 10) -> torch.Tensor:
    """The sums of each unit `[G, bins, 3]`."""
    return torch.stack([count_forecasts(log_probs[unit == u], outcome[unit == u], bins) for u in unit.unique()])


def test_by_hand():
    """Four bins have forecasts; places 0 and 2 are of one unit, 1 and 3 of another, 4 of a third."""
    probs = torch.tensor([[0.62, 0.38], [0.62, 0.38], [0.95, 0.05], [0.66, 0.34], [0.92, 0.08]]).double()
    sums = of_units(probs.log(), torch.tensor([0, 1, 0, 0, 0]), torch.tensor([7, 8, 7, 8, 9]))
    assert sums[..., 2].sum(0).tolist() == [2, 0, 0, 3, 0, 0, 3, 0, 0, 2]
    found = filled_bins(sums)
    assert [b.forecast for b in found] == pytest.approx([0.065, 1.10 / 3, 1.90 / 3, 0.935])
    assert [b.true.mean for b in found] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    # Shares of 0 and 1 have Wilson's interval over the two units 7 and 9; the others that of a ratio, cut at 0 and 1.
    assert found[0].true == share_interval(0, 2)
    assert found[3].true == share_interval(2, 2)
    wide = ratio_difference([0, 1], [1, 2])
    assert found[1].true[1:] == pytest.approx((max(wide.low, 0), min(wide.high, 1)))
    assert calibration_error(sums) == pytest.approx(2 * (0.13 + 0.10) / 10)


def test_edges_certainty_and_a_single_unit():
    """A forecast on an edge belongs above it; 0 and 1 are forecasts; one unit has no interval."""
    log_probs = torch.tensor([[0.5, 0.5], [0.0, 1.0]]).double().log()
    found = filled_bins(count_forecasts(log_probs, torch.tensor([0, 1]), 2)[None])
    assert [b.forecast for b in found] == pytest.approx([0, 2 / 3])
    assert [b.true.mean for b in found] == pytest.approx([0, 2 / 3])
    assert all(map(math.isnan, found[1].true[1:]))


@pytest.mark.parametrize("num_outcomes", [2, 6])
def test_intervals_of_a_calibrated_forecaster(num_outcomes):
    """100 sets: about 95 % of the intervals of each bin have its mean forecast in them, and the error is small."""
    hits, sets, whole = torch.zeros(10), 100, []
    for seed in range(sets):
        generator = seeded(seed)
        log_probs = (2 * torch.randn(3000, num_outcomes, generator=generator)).log_softmax(-1)
        outcome = torch.multinomial(log_probs.exp(), 1, generator=generator)[:, 0]
        sums = of_units(log_probs, outcome, torch.arange(3000) // 30)
        hits += torch.tensor([b.true.low <= b.forecast <= b.true.high for b in filled_bins(sums)])
        whole.append(sums.sum(0))
    assert (hits >= stats.binom.ppf(FALSE_ALARM / 10, sets, 0.91)).all()
    assert hits.sum() <= stats.binom.isf(FALSE_ALARM, 10 * sets, 0.98)
    assert calibration_error(torch.stack(whole)) < 0.003


@pytest.mark.parametrize("p", [0.55, 0.6, 0.75])
def test_a_forecaster_that_is_too_sure(p):
    """At temperature 0.5 p becomes p**2 / (p**2 + (1 - p)**2): the error is the gap, the same for p and for 1 - p."""
    log_probs = torch.tensor([[p, 1 - p]], dtype=torch.double).log().expand(1000, 2)
    outcome = (torch.arange(1000) >= round(1000 * p)).long()
    said = p**2 / (p**2 + (1 - p) ** 2)
    sure = of_units((2 * log_probs).log_softmax(-1), outcome, torch.arange(1000))
    assert calibration_error(sure) == pytest.approx(said - p)
    assert filled_bins(sure)[1].true.high < said
    assert calibration_error(of_units(log_probs, outcome, torch.arange(1000))) == pytest.approx(0, abs=1e-9)
