"""Plans that go on from a kept state, and of actions that a mask allows."""

import numpy as np
import pytest
import torch

from neuroprior import (
    GRUPrior,
    MarkovPrior,
    Plans,
    TransformerPrior,
)
from neuroprior.sampling.states import map_state
from tests.support.sources import every_plan, fits, refuses, seeded


def drawn_priors():
    """Chains that were counted, and networks of random weights, on four actions; some under one of three contexts."""
    plans = torch.randint(4, (60, 7), generator=seeded(0))
    context = torch.randint(3, (60, 7), generator=seeded(1))
    return {
        "chain": MarkovPrior(4, 2).fit(plans),
        "chain in contexts": MarkovPrior(4, 1, num_contexts=3).fit(Plans(plans, 4, context=context)),
        "gru": GRUPrior(4, hidden_size=8, lags=3, seed=1),
        "gru of features": GRUPrior(4, hidden_size=8, context_size=2, seed=2),
        "transformer": TransformerPrior(4, width=8, num_heads=2, num_layers=1, seed=3),
    }


PRIORS = drawn_priors()
PAST = torch.tensor([3, 0, 1, 1, 2])


def first_context(prior, number):
    if prior.num_contexts is not None:
        return torch.arange(number) % 3
    return None if prior.context_size is None else torch.randn(number, 2, generator=seeded(4))


def stepped(prior, number):
    """What `step` returned after the past."""
    state = prior.start(number, first_context(prior, number))
    for action in PAST:
        state = prior.step(action.expand(number), state[1])
    return state


@pytest.mark.parametrize("name", PRIORS)
def test_a_kept_state_goes_on_as_its_past_does(name):
    """The same plans from the same seed, twice: the state is left as it is."""
    prior, number = PRIORS[name], 200
    context = first_context(prior, number)
    state = stepped(prior, number)
    before = map_state(torch.clone, state[1])
    past = PAST.expand(number, -1)  # each plan is drawn by itself, as from a state of as many rows
    due = prior.sample(number, 6, context, past=past, generator=seeded(5))
    for _ in range(2):
        assert prior.sample(number, 6, state=state, generator=seeded(5)).equal(due)
    same = map_state(lambda one, other: (one == other).all(), before, state[1])
    assert same if isinstance(same, torch.Tensor) else all(same)


@pytest.mark.parametrize("method", ["auto", "tree", "ancestral"])
@pytest.mark.parametrize("name", PRIORS)
def test_plans_of_one_kept_state_have_its_distribution(name, method):
    prior = PRIORS[name]
    state, context = stepped(prior, 1), first_context(prior, 1)
    plans = prior.sample(20_000, 3, state=state, method=method, generator=seeded(6))
    every = every_plan(4, 3)
    whole = torch.cat([PAST.expand(len(every), -1), every], 1)
    contexts = None if context is None else context.expand(len(every), *context.shape[1:])
    log_probs = prior.action_log_probs(Plans(whole, 4, context=contexts))[:, len(PAST) :].sum(1)
    assert fits(plans, log_probs.exp(), 4)


def masked_log_probs(prior, context, allowed):
    """The log-probabilities of all plans of three actions, where `allowed(plan[:t])` says which may come next."""
    every = every_plan(4, 3)
    contexts = None if context is None else context.expand(len(every), *context.shape[1:])
    [(_, forecasts)] = prior.forecasts(Plans(every, 4, context=contexts))
    total = torch.zeros(len(every))
    for n, plan in enumerate(every.tolist()):
        for t, action in enumerate(plan):
            may = torch.tensor(allowed(plan[:t]))
            logits = forecasts[n, t].masked_fill(~may, -torch.inf).log_softmax(-1)
            total[n] += logits[action]
    return total


@pytest.mark.parametrize("name", PRIORS)
def test_masked_plans_have_the_distribution_of_what_is_allowed(name):
    """By a mask for all steps, one for each, one for each plan and step, and a function: no action twice running."""
    prior = PRIORS[name]
    context = first_context(prior, 1)
    contexts = None if context is None else context.expand(20_000, *context.shape[1:])
    every_step = torch.tensor([[True, False, True, True], [False, True, True, False], [True, True, True, True]])

    def other_than_last(plans):
        may = np.ones((len(plans), 4), dtype=bool)
        if plans.shape[1]:
            may[np.arange(len(plans)), plans[:, -1].numpy()] = False
        return may

    for mask, allowed in (
        (every_step[0], lambda before: every_step[0].tolist()),
        (every_step, lambda before: every_step[len(before)].tolist()),
        (every_step.expand(20_000, 3, 4), lambda before: every_step[len(before)].tolist()),
        (other_than_last, lambda before: [not before or action != before[-1] for action in range(4)]),
    ):
        plans = prior.sample(20_000, 3, contexts, mask=mask, generator=seeded(7))
        assert fits(plans, masked_log_probs(prior, context, allowed).exp(), 4)


def test_a_mask_holds_after_a_past_and_in_each_context():
    prior = PRIORS["chain in contexts"]
    context = torch.tensor([0, 1, 2, 1] * 50)
    mask = torch.ones(200, 5, 4, dtype=torch.bool)
    mask[torch.arange(200)[:, None], torch.arange(5), (torch.arange(200)[:, None] + torch.arange(5)) % 4] = False
    plans = prior.sample(200, 5, context, past=PAST, mask=mask, generator=seeded(8))
    assert not (plans == (torch.arange(200)[:, None] + torch.arange(5)) % 4).any()
    alone = torch.zeros(4, dtype=torch.bool).index_fill(0, torch.tensor(2), True)
    assert (prior.sample(9, 4, torch.zeros(9, dtype=torch.long), mask=alone) == 2).all()


def test_what_is_no_mask_or_state_is_refused():
    chain, state = PRIORS["chain"], stepped(PRIORS["chain"], 2)
    with refuses("mask", "got torch.float32 [4]"):
        chain.sample(3, 2, mask=torch.ones(4))
    with refuses("mask", "must be bool [4] or [2, 4] or [3, 2, 4], got torch.bool [3, 4]"):
        chain.sample(3, 2, mask=torch.ones(3, 4, dtype=torch.bool))
    with refuses("mask", "must return bool [3, 4], got torch.bool [4]"):
        chain.sample(3, 2, mask=lambda plans: torch.ones(4, dtype=torch.bool))
    with refuses("`mask` must return bool [3, 4], got NoneType"):
        chain.sample(3, 2, mask=lambda plans: None)
    with refuses("`mask` must be bool", "got torch.int64 [4]"):
        chain.sample(3, 2, mask=torch.tensor([0, 1, 2, 1]))
    with refuses("`mask` must allow an action in each plan"):
        chain.sample(3, 2, mask=torch.zeros(4, dtype=torch.bool))
    with refuses("state", "of 1 row or of num_plans = 3"):
        chain.sample(3, 2, state=state)
    with refuses("state", "what `start` or `step` returned"):
        chain.sample(3, 2, state=state[1])
    with refuses("past", "must be None with a state"):
        chain.sample(2, 2, state=state, past=PAST)
    with refuses("context", "one per step with a state"):
        PRIORS["chain in contexts"].sample(2, 2, torch.tensor([0, 1]), state=stepped(PRIORS["chain in contexts"], 2))


@pytest.mark.parametrize("mask", [[0, 0, 1, 0], torch.tensor([0, 0, 1, 0]), torch.tensor([0, 0, 1, 0]).bool()])
def test_masks_may_be_ones_and_zeros(mask):
    assert (PRIORS["chain"].sample(5, 3, mask=mask) == 2).all()
