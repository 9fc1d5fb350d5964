"""Order selection against brute force, closed forms and chains of a known order."""

import math
from collections import Counter

import pytest
import torch
from scipy import stats

from neuroprior import Plans
from neuroprior.behaviour import order_selection
from tests.support.chains import markov_plans, markov_probs, null_sets
from tests.support.sources import refuses, seeded


def brute_force(plans: Plans, order: int, max_order: int, contexts=None) -> tuple[float, int, int]:
    """Log-likelihood, histories that occurred and scored actions, counted one by one."""
    pairs, histories = Counter(), Counter()
    for n, row in enumerate(plans.actions.tolist()):
        length = plans.max_length if plans.lengths is None else int(plans.lengths[n])
        for t in range(max_order, length):
            index = None if contexts is None else int(contexts[n, t] if contexts.dim() == 2 else contexts[n])
            history = (index, *row[t - order : t])
            pairs[history, row[t]] += 1
            histories[history] += 1
    likelihood = sum(c * math.log(c / histories[history]) for (history, _), c in pairs.items())
    return likelihood, len(histories), sum(histories.values())


@pytest.mark.parametrize("per", [None, "plan", "step"])
def test_fits_are_those_of_brute_force(per):
    """Plans of unequal length, some too short to count."""
    lengths = torch.randint(12, (30,), generator=seeded(1))
    context = {None: None, "plan": torch.arange(30) % 3, "step": torch.randint(3, (30, 11), generator=seeded(2))}[per]
    actions = torch.randint(3, (30, 11), generator=seeded(0))
    plans = Plans(actions, 3, lengths, context=context)
    fits = order_selection(plans, 4, None if per is None else 3)
    assert [fit.order for fit in fits] == [0, 1, 2, 3, 4]
    for fit in fits:
        likelihood, histories, scored = brute_force(plans, fit.order, 4, context)
        assert fit.log_likelihood == pytest.approx(likelihood, abs=1e-9)
        assert fit.num_parameters == 2 * histories
        assert fit.num_actions_scored == scored
        assert fit.bic == pytest.approx(-2 * likelihood + 2 * histories * math.log(scored))
        assert fit.aic == pytest.approx(-2 * likelihood + 4 * histories)


def test_context_is_left_aside_where_it_is_not_asked_for():
    plans = markov_plans(markov_probs(3, 1, 0), 5, 20, 1)
    other = Plans(plans.actions, 3, context=torch.arange(5))
    assert order_selection(other, 2) == order_selection(plans, 2)


def test_a_cycle_is_certain_after_one_action():
    """0 1 2 0 1 2 ...: log(1/3) an action without history, 0 nats with any, and never more than 3 histories."""
    plans = Plans(torch.arange(12)[None] % 3, 3)
    fits = order_selection(plans, 3)
    assert fits[0].log_likelihood == pytest.approx(9 * math.log(1 / 3))
    assert [fit.log_likelihood for fit in fits[1:]] == pytest.approx([0, 0, 0], abs=1e-12)
    assert [fit.num_parameters for fit in fits] == [2, 6, 6, 6]


def test_all_orders_are_scored_on_the_same_actions():
    plans = markov_plans(markov_probs(2, 2, 0), 7, 9, 1)
    assert {fit.num_actions_scored for fit in order_selection(plans, 5)} == {7 * 4}
    # A longer plan of which nothing new is scored changes nothing.
    short = Plans(torch.cat([plans.actions, plans.actions[:3]]), 2, torch.tensor([9] * 7 + [5] * 3))
    assert order_selection(short, 5) == order_selection(plans, 5)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
@pytest.mark.parametrize("num_actions", [2, 4])
def test_bic_finds_the_order(num_actions, order):
    for seed in range(3):
        plans = markov_plans(markov_probs(num_actions, order, seed, 2.0), 200, 80, seed)
        fits = order_selection(plans, 5)
        assert min(fits, key=lambda fit: fit.bic).order == order


def test_twice_the_likelihood_ratio_is_chi_square():
    """Of order 2 against a true order 1 (Anderson and Goodman 1957), with 2 actions: 4 - 2 degrees of freedom."""
    found = []
    for plans in null_sets(2, 1, 300, 40, 50):
        fits = order_selection(plans, 2)
        found.append(2 * (fits[2].log_likelihood - fits[1].log_likelihood))
    assert stats.kstest(found, stats.chi2(2).cdf).pvalue > 1e-6
    # That of one degree of freedom more or fewer would not pass.
    assert max(stats.kstest(found, stats.chi2(k).cdf).pvalue for k in (1, 3)) < 1e-6


def test_context_stands_in_for_memory():
    """If the context of a step is the last action, order 0 with context is order 1 without."""
    plans = markov_plans(markov_probs(3, 1, 0), 20, 50, 1)
    last = torch.cat([torch.zeros(20, 1).long(), plans.actions[:, :-1].long()], 1)
    given = Plans(plans.actions, 3, context=last)
    with_context, without = order_selection(given, 3, num_contexts=3), order_selection(plans, 3)
    for order in range(3):
        assert with_context[order].log_likelihood == pytest.approx(without[max(order, 1)].log_likelihood)
    assert min(with_context, key=lambda fit: fit.bic).order == 0


def test_many_actions_and_long_histories_do_not_overflow():
    """57**12 is far beyond 64 bits; of 12 past actions all histories differ, of plans that are drawn at random."""
    plans = Plans(torch.randint(57, (50, 200), generator=seeded(0)), 57)
    fits = order_selection(plans, 12)
    assert fits[12].log_likelihood == pytest.approx(0, abs=1e-9)
    assert fits[12].num_parameters == 50 * 188 * 56
    likelihood, histories, _ = brute_force(plans, 3, 12)
    assert fits[3].log_likelihood == pytest.approx(likelihood)
    assert fits[3].num_parameters == 56 * histories


def test_bad_input():
    plans = Plans(torch.zeros(3, 4).long(), 2, torch.tensor([4, 2, 0]))
    with refuses("max_order", "below 4", "not 4"):
        order_selection(plans, 4)
    with refuses("max_order", "-1"):
        order_selection(plans, -1)
    with refuses("max_order", "below 0"):
        order_selection(Plans(torch.zeros(0, 4).long(), 2), 0)
    with refuses("context", "below 2", "none"):
        order_selection(plans, 1, num_contexts=2)
    with refuses("context", "float32"):
        order_selection(Plans(plans.actions, 2, context=torch.zeros(3, 2)), 1, num_contexts=2)
    with refuses("context[2, 0]", "5"):
        order_selection(Plans(plans.actions, 2, context=torch.tensor([0, 1, 5])), 1, num_contexts=2)
