"""Priors over vectors: bounds of any place and width, values at the bounds, and what a caller may give."""

from math import inf, nan

import numpy as np
import pytest
import torch

from neuroprior.control import AutoregressivePrior, NoisePrior, StoredWindows, VectorGRU, VectorPlans, VectorPrior
from neuroprior.priors import load, save
from neuroprior.testing import check_prior
from tests.support.sources import seeded

LINEAR = {
    "noise": lambda low, high: NoisePrior(low, high, None, memory=4),
    "autoregressive": lambda low, high: AutoregressivePrior(low, high, 2),
}
CLOSED = LINEAR | {"stored windows": lambda low, high: StoredWindows(low, high, 2, 4, max_windows=6)}
WIDE = CLOSED | {"stored windows": lambda low, high: StoredWindows(low, high, 2, 10)}
KINDS = CLOSED | {"gru": lambda low, high: VectorGRU(low, high, width=8)}


def source(low, high, num=10, length=30, seed=0):
    """A random walk that is drawn back, a tenth of whose values are exactly at a bound."""
    low, high = torch.tensor([low]), torch.tensor([high])
    now, rows = torch.zeros(num, 1), []
    noise = 0.4 * torch.randn(num, length, 1, generator=seeded(seed))
    for t in range(length):
        now = (0.9 * now + noise[:, t]).clamp(-1, 1)
        rows.append(now)
    share = torch.stack(rows, 1)
    values = ((low + high) / 2 + (high - low) / 2 * share).clamp(low, high)
    values = torch.where(share <= -1, low, torch.where(share >= 1, high, values))
    return VectorPlans(values, low, high)


@pytest.mark.parametrize("bounds", [(100.1, 101.3), (-1e-6, 1e-6), (-1e6, 1e6)])  # far from 0, narrow, wide
@pytest.mark.parametrize("kind", CLOSED)
def test_conformance_between_any_bounds(kind, bounds):
    """A mass at a bound is one in scores as in samples, wherever the bounds are: rounding must not move it beside."""
    plans = source(*bounds)
    prior = CLOSED[kind](plans.action_low, plans.action_high).fit(plans, generator=seeded(0))
    check_prior(prior, length=3, num_plans=400)


@pytest.mark.parametrize("kind", KINDS)
def test_vectors_of_one_number_are_saved(kind, tmp_path):
    plans = source(-2.0, 5.0)
    prior = KINDS[kind](plans.action_low, plans.action_high)
    prior.fit(plans, generator=seeded(0), **({"max_steps": 2, "progress": False} if kind == "gru" else {}))
    again = load(save(prior, tmp_path), kind=VectorPrior)
    assert again.action_log_probs(plans).equal(prior.action_log_probs(plans))


@pytest.mark.parametrize("kind", CLOSED)
def test_densities_are_the_same_in_other_units(kind):
    """Nats of the same plans between other bounds differ by the logarithm of the ratio of ranges, of numbers inside."""
    plans = source(-1.0, 1.0)
    other = source(100.1, 101.3)
    nats = [
        CLOSED[kind](each.action_low, each.action_high).fit(each, generator=seeded(0)).action_log_probs(each)
        for each in (plans, other)
    ]
    inside = (plans.actions.abs() < 1)[..., 0]
    half = float(other.action_high - other.action_low) / 2
    expected = nats[0] - inside * torch.tensor(half).log()
    assert (~inside).sum() > 10
    assert (nats[1] - expected).abs().max() < 0.05


@pytest.mark.parametrize(
    ("low", "high"), [(-3e38, 3e38), (1000.0, 1000.0001), (-inf, 1.0), (0.0, 1e-40), (2e38, 3.3e38)]
)
def test_ranges_that_float32_does_not_resolve_are_refused(low, high):
    with pytest.raises(ValueError, match="action_low"):
        NoisePrior([low], [high])
    with pytest.raises(ValueError, match="action_low"):
        VectorPlans(torch.full((1, 2, 1), 1000.0), [low], [high])


def test_a_millionth_of_the_range_beyond_the_bounds_is_rounding():
    assert float(VectorPlans(torch.full((1, 1, 1), 1 + 1.5e-6), [-1.0], [1.0]).actions) == 1
    with pytest.raises(ValueError, match="`actions` must be between the bounds -1 and 1"):
        VectorPlans(torch.full((1, 1, 1), 1 + 4e-6), [-1.0], [1.0])


def test_bounds_are_compared_by_their_range():
    plans = VectorPlans(torch.full((2, 3, 1), 1000.5), [1000.0], [1001.0])
    with pytest.raises(ValueError, match="action_low"):
        NoisePrior([1000.005], [1001.0]).log_prob(plans)
    assert NoisePrior([1000.0], [1001.0]).log_prob(plans).isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_past_of_any_numbers(kind):
    prior, past = KINDS[kind]([-1.0], [1.0]), torch.tensor([[[0.0], [1.0]], [[-1.0], [1.0]]])
    expected = prior.sample(3, 2, past=past, generator=seeded(0))
    assert expected.dtype == torch.float32
    for same in (past.double(), past.long(), past.numpy(), past.numpy().astype(np.float16), past.tolist()):
        assert prior.sample(3, 2, past=same, generator=seeded(0)).equal(expected)
    assert prior.sample(3, 2, past=past[:0], generator=seeded(0)).shape == (0, 3, 2, 1)
    forecast, _ = prior.step(torch.zeros(0, 1), prior.start(0)[1])
    assert forecast.log_prob(torch.zeros(0, 1)).shape == (0,)


@pytest.mark.parametrize(
    ("past", "said"),
    [
        (torch.full((1, 2, 1), 1.5), "`past` must be between the bounds -1 and 1 of dimension 0, got 1.5 at"),
        (torch.full((1, 2, 1), nan), "`past`"),
        (torch.zeros(1, 2), r"`past` must have shape \[B, T, 1\]"),
        ("abc", "`past` must be numbers"),
    ],
)
def test_what_is_no_past_is_refused(past, said):
    with pytest.raises(ValueError, match=said):
        NoisePrior([-1.0], [1.0]).sample(2, 3, past=past)


def test_contexts_that_do_not_fit_the_past_are_refused():
    prior, past = VectorGRU([-1.0], [1.0], 2), torch.zeros(3, 4, 1)
    assert prior.sample(2, 3, torch.zeros(3, 5, 2).numpy(), past=past.numpy()).shape == (3, 2, 3, 1)
    for rows in (1, 3, 4, 6, 9):
        with pytest.raises(ValueError, match=r"`context` must have shape \[3, 5, 2\]"):
            prior.sample(2, 3, torch.zeros(3, rows, 2), past=past)
    for bad in (torch.full((3, 2), nan), torch.full((3, 5, 2), inf)):
        with pytest.raises(ValueError, match=r"`context` must be finite"):
            prior.sample(2, 3, bad, past=past)
    for wrong in ("abc", torch.zeros(3, 2, dtype=torch.bool), torch.zeros(2, 2), torch.zeros(3, 3), None):
        with pytest.raises(ValueError, match="`context`"):
            prior.sample(2, 3, wrong, past=past)


@pytest.mark.parametrize("num", [1, 10])
def test_stored_windows_where_too_few_plans_can_be_held_out(num):
    """One run just longer than a window, or one long plan among short ones, can be learned from."""
    plans = source(-1.0, 1.0, num, 26)
    lengths = torch.tensor([26] + [5] * (num - 1))
    few = VectorPlans(plans.actions, plans.action_low, plans.action_high, lengths)
    for seed in range(5):
        prior = StoredWindows([-1.0], [1.0]).fit(few, generator=seeded(seed))
        assert len(prior.segments) == 3
        assert prior.log_prob(few).isfinite().all()


def walk(num, seed, scale=0.05, dims=2, rho=0.8):
    """An autoregression of order 1, kept between -1 and 1."""
    noise, rows = scale * torch.randn(num, 60, dims, generator=seeded(seed)), [torch.zeros(num, dims)]
    for t in range(1, 60):
        rows.append((rho * rows[-1] + noise[:, t]).clamp(-1, 1))
    return torch.stack(rows, 1)


@pytest.mark.parametrize("kind", WIDE)
def test_wide_bounds_make_no_difference(kind):
    """Bounds of simulators are sometimes far wider than what is done."""
    values, found, spread = walk(20, 0), [], []
    for most in (10.0, 1000.0):
        plans = VectorPlans(values, [-most] * 2, [most] * 2)
        prior = WIDE[kind](plans.action_low, plans.action_high).fit(plans, generator=seeded(0))
        found.append(float(prior.log_prob(plans).mean()))
        spread.append(float(prior.sample(500, 20, generator=seeded(1)).std()))
    assert found[1] == pytest.approx(found[0], abs=0.1)
    assert spread[1] == pytest.approx(spread[0], rel=1e-3)
    assert spread[0] == pytest.approx(float(values.std()), rel=0.3)


def test_a_network_that_wide_bounds_make_coarse_says_so():
    plans = VectorPlans(walk(6, 0), [-1.0, -100.0], [1.0, 100.0])
    with pytest.warns(UserWarning, match=r"dimension 1 .* narrower bounds"):
        VectorGRU(plans.action_low, plans.action_high, width=4).fit(plans, max_steps=2, progress=False)


def test_stored_windows_are_followed_in_each_dimension_as_closely_as_it_varies():
    values = torch.cat([walk(20, 0, 0.25, 1, 0.9), walk(20, 1, 0.01, 1, 0.9), torch.full((20, 60, 1), 0.25)], 2)
    prior = StoredWindows([-1.0] * 3, [1.0] * 3).fit(VectorPlans(values, [-1.0] * 3, [1.0] * 3), generator=seeded(0))
    own, drawn = values.std((0, 1)), prior.sample(200, 60, generator=seeded(1))[0].std((0, 1))
    assert drawn[:2].tolist() == pytest.approx(own[:2].tolist(), rel=0.4)
    assert drawn[2] < 0.02


@pytest.mark.parametrize("kind", [NoisePrior, AutoregressivePrior])
def test_vectors_beyond_the_bounds_count_as_such(kind):
    """The censored Gaussian with standard deviation 2: five standard errors of 20,000 draws are about .1."""
    values = (2 * torch.randn(400, 50, 1, generator=seeded(0)) + 0.5).clamp(-1, 1)
    plans = VectorPlans(values, [-1.0], [1.0])
    prior = kind([-1.0], [1.0]).fit(plans, generator=seeded(0))
    forecast, _ = prior.read(torch.zeros(1, 3, 1))
    assert float(forecast.mean) == pytest.approx(0.5, abs=0.1)
    assert float(forecast.std) == pytest.approx(2.0, abs=0.1)
    drawn = prior.sample(20_000, 1, generator=seeded(1))
    assert float((drawn == 1).float().mean()) == pytest.approx(float((values == 1).float().mean()), abs=0.025)


@pytest.mark.parametrize("make", [AutoregressivePrior, KINDS["noise"]])
def test_settings_that_are_compared_one_by_one_are_the_same(make, monkeypatch):
    plans = VectorPlans(walk(12, 0, 0.6, 3), [-1.0] * 3, [1.0] * 3)
    together = make([-1.0] * 3, [1.0] * 3).fit(plans, generator=seeded(0))
    monkeypatch.setattr("neuroprior.control.priors.linear_gaussian.MAX_NUMBERS_AT_ONCE", 1)
    alone = make([-1.0] * 3, [1.0] * 3).fit(plans, generator=seeded(0))
    assert alone.log_prob(plans).equal(together.log_prob(plans))


def test_a_censored_autoregression_is_recovered():
    plans = VectorPlans(walk(400, 0, 1.0, 1), [-1.0], [1.0])
    prior = AutoregressivePrior([-1.0], [1.0], order=1).fit(plans, generator=seeded(0))
    ends, means = torch.tensor([[[-1.0]], [[0.0]], [[1.0]]]), [-0.8, 0.0, 0.8]
    forecast, _ = prior.read(ends)
    assert forecast.mean.flatten().tolist() == pytest.approx(means, abs=0.06)
    assert float(forecast.std.mean()) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("half", [3.0, 1.2e6, 1e7])
@pytest.mark.parametrize("kind", LINEAR)
def test_however_wide_bounds_are_linear_priors_follow_the_vectors(kind, half):
    values = walk(20, 0, 1.0, 1, 0.9).clamp(-3, 3)
    plans = VectorPlans(values, [-half], [half])
    prior = WIDE[kind](plans.action_low, plans.action_high).fit(plans, generator=seeded(0))
    drawn = prior.sample(500, 40, generator=seeded(1))[0]
    assert float(drawn.std()) == pytest.approx(float(values.std()), rel=0.3)


@pytest.mark.parametrize("kind", LINEAR)
def test_vectors_far_from_the_middle_of_wide_bounds(kind):
    """Single precision distinguishes them in units of half the range, of which they are .002 %."""
    values, nats = 3 + 0.05 * torch.randn(40, 30, 1, generator=seeded(0)).cumsum(1), []
    for high in (10.0, 3e5):
        plans = VectorPlans(values.clamp(min=0), [0.0], [high])
        prior = WIDE[kind](plans.action_low, plans.action_high).fit(plans[:30], generator=seeded(0))
        nats.append(float(prior.action_log_probs(plans[30:]).mean()))
    assert nats[1] == pytest.approx(nats[0], abs=0.05)


@pytest.mark.parametrize(("value", "low", "high"), [(0.0, -10.0, 10.0), (3.0, -10.0, 10.0), (0.2, -0.3, 0.7)])
@pytest.mark.parametrize("kind", CLOSED)
def test_what_never_changes_is_drawn_close_to_where_it_is(kind, value, low, high):
    """With a standard deviation of a thousandth of half the range, also at the middle of the range but for rounding."""
    plans = VectorPlans(torch.full((10, 20, 1), value), [low], [high])
    prior = CLOSED[kind](plans.action_low, plans.action_high).fit(plans, generator=seeded(0))
    drawn = prior.sample(100, 20, generator=seeded(1))
    assert float(drawn.std()) == pytest.approx(1e-3 * (high - low) / 2, rel=0.1)
    nearly = VectorPlans(plans.actions * (1 + 2**-22), [low], [high])
    assert float(prior.log_prob(nearly).mean()) == pytest.approx(float(prior.log_prob(plans).mean()), abs=0.1)


@pytest.mark.parametrize("kind", LINEAR)
def test_what_never_changes_beside_others_does_not_borrow_their_spread(kind):
    moving = torch.randn(2, 12, 2, generator=seeded(0)).cumsum(1).mul(0.1).tanh()
    values = torch.cat([moving[..., :1], torch.full((2, 12, 1), 3.0), moving[..., 1:]], -1)
    plans = VectorPlans(values, [-1.0, -1e4, -1.0], [1.0, 1e4, 1.0])
    prior = LINEAR[kind](plans.action_low, plans.action_high).fit(plans, generator=seeded(0))
    drawn = prior.sample(100, 10, generator=seeded(1))[..., 1]
    assert float((drawn - 3).std()) == pytest.approx(10, rel=0.1)
