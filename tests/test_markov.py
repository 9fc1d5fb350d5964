"""Markov and uniform priors against a plain re-implementation of the documented formula."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from neuroprior import MarkovPrior, Plans, UniformPrior
from tests.sources import (
    FALSE_ALARM,
    best_plan_distribution,
    best_plans,
    bits_per_action,
    distribution,
    every_plan,
    fits,
    refuses,
    seeded,
)


class Counting:
    """The formula of `MarkovPrior`'s docstring, word by word, over lists of (actions, contexts)."""

    def __init__(self, plans, num_actions, order, smoothing, initial, contexts):
        self.plans, self.num_actions, self.order = plans, num_actions, order
        self.smoothing, self.initial, self.contexts = smoothing, initial, contexts

    def blend(self, counts, lower):
        total = sum(counts)
        return [(n + self.smoothing * p) / (total + self.smoothing) for n, p in zip(counts, lower, strict=True)]

    def count(self, history, seen, opening=False, any_context=False):
        """How often each action followed `history` while `seen` was seen; at a plan's start only, where `opening`."""
        counts = [0] * self.num_actions
        k = len(history)
        for actions, contexts in self.plans:
            for t in range(k, len(actions)):
                if list(actions[t - k : t]) == list(history) and (not opening or t == k):
                    counts[actions[t]] += any_context or contexts[t] == seen
        return counts

    def chain(self, history, seen):
        if history:
            lower = self.chain(history[1:], seen)
        else:
            lower = [1 / self.num_actions] * self.num_actions
            if self.contexts:
                lower = self.blend(self.count([], None, any_context=True), lower)
        return self.blend(self.count(history, seen), lower)

    def next(self, past, seen):
        """The probabilities of the action after all of `past`."""
        last = past[max(len(past) - self.order, 0) :]
        probs = self.chain(last, seen)
        if self.initial == "joint" and len(past) < self.order:
            probs = self.blend(self.count(past, seen, opening=True), probs)
        return probs


@st.composite
def problems(draw):
    num_actions, length, contexts = draw(st.integers(1, 4)), draw(st.integers(0, 6)), draw(st.integers(0, 3))
    per = draw(st.sampled_from(["plan", "step"])) if contexts else None
    num, seed = draw(st.integers(0, 12)), draw(st.integers(0, 2**31))
    generator = seeded(seed)
    # Few contexts and actions are used in training, so that some are met in the test alone.
    used = draw(st.integers(1, num_actions))
    actions = torch.randint(used, (num, length), generator=generator)
    lengths = torch.randint(length + 1, (num,), generator=generator) if draw(st.booleans()) else None
    context = None
    if contexts:
        shape = (num,) if per == "plan" else (num, length)
        context = torch.randint(max(contexts - 1, 1), shape, generator=generator)
    arguments = {
        "num_actions": num_actions,
        "order": draw(st.integers(0, 5)),
        "smoothing": draw(st.sampled_from([0.01, 1.0, 7.5])),
        "initial": draw(st.sampled_from(["joint", "lower"])),
    }
    return Plans(actions, num_actions, lengths, context=context), contexts, per, arguments, seed


@settings(max_examples=120, deadline=None)
@given(problems())
def test_counts(problem):
    plans, contexts, per, arguments, seed = problem
    prior = MarkovPrior(**arguments, num_contexts=contexts or None).fit(plans)
    assert prior.context_per == per
    rows = []
    for i in range(len(plans)):
        length = plans.max_length if plans.lengths is None else int(plans.lengths[i])
        seen = [None] * length
        if contexts:
            seen = [int(plans.context[i])] * length if per == "plan" else plans.context[i, :length].tolist()
        rows.append((plans.actions[i, :length].tolist(), seen))
    truth = Counting(rows, contexts=contexts, **arguments)
    generator = seeded(seed + 1)
    num, length = 6, plans.max_length + 2
    test = torch.randint(arguments["num_actions"], (num, length), generator=generator)
    context = None
    if contexts:
        context = torch.randint(contexts, (num,) if per == "plan" else (num, length), generator=generator)
    got = prior(test, context).softmax(-1)
    for i in range(num):
        for t in range(length):
            seen = None if context is None else int(context[i] if per == "plan" else context[i, t])
            want = torch.tensor(truth.next(test[i, :t].tolist(), seen))
            torch.testing.assert_close(got[i, t], want, rtol=1e-4, atol=1e-6)
    assert (got > 0).all()
    taken = got.gather(-1, test[..., None])[..., 0].log()
    torch.testing.assert_close(prior.log_prob(test, context), taken.sum(1), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("order", range(6))
@pytest.mark.parametrize("initial", ["joint", "lower"])
@pytest.mark.parametrize("contexts", [None, 2])
def test_probabilities_of_all_plans_sum_to_one(order, initial, contexts):
    actions = torch.randint(3, (40, 4), generator=seeded(order))
    seen = None if contexts is None else torch.arange(40) % 2
    prior = MarkovPrior(3, order, initial=initial, num_contexts=contexts).fit(Plans(actions, 3, context=seen))
    for length in (0, 1, 3, 6):
        probs = distribution(prior, length, None if contexts is None else torch.tensor(1))
        assert float(probs.sum()) == pytest.approx(1, abs=1e-5)
        assert (probs > 0).all()


@pytest.mark.parametrize("order", [0, 1, 3])
@pytest.mark.parametrize("fitted", [None, torch.zeros(0, 5).long(), torch.zeros(7, 0).long()])
def test_nothing_seen_is_uniform(order, fitted):
    prior = MarkovPrior(3, order)
    if fitted is not None:
        prior.fit(fitted)
    torch.testing.assert_close(distribution(prior, 3), torch.full((27,), 1 / 27, dtype=torch.double))


def test_by_hand():
    """Order 1, smoothing 1, plans 0 0 1 and 0 1: computed on paper from the docstring."""
    plans = Plans(torch.tensor([[0, 0, 1], [0, 1, 0]]), 2, torch.tensor([3, 2]))
    empty = [(3 + 0.5) / 6, (2 + 0.5) / 6]  # 0 three times and 1 twice
    after_0 = [(1 + empty[0]) / 4, (2 + empty[1]) / 4]
    opening = [(2 + empty[0]) / 3, (0 + empty[1]) / 3]
    for initial, first in (("joint", opening), ("lower", empty)):
        got = MarkovPrior(2, 1, initial=initial).fit(plans)(torch.tensor([[0, 1, 0]])).softmax(-1)[0]
        torch.testing.assert_close(got, torch.tensor([first, after_0, empty]))  # nothing ever followed 1
    matrix = MarkovPrior(2, 1).fit(plans).transition_matrix()
    torch.testing.assert_close(matrix, torch.tensor([after_0, empty]))


def test_fitting_again_forgets():
    first, second = (torch.randint(3, (20, 4), generator=seeded(s)) for s in (0, 1))
    again = MarkovPrior(3, 2).fit(first).fit(second)
    torch.testing.assert_close(distribution(again, 4), distribution(MarkovPrior(3, 2).fit(second), 4))


def test_a_prior_without_context_leaves_that_of_the_plans_aside():
    plans = Plans(torch.randint(3, (20, 4), generator=seeded(0)), 3, context=torch.arange(20))
    prior = MarkovPrior(3, 2).fit(plans)
    assert prior.context_per is None
    torch.testing.assert_close(distribution(prior, 4), distribution(MarkovPrior(3, 2).fit(plans.actions), 4))


def test_the_torus_source():
    """DESIGN's figures for the best depth-4 plan, from the enumeration that the tests use."""
    probs, plans = best_plan_distribution(), every_plan(4, 4)
    assert float(-(probs * probs.log2()).sum()) == pytest.approx(7.27784, abs=5e-6)
    matrix = torch.zeros(4, 4, dtype=torch.double)
    for t in range(3):
        matrix.index_put_((plans[:, t], plans[:, t + 1]), probs, accumulate=True)
    turn = torch.tensor([4 / 9, 2 / 9, 1 / 9, 2 / 9], dtype=torch.double)
    want = torch.stack([turn.roll(a) for a in range(4)])
    torch.testing.assert_close(matrix / matrix.sum(1, keepdim=True), want)


@pytest.mark.parametrize(("order", "figure"), [(0, 0.18054), (1, 0.05798), (2, 0.01387), (3, 0.0)])
def test_divergence_from_the_torus_source(order, figure):
    """DESIGN's figures, reached from 100,000 plans but for the error of estimating the chain's probabilities.

    Twice the number of plans times the excess divergence in nats is a sum of chi-squares, one a free probability, each
    times at most 2 (the variance of counts along a plan against that of independent ones).
    """
    num = 100_000
    prior = MarkovPrior(4, order).fit(Plans(best_plans(num, seed=order), 4))
    found = bits_per_action(best_plan_distribution(), prior.log_prob(every_plan(4, 4)), 4)
    free = 4**order - 1 + 4**order * 3
    excess = 2 * stats.chi2.isf(FALSE_ALARM, free) / (2 * num) / math.log(2) / 4
    assert figure - 1e-5 < found < figure + excess + 1e-5


def test_transition_matrix_of_the_torus_source():
    matrix = MarkovPrior(4, 1).fit(Plans(best_plans(100_000, seed=9), 4)).transition_matrix()
    turn = torch.tensor([4 / 9, 2 / 9, 1 / 9, 2 / 9])
    # Each row is estimated from about 75,000 steps; 5 standard errors, doubled as above.
    for action in range(4):
        assert (matrix[action] - turn.roll(action)).abs().max() < 5 * math.sqrt(2 * 0.25 / 75_000)
    torch.testing.assert_close(matrix.sum(1), torch.ones(4))


@pytest.mark.parametrize("prior", [MarkovPrior(3, 0), MarkovPrior(3, 1, num_contexts=2)])
def test_transition_matrix_refuses(prior):
    with refuses("transition_matrix"):
        prior.transition_matrix()


def test_sampling_goes_on_past_the_training_length():
    prior = MarkovPrior(3, 2).fit(torch.randint(3, (50, 3), generator=seeded(0)))
    plans = prior.sample(30_000, 6, generator=seeded(1))
    assert fits(plans, distribution(prior, 6), 3)


def test_uniform():
    prior = UniformPrior(5)
    torch.testing.assert_close(distribution(prior, 3), torch.full((125,), 1 / 125, dtype=torch.double))
    assert prior.fit(torch.randint(5, (3, 2), generator=seeded(0))) is prior
    assert fits(prior.sample(20_000, 2, generator=seeded(0)), torch.ones(25), 5)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"num_actions": 0}, "num_actions"),
        ({"num_actions": 2.0}, "num_actions"),
        ({"order": -1}, "order"),
        ({"order": 1.5}, "order"),
        ({"smoothing": 0}, "smoothing"),
        ({"smoothing": -1.0}, "smoothing"),
        ({"smoothing": float("nan")}, "smoothing"),
        ({"smoothing": float("inf")}, "smoothing"),
        ({"initial": "both"}, "initial"),
        ({"num_contexts": 0}, "num_contexts"),
    ],
)
def test_refuses_arguments(arguments, word):
    with refuses(word):
        MarkovPrior(**({"num_actions": 3} | arguments))
