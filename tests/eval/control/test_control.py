"""`python -m eval control`: a small run from end to end, what is chosen, and how many candidates are saved."""

import json
from math import inf, log
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch

from eval.__main__ import main
from eval.control.comparison import against_simple, candidates_needed, differences, interpolate, savings
from eval.control.priors import fit_prior, shuffle_steps
from eval.control.run import (
    EXPONENTS,
    STDS,
    Choice,
    Collecting,
    ControlSettings,
    Planning,
    Tuning,
    collecting_run,
    make_planner,
    planning_run,
    tuning_run,
)
from eval.control.tasks import CONDITIONS, TASKS
from neuroprior.control import VectorPlans
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")

SMALL = ["control", "--tasks", "double_integrator", "--seeds", "2", "--steps", "9", "--budgets", "4", "8"]
SMALL += ["--plain_budgets", "16"]
SMALL += ["--training_runs", "2", "--training_budget", "4", "--tuning_budget", "4", "--processes", "1"]
SMALL += ["--priors", "none", "autoregressive", "synergies"]


def test_a_small_run(tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*SMALL, "--planners", "shooting", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    results = json.loads((out / "results.json").read_text())
    places = {(row["condition"], row["planner"], row["prior"], row["budget"]) for row in results["rows"]}
    assert places == {
        (condition, "shooting", prior, budget)
        for condition in CONDITIONS
        for prior in ("none", "autoregressive", "synergies")
        for budget in ((4, 8, 16) if prior == "none" else (4, 8))
    }
    assert len(results["rows"]) == len(places)
    at = {(r["condition"], r["planner"], r["prior"], r["budget"]): r for r in results["rows"]}
    for row in results["rows"]:
        assert row["task"] == "double_integrator"
        assert row["low"] <= row["return"] <= row["high"]
        assert row["seconds"] > 0
    for row in results["paired"]:
        place = row["condition"], row["planner"], row["prior"], row["budget"]
        plain = at[(*place[:2], "none", place[3])]
        assert row["difference"] == pytest.approx(at[place]["return"] - plain["return"], abs=1e-6)
    assert {row["prior"] for row in results["likelihoods"]} == {"autoregressive", "synergies"}
    assert (out / "double_integrator-shooting.png").read_bytes().startswith(b"\x89PNG")
    page = (out / "report.html").read_text()
    for condition in CONDITIONS:  # tables of one task can be told apart
        assert f"<strong>double_integrator, {condition}, shooting: return by candidates a decision.</strong>" in page
    kept = {path: path.stat().st_mtime_ns for path in out.glob("*/*/double*")}
    # Settings of iCEM, of the planner, and of the planner with each prior; plans to learn from and others; runs.
    assert len(list(out.glob("tuning/*/double*.json"))) == 4
    assert len(list(out.glob("plans/*/double*.npz"))) == 2 * 2
    assert len(list(out.glob("planning/*/double*.json"))) == 2 * 3 * 3
    assert len(list(out.glob("scoring/*/double*.json"))) == 2 * 2
    assert main([*SMALL, "--planners", "shooting", "--out", str(out)]) == 0
    assert capsys.readouterr().out == printed
    # A prior and a condition less, and a prior that is only scored: what is finished is not done again.
    less = [name for name in SMALL if name != "synergies"] + ["--planners", "shooting", "--out", str(out)]
    assert main([*less, "--scored", "stored", "--conditions", "masses", "goal"]) == 0
    results = json.loads((out / "results.json").read_text())
    assert {row["prior"] for row in results["likelihoods"]} == {"autoregressive", "stored"}
    assert {row["condition"] for row in results["rows"]} == {"masses", "goal"}
    assert {row["prior"] for row in results["rows"]} == {"none", "autoregressive"}
    assert all(path.stat().st_mtime_ns == time for path, time in kept.items())
    assert len(list(out.glob("scoring/*/double*-stored-*.json"))) == 2


def test_a_prior_that_proposes_nothing_leaves_the_plain_planner_as_it_is():
    settings = ControlSettings((4, 8), (16,), 6, 2, 4, 4, 1, seed=3)
    plans = collecting_run(Collecting("double_integrator", 0, Choice(0.3, 1.0)), settings)

    def returns(prior, choice):
        run = Planning("double_integrator", 0, "masses", "icem", prior, choice, plans)
        return [entry["return"] for entry in planning_run(run, settings)]

    plain = returns("none", Choice(0.3, 1.0))
    assert returns("autoregressive", Choice(0.3, 1.0)) == plain[:2]
    assert returns("autoregressive", Choice(0.3, 1.0, share=0.5)) != plain[:2]


def test_nothing_is_called_significant_with_fewer_than_five_seeds():
    rng = np.random.default_rng(0)
    for seeds in (4, 5):
        frame = made_up(seeds).assign(**{"return": lambda rows: rows["return"] + 1e-3 * rng.random(len(rows))})
        verdicts = differences(frame)["p_holm"]
        assert verdicts.isna().all() if seeds == 4 else (verdicts < 0.05).all()


def test_candidates_needed_by_hand():
    """Interpolated in the logarithm of the budget; the least tried where it suffices, infinite where none does."""
    budgets = np.array([8.0, 16.0, 32.0, 128.0])
    assert candidates_needed(budgets, np.array([0.0, 4.0, 6.0, 7.0]), 5) == pytest.approx(16 * 2**0.5)
    assert candidates_needed(budgets, np.array([5.0, 5.0, 5.0, 5.0]), 5) == 8
    assert candidates_needed(budgets, np.array([4.0, 4.0, 4.0, 4.9]), 5) == inf
    plain = np.array([1.0, 2.0, 3.0, 5.0])
    at_64 = interpolate(64, budgets, plain)
    assert at_64 == pytest.approx(3 + 2 * log(2) / log(4))
    assert candidates_needed(budgets, plain, at_64) == pytest.approx(64)


def made_up(seeds=6):
    rows = [
        {"world": "w", "task": "w", "seed": seed, "condition": "same", "planner": "icem", "prior": prior}
        | {"budget": budget, "return": value + seed, "seconds": budget * (1 if prior == "none" else 2)}
        for seed in range(seeds)
        for prior, values in (("none", (1, 2, 3)), ("good", (2, 4, 5)), ("bad", (0, 0, 1)))
        for budget, value in zip((25, 50, 100), values, strict=True)
    ]
    return pd.DataFrame(rows)


def test_savings_and_differences_of_made_up_returns():
    """Seeds differ by as much for all, so that every resample of seeds gives the same."""
    saved = savings(made_up()).set_index("prior")
    assert saved.loc["good", "reference"] == 100
    assert saved.loc["good", ["needed", "low", "high"]].tolist() == pytest.approx([25 * 2**0.5] * 3)
    assert saved.loc["bad", ["needed", "low", "high"]].tolist() == [inf] * 3
    # Between 50 and 100 units of time, at the geometric middle of 25 and 50 candidates.
    assert saved.loc["good", "faster"] == pytest.approx(100 / 75)
    assert np.isnan(saved.loc["bad", "faster"])
    assert savings(made_up(4))["low"].isna().all()
    gaps = differences(made_up()).set_index(["prior", "budget"])
    assert gaps.loc[("good", 50), "difference"] == 2
    assert gaps.loc[("bad", 100), "high"] == -2


def test_the_reference_is_a_number_of_candidates_that_was_tried():
    """With 200 and more in all runs, nothing is known of 100."""
    more = made_up().assign(budget=lambda rows: rows["budget"] * 8)
    saved = savings(more).set_index("prior")
    assert saved["reference"].tolist() == [200, 200]
    assert saved.loc["good", "needed"] == 200  # reaches there, with the fewest that were tried, more than the plain one


def test_the_plain_planner_alone_has_a_report(tmp_path):
    plain = [*SMALL[: SMALL.index("--priors")], "--priors", "none", "--out", str(tmp_path)]
    assert main(plain) == 0
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert {(row["prior"], row["condition"]) for row in rows} == {("none", condition) for condition in CONDITIONS}


def test_a_task_without_its_simulator_is_refused_before_anything_is_done(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("eval.control.tasks.find_spec", lambda name: None)
    assert main([*SMALL, "--tasks", "hopper", "--out", str(tmp_path / "out")]) == 2
    assert 'hopper needs mujoco: pip install "neuroprior[mujoco]"' in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_networks_are_compared_with_the_best_prior_that_is_none():
    values = {"noise": 3.0, "stored": 1.0, "shuffled": 9.0, "gru": 5.0, "cloning": 2.0}
    frame = pd.DataFrame(
        [
            {"world": world, "seed": seed, "prior": prior, "nats": value + seed + 0.1 * (seed % 2) * (prior == "gru")}
            for world in "ab"
            for seed in range(6)
            for prior, value in values.items()
        ]
    )
    found = against_simple(frame, ["world"], "nats").set_index(["world", "prior"])
    assert set(found["baseline"]) == {"noise"}
    assert found.loc[("b", "gru"), "difference"] == pytest.approx(2.05)
    assert found.loc[("b", "gru"), "p_holm"] < 0.05
    assert found.loc[("a", "cloning"), "difference"] == pytest.approx(-1)
    assert len(against_simple(frame[frame["prior"] == "noise"], ["world"], "nats")) == 0


def test_settings_are_chosen_by_their_returns_over_both_worlds(monkeypatch):
    """Returns of both worlds count alike, although those of one are a hundred times as large."""
    settings = ControlSettings((8,), (), 10, 1, 8, 8, 2, 0)
    worlds, asked = {}, []
    for name in ("same", "validation"):
        worlds[TASKS["double_integrator"].make(name).mass] = name

    def returned(planner, world, settings, seed, starts):
        asked.append((planner.std, planner.noise_beta, planner.prior_share, planner.prior_as))
        value = {0.12: (100, 1), 0.3: (99, 5)}.get(planner.std, (50, 0.5))[worlds[world.mass] == "validation"]
        more = 1 + (planner.noise_beta == EXPONENTS[2]) + (planner.prior_as == "noise")
        return SimpleNamespace(rewards=torch.full((starts, 1), float(value * more)))

    monkeypatch.setattr("eval.control.run.control_starts", returned)
    alone = tuning_run(Tuning("double_integrator", "icem"), settings)
    assert alone == Choice(0.3, EXPONENTS[2])
    assert {std for std, *_ in asked} == set(STDS)
    monkeypatch.setattr("eval.control.run.collecting_run", lambda *_: _plans())
    found = tuning_run(Tuning("double_integrator", "icem", "autoregressive", (alone, alone)), settings)
    assert found == alone._replace(share=0.5, proposes="noise")
    # Where all proposals are worse, the planner is left alone.
    monkeypatch.setattr(
        "eval.control.run.control_starts",
        lambda planner, *_: SimpleNamespace(rewards=torch.full((1, 1), 1.0 - planner.prior_share)),
    )
    assert tuning_run(Tuning("double_integrator", "icem", "autoregressive", (alone, alone)), settings) == alone


def test_planners_have_the_settings_that_were_chosen():
    choice = Choice(0.4, 2.0, 0.25, 0, "noise")
    planner = make_planner("icem", 5, 30, choice, fit_prior("noise", _plans(), 5, seeded(0)))
    assert (planner.std, planner.noise_beta, planner.prior_share, planner.prior_as) == (0.4, 2.0, 0.25, "noise")
    assert planner.prior_iterations == len(planner.populations)
    assert make_planner("icem", 5, 30, Choice(0.4, 2.0, 0.25, 1), planner.prior).prior_iterations == 1
    assert make_planner("shooting", 5, 30, Choice(0.4, 2.0, 0.25, 1), None).prior_share == 0


def _plans(num=4, length=30):
    values = torch.rand(num, length, 2, generator=seeded(0)).cumsum(1) / length
    return VectorPlans(
        values, -torch.ones(2), torch.ones(2), torch.tensor([length, 20, length, 5]), context=values[..., :1]
    )


def test_shuffled_plans_have_the_same_vectors_in_another_order():
    plans = _plans()
    mixed = shuffle_steps(plans, seeded(1))
    for one, other, length in zip(plans.actions, mixed.actions, plans.mask().sum(1).tolist(), strict=True):
        assert not one[:length].equal(other[:length])
        assert one[:length, 0].sort().values.equal(other[:length, 0].sort().values)
    chain, control = (fit_prior(name, plans, 5, seeded(0)) for name in ("autoregressive", "shuffled"))
    blind = plans.without_context()
    assert chain.log_prob(blind).sum() > control.log_prob(blind).sum() + 50


def test_every_condition_changes_what_it_says():
    for name in ("arm", "double_integrator"):
        same, masses, goal = (TASKS[name].make(condition) for condition in CONDITIONS)
        state = same.reset(5, seeded(0))
        plans = torch.ones(5, 1, 4, same.action_size) * same.action_high
        results = [world.rollout(state, plans) for world in (same, masses, goal)]
        assert not results[0].final_state.allclose(results[1].final_state)
        assert results[0].final_state.equal(results[2].final_state)
        assert not results[0].rewards.allclose(results[2].rewards)
