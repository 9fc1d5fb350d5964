"""Features are standardised before networks read them: units and missing codes make no difference."""

import pytest
import torch

from neuroprior import GRUPrior, Plans, TransformerPrior
from neuroprior.control import VectorGRU, VectorPlans
from neuroprior.priors.neural.features import Standardise
from tests.support.sources import seeded

HOW = {"max_steps": 60, "progress": False, "learning_rate": 0.02}


def learned(values):
    made = Standardise(values.shape[1])
    made.learn(values)
    return made


def test_means_and_standard_deviations():
    values = torch.randn(5000, 3, generator=seeded(0)).double() * torch.tensor([1e-3, 1.0, 1e5]) + 7
    found = learned(values.float())(values.float())
    assert found.mean(0).abs().max() < 1e-3
    assert (found.std(0) - 1).abs().max() < 1e-3


def test_of_very_many_values_some_are_enough():
    """An indicator is one of all values."""
    values = torch.randn(200_000, 3, generator=seeded(0)) * 5 + 40
    values[:, 1:] = (values[:, 1:] > 40).float()
    values[77_777, 2] = 0.5
    made = learned(values)
    assert made.mean.tolist() == pytest.approx([40, 0, 0.5], abs=0.1)
    assert made.std.tolist() == pytest.approx([5, 1, 0.5], rel=0.03)


def test_indicators_and_constants():
    signs = torch.randint(-1, 2, (50, 1), generator=seeded(0)).float()
    rare = torch.zeros(50, 1)
    rare[3] = 1
    values = torch.cat([signs, rare, torch.full((50, 1), 300.0), torch.full((50, 1), 0.2)], 1)
    made = learned(values)
    assert made(values)[:, :2].equal(values[:, :2])
    assert made(values)[:, 2:].abs().max() < 1e-6
    assert made(values + 30)[:, 2].tolist() == pytest.approx([0.1] * 50)


@pytest.mark.parametrize("share", [0.001, 0.03, 0.3])
def test_codes_for_missing_numbers_do_not_hide_the_others(share):
    values = torch.randn(4000, 1, generator=seeded(0))
    code = torch.rand(4000, 1, generator=seeded(1)) < share
    coded = values.masked_fill(code, -9999)
    found = learned(coded)(coded)
    assert found[code].tolist() == [-10.0] * int(code.sum())
    assert 0.9 < found[~code].std() < 3


@pytest.mark.parametrize("code", [-99.0, -9999.0])
@pytest.mark.parametrize("share", [0.0025, 0.03])
def test_codes_among_numbers_that_are_mostly_0(share, code):
    some = torch.rand(4000, 1, generator=seeded(0)) < 0.2
    numbers = some * (1 + torch.rand(4000, 1, generator=seeded(1)))
    coded = torch.rand(4000, 1, generator=seeded(2)) < share
    for values in (some.float(), numbers):
        found = learned(values.masked_fill(coded, code))(values.masked_fill(coded, code))
        assert found[coded].tolist() == [-10.0] * int(coded.sum())
        apart = found[some & ~coded].mean() - found[~some & ~coded].mean()
        assert 1 <= apart < 4


def test_heavy_tails_are_not_taken_for_codes():
    """Nor a feature that is mostly 0."""
    heavy = (1.5 * torch.randn(4000, 1, generator=seeded(0))).exp()
    some = torch.where(torch.rand(4000, 1, generator=seeded(1)) < 0.05, heavy, 0.0)
    for values in (torch.randn(4000, 1, generator=seeded(2)) ** 3, some):
        assert float(learned(values).std) == pytest.approx(float(values.std(correction=0)))


def signs(features):
    """Plans whose actions are the signs of the first feature, given as they are in `features`."""
    values = torch.randn(30, 12, 2, generator=seeded(0))
    return Plans((values[..., 0] > 0).long(), 2, context=features(values))


@pytest.mark.parametrize("kind", [GRUPrior, TransformerPrior])
@pytest.mark.parametrize(
    "features",
    [
        pytest.param(lambda x: 1e-5 * x, marks=pytest.mark.slow),
        pytest.param(lambda x: x + 100, marks=pytest.mark.slow),
        lambda x: x * torch.tensor([0.3, 9.0]) + 37,
    ],
)
@torch.no_grad()
def test_units_of_features_make_no_difference(kind, features):
    plain, other = signs(lambda x: x), signs(features)
    with torch.enable_grad():
        first, second = (
            kind(2, width_of(kind), context_size=2).fit(p, generator=seeded(1), **HOW) for p in (plain, other)
        )
    nats = first.action_log_probs(plain)
    assert nats.mean() > -0.35
    assert second.action_log_probs(other).mean() == pytest.approx(float(nats.mean()), abs=0.02)


def width_of(kind):
    return 16 if kind is GRUPrior else 32


@pytest.mark.parametrize("kind", [GRUPrior, TransformerPrior])
@torch.no_grad()
def test_what_is_far_away_is_as_far_as_ten_standard_deviations(kind):
    prior = kind(2, width_of(kind), context_size=2)
    prior.prepare(signs(lambda x: 2 * x + 5), 128)
    far = torch.tensor([[40.0, 5.0], [5e3, 5.0], [1e30, 5.0]])
    logits = torch.cat([prior.start(1, row[None])[0] for row in far])  # a product may round its rows differently
    assert logits.isfinite().all()
    assert logits[0].equal(logits[1])
    assert logits[0].equal(logits[2])
    assert not torch.allclose(logits[0], prior.start(1, torch.tensor([[5.0, 5.0]]))[0][0], atol=1e-3)


@torch.no_grad()
def test_vectors_after_features_that_are_far_away_are_numbers():
    context = torch.randn(20, 10, 1, generator=seeded(0)) * 1e-7
    plans = VectorPlans((5e6 * context).clamp(-1, 1), [-1.0], [1.0], context=context)
    with torch.enable_grad():
        prior = VectorGRU([-1.0], [1.0], 1, width=16).fit(plans, generator=seeded(1), **HOW)
    blind = VectorGRU([-1.0], [1.0], width=16)
    with torch.enable_grad():
        blind.fit(plans, generator=seeded(1), **HOW)
    assert prior.log_prob(plans).mean() > blind.log_prob(plans.without_context()).mean() + 3
    assert prior.sample(50, 4, context=torch.full((1, 1), 1e30), generator=seeded(2)).isfinite().all()


def test_features_that_single_precision_does_not_hold_are_not_learned_from():
    """Plans in memory keep float64: seconds since 1970 would be one number to a network."""
    actions = torch.arange(40)[None].expand(8, 40) % 3
    context = torch.arange(40.0, dtype=torch.double)[None, :, None].repeat(8, 1, 1)
    prior = GRUPrior(3, hidden_size=4, context_size=1)
    with pytest.raises(ValueError, match=r"context: feature 1 of 1 .* single precision"):
        prior.fit(Plans(actions, 3, context=1.7e9 + context), generator=seeded(0), **HOW)
    prior.fit(Plans(actions, 3, context=context), generator=seeded(0), **HOW | {"max_steps": 2})
