"""Steps of a fixed shape, and what is done with recordings of them; `tests/test_cuda.py` makes real ones."""

from itertools import product

import pytest
import torch

from neuroprior import GRUPrior, TransformerPrior
from neuroprior.control import VectorGRU, VectorPlans
from neuroprior.priors.neural import cuda_graphs as recordings
from neuroprior.priors.neural.neural import NeuralPrior
from tests.support.sources import refuses, seeded

A = 5


def network(kind, seed=0, **how):
    prior = kind(A, 16, seed=seed, **how)
    with torch.no_grad():
        for weight in prior.parameters():
            weight.mul_(2)  # away from the near-uniform predictions of fresh weights
    return prior.eval()


SHAPES = [{}, {"window": 1}, {"window": 3, "lags": 4, "num_contexts": 2}, {"context_size": 2, "lags": 1}, {"span": 4}]


@pytest.mark.parametrize(("kind", "how", "before"), [*product([GRUPrior, TransformerPrior], SHAPES, [0, 2, 9])])
@torch.no_grad()
def test_fixed_steps_are_steps(kind, how, before):
    prior = network(kind, **{name: value for name, value in how.items() if name != "span"})
    if "span" in how:
        prior.set_training_window(how["span"])
    context = None
    if prior.takes_context:
        context = torch.tensor([0, 1, 1]) if prior.num_contexts else torch.randn(3, 2, generator=seeded(0))
    _, state = prior.start(3, context)
    actions = torch.randint(A, (before + 20, 3), generator=seeded(1))
    for action in actions[:before]:
        _, state = prior.step(action, state)
    fixed = prior.fixed_state(state, 20).clone()
    shape = fixed.shape
    for action in actions[before:]:
        want, state = prior.step(action, state)
        got, fixed = prior.fixed_step(action, fixed)
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-4)
        assert fixed.shape == shape


class Stepwise:
    """In place of a recording: takes the step each time."""

    made = 0
    agrees = True

    def __init__(self, take, last, state, numbers):
        type(self).made += 1
        self.take = take

    def run(self, last, state, numbers):
        taken, state = [], state.clone()
        for t in range(len(numbers[0])):
            last, state = self.take(last, state, *(each[t] for each in numbers))
            taken.append(last)
        return torch.stack(taken)


@pytest.fixture
def stepwise(monkeypatch):
    monkeypatch.setattr(recordings, "DEVICES", ("cpu",))
    monkeypatch.setattr(recordings, "Recording", Stepwise)
    monkeypatch.setattr(recordings, "WORTH", 16)
    monkeypatch.setattr(Stepwise, "made", 0)
    return monkeypatch


@torch.no_grad()
def test_recorded_plans_are_those_of_steps(stepwise):
    prior = network(TransformerPrior)
    context = {"generator": seeded(3), "method": "ancestral", "temperature": 1.3}
    drawn = prior.sample(200, 30, **context)
    assert Stepwise.made == 1
    stepwise.setattr(recordings, "DEVICES", ())  # what was recorded would be used again
    again = prior.sample(200, 30, **context | {"generator": seeded(3)})
    assert Stepwise.made == 1
    assert float((drawn == again).float().mean()) > 0.999  # but for rounding


def rest(prior, steps=20, number=4, temperature=1.0):
    _, state = prior.start(number)
    uniform = torch.rand(steps, number, generator=seeded(1))
    return NeuralPrior.draw_rest(prior, torch.zeros(number, dtype=torch.long), state, uniform, temperature)


@torch.no_grad()
def test_a_step_is_recorded_once_enough_are_asked_for(stepwise):
    prior = network(GRUPrior)
    assert rest(prior, 8) is None
    assert rest(prior, 7) is None
    assert rest(prior, 1).shape == (4, 1)
    assert rest(prior, 9).shape == (4, 9)
    assert Stepwise.made == 1
    assert rest(prior, 20, number=5).shape == (5, 20)
    assert rest(prior, 20, temperature=2.0).shape == (4, 20)
    assert Stepwise.made == 3
    rest(prior, 20)
    assert Stepwise.made == 3
    stepwise.setattr(recordings, "KEPT", 2)
    rest(prior, 20, number=5)
    rest(prior, 20)
    assert Stepwise.made == 3  # the last two are kept
    rest(prior, 20, temperature=2.0)
    assert Stepwise.made == 4


@torch.no_grad()
def test_a_recording_that_differs_from_its_step_is_not_used(stepwise):
    prior = network(GRUPrior)
    stepwise.setattr(Stepwise, "agrees", False)
    with pytest.warns(UserWarning, match="a recorded step of GRUPrior differs"):
        assert rest(prior) is None
    assert rest(prior) is None
    assert Stepwise.made == 1


def test_what_was_recorded_in_inference_mode_is_not_used_elsewhere(stepwise):
    """Its tensors cannot be written to there."""
    prior = network(GRUPrior)
    with torch.inference_mode():
        rest(prior)
        rest(prior)
    assert Stepwise.made == 1
    with torch.no_grad():
        rest(prior)
    assert Stepwise.made == 2


@torch.no_grad()
def test_other_weights_are_recorded_anew(stepwise):
    prior = network(GRUPrior)
    first = rest(prior)
    with torch.no_grad():
        next(prior.parameters()).neg_()  # in place, which a recording reads
    changed = rest(prior)
    assert Stepwise.made == 1
    assert not changed.equal(first)
    prior.head = torch.nn.Linear(16, A)
    rest(prior)
    assert Stepwise.made == 2


@torch.no_grad()
def test_what_is_not_recorded(stepwise):
    prior = network(GRUPrior)
    with torch.enable_grad():
        assert rest(prior) is None
    assert rest(prior.train()) is None
    with torch.autocast("cpu", torch.bfloat16):
        assert rest(prior.eval()) is None
    stepwise.setattr(recordings, "LARGEST", 10)
    assert rest(prior) is None
    stepwise.setattr(recordings, "LARGEST", 10**6)
    assert rest(prior) is not None
    handle = prior.head.register_forward_hook(lambda *_: None)
    assert rest(prior) is None
    handle.remove()
    assert rest(network(GRUPrior, window=0)) is None
    for kind in (GRUPrior, TransformerPrior):
        assert rest(type("Mine", (kind,), {})(A, 16).eval()) is None


@torch.no_grad()
def test_logits_of_which_nothing_can_be_drawn_are_refused(stepwise):
    prior = network(TransformerPrior)
    prior.head.bias[:] = torch.nan
    with refuses("logits are NaN"):
        rest(prior)


def test_recorded_vectors_are_those_of_steps(stepwise):
    stepwise.setattr(VectorGRU, "draw", VectorGRU.draw_in_steps)  # loops would draw them
    low, high = torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 3.0])
    actions = torch.randn(10, 12, 2, generator=seeded(0)).clamp(-1, 1)
    prior = VectorGRU(low, high, width=8).fit(VectorPlans(actions, low, high), max_steps=5, progress=False)
    drawn = prior.sample(6, 20, past=actions[:3, :4], generator=seeded(1))
    assert Stepwise.made == 1
    share, prior.autoregressive_share = prior.autoregressive_share, 0.9
    prior.sample(6, 20, past=actions[:3, :4], generator=seeded(1))
    assert Stepwise.made == 2  # a recording keeps the numbers that the step found
    prior.autoregressive_share = share
    stepwise.setattr(recordings, "DEVICES", ("cuda",))
    torch.testing.assert_close(prior.sample(6, 20, past=actions[:3, :4], generator=seeded(1)), drawn)
