"""The paper's second simulation: pursuit of a goal under approximate values, and planners that may end anywhere."""

import itertools

import pytest
import torch

from eval.paper.planners import PaperSettings
from eval.paper.second_simulation import ceiling, empty_world, objective, pursue, random_starts
from eval.paper.value_quality import families, quality
from neuroprior import ExhaustivePlanner, SamplingPlanner, TabularWorld, UniformPrior, oracle
from neuroprior.planners import value_iteration
from neuroprior.testing import FALSE_ALARM
from neuroprior.testing.chi_square import chi_square
from tests.support.sources import seeded


def settings(**changes: object) -> PaperSettings:
    small: dict[str, object] = {
        "worlds": 1,
        "edges": "torus",
        "ties": "uniform",
        "learn_from": "all",
        "reward_power": 1.0,
        "value_functions": 3,
        "starts": 40,
        "size": 6,
        "q_steps": 300,
        "initial_scale": 0.01,
        "max_plans": 4,
        "training_plans": 200,
        "depth": 3,
        "length": 4,
        "num_plans": 32,
        "steps": 10,
        "seed": 0,
    }
    return PaperSettings(**(small | changes))


@pytest.mark.parametrize(("edges", "any_prefix"), [("torus", False), ("torus", True), ("wall", True)])
def test_exact_values_lead_every_start_that_can_to_the_goal(edges: str, any_prefix: bool) -> None:
    t = settings(edges=edges, max_plans=6, depth=4)
    world = empty_world(t, 1)
    states = random_starts(t, 1, 200, seeded(0))[0]
    values = value_iteration(world, goal=t.goal)
    # With exact values a planner climbs to the goal, or, by parity, stays beside it.
    planner = ExhaustivePlanner(4, value=objective(values, t.goal), any_prefix=any_prefix)
    done = pursue(planner, world, states, t.goal, t.max_plans, seeded(1))
    able = torch.ones(200, dtype=torch.bool) if any_prefix else ceiling(world, states, t)
    assert done.reached.equal(able)
    if not any_prefix:
        parity = (world.coordinates(states) - world.coordinates(torch.tensor(t.goal))).sum(1) % 2
        assert able.equal(parity == 0)


def test_pursuit_goes_on_from_where_the_last_plan_ended() -> None:
    t = settings()
    world = empty_world(t, 3)
    values = torch.rand(3, 36, generator=seeded(2))
    states = random_starts(t, 3, 60, seeded(0)).flatten()
    value = objective(values, t.goal)
    planner = SamplingPlanner(UniformPrior(4), 4, 16, value=value, any_prefix=True)
    done = pursue(planner, world, states, t.goal, 5, seeded(3))
    now = states.clone()
    for plan, length, start in zip(done.plans, done.lengths, done.start, strict=True):
        assert int(world.cell(now[start])) != t.goal
        before = now[start].clone()
        for action in plan[:length]:
            now[start] = world.step(now[start, None], action[None].long())[0]
        assert int(now[start]) != int(before), "a plan that ends where it began was kept"
    assert now.equal(done.final_state)
    assert done.reached.equal(world.cell(now) == t.goal)
    assert int(torch.bincount(done.start).max()) <= 5


def test_pursuit_without_anything_to_do() -> None:
    t = settings()
    done = pursue(ExhaustivePlanner(2), empty_world(t, 1), torch.tensor([t.goal]), t.goal, 3, seeded(0))
    assert done.reached.tolist() == [True]
    assert len(done.plans) == 0


def test_starts_are_uniform_over_all_cells_but_the_goal() -> None:
    t = settings()
    states = random_starts(t, 2, 20_000, seeded(0))
    cells = (states % 36).flatten().bincount(minlength=36)
    assert int(cells[t.goal]) == 0
    assert (states // 36).equal(torch.arange(2)[:, None].expand_as(states))
    others = torch.cat([cells[: t.goal], cells[t.goal + 1 :]]).double()
    assert chi_square(others, torch.full((35,), 40_000 / 35).double()) > FALSE_ALARM


@pytest.mark.parametrize("edges", ["torus", "wall"])
@pytest.mark.parametrize("depth", [1, 2])
def test_ceiling_by_brute_force(edges: str, depth: int) -> None:
    t = settings(edges=edges, size=4, depth=depth, length=2, max_plans=3)
    world = empty_world(t, 1)
    states = torch.arange(16)
    reached = torch.zeros(16, dtype=torch.bool)
    for moves in {plans * length for plans in (1, 2, 3) for length in (depth, 2)}:
        every = torch.tensor(list(itertools.product(range(4), repeat=moves)))
        ends = world.rollout(states, every.expand(16, -1, -1)).final_state
        reached |= (ends == t.goal).any(1)
    assert ceiling(world, states, t).equal(reached)


def random_table(seed: int) -> TabularWorld:
    g = seeded(seed)
    return TabularWorld(torch.randint(5, (5, 3), generator=g), torch.rand(2, 5, generator=g))


@pytest.mark.parametrize("goal", ["terminal", "return"])
@pytest.mark.parametrize("with_value", [False, True])
def test_best_prefix_by_brute_force(goal: str, with_value: bool) -> None:
    world = random_table(1)
    state = torch.arange(10)
    table = torch.rand(10, generator=seeded(5))
    settings = {"objective": goal, "discount": 0.8 if goal == "return" else 1.0}
    settings |= {"value": (lambda s: table[s])} if with_value else {}
    # The best of all whole plans of every length is the best prefix.
    scores = torch.stack([ExhaustivePlanner(n, **settings).plan(world, state).score for n in (1, 2, 3, 4)])
    found = ExhaustivePlanner(4, any_prefix=True, **settings).plan(world, state, seeded(0))
    assert torch.allclose(found.score, scores.amax(0))
    assert torch.allclose(oracle(world, state, 4, any_prefix=True, **settings), found.score)
    sampled = SamplingPlanner(UniformPrior(3), 4, 3000, any_prefix=True, **settings).plan(world, state, seeded(0))
    assert torch.allclose(sampled.score, found.score), "3,000 samples of 81 plans miss the best with p < 1e-14"
    for decision in (found, sampled):
        for b in range(10):
            plan = decision.plan[b, : decision.lengths[b]]
            rollout = world.rollout(state[b : b + 1], plan[None, None].long())
            planner = ExhaustivePlanner(4, **settings)
            assert float(planner.score(rollout.rewards, rollout.final_state)) == pytest.approx(float(decision.score[b]))
            assert int(rollout.final_state) == int(decision.final_state[b])


def test_best_prefixes_are_legal_and_ties_uniform() -> None:
    # From cell 0 only action 1 exists; all rewards are equal, so each legal prefix of up to 2 actions ties.
    legal = torch.tensor([[False, True], [True, True]])
    world = TabularWorld(torch.tensor([[0, 1], [0, 1]]), torch.ones(2), legal)
    state = torch.zeros(12_000, dtype=torch.long)
    decision = ExhaustivePlanner(2, any_prefix=True).plan(world, state, seeded(0))
    code = torch.where(decision.lengths == 1, 0, 1 + decision.plan[:, 1].long())
    assert bool((decision.plan[:, 0] == 1).all())
    assert chi_square(code.bincount(minlength=3).double(), torch.full((3,), 4000.0)) > FALSE_ALARM


def test_worse_values_are_of_lower_quality() -> None:
    t = settings(size=12)
    exact = value_iteration(empty_world(t, 1), goal=t.goal)[0]
    for kind, levels in families(t, seeded(0)).items():
        found = [quality(values, exact, t.goal) for values in levels.values()]
        assert found[-1] > found[0], kind
        assert max(found) <= 1 + 1e-9
