"""`python -m eval intentions`: exact inverse planning by hand, what is learned from mice, and a small run."""

import csv
import json
from collections import deque
from dataclasses import replace
from math import exp, log

import pandas as pd
import pytest
import torch

from eval.__main__ import main
from eval.intentions.grid import STAY, Agents, IntentionSettings, make_scene, policy_prior, progress, walk
from eval.intentions.mice import log_odds, regression, stretches
from eval.intentions.report import compared
from eval.worlds.labyrinth import DATA, arrives_within
from neuroprior import read_plans
from neuroprior.plans import Plans
from neuroprior.priors import infer
from neuroprior.worlds import maze
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")

SETTINGS = IntentionSettings(3, (4,), 10, (2, 4), (2,), 0.5, 0)
GRID = maze(7, 7, seed=1)
SCENE = make_scene(GRID, SETTINGS, seeded(0))


def distances(goal):
    """The number of moves from each cell to the goal, by breadth-first search."""
    found, queue = {goal: 0}, deque([goal])
    while queue:
        cell = queue.popleft()
        for before in (GRID.next_state == cell).any(1).nonzero()[:, 0].tolist():
            if before not in found:
                found[before] = found[cell] + 1
                queue.append(before)
    return found


GOALS = [int((row == 0).nonzero()) for row in SCENE.path]


def test_policies_are_softmax_of_optimal_values():
    for goal, path, policy in zip(GOALS, SCENE.path, SCENE.policies, strict=True):
        away = distances(goal)
        for cell in SCENE.free.tolist():
            assert path[cell] == away[cell]
            weights = [exp(-away[after] / 0.5) for after in GRID.next_state[cell].tolist()]
            expected = [weight / sum(weights) for weight in weights] + [0.0]
            if cell == goal:
                expected = [0.0] * STAY + [1.0]
            assert policy[cell].tolist() == pytest.approx(expected, abs=1e-12)


def test_infer_is_exact_inverse_planning():
    """With the policies as priors, `infer` gives Bayes' rule by direct enumeration, after every move."""
    goal = torch.tensor([0, 1, 2] * 4)
    plans, cells = walk(SCENE, goal[:, None].expand(-1, 40), seeded(1))
    found = infer([policy_prior(policy) for policy in SCENE.policies], plans).log_probs.exp()
    for b, length in enumerate(plans.lengths.tolist()):
        likelihood = [1.0, 1.0, 1.0]
        assert cells[b, length] == GOALS[goal[b]] or length == 40
        for t in range(length):
            at, action = int(cells[b, t]), int(plans.actions[b, t])
            likelihood = [p * float(SCENE.policies[k, at, action]) for k, p in enumerate(likelihood)]
            expected = [p / sum(likelihood) for p in likelihood]
            assert found[b, t + 1].tolist() == pytest.approx(expected, abs=1e-6)
    # Who passes a goal is not after it.
    passed = (cells[:, :-1] == GOALS[0]) & (goal != 0)[:, None] & plans.mask()
    assert passed.any()
    b, t = passed.nonzero()[0].tolist()
    assert found[b, t + 1, 0] == 0


def test_progress_and_scores():
    goal = torch.tensor([0, 2])
    _, cells = walk(SCENE, goal[:, None].expand(-1, 9), seeded(2))
    logits = progress(SCENE.path, cells)
    for b in range(2):
        for t in range(10):
            for k in range(3):
                away = distances(GOALS[k])
                assert logits[b, t, k] == away[int(cells[b, 0])] - away[int(cells[b, t])]
    agents = Agents(goal, torch.tensor([9, 3]))
    logits = torch.tensor([[0.7, 0.2, 0.1], [0.4, 0.2, 0.4]]).double().log()[:, None].expand(2, 10, 3)
    both, one = agents.scores(logits, (3, 5, 20))
    assert both["loss"] == pytest.approx(-(log(0.7) + log(0.4)) / 2)
    assert both["accuracy"] == pytest.approx((1 + 0.5) / 2)  # of two that are equally probable one is drawn
    assert (both["agents"], one["agents"]) == (2, 1)
    assert one["probability"] == pytest.approx(0.7)


def test_observers_are_compared_with_as_many_plans_and_exact_ones_with_all():
    rows = [("exact", None, 1.0), ("blind", 20, 3.0), ("blind", 40, 2.0), ("blind, tempered", 20, 2.5)]
    scored = pd.DataFrame(rows, columns=["kind", "plans", "loss"]).assign(world="g", measure="moves", at=4, seed=0)
    found = compared(scored)
    pairs = {(row.kind, row.minus, row.first, row.second) for row in found.itertuples()}
    assert pairs == {
        ("blind", "exact", 3.0, 1.0),
        ("blind", "exact", 2.0, 1.0),
        ("blind, tempered", "exact", 2.5, 1.0),
        ("blind, tempered", "blind", 2.5, 3.0),
    }


def test_stretches_lead_to_the_water():
    """Sequences of 100 moves that arrive at moves 9, 11 and 70, and at none."""
    arrives = torch.zeros(2, 100, dtype=torch.bool)
    arrives[0, [9, 11, 70]] = True
    number = torch.arange(200).view(2, 100) % 4
    plans = Plans(number, 4, context=torch.arange(200).view(2, 100))
    leads, others = stretches(plans, arrives)
    found = [some.context[some.mask()].tolist() for some in (leads, others)]
    assert leads.mask().sum(1).tolist() == [10, 2, 32]
    assert found[0] == [*range(12), *range(39, 71)]
    assert others.mask().sum(1).tolist() == [27, 69]  # of the last 31 moves it is not known
    assert found[1] == [*range(12, 39), *range(100, 169)]
    within = arrives_within(arrives, 4)
    assert within.nonzero().tolist() == [[0, t] for t in (*range(6, 12), *range(67, 71))]


def test_the_posterior_knows_past_moves_alone():
    plans = read_plans(DATA)
    learned, plans = plans[40:60], plans[:2]
    found = log_odds(learned, plans)
    changed = replace(plans, actions=plans.actions.clone(), context=plans.context.clone())
    changed.actions[:, 300:], changed.context[:, 300:] = 0, 5
    other = log_odds(learned, changed)
    assert other[:, :301].equal(found[:, :301])
    assert not other[:, 301:].allclose(found[:, 301:])


def test_regression_solves_its_equations():
    features = torch.randn(500, 2, generator=seeded(0), dtype=torch.double)
    happened = (torch.rand(500, generator=seeded(1)) < (features[:, 0] - 1).sigmoid()).double()
    weights = regression(features, happened)
    wrong = happened - (features @ weights[:-1] + weights[-1]).sigmoid()
    assert wrong.sum().abs() < 1e-9
    assert (features.T @ wrong).abs().max() < 1e-9


SMALL = ["intentions", "--worlds", "four_rooms", "--seeds", "2", "--goals", "3", "--num-plans", "4"]
SMALL += ["--agents", "30", "--observed", "2", "4", "--ahead", "2", "--processes", "1"]


def test_a_small_run(tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*SMALL, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    results = json.loads((out / "results.json").read_text())
    learned = {(kind + more, 4) for kind in ("cell", "blind") for more in ("", ", tempered")}
    expected = learned | {(kind, 0) for kind in ("exact", "uniform", "path", "straight")}
    for measure, times in (("moves", 2), ("way", 3)):
        rows = [row for row in results["rows"] if row["measure"] == measure and row["score"] == "loss"]
        assert {(row["kind"], row["plans"]) for row in rows} == expected
        assert len(rows) == times * len(expected)
        assert all(row["low"] <= row["value"] <= row["high"] and row["seeds"] == 2 for row in rows)
    uniform = [row["value"] for row in rows if row["kind"] == "uniform"]
    assert uniform == pytest.approx([log(3)] * 3)
    at = {
        (r["world"], r["measure"], r["kind"], r["plans"], r["at"]): r for r in results["rows"] if r["score"] == "loss"
    }
    for row in results["paired"]:
        place = row["world"], row["measure"]
        ends = [(row["kind"], row["plans"]), (row["minus"], 0 if row["minus"] == "exact" else row["plans"])]
        first, second = (at[*place, *end, row["at"]]["value"] for end in ends)
        assert row["difference"] == pytest.approx(first - second, abs=1e-9)
    assert {row["switch"] for row in results["rows"] if row["measure"] == "switched"} == {0.0, 0.05}
    assert {(row["kind"], row["plans"]) for row in results["calibration"]} == expected
    with open(out / "rows.csv") as file:
        assert [float(row["value"]) for row in csv.DictReader(file)] == [row["value"] for row in results["rows"]]
    assert (out / "intentions.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "report.html").exists()
    kept = {path: path.stat().st_mtime_ns for path in (out / "runs").rglob("*-*.json")}
    assert len(kept) == 2
    assert main([*SMALL, "--out", str(out)]) == 0  # finished runs are not done again
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
    assert capsys.readouterr().out == printed


@pytest.mark.slow
def test_in_the_labyrinth(tmp_path):
    how = ["--worlds", "labyrinth", "--seeds", "2", "--observed", "2", "--processes", "1"]
    assert main(["intentions", *how, "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    kinds = ["node", "node, move"]
    more = [(f"{kind}, {what}", kind) for kind in kinds for what in ("posterior", "modes")]
    loss = {row["kind"]: row["value"] for row in results["rows"] if row["score"] == "loss"}
    assert sorted(loss) == sorted([*kinds, *(kind for kind, _ in more)])
    assert loss["node, move"] < loss["node"]  # on the way in, or out
    assert {(row["kind"], row["minus"]) for row in results["paired"]} == set(more)
