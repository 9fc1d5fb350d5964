"""Transitions and the tests of their differences against brute force, scipy, enumeration and null data."""

import itertools
from collections import Counter

import numpy as np
import pytest
import torch
from scipy import special, stats

from neuroprior import Plans
from neuroprior.behaviour import RecordedPlans, transitions
from neuroprior.behaviour.analysis.transitions import FEWEST_PERMUTATIONS
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import refuses, seeded


def unequal() -> Plans:
    """Plans of 0 to 7 of 4 actions, one of which never occurs, in the groups -2, 5 and 9."""
    group = torch.tensor([5, 9, 5, -2] * 5)
    lengths = torch.randint(8, (20,), generator=seeded(1))
    return Plans(torch.randint(3, (20, 7), generator=seeded(0)), 4, lengths, group=group)


def test_counts_are_those_of_brute_force():
    plans = unequal()
    found = transitions(plans, 9, seeded(0))
    assert found.groups.tolist() == [-2, 5, 9]
    each = Counter()
    for row, length, group in zip(plans.actions.tolist(), plans.lengths.tolist(), plans.group.tolist(), strict=True):
        each.update((group, *pair) for pair in itertools.pairwise(row[:length]))
    for g, a, b in itertools.product(range(3), range(4), range(4)):
        assert found.group_counts[g, a, b] == each[found.groups[g].item(), a, b]
    assert found.counts.equal(found.group_counts.sum(0))
    assert found.counts.dtype == torch.int64


def test_probs():
    found = transitions(Plans(torch.tensor([[0, 1, 0, 1, 0, 0]]), 3))
    want = [[1 / 3, 2 / 3, 0], [1, 0, 0]]
    assert found.probs()[:2].flatten().tolist() == pytest.approx([p for row in want for p in row])
    assert found.probs()[2].isnan().all()
    torch.testing.assert_close(found.group_probs()[0], found.probs(), equal_nan=True)


def statistics(plans: Plans) -> tuple[float, float]:
    """The statistics of all and of the strongest cell, by scipy."""
    counts = transitions(Plans(plans.actions, plans.num_actions, group=plans.group), 1, seeded(0)).group_counts
    whole, cells = 0.0, [0.0]
    for table in counts.transpose(0, 1).numpy():
        table = table[table.sum(1) > 0][:, table.sum(0) > 0]
        if min(table.shape, default=0) < 2:
            continue
        whole += stats.chi2_contingency(table, correction=False, lambda_="log-likelihood").statistic
        for g, b in itertools.product(range(table.shape[0]), range(table.shape[1])):
            ours, others = table[g], table.sum(0) - table[g]
            cell = [[ours[b], ours.sum() - ours[b]], [others[b], others.sum() - others[b]]]
            cells.append(stats.chi2_contingency(cell, correction=False, lambda_="log-likelihood").statistic)
    return whole, max(cells)


def test_permutations_come_near_to_all_divisions():
    """Three of seven plans in one group: all 35 divisions against 4,000 drawn ones (5 standard errors)."""
    actions = markov_plans(markov_probs(2, 1, 0), 7, 9, 5).actions
    divisions = []
    for chosen in itertools.combinations(range(7), 3):
        group = torch.zeros(7).long().index_fill(0, torch.tensor(chosen), 1)
        divisions.append(statistics(Plans(actions, 2, group=group)))
    observed = statistics(Plans(actions, 2, group=torch.tensor([1, 1, 1, 0, 0, 0, 0])))
    found = transitions(Plans(actions, 2, group=torch.tensor([1, 1, 1, 0, 0, 0, 0])), 4000, seeded(1))
    assert found.test == "permutation"
    assert found.permutations == 4000
    assert found.statistic == pytest.approx(observed[0])
    reached = [sum(one[i] >= observed[i] - 1e-9 for one in divisions) / 35 for i in (0, 1)]
    assert 0.05 < reached[0] < 0.95
    assert 0.05 < reached[1] < 0.95
    assert found.p_value == pytest.approx(reached[0], abs=5 * 0.5 / 4000**0.5)
    assert float(found.cell_p_values.min()) == pytest.approx(reached[1], abs=5 * 0.5 / 4000**0.5)


def test_ties_count():
    """Plans that are all equal: every permutation has the same statistic, and every p-value is 1."""
    plans = Plans(torch.tensor([0, 0, 1, 1, 0]).expand(12, 5), 2, group=torch.arange(12) % 2)
    found = transitions(plans, 50, seeded(0))
    assert found.p_value == 1
    assert (found.cell_p_values == 1).all()


@pytest.mark.parametrize(
    ("plans_of_groups", "test"),
    [
        ([5], "none"),
        ([0, 4, 0], "none"),
        ([1] * 30, "none"),
        ([2, 2, 2], "none"),  # 15 divisions
        ([18, 1], "none"),  # 19
        ([19, 1], "permutation"),  # 20
        ([3, 4], "permutation"),  # 35
    ],
)
def test_which_test(plans_of_groups, test):
    """Plans of a single action, three in each group, count for nothing."""
    group = torch.arange(len(plans_of_groups)).repeat_interleave(torch.tensor(plans_of_groups))
    lengths = torch.cat([torch.full_like(group, 20), torch.ones(3 * len(group.unique()), dtype=torch.long)])
    group = torch.cat([group, group.unique().repeat(3)])
    actions = torch.randint(2, (len(group), 20), generator=seeded(0))
    found = transitions(Plans(actions, 2, lengths, group=group), 19, seeded(0))
    assert found.test == test
    assert found.permutations == (19 if test == "permutation" else 0)
    assert (found.p_value != found.p_value) == (test == "none")


def test_without_anything_to_compare():
    for plans in (
        Plans(torch.zeros(0, 5).long(), 2),
        Plans(torch.zeros(3, 1).long(), 2, group=torch.arange(3)),
        Plans(torch.zeros(30, 5).long(), 2, group=torch.arange(30) % 2),
        Plans(torch.randint(2, (9, 5), generator=seeded(0)), 2),
    ):
        found = transitions(plans)
        assert found.test == "none"
        assert found.p_value != found.p_value
        assert found.statistic != found.statistic
        assert found.cell_p_values.isnan().all()
        assert found.cell_p_values.shape == found.group_counts.shape


def test_cells_without_anything_to_compare_are_nan():
    """After action 2 only group 1 goes on, after 1 there is always 0, nobody takes action 3, and group 2 is empty."""
    actions = torch.tensor([[0, 0, 1, 0, 0, 1, 0]] * 6 + [[1, 0, 2, 2, 1, 0, 0]] * 6)
    lengths = torch.tensor([7] * 12 + [1])
    group = torch.tensor([0] * 6 + [1] * 6 + [2])
    plans = Plans(torch.cat([actions, actions[:1]]), 4, lengths, group=group)
    known = ~transitions(plans, 99, seeded(0)).cell_p_values.isnan()
    want = torch.zeros(3, 4, 4, dtype=torch.bool)
    want[:2, 0, :3] = True  # 0 is followed by 0, 1 and 2
    assert known.equal(want)


def null_plans(seed: int, groups: int, num: int, length: int) -> Plans:
    """A source of dissimilar plans: each follows one of two chains."""
    both = [markov_plans(markov_probs(3, 1, 2 * seed + i), num, length, 7 * seed + i) for i in (0, 1)]
    which = torch.rand(num, 1, generator=seeded(seed)) < 0.5
    actions = torch.where(which, both[0].actions, both[1].actions)
    return Plans(
        actions, 3, torch.randint(length + 1, (num,), generator=seeded(seed)), group=torch.arange(num) % groups
    )


def test_a_group_of_its_own_is_found():
    """Group 2 goes from 0 to 1 more often; the rows of other actions do not differ."""
    probs = markov_probs(4, 1, 0)
    other = probs.clone()
    other[0] = torch.tensor([0.1, 0.7, 0.1, 0.1])
    parts = [markov_plans(p, 12, 60, seed).actions for seed, p in enumerate((probs, probs, other))]
    plans = Plans(torch.cat(parts), 4, group=torch.arange(3).repeat_interleave(12))
    found = transitions(plans, 999, seeded(0))
    assert found.p_value == 1 / 1000
    assert found.cell_p_values[2, 0, 1] == 1 / 1000
    assert (found.cell_p_values[:, 1:] > 0.05).all()


def test_work_is_bounded(monkeypatch):
    """How many permutations are made together changes nothing."""
    plans = null_plans(0, 3, 18, 20)
    full = transitions(plans, 300, seeded(0))
    assert full.permutations == 300
    monkeypatch.setattr("neuroprior.behaviour.analysis.transitions.NUMBERS_AT_ONCE", 1)
    alone = transitions(plans, 300, seeded(0))
    assert alone.p_value == full.p_value
    assert alone.cell_p_values.equal(full.cell_p_values)
    monkeypatch.setattr("neuroprior.behaviour.analysis.transitions.MAX_WORK", 1)
    assert transitions(plans, 300, seeded(0)).permutations == FEWEST_PERMUTATIONS
    assert transitions(plans, 20, seeded(0)).permutations == 20


def test_bad_input():
    with refuses("permutations", "0"):
        transitions(unequal(), 0)


def by_condition() -> RecordedPlans:
    """Five animals under two conditions, of two to four sessions of different lengths."""
    group = torch.tensor([0, 0, 1, 1, 1, 2, 2, 3, 3, 3, 3, 4, 4])
    condition = torch.tensor([0, 0, 1, 1, 1, 0, 0, 1, 1, 1, 1, 0, 0])
    actions = torch.randint(3, (13, 30), generator=seeded(4))
    names = {"action_names": ("eat", "rest", "walk"), "condition_names": ("saline", "drug")}
    lengths = 12 + torch.arange(13)
    return RecordedPlans(actions, 3, lengths, group=group, condition=condition, **names)


def test_intervals_leave_out_a_subject():
    """In plain loops, on the scale of log odds."""
    plans = by_condition()
    found = transitions(plans, 9, seeded(0), by="condition")
    frame = found.frame()
    assert [*frame["condition"].unique()] == ["all", "saline", "drug"]
    for row in frame.itertuples():
        own = plans if row.condition == "all" else plans[plans.condition == ["saline", "drug"].index(row.condition)]
        per = transitions(own, 1, seeded(0)).group_counts.double()
        a, b = (plans.action_names.index(name) for name in (row[2], row.to))
        times, of_row = per[:, a, b].numpy(), per[:, a].sum(1).numpy()
        times, of_row = times[of_row > 0], of_row[of_row > 0]
        share, units = times.sum() / of_row.sum(), len(times)
        assert (row.count, row.probability) == (times.sum(), pytest.approx(share))
        without = [np.delete(times, k).sum() / np.delete(of_row, k).sum() for k in range(units)]
        error = np.sqrt((units - 1) / units * sum((one - share) ** 2 for one in without))
        freedom = max(of_row.sum() ** 2 / (of_row**2).sum() - 1, 1)
        half = stats.t.ppf(0.975, freedom) * error / share / (1 - share)
        assert (row.low, row.high) == pytest.approx(special.expit(special.logit(share) + half * np.array([-1, 1])))


def test_of_what_always_follows_the_lower_bound_is_exact():
    """Three subjects show it with .025 at most where its probability is so low; of one subject nothing is known."""
    actions = torch.tensor([[0, 1, 0, 1], [0, 1, 1, 1], [0, 1, 0, 1], [1, 0, 1, 0], [2, 2, 2, 2]])
    result = transitions(Plans(actions, 3, group=torch.tensor([4, 4, 7, 9, 9])), 9, seeded(0))
    assert [result.low[0, 0, 1], result.high[0, 0, 1]] == pytest.approx([0.025 ** (1 / 3), 1])
    assert result.low[0, 2, 2].isnan()
    assert result.high[0, 2, 2].isnan()


def test_whole_subjects_are_permuted_between_conditions():
    """Three animals against two: ten divisions are too few; of six against six there are enough. Within: none."""
    assert transitions(by_condition(), 9, seeded(0), by="condition").test == "none"
    plans = markov_plans(markov_probs(3, 1, 0), 24, 20, 1)
    group = torch.arange(24) // 2
    between = RecordedPlans(plans.actions, 3, group=group, condition=group % 2)
    assert transitions(between, 9, seeded(0), by="condition").test == "permutation"
    within = RecordedPlans(plans.actions, 3, group=group, condition=torch.arange(24) % 2)
    assert transitions(within, 9, seeded(0), by="condition").test == "none"
    with refuses("`by` must be"):
        transitions(between, by="treatment")


def test_the_graph_has_the_transitions_above_chance():
    probs = torch.tensor([[0.0, 0.8, 0.2], [0.45, 0.1, 0.45], [0.1, 0.6, 0.3]])
    plans = markov_plans(probs[None].log().softmax(-1)[0], 12, 200, 3, group=torch.arange(12) % 6)
    found = transitions(plans, 9, seeded(0))
    graph, counts = found.graph(), found.counts.double()
    apart = counts.clone().fill_diagonal_(0)
    above = {
        (str(a), str(b)) for a in range(3) for b in range(3) if found.low[0, a, b] > apart[:, b].sum() / apart.sum()
    }
    assert {*graph.edges} == above
    assert ("0", "1") in above
    assert graph.edges["0", "1"]["weight"] == pytest.approx(float(found.probs()[0, 1]))
    with refuses("`group` must be one of group 0, "):
        found.graph("nobody")


def test_a_subject_that_is_called_all_is_one_of_them():
    plans = RecordedPlans(
        torch.tensor([[0, 1, 0], [1, 1, 0]]), 2, group=torch.tensor([0, 1]), group_names=("m1", "all")
    )
    frame = transitions(plans, 9).frame()
    assert frame.groupby("subject")["count"].sum().to_dict() == {"all groups": 4, "m1": 2, "all": 2}
    assert sorted(transitions(plans, 9).graph("all").nodes(data="count")) == [("0", 0), ("1", 2)]
