"""Macro-actions: what is found, by brute force; a plan's probability is the sum over all ways to write it."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import (
    ContextTreePrior,
    GRUPrior,
    MarkovPrior,
    Plans,
    SamplingPlanner,
    TransformerPrior,
    UniformPrior,
    load,
    save,
)
from neuroprior.priors import MacroPrior, learn_macros
from neuroprior.priors.macros import CRITERIA
from neuroprior.testing import check_prior
from tests.support.sources import every_plan, random_world, refuses, seeded


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


def merits(plans, kinds, by):
    """The merit of each pair, by replacing it."""
    found = {}
    for pair in itertools.product(range(kinds), repeat=2):
        after = [recoded_by_hand(plan, pair, kinds) for plan in plans]
        count = sum(plan.count(kinds) for plan in after)
        if count < 2:
            continue
        total = sum(map(len, plans))
        share = [sum(plan.count(symbol) for plan in plans) / total for symbol in pair]
        gain = bits(plans) - bits(after) - 2 * math.log2(kinds)
        information = count * math.log2(count / total / math.prod(share))
        found[pair] = {"count": count, "information": information, "compression": gain}[by], count, gain
    return found


@settings(deadline=None, max_examples=60)
@given(
    plans=st.lists(st.lists(st.integers(0, 2), min_size=1, max_size=12), min_size=1, max_size=6),
    by=st.sampled_from(CRITERIA),
)
def test_macros_are_those_found_by_hand(plans, by):
    lengths = torch.tensor([len(plan) for plan in plans])
    actions = torch.tensor([[*plan, *[0] * (12 - len(plan))] for plan in plans])
    macros, recoded = learn_macros(Plans(actions, 3, lengths), 3, by)
    symbols, meaning = [list(plan) for plan in plans], [(0,), (1,), (2,)]
    for macro in macros:
        all_merits = merits(symbols, len(meaning), by)
        best = max(merit for merit, _, _ in all_merits.values())
        pairs = [pair for pair in all_merits if meaning[pair[0]] + meaning[pair[1]] == macro.actions]
        pair = max(pairs, key=lambda one: all_merits[one][0])
        merit, count, gain = all_merits[pair]
        assert merit == pytest.approx(best)
        assert (macro.count, macro.gain) == (count, pytest.approx(gain, abs=1e-6))
        symbols = [recoded_by_hand(plan, pair, len(meaning)) for plan in symbols]
        meaning.append(macro.actions)
    if len(macros) < 3:
        left = merits(symbols, len(meaning), by)
        assert not left or max(merit for merit, _, _ in left.values()) <= 1e-9
    for row, (plan, own) in enumerate(zip(plans, symbols, strict=True)):
        predicted = recoded.actions[row, : recoded.lengths[row]].tolist()
        assert predicted == own
        assert [action for symbol in predicted for action in meaning[symbol]] == plan


def test_what_plans_repeat_is_found():
    """Plans of three words among noise: the words are found."""
    words = [(0, 1, 2, 3), (3, 3, 1), (2, 0, 0)]
    generator = seeded(0)
    plans = []
    for _ in range(400):
        plan = []
        while len(plan) < 24:
            k = int(torch.randint(5, (), generator=generator))
            plan += words[k] if k < 3 else [int(torch.randint(4, (), generator=generator))]
        plans.append(plan[:24])
    for by in CRITERIA:
        macros, _ = learn_macros(Plans(torch.tensor(plans), 4), 12, by)
        found = {macro.actions for macro in macros}
        assert (0, 1, 2, 3) in found
        assert len(found & set(words)) >= 2
        assert macros[0].gain > 100


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


def fitted(inner, **settings):
    plans = (
        MarkovPrior(3, 2)
        .fit(torch.tensor([[0, 1, 2, 0, 1, 2, 2, 1], [0, 1, 1, 0, 1, 2, 0, 0]]))
        .sample(300, 10, generator=seeded(0))
    )
    return MacroPrior(3, inner).fit(plans, generator=seeded(1), **settings)


INNER = {
    "uniform": lambda: UniformPrior(7),
    "markov-0": lambda: MarkovPrior(7, 0),
    "markov-2": lambda: MarkovPrior(7, 2),
    "tree": lambda: ContextTreePrior(7, 3),
    "gru": lambda: GRUPrior(7, hidden_size=8, lags=2),
}


@pytest.mark.parametrize("inner", INNER.values(), ids=INNER)
def test_probabilities_are_sums_over_all_ways(inner):
    quick = {"max_steps": 3, "progress": False} if inner is INNER["gru"] else {}
    prior = fitted(inner(), **quick)
    assert len(prior.macros) >= 2
    plans = every_plan(3, 5)
    known = 3 + len(prior.macros)
    with torch.no_grad():
        found = prior.log_prob(plans).double().exp()
        for row in range(0, len(plans), 11):
            total = 0.0
            for way in all_ways(tuple(plans[row].tolist()), prior.macros, 3):
                # Macros that were not found are never taken.
                predicted = prior.inner(torch.tensor([way]))[..., :known].log_softmax(-1).double()
                total += float(predicted.gather(2, torch.tensor([way])[..., None]).sum().exp())
            assert float(found[row]) == pytest.approx(total, rel=1e-4)
    assert float(found.sum()) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("inner", ["markov-2", "gru"])
def test_it_is_a_prior(inner):
    quick = {"max_steps": 3, "progress": False} if inner == "gru" else {}
    check_prior(fitted(INNER[inner](), **quick), length=4, num_plans=5000)


@pytest.mark.parametrize("kind", [pytest.param(GRUPrior, marks=pytest.mark.slow), TransformerPrior])
def test_networks_inside_predict_plans_longer_than_their_window(kind):
    """Recoded plans are short, and so is the window that is learned."""
    words = torch.tensor([[0, 1, 2, 3], [3, 2, 2, 0], [1, 1, 0, 3]])
    plans = words[torch.randint(3, (200, 4), generator=seeded(0))].flatten(1)
    prior = MacroPrior(4, kind(12)).fit(plans, generator=seeded(3), max_steps=3, progress=False)
    long = torch.randint(4, (3, 20), generator=seeded(1))
    with torch.no_grad():
        predicted = prior.log_prob(long)
        assert predicted.isfinite().all()
        assert torch.allclose(prior.log_prob(long.to(torch.uint8)), predicted)
    assert prior.sample(5, 18, generator=seeded(2)).shape == (5, 18)


def test_of_too_many_ways_the_most_probable_are_kept(monkeypatch):
    prior, plans = fitted(MarkovPrior(7, 2)), every_plan(3, 6)
    exact = prior.log_prob(plans)
    monkeypatch.setattr(MacroPrior, "MOST", 6)
    near = prior.log_prob(plans)
    assert not torch.equal(near, exact)
    assert (near - exact).abs().mean() < 0.1
    assert float(near.double().exp().sum()) == pytest.approx(1, abs=1e-4)
    # One way alone must not be within a macro: nothing else could follow.
    monkeypatch.setattr(MacroPrior, "MOST", 1)
    assert prior.log_prob(plans).isfinite().all()
    # Of a macro and the actions that it is made of it is always these: each action is as probable as the first.
    alone = MacroPrior(2, MarkovPrior(3, 0)).fit(torch.tensor([[0, 1, 1], [0, 1, 0]]).repeat(5, 1))
    assert [macro.actions for macro in alone.macros] == [(0, 1)]
    first, pairs = alone.start(4)[0].log_softmax(-1), every_plan(2, 3)
    torch.testing.assert_close(alone.action_log_probs(pairs), first[0][pairs])


def test_actions_of_any_integer_dtype():
    prior = fitted(MarkovPrior(7, 1))
    _, state = prior.start(4)
    action = torch.tensor([0, 1, 2, 1])
    for dtype in (torch.uint8, torch.int32):
        assert torch.equal(prior.step(action.to(dtype), state)[0], prior.step(action, state)[0])


def test_before_it_learned_it_has_no_macros():
    check_prior(MacroPrior(3, MarkovPrior(5, 1)), length=3, num_plans=2000)


def test_macros_say_more_than_chains_of_the_same_order():
    """Words of four actions: a chain of order 0 over words predicts plans better than one over actions."""
    words = torch.tensor([[0, 1, 2, 3], [3, 2, 2, 0], [1, 1, 0, 3]])
    pick = torch.randint(3, (600, 4), generator=seeded(0))
    plans = words[pick].flatten(1)
    learned, held_out = plans[:400], plans[400:]
    macro = MacroPrior(4, MarkovPrior(4 + 12, 0)).fit(learned)
    plain = MarkovPrior(4, 0).fit(learned)
    assert macro.log_prob(held_out).mean() > plain.log_prob(held_out).mean() + 5


def test_planners_take_it():
    world = random_world(0)
    prior = fitted(MarkovPrior(7, 1))
    decision = SamplingPlanner(prior, 4, 64).plan(world, world.reset(5, seeded(0)), seeded(1))
    assert decision.plan.max() < 3


def test_saved_and_loaded(tmp_path):
    prior = fitted(MarkovPrior(7, 1))
    save(prior, tmp_path / "macro")
    again = load(tmp_path / "macro")
    assert again.macros == prior.macros
    plans = every_plan(3, 4)
    assert torch.equal(again.log_prob(plans), prior.log_prob(plans))


def test_refuses():
    plans = torch.zeros(4, 3, dtype=torch.long)
    with refuses("num_macros"):
        learn_macros(Plans(plans, 2), 0)
    with refuses("by"):
        learn_macros(Plans(plans, 2), 1, "length")
    with refuses("by"):
        MacroPrior(3, MarkovPrior(4), "length")
    with refuses("more than 3 actions"):
        MacroPrior(3, MarkovPrior(3))
    with refuses("without context"):
        MacroPrior(3, MarkovPrior(4, 1, num_contexts=2))
    with refuses("end symbol"):
        learn_macros(Plans(plans, 2, end=1), 1)
    prior = MacroPrior(2, MarkovPrior(3))
    with refuses("end symbol"):
        prior.fit(Plans(plans, 2, end=1))
    assert prior.end is None
    with refuses("without macros"):
        MacroPrior(2, MacroPrior(3, MarkovPrior(4)))


def test_nothing_to_find():
    for plans in (Plans(torch.zeros(3, 0, dtype=torch.long), 2), Plans(torch.tensor([[0, 1]]), 2)):
        macros, recoded = learn_macros(plans, 3)
        assert macros == []
        assert recoded.actions.shape == plans.actions.shape
