"""`python -m eval control`: a small run from end to end, what is chosen, and how many candidates are saved."""

import json
from math import inf, log

import numpy as np
import pandas as pd
import pytest
import torch

from eval.__main__ import main
from eval.control.animation import pictures
from eval.control.priors import check_prior_name, fitted, shuffled
from eval.control.report import candidates_needed, differences, interpolated, savings
from eval.control.run import NOISES, PROPOSALS, Choice, ControlSettings, chosen, planner_of
from eval.control.tasks import CONDITIONS, TASKS
from neuroprior.plans import VectorPlans
from neuroprior.worlds import PlanarArm
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")

SMALL = ["control", "--tasks", "double_integrator", "--seeds", "2", "--steps", "9", "--budgets", "4", "8"]
SMALL += ["--plain_budgets", "16"]
SMALL += ["--training_runs", "2", "--training_budget", "4", "--tuning_budget", "4", "--processes", "1"]
SMALL += ["--priors", "none", "autoregressive", "synergies-2"]


def test_a_small_run(tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*SMALL, "--planners", "shooting", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    results = json.loads((out / "results.json").read_text())
    places = {(row["condition"], row["planner"], row["prior"], row["budget"]) for row in results["rows"]}
    assert places == {
        (condition, "shooting", prior, budget)
        for condition in CONDITIONS
        for prior in ("none", "autoregressive", "synergies-2")
        for budget in ((4, 8, 16) if prior == "none" else (4, 8))
    }
    assert all((row["sampling"] > 0) == (row["prior"] != "none") for row in results["rows"])
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
    assert {row["prior"] for row in results["likelihoods"]} == {"autoregressive", "synergies-2"}
    assert (out / "double_integrator-shooting.png").read_bytes().startswith(b"\x89PNG")
    kept = {path: path.stat().st_mtime_ns for path in out.rglob("double_integrator-*.json")}
    assert len(kept) == 3
    assert main([*SMALL, "--planners", "shooting", "--out", str(out)]) == 0  # finished runs are not done again
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
    assert capsys.readouterr().out == printed


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--priors", "none", "wizard"], "wizard"),
        (["--priors", "none", "gru-4"], "gru-4"),
        (["--priors", "stored"], "none"),
        (["--budgets", "8", "8"], "budgets"),
        (["--tasks", "chess"], "chess"),
        (["--planners", "astar"], "astar"),
    ],
)
def test_bad_options_get_one_line(options, said, tmp_path, capsys):
    assert main(["control", *options, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error


def test_candidates_needed_by_hand():
    """Interpolated in the logarithm of the budget; the least tried where it suffices, infinite where none does."""
    budgets = np.array([8.0, 16.0, 32.0, 128.0])
    assert candidates_needed(budgets, np.array([0.0, 4.0, 6.0, 7.0]), 5) == pytest.approx(16 * 2**0.5)
    assert candidates_needed(budgets, np.array([5.0, 5.0, 5.0, 5.0]), 5) == 8
    assert candidates_needed(budgets, np.array([4.0, 4.0, 4.0, 4.9]), 5) == inf
    plain = np.array([1.0, 2.0, 3.0, 5.0])
    at_64 = interpolated(64, budgets, plain)
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


def test_a_moving_picture_without_its_simulator_is_refused_before_anything_is_done(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("eval.control.tasks.find_spec", lambda name: None)
    assert main([*SMALL, "--animation", "hopper", "--out", str(tmp_path / "out")]) == 2
    assert 'hopper needs mujoco: pip install "neuroprior[mujoco]"' in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_settings_are_chosen_by_their_mean_over_validation_seeds():
    settings = ControlSettings(("shooting",), ("none", "stored"), (8,), (), 10, 1, 8, 8, 0)
    first, second = [0.0] * len(NOISES), [0.0] * len(NOISES)
    first[1], second[1], second[4] = 3.0, 1.0, 3.5  # means 2 and 1.75
    shares = [{"stored": [0.0, 1.0, 5.0, 0.0, 0.0]}, {"stored": [0.0, 6.0, 1.0, 0.0, 0.0]}]
    results = [
        {"plain": {"icem": [*first[1:], 0.0], "shooting": plain}, "with_prior": {"shooting": some}}
        for plain, some in ((first, shares[0]), (second, shares[1]))
    ]
    found = chosen(results, settings)
    assert found["shooting"]["none"] == Choice(*NOISES[1])
    assert found["shooting"]["stored"] == Choice(*NOISES[1])._replace(**PROPOSALS[1])
    assert found["icem"]["none"] == Choice(*NOISES[0])
    choice = Choice(0.4, 2.0, 0.25, 0, "noise")
    planner = planner_of("icem", 5, 30, choice, fitted("noise", _plans(), 5, seeded(0)))
    assert (planner.std, planner.noise_beta, planner.prior_share, planner.prior_as) == (0.4, 2.0, 0.25, "noise")
    assert planner.prior_iterations == len(planner.populations)
    assert planner_of("icem", 5, 30, Choice(0.4, 2.0, 0.25, 1), planner.prior).prior_iterations == 1
    assert planner_of("shooting", 5, 30, Choice(0.4, 2.0, 0.25, 1), None).prior_share == 0


def _plans(num=4, length=30):
    values = torch.rand(num, length, 2, generator=seeded(0)).cumsum(1) / length
    return VectorPlans(
        values, -torch.ones(2), torch.ones(2), torch.tensor([length, 20, length, 5]), context=values[..., :1]
    )


def test_shuffled_plans_have_the_same_vectors_in_another_order():
    plans = _plans()
    mixed = shuffled(plans, seeded(1))
    for one, other, length in zip(plans.actions, mixed.actions, plans.mask().sum(1).tolist(), strict=True):
        assert not one[:length].equal(other[:length])
        assert one[:length, 0].sort().values.equal(other[:length, 0].sort().values)
    chain, control = (fitted(name, plans, 5, seeded(0)) for name in ("autoregressive", "shuffled"))
    blind = plans.without_context()
    assert chain.log_prob(blind).sum() > control.log_prob(blind).sum() + 50


def test_names_of_priors():
    for name in ("none", "stored", "synergies-4", "step-synergies-1", "cloning", "shuffled"):
        check_prior_name(name)
    assert fitted("step-synergies-1", _plans(), 5, seeded(0)).num_components == 1
    assert fitted("synergies-3", _plans(), 5, seeded(0)).config["window"] == 5
    for name in ("synergies-0", "stored-3", "-4", ""):
        with pytest.raises(ValueError, match="priors: one of"):
            check_prior_name(name)


def test_every_condition_changes_what_it_says():
    for name in ("arm", "double_integrator"):
        same, masses, goal = (TASKS[name].make(condition) for condition in CONDITIONS)
        state = same.reset(5, seeded(0))
        plans = torch.ones(5, 1, 4, same.action_size) * same.action_high
        results = [world.rollout(state, plans) for world in (same, masses, goal)]
        assert not results[0].final_state.allclose(results[1].final_state)
        assert results[0].final_state.equal(results[2].final_state)
        assert not results[0].rewards.allclose(results[2].rewards)


def test_pictures_of_an_arm():
    world = PlanarArm()
    frames = pictures(world, world.reset(3, seeded(0)))
    assert len(frames) == 3
    assert frames[0].shape == (240, 240, 3)
    assert frames[0].std() > 0
    with pytest.raises(ValueError, match="no picture"):
        pictures(TASKS["double_integrator"].make("same"), torch.zeros(1, 4))
