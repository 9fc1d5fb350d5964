"""Comparisons of conditions against brute force, refits by hand, null studies and planted changes."""

import itertools
from collections import Counter
from dataclasses import replace
from math import log, log2

import numpy as np
import pytest
import torch
from scipy import stats

from neuroprior import Plans
from neuroprior._statistics import p_words
from neuroprior.behaviour import PermutationDesign, compare_conditions, holm
from neuroprior.behaviour.analysis.condition_chains import SMOOTHING
from neuroprior.behaviour.recorded_plans import RecordedPlans
from tests.support.sources import refuses, seeded
from tests.support.studies import between, study, within

TESTS = ["behaviours", "transitions", "sequences", "durations", "bits", "classifier"]


def family_of(found, name):
    return next(one for one in found.families if one.name == name)


def pairs_of(plans: Plans) -> Counter[tuple[int, int, int, int]]:
    """How often b followed a in each group and condition; a is A at the beginning of a plan."""
    counts: Counter[tuple[int, int, int, int]] = Counter()
    lengths = plans.mask().sum(1).tolist()
    for row, length, group, condition in zip(
        plans.actions.tolist(), lengths, plans.group.tolist(), plans.condition.tolist(), strict=True
    ):
        steps = [plans.num_actions, *row[:length]]
        counts.update((group, condition, *pair) for pair in itertools.pairwise(steps))
    return counts


def smoothed_shares(plans: Plans) -> np.ndarray:
    """`[B, A]`: the share of each action in each group and condition, smoothed by hand."""
    counts = pairs_of(plans)
    blocks = sorted({key[:2] for key in counts})
    table = np.array(
        [
            [sum(n for k, n in counts.items() if k[:2] == b and k[3] == a) for a in range(plans.num_actions)]
            for b in blocks
        ],
        dtype=float,
    )
    total = table.sum(1, keepdims=True)
    weight = total / (total + SMOOTHING)
    usual = (weight * table / total).sum(0) / weight.sum()
    if len({group for group, _ in blocks}) < len(blocks):
        groups = np.array([group for group, _ in blocks])
        usual = np.stack(
            [(table[groups == g].sum(0) + SMOOTHING * usual) / (total[groups == g].sum() + SMOOTHING) for g in groups]
        )
    return (table + SMOOTHING * usual) / (total + SMOOTHING)


def expect_p_values(family, statistics: np.ndarray) -> None:
    """`statistics [P, F]` of all labellings, the observed one first."""
    reach = statistics >= statistics[:1] * (1 - 1e-9)
    np.testing.assert_allclose(family.statistic, statistics[0], rtol=1e-9)
    np.testing.assert_allclose(family.p_values, reach.mean(0))
    largest = statistics.max(1)[:, None] >= statistics[:1] * (1 - 1e-9)
    np.testing.assert_allclose(family.corrected, largest.mean(0))
    assert family.p_value == pytest.approx(largest.mean(0).min())


def test_between_units_all_labellings_are_compared_by_welchs_t():
    plans = study(0, [[0], [0, 0], [1], [1, 1, 1], [0], [1, 1], [0]])
    shares, label = smoothed_shares(plans), np.array([0, 0, 1, 1, 0, 1, 0])
    others = [np.isin(range(7), chosen).astype(int) for chosen in itertools.combinations(range(7), 3)]
    others.sort(key=lambda own: tuple(own) != tuple(label))
    welch = [stats.ttest_ind(shares[own == 1], shares[own == 0], equal_var=False).statistic ** 2 for own in others]
    found = compare_conditions(plans)
    assert (found.labellings, found.exact, found.smallest_p) == (35, True, 1 / 35)
    expect_p_values(family_of(found, "behaviours"), np.array(welch))


def test_within_units_conditions_are_swapped_and_compared_by_the_paired_t():
    plans = study(1, [[0, 1], [1, 0, 1], [0, 0, 1], [1, 0], [0, 1]])
    shares = smoothed_shares(plans).reshape(5, 2, -1)
    found = compare_conditions(plans)
    swaps = itertools.product([False, True], repeat=5)
    paired = []
    for swap in swaps:
        pair = np.where(np.array(swap)[:, None, None], shares[:, ::-1], shares)
        paired.append(stats.ttest_rel(pair[:, 1], pair[:, 0]).statistic ** 2)
    assert (found.labellings, found.exact, found.smallest_p) == (32, True, 2 / 32)
    expect_p_values(family_of(found, "behaviours"), np.array(paired))


def test_three_conditions_between_units():
    plans = study(2, [[0], [1, 1], [2, 2], [0, 0, 0], [1], [2]])
    shares = smoothed_shares(plans)
    labellings = sorted(set(itertools.permutations([0, 1, 2, 0, 1, 2])), key=lambda own: own != (0, 1, 2, 0, 1, 2))
    statistics = []
    for own in np.array(labellings):
        mean = np.stack([shares[own == k].mean(0) for k in range(3)])
        weight = np.stack([2 / shares[own == k].var(0, ddof=1) for k in range(3)])
        common = (weight * mean).sum(0) / weight.sum(0)
        statistics.append((weight * (mean - common) ** 2).sum(0) / 2)
    found = compare_conditions(plans)
    assert (found.labellings, found.smallest_p) == (90, 6 / 90)
    expect_p_values(family_of(found, "behaviours"), np.array(statistics))
    assert family_of(found, "behaviours").difference.isnan().all()


def test_three_conditions_within_units_are_compared_by_the_f_of_repeated_measures():
    plans = study(3, within(4, 3, 3))
    shares = smoothed_shares(plans).reshape(4, 3, -1)
    statistics = []
    for orders in itertools.product(itertools.permutations(range(3)), repeat=4):
        own = np.stack([shares[unit][list(order)] for unit, order in enumerate(orders)])
        middle = own - own.mean(1, keepdims=True)
        conditions = 4 * (middle.mean(0) ** 2).sum(0)
        rest = (middle**2).sum((0, 1)) - conditions
        statistics.append((conditions / 2) / (rest / 6))
    found = compare_conditions(plans)
    assert (found.labellings, found.smallest_p) == (6**4, 6 / 6**4)
    expect_p_values(family_of(found, "behaviours"), np.array(statistics))


def refitted(plans: Plans) -> dict[tuple[int, int], list[float]]:
    """For each group and condition its log2-likelihood without condition, then under each, fitted by hand."""
    counts, size, s = pairs_of(plans), plans.num_actions, SMOOTHING
    strata = torch.zeros(len(plans)) if plans.stratum is None else plans.stratum
    stratum = dict(zip(plans.group.tolist(), strata.tolist(), strict=True))
    labels = sorted({key[1] for key in counts})
    found: dict[tuple[int, int], list[float]] = {}
    for group, label in {key[:2] for key in counts}:
        learned = {key: n for key, n in counts.items() if key[0] != group}

        def number(learned=learned, group=group, **wanted: int) -> float:
            names = ("group", "label", "a", "b")
            own = {key: n for key, n in learned.items() if "a" not in wanted or stratum[key[0]] == stratum[group]}
            return sum(n for key, n in own.items() if all(key[names.index(w)] == v for w, v in wanted.items()))

        sums = [0.0] * (1 + len(labels))
        for (g, k, a, b), n in counts.items():
            if (g, k) != (group, label):
                continue
            single = (number(b=b) + s / size) / (number() + s)
            plain = (number(a=a, b=b) + s * single) / (number(a=a) + s)
            known = [(number(label=k, a=a, b=b) + s * plain) / (number(label=k, a=a) + s) for k in labels]
            sums = [total + n * log2(p) for total, p in zip(sums, [plain, *known], strict=True)]
        found[group, label] = sums
    return found


@pytest.mark.parametrize(
    "conditions",
    [[[0], [1, 1], [0, 0], [1], [1]], [[0, 1], [1, 1, 0], [0, 1]], [[0, 1, 2], [2, 1, 0, 0], [1, 2, 0]]],
    ids=["between", "within", "three within"],
)
@pytest.mark.parametrize("with_strata", [False, True])
def test_the_prediction_is_that_of_chains_refitted_without_the_unit(conditions, with_strata):
    conditions = conditions * (1 + with_strata)
    plans = study(9 + with_strata, conditions, length=12, num_actions=3)
    plans = replace(plans, lengths=torch.randint(4, 13, (len(plans),), generator=seeded(0)))
    if with_strata:
        plans = replace(plans, stratum=plans.group // (len(conditions) // 2))
    by_hand = refitted(plans)
    blocks, actions = sorted(by_hand), int(plans.lengths.sum())
    found = compare_conditions(plans).prediction
    labels = [label for _, label in blocks]
    logs = np.array([by_hand[block] for block in blocks])
    num = logs.shape[1] - 1
    right = logs[range(len(blocks)), 1 + np.array(labels)]
    assert found.gain.mean == pytest.approx((right - logs[:, 0]).sum() / actions)
    odds = logs[:, 1:] - (logs[:, 1:].sum(1, keepdims=True) - logs[:, 1:]) / (num - 1)
    np.testing.assert_allclose(found.log_odds, odds, atol=1e-9)
    correct = logs[:, 1:].argmax(1) == labels
    assert {*correct} == {False, True}
    assert found.accuracy == pytest.approx(np.mean([correct[np.array(labels) == k].mean() for k in range(num)]))


def test_the_p_values_of_bits_and_classifier_are_those_of_relabelled_plans():
    """Computed anew under each labelling, they are ranked as the permutation test says."""
    plans = study(1, between(6, 2), length=20, num_actions=3)
    found = compare_conditions(plans)
    bits, shares, odds = [], [], []

    def mean_odds(own, label):
        return float(own.log_odds.gather(1, label[::2, None]).mean())

    for chosen in itertools.combinations(range(6), 3):
        label = torch.isin(plans.group, torch.tensor(chosen)).long()
        own = compare_conditions(replace(plans, condition=label)).prediction
        bits.append(own.gain.mean)
        shares.append(own.accuracy)
        odds.append(mean_odds(own, label))
    assert found.prediction.gain.p_value == pytest.approx(np.mean(np.array(bits) >= found.prediction.gain.mean - 1e-12))
    assert found.prediction.expected == pytest.approx(np.mean(shares))
    # Animals have as many actions each. Of equal accuracies the one with the larger mean log odds is better.
    same = np.isclose(shares, found.prediction.accuracy)
    better = (np.array(shares) > found.prediction.accuracy) & ~same
    surer = np.array(odds) >= mean_odds(found.prediction, plans.condition) - 1e-9
    assert found.prediction.p_value == pytest.approx((better | (same & surer)).mean())
    assert (same & ~surer).any()


def test_all_tests_are_corrected_and_combined():
    plans = study(10, between(8))
    found = compare_conditions(plans)
    assert list(found.tests) == TESTS
    p_values = [found.tests[name][0] for name in TESTS]
    assert [family.p_value for family in found.families] == pytest.approx(p_values[:4])
    # The smallest p-value of a test and of all with larger ones, under every labelling.
    under = []
    for chosen in itertools.combinations(range(8), 4):
        label = torch.isin(plans.group, torch.tensor(chosen)).long()
        under.append([p for p, _ in compare_conditions(replace(plans, condition=label)).tests.values()])
    order, corrected = np.argsort(p_values, kind="stable"), np.zeros(len(TESTS))
    for step, test in enumerate(order):
        smallest = np.array(under)[:, order[step:]].min(1)
        share = np.mean(smallest <= p_values[test] + 1e-9)
        corrected[test] = max(share, corrected[order[step - 1]] if step else 0)
    assert [found.tests[name][1] for name in TESTS] == pytest.approx(corrected)
    assert found.p_value == pytest.approx(corrected.min())
    assert (corrected <= holm(p_values) + 1e-9).all()


def leave_one_out(values, weight):
    """The weighted mean, the jackknife's error, and degrees of freedom: as many equal weights vary as much, less 1."""
    mean, units = np.average(values, weights=weight), len(values)
    without = [np.average(np.delete(values, k), weights=np.delete(weight, k)) for k in range(units)]
    error = np.sqrt((units - 1) / units * sum((one - mean) ** 2 for one in without))
    return mean, error, weight.sum() ** 2 / (weight**2).sum() - 1


def test_estimates_are_weighted_means_over_animals_with_students_intervals():
    """Animal 0 takes action 1 in 10 of 30 actions, and so on: with n actions an animal has the weight n / (n + 20)."""
    ones, lengths = [10, 10, 3, 30, 20, 6], [30, 20, 6, 60, 30, 12]
    actions = torch.zeros(6, 60, dtype=torch.long)
    for row, number in enumerate(ones):
        actions[row, :number] = 1
    plans = RecordedPlans(
        actions, 2, torch.tensor(lengths), group=torch.arange(6), condition=torch.tensor([0, 0, 0, 1, 1, 1])
    )
    family = family_of(compare_conditions(plans), "behaviours")
    share, n = np.array(ones) / lengths, np.array(lengths)
    weight = n / (n + SMOOTHING)
    np.testing.assert_allclose(family.values[:, 1], share)
    errors = []
    for k, own in enumerate((slice(0, 3), slice(3, 6))):
        mean, error, freedom = leave_one_out(share[own], weight[own])
        half = stats.t.ppf(0.975, freedom) * error
        assert [family.means[k, 1], family.low[k, 1], family.high[k, 1]] == pytest.approx(
            [mean, mean - half, mean + half]
        )
        errors.append((error**2, freedom))
    gap = float(family.means[1, 1] - family.means[0, 1])
    variance = sum(square for square, _ in errors)
    half = stats.t.ppf(0.975, variance**2 / sum(square**2 / freedom for square, freedom in errors)) * np.sqrt(variance)
    assert family.difference[:, 1].tolist() == pytest.approx([gap, gap - half, gap + half])


def test_paired_differences_are_weighted_over_animals():
    plans = study(7, [[0, 1], [0, 1, 1], [0, 0, 1], [0, 1]], length=15)
    family = family_of(compare_conditions(plans), "behaviours")
    label, n = np.array([0, 1] * 4), np.array([15, 15, 15, 30, 30, 15, 15, 15])
    gap = np.diff(family.values.numpy().reshape(4, 2, -1), axis=1)[:, 0]
    weight = 1 / (1 + SMOOTHING / n[label == 0] + SMOOTHING / n[label == 1])
    for place in range(gap.shape[1]):
        mean, error, freedom = leave_one_out(gap[:, place], weight)
        half = stats.t.ppf(0.975, freedom) * error
        np.testing.assert_allclose(family.difference[:, place], [mean, mean - half, mean + half], atol=1e-12)


def test_features_are_shares_and_mean_log_durations_by_hand():
    """The numbers of the first of two animals; durations of 0 and unknown ones do not count."""
    actions = torch.tensor([[0, 1, 0, 1, 2], [0, 1, 1, 0, 0], [2, 2, 0, 1, 0], [0, 1, 0, 1, 2]])
    durations = torch.ones(4, 5)
    durations[0] = torch.tensor([4.0, 9.0, 0.0, float("nan"), 1.0])
    durations[1, 0] = 2.0
    plans = RecordedPlans(
        actions, 3, group=torch.tensor([0, 0, 1, 2]), condition=torch.tensor([0, 0, 1, 1]), durations=durations
    )
    plans = plans[torch.tensor([0, 1, 2, 2, 3, 3])]
    plans = replace(plans, group=torch.tensor([0, 0, 1, 1, 3, 2]), condition=torch.tensor([0, 0, 1, 1, 0, 1]))
    found = compare_conditions(plans)
    numbers = {
        (family.name, *feature): float(value)
        for family in found.families
        for feature, value in zip(family.features.tolist(), family.values[0], strict=True)
    }
    assert numbers["behaviours", 0] == 5 / 10
    assert numbers["transitions", 0, 1] == 3 / 4
    assert numbers["transitions", 1, 0] == 2 / 4
    assert numbers["sequences", 0, 1, 0] == 1 / 6
    assert numbers["durations", 0] == pytest.approx((log(4) + log(2)) / 4)
    assert numbers["durations", 1] == pytest.approx(log(9) / 3)


@pytest.mark.parametrize(("permutations", "labellings", "smallest"), [(69, 70, 2 / 70), (68, 69, 1 / 69)])
def test_all_labellings_are_compared_where_they_are_no_more(permutations, labellings, smallest):
    found = compare_conditions(study(0, between(8)), permutations, seeded(0))
    assert (found.labellings, found.exact, found.smallest_p) == (labellings, labellings == 70, pytest.approx(smallest))
    assert found.conclusive
    assert f"With 4 against 4 subjects the smallest possible is {p_words(smallest)}" in found.verdict


def test_with_too_few_there_is_no_verdict():
    found = compare_conditions(study(0, between(4), slower={0: 100.0}, habit=0.1))
    assert found.smallest_p == pytest.approx(2 / 6)
    assert found.verdict == "With 2 against 2 subjects the smallest possible is p = .33: no test can find a difference."
    assert not any(found.significant(family).any() for family in found.families)
    # Three animals under three conditions have enough permutations, but are too few.
    found = compare_conditions(study(0, within(3, 3, 3)))
    assert found.smallest_p == pytest.approx(6 / 6**3)
    assert found.verdict == "3 subjects under every condition are too few for a verdict."
    assert not found.conclusive


@pytest.mark.parametrize(
    ("conditions", "why"),
    [
        ([[0, 0], [0], [0]], "Not tested: all sequences are under one condition."),
        ([[0], [0], [0], [1, 1]], "drug 1 has one of the subjects only"),
        ([[0, 1, 0, 1]], "of the subjects, only one is under every condition"),
        ([[0, 1], [1, 2], [0, 2]], "of the subjects, none is under every condition"),
    ],
)
def test_what_cannot_be_tested_says_why(conditions, why):
    found = compare_conditions(study(0, conditions))
    assert why in found.verdict
    assert found.verdict.startswith("Not tested: ")
    assert (found.families, found.prediction, found.tests) == ([], None, {})


def test_plans_without_condition_are_refused():
    with refuses("condition", "none"):
        compare_conditions(Plans(torch.zeros(3, 3, dtype=torch.long), 2))
    with refuses("permutations"):
        compare_conditions(study(0, between(8)), permutations=0)


@pytest.mark.parametrize("drawn", [10**4, 20], ids=["all", "random"])
@pytest.mark.parametrize(
    ("conditions", "possible"),
    [
        ([[0], [1, 1], [0, 0, 0], [1], [1] * 4, [0, 0], [0]], 35),
        ([[0, 1, 2], [2, 1, 0, 0], [1, 2, 0], [0, 1, 2, 2]], 6**4),
    ],
    ids=["between", "within"],
)
def test_whole_animals_are_relabelled_and_within_them_whole_blocks(conditions, possible, drawn):
    plans = study(0, conditions, length=5)
    design = PermutationDesign.of(plans)
    labellings = design.labellings(drawn, seeded(0))
    assert labellings.shape[1] == min(possible, drawn + 1)
    each = labellings.view(-1 if possible == 35 else 4, 7 if possible == 35 else 3, labellings.shape[1])
    assert each.sort(1).values.eq(each[:, :, :1].sort(1).values).all()
    of_plans = labellings[design.block]
    assert of_plans[:, 0].equal(plans.condition.short())
    for group, label in {*zip(plans.group.tolist(), plans.condition.tolist(), strict=True)}:
        own = of_plans[(plans.group == group) & (plans.condition == label)]
        assert own.eq(own[:1]).all()
    assert drawn == 20 or len(labellings.unique(dim=1).T) == possible


def test_all_labellings_are_distinct_and_the_observed_one_is_first():
    for sizes in ([3, 4], [2, 2, 3], [2, 2, 2, 2]):
        label = torch.tensor([k for k, size in enumerate(sizes) for _ in range(size)])
        label = label[torch.randperm(len(label), generator=seeded(0))]
        plans = RecordedPlans(torch.zeros(len(label), 1, dtype=torch.long), 2, condition=label)
        design = PermutationDesign.of(plans)
        found = [tuple(own) for own in design.labellings(design.possible - 1).T.tolist()]
        assert found[0] == tuple(label.tolist())
        assert {*found} == {*itertools.permutations(label.tolist())}
        assert len(found) == len({*found}) == design.possible


def test_random_permutations_give_the_exact_p_value():
    """With 2,000 permutations a p-value is 5 standard errors off with a probability below 1e-6."""
    plans = study(8, between(14), length=30, num_actions=3)
    exact, drawn = compare_conditions(plans), compare_conditions(plans, 2000, seeded(0))
    assert (exact.exact, exact.labellings, drawn.exact, drawn.labellings) == (True, 3432, False, 2001)
    for name in TESTS:
        p = exact.tests[name][0]
        assert abs(drawn.tests[name][0] - p) < 5 * (p * (1 - p) / 2000) ** 0.5 + 1 / 2001
    assert drawn.smallest_p == 1 / 2001


def test_work_is_bounded(monkeypatch):
    plans = study(8, between(14, 1), length=20, num_actions=3)

    def drawn(max_work):
        monkeypatch.setattr("neuroprior.behaviour.analysis.conditions.MAX_WORK", max_work)
        return compare_conditions(plans, generator=seeded(0)).labellings - 1

    assert drawn(1) == drawn(300_000) == 999
    assert 999 < drawn(10**6) < 3431
    assert drawn(800_000) / drawn(10**6) == pytest.approx(0.8, abs=0.001)


@pytest.mark.parametrize("conditions", [between(8), within(6)], ids=["between", "within"])
def test_parts_that_fit_the_memory_change_nothing(conditions, monkeypatch):
    plans = study(3, conditions, num_actions=3)
    whole = compare_conditions(plans, 63, seeded(0))
    design = PermutationDesign.of(plans)
    monkeypatch.setattr("neuroprior.behaviour.analysis.permutation_tests.NUMBERS_AT_ONCE", 60)
    monkeypatch.setattr("neuroprior.behaviour.analysis.condition_chains.CELLS_AT_ONCE", 1000)
    parts = compare_conditions(plans, 63, seeded(0))
    assert parts.tests == whole.tests
    assert parts.prediction.log_odds.equal(whole.prediction.log_odds)
    for one, other in zip(parts.families, whole.families, strict=True):
        for what in ("statistic", "p_values", "corrected"):
            assert getattr(one, what).equal(getattr(other, what))
    monkeypatch.setattr("neuroprior.behaviour.analysis.permutation_design.DRAWN_AT_ONCE", 7 * len(design.label))
    drawn = design.labellings(20, seeded(0))
    assert drawn.shape == (len(design.label), 21)
    assert drawn[:, 0].equal(design.label.short())
    shape = (-1, 2, 21) if design.kind == "within" else (1, -1, 21)
    assert drawn.view(shape).sum(1).eq(len(design.label) // drawn.view(shape).shape[0] // 2).all()


@pytest.mark.parametrize(("length", "number"), [(60, 71), (300, 100)])
def test_the_commonest_sequences_are_tested(length, number):
    """The 100 commonest at most, that occurred as often as there are animals; of equally common ones the first."""
    plans = study(0, between(8), num_actions=6, length=length)
    counts = Counter(tuple(row[t : t + 3]) for row in plans.actions.tolist() for t in range(length - 2))
    common = [one for one in sorted(counts, key=lambda one: (-counts[one], one))[:100] if counts[one] >= 8]
    assert len(common) == number
    family = family_of(compare_conditions(plans, 10), "sequences")
    assert [*map(tuple, family.features.tolist())] == sorted(common)


def test_animals_that_are_not_under_every_condition_are_left_out():
    conditions = [*within(8), [0, 0], [1]]
    plans = study(9, conditions)
    found = compare_conditions(plans)
    assert found.design.left_out.tolist() == [8, 9]
    assert found.design.units.tolist() == list(range(8))
    alone = compare_conditions(plans[plans.group < 8])
    assert alone.tests == found.tests


@pytest.mark.parametrize("slips", [[3], [3, 9]])
def test_slips_in_conditions_are_named(slips):
    """A session or two with the wrong condition make a paired design of twelve animals, of which few are left."""
    conditions = [[0, 0]] * 6 + [[1, 1]] * 6
    for animal in slips:
        conditions[animal] = [0, 1]
    plans = study(12, conditions)
    found = compare_conditions(replace(plans, group_names=[f"m{n}" for n in range(12)]))
    names = ", ".join(f"m{animal}" for animal in slips)
    assert (
        f"Under several conditions: {names}; the other {12 - len(slips)} subjects are under one each." in found.verdict
    )
    assert "mend the condition of their sequences" in found.verdict
    assert f"conditions: {', '.join(map(str, slips))};" in compare_conditions(plans).verdict
    # What is advised helps: the others can be compared.
    others = compare_conditions(plans[~torch.isin(plans.group, torch.tensor(slips))], 99)
    assert (others.design.kind, others.design.odd, others.conclusive) == ("between", "", True)


@pytest.mark.parametrize("conditions", [within(8), [*within(8), [0], [1]], [[0, 1], [0], [1]], [[0, 1], *[[0]] * 5]])
def test_paired_designs_are_no_slips(conditions):
    """Nor are those of which too few animals are under one condition to be compared with one another."""
    assert PermutationDesign.of(study(13, conditions)).odd == ""


def test_conditions_are_named_by_their_numbers():
    plans = study(10, between(8))
    found = compare_conditions(plans)
    other = replace(plans, condition=2 * plans.condition + 1, condition_names=["w", "x", "y", "z"])
    renamed = compare_conditions(other)
    assert renamed.condition_names == ["x", "z"]
    assert compare_conditions(replace(other, condition_names=None)).condition_names == ["condition 1", "condition 3"]
    assert renamed.design.conditions.tolist() == [1, 3]
    assert renamed.tests == found.tests


def test_without_groups_plans_are_the_units():
    plans = study(10, between(12, 1))
    found = compare_conditions(replace(plans, group=None))
    assert found.design.item == "sequences"
    assert found.tests == compare_conditions(plans).tests
    assert "6 against 6 sequences" in found.verdict


def test_plans_without_actions_and_actions_that_an_animal_never_takes():
    """An animal that never takes action 2 has no transitions from it, and no part in their means."""
    plans = study(11, between(8), num_actions=3)
    actions = torch.where((plans.group == 3)[:, None] & (plans.actions == 2), 0, plans.actions.long())
    lengths = torch.full((len(plans),), 60).index_fill(0, torch.tensor([0, 31]), 0)
    found = compare_conditions(replace(plans, actions=actions, lengths=lengths))
    assert all(0 < p <= 1 for pair in found.tests.values() for p in pair)
    family = family_of(found, "transitions")
    after = family.features[:, 0] == 2
    assert family.values[3, after].isnan().all()
    assert family.values[[0, 1, 2, 4, 5, 6, 7]].isfinite().all()
    assert family.means.isfinite().all()
    assert family.p_values.isfinite().all()
    # The interval is one of the other three animals of its condition.
    condition = int(plans.condition[plans.group == 3][0])
    others = [int(g) for g in plans.group[plans.condition == condition].unique() if g != 3]
    taken = (actions == 2)[:, :-1] & (torch.arange(1, actions.shape[1]) < lengths[:, None])
    n = np.array([int(taken[plans.group == animal].sum()) for animal in others])
    for place in after.nonzero()[:, 0].tolist():
        mean, error, freedom = leave_one_out(family.values[others, place].numpy(), n / (n + SMOOTHING))
        half = stats.t.ppf(0.975, freedom) * error
        ends = [float(one[condition, place]) for one in (family.means, family.low, family.high)]
        np.testing.assert_allclose(ends, [mean, mean - half, mean + half])


def test_where_all_animals_are_alike_there_is_no_interval():
    """In their mean; that of the difference takes the other condition's spread for theirs, as equal variances would."""
    half = torch.tensor([0, 1] * 12)
    actions = torch.stack([half, torch.tensor([0, 0, 0, 1] * 6), torch.tensor([0, 1, 1] * 8), half, half, half, half])
    plans = RecordedPlans(actions.repeat(1, 5), 2, group=torch.arange(7), condition=(torch.arange(7) > 2).long())
    family = family_of(compare_conditions(plans), "behaviours")
    assert family.means[1].tolist() == [0.5, 0.5]
    assert torch.cat([family.low[1], family.high[1]]).isnan().all()
    variance = float(family.values[:3, 0].var())
    freedom = (1 / 3 + 1 / 4) ** 2 / (1 / 3**2 / 2 + 1 / 4**2 / 3)
    width = stats.t.ppf(0.975, freedom) * np.sqrt(variance / 3 + variance / 4)
    gap = float(0.5 - family.values[:3, 0].mean())
    assert family.difference[:, 0].tolist() == pytest.approx([gap, gap - width, gap + width])
    alike = family_of(compare_conditions(replace(plans, actions=plans.actions[[1, 1, 1, 3, 3, 3, 3]])), "behaviours")
    assert alike.difference[0].tolist() == pytest.approx([-0.25, 0.25])
    assert alike.difference[1:].isnan().all()


def test_what_never_varies_does_not_differ():
    """A single action has the same share everywhere, and its p-value is 1."""
    plans = RecordedPlans(torch.zeros(8, 9, dtype=torch.long), 1, group=torch.arange(8), condition=torch.arange(8) % 2)
    found = compare_conditions(plans)
    assert [p for p, _ in found.tests.values()] == [1.0] * len(found.tests)
    assert found.prediction.accuracy == 0.5


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 1, 0, 2], [2, 3, 1, 0]])
def test_conditions_with_the_same_mean_do_not_differ(order):
    """Animals of both conditions take action 0 equally often: whatever rounding leaves of the difference is a tie."""
    often = [3, 7, 12, 18]
    rows = [[0] * k + [1] * (20 - k) for k in [*often, *(often[place] for place in order)]]
    plans = RecordedPlans(torch.tensor(rows), 2, group=torch.arange(8), condition=torch.arange(8) // 4)
    assert family_of(compare_conditions(plans), "behaviours").p_values.tolist() == [1, 1]


def false_alarms(conditions, studies: int, **settings) -> Counter[str]:
    """How many of the studies without an effect each test calls significant at 5 %, uncorrected."""
    alarms: Counter[str] = Counter(dict.fromkeys([*TESTS, "overall", "family"], 0))
    for seed in range(studies):
        found = compare_conditions(study(1000 + seed, conditions, **settings), 999, seeded(seed))
        alarms.update(name for name, (p, _) in found.tests.items() if p < 0.05)
        alarms["overall"] += found.p_value < 0.05
        alarms["family"] += any(corrected < 0.05 for _, corrected in found.tests.values())
    return alarms


@pytest.mark.slow
@pytest.mark.parametrize(
    ("conditions", "habit"),
    [
        (between(12), 1.0),
        (between(12), 0.0),
        ([[animal % 2] * (1 + animal % 5) for animal in range(13)], 1.0),
        (within(9), 1.0),
        ([[0, 1, 1] if animal % 3 else [0, 0, 0, 1] for animal in range(9)], 1.0),
        (between(9, 3, 3), 1.0),
        (within(6, 6, 3), 1.0),
    ],
    ids=["between", "alike", "unequal", "within", "unequal within", "three", "three within"],
)
def test_over_200_studies_false_alarms_are_5_percent(conditions, habit):
    """Within the binomial interval that a level of 5 % leaves with a probability of 0.1 % (corrected: at most that)."""
    alarms = false_alarms(conditions, 200, habit=habit)
    low, high = stats.binom.interval(0.999, 200, 0.05)
    assert alarms.pop("family") <= high
    assert all(low <= number <= high for number in alarms.values()), alarms


def test_the_frame_has_names_and_the_repr_is_short():
    """Of two conditions with unlike means: differences of the second from the first, ratios of durations."""
    generator = seeded(4)
    condition = torch.arange(12) // 6
    actions = torch.stack([torch.randint(2 + int(c), (40,), generator=generator) for c in condition])
    seconds = (1.0 + condition[:, None]) * (0.5 + torch.rand(12, 40, generator=generator))
    names = {"action_names": ("eat", "groom", "rest"), "condition_names": ("vehicle", "drug")}
    plans = RecordedPlans(actions, 3, group=torch.arange(12), condition=condition, durations=seconds, **names)
    result = compare_conditions(plans, 199, seeded(5))
    frame = result.frame().set_index("feature")
    assert frame["significant"].tolist() == sorted(frame["significant"], reverse=True)
    share = torch.stack([(actions == 2)[condition == c].double().mean() for c in (0, 1)])
    row = frame.loc["share of rest (by count)"]
    assert (row["mean, vehicle"], row["mean, drug"]) == pytest.approx(tuple(share.tolist()), abs=0.02)
    assert row["difference"] == pytest.approx(float(share[1] - share[0]), abs=0.02)
    assert frame.loc["duration of eat", "difference"] == pytest.approx(2, abs=0.3)
    assert frame.loc["eat → groom", "parts"] == ["eat", "groom"]
    assert repr(result) == f"ConditionComparison({result.verdict})"
