"""Strata, rare conditions, pairs of conditions and interactions, against enumeration and least squares by hand."""

import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from neuroprior._statistics import LEVEL
from neuroprior.behaviour import PermutationDesign, RecordedPlans, compare_conditions, holm
from neuroprior.behaviour.analysis.condition_chains import SMOOTHING
from tests.support.sources import refuses, seeded
from tests.support.studies import between, study, within

SEX = [0, 0, 0, 1, 1, 1, 1]
DRUG = [0, 1, 1, 0, 1, 0, 1]
"""Seven animals: one against two of the first sex, two against two of the other."""


def stratified(conditions, strata, seed: int = 0, **settings) -> RecordedPlans:
    plans = study(seed, conditions, **settings)
    return replace(plans, stratum=torch.tensor(strata)[plans.group], stratum_names=["female", "male"])


def family_of(found, name):
    return next(one for one in found.families if one.name == name)


def all_labellings(labels, strata):
    """Every way to give the units of each stratum the labels that they have together."""
    cells = [[n for n, own in enumerate(strata) if own == s] for s in sorted(set(strata))]
    ways = [sorted(set(itertools.permutations([labels[n] for n in cell]))) for cell in cells]
    for chosen in itertools.product(*ways):
        out = [0] * len(labels)
        for cell, own in zip(cells, chosen, strict=True):
            for n, label in zip(cell, own, strict=True):
                out[n] = label
        yield tuple(out)


@pytest.mark.parametrize(
    ("labels", "strata"),
    [
        (DRUG, SEX),
        ([0, 1, 0, 1, 1, 0, 0, 1], [0, 1, 0, 0, 1, 1, 0, 1]),
        ([0, 1, 2, 2, 1, 0, 1, 0, 2], [1, 1, 1, 0, 0, 0, 0, 0, 1]),
        ([0, 1, 1, 0, 1, 0, 0], [2, 0, 1, 1, 0, 0, 2]),
    ],
)
def test_labels_are_permuted_within_strata(labels, strata):
    plans = replace(study(0, [[label] for label in labels], length=3), stratum=torch.tensor(strata))
    design = PermutationDesign.of(plans)
    kept = [n for n in range(len(labels)) if len({labels[m] for m in range(len(labels)) if strata[m] == strata[n]}) > 1]
    every = {*all_labellings([labels[n] for n in kept], [strata[n] for n in kept])}
    assert design.possible == len(every)
    found = [tuple(own) for own in design.labellings(design.possible - 1).T.tolist()]
    assert found[0] == tuple(labels[n] for n in kept)
    assert {*found} == every
    assert len(found) == len(every)
    drawn = [tuple(own) for own in design.labellings(len(every) - 2, seeded(0)).T.tolist()]
    assert {*drawn} <= every
    assert len({*drawn}) > len(every) / 3
    assert len(design.left_out) == len(labels) - len(kept)


@pytest.mark.parametrize(("drug", "equivalent"), [(DRUG, 1), ([0, 1, 0, 1, 1, 0, 0, 1], 2), ([0, 1, 1, 0, 0, 1], 1)])
def test_the_smallest_p_is_that_of_the_most_extreme_labelling(drug, equivalent):
    """The smallest p-value over all labellings taken for the observed one, by brute force."""
    sex = SEX if len(drug) == 7 else [int(place >= len(drug) // 2) for place in range(len(drug))]
    plans = stratified([[label] for label in drug], sex, length=211, num_actions=3)
    design = PermutationDesign.of(plans)
    assert design.equivalent == equivalent
    each = [
        family_of(compare_conditions(replace(plans, condition=torch.tensor(own))), "behaviours").p_values
        for own in all_labellings(drug, sex)
    ]
    least = torch.stack(each).amin(0)
    assert least.tolist() == pytest.approx([equivalent / len(each)] * len(least))
    assert design.smallest_p(9999) == equivalent / len(each)


def shares_of(plans: RecordedPlans) -> tuple[np.ndarray, np.ndarray]:
    """The share of each action in each plan of equal lengths `[N, A]`, and the same smoothed towards that of all."""
    table = torch.nn.functional.one_hot(plans.actions.long(), plans.num_actions).double().mean(1).numpy()
    length = plans.max_length
    return table, (length * table + SMOOTHING * table.mean(0)) / (length + SMOOTHING)


def test_what_a_stratum_has_in_common_does_not_count():
    """Welch's t squared of numbers less the mean of their stratum, in all labellings within strata."""
    plans = stratified([[label] for label in DRUG], SEX, num_actions=3)
    _, shares = shares_of(plans)
    sex = np.array(SEX)
    centred = shares - np.stack([shares[sex == s].mean(0) for s in sex])
    family = family_of(compare_conditions(plans), "behaviours")
    every = sorted(all_labellings(DRUG, SEX), key=lambda own: own != tuple(DRUG))
    statistics = []
    for own in map(np.array, every):
        first, second = centred[own == 0], centred[own == 1]
        error = first.var(0, ddof=1) / len(first) + second.var(0, ddof=1) / len(second)
        statistics.append((second.mean(0) - first.mean(0)) ** 2 / error)
    statistics = np.array(statistics)
    np.testing.assert_allclose(family.statistic, statistics[0], rtol=1e-9)
    reached = statistics >= statistics[:1] * (1 - 1e-9)
    np.testing.assert_allclose(family.p_values, reached.mean(0))
    largest = statistics.max(1)[:, None] >= statistics[:1] * (1 - 1e-9)
    np.testing.assert_allclose(family.corrected, largest.mean(0))


def test_the_difference_is_that_of_least_squares_with_strata():
    plans = stratified([[label] for label in DRUG], SEX, num_actions=3)
    plans = replace(plans, lengths=torch.tensor([60, 10, 33, 52, 25, 8, 41]))
    family = family_of(compare_conditions(plans), "behaviours")
    weight = np.sqrt(plans.lengths.numpy() / (plans.lengths.numpy() + SMOOTHING))[:, None]
    columns = np.stack([np.array(SEX) == 0, np.array(SEX) == 1, np.array(DRUG) == 1], 1).astype(float)
    slope = np.linalg.lstsq(weight * columns, weight * family.values.numpy(), rcond=None)[0][2]
    np.testing.assert_allclose(family.difference[0], slope, rtol=1e-9)
    assert (family.difference[1] < family.difference[0]).all()
    assert (family.difference[0] < family.difference[2]).all()


def test_the_interval_of_the_difference_covers_it():
    """In 100 studies with very different sexes; more are outside than 5 % with a probability of 1e-4."""
    sexes, drug, outside = np.arange(12) % 2, np.arange(12) // 2 % 2, 0
    for seed in range(100):
        random = np.random.default_rng(seed)
        share = np.array([0.25, 0.6])[sexes] + 0.1 * drug + 0.05 * random.standard_normal(12)
        rows = (random.random((12, 200)) < share[:, None]).astype(int)
        design = {"condition": torch.from_numpy(drug), "stratum": torch.from_numpy(sexes)}
        plans = RecordedPlans(torch.from_numpy(rows), 2, group=torch.arange(12), **design)
        low, high = family_of(compare_conditions(plans, 9), "behaviours").difference[1:, 1].tolist()
        outside += not low < 0.1 < high
        assert high - low < 0.4
    assert outside <= stats.binom.isf(1e-4, 100, 0.05)


def sexes_differ(strength: float, change: bool):
    """Changes what follows 1 and later actions in every second animal much, what follows 0 in condition 1 little."""

    def apply(probs: Tensor, condition: Tensor) -> None:
        shift = strength * torch.randn(probs.shape[1:], generator=seeded(99))
        sex = (torch.arange(len(probs)) % 2 == 1)[:, None, None]
        shift[0] = 0
        logits = probs.log() + shift * sex
        logits[:, 0, 1] += 1.5 * change * (condition == 1)
        probs[:] = logits.softmax(-1)

    return apply


def test_strata_raise_no_false_alarms():
    """Of 100 studies, in each of the tests; sexes differ much, and are not treated equally often."""
    conditions = [[int(animal % 3 == 0) if animal % 2 else int(animal % 3 != 0)] for animal in range(12)]
    sex, alarms = [animal % 2 for animal in range(12)], Counter()
    for seed in range(100):
        change = sexes_differ(1.5, False)
        plans = stratified(conditions, sex, 500 + seed, length=60, num_actions=3, habit=0.5, change=change)
        found = compare_conditions(plans, 199, seeded(seed))
        alarms.update(name for name, (p, _) in found.tests.items() if p < 0.05)
        alarms["all"] += found.p_value < 0.05
        assert found.interaction is not None
        alarms["interaction"] += found.interaction.p_value < 0.05
    assert max(alarms.values()) <= stats.binom.isf(1e-4, 100, 0.05), alarms


def test_strata_under_one_condition_are_left_out():
    plans = stratified([[0], [1], [0], [1], [0], [1], [1], [1]], [0, 0, 0, 0, 0, 0, 1, 1])
    found = compare_conditions(plans)
    assert found.design.left_out.tolist() == [6, 7]
    assert found.design.notes == ("2 subjects of strata that are under one condition only were left out.",)
    assert found.tests == compare_conditions(plans[plans.group < 6]).tests
    alone = compare_conditions(stratified([[0], [0], [1], [1]], [0, 0, 1, 1]))
    assert alone.verdict == "Not tested: in each stratum all sequences are under one condition."


def test_a_group_in_two_strata_is_refused():
    plans = replace(study(0, within(4)), stratum=torch.arange(16) % 2)
    with refuses("`stratum` must be the same for all plans of a group"):
        compare_conditions(plans)


@pytest.mark.parametrize(
    ("conditions", "few"),
    [([*between(8), [2]], [8]), ([*within(6), [0, 1, 2], [0, 1]], []), ([*between(9, 2, 3), [3], [4, 4]], [9, 10])],
    ids=["between", "within", "two rare"],
)
def test_rare_conditions_are_left_out_with_a_note(conditions, few):
    plans = study(2, conditions)
    found = compare_conditions(plans, 199, seeded(0))
    common = [label for label, units in Counter(k for own in conditions for k in {*own}).items() if units > 1]
    rare = [f"drug {k}" for k in range(5) if k in {k for own in conditions for k in own} and k not in common]
    assert found.design.notes[0] == f"Left out, with fewer than 2 subjects: {', '.join(rare)}."
    assert found.condition_names == [f"drug {k}" for k in sorted(common)]
    assert found.design.left_out.tolist() == few
    alone = compare_conditions(plans[torch.isin(plans.condition, torch.tensor(common))], 199, seeded(0))
    assert alone.tests == found.tests
    assert alone.design.notes == ()


@pytest.mark.parametrize("conditions", [between(21, 2, 3), within(8, 3, 3)], ids=["between", "within"])
def test_each_two_of_three_conditions_are_compared_in_a_closed_test(conditions):

    def change(probs: Tensor, condition: Tensor) -> None:
        probs[condition == 1, 0] = torch.tensor([0.6, 0.1, 0.1, 0.1, 0.1])

    plans = study(4, conditions, slower={0: 4.0}, habit=0.3, change=change)
    found = compare_conditions(plans, 999, seeded(0))
    assert [pair.condition_names for pair in found.contrasts] == [
        ["drug 0", "drug 1"],
        ["drug 0", "drug 2"],
        ["drug 1", "drug 2"],
    ]
    for pair, (first, second) in zip(found.contrasts, [(0, 1), (0, 2), (1, 2)], strict=True):
        own = compare_conditions(plans[(plans.condition == first) | (plans.condition == second)], 9999, seeded(0))
        family, alone = family_of(pair, "durations"), family_of(own, "durations")
        torch.testing.assert_close(family.difference, alone.difference)
        torch.testing.assert_close(family.statistic, alone.statistic)
        for name, (_, corrected) in pair.tests.items():  # of 999 labellings, and of more
            assert corrected == pytest.approx(max(own.tests[name][1], found.tests[name][1]), abs=0.05)
        assert pair.p_value >= found.p_value
    # Condition 1 alone takes longer: the pairs with it differ, the other does not.
    differ = [bool(pair.significant(family_of(pair, "durations")).any()) for pair in found.contrasts]
    assert differ == [True, False, True]
    assert "Of two conditions, there differ drug 0 and drug 1; drug 1 and drug 2 (corrected)." in found.verdict


def test_pairs_of_four_conditions_are_corrected_by_holm():
    """Each family's p-value, corrected for the families of its pair, for the six pairs, and for all conditions."""
    plans = study(5, between(16, 2, 4), habit=0.4)
    found = compare_conditions(plans, 199, seeded(0))
    pairs = [torch.tensor(pair) for pair in itertools.combinations(range(4), 2)]
    each = [compare_conditions(plans[torch.isin(plans.condition, pair)], 199, seeded(0)) for pair in pairs]
    assert len(found.contrasts) == 6
    for name, (_, of_all) in found.tests.items():
        alone = holm([own.tests[name][1] for own in each])
        assert [pair.tests[name][1] for pair in found.contrasts] == pytest.approx(np.maximum(alone, of_all).tolist())


def test_a_feature_of_a_pair_is_starred_where_the_pair_differs():
    for seed in range(12):
        found = compare_conditions(study(seed, between(12, 2, 3), slower={0: 1.6}, habit=0.3), 299, seeded(0))
        for pair in found.contrasts:
            assert pair.p_value < LEVEL or not pair.frame()["significant"].any()


def ratio_by_hand(values: np.ndarray, main: np.ndarray, full: np.ndarray) -> np.ndarray:
    """Squares that the full model explains beyond the main effects, by those that it leaves, `[F]`."""
    left = [((values - own @ np.linalg.lstsq(own, values, rcond=None)[0]) ** 2).sum(0) for own in (main, full)]
    return (left[0] - left[1]) / left[1]


def test_the_interaction_between_units_is_that_of_residuals_permuted_within_strata():
    """Random orders of the residuals of three females and seven males, some treated; both models refitted."""
    drug, sex = [0, 1, 1, 0, 1, 0, 0, 1, 1, 0], [0, 0, 0, 1, 1, 1, 1, 1, 1, 1]
    plans = stratified([[label] for label in drug], sex, num_actions=3, length=40)
    alike = plans.actions[:1].repeat(3, 1)  # females do nearly the same, so that strata must not be mixed
    alike[:, :8] = plans.actions[:3, :8]
    plans = replace(plans, actions=torch.cat([alike, plans.actions[3:]]))
    _, shares = shares_of(plans)
    drug, sex = np.array(drug), np.array(sex)
    main = np.stack([sex == 0, sex == 1, drug == 1], 1).astype(float)
    full = np.concatenate([main, (sex * drug)[:, None]], 1)
    fitted = main @ np.linalg.lstsq(main, shares, rcond=None)[0]
    statistics = [ratio_by_hand(shares, main, full)]
    random = np.random.default_rng(0)
    for _ in range(4000):
        order = np.array([*random.permutation(3), *(3 + random.permutation(7))])
        statistics.append(ratio_by_hand(fitted + (shares - fitted)[order], main, full))
    found = compare_conditions(plans, 9999, seeded(0)).interaction
    assert found.stratum_names == ["female", "male"]
    family = family_of(found, "behaviours")
    np.testing.assert_allclose(family.statistic, statistics[0], rtol=1e-6)
    # Both are of random orders; each p-value is five standard errors off with a probability below 1e-6.
    p_values = (np.array(statistics) >= statistics[0] * (1 - 1e-9)).mean(0)
    np.testing.assert_allclose(family.p_values, p_values, atol=5 * 0.5 / 3000**0.5)
    effects = [shares[(sex == s) & (drug == 1)].mean(0) - shares[(sex == s) & (drug == 0)].mean(0) for s in range(2)]
    np.testing.assert_allclose(family.differences, effects, atol=1e-12)


def test_the_interaction_within_units_is_a_permutation_of_their_strata():
    """All ways to call three of seven animals female, compared by the F of their differences."""
    sex = np.array([0, 0, 0, 1, 1, 1, 1])
    plans = stratified(within(7, 2), sex.tolist(), num_actions=3, length=40)
    found = compare_conditions(plans, 9999, seeded(0))
    family = family_of(found.interaction, "behaviours")
    values = found.families[0].values.numpy().reshape(7, 2, -1)
    usual = (40 * values.sum(1) + SMOOTHING * values.mean((0, 1))) / (80 + SMOOTHING)
    smoothed = (40 * values + SMOOTHING * usual[:, None]) / (40 + SMOOTHING)
    gap = smoothed[:, 1] - smoothed[:, 0]
    statistics = []
    for chosen in itertools.combinations(range(7), 3):
        own = ~np.isin(np.arange(7), chosen)
        statistics.append(ratio_by_hand(gap, np.ones((7, 1)), np.stack([own, ~own], 1).astype(float)))
    np.testing.assert_allclose(family.statistic, statistics[0], rtol=1e-6)
    p_values = (np.array(statistics) >= statistics[0] * (1 - 1e-9)).mean(0)
    np.testing.assert_allclose(family.p_values, p_values, atol=5 * 0.5 / 9999**0.5)


@pytest.mark.parametrize("paired", [False, True])
def test_an_effect_in_one_sex_only_is_an_interaction(paired):
    """After action 0, action 1 is more frequent in treated males alone."""
    conditions = within(12, 2) if paired else [[animal // 2 % 2] * 2 for animal in range(24)]
    sex = torch.tensor([own for animal in range(len(conditions)) for own in [animal % 2] * 2])

    def change(probs: Tensor, condition: Tensor) -> None:
        logits = probs.log()
        logits[:, 0, 1] += 3.0 * ((condition == 1) & (sex == 1))
        probs[:] = logits.softmax(-1)

    plans = replace(study(0, conditions, length=150, num_actions=4, habit=0.3, change=change), stratum=sex)
    found = compare_conditions(plans, 999, seeded(0)).interaction
    assert found.p_value < 0.01
    family = family_of(found, "transitions")
    strongest = int(family.statistic.argmax())
    assert family.features[strongest].tolist()[0] == 0
    place = family.features.tolist().index([0, 1])
    assert family.corrected[place] < 0.05
    assert abs(family.differences[0, place]) < 0.15 < family.differences[1, place]
    assert found.verdict.startswith("The difference between conditions depends on the stratum (stratum 0, stratum 1;")


def test_where_an_interaction_cannot_be_tested_there_is_none():
    assert compare_conditions(study(0, between(12))).interaction is None
    few = stratified([[0], [1], [0], [1], [0], [1], [0], [1]], [0, 0, 0, 0, 1, 1, 1, 1])
    assert compare_conditions(few).interaction is None
    # With conditions 0 and 1 in one stratum, 1 and 2 in the other there is no difference to compare.
    apart = stratified([[0], [1]] * 3 + [[1], [2]] * 3, [0] * 6 + [1] * 6)
    assert compare_conditions(apart, 99, seeded(0)).interaction is None


@pytest.mark.parametrize(("shorter", "noted"), [(20, False), (9, True)])
def test_groups_of_far_more_behaviours_are_noted(shorter, noted):
    """Of thirty behaviours under one condition, and fewer under the other."""
    plans = stratified([[0], [1], [0], [1], [0], [1], [1]], [0] * 7, length=30)
    lengths = torch.where(plans.condition == 1, shorter, 30)
    notes = compare_conditions(replace(plans, lengths=lengths), 99, seeded(0)).design.notes
    assert [note for note in notes if "3.3 times as many behaviours" in note] == [*notes]
    assert len(notes) == noted
