"""How far back: gains counted by hand, closed forms, and simulations of known order; pieces against slices."""

import math
from collections import Counter

import numpy as np
import pytest
import torch
from scipy import stats

from neuroprior import Plans
from neuroprior.behaviour import Difference, HowFarBack, how_far_back, ratio_difference
from neuroprior.behaviour.analysis.lags import FIRST_SHARE, _fallback, pieces
from tests.support.sources import FALSE_ALARM, refuses, seeded


def order_two(seed: int, mix: float, subjects: int = 10, length: int = 60) -> Plans:
    """Two or three sessions a subject of unlike lengths: what comes next is by one action, or with `mix` by two."""
    random = np.random.default_rng(seed)
    one, two = random.dirichlet(np.ones(4) / 2, 4), random.dirichlet(np.ones(4) / 2, (4, 4))
    probs = ((1 - mix) * one[None] + mix * two).cumsum(-1)
    group = torch.arange(subjects).repeat_interleave(2 + torch.arange(subjects) % 2)
    actions = random.integers(4, size=(len(group), length))
    for t in range(2, length):
        drawn = random.random((len(group), 1))
        actions[:, t] = (probs[actions[:, t - 2], actions[:, t - 1]] < drawn).sum(-1).clip(max=3)
    lengths = torch.from_numpy(random.integers(length // 2, length + 1, len(group)))
    return Plans(torch.from_numpy(actions), 4, lengths, group=group)


def by_hand(plans: Plans, max_lag: int) -> list[tuple[list[float], list[int]]]:
    """The gain and the actions of each subject, counted in plain loops."""
    rows = [
        (number, row[:length])
        for number, row, length in zip(
            plans.group.tolist(), plans.actions.tolist(), plans.lengths.tolist(), strict=True
        )
    ]
    subjects = sorted({number for number, _ in rows})
    prob = {}  # of each action by subject, plan, step: under the chain of the last order
    found = []
    for order in range(max_lag + 1):
        new = {}
        gain, size = dict.fromkeys(subjects, 0.0), dict.fromkeys(subjects, 0)
        for own in subjects:
            counts: Counter[tuple[tuple[int, ...], int]] = Counter()
            for number, row in rows:
                if number != own:
                    counts.update((tuple(row[t - order : t]), row[t]) for t in range(order, len(row)))
            totals: Counter[tuple[int, ...]] = Counter()
            for (past, _), many in counts.items():
                totals[past] += many

            lower = {}
            for place, (number, row) in enumerate(rows):
                for t in range(order, len(row)):
                    if order and number != own and (tuple(row[t - order : t]), row[t]) not in lower:
                        lower[tuple(row[t - order : t]), row[t]] = prob[place, t]

            def evidence(weight, counts=counts, totals=totals, lower=lower):
                pairs = [(n, weight * lower[key]) for key, n in counts.items()]
                each = [math.lgamma(n + some) - math.lgamma(some) for n, some in pairs]
                return sum(each) + sum(math.lgamma(weight) - math.lgamma(n + weight) for n in totals.values())

            weight = max((4.0**k for k in range(-6, 9)), key=evidence) if order else 4.0
            for place, (number, row) in enumerate(rows):
                for t in range(order, len(row)) if number == own else ():
                    past = tuple(row[t - order : t])
                    before = prob[place, t] if order else 0.25
                    new[place, t] = (counts[past, row[t]] + weight * before) / (totals[past] + weight)
                    if order:
                        gain[own] += math.log2(new[place, t] / before)
                        size[own] += 1
        prob = prob | new
        found.append((list(gain.values()), list(size.values())))
    return found[1:]


def test_gains_by_hand():
    plans = order_two(3, 0.5, 4, 30)
    result, want = how_far_back(plans, 3), by_hand(plans, 3)
    for one, (gain, size) in zip(result.gains, want, strict=True):
        assert one == pytest.approx(tuple(ratio_difference(gain, size)), abs=1e-7)
    assert (result.unit, result.num_units) == ("subjects", 4)
    assert result.few == "4 subjects are too few for a verdict"
    assert not result.frame()["significant"].any()


def test_the_verdict_names_the_last_lag_that_adds():
    """Also where nearer ones add nothing alone; a loss never counts."""
    gains = [Difference(0.3, 0.2, 0.4, 1e-5), Difference(-0.3, -0.4, -0.2, 1e-5), Difference(0.3, 0.2, 0.4, 1e-9)]
    some = HowFarBack(gains, np.array([1e-5, 1.0, 1.0]), 1, "groups", 9, "")
    assert some.frame()["significant"].tolist() == [True, False, False]
    assert some.verdict == "How far back: one behaviour; a second adds nothing (-.3 bits, -.4 to -.2)."
    every = HowFarBack(gains, np.array([1e-5, 1.0, 1e-5]), 3, "groups", 9, "")
    assert every.verdict == "How far back: three behaviours at least."
    assert every.frame()["significant"].tolist() == [True, False, True]
    none = HowFarBack(gains[1:], np.array([1.0, 1.0]), 0, "groups", 9, "")
    assert none.verdict == "How far back: no behaviour; the last adds nothing (-.3 bits, -.4 to -.2)."


def test_a_lag_is_found_that_nearer_ones_hide():
    """Each action is the one two before it: the last one alone says nothing."""
    in_turn = how_far_back(Plans(torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1]] * 10).repeat(1, 30), 2), 3)
    assert in_turn.gains[1].mean > 0.9
    assert in_turn.frame()["significant"].tolist() == [False, True, False]
    assert in_turn.verdict.startswith("How far back: two behaviours; a third adds nothing")


@pytest.mark.parametrize("seed", range(5))
def test_p_values_are_corrected_by_the_fallback_procedure(seed):
    """The least level at which each passes, against a search over all levels; and by hand for two lags."""
    p_values = 10 ** -torch.empty(5).uniform_(0, 4, generator=seeded(seed)).double().numpy()
    shares = np.array([FIRST_SHARE, *[(1 - FIRST_SHARE) / 4] * 4])
    due = np.ones(5)
    for level in np.logspace(0, -6, 20_000):
        spent = 0.0
        for lag in range(5):
            spent += level * shares[lag]
            if p_values[lag] > spent:
                spent = 0.0
            else:
                due[lag] = level
    assert _fallback(p_values) == pytest.approx(due, rel=1e-3)
    assert _fallback(np.array([0.04, 0.001])) == pytest.approx([0.05, 0.005])
    assert _fallback(np.array([0.008, 0.03])) == pytest.approx([0.01, 0.03])
    assert _fallback(np.array([0.03])) == pytest.approx([0.03])


def test_first_actions_may_be_left_out():
    """A cycle in the first ten actions; what comes after them is random."""
    cycle = (torch.arange(20)[:, None] + torch.arange(10)) % 3
    plans = Plans(torch.cat([cycle, torch.randint(3, (20, 40), generator=seeded(0))], 1), 3)
    whole, rest = how_far_back(plans, 1), how_far_back(plans, 1, skip=10)
    assert whole.gains[0].mean > 0.03 > 0 > rest.gains[0].low
    assert (whole.reach, rest.reach) == (1, 0)


def test_plans_of_one_subject_or_without_pairs_are_refused():
    with refuses("`plans` must have two units with successive actions after the first 0, got fewer"):
        how_far_back(Plans(torch.zeros(1, 9, dtype=torch.long), 2))
    with refuses("two units", "after the first 9"):
        how_far_back(Plans(torch.zeros(5, 9, dtype=torch.long), 2), skip=9)
    with refuses("max_lag"):
        how_far_back(order_two(0, 0.0), 0)
    with refuses("skip"):
        how_far_back(order_two(0, 0.0), skip=-1)


def test_lags_end_where_plans_do():
    plans = Plans(torch.randint(2, (6, 3), generator=seeded(0)), 2, torch.tensor([3, 2, 3, 1, 2, 3]))
    assert len(how_far_back(plans).gains) == 2
    assert how_far_back(plans, skip=2).frame()["units"].tolist() == [6, 6]


def numbered(**more) -> Plans:
    """Plans whose actions are 10 times the plan plus the step."""
    lengths = torch.tensor([5, 2, 7, 0, 3])
    return Plans(10 * torch.arange(5)[:, None] + torch.arange(7), 50, lengths, **more)


@pytest.mark.parametrize("length", [1, 3, 6, 7])
def test_all_pieces(length):
    plans = numbered()
    want = [
        plans.actions[n, t : t + length].tolist() for n in range(5) for t in range(int(plans.lengths[n]) - length + 1)
    ]
    found = pieces(plans, length, 100)
    assert found.actions.tolist() == want
    if len({row[0] // 10 for row in want}) > 1:
        _, rank = torch.tensor([row[0] // 10 for row in want]).unique(return_inverse=True)
        assert found.group.tolist() == rank.tolist()
    else:
        assert found.group.tolist() == list(range(len(want)))  # parts of the only plan


def test_pieces_keep_contexts_and_groups():
    step, features = numbered().actions.long(), torch.randn(5, 7, 2, generator=seeded(0))
    group, names = torch.tensor([1, 0, 0, 2, 1]), ["a", "b", "c"]
    found = pieces(numbered(context=step, group=group, group_names=names), 3, 100)
    assert found.context.equal(found.actions.long())
    assert found.group.equal(group[found.actions[:, 0].long() // 10])
    assert found.group_names == names
    found = pieces(numbered(context=features), 3, 100)
    plan, at = found.actions.long() // 10, found.actions.long() % 10
    assert found.context.equal(features[plan, at])
    found = pieces(numbered(context=torch.arange(5), group=torch.zeros(5).long(), group_names=["a"]), 3, 100)
    assert found.context.equal(found.actions.long() // 10)
    assert found.group.tolist() == [0] * 3 + [1] * 5 + [2]  # the plan: one group is none
    assert found.group_names is None


def test_pieces_may_end():
    closed = Plans(torch.randint(2, (20, 4), generator=seeded(0)), 2).with_end()
    found = pieces(closed, 3, 1000)
    assert found.lengths.tolist() == [3] * 60
    assert (found.actions[:, -1] == 2).sum() == 20


def test_pieces_are_drawn_uniformly_and_without_replacement():
    """9 of 17 starts, 3,000 times: each as often, pieces differ and are in order, and a seed determines them."""
    plans = numbered()
    generator, times = seeded(2), torch.zeros(50)
    for _ in range(3000):
        found = pieces(plans, 1, 9, generator).actions[:, 0].long()
        assert found.unique().tolist() == found.tolist()  # in the order of the plans
        times[found] += 1
    taken = times[plans.actions[plans.mask()].long()]
    assert taken.sum() == 27000
    n, p = 3000, 9 / 17
    low, high = stats.binom.ppf(FALSE_ALARM / 34, n, p), stats.binom.isf(FALSE_ALARM / 34, n, p)
    assert (low <= taken).all()
    assert (taken <= high).all()
    again = [pieces(plans, 2, 5, seeded(7)).actions for _ in range(2)]
    assert again[0].equal(again[1])


def test_pieces_bad_input():
    with refuses("length: no plan has 8 actions", "7"):
        pieces(numbered(), 8, 10)
    with refuses("length"):
        pieces(numbered()[:0], 1, 10)
    for length, most in ((0, 1), (1, 0)):
        with refuses("most" if length else "length"):
            pieces(numbered(), length, most)
