"""Priors over vectors: the conformance suite, closed forms, and sources whose parameters are known."""

from dataclasses import replace
from math import e, erf, log, pi, sqrt

import pytest
import torch

from neuroprior.control import (
    AutoregressivePrior,
    GaussianForecast,
    NoisePrior,
    StoredWindows,
    VectorGRU,
    VectorPlans,
    VectorPrior,
    coloured_noise,
)
from neuroprior.priors import MarkovPrior, load, save
from neuroprior.testing import check_prior
from tests.support.saved import content_of, rewrite
from tests.support.sources import seeded
from tests.support.vectors import Drift, walks

LOW, HIGH = [-1.0, -2.0], [1.0, 3.0]
KINDS = {
    "white": NoisePrior,
    "coloured": lambda low, high: NoisePrior(low, high, None, memory=6),
    "autoregressive": AutoregressivePrior,
    "stored windows": lambda low, high: StoredWindows(low, high, match=2, horizon=4, max_windows=10),
}


def source(num: int = 12, length: int = 40, low=LOW, high=HIGH, seed: int = 0) -> VectorPlans:
    """A damped rotation driven by noise, part of which lies at the bounds."""
    low, high = torch.tensor(low), torch.tensor(high)
    turn = 0.95 * torch.tensor([[0.9, -0.43], [0.43, 0.9]])[: len(low), : len(low)]
    noise = 0.3 * torch.randn(num, length, len(low), generator=seeded(seed))
    now, rows = torch.zeros(num, len(low)), []
    for t in range(length):
        now = (now @ turn.T + noise[:, t]).clamp(-1, 1)
        rows.append(now)
    share = (torch.stack(rows, 1) + 1) / 2
    return VectorPlans(low + share * (high - low), low, high)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("size", "fitted"),
    [(1, False), (2, False), (2, True)],  # one dimension, fitted: see test_bounds_and_input.py
)
def test_conformance(kind, fitted, size):
    prior = KINDS[kind](LOW[:size], HIGH[:size])
    if fitted:
        prior.fit(source(low=LOW[:size], high=HIGH[:size]), generator=seeded(0))
    check_prior(prior, num_plans=600)


@pytest.mark.parametrize(("size", "context_size"), [(1, 3), (2, None)])
def test_conformance_of_a_network(size, context_size):
    plans = source(low=LOW[:size], high=HIGH[:size])
    if context_size is not None:
        plans = replace(plans, context=torch.randn(*plans.actions.shape[:2], context_size, generator=seeded(0)))
    prior = VectorGRU(LOW[:size], HIGH[:size], context_size, width=8)
    check_prior(prior.fit(plans, generator=seeded(0), max_steps=40, progress=False), num_plans=600)


def test_a_forecast_is_a_density_between_the_bounds_and_a_mass_at_each():
    def cdf(x):
        return 0.5 * (1 + erf(x / sqrt(2)))

    forecast = GaussianForecast(
        torch.full((3, 1, 1), 0.5), torch.tensor([2.0]), torch.tensor([-1.0]), torch.tensor([3.0])
    )
    nats = forecast.log_prob(torch.tensor([[-1.0], [1.5], [3.0]])).double()
    inside = -0.5 * 0.25 - log(2) - 0.5 * log(2 * pi)
    expected = torch.tensor([log(cdf(-0.75)), inside, log(1 - cdf(1.25))]).double()
    assert nats.allclose(expected, atol=1e-6)


def test_dimensions_depend_on_those_before_them_as_they_are():
    """Where the first of two dimensions is clipped, the second follows what was executed."""
    coupling = torch.tensor([[0.0, 0.0], [0.7, 0.0]])
    low, high = -torch.ones(2), torch.ones(2)
    forecast = GaussianForecast(torch.full((1, 1, 2), 0.2), torch.tensor([0.5, 0.1]), low, high, None, coupling)
    value = torch.tensor([[1.0, 0.9]])
    alone = GaussianForecast(torch.tensor([[[0.2]]]), torch.tensor([0.5]), low[:1], high[:1])
    given = GaussianForecast(torch.tensor([[[0.2 + 0.7 * 0.8]]]), torch.tensor([0.1]), low[:1], high[:1])
    expected = alone.log_prob(value[:, :1]) + given.log_prob(value[:, 1:])
    assert forecast.log_prob(value).allclose(expected, atol=1e-6)
    samples = forecast.repeat_interleave(20_000).sample(seeded(0))
    clipped = samples[samples[:, 0] == 1]
    assert len(clipped) > 500
    assert abs(float(clipped[:, 1].mean()) - 0.76) < 5 * 0.1 / sqrt(len(clipped))


def test_weights_of_a_mixture():
    mean = torch.tensor([[[-0.5], [0.5]]])
    weights = torch.tensor([[0.2, 0.8]]).log()
    bounds = torch.tensor([-1.0]), torch.tensor([1.0])
    forecast = GaussianForecast(mean, torch.tensor([0.01]), *bounds, weights)
    alone = GaussianForecast(mean[:, :1], torch.tensor([0.01]), *bounds)
    at = torch.tensor([[-0.5]])
    assert float(forecast.log_prob(at) - alone.log_prob(at)) == pytest.approx(log(0.2), abs=1e-4)
    share = (forecast.repeat_interleave(4000).sample(seeded(0)) > 0).float().mean()
    assert abs(float(share) - 0.8) < 5 * sqrt(0.16 / 4000)


def autoregression(coefficients, num=40, length=100, std=0.05):
    """A one-dimensional autoregression, too small to meet its bounds."""
    order, values = len(coefficients), torch.zeros(num, length + len(coefficients))
    noise = std * torch.randn(values.shape, generator=seeded(3))
    for t in range(order, values.shape[1]):
        past = values[:, t - order : t].flip(1)
        values[:, t] = past @ torch.tensor(coefficients) + noise[:, t]
    return VectorPlans(values[:, order + 20 :, None], [-1.0], [1.0])


def test_an_autoregression_is_found_with_its_order_and_entropy():
    plans = autoregression([1.3, -0.6])
    prior = AutoregressivePrior([-1.0], [1.0]).fit(plans[:30], generator=seeded(0))
    held_out = plans[30:]
    nats = prior.action_log_probs(held_out)[:, 5:].mean()
    truth = -0.5 * (1 + log(2 * pi)) - log(0.05)
    assert abs(float(nats) - truth) < 0.05
    first = AutoregressivePrior([-1.0], [1.0], 1).fit(plans[:30], generator=seeded(0))
    assert first.memory == 1
    assert prior.memory >= 2
    assert float(first.action_log_probs(held_out)[:, 5:].mean()) < float(nats) - 0.1
    forecast, _ = prior.read(torch.tensor([[[0.3], [0.1]]]))
    assert float(forecast.mean) == pytest.approx(1.3 * 0.1 - 0.6 * 0.3, abs=0.03)


def test_noise_has_the_spectrum_that_it_is_given():
    """Of 1 / f noise the autocorrelations follow from its spectrum."""
    prior = NoisePrior([-50.0], [50.0], 1.0, scale=0.02, memory=15)
    samples = prior.sample(20_000, 16, generator=seeded(0))[0, :, :, 0].double()
    frequency = torch.arange(1, 17).double() / 32
    power = 1 / frequency
    for lag in (1, 3, 15):
        expected = float((power * torch.cos(2 * pi * frequency * lag)).sum() / power.sum())
        found = float((samples[:, 0] * samples[:, lag]).mean() / samples[:, 0].square().mean())
        assert abs(found - expected) < 5 / sqrt(20_000)
    assert float(samples.std()) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
def test_the_exponent_of_noise_is_found(exponent):
    truth = NoisePrior([-1.0], [1.0], exponent, scale=0.1, memory=20)
    plans = VectorPlans(truth.sample(100, 40, generator=seeded(1))[0], [-1.0], [1.0])
    assert NoisePrior([-1.0], [1.0], None, memory=20).fit(plans).exponent == exponent


def test_a_stored_window_is_found_by_its_past():
    ramps = torch.linspace(-0.9, 0.9, 30)
    plans = VectorPlans(torch.stack([ramps, -ramps])[..., None], [-1.0], [1.0])
    prior = StoredWindows([-1.0], [1.0], match=3, horizon=5).fit(plans, generator=seeded(0))
    prior.bandwidth, prior.noise = 0.02, 0.005
    for way, values in ((1, ramps), (-1, -ramps)):
        past = values[None, 10:13, None]
        sampled = prior.sample(20, 5, past=past, generator=seeded(0))[0, :, :, 0]
        assert (sampled - values[13:18]).abs().max() < 0.15, way
        assert (sampled[:, -1] - sampled[:, 0]).sign().eq(way).all()
    # What was seen of the segment tells which of the two it is, where the past did not.
    flat = torch.zeros(1, 3, 1)
    forecast, state = prior.read(flat)
    forecast, state = prior.step(torch.tensor([[float(ramps[18])]]), state)
    assert float(forecast.sample(seeded(0))) == pytest.approx(float(ramps[19]), abs=0.1)


def test_unequal_lengths_and_groups():
    """Beyond a plan's end nothing counts, in learning as in scoring."""
    plans = source(10, 30)
    lengths = torch.tensor([30, 20, 10, 5, 1, 0, 30, 25, 15, 30])
    cut = VectorPlans(plans.actions, plans.action_low, plans.action_high, lengths, group=torch.arange(10) // 2)
    wild = cut.actions.clone()
    wild[~cut.mask()] = 0.3
    other = VectorPlans(wild, plans.action_low, plans.action_high, lengths, group=cut.group)
    for name, make in KINDS.items():
        one = make(LOW, HIGH).fit(cut, generator=seeded(0))
        two = make(LOW, HIGH).fit(other, generator=seeded(0))
        scores = one.action_log_probs(cut)
        assert scores.equal(two.action_log_probs(other)), name
        assert not scores[~cut.mask()].any()


def test_constant_plans_and_a_single_vector_can_be_learned():
    for actions in (torch.full((5, 30, 2), 0.5), torch.full((5, 30, 2), 1.0), torch.zeros(1, 25, 2)):
        plans = VectorPlans(actions, -torch.ones(2), torch.ones(2))
        for name, make in KINDS.items():
            prior = make(plans.action_low, plans.action_high).fit(plans, generator=seeded(0))
            assert prior.log_prob(plans).isfinite().all(), name
            assert (prior.sample(9, 3, generator=seeded(0)) - actions[0, 0]).abs().mean() < 0.2, name
    single = VectorPlans(torch.zeros(1, 1, 2), -torch.ones(2), torch.ones(2))
    for name in KINDS:
        if name != "stored windows":
            assert KINDS[name](-torch.ones(2), torch.ones(2)).fit(single).log_prob(single).isfinite().all()


def slow_noise(num: int, length: int, size: int, seed: int) -> VectorPlans:
    """Independent dimensions, each x[t] = .9 x[t - 1] + noise, of standard deviation .3."""
    noise = 0.3 * torch.randn(num, length, size, generator=torch.Generator().manual_seed(seed))
    line = [noise[:, 0]]
    for t in range(1, length):
        line.append(0.9 * line[-1] + sqrt(1 - 0.9**2) * noise[:, t])
    return VectorPlans(torch.stack(line, 1), torch.full((size,), -2.0), torch.full((size,), 2.0))


def nats_of_noise(plans: VectorPlans, test: VectorPlans) -> float:
    """Nats per vector under independent Gaussians with the means and variances of some plans."""
    values, held_out = plans.actions[plans.mask()], test.actions[test.mask()]
    law = torch.distributions.Normal(values.mean(0), values.std(0, correction=0))
    return float(law.log_prob(held_out).sum(1).mean())


@pytest.mark.parametrize(("num", "length"), [(1, 42), (3, 50), (20, 5)])
def test_many_dimensions_are_learned_from_few_vectors(num, length):
    """Of 20 dimensions 40 to 150 vectors say nothing reliable of the 400 covariances between them."""
    data, test = slow_noise(num, length, 20, 1), slow_noise(10, 40, 20, 2)
    prior = AutoregressivePrior(data.action_low, data.action_high).fit(data, generator=seeded(0))
    nats = float(prior.log_prob(test).sum()) / 400
    own = -0.5 * log(2 * pi * e * 0.3**2 * (1 - 0.9**2)) * 20  # of each dimension's own chain
    assert max(own - 6, nats_of_noise(data, test) + 10) < nats < own


@pytest.mark.parametrize("size", [1, 3])
def test_what_few_windows_do_not_show_is_not_taken_for_impossible(size):
    """One plan of six vectors among single ones: one window of order 5, and three of order 3."""
    low, high = torch.full((size,), -1.0), torch.ones(size)
    actions = 0.1 * torch.randn(60, 6, size, generator=torch.Generator().manual_seed(1))
    data = VectorPlans(actions, low, high, torch.tensor([6] + [1] * 59))
    test = VectorPlans(0.1 * torch.randn(50, 6, size, generator=torch.Generator().manual_seed(2)), low, high)
    noise = -0.5 * log(2 * pi * e * 0.1**2)
    for order in (3, 5):
        prior = AutoregressivePrior(low, high, order).fit(data, generator=torch.Generator().manual_seed(0))
        assert float(prior.log_prob(test).mean()) / (6 * size) > noise - 0.2


PAIR = VectorPlans(torch.zeros(3, 7, 2), LOW, HIGH)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: NoisePrior("a", "b"), "`action_low` must be numbers"),
        (lambda: NoisePrior([1.0], [0.0]), "`action_low` must be below `action_high`"),
        (lambda: NoisePrior([], []), r"must have shape \[D\]"),
        (lambda: NoisePrior([-1.0], [1.0], -1.0), "`exponent` must be finite and at least 0, got -1"),
        (lambda: NoisePrior([-1.0], [1.0], 1.0, scale=0.0), "`scale` must be finite and above 0, got 0"),
        (lambda: AutoregressivePrior([-1.0], [1.0], 1.5), "order"),
        (lambda: AutoregressivePrior(LOW, HIGH, 7).fit(PAIR), "`order` must be below .* 7, got 7"),
        (lambda: AutoregressivePrior(LOW, HIGH, 10**7), "order"),
        (lambda: StoredWindows([-1.0], [1.0], horizon=0), "horizon"),
        (lambda: StoredWindows(LOW, HIGH, match=3, horizon=5).fit(PAIR), "`plans` must have one of 8 .* got at most 7"),
        (lambda: AutoregressivePrior([-1, -1], [1, 1]).fit(PAIR), "`action_low` of the plans"),
        (lambda: AutoregressivePrior(LOW, HIGH).fit(torch.zeros(3, 4, 2)), "`plans` must be VectorPlans, got Tensor"),
        (lambda: AutoregressivePrior(LOW, HIGH).fit(PAIR.steps(7)), "`plans` must have a vector"),
        (lambda: NoisePrior(LOW, HIGH).sample(2, 3, torch.zeros(1, 2)), "`context` must be None"),
        (lambda: NoisePrior(LOW, HIGH).sample(2, 3, generator=7), "generator"),
    ],
)
def test_bad_input(call, said):
    with pytest.raises(ValueError, match=said):
        call()


def test_folders_say_what_they_hold(tmp_path):
    save(AutoregressivePrior(LOW, HIGH).fit(source(), generator=seeded(0)), tmp_path / "vectors")
    save(MarkovPrior(3), tmp_path / "actions")
    assert isinstance(load(tmp_path / "vectors", kind=VectorPrior), VectorPrior)
    with pytest.raises(ValueError, match=r"must hold a Prior, got AutoregressivePrior"):
        load(tmp_path / "vectors")
    with pytest.raises(ValueError, match="must hold a VectorPrior, got MarkovPrior"):
        load(tmp_path / "actions", kind=VectorPrior)
    with pytest.raises(ValueError, match="kind"):
        load(tmp_path / "actions", kind="other")
    content = content_of(tmp_path / "vectors")
    content["learned"]["memory"] = 10**9
    rewrite(tmp_path / "vectors", content)
    with pytest.raises(ValueError, match=r"memory: 1000000000 would need at least"):
        load(tmp_path / "vectors", kind=VectorPrior)


class Echo(Drift):
    """The vector before the last one comes again: its state is the last one."""

    memory = 2

    def step(self, action, state, context=None):
        return self._forecast(state)[0], action


def test_each_plan_goes_on_from_its_own_past():
    """In plans sampled for several pasts at once, steps and all: the two last vectors of a past take turns."""
    past = torch.tensor([[[0.1, 0.2], [0.3, -0.4]], [[-0.5, 0.6], [0.7, 1.5]], [[0.0, -1.0], [-0.9, 2.0]]])
    plans = Echo(LOW, HIGH, std=1e-4).sample(4, 5, past=past, generator=seeded(0))
    due = past[:, [0, 1, 0, 1, 0]][:, None].expand(-1, 4, -1, -1)
    assert plans.shape == (3, 4, 5, 2)
    assert torch.allclose(plans, due, atol=1e-2)


def test_a_past_is_read_with_its_last_contexts():
    """A prior without memory knows the next context alone."""
    prior, context = Drift(LOW, HIGH, 2), torch.randn(3, 5, 2, generator=seeded(0))
    prior.memory = 0
    forecast, _ = prior.read(torch.zeros(3, 4, 2), context)
    assert forecast.mean[:, 0].allclose(torch.tensor([0.0, 0.5]) + context[:, -1, :1])


def test_shorter_plans_are_learned_from():
    """White noise has the mean and the variance of all vectors, whatever the lengths of their plans."""
    actions = torch.tensor([[[0.1], [0.3], [-0.2]], [[0.9], [0.0], [0.0]], [[0.5], [0.5], [0.0]]])
    plans = VectorPlans(actions, [-1.0], [1.0], lengths=torch.tensor([3, 1, 0]))
    prior = NoisePrior([-1.0], [1.0]).fit(plans)
    all_of_them = torch.tensor([0.1, 0.3, -0.2, 0.9])
    forecast, _ = prior.start(1)
    assert float(forecast.mean) == pytest.approx(float(all_of_them.mean()))
    assert float(forecast.std) == pytest.approx(float(all_of_them.std(correction=0)), rel=1e-4)


@pytest.mark.parametrize("lengths", [[12], [40], [40, 1, 1, 2, 1]])
def test_of_a_single_plan_no_order_is_chosen_that_it_is_too_short_for(lengths):
    """Its vectors are independent; before it was cut into parts, .3 (of 40) and 2.1 nats (of 12) were lost."""
    low, high, lost = [-1.0, -1.0], [1.0, 1.0], []
    test = VectorPlans((0.4 * torch.randn(100, 40, 2, generator=seeded(99))).clamp(-1, 1), low, high)
    for seed in range(12):
        actions = (0.4 * torch.randn(len(lengths), max(lengths), 2, generator=seeded(seed))).clamp(-1, 1)
        plans = VectorPlans(actions, low, high, torch.tensor(lengths))
        noise, chain = (kind(low, high).fit(plans, generator=seeded(0)) for kind in (NoisePrior, AutoregressivePrior))
        lost.append(float((noise.action_log_probs(test) - chain.action_log_probs(test)).mean()))
    assert sum(lost) / len(lost) < 0.15


@pytest.mark.slow
def test_of_a_small_group_beside_a_large_one_little_is_learned():
    """Where the large one is held out, the small one is all there is: plans are held out instead of groups."""
    data = walks(9, 40, 2, 1)
    plans = VectorPlans(
        data.actions, [-1.0] * 2, [1.0] * 2, torch.tensor([40] * 8 + [2]), group=torch.tensor([0] * 8 + [1])
    )
    for seed in range(6):
        assert AutoregressivePrior([-1.0] * 2, [1.0] * 2).fit(plans, generator=seeded(seed)).memory >= 1


def test_a_single_plan_is_known_by_the_vectors_before_each_part():
    plans = walks(1, 100, 2, 1)
    chain = AutoregressivePrior([-1.0] * 2, [1.0] * 2).fit(plans, generator=seeded(0))
    test = walks(50, 60, 2, 2)
    noise = NoisePrior([-1.0] * 2, [1.0] * 2).fit(plans)
    assert chain.memory in (1, 2, 3)
    assert (chain.action_log_probs(test) - noise.action_log_probs(test)).mean() > 1


def test_plans_of_few_vectors_do_not_run_away():
    """By chance, the recursions of some of these would grow exponentially."""
    for seed in range(8):
        plans = walks(2, 25, 4, seed)
        prior = AutoregressivePrior(plans.action_low, plans.action_high).fit(plans, generator=seeded(0))
        drawn = prior.sample(100, 50, generator=seeded(1))[0]
        assert (drawn[:, 30:].std((0, 1)) < 3 * plans.actions.std((0, 1))).all(), seed
        assert (drawn.abs() == 1).float().mean() < 0.01


def test_what_grows_is_slowed_to_a_walk():
    """Doubling numbers have a spectral radius of 2, oscillating ones that grow likewise; the rest is as it was."""
    for root in (2.0, -2.0, 0.5):
        values = 0.01 * root ** torch.arange(6.0).expand(30, 6)[..., None] * torch.linspace(-2, 2, 30)[:, None, None]
        prior = AutoregressivePrior([-1.0], [1.0], order=1).fit(VectorPlans(values, [-1.0], [1.0]))
        ahead = prior.read(torch.full((1, 3, 1), 0.1))[0].mean
        want = 0.1 * min(max(root, -1), 1)
        assert float(ahead) == pytest.approx(want, abs=0.01)


@pytest.mark.parametrize("exponent", [0.0, 1.5, None])
def test_noise_in_each_dimension_is_that_of_a_prior_of_its_own(exponent):
    """Dimensions are independent: densities are products, and a dimension that never changes leaves others alone."""
    actions = coloured_noise((8, 30, 3), 1.5, seeded(0)) * torch.tensor([0.1, 0.3, 0.0])
    low, high = [-1.0, -2.0, -1.0], [1.0, 1.0, 0.5]
    plans = VectorPlans(actions, low, high)
    together = NoisePrior(low, high, exponent, memory=6).fit(plans)
    alone = [
        NoisePrior(low[d : d + 1], high[d : d + 1], together.exponent, memory=6).fit(
            VectorPlans(actions[..., d : d + 1], low[d : d + 1], high[d : d + 1])
        )
        for d in range(3)
    ]
    each = sum(prior.log_prob(VectorPlans(actions[..., [d]], [low[d]], [high[d]])) for d, prior in enumerate(alone))
    assert torch.allclose(together.log_prob(plans), each, rtol=1e-4)
    assert together.exponent == exponent or (exponent is None and together.exponent > 1)
