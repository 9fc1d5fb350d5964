"""From runs to tables: closed forms on made-up runs, intervals that cover, tests with few false alarms."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from eval.compare.results import AGAINST, BEST, Results, best_difference, chosen, needed
from eval.worlds.aggregates import interquartile_gap, interquartile_mean, probability_of_improvement
from neuroprior._statistics import holm, mean_interval, paired_difference
from neuroprior.behaviour.reporting.document import records
from tests.support.compare_runs import BUDGETS, TIMES, curve, entry, run, worlds

ASKED = (16, 256, 4096)


def found(frame: pd.DataFrame, **wanted: Any) -> list[dict[str, Any]]:
    """The rows of a frame that have these values; missing ones are None, as in results.json."""
    return [row for row in records(frame) if all(row[name] == value for name, value in wanted.items())]


def two(first: list[float], second: list[float], names: tuple[str, str] = ("gru", "markov-1"), world: str = "maze"):
    """Runs of two priors that have one score each, seed by seed, with any number of plans."""
    pairs = zip(first, second, strict=True)
    priors = [[entry(name, [share] * 13) for name, share in zip(names, pair, strict=True)] for pair in pairs]
    return [run(world, seed, own) for seed, own in enumerate(priors)]


def test_rows_hold_means_over_seeds():
    runs = worlds(["maze"], 3)
    made = Results(runs, ASKED).rows
    assert len(made) == 1 + len(TIMES) * len(ASKED)
    (row,) = found(made, prior="gru", num_plans=256)
    shares = [one["share"][8] for r in runs for one in r["entries"] if one["prior"] == "gru"]
    assert (row["oracle_share"], row["low"], row["high"]) == pytest.approx(mean_interval(shares))
    assert row["at_oracle"] == pytest.approx(np.mean(shares) / 2)
    assert (row["model_steps"], row["seeds"]) == (2048, 3)
    assert row["seconds_per_decision"] == pytest.approx(0.009)
    (row,) = found(made, planner="exhaustive")
    assert (row["num_plans"], row["prior"], row["model_steps"]) == (None, None, 8)
    # Without spread there is no interval but the value.
    assert row["low"] == row["high"] == pytest.approx(0.6)
    (row,) = found(Results(runs, [32]).rows, prior="gru")
    assert row["seconds_per_decision"] is None
    alone = records(Results(runs[:1], ASKED).rows)
    assert all(row["low"] is row["high"] is None and row["seeds"] == 1 for row in alone)


def test_unlike_runs_are_refused():
    runs = worlds(["maze"], 2)
    with pytest.raises(ValueError, match="`runs` must have at least one"):
        Results([], ASKED)
    with pytest.raises(ValueError, match="maze, seed 1: uniform is there twice"):
        _ = Results([*runs, run("maze", 1, [entry("uniform", curve(1))])], ASKED).rows
    with pytest.raises(ValueError, match="maze, seed 2: the numbers of plans are"):
        _ = Results([*runs, run("maze", 2, []) | {"budgets": [1, 2]}], ASKED).rows
    with pytest.raises(ValueError, match=r"num_plans: maze has \[1, 2, .*\], not 100"):
        _ = Results(runs, [16, 100]).rows


@settings(max_examples=5, deadline=None)
@given(order=st.permutations(range(6)))
def test_the_order_of_seeds_does_not_matter(order):
    runs = worlds(["maze", "taxi"], 3, {"uniform": 1.0, "markov-1": 2.0, "gru": 4.0})
    mixed, ordered = Results(sorted((runs[k] for k in order), key=lambda one: one["world"]), [16]), Results(runs, [16])
    for name in ("rows", "paired", "efficiency", "bits", "across"):
        assert records(getattr(mixed, name)) == records(getattr(ordered, name))


def test_what_a_curve_needs():
    assert needed(np.array(curve(8)), BUDGETS, curve(1)[-1]) == pytest.approx(4096 / 8)
    assert needed(np.array(curve(1)), BUDGETS, curve(1)[5]) == pytest.approx(32)
    assert needed(np.array(curve(3)), BUDGETS, curve(1)[-1]) == pytest.approx(4096 / 3)
    assert needed(np.array([0.5, 0.6]), [1, 2], 0.3) == 1
    assert needed(np.array([0.5, 0.6]), [1, 2], 0.7) == np.inf
    # A random peak is no crossing: made to climb, the curve is 0, 0.3, 0.3, 0.6.
    assert needed(np.array([0.0, 0.5, 0.1, 0.6]), [1, 2, 4, 8], 0.45) == pytest.approx(2**2.5)


def test_the_combined_prior_against_the_best_of_its_parts():
    times = {"uniform": 1.0, "markov-1": 2.0, "markov-2": 3.0, "gru": 2.5, "combined": 3.5}
    made = Results(worlds(["maze"], 6, times), [256])
    shares = {
        name: np.array([one["share"][8] for r in made.runs for one in r["entries"] if one["prior"] == name])
        for name in times
    }
    against = (("gru", "markov-1", "markov-2"), ("markov-1", "markov-2"), ("gru",))
    for what, others in zip(AGAINST, against, strict=True):
        (row,) = found(made.paired, what=what, rounds="0", context="none")
        expected = best_difference(shares["combined"][None], np.stack([shares[name] for name in others]))
        assert row["first"] == "combined"
        assert (row["difference"], row["low"], row["high"], row["p_value"]) == pytest.approx(tuple(expected))
    assert not found(Results(worlds(["maze"], 6), [256]).paired, what=AGAINST[0])


def test_efficiency_is_how_many_random_plans_one_is_worth():
    made = Results(worlds(["maze"], 20, {**TIMES, "transformer": 0.5}, noise=0), ASKED).efficiency
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
    runs = [run("maze", seed, [entry("uniform", flat), entry("gru", curve(4))]) for seed in range(6)]
    uniform, gru = records(Results(runs, ASKED).efficiency)
    assert (uniform["needed"], uniform["factor"]) == pytest.approx((256, 1))
    assert (gru["needed"], gru["factor"]) == pytest.approx((64, 4))


def test_medians_have_the_intervals_of_the_sign_test():
    """With 20 seeds, between the 6th and the 15th; with fewer than 6, none; seeds that never get there count."""
    times = [2.0 ** (seed / 4) for seed in range(20)]
    runs = [run("maze", s, [entry("uniform", curve(1)), entry("gru", curve(t))]) for s, t in enumerate(times)]
    row = records(Results(runs, ASKED).efficiency)[1]
    assert (row["factor_low"], row["factor_high"]) == pytest.approx((times[5], times[14]))
    assert row["factor"] == pytest.approx((times[9] * times[10]) ** 0.5)
    test = stats.quantile_test(times).confidence_interval(0.95)
    assert (row["factor_low"], row["factor_high"]) == pytest.approx((test.low, test.high))
    assert records(Results(runs[:5], ASKED).efficiency)[1]["factor_low"] is None
    late = [run("maze", s, [entry("uniform", curve(1)), entry("gru", curve(0.5 if s < 8 else 2))]) for s in range(20)]
    row = records(Results(late, ASKED).efficiency)[1]
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
        assert (stats.ttest_1samp(alone, 0, axis=1).pvalue < 0.05).sum() > 85
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
    # They are no wider than they must be: most of the large differences are significant.
    large = [one for one, gap in zip(found, true, strict=True) if gap > 1.5]
    assert sum(one.low > 0 for one in large) > 0.8 * len(large) > 50


def test_one_against_one_is_students_test():
    first, second = np.random.default_rng(0).normal(0, 1, (2, 1, 9))
    assert best_difference(first, second) == pytest.approx(paired_difference(first[0], second[0]))
    whole = np.arange(9.0)[None]
    for more in (1, -1, 0):
        assert best_difference(whole + more, whole) == paired_difference(whole[0] + more, whole[0])


def test_pairs():
    runs = worlds(["maze"], 6, context=("none", "initial"), rounds=1)
    made = Results(runs, [16, 256]).paired
    # Twice two contexts and rounds; one neural prior and two chains; two numbers of plans.
    after, context = "after minus before the curriculum", "with minus without context"
    assert made["what"].value_counts().to_dict() == {BEST: 8, "neural minus Markov": 16, after: 12, context: 12}
    assert made["p_holm"].tolist() == pytest.approx(holm(made["p_value"]).tolist())
    (row,) = found(made, what="neural minus Markov", second="markov-1", context="none", rounds="0", num_plans=16)
    shares = {
        prior: [
            one["share"][4] for r in runs for one in r["entries"] if (one["prior"], *place(one)) == (prior, "none", 0)
        ]
        for prior in ("gru", "markov-1")
    }
    gaps = np.subtract(shares["gru"], shares["markov-1"])
    assert (row["difference"], row["low"], row["high"]) == pytest.approx(mean_interval(gaps))
    assert row["p_value"] == pytest.approx(stats.ttest_1samp(gaps, 0).pvalue)
    # Twice as many plans are worth 1 / 24; without spread the test is that of signs.
    for row in (*found(made, what=after), *found(made, what=context)):
        assert (row["difference"], row["low"], row["high"]) == pytest.approx([1 / 24] * 3, abs=1e-8)
        assert row["p_value"] == 2.0**-5
    assert {row["rounds"] for row in found(made, what=after)} == {"1 - 0"}
    assert {row["context"] for row in found(made, what=context)} == {"initial - none"}


def place(one: dict[str, Any]) -> tuple[str, int]:
    return one["context"], one["rounds"]


def test_saved_priors_meet_all_others():
    names = ("uniform", "markov-1", "runs/gru", "runs/new")
    runs = [run("maze", s, [entry(name, curve(1)) for name in names]) for s in range(3)]
    made = Results(runs, [16]).paired
    pairs = list(zip(made["first"], made["second"], strict=True))
    assert pairs == [("runs/gru", "markov-1"), ("runs/gru", "runs/new"), ("runs/new", "markov-1")]


def test_seeds_that_lack_one_of_a_pair_are_left_out():
    runs = two([0.5, 0.6, 0.7], [0.4, 0.4, 0.4])
    runs[1]["entries"].pop()
    (row,) = found(Results(runs, [16]).paired, what="neural minus Markov")
    assert (row["seeds"], row["difference"]) == (2, pytest.approx(0.2))


def answer(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The first row of the headline differences."""
    return records(Results(runs, [16]).words)[0]


def test_headline_differences():
    rng = np.random.default_rng(0)
    low, noise = [0.5] * 10, rng.normal(0, 0.01, 10)
    better = answer(two(list(0.52 + noise), low))
    assert (better["first"], better["second"], better["better"]) == ("gru", "markov-1", "gru")
    assert (better["difference"], better["low"], better["high"]) == pytest.approx(mean_interval(0.02 + noise))
    assert (better["num_plans"], better["seeds"]) == (16, 10)
    worse = answer(two(low, list(0.52 + noise)))
    assert worse["better"] == "markov-1"
    assert (-worse["difference"], -worse["high"], -worse["low"]) == pytest.approx(mean_interval(0.02 + noise))
    alike = answer(two(list(0.5 + noise - noise.mean()), low))
    assert alike["better"] is None
    assert alike["low"] < 0 < alike["high"]
    assert answer(two(low, low))["better"] is None
    alone = answer(two([0.6], [0.5]))
    assert (alone["difference"], alone["seeds"]) == (pytest.approx(0.1), 1)
    assert alone["low"] is alone["p_value"] is alone["p_holm"] is alone["better"] is None
    assert answer(two(list(0.52 + noise), low, ("runs/a", "runs/b")))["better"] == "runs/a"
    lone = answer(two(list(0.52 + noise), low, ("markov-3", "uniform")))
    assert (lone["second"], lone["better"]) == ("uniform", "markov-3")
    assert Results([run("maze", 0, [entry("uniform", curve(1))])], [16]).words.empty


def test_headlines_are_about_the_best_of_several():
    several = answer(worlds(["maze"], 10, {**TIMES, "transformer": 64.0}, noise=0.001))
    assert (several["first"], several["second"], several["better"]) == ("transformer", "markov-2", "transformer")
    chains = answer(worlds(["maze"], 10, {"uniform": 1, "markov-1": 2, "markov-2": 2, "markov-3": 2}))
    assert chains["better"] == chains["first"]
    assert set(chains["first"].split(" / ")) <= {"markov-1", "markov-2", "markov-3"}
    assert chains["second"] == "uniform"


def test_headlines_are_corrected_for_the_number_of_worlds():
    """A difference that is significant in one world alone is not among ten others without any difference."""
    gaps = np.array([0.02, 0.05, -0.01, 0.03, 0.01, 0.04])
    alone = two(list(0.5 + gaps), [0.5] * 6)
    assert answer(alone)["better"] == "gru"
    noise = np.array([0.01, -0.01, 0.02, -0.02, 0.01, -0.01])
    others = [one for n in range(10) for one in two(list(0.5 + noise), [0.5] * 6, world=f"world {n}")]
    first = answer([*alone, *others])
    assert first["better"] is None
    assert first["p_value"] < 0.05 < first["p_holm"] == pytest.approx(11 * first["p_value"])
    # Before and after the curriculum, and with each context, another question is asked.
    words = Results(worlds(["maze", "taxi", "grid"], 6, context=("none", "initial"), rounds=2), ASKED).words
    for _, own in words.groupby(["context", "rounds"]):
        assert len(own) == 3
        assert own["p_holm"].tolist() == pytest.approx(holm(own["p_value"]).tolist())


def test_aggregates_over_worlds():
    """Interquartile means and probabilities of improvement, of the scores `[world, seed]` of pairs of priors."""
    made = Results(runs := worlds(["maze", "grid", "cube", "taxi", "cliff"], 4, rounds=2), ASKED)

    def scores(prior: str, rounds: int) -> np.ndarray:
        own = [one for r in runs for one in r["entries"] if (one["prior"], one["rounds"]) == (prior, rounds)]
        return np.array([one["share"][8] for one in own]).reshape(5, 4)

    for rounds in (0, 2):
        (row,) = found(made.across, prior="gru", baseline="markov-2", rounds=min(rounds, 1))
        first, second = scores("gru", rounds), scores("markov-2", rounds)
        assert (row["first"], row["first_low"], row["first_high"]) == pytest.approx(interquartile_mean(first))
        assert (row["second"], row["second_low"], row["second_high"]) == pytest.approx(interquartile_mean(second))
        better = (row["improvement"], row["improvement_low"], row["improvement_high"])
        assert better == pytest.approx(probability_of_improvement(first, second))
        gap = (row["difference"], row["difference_low"], row["difference_high"])
        assert gap == pytest.approx(interquartile_gap(first, second))
        assert (row["worlds"], row["seeds"]) == (5, 4)
    pairs = {(row["prior"], row["baseline"]) for row in records(made.across)}
    chains = {("gru", "markov-1"), ("gru", "markov-2")}
    assert pairs == chains | {(prior, "uniform") for prior in TIMES if prior != "uniform"}
    assert Results(worlds(["maze"], 4), ASKED).across.empty


def test_the_combined_prior_over_worlds():
    """Against each other prior, without context and with the last of each world, at each number of candidates."""
    times = TIMES | {"combined": 32.0}
    runs = worlds(["maze", "grid"], 4, times, context=("none", "initial"), rounds=2)
    runs += worlds(["cube", "taxi", "cliff"], 4, times, rounds=1)
    frame = Results(runs, ASKED).combined
    assert set(frame["prior"]) == set(TIMES) - {"uniform"}
    assert len(frame) == 3 * 2 * 2 * len(ASKED)  # priors, contexts, rounds

    def scores(prior: str, number: int) -> np.ndarray:
        of = {}
        for made in runs:
            for one in made["entries"]:
                if one["prior"] == prior and one["rounds"]:
                    of[made["world"], made["seed"]] = one["share"][made["budgets"].index(number)]  # the last context
        return np.array(list(of.values())).reshape(5, 4)

    for number in ASKED:
        (row,) = found(frame, prior="gru", context="most", rounds=1, num_plans=number)
        first, second = scores("combined", number), scores("gru", number)
        assert row["first"] == pytest.approx(interquartile_mean(first).mean)
        assert row["second"] == pytest.approx(interquartile_mean(second).mean)
        gap = (row["difference"], row["difference_low"], row["difference_high"])
        assert gap == pytest.approx(interquartile_gap(first, second))
        assert (row["worlds"], row["seeds"]) == (5, 4)
    assert Results(worlds(["maze", "grid"], 4), ASKED).combined.empty
    assert set(Results(worlds(["maze", "grid"], 4, times), ASKED).combined["context"]) == {"none"}


def test_bits():
    made = Results(worlds(["maze"], 6, noise=0, context=("none", "initial")), ASKED).bits
    (gru,) = found(made, prior="gru", context="initial")
    assert gru["bits_per_action"] == pytest.approx(2 - 4 / 8 - 0.1)
    # One bit per eight-fold worth: markov-2 takes 1 / 8 more, whatever the context.
    assert (gru["more"], gru["more_low"], gru["more_high"]) == pytest.approx([-1 / 8] * 3)
    assert found(made, prior="markov-2", context="none")[0]["more"] == 0
    runs = [run("maze", s, [entry("gru", curve(1), bits=1.0), entry("markov-1", curve(1))]) for s in range(3)]
    (row,) = records(Results(runs, ASKED).bits)
    assert (row["bits_per_action"], row["more"], row["p_value"], row["seeds"]) == (1.0, None, None, 3)


def test_rounds_of_the_curriculum():
    made = Results(worlds(["maze"], 3, noise=0, rounds=2), ASKED).curriculum
    assert len(made) == 3 * len(TIMES)
    (row,) = found(made, prior="gru", round=2)
    assert (row["length"], row["num_plans"], row["seeds"]) == (8, 256, 3)
    assert row["oracle_share"] == pytest.approx(curve(16)[-1])
    assert Results(worlds(["maze"], 1), ASKED).curriculum.empty


def explained(chain: float, network: float, bits: tuple[float, float], early: float = 0.0) -> Results:
    """Results for the scores of a chain and a network with all numbers of plans, and their bits; 6 seeds."""
    runs = []
    for seed in range(6):
        noise = 0.001 * (-1) ** seed
        shares = {"markov-1": [chain + noise] * 13, "gru": [network - noise] * 13}
        shares["gru"][BUDGETS.index(16)] += early
        runs.append(run("maze", seed, [entry(n, shares[n], bits=own) for n, own in zip(shares, bits, strict=True)]))
    return Results(runs, ASKED)


def test_both_scores_are_of_the_same_choice():
    """Which of two chains is better changes from half to half: the one that was chosen is not the better one there."""
    runs = []
    for seed in range(6):
        odd = seed % 2
        chains = {"markov-1": 0.7 - 0.1 * odd, "markov-2": 0.6 + 0.1 * odd}
        shares = chains | {"gru": 0.64 + 0.001 * (seed // 2)}
        runs.append(run("maze", seed, [entry(name, [share] * 13, bits=1.0) for name, share in shares.items()]))
    (row,) = records(Results(runs, ASKED).words)
    assert (row["second_share"], row["first_share"]) == pytest.approx((0.6, 0.641))
    assert row["difference"] == pytest.approx(0.041)


def test_a_better_network_needs_no_reason():
    results = explained(0.6, 0.7, (1.5, 1.4))
    assert results.reasons.empty
    (row,) = records(results.words)
    assert (row["second_share"], row["first_share"], row["difference"]) == pytest.approx((0.6, 0.7, 0.1))
    assert row["better"] == "gru"


@pytest.mark.parametrize(
    ("shares", "bits", "early"),
    [
        ((0.99, 0.9), (1.2, 1.5), 0.0),
        ((0.99, 0.99), (1.5, 1.2), 0.0),
        ((0.7, 0.7), (1.5, 1.5), 0.0),
        ((0.7, 0.7), (1.5, 1.2), 0.1),
        ((0.7, 0.6), (1.5, 1.2), 0.0),
    ],
)
def test_reasons(shares, bits, early):
    (row,) = records(explained(*shares, bits, early).reasons)
    assert row["markov_share"] == pytest.approx(shares[0], abs=0.002)
    assert (row["markov_bits"], row["neural_bits"]) == pytest.approx(bits)
    assert row["early"] == (pytest.approx(early) if early else None)


def test_one_number_of_plans_is_not_fewer_than_itself():
    runs = []
    for seed in range(6):
        shares = {"markov-1": 0.7, "gru": 0.7 + (0.02 if seed else -0.01)}
        entries = [entry(name, [share] * 13, bits=2 - share) for name, share in shares.items()]
        runs += [run(world, seed, entries) for world in ("maze", "grid", "cube")]
    found = Results(runs, (256,)).reasons
    assert len(found) == 3
    assert found["early"].isna().all()


def test_the_median_of_the_numbers_of_plans_is_shown():
    """In whatever order they were asked for; of two in the middle the larger."""
    runs = worlds(["maze"], 2)
    assert Results(runs, [4096, 16, 256]).shown == 256
    assert Results(runs, [256, 16, 4096, 1024]).shown == 1024
    early = explained(0.7, 0.7, (1.5, 1.2), 0.1)
    backwards = Results(early.runs, ASKED[::-1])
    assert records(backwards.reasons) == records(early.reasons)


def test_worlds_with_other_numbers_of_rounds_are_asked_the_same():
    """After one round in one world and after two in the other: both are corrected together."""
    runs = [*worlds(["maze"], 6, rounds=1), *worlds(["taxi"], 6, rounds=2)]
    words = Results(runs, [16]).words
    after = words[words["rounds"] > 0]
    assert after["rounds"].tolist() == [1, 2]
    assert after["p_holm"].tolist() == pytest.approx(holm(after["p_value"]).tolist())
    assert (after["p_holm"] > after["p_value"]).any()


def test_plans_needed_are_of_seeds_with_random_plans():
    """A seed without random plans has nothing to reach."""
    runs = [run("maze", s, [entry("uniform", curve(1)), entry("gru", curve(4))]) for s in range(3)]
    runs[1]["entries"].pop(0)
    (row,) = found(Results(runs, ASKED).efficiency, prior="gru")
    assert (row["seeds"], row["reached"], row["needed"]) == (2, 2, pytest.approx(1024))


def test_what_random_plans_need_is_by_their_climbing_curve():
    """Scores of 0.5 at all numbers but the last two, 0.9 and 0.1: made to climb 0.5 throughout, reached at once."""
    noisy = [0.5] * 11 + [0.9, 0.1]
    runs = [run("maze", s, [entry("uniform", noisy), entry("gru", [0.4] * 3 + [0.6] * 10)]) for s in range(6)]
    uniform, gru = records(Results(runs, ASKED).efficiency)
    assert (uniform["needed"], uniform["factor"]) == pytest.approx((1, 1))
    assert gru["needed"] == pytest.approx(2**2.5)
    assert gru["factor"] == pytest.approx(2**-2.5)


def test_bits_are_compared_with_chains_before_the_curriculum_seed_by_seed():
    """After the curriculum too; seeds in which either lacks its bits are left out; one seed has no difference."""
    runs = []
    for s, (before, after) in enumerate([(1.5, 1.0), (1.25, 1.25), (1.5, 1.75), (None, 2.0)]):
        entries = [entry("gru", curve(1), rounds=1, bits=after - 0.25), entry("markov-1", curve(1), bits=before)]
        runs.append(run("maze", s, [*entries, entry("markov-1", curve(1), rounds=1, bits=after)]))
    (row,) = found(Results(runs, ASKED).bits, prior="gru")
    due = paired_difference([0.75, 1.0, 1.5], [1.5, 1.25, 1.5])
    assert tuple(row[name] for name in ("more", "more_low", "more_high", "p_value")) == pytest.approx(due)
    (chain,) = found(Results(runs, ASKED).bits, prior="markov-1", rounds=1)
    assert chain["more"] == pytest.approx((-0.5 + 0 + 0.25) / 3)
    (two_seeds,) = found(Results(runs[:2], ASKED).bits, prior="gru")
    assert (two_seeds["more"], two_seeds["p_value"] is None) == (pytest.approx(-0.5), False)


def test_reasons_take_the_fewest_bits_before_the_curriculum():
    """Of two networks and two chains; bits after the curriculum, which are fewer, do not count."""
    runs = []
    for s in range(6):
        bits = {"gru": 1.5, "transformer": 1.25, "markov-1": 1.75, "markov-2": 1.625}
        entries = [entry(name, [0.7] * 13, bits=own) for name, own in bits.items()]
        entries += [entry(name, [0.7] * 13, rounds=1, bits=0.5) for name in bits]
        runs.append(run("maze", s, entries))
    before, after = records(Results(runs, ASKED).reasons)
    for row in (before, after):
        assert (row["neural_bits"], row["markov_bits"]) == (1.25, 1.625)


def test_pairs_over_worlds_are_alike_in_context_and_curriculum():
    runs = worlds(["maze", "taxi"], 3, {**TIMES, "runs/mine": 3.0}, context=("none", "initial"), rounds=2)
    across = Results(runs, ASKED).across
    assert set(across["rounds"]) == {0, 1}
    rows = list(across[["prior", "context", "rounds", "baseline"]].itertuples(index=False, name=None))
    assert len(rows) == len(set(rows))
    ways = [(context, after) for context in ("none", "initial") for after in (0, 1)]
    against = [(one, chain) for one in ("gru", "runs/mine") for chain in ("markov-1", "markov-2")]
    against += [(one, "uniform") for one in ("gru", "runs/mine", "markov-1", "markov-2")]
    assert set(rows) == {(one, *way, other) for one, other in against for way in ways}
    # At the number of plans that is shown, one of each pair's own kind: none is counted twice.
    assert (across["seeds"] == 3).all()


def test_after_any_number_of_rounds_is_compared_with_before():
    made = Results(worlds(["maze"], 4, rounds=2), [16]).paired
    assert len(found(made, what="after minus before the curriculum", rounds="2 - 0")) == 3


def test_headlines_of_a_single_seed_are_of_the_first_network_and_the_last_chain():
    """The best cannot be chosen then."""
    one = answer(worlds(["maze"], 1))
    assert (one["what"], one["first"], one["second"]) == ("neural minus Markov", "gru", "markov-2")


def test_the_better_of_several_is_corrected_for_their_number():
    """Three alternatives against one, and one against three, by hand: Bonferroni over the side that has three."""
    values = np.random.default_rng(2).normal(0, 1, (4, 8))
    values[0] += 2
    for first, second, sign in ((values[:3], values[3:], 1), (values[3:], values[:3], -1)):
        gap = best_difference(first, second)
        tests = [stats.ttest_rel(one, values[3], alternative="greater") for one in values[:3]]
        below = [stats.ttest_rel(one, values[3], alternative="less").pvalue for one in values[:3]]
        assert gap.p_value == pytest.approx(min(1, 2 * min(3 * min(t.pvalue for t in tests), max(below))))
        gaps = values[:3] - values[3]
        error = gaps.std(1, ddof=1) / 8**0.5
        low = (gaps.mean(1) - stats.t.ppf(1 - 0.025 / 3, 7) * error).max()
        high = (gaps.mean(1) + stats.t.ppf(0.975, 7) * error).max()
        assert (gap.low, gap.high) == pytest.approx((low, high) if sign == 1 else (-high, -low))


def test_an_estimate_lies_in_its_interval():
    """Chosen on one half, the best is far worse on the other: the estimate is moved to the interval's end."""
    rng = np.random.default_rng(0)
    found = [
        best_difference(*np.split(rng.normal(0, 1, (12, 4)) + 3 * rng.normal(0, 1, (12, 1)), 2)) for _ in range(500)
    ]
    assert all(one.low <= one.mean <= one.high for one in found)
    assert all(0 <= one.p_value <= 1 for one in found)


def test_the_middle_of_two_numbers_of_plans_one_of_which_is_infinite_is_on_the_safe_side():
    """Half of the seeds never get there: more plans than there are; times fewer than random plans, none."""
    runs = [run("maze", s, [entry("uniform", curve(1)), entry("gru", curve(0.5 if s < 3 else 2))]) for s in range(6)]
    (row,) = found(Results(runs, ASKED).efficiency, prior="gru")
    assert (row["needed"], row["factor"], row["reached"]) == (None, None, 3)


def test_the_most_context_is_not_that_of_the_last_entry():
    """Other runs may have been put beside: their entries come last, and have less."""
    runs = worlds(["maze", "grid"], 4, TIMES | {"combined": 32.0}, context=("none", "initial", "per-step"))
    turned = [one | {"entries": one["entries"][::-1]} for one in runs]
    by = ["prior", "context", "rounds", "num_plans"]
    frames = [Results(some, ASKED).combined.sort_values(by, ignore_index=True) for some in (runs, turned)]
    pd.testing.assert_frame_equal(*frames)
    assert (frames[0]["context"] == "most").any()
