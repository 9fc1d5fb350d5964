"""A neural prior over vectors: one density however it is computed, and it is the one that generated the data."""

from math import e, log, pi

import pytest
import torch
from torch import Tensor

from neuroprior.control import AutoregressivePrior, NoisePrior, VectorGRU, VectorPrior
from neuroprior.control.priors.linear_gaussian import held_out_split
from neuroprior.control.vector_plans import VectorPlans
from tests.support.sources import seeded

LOW, HIGH = torch.tensor([-1.0, 0.5]), torch.tensor([2.0, 3.0])
HOW = {"progress": False, "max_steps": 2, "check_every": 1, "window": 4}


def plans(num: int = 6, length: int = 9, context_size: int | None = None, per_step: bool = True) -> VectorPlans:
    """Uniform vectors, a third of them clipped, in plans of unlike lengths."""
    actions = (torch.rand(num, length, 2, generator=seeded(1)) * 1.5 - 0.25) * (HIGH - LOW) + LOW
    lengths = torch.arange(num) % 3 + length - 2
    shape = (num, length) if per_step else (num,)
    context = None if context_size is None else 5 + torch.randn(*shape, context_size, generator=seeded(2))
    return VectorPlans(actions.clamp(LOW, HIGH), LOW, HIGH, lengths=lengths, context=context)


def test_features_beyond_the_ends_of_plans_are_not_learned_from():
    """Plans that are padded further have the same mean features, and so the same forecasts."""
    data = plans(context_size=2)
    assert data.context is not None
    padded = VectorPlans(
        torch.cat([data.actions, data.actions], 1), LOW, HIGH, data.lengths, torch.cat([data.context, data.context], 1)
    )
    one, two = (VectorGRU(LOW, HIGH, 2, width=8).fit(some, generator=seeded(0), **HOW) for some in (data, padded))
    torch.testing.assert_close(one.action_log_probs(data), two.action_log_probs(data), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(("context_size", "per_step"), [(None, True), (3, True), (3, False)])
@torch.no_grad()
def test_scoring_whole_plans_equals_stepping_and_reading_beyond_the_training_window(context_size, per_step):
    data = plans(length=13, context_size=context_size, per_step=per_step)
    with torch.enable_grad():
        prior = VectorGRU(LOW, HIGH, context_size, width=16).fit(data, generator=seeded(0), **HOW)
    assert prior.memory == 4
    whole = prior.action_log_probs(data)
    assert whole.allclose(VectorPrior.action_log_probs(prior, data), atol=1e-4)
    for t in range(4):  # where the past is shorter than `memory`, reading is stepping
        context = data.context
        forecast, _ = prior.read(data.actions[:, :t], None if context is None else context[:, : t + 1])
        assert forecast.log_prob(data.actions[:, t]).allclose(whole[:, t], atol=1e-4)


def test_the_autoregression_is_a_part_of_the_mixture():
    """With its share, from a plan's first vector on, whether fewer or more vectors are known than it reads."""
    data = plans(num=40)
    prior = VectorGRU(LOW, HIGH, width=8, order=2).fit(data, generator=seeded(0), **HOW)
    chain = AutoregressivePrior(LOW, HIGH, order=2).fit(plans(num=40, length=30), generator=seeded(0))
    assert chain.memory == 2
    prior.autoregression.learn_from(chain)
    assert 0 < prior.autoregressive_share < 1
    nats = []
    for share in (0.0, 0.3):
        prior.autoregressive_share = share
        with torch.no_grad():
            nats.append(prior.action_log_probs(data))
    expected = torch.logaddexp(nats[0] + log(0.7), chain.action_log_probs(data) + log(0.3))
    assert nats[1].allclose(expected.masked_fill(~data.mask(), 0), atol=1e-4)


@pytest.mark.slow
def test_few_plans_are_predicted_as_well_as_by_an_autoregression_and_many_better():
    """The data: a circle whose radius the autoregression does not know, with noise."""

    def circles(num: int, seed: int) -> VectorPlans:
        phase = 6 * torch.rand(num, 1, generator=seeded(seed)) + 0.7 * torch.arange(40)
        actions = torch.stack([phase.sin().sign(), phase.cos().sign()], -1) / 2
        return VectorPlans(actions + 0.1 * torch.randn(num, 40, 2, generator=seeded(seed + 1)), [-1, -1], [1, 1])

    test, gains, shares = circles(100, 5), [], []
    for num in (3, 100):
        chain = AutoregressivePrior([-1, -1], [1, 1], 1).fit(circles(num, 1), generator=seeded(0))
        prior = VectorGRU([-1, -1], [1, 1], width=16)
        prior.fit(circles(num, 1), generator=seeded(0), progress=False, max_steps=200, learning_rate=0.01)
        with torch.no_grad():
            gains.append(float((prior.log_prob(test) - chain.log_prob(test)).mean() / 40))
        shares.append(prior.autoregressive_share)
    assert gains[0] > 0
    assert gains[1] > 0.5
    assert shares[0] > 0.1 > 0.05 > shares[1]


@pytest.mark.parametrize("value", [0.3, -1.0])
def test_constant_vectors_and_features_leave_all_numbers_finite(value):
    data = VectorPlans(torch.full((4, 6, 2), value), -torch.ones(2), torch.ones(2), context=torch.ones(4, 6, 1))
    prior = VectorGRU([-1, -1], [1, 1], 1, width=8)
    prior.fit(data, generator=seeded(0), progress=False, max_steps=60, learning_rate=0.03)
    assert all(bool(weight.isfinite().all()) for weight in prior.state_dict().values())
    assert prior.log_prob(data).isfinite().all()
    assert prior.log_prob(data).mean() > -1
    assert prior.sample(3, 5, torch.ones(1, 1), generator=seeded(0)).isfinite().all()


def test_unfit_arguments_and_plans_are_refused():
    for wrong in ({"width": 0}, {"num_components": 0}, {"dropout": 1.0}, {"num_layers": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            VectorGRU(LOW, HIGH, **wrong)
    prior = VectorGRU(LOW, HIGH, width=8)
    with pytest.raises(ValueError, match="action_low"):
        prior.fit(VectorPlans(torch.zeros(2, 3, 2), -torch.ones(2), torch.ones(2)))
    with pytest.raises(ValueError, match="features"):
        VectorGRU(LOW, HIGH, 2, width=8).fit(plans())


def autoregression(num: int, length: int, seed: int) -> VectorPlans:
    """x[t] = 1.5 x[t-1] - .8 x[t-2] + .1 noise, in bounds that it does not reach."""
    noise = 0.1 * torch.randn(num, length + 50, 1, generator=seeded(seed))
    line: list[Tensor] = [torch.zeros(num, 1), torch.zeros(num, 1)]
    for t in range(length + 50):
        line.append(1.5 * line[-1] - 0.8 * line[-2] + noise[:, t])
    return VectorPlans(torch.stack(line[52:], 1), torch.tensor([-4.0]), torch.tensor([4.0]))


def test_two_modes_are_learned_and_features_are_used():
    feature = torch.rand(400, 10, 1, generator=seeded(1)) * 2 - 1
    side = torch.rand(400, 10, 1, generator=seeded(2)).round() - 0.5
    actions = 0.4 * feature + side + 0.05 * torch.randn(400, 10, 1, generator=seeded(3))
    data = VectorPlans(actions, torch.tensor([-2.0]), torch.tensor([2.0]), context=20 + 9 * feature)
    both = [VectorGRU([-2], [2], 1, width=16, num_components=num, dropout=0.0) for num in (2, 1)]
    nats = []
    for prior in both:
        prior.fit(data[:300], generator=seeded(0), progress=False, max_steps=250, learning_rate=0.01)
        with torch.no_grad():
            nats.append(float(prior.action_log_probs(data[300:]).mean()))
    truth = -0.5 * log(2 * pi * e * 0.05**2) - log(2)
    assert truth - 0.1 < nats[0] < truth + 0.1
    assert nats[1] < -0.5 * log(2 * pi * e * 0.5**2) + 0.1  # one Gaussian has the spread of both modes


@pytest.mark.parametrize("order", [1, 2])
def test_what_has_learned_nothing_predicts_as_an_autoregression_of_all_plans(order):
    """Those that are held out, here half of them, are among these."""
    data, test = autoregression(40, 30, 1), autoregression(50, 60, 2)
    data.actions[20:] += 1.0
    chain = AutoregressivePrior([-4], [4], order).fit(data, generator=seeded(0))
    prior = VectorGRU([-4], [4], width=8, num_components=3, order=order, dropout=0.0)
    prior.fit(data, generator=seeded(0), progress=False, max_steps=1, learning_rate=1e-9, validation=0.5)
    with torch.no_grad():
        prior.head.weight.zero_()  # what a network adds that was not trained
        first, ahead = (each[0].mean.mean(1) for each in (prior.start(1), prior.read(test.actions)))
        nats = [float(each.action_log_probs(data)[:, 16:].mean()) for each in (prior, chain)]
    assert first.allclose(chain.start(1)[0].mean[:, 0], atol=1e-4)  # where nothing is known yet
    gap = ahead - chain.read(test.actions)[0].mean[:, 0]
    assert gap.abs().mean() < 0.02  # a fifth of the noise: the ridge is chosen on other plans
    assert nats[0] > nats[1] - 0.1


NEXT_TO_NOTHING = {"progress": False, "max_steps": 1, "learning_rate": 1e-9}


def slow_noise(num: int, length: int, seed: int) -> Tensor:
    """Two slow dimensions `[num, length, 2]`: a vector is known well where the one before it is."""
    noise = torch.randn(num, length, 2, generator=seeded(seed))
    line = [0.3 * noise[:, 0]]
    for t in range(1, length):
        line.append(0.97 * line[-1] + 0.3 * (1 - 0.97**2) ** 0.5 * noise[:, t])
    return torch.stack(line, 1).clamp(-1, 1)


def test_it_begins_with_a_spread_of_the_first_vector():
    low, high = [-1.0, -1.0], [1.0, 1.0]
    data, test = (VectorPlans(slow_noise(num, 50, seed), low, high) for num, seed in ((40, 1), (200, 2)))
    prior = VectorGRU(low, high, width=8).fit(data, generator=seeded(0), **NEXT_TO_NOTHING)
    prior.autoregressive_share = 0.0  # which knows the spread in any case
    with torch.no_grad():
        found, chain = (p.action_log_probs(test) for p in (prior, AutoregressivePrior(low, high).fit(data)))
    assert (found[:, 0] - chain[:, 0]).mean().abs() < 0.15  # with the spread of later vectors it loses 10
    assert (found[:, 1:] - chain[:, 1:]).mean().abs() < 0.3


def test_of_a_long_plan_and_single_vectors_the_long_one_is_learned_from_and_validated_on():
    """Whichever plans chance would hold out."""
    low, high = [-1.0, -1.0], [1.0, 1.0]
    actions = torch.zeros(6, 600, 2)
    actions[:1], actions[1:, :1] = slow_noise(1, 600, 1), slow_noise(5, 1, 2)
    data = VectorPlans(actions, low, high, torch.tensor([600] + [1] * 5))
    test = VectorPlans(slow_noise(50, 50, 3), low, high)
    for seed in range(3):
        prior = VectorGRU(low, high, width=8, seed=seed)
        prior.fit(data, generator=seeded(seed), progress=False, max_steps=15)
        with torch.no_grad():
            assert prior.action_log_probs(test)[:, 1:].mean() > 2.2  # the noise has 2.4


@pytest.mark.parametrize(("larger", "sizes"), [(45, (225, 75)), (59, (270, 30))])
def test_a_fair_share_is_held_out_of_unequal_groups_of_many_plans(larger, sizes):
    """In one of two groups are most plans: the other is held out, or where that has too few, some plans are."""
    group = (torch.arange(60) >= larger).long()
    data = VectorPlans(torch.rand(60, 5, 1, generator=seeded(1)) - 0.5, [-1.0], [1.0], group=group)
    found = [tuple(int(part.mask().sum()) for part in held_out_split(data, seeded(seed), 0.1)) for seed in range(8)]
    assert {*found} == {sizes}
    VectorGRU([-1.0], [1.0], width=8).fit(data, generator=seeded(0), **HOW)


def test_plans_of_a_single_group_are_learned_from():
    data = plans()
    in_one = VectorPlans(data.actions, LOW, HIGH, data.lengths, group=torch.zeros(len(data), dtype=torch.long))
    one, each = (VectorGRU(LOW, HIGH, width=8).fit(some, generator=seeded(0), **HOW) for some in (in_one, data))
    assert one.log_prob(data).equal(each.log_prob(data))


def test_a_refused_fit_is_not_learned_from():
    """The next one learns as the first of a new network does: from its own autoregression and features."""
    data = plans(context_size=1)
    wrong = (plans(), VectorPlans(data.actions, LOW - 1, HIGH, context=data.context), 2.0)
    prior = VectorGRU(LOW, HIGH, 1, width=8)
    for validation in wrong:
        with pytest.raises(ValueError, match=r"^(validation: |`validation` must be)"):
            prior.fit(data, validation=validation, **HOW)
    with pytest.raises(ValueError, match="plans"):
        prior.fit(data[:1].steps(0, 1), **HOW)
    fresh = VectorGRU(LOW, HIGH, 1, width=8).fit(data, generator=seeded(0), **HOW)
    again = prior.fit(data, generator=seeded(0), **HOW)
    assert all(a.equal(b) for a, b in zip(fresh.state_dict().values(), again.state_dict().values(), strict=True))


def test_after_a_fit_that_fails_the_autoregression_keeps_its_share():
    prior = VectorGRU(LOW, HIGH, width=8).fit(plans(), generator=seeded(0), **HOW)
    share = prior.autoregressive_share
    assert share > 0
    with pytest.raises(ValueError, match="diverged"):
        prior.fit(plans(), generator=seeded(0), **HOW | {"learning_rate": 1e30, "max_steps": 20})
    assert prior.autoregressive_share == share


def test_of_too_few_vectors_no_autoregression_is_learned():
    """The one plan of more than a vector is held out, and ends far from all else: vectors count as independent."""
    for num, seed in ((20, 20), (40, 2)):
        actions = 0.1 * torch.randn(num, 2, 1, generator=seeded(1))
        actions[0, 1] = 0.9
        data = VectorPlans(actions, [-1.0], [1.0], torch.tensor([2] + [1] * (num - 1)))
        test = VectorPlans(0.1 * torch.randn(50, 2, 1, generator=seeded(9)), [-1.0], [1.0])
        priors = (NoisePrior([-1], [1]), AutoregressivePrior([-1], [1]), VectorGRU([-1], [1], seed=seed))
        for prior in priors:
            prior.fit(data, generator=seeded(seed))
        with torch.no_grad():
            noise, chain, network = (float(each.log_prob(test).mean()) for each in priors)
        assert noise == pytest.approx(chain, abs=1e-5)
        assert network > noise > 0.9  # the vectors have 1.76 a plan; with an autoregression of order 1 below -.6


def test_learning_further_goes_on_from_the_present_weights():
    prior = VectorGRU(LOW, HIGH, width=8).fit(plans(), generator=seeded(0), **HOW)
    before = {name: weight.clone() for name, weight in prior.state_dict().items()}
    prior.fit(plans(), generator=seeded(1), **HOW | {"learning_rate": 1e-9})
    autoregression = {f"autoregression.{name}" for name in prior.autoregression.state_dict()}  # is fitted anew
    now = {name: weight for name, weight in prior.state_dict().items() if name not in autoregression}
    assert all(weight.allclose(before[name], atol=1e-6) for name, weight in now.items())
