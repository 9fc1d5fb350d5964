"""Compiled loops draw the same plans as torch, from the same random numbers."""

import pytest
import torch

from neuroprior.control import AutoregressivePrior, NoisePrior, StepSynergies, VectorGRU, VectorPlans, WindowSynergies
from tests.support.sources import seeded

pytest.importorskip("numba")

LOW, HIGH = torch.tensor([-1.0, -2.0, 0.0]), torch.tensor([1.0, 3.0, 0.5])
PLACES = ("linear_gaussian", "networks")


def drawn(prior, past, monkeypatch, context=None):
    """Plans by compiled loops, and by torch."""
    prior.requires_grad_(False)
    fast = prior.sample(6, 9, context, past=past, generator=seeded(1))
    with monkeypatch.context() as patch:
        for place in PLACES:
            patch.setattr(f"neuroprior.control.priors.{place}.compiled", lambda name: None)
        return fast, prior.sample(6, 9, context, past=past, generator=seeded(1))


def pasts(length, number=2):
    return LOW + (HIGH - LOW) * torch.rand(number, length, 3, generator=seeded(2))


@pytest.mark.parametrize("length", [0, 2, 12])
@pytest.mark.parametrize(
    "make",
    [
        lambda low, high: NoisePrior(low, high, exponent=1.5, memory=6),
        lambda low, high: NoisePrior(low, high),
        lambda low, high: AutoregressivePrior(low, high, order=3),
        lambda low, high: WindowSynergies(low, high, num_components=4, window=8),
        StepSynergies,
    ],
)
def test_linear_priors(make, length, monkeypatch):
    walks = (0.3 * torch.randn(5, 40, 3, generator=seeded(3))).cumsum(1).sin()
    values = (LOW + HIGH) / 2 + (HIGH - LOW) / 2 * (1.2 * walks + walks[..., :1]).clamp(-1, 1)
    prior = make(LOW, HIGH).fit(VectorPlans(values, LOW, HIGH))
    fast, slow = drawn(prior, pasts(length), monkeypatch)
    torch.testing.assert_close(fast, slow, atol=1e-5, rtol=1e-5)
    assert (slow == HIGH).any()
    assert slow.std(1).amax(-1).amin() > 0  # not in all dimensions: a step may be at a bound in all plans


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("number", [2, 17])
@pytest.mark.parametrize("length", [0, 1, 7])
@pytest.mark.parametrize(
    ("settings", "features"),
    [
        ({"width": 6}, None),
        ({"width": 16, "num_layers": 2, "lags": 3, "coupled": True, "num_components": 3}, None),
        ({"width": 8, "lags": 2}, 4),
    ],
)
def test_a_recurrent_network(settings, features, length, number, share, monkeypatch):
    prior = VectorGRU(LOW, HIGH, features, **settings).requires_grad_(False)
    for name, numbers in prior.named_parameters():
        numbers.add_(0.3 * torch.randn(numbers.shape, generator=seeded(len(name))))
    walks = (0.3 * torch.randn(5, 40, 3, generator=seeded(3))).cumsum(1).sin()
    values = VectorPlans(LOW + (HIGH - LOW) * (walks + 1) / 2, LOW, HIGH)
    prior.autoregression.learn_from(AutoregressivePrior(LOW, HIGH, prior.order).fit(values))
    prior.autoregressive_share = share
    context = None if features is None else torch.randn(number, length + 1, features, generator=seeded(4))
    fast, slow = drawn(prior, pasts(length, number), monkeypatch, context)
    torch.testing.assert_close(fast, slow, atol=2e-5, rtol=1e-5)
    assert (slow == HIGH).any()
    assert ((slow > LOW) & (slow < HIGH)).any()
    assert slow.std(1).mean() > 0.1
