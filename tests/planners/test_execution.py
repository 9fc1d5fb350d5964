"""Executing plans in open and closed loop: as they were planned; replanning pays where outcomes are random."""

import pytest
import torch

from neuroprior import ExhaustivePlanner, SamplingPlanner, TabularWorld, UniformPrior, collect, gridworld
from neuroprior.planners import execute
from tests.support.sources import corridor, random_world, refuses, seeded


def test_an_open_loop_is_the_plan():
    world = random_world(0)
    state = world.reset(20, seeded(0))
    planner = ExhaustivePlanner(4, objective="return")
    done = execute(planner, world, state, 4, replan_every=4, generator=seeded(1))
    decision = planner.plan(world, state, seeded(1))
    assert torch.equal(done.actions, decision.plan.long())
    assert torch.allclose(done.rewards.sum(1), decision.score)
    assert torch.equal(done.states[:, -1], decision.final_state)
    assert done.model_steps == decision.model_steps


@pytest.mark.parametrize(("every", "decisions"), [(1, 7), (2, 4), (3, 3)])
def test_it_replans_after_so_many_steps(every, decisions):
    world = gridworld(8, 8, num_worlds=3)
    state = world.reset(5, seeded(0))
    planner = SamplingPlanner(UniformPrior(4), 3, 10)
    done = execute(planner, world, state, 7, every, seeded(1))
    assert done.actions.shape == done.rewards.shape == done.states.shape == (5, 7)
    assert done.model_steps == decisions * 30
    now = state
    for t in range(7):
        now, reward = world.step(now, done.actions[:, t])
        assert torch.equal(now, done.states[:, t])
        assert torch.equal(reward, done.rewards[:, t])


def test_what_is_recorded_with_plans_was_seen_before_the_actions():
    """From the first and the second of four cells there is one best plan of three actions, to the right."""
    world, state = corridor((0.0, 0.0, 0.0, 1.0)), torch.tensor([0, 1])
    planner = ExhaustivePlanner(3, objective="return")
    for context, seen in ((None, None), ("plan", [[0, 0, 0], [1, 1, 1]]), ("step", [[0, 1, 2], [1, 2, 3]])):
        plans = collect(planner, world, state=state, context=context)
        assert plans.actions.tolist() == [[1, 1, 1]] * 2
        assert (None if plans.context is None else plans.context.tolist()) == seen
        assert plans.lengths is None
    best = collect(planner, world, state=state, context="step", min_score=1.0)
    assert best.context.tolist() == [[1, 2, 3]]


def test_a_closed_loop_responds_to_random_outcomes():
    """A coin leads to cell 1 or 2, where the right answer is another: a closed loop is always right, an open one half.

    Wrong answers of 4,000 coins: by Hoeffding their share is within .05 of a half but with probability 5e-9.
    """
    table = torch.tensor([[[1, 2]] * 2, [[3, 3], [4, 4]], [[4, 4], [3, 3]], [[3, 3]] * 2, [[4, 4]] * 2])
    world = TabularWorld(table, torch.tensor([0.0, 0, 0, 1, 0]), probability=torch.full((5, 2, 2), 0.5))
    state = torch.zeros(4000, dtype=torch.long)
    planner = ExhaustivePlanner(2, num_rollouts=8, objective="return")
    closed, opened = (execute(planner, world, state, 2, every, seeded(0)).rewards[:, -1].mean() for every in (1, 2))
    assert closed == 1
    assert abs(float(opened) - 0.5) < 0.05


def test_of_many_starts_the_shortest_prefix_that_won_says_how_many_actions_there_are():
    """The reward is a step from the first start, and two steps from the second."""
    world = TabularWorld(torch.tensor([[1], [3], [0], [3]]), torch.tensor([0.0, 1.0, 0.0, 0.0]))
    planner, state = ExhaustivePlanner(2, any_prefix=True), torch.tensor([0, 2])
    assert planner.plan(world, state).lengths.tolist() == [1, 2]
    for some, every in ((state, 2), (state.flip(0), 2)):
        with refuses("fewer"):
            execute(planner, world, some, 2, replan_every=every)
    assert execute(planner, world, state[1:], 2, replan_every=2).states.tolist() == [[0, 1]]
    assert execute(planner, world, state, 2).states.tolist() == [[1, 3], [0, 1]]
