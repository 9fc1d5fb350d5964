"""Neural priors: fitting, the exact divergence from a known source, reproducibility, and what is refused."""

import random
from dataclasses import replace

import numpy as np
import pytest
import torch

from neuroprior import GRUPrior, Plans, TransformerPrior, load, save
from neuroprior.plans import expand_context
from neuroprior.priors.neural import gru
from neuroprior.sampling.states import map_state, tensors_in
from tests.support.sources import best_plan_distribution, best_plans, bits_per_action, every_plan, refuses, seeded

BOTH = pytest.mark.parametrize("kind", [GRUPrior, TransformerPrior])
QUICK = {"max_steps": 6, "progress": False}


def small(kind, num_actions=3, **arguments):
    size = {"hidden_size": 8} if kind is GRUPrior else {"width": 8, "num_layers": 1, "num_heads": 2}
    return kind(num_actions, **size, **arguments)


def weights(prior):
    return torch.cat([weight.detach().flatten() for weight in prior.parameters()])


@pytest.mark.parametrize("kind", [GRUPrior, pytest.param(TransformerPrior, marks=pytest.mark.slow)])
def test_divergence_from_the_torus_source(kind):
    """With default settings but fewer steps, in bits per action over all 256 plans; Markov-2 is at .01387 at best."""
    plans = Plans(best_plans(100_000, seed=0), 4)
    prior = kind(4).fit(plans, generator=seeded(0), max_steps=150, progress=False)
    with torch.no_grad():
        log_probs = prior.log_prob(every_plan(4, 4))
    assert float(log_probs.exp().sum()) == pytest.approx(1, abs=1e-4)
    assert bits_per_action(best_plan_distribution(), log_probs, 4) < 0.005
    assert prior.window == 3
    assert not prior.training


@BOTH
def test_same_seed_same_weights_and_global_generators_are_left_alone(kind):
    plans, found = Plans(torch.randint(3, (300, 5), generator=seeded(0)), 3), []
    for seed in (1, 2):
        torch.manual_seed(seed)
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        before = torch.get_rng_state(), random.getstate(), np.random.get_state()[1].copy()  # noqa: NPY002
        found.append(weights(small(kind, seed=3).fit(plans, generator=seeded(5), **QUICK)))
        small(kind).fit(plans, **QUICK).sample(50, 4)
        assert torch.equal(before[0], torch.get_rng_state())
        assert before[1] == random.getstate()
        assert (before[2] == np.random.get_state()[1]).all()  # noqa: NPY002
    assert torch.equal(*found)
    assert torch.equal(weights(small(kind, seed=3)), weights(small(kind, seed=3)))
    assert not torch.equal(weights(small(kind, seed=3)), weights(small(kind, seed=4)))
    assert not torch.equal(found[0], weights(small(kind, seed=3)))
    assert not torch.equal(found[0], weights(small(kind, seed=3).fit(plans, generator=seeded(6), **QUICK)))


@BOTH
@pytest.mark.parametrize("per", ["plan", "step"])
@pytest.mark.parametrize("what", ["index", "features"])
def test_learns_from_each_kind_of_context(kind, what, per):
    """Actions are what the context says: a prior that takes it predicts them far better than uniformly."""
    context = torch.randint(3, (600, 4) if per == "step" else (600, 1), generator=seeded(0))
    actions = context.expand(600, 4)
    context = context if per == "step" else context[:, 0]
    arguments = {"num_contexts": 3}
    if what == "features":
        context, arguments = torch.nn.functional.one_hot(context, 3).float(), {"context_size": 3}
    prior = small(kind, dropout=0.0, **arguments)
    prior.fit(Plans(actions, 3, context=context), generator=seeded(0), max_steps=45, learning_rate=0.05, progress=False)
    assert prior.context_per == per
    assert prior.log_prob(Plans(actions, 3, context=context)).exp().mean() > 0.7  # uniform: 1/81
    wrong = context.roll(1, -1) if what == "features" else (context + 1) % 3
    assert prior.log_prob(Plans(actions, 3, context=wrong)).exp().mean() < 1 / 81


@BOTH
def test_fit_sets_the_window_to_the_longest_plan_unless_it_is_given(kind):
    prior, given = small(kind), small(kind, window=1)
    for lengths, window in ((None, 4), (torch.tensor([1, 3] * 10), 2)):
        plans = Plans(torch.randint(3, (20, 5), generator=seeded(0)), 3, lengths)
        assert prior.fit(plans, **QUICK | {"max_steps": 1}).window == window
        assert given.fit(plans, **QUICK | {"max_steps": 1}).window == 1


@BOTH
@pytest.mark.parametrize("shape", [(1, 1), (0, 4), (9, 0)])
def test_refuses_too_few_plans(kind, shape):
    with refuses("plans"):
        small(kind).fit(torch.zeros(shape, dtype=torch.long), **QUICK)


@BOTH
def test_a_single_group_is_no_group(kind):
    """Plans of one animal are held out as if they had no group."""
    actions = torch.randint(3, (9, 4), generator=seeded(3))
    groups = (torch.zeros(9).long(), None)
    one, none = (small(kind).fit(Plans(actions, 3, group=g), generator=seeded(0), **QUICK) for g in groups)
    assert one.log_prob(actions).equal(none.log_prob(actions))


@BOTH
def test_a_refused_fit_is_not_learned_from(kind):
    """The next one learns as the first of a new network does, with sizes of its own."""
    plans = Plans(torch.randint(3, (40, 6), generator=seeded(0)), 3, action_names=("a", "b", "c"))
    others = {"action_names": replace(plans, action_names=("b", "a", "c")), "3": Plans(plans.actions, 4), "2.0": 2.0}
    prior = kind(3)
    for word, validation in others.items():
        with refuses(word):
            prior.fit(plans, validation=validation, **QUICK)
    assert prior.action_names is None
    fresh = kind(3).fit(plans, generator=seeded(1), **QUICK)
    assert weights(prior.fit(plans, generator=seeded(1), **QUICK)).equal(weights(fresh))


@pytest.mark.parametrize("batch", [3, 5])  # fewer than actions, and more
@pytest.mark.parametrize("lags", [1, 3])
@pytest.mark.parametrize("num_layers", [1, 2])
@pytest.mark.parametrize("takes", [{}, {"num_contexts": 3}, {"context_size": 2}])
def test_single_steps_of_a_gru_are_those_of_torch(batch, lags, num_layers, takes, monkeypatch):
    """A step has a path of its own, compiled in single precision, and under autocast that of sequences."""
    prior = GRUPrior(4, hidden_size=8, num_layers=num_layers, lags=lags, dropout=0.3, seed=1, **takes)
    action = torch.randint(4, (6, batch), generator=seeded(0))
    features = torch.rand(batch, 2, generator=seeded(1))
    context = {"num_contexts": torch.arange(batch) % 3, "context_size": features}
    current = next((context[name] for name in takes), None)
    one_step, calls = gru.gru_step, []
    monkeypatch.setattr(gru, "gru_step", lambda *given, **rows: calls.append(given) or one_step(*given, **rows))

    def steps():
        logits, state = prior.start(batch, current)
        predicted = [logits]
        for one in action:
            logits, state = prior.step(one, state)
            predicted.append(logits)
        return torch.stack(predicted)

    fast = steps()
    assert len(calls) == len(action)
    assert not fast.requires_grad
    with torch.autocast("cpu", torch.bfloat16):
        rough = steps()
    assert len(calls) == len(action)
    throughout = None if current is None else expand_context(current, len(action) + 1)
    whole = prior(torch.cat([action, action[:1]]).T, throughout).transpose(0, 1)
    torch.testing.assert_close(fast, whole, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(rough.to(fast), fast, atol=0.05, rtol=0.05)


@pytest.mark.parametrize("num_layers", [1, 2])
@pytest.mark.parametrize("begun", [False, True])
def test_a_compiled_sequence_of_a_gru_is_that_of_torch(num_layers, begun):
    """Its output, its last states, and the gradients of weights, inputs and first states."""
    network = torch.nn.GRU(8, 8, num_layers, batch_first=True)
    inputs = torch.randn(5, 7, 8, generator=seeded(0), requires_grad=True)
    first = torch.randn(num_layers, 5, 8, generator=seeded(1), requires_grad=True)
    begin, found = first if begun else None, []
    learned = [*network.parameters(), inputs, *([first] if begun else [])]
    for out, last in (network(inputs, begin), gru.gru_sequence(network, inputs, begin)):
        for values in learned:
            values.grad = None
        (out.sin().sum() + (last**2).sum()).backward()
        found.append([out.detach(), last.detach(), *(values.grad for values in learned)])
    for plain, fast in zip(*found, strict=True):
        torch.testing.assert_close(fast, plain, atol=1e-5, rtol=1e-4)
    with torch.no_grad():
        assert torch.allclose(gru.gru_sequence(network, inputs, begin)[0], found[0][0], atol=1e-6)


@pytest.mark.parametrize(
    ("made", "context"),
    [
        ({"lags": 1}, None),
        ({"lags": 16}, None),
        ({"lags": 16, "window": 5}, None),
        ({"lags": 3, "window": 2}, None),
        ({"lags": 1, "num_layers": 2}, None),
        ({"lags": 2, "num_layers": 3, "num_contexts": 5}, torch.arange(3000) % 5),
        ({"lags": 2, "num_contexts": 5}, torch.arange(3000) % 5),
        ({"lags": 2, "context_size": 2}, torch.randn(3000, 2, generator=seeded(3))),
    ],
    ids=lambda given: str(given) if isinstance(given, dict) else "",
)
def test_plans_that_a_compiled_loop_draws_to_their_ends_are_those_of_torch(made, context, monkeypatch):
    """With the same numbers; also past the window, with a temperature, and after a past."""
    prior = GRUPrior(5, 16, **made)
    with torch.no_grad():
        for weights in prior.parameters():
            weights.mul_(3)
    rest, loops = prior.draw_rest, []
    prior.draw_rest = lambda *given: loops.append(rest(*given)) or loops[-1]
    found = []
    for draw_from in (1, 2**62):
        monkeypatch.setattr(gru, "DRAW_FROM", draw_from)
        how = {"context": context, "past": torch.tensor([3, 1, 4]), "temperature": 0.7}
        found.append(prior.sample(3000, 12, **how, generator=seeded(4)))
    assert torch.equal(*found)
    assert any(plans is not None for plans in loops)


@pytest.mark.parametrize("changed", ["wide", "other head", "hooked"])
def test_other_networks_are_stepped(changed):
    """Where the loop would be slower, or would leave out what was changed."""
    prior = GRUPrior(5, 256 if changed == "wide" else 16)
    if changed == "other head":
        prior.head = torch.nn.Sequential(prior.head)
    elif changed == "hooked":
        prior.head.register_forward_hook(lambda module, given, logits: logits * 0.1)
    _, state = prior.start(2000)
    with torch.no_grad():
        assert prior.draw_rest(torch.zeros(2000, dtype=torch.long), state, torch.rand(9, 2000), 1.0) is None
    assert prior.sample(2000, 12, generator=seeded(0)).shape == (2000, 12)


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("number", [5, 20_000])
def test_steps_are_those_of_torch_over_the_whole_range_of_activations(layers, number):
    """Of few rows and of many, in parts; of states that have other numbers beside them; and of none."""
    network = torch.nn.GRU(16, 16, layers, batch_first=True)
    with torch.no_grad():
        for weights in network.parameters():
            weights.mul_(8)
    below, state = torch.randn(4, 16, generator=seeded(0)), torch.rand(layers, number, 17, generator=seeded(1)) * 2 - 1
    before, rows = state[..., :16], torch.arange(number, dtype=torch.int32) % 4
    with torch.no_grad():
        out, after = gru.gru_step(network, below, before, rows)
        plain, last = network(below[rows][:, None], before.contiguous())
        assert gru.gru_step(network, below, before[:, :0], rows[:0])[0].shape == (0, 16)
    assert torch.allclose(out, plain[:, 0], atol=1e-5)
    assert torch.allclose(after, last, atol=1e-5)


@pytest.mark.parametrize("lags", [1, 3])
@pytest.mark.parametrize(("window", "span"), [(None, None), (1, None), (4, None), (9, None), (None, 3), (None, 1)])
@pytest.mark.parametrize("takes", [{}, {"num_contexts": 3}, {"context_size": 2}])
def test_steps_of_a_transformer_are_what_it_reads_at_once(lags, window, span, takes):
    """Also where the cache is full, and steps are dropped from it; a step leaves the state before it as it was."""
    prior = TransformerPrior(4, width=8, num_heads=2, window=window, lags=lags, dropout=0.3, seed=1, **takes)
    prior.span, batch = span, 3
    action = torch.randint(4, (13, batch), generator=seeded(0))
    context = {"num_contexts": torch.arange(batch), "context_size": torch.rand(batch, 2, generator=seeded(1))}
    current = next((context[name] for name in takes), None)
    logits, state = prior.start(batch, current)
    predicted = [logits]
    for one in action:
        before = map_state(torch.clone, state)
        logits, after = prior.step(one, state)
        assert all(map(torch.equal, tensors_in(before), tensors_in(state)))
        predicted, state = [*predicted, logits], after
    throughout = None if current is None else expand_context(current, len(action) + 1)
    whole = prior(torch.cat([action, action[:1]]).T, throughout).detach().transpose(0, 1)
    torch.testing.assert_close(whole, torch.stack(predicted), atol=1e-5, rtol=1e-4)
    cache = (state[1] if takes else state)[0][0]
    assert cache.shape[1] == min(14, prior.most_kept or 14)


class NeverFirst(TransformerPrior):
    """Without the first action, by steps of its own."""

    def step(self, action, state, context=None):
        logits, state = super().step(action, state, context)
        return logits.index_fill(1, torch.tensor(0), -torch.inf), state


class Loud(TransformerPrior):
    """Reads in a way of its own."""

    def encode(self, previous, context, hidden=None):
        logits, hidden = super().encode(previous, context, hidden)
        return 2 * logits + 1, hidden


@pytest.mark.parametrize("kind", [NeverFirst, Loud])
def test_subclasses_that_step_or_read_in_their_own_way_do(kind):
    prior = kind(3, width=8, num_heads=2)
    with torch.no_grad():
        _, state = prior.start(4)
        action = torch.tensor([0, 1, 2, 0])
        want = kind.encode(prior, action[:, None], None, state)[0][:, 0]
        logits, _ = prior.step(action, state)
        assert torch.allclose(logits[:, 1:], want[:, 1:], atol=1e-5)
        assert (logits[:, 0] == -torch.inf).all() == (kind is NeverFirst)


@BOTH
def test_sizes_follow_from_the_first_plans(kind, tmp_path):
    """Short plans: small, with dropout where they are few; long sequences: the wider the more there are.

    Of long sequences a GRU, then of two layers, is shown no lags, a transformer only none where they are few.
    """

    def plans(num: int, length: int, actions: int = 3) -> Plans:
        return Plans(torch.randint(actions, (num, length), generator=seeded(0)), actions)

    quick = {"max_steps": 1, "progress": False}
    for few, expected in (
        (plans(100, 8), (64, 16, 0.2)),
        (plans(3000, 8), (64, 16, 0.0)),
        (plans(20, 100), (64, 1, 0.3)),
        (plans(300, 100), (128, 1, 0.3)),
        (plans(300, 100, 17), (256, 1, 0.4)),
    ):
        prior = kind(few.num_actions).fit(few, generator=seeded(0), **quick)
        if kind is TransformerPrior:
            expected = (64, 1 if len(few) == 20 else 16, expected[2])
        assert (prior.width, prior.lags, prior.dropout) == expected
        assert prior.num_layers == (2 if kind is TransformerPrior or few.max_length == 100 else 1)
    again = load(save(prior, tmp_path / "prior"))
    for kept in (prior, again):  # what has learned keeps its sizes
        kept.fit(plans(100, 8, 17), generator=seeded(0), **quick)
        assert (kept.lags, kept.dropout, kept.num_layers) == (*expected[1:], 2)
    given = kind(3, 16, lags=2).fit(plans(20, 100), generator=seeded(0), **quick)
    assert (given.width, given.lags, given.dropout, given.num_layers) == (16, 2, 0.3, 2)
    assert kind(3, num_layers=3).fit(plans(20, 100), generator=seeded(0), **quick).num_layers == 3


def test_sizes_that_were_chosen_are_restored_and_trained_further():
    """As where an agent is restored: into a prior that was made as the saved one was."""
    plans = Plans(torch.randint(3, (8, 40), generator=torch.Generator().manual_seed(0)), 3)
    how = {"max_steps": 1, "progress": False}
    first, second = GRUPrior(3).fit(plans, generator=torch.Generator().manual_seed(0), **how), GRUPrior(3)
    assert first.lags != second.lags
    second.restore(first.learned)
    second.load_state_dict(first.state_dict())
    assert second.log_prob(plans).equal(first.log_prob(plans))
    for prior in (first, second):
        prior.fit(plans, generator=torch.Generator().manual_seed(1), **how)
    assert second.log_prob(plans).equal(first.log_prob(plans))
