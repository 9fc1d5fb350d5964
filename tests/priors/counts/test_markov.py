"""Markov and uniform priors against a plain re-implementation of the documented formula."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from neuroprior import MarkovPrior, Plans
from neuroprior.plans import constant_context
from tests.support.sources import (
    FALSE_ALARM,
    best_plan_distribution,
    best_plans,
    bits_per_action,
    distribution,
    every_plan,
    refuses,
    seeded,
)


class Counting:
    """The formulas of `MarkovPrior`'s docstring, word by word, over lists of (actions, contexts)."""

    def __init__(self, plans, num_actions, order, smoothing, initial, backoff, contexts):
        self.num_actions, self.order, self.smoothing = num_actions, order, smoothing
        self.initial, self.backoff, self.contexts = initial, backoff, contexts
        # How often each action followed: of (at a plan's beginning, history, context).
        self.raw = {}
        for actions, current in plans:
            for t, action in enumerate(actions):
                for k in range(min(t, order) + 1):
                    keys = [(False, tuple(actions[t - k : t]), current[t])]
                    if k == t < order:
                        keys.append((True, tuple(actions[:t]), current[t]))
                    for key in keys:
                        self.raw.setdefault(key, [0] * num_actions)[action] += 1
        self.none = [0] * num_actions

    def followed(self, key):
        return self.raw.get(key, self.none)

    def counts(self, opening, history, current):
        if self.backoff != "kneser-ney" or opening or len(history) == self.order:
            return self.followed((opening, history, current))
        longer = [self.followed((False, (older, *history), current)) for older in range(self.num_actions)]
        longer.append(self.followed((True, history, current)))
        return [sum(counts[a] > 0 for counts in longer) for a in range(self.num_actions)]

    def in_all_contexts(self):
        rows = [counts for (opening, history, _), counts in self.raw.items() if history == () and not opening]
        return [
            sum(min(n[a], 1) if self.backoff == "kneser-ney" else n[a] for n in rows) for a in range(self.num_actions)
        ]

    def level(self, opening, length):
        """All counts of histories of one length."""
        keys = [key for key in self.raw if key[0] == opening and len(key[1]) == length]
        return [n for key in keys for n in self.counts(*key)]

    def discounts(self, counts):
        n1, n2, n3, n4 = (counts.count(k) for k in range(1, 5))
        if min(n1, n2, n3) == 0:
            return [0.5, 1.0, 1.5]
        y = n1 / (n1 + 2 * n2)
        found = [1 - 2 * y * n2 / n1, 2 - 3 * y * n3 / n2, 3 - 4 * y * n4 / n3]
        return found if all(0 < d <= k for k, d in enumerate(found, 1)) else [0.5, 1.0, 1.5]

    def blend(self, counts, lower, level):
        total = sum(counts)
        if total == 0:
            return lower
        if self.backoff == "kneser-ney":
            discounts = [self.smoothing * d for d in self.discounts(level)]
            off = [min(discounts[min(n, 3) - 1], n) if n else 0 for n in counts]
            return [(n - d + sum(off) * p) / total for n, d, p in zip(counts, off, lower, strict=True)]
        s = self.smoothing * (sum(n > 0 for n in counts) if self.backoff == "witten-bell" else 1)
        return [(n + s * p) / (total + s) for n, p in zip(counts, lower, strict=True)]

    def chain(self, history, current):
        if history:
            lower = self.chain(history[1:], current)
        else:
            lower = [1 / self.num_actions] * self.num_actions
            if self.contexts:
                pooled = self.in_all_contexts()
                lower = self.blend(pooled, lower, pooled)
        return self.blend(self.counts(False, history, current), lower, self.level(False, len(history)))

    def next(self, past, current):
        """The probabilities of the action after all of `past`."""
        past = tuple(past)
        probs = self.chain(past[max(len(past) - self.order, 0) :], current)
        if self.initial == "joint" and len(past) < self.order:
            probs = self.blend(self.counts(True, past, current), probs, self.level(True, len(past)))
        return probs


@st.composite
def problems(draw):
    num_actions, length, contexts = draw(st.integers(1, 4)), draw(st.integers(0, 6)), draw(st.integers(0, 3))
    per = draw(st.sampled_from(["plan", "step"])) if contexts else None
    num, seed = draw(st.sampled_from([0, 1, 3, 12, 60])), draw(st.integers(0, 2**31))
    generator = seeded(seed)
    # Few contexts and actions are used in training, so that some occur in the test alone.
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
        "backoff": draw(st.sampled_from(["dirichlet", "witten-bell", "kneser-ney"])),
    }
    return Plans(actions, num_actions, lengths, context=context), contexts, per, arguments, seed


@settings(max_examples=100, deadline=None, derandomize=True)
@given(problems())
def test_counts(problem):
    plans, contexts, per, arguments, seed = problem
    prior = MarkovPrior(**arguments, num_contexts=contexts or None).fit(plans)
    assert prior.context_per == (per and ("step" if constant_context(plans) is None else "plan"))
    rows = []
    for i in range(len(plans)):
        length = plans.max_length if plans.lengths is None else int(plans.lengths[i])
        current = [None] * length
        if contexts:
            current = plans.context[i, :length].tolist()
        rows.append((plans.actions[i, :length].tolist(), current))
    truth = Counting(rows, contexts=contexts, **arguments)
    generator = seeded(seed + 1)
    num, length = 6, plans.max_length + 2
    test = torch.randint(arguments["num_actions"], (num, length), generator=generator)
    context = None
    if contexts:
        drawn = torch.randint(contexts, (num, 1 if per == "plan" else length), generator=generator)
        context = drawn.expand(num, length)
    got = prior(test, context).softmax(-1)
    for i in range(num):
        for t in range(length):
            current = None if context is None else int(context[i, t])
            want = torch.tensor(truth.next(test[i, :t].tolist(), current))
            torch.testing.assert_close(got[i, t], want, rtol=1e-4, atol=1e-6)
    assert (got > 0).all()
    taken = got.gather(-1, test[..., None])[..., 0].log()
    scored = Plans(test, arguments["num_actions"], context=context)
    torch.testing.assert_close(prior.log_prob(scored), taken.sum(1), rtol=1e-4, atol=1e-4)


def test_by_hand():
    """Order 1, smoothing 1, plans 0 0 1 and 0 1: computed on paper from the docstring."""
    plans = Plans(torch.tensor([[0, 0, 1], [0, 1, 0]]), 2, torch.tensor([3, 2]))
    empty = [(3 + 0.5) / 6, (2 + 0.5) / 6]  # 0 three times and 1 twice
    after_0 = [(1 + empty[0]) / 4, (2 + empty[1]) / 4]
    opening = [(2 + empty[0]) / 3, (0 + empty[1]) / 3]
    for initial, first in (("joint", opening), ("lower", empty)):
        got = (
            MarkovPrior(2, 1, initial=initial, backoff="dirichlet").fit(plans)(torch.tensor([[0, 1, 0]])).softmax(-1)[0]
        )
        torch.testing.assert_close(got, torch.tensor([first, after_0, empty]))  # nothing ever followed 1
    matrix = MarkovPrior(2, 1, backoff="dirichlet").fit(plans).transition_matrix()
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


@pytest.mark.parametrize("prior", [MarkovPrior(3, 0), MarkovPrior(3, 1, num_contexts=2)])
def test_transition_matrix_refuses(prior):
    with refuses("transition_matrix"):
        prior.transition_matrix()
