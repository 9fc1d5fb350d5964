"""The end of a run of `fit`: what is compared with what, on which plans, and how the table says it."""

from dataclasses import replace

import pandas as pd
import pytest
import torch

from neuroprior import MarkovPrior, Plans
from neuroprior.behaviour.analysis.comparison import action_bits, baselines, score
from neuroprior.cli.fit_data import divide
from neuroprior.cli.fit_folds import cross_validated
from neuroprior.cli.fit_report import learning_curve, report
from neuroprior.plans.folds import folds
from neuroprior.priors.scoring import learned_from
from tests.integration.test_train import metrics
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import seeded

CURVE = [
    {"step": 10, "train_bits": 1.9, "validation_bits": 2.0},
    {"step": 20, "train_bits": 1.5, "validation_bits": 1.6},
    {"step": 30, "train_bits": 1.1, "validation_bits": 1.8},
]


def chain(num, **more) -> Plans:
    return replace(markov_plans(markov_probs(3, 1, 0, 1.5), num, 6, 0), **more)


def reported(folder, data, prior, curve=()):
    """The prior, fitted, after the report on it."""
    prior.fit(data.learned_from)
    report(folder, prior, list(curve), data, type(prior)(**prior.config), {})
    return prior


def test_all_is_scored_on_held_out_plans_and_chosen_on_others(tmp_path, capsys):
    """Of 100 plans 50, 20 and 30: scores by hand. The prior takes no context, so that the baselines take none."""
    data = divide(chain(100, context=torch.arange(100) % 2), 0.2, 0.3)
    prior = reported(tmp_path, data, MarkovPrior(3, 1), CURVE)
    results = metrics(tmp_path)
    assert results["plans"] == {"training": 50, "validation": 20, "held_out": 30}
    assert results["curve"] == CURVE
    rows = {row["model"]: row for row in results["rows"]}
    trained = score("markov", prior, data.held_out)
    made = list(baselines(data.learned_from, data.chosen_on, None))
    assert list(rows) == [*(one.model for one in made), "markov"]
    for one in made:
        gap = score(one.model, one.prior, data.held_out).minus(trained)
        row = rows[one.model]
        found = [row[name] for name in ("more_than_trained", "more_low", "more_high", "p_value")]
        assert found == pytest.approx(list(gap), nan_ok=True)
        assert row["validation_bits"] == pytest.approx(one.validation_bits)
    assert rows["markov"]["bits_per_action"] == pytest.approx(trained.bits_per_action().mean)
    assert rows["markov"]["more_than_trained"] == 0
    assert results["chosen"] == min(made, key=lambda one: one.validation_bits).model
    printed = capsys.readouterr().out
    starred = [line.split("*")[0].split()[-1] for line in printed.splitlines() if "* " in line]
    assert starred == [results["chosen"]]
    lines = [line for line in printed.splitlines() if " ± " in line]
    assert [line.count("±") for line in lines] == [2] * (len(lines) - 1) + [1]  # no difference from itself
    assert "± -" not in printed
    assert "folds" not in printed
    assert len(pd.read_csv(tmp_path / "metrics.csv")) == len(rows)


def test_what_takes_a_context_is_marked(tmp_path, capsys):
    reported(tmp_path, divide(chain(60, context=torch.arange(60) % 2)), MarkovPrior(3, 1, num_contexts=2))
    lines = [line for line in capsys.readouterr().out.splitlines() if " ± " in line]
    assert "context" in lines[-1]
    assert "context" not in next(line for line in lines if "uniform" in line)


@pytest.mark.parametrize(
    ("sizes", "known"), [([900], [True]), ([900, 300], [True, True]), ([3, 4, 2000], [..., ..., True])]
)
def test_of_a_plan_that_was_cut_a_part_was_learned(sizes, known, tmp_path):
    """One plan is cut in three; of two plans, or of three that are as unequal, the longer is cut."""
    plans = Plans(torch.randint(3, (len(sizes), max(sizes)), generator=seeded(0)), 3, torch.tensor(sizes))
    data = divide(plans)
    reported(tmp_path, data, MarkovPrior(3, 1))
    marked = learned_from(tmp_path, plans)
    assert [due in (..., found) for found, due in zip(marked, known, strict=True)] == [True] * len(sizes)
    assert sum(learned_from(tmp_path, data.held_out)) == (len(data.held_out) if data.folds > 1 else 0)


@pytest.mark.parametrize("kinds", [3, 500])
def test_a_prior_that_is_worse_than_uniform_is_named(kinds, tmp_path, capsys):
    """Of 500 kinds of action that follow one another at random, 1,600 actions show hardly anything."""
    actions = torch.randint(kinds, (200, 8), generator=seeded(0))
    actions[:, 1::2] = actions[:, ::2] if kinds == 3 else actions[:, 1::2]
    reported(tmp_path, divide(Plans(actions, kinds)), MarkovPrior(kinds, 2))
    printed = " ".join(capsys.readouterr().out.split())
    assert ("predicts these plans worse than uniform does." in printed) == (kinds == 500), printed


def test_the_learning_curve():
    (axes,) = learning_curve("gru", pd.DataFrame(CURVE), "markov-1", 1.7).axes
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    assert list(lines["training plans"]) == [1.9, 1.5, 1.1]
    assert list(lines["validation plans"]) == [2.0, 1.6, 1.8]
    assert set(lines["markov-1, validation plans"]) == {1.7}
    kept = next(line for line in axes.lines if line.get_label() == "kept")
    assert (list(kept.get_xdata()), list(kept.get_ydata())) == ([20], [1.6])


def test_folds_are_those_of_the_seed(tmp_path):
    """Seven animals in two folds: each model is fitted without a fold, on settings chosen on a share of the rest."""
    plans = chain(56, group=torch.arange(56) % 7)
    plans = replace(plans, context=plans.actions.amax(1))  # which tells something of the actions
    how = {"num_folds": 2, "seed": 4, "validation": 0.4}
    fresh, data = MarkovPrior(3, 2, 0.5), divide(plans, **how)
    found = cross_validated(tmp_path, fresh, {}, data, 3)
    due = {"trained": torch.zeros(56, 6), "markov-1": torch.zeros(56, 6)}
    for fold, (training, held_out) in enumerate(folds(plans, 2, 4)):
        learned = plans[training]
        due["trained"][held_out] = action_bits(MarkovPrior(3, 2, 0.5).fit(learned), plans[held_out]).float()
        parts = learned.split(0.4, seeded(4000 + fold))
        (one,) = (one for one in baselines(*parts, 3) if one.model == "markov-1")
        assert one.prior.takes_context
        due["markov-1"][held_out] = action_bits(one.prior.fit(learned), plans[held_out]).float()
    for name, bits in due.items():
        by_group = [float(bits[plans.group == g].sum()) for g in range(7)]
        assert found[name].bits.tolist() == pytest.approx(by_group, rel=1e-4)
    assert found["trained"].inputs == "behaviours"
    assert found["markov-1"].inputs == "behaviours and context"
    # Finished folds are read again, where prior, seed and context are the same.
    others = [(MarkovPrior(3, 1), how, 3), (fresh, how | {"seed": 5}, 3), (fresh, how, 4)]
    for number, (prior, options, contexts) in enumerate([(fresh, how, 3), *others], 1):
        cross_validated(tmp_path, prior, {}, divide(plans, **options), contexts)
        assert len(list((tmp_path / "folds").rglob("*.npz"))) == 2 * number
