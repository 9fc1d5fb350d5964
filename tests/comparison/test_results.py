"""`Comparison`: statistics by hand and by scipy, sentences, figure and files, of outcomes that are made up."""

import json

import numpy as np
import pytest
from scipy import stats

from neuroprior.comparison import Comparison
from neuroprior.comparison.trial import Outcome

NOISE = np.random.default_rng(0).normal(0, 0.01, (8, 1, 3, 1, 5))


def outcome(scores, random=0.0, best=1.0):
    """An outcome of scores `[planners, priors, budgets, S]`."""
    scores = np.asarray(scores, dtype=float)
    starts = scores.shape[-1]
    optimum = None if best is None else np.full(starts, best)
    steps = np.full(scores.shape[:-1], 40)
    return Outcome(scores, np.full(starts, random), optimum, steps, 100, False, 1.0)


def comparison(*means, seeds=8, random=0.0, best=1.0, noise=NOISE, planner="sampling"):
    """Of a planner and a budget, with priors of these mean scores and little noise."""
    levels = np.array(means)[None, :, None, None]
    outcomes = tuple(outcome(levels + noise[seed, :, : len(means)], random, best) for seed in range(seeds))
    return Comparison(outcomes, (planner,), ("uniform", "gru", "markov")[: len(means)], (16,), 10, ())


def test_statistics_are_those_of_scipy_where_all_seeds_can_gain_as_much():
    """Random plans get 1 and the optimum is 3, so that normalised scores are (score - 1) / 2; Holm by hand."""
    uniform, gru, markov = comparison(2.0, 2.2, 2.01, random=1.0, best=3.0).rows
    values = (np.array([2.0, 2.2, 2.01])[:, None] + NOISE[:, 0, :, 0].mean(-1).T - 1) / 2
    for row, own in zip((uniform, gru, markov), values, strict=True):
        interval = stats.t.interval(0.95, 7, own.mean(), stats.sem(own))
        assert (row.score, row.low, row.high) == pytest.approx((own.mean(), *interval))
    for row, own in ((gru, values[1]), (markov, values[2])):
        test = stats.ttest_rel(own, values[0])
        ends = test.confidence_interval(0.95)
        assert row.difference == pytest.approx((own - values[0]).mean())
        assert (row.difference_low, row.difference_high) == pytest.approx((ends.low, ends.high))
        assert row.p == pytest.approx(test.pvalue)
    assert gru.p < markov.p
    assert (gru.p_holm, markov.p_holm) == pytest.approx((2 * gru.p, markov.p))
    assert np.isnan([uniform.difference, uniform.p, uniform.p_holm]).all()
    assert uniform.mean_score == pytest.approx(2.0, abs=0.01)


def test_scores_are_ratios_of_sums():
    """Two seeds, which can gain 1 and 3, gain 1 and 0: together a quarter, not half."""
    outcomes = (outcome([[[[1.0]]]], best=1.0), outcome([[[[0.0]]]], best=3.0))
    assert Comparison(outcomes, ("sampling",), ("uniform",), (1,), 1, ()).rows[0].score == pytest.approx(0.25)


def test_the_best_score_found_takes_the_place_of_the_optimum():
    """From two starts the best of all decisions are 2 and 4; uniform plans reach 2 and 1 of them."""
    found = Comparison((outcome([[[[2, 1]], [[0, 4]]]], best=None),), ("mcts",), ("uniform", "gru"), (1,), 1, ())
    assert [row.score for row in found.rows] == pytest.approx([3 / 6, 4 / 6])
    assert found.scale == "the best score found"
    assert found.unit == "starts"
    assert "±: 95 % intervals over 2 starts; how much a prior varies from one training to another is not in" in str(
        found
    )


def test_sentences_say_what_was_tested():
    assert (
        comparison(0.5, 0.83)
        .summary()
        .startswith(
            "With a budget of 16 plans, the sampling planner reaches .83 of the optimum with the gru prior and .50 with"
            " uniform plans (difference .33, .3"
        )
    )
    assert "No prior helps the sampling planner, and gru harms it" in comparison(0.5, 0.3).summary()
    assert "The mcts planner needs no prior here: it reaches .98" in comparison(0.98, 0.98, planner="mcts").summary()
    assert comparison(0.5, 0.5).summary().startswith("No prior clearly helps the sampling planner: the largest")
    assert comparison(0.5).summary() == "The sampling planner reaches .50 of the optimum with 16 uniform plans."
    few = comparison(0.5, 0.83, seeds=4)
    assert few.summary().startswith("No prior clearly helps")
    assert "Fewer than 5 seeds" in str(few)
    assert "*" not in str(few)
    assert "*" in str(comparison(0.5, 0.83))


def test_a_figure_has_a_panel_for_each_planner_and_a_line_for_each_prior():
    outcomes = tuple(outcome(np.random.default_rng(seed).random((2, 3, 2, 4))) for seed in range(3))
    drawn = Comparison(outcomes, ("sampling", "mcts"), ("uniform", "gru", "markov"), (16, 64), 10, ()).figure()
    assert [panel.get_title() for panel in drawn.axes] == ["sampling", "mcts"]
    assert [len(panel.lines) for panel in drawn.axes] == [3, 3]
    assert [len(panel.collections) for panel in drawn.axes] == [3, 3]


def test_files_hold_the_rows_and_all_scores(tmp_path):
    found = comparison(0.5, 0.83)
    found.save(tmp_path / "out")
    content = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert content["summary"] == found.summary()
    assert np.array_equal(content["seeds"][3]["scores"], found.outcomes[3].scores)
    assert (tmp_path / "out" / "comparison.csv").read_text().splitlines()[0].startswith("planner,prior,budget,score")
    assert sorted(path.name for path in (tmp_path / "out").glob("c*")) == [
        "comparison.csv",
        "comparison.json",
        "comparison.png",
    ]
