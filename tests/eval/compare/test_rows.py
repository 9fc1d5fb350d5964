"""From cells to rows: closed forms on made-up cells, intervals that cover, tests that do not cry wolf."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from eval.compare.best import best_difference, chosen
from eval.compare.efficiency import efficiency, needed
from eval.compare.pairs import BEST, paired, points, words
from eval.compare.rows import Key, bits_rows, by_world, growth_rows, intervals, rows
from neuroprior.analysis.statistics import holm, mean_interval, paired_difference
from tests.support.compare_cells import BUDGETS, TIMES, cell, curve, entry, worlds

ASKED = (16, 256, 4096)


def key(prior: str, sees: str = "nothing", rounds: int = 0) -> Key:
    return Key("sampling", prior, sees, rounds)


def found(some: list[dict[str, Any]], **wanted: Any) -> list[dict[str, Any]]:
    return [row for row in some if all(row[name] == value for name, value in wanted.items())]


def two(first: list[float], second: list[float], names: tuple[str, str] = ("gru", "markov-1"), world: str = "maze"):
    """Cells of two priors that have one share each, seed by seed, with any number of plans."""
    pairs = zip(first, second, strict=True)
    priors = [[entry(name, [share] * 13) for name, share in zip(names, pair, strict=True)] for pair in pairs]
    return [cell(world, seed, own) for seed, own in enumerate(priors)]


def test_rows_hold_means_over_seeds():
    cells = worlds(["maze"], 3)
    made = rows(cells, ASKED)
    assert len(made) == 1 + len(TIMES) * len(ASKED)
    (row,) = found(made, prior="gru", num_plans=256)
    shares = [one["share"][8] for c in cells for one in c["entries"] if one["prior"] == "gru"]
    assert row["oracle_share"] == pytest.approx(np.mean(shares))
    assert row["at_oracle"] == pytest.approx(np.mean(shares) / 2)
    assert min(shares) <= row["low"] < row["oracle_share"] < row["high"] <= max(shares)
    assert (row["model_steps"], row["seeds"]) == (2048, 3)
    assert row["seconds_per_decision"] == pytest.approx(0.009)
    (row,) = found(made, planner="exhaustive")
    assert (row["num_plans"], row["prior"], row["model_steps"]) == (None, None, 8)
    # Without spread there is no interval but the value.
    assert row["low"] == row["high"] == pytest.approx(0.6)
    (row,) = found(rows(cells, [32]), prior="gru")
    assert row["seconds_per_decision"] is None
    alone = rows(cells[:1], ASKED)
    assert all(row["low"] is row["high"] is None and row["seeds"] == 1 for row in alone)


def test_bootstrap_intervals_cover():
    """Of 500 intervals from 20 skewed values each, 95 % asked for.

    If between 92 and 96 % hold the mean, 430 < hits < 498 fails with a probability below 1e-6.
    """
    draws = np.random.default_rng(0).gamma(8, 1, (500, 20))
    low, high = intervals(draws).T
    assert 430 < ((low <= 8) & (high >= 8)).sum() < 498
    again = intervals(draws[:3])
    assert np.array_equal(again, np.stack([low, high], 1)[:3])
    assert np.isnan(intervals(np.ones((2, 1)))).all()
    # Percentiles of the same means, where skewness shifts the ends of the corrected interval up.
    skewed = np.array([[0.0] * 15 + [1.0, 2.0, 3.0, 4.0, 10.0]])
    assert intervals(skewed)[0, 0] > mean_interval(skewed[0]).low


def test_unlike_cells_are_refused():
    cells = worlds(["maze"], 2)
    with pytest.raises(ValueError, match="maze, seed 1: uniform is there twice"):
        by_world([*cells, cell("maze", 1, [entry("uniform", curve(1))])])
    with pytest.raises(ValueError, match="maze, seed 2: the numbers of plans are"):
        by_world([*cells, cell("maze", 2, []) | {"budgets": [1, 2]}])
    with pytest.raises(ValueError, match=r"num_plans: maze has \[1, 2, .*\], not 100"):
        rows(cells, [16, 100])


@settings(max_examples=5, deadline=None)
@given(order=st.permutations(range(6)))
def test_the_order_of_seeds_does_not_matter(order):
    cells = worlds(["maze", "taxi"], 3, {"uniform": 1.0, "markov-1": 2.0, "gru": 4.0})
    mixed = sorted((cells[place] for place in order), key=lambda one: one["world"])
    for make in (lambda some: rows(some, [16]), lambda some: paired(some, [16]), efficiency, bits_rows):
        assert make(mixed) == make(cells)


def test_what_a_curve_needs():
    assert needed(np.array(curve(8)), BUDGETS, curve(1)[-1]) == pytest.approx(4096 / 8)
    assert needed(np.array(curve(1)), BUDGETS, curve(1)[5]) == pytest.approx(32)
    assert needed(np.array(curve(3)), BUDGETS, curve(1)[-1]) == pytest.approx(4096 / 3)
    assert needed(np.array([0.5, 0.6]), [1, 2], 0.3) == 1
    assert needed(np.array([0.5, 0.6]), [1, 2], 0.7) == np.inf
    # A peak by chance is no crossing: made to climb, the curve is 0, 0.3, 0.3, 0.6.
    assert needed(np.array([0.0, 0.5, 0.1, 0.6]), [1, 2, 4, 8], 0.45) == pytest.approx(2**2.5)


def test_efficiency_is_how_many_random_plans_one_is_worth():
    made = efficiency(worlds(["maze"], 20, {**TIMES, "transformer": 0.5}, noise=0))
    for prior, times in TIMES.items():
        (row,) = found(made, prior=prior)
        assert [row[f"needed{end}"] for end in ("", "_low", "_high")] == pytest.approx([4096 / times] * 3)
        assert [row[f"factor{end}"] for end in ("", "_low", "_high")] == pytest.approx([times] * 3)
        assert (row["reached"], row["seeds"], row["most"]) == (20, 20, 4096)
    (row,) = found(made, prior="transformer")
    assert all(row[f"{name}{end}"] is None for name in ("needed", "factor") for end in ("", "_low", "_high"))
    assert row["reached"] == 0


def test_random_plans_that_gain_nothing_by_more_count_as_fewer():
    """Random search reaches all there is with 256 plans, a prior that is worth 4 with 64: not 4096 / 64 times fewer."""
    flat = [min(share, curve(1)[8]) for share in curve(1)]
    cells = [cell("maze", seed, [entry("uniform", flat), entry("gru", curve(4))]) for seed in range(6)]
    uniform, gru = efficiency(cells)
    assert (uniform["needed"], uniform["factor"]) == pytest.approx((256, 1))
    assert (gru["needed"], gru["factor"]) == pytest.approx((64, 4))


def test_medians_have_the_intervals_of_the_sign_test():
    """With 20 seeds, between the 6th and the 15th; with fewer than 6, none; seeds that never get there count."""
    times = [2.0 ** (seed / 4) for seed in range(20)]
    cells = [cell("maze", s, [entry("uniform", curve(1)), entry("gru", curve(t))]) for s, t in enumerate(times)]
    row = efficiency(cells)[1]
    assert (row["factor_low"], row["factor_high"]) == pytest.approx((times[5], times[14]))
    assert row["factor"] == pytest.approx((times[9] * times[10]) ** 0.5)
    test = stats.quantile_test(times).confidence_interval(0.95)
    assert (row["factor_low"], row["factor_high"]) == pytest.approx((test.low, test.high))
    assert efficiency(cells[:5])[1]["factor_low"] is None
    late = [cell("maze", s, [entry("uniform", curve(1)), entry("gru", curve(0.5 if s < 8 else 2))]) for s in range(20)]
    row = efficiency(late)[1]
    assert (row["needed"], row["needed_low"], row["needed_high"]) == (pytest.approx(2048), pytest.approx(2048), None)
    assert (row["factor"], row["factor_low"], row["reached"]) == (pytest.approx(2), None, 12)


def test_the_best_are_chosen_on_the_other_half():
    # The first is best on even seeds, the second on odd ones.
    assert chosen(np.array([[3.0, 0, 3, 0], [0, 2.0, 0, 2]])).tolist() == [1, 0, 1, 0]
    assert chosen(np.array([[3.0, 3, 3, 3], [0, 2.0, 0, 2]])).tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("gap", [0.0, 0.3])
def test_choosing_the_best_is_no_advantage(gap):
    """Five chains against two neural priors, the best of each alike, in 1,000 comparisons of 20 seeds.

    Intervals of 95 % at least: more than 85 misses have a probability below 1e-6, and so has a mean difference of
    alternatives that are all alike beyond 5 standard errors. A t-test of the chosen ones alone has more false alarms
    than that, and the best by mean would seem better for being chosen among more.
    """
    draws = np.random.default_rng(0).normal(0, 1, (1000, 7, 20))
    draws[:, [1, 3, 4, 5, 6]] -= gap
    found = [best_difference(one[:2], one[2:]) for one in draws]
    misses = sum(not one.low <= 0 <= one.high for one in found)
    assert misses <= 85
    assert [one.p_value < 0.05 for one in found] == [not one.low <= 0 <= one.high for one in found]
    seeds = np.arange(20)
    alone = [one[:2][chosen(one[:2]), seeds] - one[2:][chosen(one[2:]), seeds] for one in draws]
    if gap:
        assert sum(stats.ttest_1samp(one, 0).pvalue < 0.05 for one in alone) > 85
    else:
        gaps = [one.mean for one in found]
        error = np.std(gaps) / len(gaps) ** 0.5
        assert abs(np.mean(gaps)) < 5 * error
        assert np.mean(draws[:, :2].mean(2).max(1) - draws[:, 2:].mean(2).max(1)) < -5 * error


def test_intervals_hold_for_the_best_whichever_they_are():
    """True differences between the best from -2 to 2, in 1,000 comparisons: at most 85 misses, as above."""
    rng = np.random.default_rng(1)
    worth = rng.normal(0, 1, (1000, 5))
    true = worth[:, :2].max(1) - worth[:, 2:].max(1)
    draws = worth[..., None] + rng.normal(0, 1, (1000, 5, 12))
    found = [best_difference(one[:2], one[2:]) for one in draws]
    assert sum(not one.low <= gap <= one.high for one, gap in zip(found, true, strict=True)) <= 85
    # They are no wider than they must be: most of the large differences are told from 0.
    large = [one for one, gap in zip(found, true, strict=True) if gap > 1.5]
    assert sum(one.low > 0 for one in large) > 0.8 * len(large) > 50


def test_one_against_one_is_students_test():
    first, second = np.random.default_rng(0).normal(0, 1, (2, 1, 9))
    assert best_difference(first, second) == pytest.approx(paired_difference(first[0], second[0]))
    whole = np.arange(9.0)[None]
    for more in (1, -1, 0):
        assert best_difference(whole + more, whole) == paired_difference(whole[0] + more, whole[0])


def test_pairs():
    cells = worlds(["maze"], 6, sees=("nothing", "start"), rounds=1)
    made = paired(cells, [16, 256])
    counts = {what: len(found(made, what=what)) for what in {row["what"] for row in made}}
    # Twice two ways to see and grow; one neural and two chains; two numbers of plans.
    assert counts == {BEST: 8, "neural minus Markov": 16, "grown minus not": 12, "seeing minus not": 12}
    assert [row["p_holm"] for row in made] == pytest.approx(holm([row["p_value"] for row in made]).tolist())
    (row,) = found(made, what="neural minus Markov", second="markov-1", sees="nothing", rounds="0", num_plans=16)
    results = by_world(cells)["maze"]
    gaps = results.values("share", key("gru"), 16) - results.values("share", key("markov-1"), 16)
    assert (row["difference"], row["low"], row["high"]) == pytest.approx(mean_interval(gaps))
    assert row["p_value"] == pytest.approx(stats.ttest_1samp(gaps, 0).pvalue)
    # Twice as many plans are worth 1 / 24; without spread the test is that of signs.
    for row in (*found(made, what="grown minus not"), *found(made, what="seeing minus not")):
        assert (row["difference"], row["low"], row["high"]) == pytest.approx([1 / 24] * 3, abs=1e-8)
        assert row["p_value"] == 2.0**-5
    assert {row["rounds"] for row in found(made, what="grown minus not")} == {"1 - 0"}
    assert {row["sees"] for row in found(made, what="seeing minus not")} == {"start - nothing"}


def test_saved_priors_meet_all_others():
    names = ("uniform", "markov-1", "runs/gru", "runs/new")
    cells = [cell("maze", s, [entry(name, curve(1)) for name in names]) for s in range(3)]
    pairs = [(row["first"], row["second"]) for row in paired(cells, [16])]
    assert pairs == [("runs/gru", "markov-1"), ("runs/gru", "runs/new"), ("runs/new", "markov-1")]


def test_seeds_that_lack_one_of_a_pair_are_left_out():
    cells = two([0.5, 0.6, 0.7], [0.4, 0.4, 0.4])
    cells[1]["entries"].pop()
    (row,) = found(paired(cells, [16]), what="neural minus Markov")
    assert (row["seeds"], row["difference"]) == (2, pytest.approx(0.2))


def sentence(cells: list[dict[str, Any]]) -> str:
    (row,) = words(cells, [16])
    return row["words"]


def test_words():
    rng = np.random.default_rng(0)
    low, noise = [0.5] * 10, rng.normal(0, 0.01, 10)
    better = sentence(two(list(0.52 + noise), low))
    mean, first, last = mean_interval(0.02 + noise)
    gain = f"by {100 * mean:.1f} points of the oracle with 16 plans (+{100 * first:.1f} to +{100 * last:.1f}, p = "
    assert better.startswith(f"maze: gru is better than markov-1 {gain}")
    assert better.endswith(", 10 seeds).")
    worse = sentence(two(low, list(0.52 + noise)))
    assert worse.startswith(f"maze: markov-1 is better than gru {gain}")
    alike = sentence(two(list(0.5 + noise - noise.mean()), low))
    assert alike.startswith("maze: gru and markov-1 cannot be told apart with 16 plans (-0.")
    assert words(two(low, low), [16])[0]["better"] is None
    alone = "gru minus markov-1: +10.0 points of the oracle with 16 plans; a single seed does not tell whether that is"
    assert sentence(two([0.6], [0.5])) == f"maze: {alone} chance."
    saved = sentence(two(list(0.52 + noise), low, ("runs/a", "runs/b")))
    assert saved.startswith("maze: runs/a is better than runs/b by")
    lone = sentence(two(list(0.52 + noise), low, ("markov-3", "uniform")))
    assert lone.startswith("maze: markov-3 is better than random search by")
    assert words([cell("maze", 0, [entry("uniform", curve(1))])], [16]) == []


def test_words_name_the_best_of_several():
    several = sentence(worlds(["maze"], 10, {**TIMES, "transformer": 64.0}, noise=0.001))
    assert several.startswith(
        "maze: the best neural prior (transformer) is better than the best Markov chain (markov-2)"
    )
    chains = sentence(worlds(["maze"], 10, {"uniform": 1, "markov-1": 2, "markov-2": 2, "markov-3": 2}))
    assert chains.startswith("maze: the best Markov chain (markov-")
    assert " is better than random search by " in chains


def test_words_count_the_worlds():
    """What is told of one world alone is not told of it among ten others in which nothing is to be found."""
    gaps = np.array([0.02, 0.05, -0.01, 0.03, 0.01, 0.04])
    alone = two(list(0.5 + gaps), [0.5] * 6)
    assert words(alone, [16])[0]["better"] == "gru"
    noise = np.array([0.01, -0.01, 0.02, -0.02, 0.01, -0.01])
    others = [c for n in range(10) for c in two(list(0.5 + noise), [0.5] * 6, world=f"world {n}")]
    first = words([*alone, *others], [16])[0]
    assert first["better"] is None
    assert first["p_value"] < 0.05 < first["p_holm"] == pytest.approx(11 * first["p_value"])
    assert f"p = {first['p_holm']:.2g} among 11 worlds" in first["words"]


def test_points():
    told = [points(share, signed) for share, signed in ((0.0213, False), (-0.004, True), (0.0, True), (0.00042, True))]
    assert told == ["2.1", "-0.4", "+0.0", "+0.042"]
    assert points(-1e-10, True) == "+0.0"


def test_bits():
    made = bits_rows(worlds(["maze"], 6, noise=0, sees=("nothing", "start")))
    (gru,) = found(made, prior="gru", sees="start")
    assert gru["bits_per_action"] == pytest.approx(2 - 4 / 8 - 0.1)
    # One bit per eight-fold worth: markov-2 takes 1 / 8 more, whatever is seen.
    assert (gru["more"], gru["more_low"], gru["more_high"]) == pytest.approx([-1 / 8] * 3)
    assert found(made, prior="markov-2", sees="nothing")[0]["more"] == 0
    cells = [cell("maze", s, [entry("gru", curve(1), bits=1.0), entry("markov-1", curve(1))]) for s in range(3)]
    (row,) = bits_rows(cells)
    assert (row["bits_per_action"], row["more"], row["p_value"], row["seeds"]) == (1.0, None, None, 3)


def test_growth():
    made = growth_rows(worlds(["maze"], 3, noise=0, rounds=2))
    assert len(made) == 3 * len(TIMES)
    (row,) = found(made, prior="gru", round=2)
    assert (row["length"], row["num_plans"], row["seeds"]) == (8, 256, 3)
    assert row["oracle_share"] == pytest.approx(curve(16)[-1])
    assert growth_rows(worlds(["maze"], 1)) == []
