"""Runs of `eval compare`: curves with known values, starts, and whole runs in small worlds."""

import csv
import json
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path

import pytest
import torch

from eval.compare import run as run_module
from eval.compare.beside import put_beside
from eval.compare.curves import (
    SETTINGS,
    Sampling,
    best,
    curve,
    planner_of,
    tried,
)
from eval.compare.run import Contest, Settings, compare_run, curriculum_run
from eval.worlds.mid_plan import MidPlanWorld
from eval.worlds.runs import Run
from eval.worlds.splits import Worlds, from_seeds
from eval.worlds.starts import starts_of
from eval.worlds.suite import TASKS, Task, best_score
from neuroprior import ExhaustivePlanner, MarkovPrior, TabularWorld, UniformPrior, collect, save
from neuroprior.priors import MixturePrior
from neuroprior.worlds import cube, four_rooms, goal_direction, local_view, maze
from tests.support.sources import refuses, seeded

SMALL = Settings((4, 16), ("markov", "gru"), ("none", "per-step"), 1, 3, 4, 30, 0)
TINY = Task(
    ("left", "right", "forward"),
    "a small maze",
    partial(from_seeds, make=maze, height=5, width=5, num_layouts=3, egocentric=True, view=1),
    3,
    (5,),
    observation="the squares around it",
)


def run_in(task: Task, seed: int, settings: Settings) -> dict:
    return compare_run(Run("tiny", seed), settings, {"tiny": task})


def bandit(actions: int, probability: float | None = None) -> TabularWorld:
    """One step: action 0 is rewarded, always or with a probability."""
    reward = torch.zeros(1, 1, actions)
    reward[..., 0] = 1.0
    if probability is None:
        return TabularWorld(torch.zeros(1, actions, dtype=torch.long), reward)
    probabilities = torch.tensor([probability, 1 - probability]).expand(1, actions, 2)
    outcomes = torch.zeros(1, 1, actions, 2)
    outcomes[..., 0] = 1.0
    return TabularWorld(torch.zeros(1, actions, 2, dtype=torch.long), outcomes, probability=probabilities)


def one_step(world: TabularWorld) -> Task:
    names = tuple(str(action) for action in range(world.num_actions))
    return Task(names, "one step", lambda seed: Worlds(world, world, world), 1, (1,), "return")


def test_plans_are_learned_in_training_worlds_and_bits_are_of_held_out_ones():
    """In each kind of world another action is best."""
    worlds = []
    for best_action in range(3):
        reward = torch.zeros(1, 1, 3)
        reward[..., best_action] = 1.0
        worlds.append(TabularWorld(torch.zeros(1, 3, dtype=torch.long), reward))
    made = Worlds(*worlds)
    task = replace(one_step(made.training), worlds=lambda seed: made)
    contest = Contest(Run("three", 0), task, SMALL)
    found = contest.first, contest.held_out_plans
    due = [next(k for k, one in enumerate(worlds) if one is world) for world in (made.training, made.held_out)]
    assert [plans.actions.unique().tolist() for plans in found] == [[action] for action in due]


def test_the_curve_of_a_lottery():
    """One of five plans wins: n candidates hold it with 1 - 0.8 ** n. 4,096 draws at each of 50 starts; 6 errors."""
    world = bandit(5)
    starts = starts_of(one_step(world), world, 50, 1, seeded(0))
    budgets = [1, 2, 4, 8, 16]
    found = curve(starts, UniformPrior(5), seeded(1), Sampling(), [*budgets, 4096])
    for budget, share, at in zip(budgets, found["share"], found["at_oracle"], strict=False):
        truth = 1 - 0.8**budget
        error = (truth * (1 - truth) / (50 * 4096 // budget)) ** 0.5
        assert share == pytest.approx(truth, abs=6 * error)
        assert at == pytest.approx(share, abs=1e-9)
    assert found["share"][-1] == found["at_oracle"][-1] == 1.0


def test_in_stochastic_worlds_plans_count_for_their_expected_score():
    """All plans gain 1 with probability 0.3, some seem to gain more: the best of many is worth 0.3 still."""
    world = bandit(4, 0.3)
    starts = starts_of(one_step(world), world, 20, 1, seeded(0))
    found = curve(starts, UniformPrior(4), seeded(1), Sampling(2.0, 0.3), [1, 64])
    assert found["share"] == pytest.approx([1.0, 1.0])
    assert found["score"] == pytest.approx([0.3, 0.3])
    decision = planner_of(starts, UniformPrior(4), 64, Sampling()).plan(world, starts.state, seeded(2))
    assert float(decision.score.mean()) > 0.3  # as the planner estimates


def test_normalised_scores_lie_between_the_reference_and_the_optimum():
    """Rewards of -1 and -3: a random plan of two gets -4 in the mean, the best -2."""
    world = TabularWorld(torch.zeros(1, 2, dtype=torch.long), torch.tensor([[[-1.0, -3.0]]]))
    task = one_step(world)
    starts = starts_of(task, world, 200, 2, seeded(0))
    assert starts.best.tolist() == [-2.0] * 200
    assert starts.reference == pytest.approx(-4.0, abs=6 * (2 / 4000) ** 0.5)
    assert starts.normalised(torch.full((200,), -2.0)) == 1.0
    assert starts.normalised(torch.full((200,), starts.reference)) == 0.0


def test_from_all_starts_something_can_be_reached():
    world = four_rooms(9, 9, num_layouts=4, reward="goal")
    task = replace(TASKS["four_rooms"], objective="return")
    starts = starts_of(task, world, 30, 4, seeded(0))
    assert starts.state.shape == (30,)
    assert float(starts.best.min()) > 0
    nothing = TabularWorld(torch.zeros(1, 2, dtype=torch.long), torch.zeros(1, 1))
    with refuses("only 0 of 6000 starts"):
        starts_of(task, nothing, 30, 4, seeded(0))


def test_the_optimum_of_the_cube():
    task, world = TASKS["cube"], cube(scramble=3, absorbing=True)
    state = world.reset(300, seeded(0))
    found = ExhaustivePlanner(3, **task.scoring).plan(world, state, seeded(1)).score
    assert torch.allclose(best_score(task, world, state, 3), found)


def nearly_sure_of(action: int) -> MarkovPrior:
    return MarkovPrior(2, 0).fit(torch.tensor([[action]] * 97 + [[1 - action]] * 3))


def test_the_curve_of_uniform_plans_among_others():
    """Of n candidates half are uniform: one wins with 1 - 0.5 ** (n / 2), as the others hardly do."""
    world = bandit(2)
    starts = starts_of(one_step(world), world, 50, 1, seeded(0))
    sure = MarkovPrior(2, 0, smoothing=1e-9, backoff="dirichlet").fit(torch.ones(99, 1, dtype=torch.long))
    found = curve(starts, sure, seeded(1), Sampling(1.0, 0.5), [2, 4, 1024])["share"]
    for share, number in zip(found, (2, 4), strict=False):
        truth = 1 - 0.5 ** (number / 2)
        assert share == pytest.approx(truth, abs=6 * (truth * (1 - truth) / (50 * 1024 // number)) ** 0.5)
    assert curve(starts, sure, seeded(1), Sampling(), [1024])["share"] == [0]


def test_the_best_way_of_sampling():
    """A prior that is nearly sure of a plan that fails finds the other one when it is hot, or by uniform plans."""
    world = bandit(2)
    starts = starts_of(one_step(world), world, 40, 1, seeded(0))
    tables = tried(starts, nearly_sure_of(1), seeded(1), (1, 8))
    assert {tuple(table) for table in tables.values()} == {SETTINGS}
    assert best([tables[8]]) == Sampling(2.0, 0.3)
    assert tables[8][Sampling(2.0)] > tables[8][Sampling(1.0)]
    assert tables[8][Sampling(1.0, 0.3)] > tables[8][Sampling(1.0)]
    # A share of a single plan is none: of equals the first.
    assert best([tables[1]]).uniform_share == 0
    assert best(tried(starts, nearly_sure_of(0), seeded(1), (1,)).values()) == Sampling(1.0, 0.0)


def test_the_mean_over_numbers_of_candidates_decides():
    one, two = Sampling(1.0), Sampling(2.0)
    assert best([{one: 0.9, two: 0.2}, {one: 0.1, two: 0.7}]) == one
    assert best([{one: 0.9, two: 0.2}, {one: 0.1, two: 0.9}]) == two
    assert replace(SMALL, num_plans=(4, 16)).validated == [4, 16]
    assert replace(SMALL, num_plans=(64, 256, 1024)).validated == [64, 256]
    assert replace(SMALL, num_plans=(1024,)).validated == [256]


def test_an_expert_of_a_mixture_may_propose_alone():
    """The mixture hardly heeds the expert that knows the plan that wins."""
    world = bandit(2)
    starts = starts_of(one_step(world), world, 40, 1, seeded(0))
    mixture = MixturePrior(2, [nearly_sure_of(1), nearly_sure_of(0)])
    mixture.first = torch.tensor([0.99, 0.01]).log()
    tables = tried(starts, mixture, seeded(1), (8,))
    assert len(tables[8]) == 3 * len(SETTINGS)
    chosen = best(tables.values())
    assert chosen.proposer == 2
    assert planner_of(starts, mixture, 8, chosen).prior is mixture.experts[1]
    assert planner_of(starts, mixture, 8, chosen._replace(proposer=0)).prior is mixture
    # Of 4 candidates the expert misses with 0.03 ** 4, the mixture with 0.95 ** 4.
    how = [1, 4], mixture, seeded(2)
    alone, whole = (curve(starts, how[1], how[2], Sampling(proposer=who), how[0])["share"][1] for who in (2, 0))
    assert alone > 0.97
    assert whole < 0.6


def test_settings_that_are_tried_score_as_in_the_curve():
    world = bandit(4)
    starts = starts_of(one_step(world), world, 40, 1, seeded(0))
    prior, one = MarkovPrior(4, 0).fit(torch.tensor([[1]] * 40 + [[0]] * 9)), Sampling(1.5, 0.3)
    table = tried(starts, prior, seeded(1), (4, 16), (one,))
    found = curve(starts, prior, seeded(1), one, [4, 16])
    assert found["share"] == [table[number][one] for number in (4, 16)]


@pytest.fixture(scope="module")
def run() -> dict:
    return run_in(TINY, 0, SMALL)


def test_a_run_holds_every_prior_before_and_after_the_curriculum(run):
    entries = [(one["prior"], one["context"], one["rounds"]) for one in run["entries"]]
    fitted = [f"markov-{order}" for order in range(5)] + ["gru"]
    expected = [(None, "none", 0), ("uniform", "none", 0)]
    expected += [(prior, context, turn) for context in ("none", "per-step") for prior in fitted for turn in (0, 1)]
    assert entries == expected
    assert json.loads(json.dumps(run))["budgets"] == [1, 2, 4, 8, 16]
    for one in run["entries"][1:]:
        assert len(one["share"]) == len(one["at_oracle"]) == len(one["seconds"]) == 5
        assert Sampling(one["temperature"], one["uniform_share"]) in SETTINGS
        assert one["alone"] == 0
        if not one["uniform_share"]:  # else larger blocks are not made of smaller ones
            assert one["share"] == sorted(one["share"])
        assert 0 < one["share"][0] <= one["share"][-1] <= 1 + 1e-12
        assert one["model_steps"] == [None, None, 20, None, 80]
        assert 0 < one["bits"] < 3
    curriculum = [(one["prior"], one["context"], one["round"], one["length"]) for one in run["curriculum"]]
    assert curriculum == [(p, s, r, (3, 5)[r]) for s in ("none", "per-step") for p in fitted for r in (0, 1)]
    for matrix in run["transitions"].values():
        assert torch.allclose(torch.tensor(matrix).sum(1), torch.ones(3))
    assert set(run["plans"]["paths"]) == {"uniform", "markov-2", "gru"}
    assert torch.tensor(run["plans"]["paths"]["gru"]).shape == (12, 6, 2)


def test_the_same_seed_gives_the_same_results(run):
    def results(found: dict) -> str:
        kept = {key: value for key, value in found.items() if key not in ("seconds", "entries")}
        entries = [{key: value for key, value in one.items() if key != "seconds"} for one in found["entries"]]
        return json.dumps(kept | {"entries": entries})

    assert results(run_in(TINY, 0, SMALL)) == results(run)
    other = run_in(TINY, 1, replace(SMALL, kinds=(), context=("none",)))
    for found, same in zip(other["entries"], run["entries"], strict=False):  # what needs no training
        assert found["prior"] == same["prior"]
        assert found["share"] != same["share"]


def test_a_world_decides_contexts_and_the_number_of_training_starts(monkeypatch):
    asked = []
    monkeypatch.setattr(run_module, "collect", lambda *given, **how: asked.append(given[2]) or collect(*given, **how))
    task = replace(TINY, contexts=("none", "initial"), start_factor=3)
    found = run_in(task, 0, replace(SMALL, kinds=("markov",), context=(), rounds=0))
    assert {one["context"] for one in found["entries"]} == {"none", "initial"}
    assert sorted(asked) == [22, 90]


def test_with_a_goal_the_observation_says_where_it_is():
    task = TASKS["goal_maze"]
    world = task.worlds(0).training
    state = world.reset(100, seeded(0))
    observed, away = world.observe(state), goal_direction(world)(state)
    assert torch.equal(observed[:, :24], local_view(world)(state))
    assert torch.equal(observed[:, 26:], away.sign())
    assert torch.allclose(observed[:, 24:26] * 15, away)
    assert all(features[-2:] == (26, 27) for features in task.feature_sets)


def test_numbers_of_states_are_no_initial_context():
    """Where other states to start from are held out, the number of a start says nothing."""
    settings = replace(SMALL, kinds=("markov",), context=("none", "initial", "per-step"), rounds=0)
    for task, contexts in ((TASKS["cliff"], {"none", "per-step"}), (TINY, {"none", "initial", "per-step"})):
        assert {one.context for one in Contest(Run("tiny", 0), task, settings, orders=(0,)).contestants()} == contexts


def test_priors_of_other_runs_plan_from_the_same_starts(run):
    chains = run_in(TINY, 0, replace(SMALL, kinds=("markov",)))
    [both] = put_beside([chains], [run])
    assert both["entries"][: len(chains["entries"])] == chains["entries"]
    more = both["entries"][len(chains["entries"]) :]
    assert more == [entry for entry in run["entries"] if entry["prior"] == "gru"]
    assert {entry["prior"] for entry in both["curriculum"]} == {entry["prior"] for entry in run["curriculum"]}
    assert both["transitions"] == run["transitions"] | chains["transitions"]
    with refuses("beside: tiny, seed 0: random plans do not reach the same"):
        put_beside([chains], [run_in(TINY, 0, replace(SMALL, seed=1, kinds=()))])


def test_saved_priors_are_compared_as_they_are(tmp_path):
    plans = collect(ExhaustivePlanner(3), TINY.worlds(0).training, 40, generator=seeded(0))
    folder = str(save(MarkovPrior(3, 1).fit(plans), tmp_path / "mine"))
    found = run_in(TINY, 0, replace(SMALL, kinds=(), priors=(folder,)))
    assert [one["prior"] for one in found["entries"]] == [None, "uniform", folder]
    assert found["curriculum"] == []


def test_the_curriculum_alone_with_lengths_of_its_own():
    settings = replace(SMALL, kinds=("markov",), context=("none",), rounds=2, lengths=(4, 6), num_plans=(8,))
    found = curriculum_run(Run("tiny", 0), settings, {"tiny": TINY})
    assert {(one["round"], one["length"]) for one in found["curriculum"]} == {
        (r, n) for r in range(3) for n in (3, 4, 6)
    }
    assert {one["num_plans"] for one in found["curriculum"]} == {8}


SEARCHED = [pytest.param(name, marks=pytest.mark.slow) for name in TASKS if name.startswith("minigrid")]


@pytest.mark.parametrize("name", [*(name for name in TASKS if not name.startswith("minigrid")), *SEARCHED])
def test_worlds_of_the_suite(name):
    """No two of the three worlds are the same, actions are named, and something can be reached."""
    task = TASKS[name]
    worlds = task.worlds(3)
    for world in worlds:
        assert world.num_actions == task.num_actions
        assert tuple(world.action_names) == task.action_names
        starts = starts_of(task, world, 5, task.length, seeded(0))
        assert float((starts.best - starts.reference).mean()) > 0
    for one, other in combinations(worlds, 2):
        if task.state_number:
            assert not bool(((one.starts > 0) & (other.starts > 0)).any())
        elif name == "cube":
            scrambles = [set(world.reset(2000, seeded(1)).tolist()) for world in (one, other)]
            assert not scrambles[0] & scrambles[1]
            assert min(map(len, scrambles)) > 1000
        else:
            inner = [world.world if isinstance(world, MidPlanWorld) else world for world in (one, other)]
            tables = [torch.cat([world.next_state.flatten(), world.reward.flatten()]) for world in inner]
            assert not torch.equal(*tables)
    assert all(later > earlier for earlier, later in zip((task.depth, *task.lengths), task.lengths, strict=False))


def test_ways_of_sampling_are_chosen_where_priors_did_not_learn(monkeypatch):
    """Once for each prior and length, and neither in the worlds it learned in nor in those of the comparison."""
    chosen = []

    def spy(starts, prior, generator, numbers):
        chosen.append(starts)
        return {number: {Sampling(): 0.5} for number in numbers}

    worlds = TINY.worlds(0)
    monkeypatch.setattr(run_module, "tried", spy)
    run_in(replace(TINY, worlds=lambda seed: worlds), 0, SMALL)
    assert all(starts.world is worlds.validation for starts in chosen)
    # Five chains and a network with two contexts: before the curriculum at lengths 3 and 5, after it at 5.
    assert [sum(starts.length == length for starts in chosen) for length in (3, 5)] == [12, 24]


def test_the_documentation_describes_the_worlds():
    docs = Path(__file__).parents[3] / "docs"
    text = (docs / "compare.md").read_text()
    with open(docs / "compare_worlds.csv", newline="", encoding="utf-8") as file:
        _, *rows = csv.reader(file)
    assert len(rows) == len(TASKS)
    for row, (name, task) in zip(rows, TASKS.items(), strict=True):
        lengths, contexts = ", ".join(map(str, task.lengths)), ", ".join(task.contexts)
        own = (name, task.about, task.num_actions, task.depth, lengths, contexts, task.start_factor)
        assert row == list(map(str, own))
        assert f"`{name}`" in text
