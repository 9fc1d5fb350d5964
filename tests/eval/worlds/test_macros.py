"""Macro-actions: what is found, by brute force; a plan's probability is the sum over all ways to write it."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.worlds.macros import MacroPrior, learn_macros
from neuroprior import MarkovPrior, Plans
from tests.support.sources import every_plan, refuses, seeded


def recoded_by_hand(plan, pair, new):
    """One plan with a pair replaced from left to right."""
    found, k = [], 0
    while k < len(plan):
        hit = tuple(plan[k : k + 2]) == pair
        found.append(new if hit else plan[k])
        k += 1 + hit
    return found


def bits(plans):
    """Each symbol coded by its frequency."""
    symbols = [symbol for plan in plans for symbol in plan]
    return sum(-math.log2(symbols.count(symbol) / len(symbols)) for symbol in symbols)


def pairs_by_hand(plans, kinds):
    """How often each pair is replaced, and the bits that it saves, by replacing it."""
    found = {}
    for pair in itertools.product(range(kinds), repeat=2):
        after = [recoded_by_hand(plan, pair, kinds) for plan in plans]
        count = sum(plan.count(kinds) for plan in after)
        if count > 1:
            found[pair] = count, bits(plans) - bits(after) - 2 * math.log2(kinds)
    return found


@settings(deadline=None, max_examples=60)
@given(plans=st.lists(st.lists(st.integers(0, 2), min_size=1, max_size=12), min_size=1, max_size=6))
def test_macros_are_those_found_by_hand(plans):
    lengths = torch.tensor([len(plan) for plan in plans])
    actions = torch.tensor([[*plan, *[0] * (12 - len(plan))] for plan in plans])
    macros, recoded = learn_macros(Plans(actions, 3, lengths), 3)
    symbols, meaning = [list(plan) for plan in plans], [(0,), (1,), (2,)]
    for macro in macros:
        pairs = pairs_by_hand(symbols, len(meaning))
        assert macro.count == max(count for count, _ in pairs.values())
        same = [pair for pair in pairs if meaning[pair[0]] + meaning[pair[1]] == macro.actions]
        pair = max(same, key=lambda one: pairs[one][0])
        assert (macro.count, macro.gain) == (pairs[pair][0], pytest.approx(pairs[pair][1], abs=1e-6))
        symbols = [recoded_by_hand(plan, pair, len(meaning)) for plan in symbols]
        meaning.append(macro.actions)
    if len(macros) < 3:
        assert not pairs_by_hand(symbols, len(meaning))
    for row, (plan, own) in enumerate(zip(plans, symbols, strict=True)):
        predicted = recoded.actions[row, : recoded.lengths[row]].tolist()
        assert predicted == own
        assert [action for symbol in predicted for action in meaning[symbol]] == plan


def all_ways(plan, macros, actions):
    """All sequences of symbols that read as a plan, the last of them perhaps cut off."""
    meaning = [(a,) for a in range(actions)] + [macro.actions for macro in macros]
    if not plan:
        return [()]
    found = []
    for symbol, own in enumerate(meaning):
        if own[: len(plan)] == plan[: len(own)]:
            found += [(symbol, *rest) for rest in all_ways(plan[len(own) :], macros, actions)]
    return found


def fitted(order):
    plans = (
        MarkovPrior(3, 2)
        .fit(torch.tensor([[0, 1, 2, 0, 1, 2, 2, 1], [0, 1, 1, 0, 1, 2, 0, 0]]))
        .sample(300, 10, generator=seeded(0))
    )
    return MacroPrior(3, 4, order).fit(plans)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_probabilities_are_sums_over_all_ways(order):
    prior = fitted(order)
    assert len(prior.macros) >= 2
    plans = every_plan(3, 5)
    known = 3 + len(prior.macros)
    found = prior.log_prob(plans).double().exp()
    for row in range(0, len(plans), 11):
        total = 0.0
        for way in all_ways(tuple(plans[row].tolist()), prior.macros, 3):
            # Macros that were not learned are never taken.
            predicted = prior.chain(torch.tensor([way]))[..., :known].log_softmax(-1).double()
            total += float(predicted.gather(2, torch.tensor([way])[..., None]).sum().exp())
        assert float(found[row]) == pytest.approx(total, rel=1e-4)
    assert float(found.sum()) == pytest.approx(1, abs=1e-4)


def test_before_it_learned_it_has_no_macros():
    plans = every_plan(3, 4)
    assert float(MacroPrior(3, 2, 1).log_prob(plans).exp().sum()) == pytest.approx(1, abs=1e-5)


def test_an_end_symbol_is_refused():
    prior = MacroPrior(2, 1)
    with refuses("end symbol"):
        prior.fit(Plans(torch.zeros(4, 3, dtype=torch.long), 2, end=1))
    assert prior.end is None


def test_nothing_to_find():
    for plans in (Plans(torch.zeros(3, 0, dtype=torch.long), 2), Plans(torch.tensor([[0, 1]]), 2)):
        macros, recoded = learn_macros(plans, 3)
        assert macros == []
        assert recoded.actions.shape == plans.actions.shape
