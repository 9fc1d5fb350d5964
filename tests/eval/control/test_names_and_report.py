"""The control experiment: what its smallest settings give, and names that it does not know."""

import json

import pytest

from eval.control.command import control_experiment
from eval.control.priors import check_prior_name


@pytest.mark.parametrize("seeds", [1, 2])
def test_the_plain_planner_alone_has_a_report(tmp_path, seeds, capsys):
    control_experiment(
        ["double_integrator"],
        ["none"],
        budgets=[4],
        seeds=seeds,
        steps=2,
        training_runs=1,
        training_budget=4,
        tuning_budget=4,
        plain_budgets=[4],
        processes=1,
        out=str(tmp_path),
    )
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert {(row["prior"], row["condition"]) for row in rows} == {
        ("none", condition) for condition in ("same", "masses", "goal")
    }
    page = (tmp_path / "report.html").read_text()
    for condition in ("same", "masses", "goal"):  # tables of one task can be told apart
        assert f"<strong>double_integrator, {condition}, icem: return by candidates a decision.</strong>" in page


@pytest.mark.parametrize("name", ["synergies-0", "synergies-\u00b2", "synergies-", "gru-4", "-4", "", "Stored"])
def test_names_that_are_none(name):
    with pytest.raises(ValueError, match="priors: one of"):
        check_prior_name(name)
