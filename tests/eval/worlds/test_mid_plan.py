"""Plans that start in the middle of others: the actions left, and that they lead where the plan was going."""

import torch

from eval.worlds.mid_plan import MidPlanWorld
from eval.worlds.suite import TASKS, best_score
from neuroprior import ExhaustivePlanner, SamplingPlanner, UniformPrior, collect
from neuroprior.testing import check_world
from neuroprior.worlds import labyrinth, maze
from neuroprior.worlds.episodes import EpisodicWorld
from neuroprior.worlds.labyrinth import WATER
from tests.support.sources import seeded


def made() -> MidPlanWorld:
    return MidPlanWorld(maze(7, 7, num_layouts=3, egocentric=True), ExhaustivePlanner(5), 2)


def test_it_is_a_world():
    check_world(made())


def test_what_is_left_leads_where_the_plan_was_going():
    world = made()
    state = world.reset(200, seeded(0))
    assert state.shape == (200, 4)
    inner = world.world.reset(200, seeded(0))
    best = ExhaustivePlanner(5).plan(world.world, inner, seeded(1)).score
    ended = world.rollout(state, state[:, None, 1:]).rewards[:, 0, -1]
    assert torch.equal(ended, best)
    observed = world.observe(state).view(200, 3, 3)
    assert torch.equal(observed.argmax(-1), state[:, 1:])
    assert bool((observed.sum(-1) == 1).all())


def test_the_oracle_is_that_of_the_inner_world():
    task, world = TASKS["mid_plan"], made()
    state = world.reset(50, seeded(0))
    found = ExhaustivePlanner(4).plan(world, state, seeded(1)).score
    assert torch.allclose(best_score(task, world, state, 4), found)
    plans = collect(SamplingPlanner(UniformPrior(3), 4, 8), world, state=state, context="step", generator=seeded(2))
    assert torch.equal(plans.context, world.observe(state)[:, None].expand(-1, 4, -1))


def test_it_terminates_where_the_inner_world_does():
    world = MidPlanWorld(labyrinth(absorbing=True), ExhaustivePlanner(3), 1)
    state = torch.tensor([[WATER, 0, 0], [5, 0, 0]])
    assert world.terminated(state).tolist() == [True, False]
    assert torch.equal(world.legal_actions(state), world.world.legal_actions(state[:, 0]))


def test_it_is_solved_where_the_inner_world_is_and_not_where_that_ends_in_a_pit():
    table = torch.tensor([[0, 1], [2, 3], [2, 2], [3, 3]])  # 2 is a pit, 3 the goal
    ended, reward = torch.tensor([False, False, True, True]), torch.zeros(1, 4, 2)
    reward[0, 1, 1] = 1.0
    inner = EpisodicWorld(table, reward, ["left", "right"], torch.tensor([1.0, 0, 0, 0]), ended)
    world = MidPlanWorld(inner, ExhaustivePlanner(2), 1)
    state = torch.tensor([[cell, left] for cell in range(4) for left in range(2)])
    assert world.has_goal
    assert world.terminated(state).tolist() == [False] * 4 + [True] * 4
    assert world.solved(state).tolist() == [False] * 6 + [True] * 2


def test_plans_come_in_the_groups_of_the_inner_world():
    world = made()
    state = world.reset(40, seeded(0))
    plans = collect(ExhaustivePlanner(2), world, state=state)
    assert torch.equal(plans.group, world.world.group(state[:, 0]))
    assert plans.action_names == ("left", "right", "forward")
