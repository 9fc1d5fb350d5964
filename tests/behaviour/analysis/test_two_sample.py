"""Two-sample tests against counts by loops, all permutations, and equal and unequal chains; Holm's correction."""

import itertools
import math
from collections import Counter

import numpy as np
import pytest
import torch
from scipy import stats

from neuroprior import Plans
from neuroprior.behaviour import two_sample_tests
from neuroprior.behaviour.analysis.statistics import holm
from neuroprior.behaviour.analysis.two_sample import LONGEST
from tests.support.sources import FALSE_ALARM, refuses, seeded

NAMES = ["1-grams", "2-grams", "3-grams", "4-grams", "run lengths", "return times"]


def chain(num: int, length: int, stay: float, seed: int) -> Plans:
    """Two actions, each as frequent, repeated with probability `stay`: order 0 at 0.5, else order 1."""
    generator = seeded(seed)
    moved = (torch.rand(num, length, generator=generator) >= stay).long()
    moved[:, 0] = torch.randint(2, (num,), generator=generator)
    return Plans(moved.cumsum(1) % 2, 2)


def counted(plans: Plans, name: str) -> Counter:
    """One statistic by loops."""
    found: Counter = Counter()
    for row, n in zip(plans.actions.tolist(), plans.mask().sum(1).tolist(), strict=True):
        row = row[:n]
        if "grams" in name:
            found.update(zip(*(row[k:] for k in range(int(name[0]))), strict=False))
        elif name == "run lengths":
            found.update((min(len(list(run)), LONGEST + 1),) for _, run in itertools.groupby(row))
        else:
            for t, action in enumerate(row):
                if action in row[t + 1 :]:
                    found[(min(row[t + 1 :].index(action) + 1, LONGEST + 1),)] += 1
    return found


def variation(first: Counter, second: Counter) -> float:
    one, two = sum(first.values()), sum(second.values())
    return sum(abs(first[key] / one - second[key] / two) for key in {*first, *second}) / 2


def ragged(num: int, length: int, actions: int, seed: int) -> Plans:
    generator = seeded(seed)
    lengths = torch.randint(length + 1, (num,), generator=generator)
    return Plans((torch.rand(num, length, generator=generator) ** 2 * actions).long(), actions, lengths)


def test_distances_and_shares_by_loops():
    real, generated = ragged(12, 90, 3, 0), ragged(15, 70, 3, 1)
    found = two_sample_tests(real, generated, 99, seeded(0))
    assert [one.statistic for one in found] == NAMES
    for one in found:
        first, second = counted(real, one.statistic), counted(generated, one.statistic)
        assert one.distance == pytest.approx(variation(first, second))
        for shares, counts in ((one.real, first), (one.generated, second)):
            want = [counts[key] / sum(counts.values()) for key in one.classes]
            assert shares.tolist() == pytest.approx(want)
        if "grams" in one.statistic:
            both = one.real + one.generated
            assert both.tolist() == sorted(both.tolist(), reverse=True)
            assert len(one.classes) == min(len({*first, *second}), 20)
        else:
            assert one.classes == tuple((k,) for k in range(1, LONGEST + 2))


def test_long_runs_and_returns_are_one_class():
    stay, away = torch.zeros(10, 60).long(), torch.cat([torch.zeros(10, 1), torch.ones(10, 58), torch.zeros(10, 1)], 1)
    found = {one.statistic: one for one in two_sample_tests(Plans(stay, 2), Plans(away.long(), 2), 99, seeded(0))}
    assert found["run lengths"].real[LONGEST] == 1
    assert found["run lengths"].generated[[0, LONGEST]].tolist() == pytest.approx([2 / 3, 1 / 3])
    assert found["return times"].generated[LONGEST] == pytest.approx(1 / 58)
    assert found["run lengths"].p_value == 0.01


def test_against_all_permutations():
    """Every way to label 5 + 4 plans of different lengths."""
    plans = ragged(20, 8, 2, 3)
    plans = plans[plans.lengths > 2][:9]
    assert len(plans) == 9
    made = 2000
    for one in two_sample_tests(plans[:5], plans[5:], made, seeded(0))[:2]:
        alone = [counted(plans[n : n + 1], one.statistic) for n in range(9)]
        distances = []
        for real in itertools.combinations(range(9), 5):
            first = sum((alone[n] for n in real), Counter())
            distances.append(variation(first, sum(alone, Counter()) - first))
        share = np.mean(np.array(distances) >= one.distance - 1e-9)
        spread = math.sqrt(share * (1 - share) / made)
        assert one.permutations == made
        assert abs(one.p_value - share) < 5 * spread + 1 / made
        assert one.null_distance == pytest.approx(np.mean(distances), abs=5 * np.std(distances) / math.sqrt(made))


def test_p_values_of_equal_distributions_are_uniform():
    """200 pairs of sets of one chain: each p-value is uniform over 1 / 40 to 1, but for ties."""
    p_values = []
    for seed in range(200):
        found = two_sample_tests(chain(15, 10, 0.7, seed), chain(20, 10, 0.7, 1000 + seed), 39, seeded(seed))
        p_values.append([one.p_value for one in found])
    for column in np.array(p_values).T:
        assert sum(column <= 0.05) <= stats.binom.isf(FALSE_ALARM, 200, 0.05)
        assert sum(column <= 0.5) >= stats.binom.ppf(FALSE_ALARM, 200, 0.4)
        assert sum(column <= 0.5) <= stats.binom.isf(FALSE_ALARM, 200, 0.5)


def test_pieces_of_one_long_plan_each():
    """60 pairs of single plans of one chain: cut, their p-values are about uniform."""
    p_values = []
    for seed in range(60):
        found = two_sample_tests(chain(1, 800, 0.7, seed), chain(1, 1000, 0.7, 1000 + seed), 39, seeded(seed))
        p_values.append([one.p_value for one in found])
    # Neighbouring pieces are not quite independent: a level of up to 9 % is allowed.
    assert (np.sum(np.array(p_values) <= 0.05, 0) <= stats.binom.isf(FALSE_ALARM, 60, 0.09)).all()
    found = {
        one.statistic: one for one in two_sample_tests(chain(1, 1000, 0.7, 0), chain(1, 1000, 0.5, 1), 499, seeded(0))
    }
    assert found["2-grams"].corrected < 0.02
    assert found["1-grams"].corrected > 0.05


def test_single_plans_are_cut_into_about_forty_pieces_of_the_shorter():
    """Of 810 and 2,000 actions pieces have 20, but the last; a piece of one action has one run, and returns after 1."""
    plans = [Plans(torch.zeros(1, length, dtype=torch.long), 2) for length in (810, 2000)]
    found = {one.statistic: one for one in two_sample_tests(*plans, 99, seeded(0))}
    assert {k + 1: float(found["run lengths"].real[k]) for k in (9, 19)} == pytest.approx({10: 1 / 41, 20: 40 / 41})
    assert found["run lengths"].generated[19] == 1
    assert found["return times"].real[0] == 1


def test_order_0_against_order_1():
    """Bigrams differ, by the known distance of 0.2, and unigrams do not."""
    real, generated = chain(300, 50, 0.7, 1), chain(300, 50, 0.5, 2)
    found = {one.statistic: one for one in two_sample_tests(real, generated, 999, seeded(0))}
    assert found["1-grams"].p_value > 0.05
    for name in NAMES[1:]:
        assert found[name].corrected == pytest.approx(0.006)
    assert found["2-grams"].distance == pytest.approx(0.2, abs=0.02)
    assert found["2-grams"].classes[:2] in (((0, 0), (1, 1)), ((1, 1), (0, 0)))
    assert found["2-grams"].real[0] == pytest.approx(0.35, abs=0.02)
    # Runs are geometric in both, but for those that a plan's end cuts.
    assert found["run lengths"].real[0] < 0.35
    assert found["run lengths"].generated[0] == pytest.approx(0.5, abs=0.02)


def test_seeds_and_bounds():
    real, generated = chain(30, 20, 0.7, 1), chain(30, 20, 0.6, 2)

    def p_values(**bounds) -> list[float]:
        return [one.p_value for one in two_sample_tests(real, generated, 99, seeded(0), **bounds)]

    assert p_values() == p_values() == p_values(chunk_size=700)
    assert {one.permutations for one in two_sample_tests(real, generated, 999, seeded(0), max_work=1)} == {99}
    few = two_sample_tests(real, generated, 99, seeded(0), max_plans=20, max_actions=330)
    # Of 17 plans each, the last cut: multiples of 1 / 330.
    assert (few[0].real * 330).tolist() == pytest.approx((few[0].real * 330).round().tolist())


def test_what_does_not_occur_is_left_out():
    one, two = Plans(torch.arange(20)[:, None] % 3, 3), Plans(torch.arange(20)[:, None] % 2, 3)
    assert [found.statistic for found in two_sample_tests(one, two, 99)] == ["1-grams", "run lengths"]


def test_bad_input():
    plans = chain(20, 5, 0.5, 0)
    with refuses("2 actions", "3"):
        two_sample_tests(plans, Plans(plans.actions, 3))
    with refuses("generated", "at least one action"):
        two_sample_tests(plans, Plans(plans.actions, 2, torch.zeros(20).long()))
    with refuses("real"):
        two_sample_tests(plans[:0], plans)
    with refuses("permutations"):
        two_sample_tests(plans, plans, 0)


def test_holm_by_hand():
    """0.005 x 4, 0.01 x 3, 0.03 x 2; 0.04 x 1 is below the one before it, and takes its value."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm(torch.tensor([0.5, 0.9, 0.3])) == pytest.approx([1, 1, 0.9])
    assert holm([]).shape == (0,)
    assert holm([0.01, 0.005], 4) == pytest.approx([0.03, 0.02])
    with refuses("tests: at least 2"):
        holm([0.1, 0.2], 1)
    for wrong, words in (([0.1, 1.1], ["p_values[1]", "1.1"]), ([math.nan], ["p_values[0]"]), ([[0.1]], ["[M]"])):
        with refuses(*words):
            holm(wrong)


def test_holm_keeps_the_family_wise_rate():
    """2,000 families of 5 true and independent hypotheses: 1 - (1 - 0.01)**5 have a corrected p-value up to 0.05."""
    draws = np.random.default_rng(0).random((2000, 5))
    wrong = sum(holm(row).min() <= 0.05 for row in draws)
    rate = 1 - 0.99**5
    assert stats.binom.ppf(FALSE_ALARM / 2, 2000, rate) <= wrong <= stats.binom.isf(FALSE_ALARM / 2, 2000, rate)


def test_of_many_plans_some_are_drawn():
    """100 plans of one action and then 100 of another: of 60 drawn 10 to 50 are of either but once in 10**9 times."""
    plans = Plans((torch.arange(200) // 100)[:, None].expand(200, 3), 2)
    shuffled = plans[torch.randperm(200, generator=seeded(1))]
    (found, *_) = two_sample_tests(plans, shuffled, 99, seeded(0), max_plans=60)
    assert found.statistic == "1-grams"
    assert found.real.sum() == pytest.approx(1)
    assert float(found.real.min()) > 1 / 6
