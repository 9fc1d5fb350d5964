"""Cells of `eval compare`: curves with known values, starts, sights by number, and whole cells of small worlds."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path

import pytest
import torch

from eval.compare import run as compare_cell
from eval.compare.curves import TEMPERATURES, best_temperature, curve, planner_of, seconds_per_decision, starts_of
from eval.compare.run import digest, run_cell, run_growth
from eval.compare.settings import Settings
from eval.worlds.mid_plan import UnderWay
from eval.worlds.splits import Worlds, unlike
from eval.worlds.suite import TASKS, Task, best_score
from neuroprior import ExhaustivePlanner, MarkovPrior, TabularWorld, UniformPrior, collect, save
from neuroprior.worlds import cube, four_rooms, goal_direction, local_view, maze
from tests.support.sources import refuses, seeded

SMALL = Settings((4, 16), ("markov", "gru"), ("nothing", "each step"), 1, 3, 4, 30, 0)
TINY = Task(
    "tiny",
    ("left", "right", "forward"),
    "a small maze",
    partial(unlike, make=maze, height=5, width=5, num_layouts=3, egocentric=True, view=1),
    3,
    (5,),
    sees="the squares around it",
)


def bandit(actions: int, probability: float | None = None) -> TabularWorld:
    """One step: action 0 is rewarded, or, with chance, sometimes."""
    reward = torch.zeros(1, 1, actions)
    reward[..., 0] = 1.0
    if probability is None:
        return TabularWorld(torch.zeros(1, actions, dtype=torch.long), reward)
    chances = torch.tensor([probability, 1 - probability]).expand(1, actions, 2)
    outcomes = torch.zeros(1, 1, actions, 2)
    outcomes[..., 0] = 1.0
    return TabularWorld(torch.zeros(1, actions, 2, dtype=torch.long), outcomes, probability=chances)


def one_step(world: TabularWorld) -> Task:
    names = tuple(str(action) for action in range(world.num_actions))
    return Task("bandit", names, "one step", lambda seed: Worlds(world, world, world), 1, (1,), "return")


def test_the_curve_of_a_lottery():
    """One of five plans wins: n candidates hold it with 1 - 0.8 ** n. 4,096 draws at each of 50 starts; 6 errors."""
    world = bandit(5)
    starts = starts_of(one_step(world), world, 50, 1, seeded(0))
    budgets = [1, 2, 4, 8, 16]
    found = curve(starts, UniformPrior(5), [*budgets, 4096], seeded(1))
    for budget, share, at in zip(budgets, found.share, found.at_oracle, strict=False):
        truth = 1 - 0.8**budget
        error = (truth * (1 - truth) / (50 * 4096 // budget)) ** 0.5
        assert share == pytest.approx(truth, abs=6 * error)
        assert at == pytest.approx(share, abs=1e-9)
    assert found.share[-1] == found.at_oracle[-1] == 1.0


def test_with_chance_plans_count_for_what_they_are_worth():
    """All plans gain 1 with probability 0.3, some seem to gain more: the best of many is worth 0.3 still."""
    world = bandit(4, 0.3)
    starts = starts_of(one_step(world), world, 20, 1, seeded(0))
    found = curve(starts, UniformPrior(4), [1, 64], seeded(1))
    assert found.share == pytest.approx([1.0, 1.0])
    assert found.score == pytest.approx([0.3, 0.3])
    decision = planner_of(starts, UniformPrior(4), 64, 1.0).plan(world, starts.state, seeded(2))
    assert float(decision.score.mean()) > 0.3  # what the planner thinks


def test_a_share_lies_between_the_reference_and_the_oracle():
    """Rewards of -1 and -3: a random plan of two gets -4 in the mean, the best -2."""
    world = TabularWorld(torch.zeros(1, 2, dtype=torch.long), torch.tensor([[[-1.0, -3.0]]]))
    task = one_step(world)
    starts = starts_of(task, world, 200, 2, seeded(0))
    assert starts.best.tolist() == [-2.0] * 200
    assert starts.reference == pytest.approx(-4.0, abs=6 * (2 / 4000) ** 0.5)
    assert starts.share(torch.full((200,), -2.0)) == 1.0
    assert starts.share(torch.full((200,), starts.reference)) == 0.0


def test_starts_are_such_that_something_can_be_had():
    world = four_rooms(9, 9, num_layouts=4, reward="goal")
    task = replace(TASKS["four_rooms"], objective="return")
    starts = starts_of(task, world, 30, 4, seeded(0))
    assert starts.state.shape == (30,)
    assert float(starts.best.min()) > 0
    nothing = TabularWorld(torch.zeros(1, 2, dtype=torch.long), torch.zeros(1, 1))
    with refuses("only 0 of 6000 starts"):
        starts_of(task, nothing, 30, 4, seeded(0))


def test_the_oracle_of_the_cube():
    task, world = TASKS["cube"], cube(scramble=3, absorbing=True)
    state = world.reset(300, seeded(0))
    found = ExhaustivePlanner(3, **task.scoring).plan(world, state, seeded(1)).score
    assert torch.allclose(best_score(task, world, state, 3), found)


def test_the_best_temperature():
    """A prior that is nearly sure of a plan that fails finds the other one when it is hot."""
    world = bandit(2)
    starts = starts_of(one_step(world), world, 40, 1, seeded(0))
    sure = MarkovPrior(2, 0).fit(torch.tensor([[1]] * 97 + [[0]] * 3))
    assert best_temperature(starts, sure, 8, seeded(1)) == max(TEMPERATURES)
    right = MarkovPrior(2, 0).fit(torch.tensor([[0]] * 97 + [[1]] * 3))
    assert best_temperature(starts, right, 1, seeded(1)) == 1.0


def test_a_decision_is_timed_at_some_of_the_starts():
    world = bandit(3)
    starts = starts_of(one_step(world), world, 6, 1, seeded(0))
    timed = seconds_per_decision(starts, UniformPrior(3), [2, 8], 2, seeded(0), 1.0)
    assert [(budget, steps) for budget, (_, steps) in timed.items()] == [(2, 2), (8, 8)]
    assert all(0 < seconds < 5 for seconds, _ in timed.values())


@pytest.fixture(scope="module")
def cell() -> dict:
    return run_cell(TINY, 0, SMALL)


def test_a_cell_holds_every_prior_before_and_after_growth(cell):
    entries = [(one["prior"], one["sees"], one["rounds"]) for one in cell["entries"]]
    fitted = [f"markov-{order}" for order in range(5)] + ["gru"]
    expected = [(None, "nothing", 0), ("uniform", "nothing", 0)]
    expected += [(prior, sees, turn) for sees in ("nothing", "each step") for prior in fitted for turn in (0, 1)]
    assert entries == expected
    assert json.loads(json.dumps(cell))["budgets"] == [1, 2, 4, 8, 16]
    for one in cell["entries"][1:]:
        assert len(one["share"]) == len(one["at_oracle"]) == len(one["seconds"]) == 5
        assert one["share"] == sorted(one["share"])
        assert 0 < one["share"][0] <= one["share"][-1] <= 1 + 1e-12
        assert one["model_steps"] == [None, None, 20, None, 80]
        assert 0 < one["bits"] < 3
    growth = [(one["prior"], one["sees"], one["round"], one["length"]) for one in cell["growth"]]
    assert growth == [(p, s, r, (3, 5)[r]) for s in ("nothing", "each step") for p in fitted for r in (0, 1)]
    for matrix in cell["transitions"].values():
        assert torch.allclose(torch.tensor(matrix).sum(1), torch.ones(3))
    assert set(cell["plans"]["paths"]) == {"uniform", "markov-2", "gru"}
    assert torch.tensor(cell["plans"]["paths"]["gru"]).shape == (12, 6, 2)


def test_the_same_seed_gives_the_same_cell(cell):
    def told(found: dict) -> str:
        kept = {key: value for key, value in found.items() if key not in ("seconds", "entries")}
        entries = [{key: value for key, value in one.items() if key != "seconds"} for one in found["entries"]]
        return json.dumps(kept | {"entries": entries})

    assert told(run_cell(TINY, 0, SMALL)) == told(cell)
    assert told(run_cell(TINY, 1, SMALL)) != told(cell)


def test_a_world_says_what_is_seen_there_and_from_how_many_starts_plans_are_learned(monkeypatch):
    asked = []
    monkeypatch.setattr(compare_cell, "collect", lambda *given, **how: asked.append(given[2]) or collect(*given, **how))
    task = replace(TINY, sights=("nothing", "start"), times=3)
    found = run_cell(task, 0, replace(SMALL, kinds=("markov",), sees=(), rounds=0))
    assert {one["sees"] for one in found["entries"]} == {"nothing", "start"}
    assert sorted(asked) == [22, 90]


def test_who_looks_for_a_goal_sees_on_which_side_it_is():
    task = TASKS["goal_maze"]
    world = task.worlds(0).training
    state = world.reset(100, seeded(0))
    seen, away = world.observe(state), goal_direction(world)(state)
    assert torch.equal(seen[:, :24], local_view(world)(state))
    assert torch.equal(seen[:, 26:], away.sign())
    assert torch.allclose(seen[:, 24:26] * 15, away)
    assert all(near[-2:] == (26, 27) for near in task.near)


def test_starts_that_are_numbers_are_not_looked_at():
    """Where other states to start from are held out, the number of a start says nothing."""
    settings = replace(SMALL, kinds=("markov",), sees=("nothing", "start", "each step"), rounds=0)
    found = run_cell(TASKS["cliff"], 0, settings)
    assert {one["sees"] for one in found["entries"]} == {"nothing", "each step"}
    assert {one["sees"] for one in run_cell(TINY, 0, settings)["entries"]} == {"nothing", "start", "each step"}


def test_saved_priors_are_compared_as_they_are(tmp_path):
    plans = collect(ExhaustivePlanner(3), TINY.worlds(0).training, 40, generator=seeded(0))
    folder = str(save(MarkovPrior(3, 1).fit(plans), tmp_path / "mine"))
    found = run_cell(TINY, 0, replace(SMALL, kinds=(), priors=(folder,)))
    assert [one["prior"] for one in found["entries"]] == [None, "uniform", folder]
    assert found["growth"] == []


def test_growth_alone_with_lengths_of_its_own():
    settings = replace(SMALL, kinds=("markov",), sees=("nothing",), rounds=2, lengths=(4, 6), num_plans=(8,))
    found = run_growth(TINY, 0, settings)
    assert {(one["round"], one["length"]) for one in found["growth"]} == {(r, n) for r in range(3) for n in (3, 4, 6)}
    assert {one["num_plans"] for one in found["growth"]} == {8}


def test_the_recipe_is_the_same_in_every_process():
    told = "from eval.compare.run import *; from eval.worlds.suite import TASKS; print([recipe(), *map(digest, TASKS.values())])"
    said = [
        subprocess.run([sys.executable, "-c", told], env=os.environ | {"PYTHONHASHSEED": seed}, capture_output=True)
        for seed in ("1", "2")
    ]
    assert said[0].stdout == said[1].stdout != b""


def test_another_world_has_another_digest(monkeypatch):
    task = TASKS["maze"]
    same = digest(task)
    assert digest(replace(task, about="in other words")) == same
    others = [replace(task, times=3), replace(task, worlds=TASKS["egocentric"].worlds)]
    assert all(digest(other) != same for other in others)
    monkeypatch.setattr(compare_cell, "MAPS", 7)
    assert digest(task) != same


SEARCHED = [pytest.param(name, marks=pytest.mark.slow) for name in TASKS if name.startswith("minigrid")]


@pytest.mark.parametrize("name", [*(name for name in TASKS if not name.startswith("minigrid")), *SEARCHED])
def test_worlds_of_the_suite(name):
    """No two of the three worlds are the same, actions are named, and something can be had."""
    task = TASKS[name]
    assert task.name == name
    worlds = task.worlds(3)
    for world in worlds:
        assert world.num_actions == task.num_actions
        assert tuple(world.action_names) == task.action_names
        starts = starts_of(task, world, 5, task.length, seeded(0))
        assert float((starts.best - starts.reference).mean()) > 0
    for one, other in combinations(worlds, 2):
        if task.numbered:
            assert not bool(((one.starts > 0) & (other.starts > 0)).any())
        elif name == "cube":
            scrambles = [set(world.reset(2000, seeded(1)).tolist()) for world in (one, other)]
            assert not scrambles[0] & scrambles[1]
            assert min(map(len, scrambles)) > 1000
        else:
            inner = [world.world if isinstance(world, UnderWay) else world for world in (one, other)]
            tables = [torch.cat([world.next_state.flatten(), world.reward.flatten()]) for world in inner]
            assert not torch.equal(*tables)
    assert all(later > earlier for earlier, later in zip((task.depth, *task.lengths), task.lengths, strict=False))


def test_temperatures_are_chosen_where_priors_did_not_learn(monkeypatch):
    """Once for each prior and length, and neither in the worlds it learned in nor in those of the comparison."""
    chosen = []

    def spy(starts, prior, budget, generator):
        chosen.append(starts)
        return 1.0

    worlds = TINY.worlds(0)
    monkeypatch.setattr(compare_cell, "best_temperature", spy)
    run_cell(replace(TINY, worlds=lambda seed: worlds), 0, SMALL)
    assert all(starts.world is worlds.validation for starts in chosen)
    # Five chains and a network that see two ways: before growth at lengths 3 and 5, after it at 5.
    assert [sum(starts.length == length for starts in chosen) for length in (3, 5)] == [12, 24]


def test_the_worlds_are_told_as_they_are():
    told = (Path(__file__).parents[3] / "docs" / "compare.md").read_text()
    for task in TASKS.values():
        lengths, sights = ", ".join(map(str, task.lengths)), ", ".join(task.sights)
        row = (f"`{task.name}`", task.about, task.num_actions, task.depth, lengths, sights, task.times)
        assert f"| {' | '.join(map(str, row))} |" in told
