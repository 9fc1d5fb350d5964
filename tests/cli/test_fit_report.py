"""The end of a run of `fit`: what is compared with what, on which plans, and how the table says it."""

import json
from dataclasses import replace

import pandas as pd
import pytest
import torch

from neuroprior import MarkovPrior, Plans
from neuroprior.behaviour.analysis.comparison import action_bits, baselines, score
from neuroprior.cli import fit_recipe
from neuroprior.cli.fit_folds import cross_validated
from neuroprior.cli.fit_recipe import PlansData, PriorModel
from neuroprior.cli.fit_report import learning_curve, report
from neuroprior.plans.folds import folds
from neuroprior.priors.scoring import learned_from
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import seeded


def data_of(monkeypatch, plans, **options):
    monkeypatch.setattr(fit_recipe, "read_plans", lambda *_, **__: plans)
    return PlansData("plans.npz", **options)


def chain(num, **more) -> Plans:
    return replace(markov_plans(markov_probs(3, 1, 0, 1.5), num, 6, 0), **more)


def rows_of(folder):
    return {row["model"]: row for row in json.loads((folder / "metrics.json").read_text())["rows"]}


def test_all_is_scored_on_held_out_plans_and_chosen_on_others(tmp_path, monkeypatch, capsys):
    """Of 100 plans 50, 20 and 30: the numbers of each part, and scores by hand."""
    data = data_of(monkeypatch, chain(100, context=torch.arange(100) % 2), validation=0.2, held_out=0.3)
    model = PriorModel(lambda n: MarkovPrior(n, 1), use_context=False, data=data)
    model.prior.fit(data.learned_from)
    model.curve = [
        {"step": 10, "train_bits": 1.5, "validation_bits": 1.4},
        {"step": 20, "train_bits": 1.0, "validation_bits": 1.6},
    ]
    report(tmp_path, model, data)
    results = json.loads((tmp_path / "metrics.json").read_text())
    assert results["plans"] == {"training": 50, "validation": 20, "held_out": 30}
    assert (results["unit"], results["folds"]) == ("plans", 1)
    rows = rows_of(tmp_path)
    trained = score("markov", model.prior, data.held_out)
    made = list(baselines(data.learned_from, data.chosen_on, None))  # no context: the prior takes none
    assert [*rows][:-1] == [one.model for one in made]
    for one in made:
        gap = score(one.model, one.prior, data.held_out).minus(trained)
        row = rows[one.model]
        found = [row[name] for name in ("more_than_trained", "more_low", "more_high", "p_value")]
        assert found == pytest.approx(list(gap), nan_ok=True)
        assert row["validation_bits"] == pytest.approx(one.validation_bits)
    best = min(made, key=lambda one: one.validation_bits)
    assert results["chosen"] == best.model
    assert [line.split("*")[0].split()[-1] for line in capsys.readouterr().out.splitlines() if "* " in line] == [
        best.model
    ]
    last = list(rows.values())[-1]
    assert last["bits_per_action"] == pytest.approx(trained.bits_per_action().mean)
    assert last["more_than_trained"] == 0
    assert len(pd.read_csv(tmp_path / "metrics.csv")) == len(rows)
    assert learned_from(tmp_path, data.plans) == [
        any(plan.equal(one) for part in (data.learned_from, data.chosen_on) for one in part.actions)
        for plan in data.plans.actions
    ]


@pytest.mark.parametrize(
    ("sizes", "known"), [([900], [True]), ([900, 300], [True, True]), ([3, 4, 2000], [..., ..., True])]
)
def test_of_a_plan_that_was_cut_a_part_was_learned(sizes, known, tmp_path, monkeypatch):
    """One plan is cut in three; of two plans, or of three that are as unequal, the longer is cut."""
    actions = torch.randint(3, (len(sizes), max(sizes)), generator=seeded(0))
    data = data_of(monkeypatch, Plans(actions, 3, torch.tensor(sizes)))
    model = PriorModel(lambda n: MarkovPrior(n, 1), data=data)
    model.prior.fit(data.learned_from)
    report(tmp_path, model, data)
    marked = learned_from(tmp_path, data.source)
    assert [due in (..., found) for found, due in zip(marked, known, strict=True)] == [True] * len(sizes)
    assert sum(learned_from(tmp_path, data.held_out)) == (len(data.held_out) if data.folds > 1 else 0)


def test_intervals_in_the_table_are_not_negative(tmp_path, monkeypatch, capsys):
    data = data_of(monkeypatch, chain(60, context=torch.arange(60) % 2))
    model = PriorModel(lambda n, **size: MarkovPrior(n, 1, **size), data=data)
    model.prior.fit(data.learned_from)
    report(tmp_path, model, data)
    printed = capsys.readouterr().out
    lines = [line for line in printed.splitlines() if " ± " in line]
    assert "± -" not in printed
    assert [line.count("±") for line in lines] == [2] * (len(lines) - 1) + [1]  # no difference from itself
    assert "context" in lines[-1]
    assert "context" not in next(line for line in lines if "uniform" in line)
    assert "folds" not in printed


@pytest.mark.parametrize("kinds", [3, 500])
def test_a_prior_that_is_worse_than_uniform_is_named(kinds, tmp_path, monkeypatch, capsys):
    """Of 500 kinds of action that follow one another at random, 1,600 actions show hardly anything."""
    actions = torch.randint(kinds, (200, 8), generator=seeded(0))
    actions[:, 1::2] = actions[:, ::2] if kinds == 3 else actions[:, 1::2]
    data = data_of(monkeypatch, Plans(actions, kinds))
    model = PriorModel(lambda n, **size: MarkovPrior(n, 2, **size), data=data)
    model.prior.fit(data.learned_from)
    report(tmp_path, model, data)
    printed = " ".join(capsys.readouterr().out.split())
    said = "predicts these plans worse than uniform does." in printed
    assert said == (kinds == 500), printed


def test_the_learning_curve():
    curve = pd.DataFrame({"step": [10, 20, 30], "train_bits": [1.9, 1.5, 1.1], "validation_bits": [2.0, 1.6, 1.8]})
    (axes,) = learning_curve("gru", curve, "markov-1", 1.7).axes
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    assert list(lines["training plans"]) == [1.9, 1.5, 1.1]
    assert list(lines["validation plans"]) == [2.0, 1.6, 1.8]
    assert set(lines["markov-1, validation plans"]) == {1.7}
    kept = next(line for line in axes.lines if line.get_label() == "kept")
    assert (list(kept.get_xdata()), list(kept.get_ydata())) == ([20], [1.6])


@pytest.mark.parametrize("with_context", [pytest.param(False, marks=pytest.mark.slow), True])
def test_folds_are_those_of_the_seed(with_context, tmp_path, monkeypatch):
    """Seven animals in two folds: each model is fitted without a fold, on settings chosen on a share of the rest."""
    group, plans = torch.arange(56) % 7, chain(56)
    context = plans.actions.amax(1)  # which tells something of the actions
    plans = replace(plans, group=group, context=context)
    data = data_of(monkeypatch, plans, folds=2, seed=4, validation=0.4)
    fresh, contexts = MarkovPrior(3, 2, 0.5), 3 if with_context else None
    found = cross_validated(tmp_path, fresh, {}, data, contexts)
    due = {"trained": torch.zeros(56, 6), "markov-1": torch.zeros(56, 6)}
    takes = []
    for fold, (training, held_out) in enumerate(folds(plans, 2, 4)):
        learned = plans[training]
        due["trained"][held_out] = action_bits(MarkovPrior(3, 2, 0.5).fit(learned), plans[held_out]).float()
        parts = learned.split(0.4, seeded(4000 + fold))
        (one,) = (one for one in baselines(*parts, contexts) if one.model == "markov-1")
        due["markov-1"][held_out] = action_bits(one.prior.fit(learned), plans[held_out]).float()
        takes.append(one.prior.takes_context)
    for name, bits in due.items():
        by_group = [float(bits[group == g].sum()) for g in range(7)]
        assert found[name].bits.tolist() == pytest.approx(by_group, rel=1e-4)
    assert found["trained"].inputs == "actions"
    assert (found["markov-1"].inputs == "actions and context") == any(takes)
    assert any(takes) == with_context
    # The same is read again; a run of another prior, share or context is refused or made anew.
    number = len(list((tmp_path / "folds").rglob("*.npz")))
    cross_validated(tmp_path, fresh, {}, data, contexts)
    assert len(list((tmp_path / "folds").rglob("*.npz"))) == number == 2
    for count, (prior, options, context) in enumerate(
        [(MarkovPrior(3, 1), {}, contexts), (fresh, {"seed": 5}, contexts), (fresh, {}, 4)], 2
    ):
        other = data_of(monkeypatch, plans, **{"folds": 2, "seed": 4, "validation": 0.4} | options)
        cross_validated(tmp_path, prior, {}, other, context)
        assert len(list((tmp_path / "folds").rglob("*.npz"))) == 2 * count


def test_a_report_of_folds_takes_the_scores_of_the_folds(tmp_path, monkeypatch, capsys):
    plans = chain(48, group=torch.arange(48) % 6)
    data = data_of(monkeypatch, plans)
    model = PriorModel(lambda n: MarkovPrior(n, 1), data=data)
    fresh = MarkovPrior(3, 1)
    model.prior.fit(plans)
    report(tmp_path, model, data, fresh, {})
    scores = cross_validated(tmp_path, fresh, {}, data, None)
    rows = rows_of(tmp_path)
    for name, one in scores.items():
        row = rows["markov" if name == "trained" else name]
        assert row["bits_per_action"] == pytest.approx(one.bits_per_action().mean)
    assert "5 folds" in capsys.readouterr().out
