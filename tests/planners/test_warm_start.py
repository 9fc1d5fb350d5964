"""Warm starts: the rest of the last plan goes on, is tried fairly, and never makes a decision worse."""

import pytest
import torch

from neuroprior import MarkovPrior, Plans, SamplingPlanner, TabularWorld, UniformPrior, gridworld
from neuroprior.planners import Decision, expected_score
from neuroprior.planners.warm_start import continue_plans, with_rest
from neuroprior.worlds import labyrinth
from tests.support.sources import (
    FALSE_ALARM,
    TablePrior,
    distribution,
    p_value,
    plan_number,
    random_world,
    seeded,
    stochastic_world,
)


def test_the_rest_goes_on_as_the_prior_would():
    """What follows two given actions: chi-square against the prior's own probabilities after them."""
    prior, world = TablePrior.random(3, 4, seed=1), random_world(0)
    rest = torch.tensor([[2, 0, 1]]).repeat(4000, 1)
    left = torch.full((4000,), 2)
    state = world.reset(4000, seeded(0))
    plans, rollout = continue_plans(prior, world, state, rest, left, 4, seeded(1))
    assert (plans[:, 0, :2].long() == rest[:, :2]).all()
    begin = torch.tensor([2, 0])
    due = distribution(prior, 4).view(9, 9)[plan_number(begin, 3)]
    assert p_value(plan_number(plans[:, 0, 2:], 3), due) > FALSE_ALARM
    again = world.rollout(state, plans, keep_states=True)
    assert torch.equal(again.rewards, rollout.rewards)
    assert torch.equal(again.states, rollout.states)


def test_actions_that_do_not_exist_are_drawn_anew():
    world = labyrinth()
    state = torch.zeros(500, dtype=torch.long)
    rest = torch.full((500, 5), 3)
    plans, rollout = continue_plans(UniformPrior(4), world, state, rest, torch.full((500,), 5), 5, seeded(0))
    now = state
    for t, action in enumerate(plans[:, 0].long().T):
        legal = world.legal_actions(now)
        assert legal.gather(1, action[:, None]).all()
        assert ((action == 3) | ~legal[:, 3]).all(), t
        now, _ = world.step(now, action)
    assert torch.equal(now, rollout.final_state[:, 0])


@pytest.mark.parametrize("any_prefix", [False, True])
@pytest.mark.parametrize("objective", ["terminal", "return"])
def test_a_decision_never_gets_worse(any_prefix, objective):
    world, prior = gridworld(8, 8, num_worlds=4), UniformPrior(4)
    state = world.reset(300, seeded(0))
    planner = SamplingPlanner(prior, 5, 3, objective=objective, any_prefix=any_prefix)
    decision = planner.plan(world, state, seeded(1))
    rest, left = torch.randint(4, (300, 4), generator=seeded(2)), torch.randint(5, (300,), generator=seeded(3))
    chosen = with_rest(planner, prior, world, state, decision, rest, left, 1, seeded(4))
    assert (chosen.score >= decision.score).all()
    assert 30 < int((chosen.score > decision.score).sum()) < 270
    assert chosen.model_steps == decision.model_steps + 5
    rollout = world.rollout(state, chosen.plan[:, None].long(), keep_states=True)
    last = torch.full((300,), 4) if chosen.lengths is None else chosen.lengths - 1
    row = torch.arange(300)
    assert torch.allclose(
        planner.for_world(world).prefix_scores(rollout.rewards, rollout.states)[row, 0, last], chosen.score
    )
    assert torch.equal(rollout.states[row, 0, last], chosen.final_state)
    assert (chosen.lengths is None) == (not any_prefix)


def test_of_equals_a_random_one():
    """A world without rewards: heads and tails of 4,000 decisions."""
    world = gridworld(3, 3)
    world.reward.zero_()
    state = torch.zeros(4000, dtype=torch.long)
    own = Decision(torch.zeros(4000, 3, dtype=torch.uint8), torch.zeros(4000), state, 3)
    planner = SamplingPlanner(UniformPrior(4), 3, 1)
    rest = torch.ones(4000, 3, dtype=torch.long)
    chosen = with_rest(planner, UniformPrior(4), world, state, own, rest, torch.full((4000,), 3), 1, seeded(0))
    assert p_value(chosen.plan[:, 0].long(), torch.tensor([0.5, 0.5])) > FALSE_ALARM


def test_in_a_stochastic_world_both_have_the_same_rollouts():
    """The score of a winner among many flatters it; where both are tried anew, the better one wins in the mean."""
    world, prior = stochastic_world(0), UniformPrior(3)
    state = world.reset(400, seeded(0))
    planner = SamplingPlanner(prior, 3, 10, objective="return")
    decision = planner.plan(world, state, seeded(1))
    better = SamplingPlanner(prior, 3, 100, objective="return", num_rollouts=50).plan(world, state, seeded(2))
    chosen = with_rest(planner, prior, world, state, decision, better.plan, torch.full((400,), 3), 200, seeded(3))
    assert chosen.model_steps == decision.model_steps + 3 + 2 * 200 * 3
    worth = [
        expected_score(world, state, one.plan[:, None].long(), objective="return").mean()
        for one in (decision, better, chosen)
    ]
    assert worth[0] < worth[1] <= worth[2] + 0.01
    assert not torch.equal(chosen.plan, decision.plan)


def test_the_context_is_the_observation_where_the_rest_leads():
    """The prior takes action `cell % 4` in each cell."""
    world, cells = gridworld(4, 4), torch.arange(16).repeat(50)
    plans = Plans((cells % 4)[:, None], 4, context=cells[:, None])
    prior = MarkovPrior(4, 0, 1e-9, backoff="dirichlet", num_contexts=16).fit(plans)
    prior.context_per = "step"
    state, rest = world.reset(50, seeded(0)), torch.zeros(50, 2, dtype=torch.long)
    found, rollout = continue_plans(prior, world, state, rest, torch.full((50,), 2), 4, seeded(0))
    assert (found[:, 0, :2] == 0).all()
    assert found[:, 0, 2:].long().equal(rollout.states[:, 0, 1:3] % 4)


def test_in_a_stochastic_world_nothing_beyond_the_end_of_a_plan_wins():
    """Every step of one action is rewarded: what comes after the end of what was decided would score more."""
    table = torch.zeros(1, 2, 1, dtype=torch.long)
    world = TabularWorld(table, torch.tensor([[[1.0], [0.0]]]), probability=torch.ones(1, 2, 1, dtype=torch.float64))
    state = torch.zeros(40, dtype=torch.long)
    planner = SamplingPlanner(UniformPrior(2), 5, 1, objective="return", any_prefix=True)
    own = Decision(torch.zeros(40, 5, dtype=torch.uint8), torch.ones(40), state, 5, torch.full((40,), 2))
    rest = torch.ones(40, 5, dtype=torch.long)
    chosen = with_rest(planner, UniformPrior(2), world, state, own, rest, torch.full((40,), 5), 1, seeded(0))
    assert (chosen.lengths == 2).all()
    assert (chosen.score == 2).all()
