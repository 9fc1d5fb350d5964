"""Control in a receding horizon: the loop, runs that end, and what is remembered."""

import pytest
import torch

from neuroprior.control import ICEMPlanner, MPPIPlanner, ShootingPlanner, VectorPlanner, control
from tests.support.sources import refuses, seeded
from tests.support.vectors import Cart, drift

PLANNERS = [ShootingPlanner, ICEMPlanner, MPPIPlanner]


class Recorded(VectorPlanner):
    """Keeps the memories that it is given."""

    def __init__(self, inner):
        super().__init__(inner.length, inner.num_plans, prior=inner.prior, prior_share=inner.prior_share)
        self.inner, self.memories = inner, []

    def plan(self, world, state, generator=None, memory=None):
        self.memories.append(memory)
        return self.inner.plan(world, state, generator, memory)


@pytest.mark.parametrize("make", PLANNERS)
def test_what_is_returned_is_what_happened(make):
    world = Cart()
    state = world.reset(3, seeded(0))
    done = control(make(5, 8), world, state, 6, seeded(1), replan_every=2)
    assert done.states.shape == (3, 7, 3)
    assert done.states[:, 0].equal(state)
    now = state
    for t in range(6):
        assert done.plans.context[:, t].equal(world.observe(now))
        now, reward = world.step(now, done.plans.actions[:, t])
        assert torch.allclose(done.rewards[:, t], reward)
        assert torch.allclose(done.states[:, t + 1], now)
    assert done.plans.lengths is None
    assert done.plans.group.tolist() == [0, 1, 2]
    assert done.model_steps.tolist() == [3 * 8 * 5] * 3
    assert done.seconds > 0
    again = control(make(5, 8), world, state, 6, seeded(1), replan_every=2)
    assert again.plans.actions.equal(done.plans.actions)


def test_an_open_loop_is_the_plan():
    world = Cart()
    state = world.reset(4, seeded(0))
    planner = ICEMPlanner(6, 20)
    done = control(planner, world, state, 6, seeded(1), replan_every=6)
    decision = planner.plan(world, state, seeded(1))
    assert done.plans.actions.equal(decision.plan)
    assert torch.allclose(done.rewards.sum(1), decision.score, atol=1e-5)


@pytest.mark.parametrize("make", PLANNERS)
def test_runs_that_end_are_left_out(make):
    world = Cart(last=4, edge=1.5)
    state = world.reset(30, seeded(0))
    state[0, 0] = 2.0
    done = control(make(5, 8, prior=drift(world)), world, state, 6, seeded(1))
    before = done.states[:, :-1]
    running = ~world.terminated(before.flatten(0, 1)).view(30, 6)
    assert done.plans.lengths.equal(running.sum(1))
    assert done.plans.lengths[0] == 0
    assert done.plans.lengths.max() == 4
    assert done.plans.lengths.unique().numel() > 2
    assert done.model_steps.equal(done.plans.lengths * 40)
    assert (done.rewards[~running] == 0).all()
    for run in range(30):
        length = int(done.plans.lengths[run])
        assert (done.states[run, length:] == done.states[run, length]).all()


@pytest.mark.parametrize(
    ("share", "memory", "kept"), [(0.0, 1, [0] * 4), (0.5, 2, [1, 2, 2, 2]), (0.5, None, [1, 2, 3, 4])]
)
def test_only_what_the_prior_reads_is_remembered(share, memory, kept):
    world = Cart()
    prior = drift(world)
    prior.memory = memory
    planner = Recorded(MPPIPlanner(4, 4, prior=prior, prior_share=share))
    done = control(planner, world, world.reset(2, seeded(0)), 5, seeded(1))
    assert planner.memories[0] is None
    for t, (remembered, number) in enumerate(zip(planner.memories[1:], kept, strict=True), 1):
        assert remembered.past.equal(done.plans.actions[:, t - number : t])
        assert remembered.observations.equal(done.plans.context[:, t - number : t])
        assert remembered.mean.shape == (2, 3, 2)


def test_runs_that_go_on_keep_their_own_memory():
    world = Cart(last=5)
    state = world.reset(4, seeded(0))
    state[:, 2] = torch.tensor([0.0, 3.0, 1.0, 4.0])
    prior = drift(world)
    prior.memory = None
    planner = Recorded(MPPIPlanner(4, 4, prior=prior))
    done = control(planner, world, state, 5, seeded(1))
    for t, remembered in enumerate(planner.memories[1:], 1):
        assert remembered.past.equal(done.plans.actions[done.plans.lengths > t, :t])


def test_a_plan_that_is_too_short_is_named():
    world = Cart()
    state = world.reset(2, seeded(0))
    with refuses("replan_every"):
        control(ShootingPlanner(3, 4), world, state, 5, replan_every=4)
    with refuses("num_steps"):
        control(ShootingPlanner(3, 4), world, state, 0)


def test_rewards_keep_the_precision_of_the_world():
    class Precise(Cart):
        def step(self, state, action, generator=None):
            return super().step(state, action, generator)[0], torch.full((len(state),), 1 / 3, dtype=torch.double)

    world = Precise()
    done = control(ShootingPlanner(2, 4), world, world.reset(2, seeded(0)), 3, generator=seeded(1))
    assert done.rewards.tolist() == [[1 / 3] * 3] * 2
