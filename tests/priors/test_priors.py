"""What every prior promises beside what `check_prior` tests: forecasts, windows, empty batches, checks of its input."""

from functools import partial

import numpy as np
import pytest
import torch

from neuroprior import (
    GRUPrior,
    MarkovPrior,
    Plans,
    SamplingPlanner,
    TransformerPrior,
    UniformPrior,
    load,
    sample,
    save,
)
from neuroprior.priors.learning import training_plans
from neuroprior.sampling import sample_in_world
from tests.support.sources import random_world, refuses, seeded

A, L, C = 3, 7, 4
SMALL = {
    "gru": partial(GRUPrior, A, hidden_size=8, num_layers=2),
    "transformer": partial(TransformerPrior, A, width=16, num_layers=2, num_heads=2),
    "markov": partial(MarkovPrior, A, order=2),
    "uniform": partial(UniformPrior, A),
}
CONTEXTS = {
    "no context": ({}, None),
    "index a plan": ({"num_contexts": C}, "plan"),
    "index a step": ({"num_contexts": C}, "step"),
    "features a plan": ({"context_size": 2}, "plan"),
    "features a step": ({"context_size": 2}, "step"),
}
ALL = [(kind, takes) for kind in ("gru", "transformer") for takes in CONTEXTS]
ALL += [("markov", takes) for takes in ("no context", "index a plan", "index a step")]
ALL += [("uniform", "no context")]


def draw_context(takes, num, length, seed=0):
    arguments, per = CONTEXTS[takes]
    if per is None:
        return None
    drawn = 1 if per == "plan" else length  # that of a plan is the same at each step
    if "num_contexts" in arguments:
        return torch.randint(C, (num, drawn), generator=seeded(seed)).expand(num, length)
    return torch.randn(num, drawn, 2, generator=seeded(seed)).expand(num, length, 2)


def make(kind, takes, window=None, seed=0, **extra):
    """A prior whose predictions depend on all of its input: random weights, or counts of random plans."""
    if kind in ("gru", "transformer"):
        extra |= {} if window is None else {"window": window}
        prior = SMALL[kind](**CONTEXTS[takes][0], **extra, seed=seed)
        with torch.no_grad():
            for weight in prior.parameters():
                weight.mul_(2)  # away from the near-uniform predictions of fresh weights
        return prior.eval()
    prior = SMALL[kind](**CONTEXTS[takes][0])
    plans = torch.randint(A, (60, 5), generator=seeded(seed))
    return prior.fit(Plans(plans, A, context=draw_context(takes, 60, 5)))


def steps(prior, plans, context, per, explicit=False):
    """Logits `[N, L, A]` and the states before each action, by stepping; `explicit` repeats a plan's context."""
    logits, state = prior.start(len(plans), None if context is None else context[:, 0])
    out, states = [logits], [state]
    for t in range(plans.shape[1] - 1):
        current = context[:, t + 1] if per == "step" or (explicit and context is not None) else None
        logits, state = prior.step(plans[:, t], state, current)
        out.append(logits)
        states.append(state)
    return torch.stack(out, 1), states


@pytest.mark.parametrize("end", [False, True])
@pytest.mark.parametrize(("kind", "takes"), ALL)
@torch.no_grad()
def test_forecasts(kind, takes, end, monkeypatch):
    """What is forecast of every action, some plans at a time, is what `log_prob` takes of the one that came."""
    prior = make(kind, takes)
    lengths = torch.tensor([0, 1, 2, 3, 4, 5, 6, 7, 7])
    actions = torch.randint(A, (9, L), generator=seeded(1))
    if end:  # action 2 closes plans, and the prior has learned so
        actions = torch.where(torch.arange(L) == lengths[:, None] - 1, 2, actions.clamp(max=1))
        prior.end = 2
    plans = Plans(actions, A, lengths, context=draw_context(takes, 9, L), end=2 if end else None)
    (whole,) = list(prior.forecasts(plans))
    assert whole[0].actions.equal(plans.actions)
    assert whole[1].shape == (9, L, A)
    within = whole[1][plans.mask()]
    torch.testing.assert_close(within.exp().sum(-1), torch.ones(len(within)))
    taken = whole[1].gather(-1, plans.actions.long()[..., None])[..., 0].masked_fill(~plans.mask(), 0)
    torch.testing.assert_close(taken, prior.action_log_probs(plans))
    torch.testing.assert_close(taken.sum(1), prior.log_prob(plans))
    if not end:
        torch.testing.assert_close(whole[1], prior(plans.actions, plans.context).log_softmax(-1))
    else:  # after the end nothing but it
        steps = plans.actions[:, :-1] == 2
        assert int(steps.sum()) == 6
        assert (whole[1][:, 1:][steps][:, 2] == 0).all()
        assert whole[1][:, 1:][steps][:, :2].isneginf().all()
    monkeypatch.setattr(type(prior), "actions_at_once", 2 * L + 1)
    parts = list(prior.forecasts(plans))
    assert [len(part) for part, _ in parts] == [2, 2, 2, 2, 1]
    assert torch.cat([part.actions for part, _ in parts]).equal(plans.actions)
    torch.testing.assert_close(torch.cat([log_probs for _, log_probs in parts]), whole[1])
    torch.testing.assert_close(prior.log_prob(plans), taken.sum(1))
    monkeypatch.setattr(type(prior), "actions_at_once", 1)  # never fewer than a plan
    assert [len(part) for part, _ in prior.forecasts(plans)] == [1] * 9


def test_forecasts_of_other_plans_are_refused():
    prior = make("markov", "index a plan")
    with refuses("3 actions", "got 4"):
        next(iter(prior.forecasts(Plans(torch.zeros(2, 2).long(), 4, context=torch.zeros(2).long()))))
    with refuses("context"):
        next(iter(prior.forecasts(Plans(torch.zeros(2, 2).long(), A))))
    assert list(prior.forecasts(Plans(torch.zeros(0, 2).long(), A, context=torch.zeros(0).long()))) == []


@pytest.mark.parametrize(("kind", "takes"), [("gru", s) for s in CONTEXTS] + [("transformer", s) for s in CONTEXTS])
@pytest.mark.parametrize("window", [0, 1, 3])
@torch.no_grad()
def test_window(kind, takes, window):
    """Past the window a prediction is that after the last `window` actions had opened a plan, and uses all of them.

    So it is where nothing else reaches further back: in a GRU that forgets its hidden state, in one block of attention.
    """
    prior = make(kind, takes, window, num_layers=1, **({} if kind == "gru" else {"lags": 1}))
    if kind == "gru":
        prior.gru.weight_hh_l0.zero_()
        prior.gru.bias_ih_l0[8:16] = -100  # the update gate keeps nothing
    plans, context = torch.randint(A, (20, L), generator=seeded(3)), draw_context(takes, 20, L)
    if context is not None and kind == "transformer" and window:
        context = context[:, :1].expand_as(context)  # the start symbol keeps the context that it came with
    forward = prior(plans, context)
    for t in range(window, L):
        last = slice(t - window, t + 1)
        opening = prior(plans[:, last], None if context is None else context[:, last])
        torch.testing.assert_close(forward[:, t], opening[:, window], rtol=1e-4, atol=1e-5)
    for age in range(1, L):
        changed = plans.clone()
        changed[:, L - 1 - age] = (changed[:, L - 1 - age] + 1) % A
        differs = (prior(changed, context)[:, -1] - forward[:, -1]).abs().max() > 1e-4
        assert differs == (age <= window)


@pytest.mark.parametrize(("kind", "takes"), ALL)
@pytest.mark.parametrize("size", [(0, 3), (0, 6), (4, 0), (0, 0), (1, 0)])
@torch.no_grad()
def test_empty_batches(kind, takes, size):
    prior, context = make(kind, takes), draw_context(takes, *size)
    plans = torch.zeros(size, dtype=torch.long)
    assert prior(plans, context).shape == (*size, A)
    assert prior.log_prob(Plans(plans, A, context=context)).tolist() == [0.0] * size[0]
    assert prior.sample(*size, context, generator=seeded(0)).shape == size


BAD_CONTEXTS = [
    ("no context", torch.zeros(4).long(), "context"),
    ("no context", torch.zeros(4, 2), "context"),
    ("index a plan", None, "context"),
    ("index a plan", torch.tensor([0, 1, C, 0]), str(C)),
    ("index a plan", torch.tensor([0, 1, -1, 0]), "-1"),
    ("index a plan", torch.zeros(4, 2), "context"),
    ("index a plan", torch.zeros(3).long(), "context"),
    ("index a step", torch.tensor([[0, 1]] * 3 + [[C, 0]]), str(C)),
    ("index a step", torch.zeros(4, 1).long(), "context"),
    ("features a plan", None, "context"),
    ("features a plan", torch.zeros(4, 3), "3]"),
    ("features a plan", torch.zeros(4).long(), "context"),
    ("features a plan", torch.tensor([[0, 1], [0, 1], [0, float("nan")], [0, 1]]), "nan"),
    ("features a step", torch.zeros(4, 2, 3), "[4, 2, 3]"),
]
CALLS = {
    "log_prob": lambda prior, plans, context: prior.log_prob(Plans(plans, A, context=context)),
    "sample": lambda prior, plans, context: prior.sample(*plans.shape, context),
    "the sampler": lambda prior, plans, context: sample(prior, *plans.shape, context),
    "fit": lambda prior, plans, context: prior.fit(Plans(plans, A, context=context)),
}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize(
    ("kind", "takes", "context", "word"),
    [(kind, *bad) for kind in SMALL for bad in BAD_CONTEXTS if (kind, bad[0]) in ALL],
)
def test_refuses_a_context(call, kind, takes, context, word):
    if call == "fit" and takes == "no context":  # which ignores the context of the plans
        assert training_plans(make(kind, takes), Plans(torch.zeros(4, 2).long(), A, context=context)).context is None
        return
    with refuses(word):
        CALLS[call](make(kind, takes), torch.zeros(4, 2, dtype=torch.long), context)


@pytest.mark.parametrize(("kind", "takes"), [case for case in ALL if case[1] != "no context"])
def test_refuses_a_world_that_shows_something_else(kind, takes):
    """The world's six cells are neither below `num_contexts` = 4 nor features."""
    world = random_world(0)
    with refuses("context"):
        sample_in_world(make(kind, takes), world, torch.arange(6), 50, 4, generator=seeded(0))


@pytest.mark.parametrize("kind", SMALL)
@pytest.mark.parametrize(
    ("plans", "words"),
    [
        (torch.tensor([[0, 1], [A, 0]]), ["actions[1, 0]", str(A)]),
        (torch.tensor([[0, -1]]), ["actions[0, 1]", "-1"]),
        (torch.zeros(2, 2), ["actions", "float32"]),
        (torch.zeros(2).long(), ["actions", "[2]"]),
        (Plans(torch.zeros(4, 2).long(), A + 1), [str(A), str(A + 1)]),
    ],
)
def test_refuses_plans(kind, plans, words):
    prior = make(kind, "no context")
    for call in (prior.log_prob, prior.fit):
        with refuses(*words):
            call(plans)


def test_integers_of_other_libraries_are_integers(tmp_path):
    prior = MarkovPrior(np.int32(4), np.int64(1)).fit(torch.randint(4, (20, 6)))
    assert load(save(prior, tmp_path)).config == MarkovPrior(4, 1).config
    assert prior.sample(np.int64(3), np.int64(5)).shape == (3, 5)
    assert SamplingPlanner(UniformPrior(np.int64(4)), np.int64(3), np.int64(5)).length == 3
    assert Plans(torch.zeros(2, 3, dtype=torch.long), np.int64(3)).num_actions == 3
    for wrong in (True, np.bool_(True), 3.0, "3", torch.tensor(True)):
        with pytest.raises(ValueError, match="num_actions"):
            UniformPrior(wrong)
