"""Reliability by hand, of forecasters that know their probabilities, and of one that is too sure by a known amount."""

import math

import pytest
import torch
from scipy import stats

from neuroprior.behaviour.analysis.calibration import UNITS, reliability
from neuroprior.behaviour.analysis.statistics import ratio_difference, share_interval
from tests.support.sources import FALSE_ALARM, refuses, seeded

HAND = torch.tensor([[0.62, 0.38], [0.62, 0.38], [0.95, 0.05], [0.66, 0.34], [0.92, 0.08]]).double()


def test_by_hand():
    """Four bins have forecasts; places 0 and 2 are of one unit, 1 and 3 of another, 4 of a third."""
    actions, unit = torch.tensor([0, 1, 0, 0, 0]), torch.tensor([7, 8, 7, 8, 9])
    found = reliability(HAND.log(), actions, unit)
    assert [(round(b.low, 9), round(b.high, 9), b.number) for b in found.bins] == [
        (0, 0.1, 2),
        (0.3, 0.4, 3),
        (0.6, 0.7, 3),
        (0.9, 1, 2),
    ]
    assert [b.forecast for b in found.bins] == pytest.approx([0.065, 1.10 / 3, 1.90 / 3, 0.935])
    assert [b.taken.mean for b in found.bins] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    # Shares of 0 and 1 have Wilson's interval over the two units 7 and 9; the others that of a ratio, cut at 0 and 1.
    assert found.bins[0].taken == share_interval(0, 2)
    assert found.bins[3].taken == share_interval(2, 2)
    wide = ratio_difference([0, 1], [1, 2])
    assert found.bins[1].taken[1:] == pytest.approx((max(wide.low, 0), min(wide.high, 1)))
    error = 2 * (0.13 + 0.10) / 10
    assert found.expected_calibration_error == pytest.approx(error)


def test_units_not_forecasts_are_the_trials_of_a_share_without_spread():
    """Six places of two units: an action that was never taken, and one that always was."""
    log_probs = torch.tensor([[0.9, 0.1]]).double().log().expand(6, 2)
    found = reliability(log_probs, torch.zeros(6).long(), torch.tensor([0, 0, 0, 1, 1, 1]), 2).bins
    assert [b.taken for b in found] == [share_interval(0, 2), share_interval(2, 2)]
    assert [b.number for b in found] == [6, 6]


def test_edges_and_certainty():
    """A forecast on an edge belongs above it; 0 and 1 are forecasts."""
    log_probs = torch.tensor([[0.5, 0.5], [0.0, 1.0]]).double().log()
    found = reliability(log_probs, torch.tensor([0, 1]), torch.tensor([0, 1]), 2)
    assert [(b.low, b.high, b.number, b.forecast) for b in found.bins] == [
        (0, 0.5, 1, 0),
        (0.5, 1, 3, pytest.approx(2 / 3)),
    ]
    assert [b.taken.mean for b in found.bins] == [0, pytest.approx(2 / 3)]


def test_one_unit_has_no_interval():
    (found,) = reliability(torch.tensor([[0.5, 0.5]]).log(), torch.tensor([0]), torch.tensor([3]), 1).bins
    assert found.taken.mean == 0.5
    assert math.isnan(found.taken.low)
    assert math.isnan(found.taken.high)


def forecasts(places: int, num_actions: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Random forecasts `[M, A]` (nats) and actions drawn from them."""
    generator = seeded(seed)
    log_probs = (2 * torch.randn(places, num_actions, generator=generator)).log_softmax(-1)
    return log_probs, torch.multinomial(log_probs.exp(), 1, generator=generator)[:, 0]


def test_folds_add_up():
    """In parts or at once, and with any chunk size."""
    log_probs, actions = forecasts(500, 4, 0)
    unit = torch.arange(500) // 7
    whole = reliability(log_probs, actions, unit)
    cut = [reliability(log_probs[s], actions[s], unit[s]) for s in (slice(0, 123), slice(123, 500))]
    torch.testing.assert_close((cut[0] + cut[1]).sums, whole.sums)
    torch.testing.assert_close(reliability(log_probs, actions, unit, chunk_size=100).sums, whole.sums)
    torch.testing.assert_close(reliability(log_probs, actions, unit - 3 * UNITS, chunk_size=100).sums, whole.sums)
    assert whole.sums.shape == (UNITS, 10, 3)
    assert whole.sums[..., 2].sum() == 2000
    assert whole.sums[..., 1].sum() == 500
    assert whole.sums[..., 0].sum() == pytest.approx(500, rel=1e-6)
    with refuses("bins", "10 and 5"):
        whole + reliability(log_probs, actions, unit, 5)


@pytest.mark.parametrize("num_actions", [2, 6])
def test_intervals_of_a_calibrated_forecaster(num_actions):
    """100 sets: about 95 % of the intervals of each bin have its mean forecast in them."""
    hits, sets = torch.zeros(10), 100
    for seed in range(sets):
        log_probs, actions = forecasts(3000, num_actions, seed)
        found = reliability(log_probs, actions, torch.arange(3000) // 30).bins
        assert len(found) == 10
        hits += torch.tensor([b.taken.low <= b.forecast <= b.taken.high for b in found])
    assert (hits >= stats.binom.ppf(FALSE_ALARM / 10, sets, 0.91)).all()
    assert hits.sum() <= stats.binom.isf(FALSE_ALARM, 10 * sets, 0.98)


def test_a_calibrated_forecaster_has_little_error():
    log_probs, actions = forecasts(200_000, 3, 1)
    assert reliability(log_probs, actions, torch.arange(200_000) // 100).expected_calibration_error < 0.003


@pytest.mark.parametrize("p", [0.55, 0.6, 0.75])
def test_a_forecaster_that_is_too_sure(p):
    """At temperature 0.5 p becomes p**2 / (p**2 + (1 - p)**2): the error is the gap, the same for p and for 1 - p."""
    log_probs = torch.tensor([[p, 1 - p]], dtype=torch.double).log().expand(1000, 2)
    actions = (torch.arange(1000) >= round(1000 * p)).long()
    sure = reliability((2 * log_probs).log_softmax(-1), actions, torch.arange(1000))
    said = p**2 / (p**2 + (1 - p) ** 2)
    assert sure.expected_calibration_error == pytest.approx(said - p)
    assert [b.forecast for b in sure.bins] == pytest.approx([1 - said, said])
    assert [b.taken.mean for b in sure.bins] == pytest.approx([1 - p, p])
    assert sure.bins[1].taken.high < said
    exact = reliability(log_probs, actions, torch.arange(1000))
    assert exact.expected_calibration_error == pytest.approx(0, abs=1e-9)


def test_many_places_of_many_actions():
    """A uniform forecaster: one bin, in which each action was taken as often as it was forecast."""
    log_probs = torch.full((40_000, 57), -math.log(57))
    (found,) = reliability(log_probs, torch.arange(40_000) % 57, torch.arange(40_000)).bins
    assert found.number == 40_000 * 57
    assert found.forecast == pytest.approx(1 / 57, rel=1e-5)
    assert found.taken == pytest.approx((1 / 57,) * 3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"log_probs": HAND.log()[0]}, ["log_probs", "[M, A]"]),
        ({"log_probs": (HAND > 1).long()}, ["log_probs", "floating point"]),
        ({"log_probs": HAND.log()[:0]}, ["log_probs"]),
        ({"log_probs": HAND}, ["log_probs[0]", "not 1", "log_softmax"]),
        ({"log_probs": HAND.log().clone().index_fill_(0, torch.tensor(3), math.nan)}, ["log_probs[3]", "nan"]),
        ({"actions": torch.tensor([0, 1, 2, 0, 0])}, ["actions[2]: 2"]),
        ({"actions": torch.zeros(5)}, ["actions", "integers"]),
        ({"unit": torch.arange(4)}, ["unit", "[5]"]),
        ({"bins": 0}, ["bins"]),
    ],
)
def test_bad_input(change, words):
    given = {"log_probs": HAND.log(), "actions": torch.zeros(5).long(), "unit": torch.arange(5)} | change
    for chunk_size in (2**22, 4):  # of two places
        with refuses(*words):
            reliability(**given, chunk_size=chunk_size)
