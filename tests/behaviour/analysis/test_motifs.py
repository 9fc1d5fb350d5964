"""Over-represented sequences against scipy's exact test, brute force, null chains and planted motifs."""

import itertools
import math
import sys
from collections import Counter
from dataclasses import astuple

import pytest
import torch
from scipy import stats

from neuroprior import Plans
from neuroprior.behaviour import motifs
from neuroprior.behaviour.analysis.motifs import FEWEST, fisher_two_sided
from neuroprior.plans.folds import BLOCKS
from tests.support.chains import markov_plans, markov_probs, null_sets
from tests.support.sources import FALSE_ALARM, refuses, seeded


def fisher(count: int, total: int, successes: int, draws: int) -> float:
    """Twice scipy's one-sided exact test on the side of the mean where the count lies."""
    table = [[count, successes - count], [draws - count, total - successes - draws + count]]
    side = "greater" if count * total > successes * draws else "less"
    return min(2 * float(stats.fisher_exact(table, side).pvalue), 1)


def test_tails_are_those_of_fishers_test():
    """All 2 x 2 tables of up to 12 in all."""
    tables = [
        (x, total, s, d)
        for total in range(1, 13)
        for s, d in itertools.product(range(total + 1), repeat=2)
        for x in range(max(s + d - total, 0), min(s, d) + 1)
    ]
    found = fisher_two_sided(*torch.tensor(tables).T)
    assert found.tolist() == pytest.approx([fisher(*table) for table in tables], rel=1e-9)


def brute_force(plans: Plans, n: int) -> dict[tuple[int, ...], tuple[int, int, int, int]]:
    """Of each possible sequence: its count, and how often its middle, its first and its last n - 1 actions occurred."""
    found = []
    for row, length in zip(plans.actions.tolist(), plans.mask().sum(1).tolist(), strict=True):
        found += [tuple(row[t : t + n]) for t in range(length - n + 1)]
    whole, heads, tails, middles = (Counter(w[a:b] for w in found) for a, b in ((0, n), (0, n - 1), (1, n), (1, n - 1)))
    return {
        (*head, last): (whole[(*head, last)], middles[head[1:]], heads[head], tails[(*head[1:], last)])
        for head in heads
        for last in range(plans.num_actions)
    }


def test_counts_tests_and_expectations_are_those_of_brute_force():
    """Plans of unequal length; 2 to 5 actions; tested is what the parts say, corrected for all that are tested."""
    lengths = torch.randint(25, (40,), generator=seeded(1))
    probs = markov_probs(3, 1, 0)
    probs[0, 2] = 0
    plans = Plans(markov_plans(probs, 40, 24, 2).actions, 3, lengths)
    found = motifs(plans, (2, 3, 4, 5))
    tested = {}
    for n in (2, 3, 4, 5):
        for word, (count, total, head, tail) in brute_force(plans, n).items():
            if min(head, tail) >= FEWEST and max(head, tail) < total:
                tested[word] = (count, total, head, tail)
    listed = {w: c for w, c in tested.items() if c[0] > 0 or c[2] * c[3] / c[1] >= FEWEST}
    assert {m.actions for m in found} == set(listed)
    assert any(m.count == 0 for m in found)
    assert len(listed) < len(tested)
    order = sorted(found, key=lambda m: m.p_value)
    largest = 0.0
    for rank, m in enumerate(order):
        count, total, head, tail = listed[m.actions]
        assert m.count == count
        assert m.expected == pytest.approx(head * tail / total)
        assert m.ratio == pytest.approx(count * total / (head * tail))
        assert m.p_value == pytest.approx(fisher(count, total, head, tail), rel=1e-6)
        largest = max(largest, m.p_value * (len(tested) - rank))
        assert m.corrected == pytest.approx(min(largest, 1), rel=1e-6)


def test_by_hand():
    """Of 20 times b, 8 after a and 12 after c, 10 before a and 10 before c; a b a occurred 7 times, expected 4."""
    rows = ["aba"] * 7 + ["abc"] * 1 + ["cba"] * 3 + ["cbc"] * 9
    found = motifs(Plans(torch.tensor([["abc".index(x) for x in row] for row in rows]), 3), (3,))
    first = next(m for m in found if m.actions == (0, 1, 0))
    assert first.count == 7
    assert first.expected == pytest.approx(4)
    # P(X >= 7) = (C(10, 7) * C(10, 1) + C(10, 8)) / C(20, 8)
    assert first.p_value == pytest.approx(2 * (120 * 10 + 45) / 125970)
    assert first.corrected == pytest.approx(4 * 2 * 1245 / 125970)  # the four tables are one: all p-values are equal
    assert {m.actions for m in found[:4]} == {(0, 1, 0), (2, 1, 2), (0, 1, 2), (2, 1, 0)}


def unlike(number: int) -> torch.Tensor:
    """Plans of two chains by turns: they differ by more than chance."""
    chains = torch.tensor([[[0.9, 0.1], [0.6, 0.4]], [[0.2, 0.8], [0.1, 0.9]]]).double()
    parts = [markov_plans(chain, number // 2, 40, seed).actions for seed, chain in enumerate(chains)]
    return torch.stack(parts, 1).flatten(0, 1)


def test_the_interval_is_that_of_the_delta_method():
    """Over plans, each with its residual; against the closed form and, within a tenth, a bootstrap over plans."""
    plans, word = Plans(unlike(30), 2), (0, 1, 1)
    found = next(m for m in motifs(plans, (3,)) if m.actions == word)
    rows = [brute_force(plans[i : i + 1], 3).get(word, (0, 0, 0, 0)) for i in range(30)]
    units = torch.tensor(rows).double()
    for i in range(30):  # those that brute force leaves out as the head never occurred
        row = plans.actions[i].tolist()
        units[i, 1] = sum(a == 1 for a in row[1:-1])
        units[i, 3] = sum(row[t : t + 2] == [1, 1] for t in range(1, 39))
    sums = units.sum(0)
    shift = units[:, 0] / sums[0] + units[:, 1] / sums[1] - units[:, 2] / sums[2] - units[:, 3] / sums[3]
    half = stats.t.ppf(0.975, 29) * math.sqrt(30 / 29 * float((shift**2).sum()))
    assert half > 1.96 * math.sqrt(float((1 - sums[2] / sums[1]) * (1 - sums[3] / sums[1]) / sums[0]))
    assert found.low == pytest.approx(found.ratio * math.exp(-half))
    assert found.high == pytest.approx(found.ratio * math.exp(half))
    drawn = units[torch.randint(30, (4000, 30), generator=seeded(0))].sum(1)
    spread = (drawn[:, 0] * drawn[:, 1] / (drawn[:, 2] * drawn[:, 3])).log().std()
    assert stats.t.ppf(0.975, 29) * float(spread) == pytest.approx(half, rel=0.1)


def halves(plans: Plans) -> float:
    found = {m.actions: m for m in motifs(plans, (3,))}
    return math.log(found[0, 1, 1].high / found[0, 1, 1].low) / 2


def test_the_units_of_the_interval():
    actions = unlike(30)
    by_plan = halves(Plans(actions, 2))
    assert halves(Plans(actions, 2, group=torch.zeros(30).long())) == by_plan
    assert halves(Plans(actions, 2, group=torch.arange(30) * 7)) == by_plan
    # Three groups: t(2) and other residuals; two copies of all plans in pairs: the same shifts of 30 units.
    assert halves(Plans(actions, 2, group=torch.arange(30) // 10)) != pytest.approx(by_plan)
    doubled = Plans(actions.repeat_interleave(2, 0), 2, group=torch.arange(30).repeat_interleave(2))
    assert halves(doubled) == pytest.approx(by_plan)
    # More than 40 units are joined in order: 80 plans in pairs.
    many = unlike(2 * BLOCKS)
    joined = Plans(many, 2, group=torch.arange(2 * BLOCKS) // 2)
    assert halves(Plans(many, 2)) == pytest.approx(halves(joined))


def test_a_single_plan_is_cut_in_parts():
    plans = markov_plans(torch.tensor([[0.7, 0.3], [0.4, 0.6]]).double(), 1, 1200, 0)
    assert 0.05 < halves(plans) < 0.5
    # Plans that are too short for a single window make no unit.
    more = Plans(torch.cat([plans.actions, plans.actions]), 2, torch.tensor([1200, 2]))
    assert halves(more) == halves(plans)


def test_intervals_without_spread_or_without_counts():
    """`0 1 0` and `2 1 2` alone occur: the others never do; all plans of a kind are equal."""
    actions = torch.tensor([[0, 1, 0], [2, 1, 2]]).repeat(20, 1)
    found = {m.actions: m for m in motifs(Plans(actions, 3, group=torch.arange(40) // 2), (3,))}
    # Units agree; the count is hypergeometric: half of the heads and half of the tails are others.
    half = stats.norm.ppf(0.975) * math.sqrt(0.5 * 0.5 / 20)
    assert found[0, 1, 0].low == pytest.approx(2 * math.exp(-half))
    assert found[0, 1, 0].high == pytest.approx(2 * math.exp(half))
    absent = found[0, 1, 2]
    assert (absent.count, absent.ratio, absent.low) == (0, 0, 0)
    assert stats.poisson.pmf(0, absent.high * absent.expected) == pytest.approx(0.025)
    # The middle in one group alone: nothing is known about groups.
    lone = Plans(torch.cat([actions, torch.zeros(1, 3).long()]), 3, group=torch.tensor([0] * 40 + [1]))
    assert {(m.low, m.high) for m in motifs(lone, (3,)) if m.actions[1] == 1} == {(0.0, math.inf)}


@pytest.mark.parametrize(
    ("num_actions", "order", "num", "length", "lengths"),
    [
        (3, 1, 20, 50, (3, 4)),
        (2, 1, 1, 200, (3,)),
        (3, 1, 150, 4, (3, 4)),
        (3, 0, 20, 50, (2, 3)),
        (2, 2, 5, 150, (4,)),
    ],
)
def test_false_positives(num_actions, order, num, length, lengths):
    """100 null data sets: a corrected p-value up to 0.05 in no more than 5 % of them; and so of single p-values."""
    families, single = 0, []
    for plans in null_sets(num_actions, order, 100, num, length):
        found = motifs(plans, lengths)
        families += any(m.corrected <= 0.05 for m in found)
        # One of them, as those of one data set depend on each other; a sequence that overlaps itself.
        single += [m.p_value for m in found if m.actions == (0,) * (order + 2) if m.expected >= 5]
    assert families <= stats.binom.isf(FALSE_ALARM, 100, 0.05)
    assert len(single) > 50
    assert sum(p <= 0.05 for p in single) <= stats.binom.isf(FALSE_ALARM, len(single), 0.05)
    # They are no smaller than they should be, nor so large that nothing could be found.
    assert stats.kstest(single, "uniform", alternative="greater").pvalue > FALSE_ALARM
    assert min(single) < 0.2


def planted(num_actions: int, motif: tuple[int, ...], seed: int) -> Plans:
    """40 random plans of 500 actions, with the motif six times in each."""
    generator = seeded(seed)
    actions = torch.randint(num_actions, (40, 500), generator=generator)
    size = len(motif)
    for row in actions:
        for place in torch.randperm(500 // size, generator=generator)[:6].tolist():
            row[size * place : size * (place + 1)] = torch.tensor(motif)
    return Plans(actions, num_actions)


def test_of_a_motif_of_rare_parts_the_parts_are_found_first():
    """In 57 actions, where `5 50 22` can hardly go on but with the motif, the rest of it is no news."""
    motif = (5, 50, 22, 31, 8)
    found = motifs(planted(57, motif, 0), top=3)
    assert {m.actions for m in found} == {motif[i : i + 3] for i in range(3)}


def test_codes_do_not_overflow():
    """Of sequences of 12 out of 57 actions there are more than fit into 64 bits."""
    motif = tuple(range(40, 52))
    actions = torch.randint(57, (200, 12), generator=seeded(0))
    actions[::2] = torch.tensor(motif)
    actions[::4, 0] = 1
    actions[::4, -1] = 2
    found = motifs(Plans(actions, 57), (12,))
    assert {m.actions for m in found} == {(first, *motif[1:-1], last) for first in (1, 40) for last in (2, 51)}
    counts = {(m.actions[0], m.actions[-1]): (m.count, m.expected) for m in found}
    assert counts == {(40, 51): (50, 25), (1, 2): (50, 25), (40, 2): (0, 25), (1, 51): (0, 25)}


def test_the_order_of_the_list():
    found = motifs(planted(4, (0, 1, 2, 3, 0), 0))
    kinds = [2 if m.corrected > 0.05 else int(m.ratio < 1) for m in found]
    assert kinds == sorted(kinds)
    assert set(kinds) == {0, 1, 2}
    for kind in range(3):
        p_values = [m.p_value for m, k in zip(found, kinds, strict=True) if k == kind]
        assert p_values == sorted(p_values)
    assert motifs(planted(4, (0, 1, 2, 3, 0), 0), top=7) == found[:7]


def test_chunks_change_nothing(monkeypatch):
    plans = planted(4, (2, 2, 0, 1), 1)[:30]
    whole, module = motifs(plans), sys.modules[fisher_two_sided.__module__]
    monkeypatch.setattr(module, "CANDIDATES_AT_ONCE", 7)
    monkeypatch.setattr(module, "COUNTS_AT_ONCE", 1)  # one unit at a time
    parts = motifs(plans)
    assert len(parts) == len(whole) > 0
    for one, other in zip(parts, whole, strict=True):
        assert one.actions == other.actions
        assert astuple(one)[1:] == pytest.approx(astuple(other)[1:], rel=1e-9)


@pytest.mark.parametrize(
    "plans",
    [
        Plans(torch.zeros(0, 9).long(), 3),
        Plans(torch.zeros(5, 0).long(), 3),
        Plans(torch.zeros(5, 9).long(), 3),
        Plans(torch.zeros(5, 9).long(), 1),
        Plans(torch.randint(3, (3, 2), generator=seeded(0)), 3),
    ],
)
def test_nothing_to_test(plans):
    assert motifs(plans) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"lengths": (3, 1)}, "`lengths` must be at least 2, got 1"),
        ({"lengths": (3, 3)}, "`lengths` must be different integers, one or more, got [3, 3]"),
        ({"lengths": ()}, "`lengths` must be different integers, one or more, got []"),
        ({"lengths": 3}, "lengths"),
        ({"top": 0}, "top"),
    ],
)
def test_what_is_refused(options, words):
    with refuses(words):
        motifs(planted(4, (0, 1, 2), 0), **options)
