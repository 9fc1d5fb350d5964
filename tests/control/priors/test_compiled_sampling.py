"""Compiled loops draw what stepping through the same random numbers gives."""

import pytest
import torch

from neuroprior.control import AutoregressivePrior, NoisePrior, VectorGRU, VectorPlans
from tests.support.sources import seeded

LOW, HIGH = torch.tensor([-1.0, -2.0, 0.0]), torch.tensor([1.0, 3.0, 0.5])
WALKS = (0.3 * torch.randn(5, 40, 3, generator=seeded(3))).cumsum(1).sin()
NUM, LENGTH = 6, 9


def stepped(prior, past, context=None):
    """Plans by `read`, `step` and `drawn`."""
    generator, rows = seeded(1), NUM * len(past)
    uniform = torch.rand(rows, LENGTH, generator=generator) if isinstance(prior, VectorGRU) else None
    noise = torch.randn(rows, LENGTH, 3, generator=generator)
    forecast, state = prior.read(past, context)
    forecast, state, plans = forecast.repeat_interleave(NUM), state.repeat_interleave(NUM, 0), []
    for t in range(LENGTH):
        plans.append(forecast.drawn(None if uniform is None else uniform[:, t], noise[:, t]))
        forecast, state = prior.step(plans[-1], state)
    return torch.stack(plans, 1).view(len(past), NUM, LENGTH, 3)


def pasts(length, number=2):
    return LOW + (HIGH - LOW) * torch.rand(number, length, 3, generator=seeded(2))


@pytest.mark.parametrize("length", [0, 2, 12])
@pytest.mark.parametrize(
    "make",
    [
        lambda low, high: NoisePrior(low, high, exponent=1.5, memory=6),
        NoisePrior,
        lambda low, high: AutoregressivePrior(low, high, order=3),
    ],
)
def test_linear_priors(make, length):
    values = (LOW + HIGH) / 2 + (HIGH - LOW) / 2 * (1.2 * WALKS + WALKS[..., :1]).clamp(-1, 1)
    prior = make(LOW, HIGH).fit(VectorPlans(values, LOW, HIGH))
    past = pasts(length)
    plans = prior.sample(NUM, LENGTH, past=past, generator=seeded(1))
    torch.testing.assert_close(plans, stepped(prior, past), atol=1e-5, rtol=1e-5)
    assert (plans == HIGH).any()
    assert plans.std(1).amax(-1).amin() > 0  # not in all dimensions: a step may be at a bound in all plans


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize(("length", "number"), [(0, 2), (1, 17), (7, 45)])  # plans and pasts of several blocks
@pytest.mark.parametrize(
    ("settings", "features"),
    [({"width": 6}, None), ({"width": 16, "num_layers": 2, "num_components": 3}, None), ({"width": 8, "order": 1}, 4)],
)
@torch.no_grad()
def test_a_recurrent_network(settings, features, length, number, share):
    prior = VectorGRU(LOW, HIGH, features, **settings)
    for name, numbers in prior.named_parameters():
        numbers.add_(0.3 * torch.randn(numbers.shape, generator=seeded(len(name))))
    plans = VectorPlans(LOW + (HIGH - LOW) * (WALKS + 1) / 2, LOW, HIGH)
    prior.autoregression.learn_from(AutoregressivePrior(LOW, HIGH, prior.order).fit(plans))
    prior.autoregressive_share = share
    context = None if features is None else torch.randn(number, length + 1, features, generator=seeded(4))
    past = pasts(length, number)
    drawn = prior.sample(NUM, LENGTH, context, past=past, generator=seeded(1))
    torch.testing.assert_close(drawn, stepped(prior, past, context), atol=2e-5, rtol=1e-5)
    assert (drawn == HIGH).any()
    assert ((drawn > LOW) & (drawn < HIGH)).any()
    assert drawn.std(1).mean() > 0.1
