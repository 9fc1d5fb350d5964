"""Worlds of vectors: conformance, closed forms, and what they refuse."""

import math
from functools import partial

import pytest
import torch

from neuroprior.control import DoubleIntegrator, PlanarArm, from_mujoco
from neuroprior.testing import check_world

TASKS = ["HalfCheetah-v5", "Swimmer-v5", "Hopper-v5", "Walker2d-v5", "Reacher-v5", "Pusher-v5"]
WORLDS = {
    "mass": DoubleIntegrator,
    "mass in 3 dimensions": partial(DoubleIntegrator, 3, mass=2.0, goal=(1.0, 0.0, -1.0)),
    "arm": PlanarArm,
    "arm of one link, no obstacles": partial(PlanarArm, 1, obstacles=()),
}


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_conform(name):
    check_world(WORLDS[name]())


@pytest.mark.parametrize("task", TASKS)
def test_mujoco_worlds_conform(task):
    pytest.importorskip("mujoco")
    pytest.importorskip("gymnasium")
    check_world(from_mujoco(task, num_threads=1), num_states=20, length=12)


def test_terminated_states_that_move_are_found():
    class Leaky(DoubleIntegrator):
        def terminated(self, state):
            return state[:, 0] > 0

    with pytest.raises(AssertionError, match="terminated states must stay"):
        check_world(Leaky())


def test_a_constant_force_moves_a_mass_along_a_parabola():
    world = DoubleIntegrator(2, mass=2.0, step_seconds=0.5, goal=(1.0, 0.0), velocity_cost=0.5, force_cost=0.25)
    start = torch.tensor([[0.0, 1.0, 1.0, 0.0]])
    plans = torch.tensor([1.0, -0.5]).expand(1, 1, 4, 2)
    rollout = world.rollout(start, plans, keep_states=True)
    seconds = 2.0  # the accelerations are 0.5 and -0.25
    torch.testing.assert_close(
        rollout.final_state[0, 0],
        torch.tensor([seconds + 0.25 * seconds**2, 1 - 0.125 * seconds**2, 1 + 0.5 * seconds, -0.25 * seconds]),
    )
    # after half a second: position (0.5625, 0.96875), velocity (1.25, -0.125)
    cost = 0.4375**2 + 0.96875**2 + 0.5 * (1.25**2 + 0.125**2) + 0.25 * (1 + 0.25)
    assert float(rollout.rewards[0, 0, 0]) == pytest.approx(-0.5 * cost)


def test_the_linear_quadratic_regulator_reaches_its_own_cost():
    """Riccati's recursion backwards from the end gives the least cost of L steps; the world must charge just that."""
    seconds, mass, length = 0.1, 1.5, 40
    world = DoubleIntegrator(1, mass=mass, step_seconds=seconds, max_force=1e4)
    state_cost = seconds * torch.diag(torch.tensor([1.0, 0.1], dtype=torch.float64))
    force_cost = seconds * 0.01
    move = torch.tensor([[1, seconds], [0, 1]], dtype=torch.float64)
    push = torch.tensor([[seconds**2 / 2], [seconds]], dtype=torch.float64) / mass
    ahead = torch.zeros(2, 2, dtype=torch.float64)
    gains = []
    for _ in range(length):
        weight = state_cost + ahead
        gain = (push.T @ weight @ move) / (force_cost + push.T @ weight @ push)
        ahead = move.T @ weight @ (move - push @ gain)
        gains.append(gain)
    state = start = torch.tensor([[1.0, -0.5]], dtype=torch.float64)
    forces = []
    for gain in reversed(gains):
        forces.append(-state @ gain.T)
        state = world.step(state, forces[-1])[0]
    plan = torch.stack(forces, 1)[:, None]
    least = float(start @ ahead @ start.T)
    assert float(world.rollout(start, plan).rewards.sum()) == pytest.approx(-least, rel=1e-6)
    other = plan + 0.1 * torch.randn(1, 50, length, 1, generator=torch.Generator().manual_seed(0))
    assert float(world.rollout(start, other).rewards.sum(-1).max()) < -least


def test_a_single_link_turns_as_a_rod():
    """A rod of 1 kg and 1 m about its end has the inertia 1 / 3; masses are a factor of it; damping is implicit."""
    world = PlanarArm(1, masses=2.0, damping=0.3, num_substeps=1, obstacles=())
    state, _ = world.step(torch.tensor([[0.5, 0.25]]), torch.tensor([[0.4]]))
    speed = (0.25 + 0.05 * 0.4 / (2 / 3)) / (1 + 0.05 * 0.3 / (2 / 3))
    torch.testing.assert_close(state, torch.tensor([[0.5 + 0.05 * speed, speed]]))


def test_a_free_arm_keeps_its_energy_and_angular_momentum():
    """Of rods, computed from how their points move: 500 points of each link, by finite differences."""
    world = PlanarArm(3, damping=0.0, obstacles=(), num_substeps=500)
    start = torch.tensor([[0.3, 1.0, -0.7, 1.0, -2.0, 1.5]], dtype=torch.float64)
    after = world.rollout(start, torch.zeros(1, 1, 20, 3)).final_state[:, 0]

    def moving(state):
        change = torch.cat([state[:, 3:], torch.zeros_like(state[:, 3:])], 1) * 1e-5
        place = torch.stack([world.joints(state - change), world.joints(state + change)])
        shares = (torch.arange(500) + 0.5) / 500
        points = place[:, :, :-1, None] + shares[:, None] * (place[:, :, 1:, None] - place[:, :, :-1, None])
        where, speed = points.mean(0), (points[1] - points[0]) / 2e-5
        turn = where[..., 0] * speed[..., 1] - where[..., 1] * speed[..., 0]
        return torch.stack([speed.square().sum(-1).mean() / 2, turn.mean()])

    assert (after - start).abs().max() > 0.5
    torch.testing.assert_close(moving(after), moving(start), rtol=5e-3, atol=1e-4)


def test_links_inside_obstacles_cost_their_depth():
    options = {"goal": (1.0, 0.0), "control_cost": 0.0, "obstacle_cost": 10.0}
    world = PlanarArm(2, obstacles=((0.25, 0.1, 0.15), (1.2, 0.0, 0.3), (0.0, 2.0, 0.5)), **options)
    # the first link is 0.05 m inside the first circle, the end of the second 0.1 m inside the second
    _, reward = world.step(torch.zeros(1, 4), torch.zeros(1, 2))
    assert float(reward) == pytest.approx(-10 * (0.05 + 0.1), abs=1e-5)
    free = PlanarArm(2, obstacles=(), **options)
    assert float(free.step(torch.zeros(1, 4), torch.zeros(1, 2))[1]) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (partial(DoubleIntegrator, 0), "num_dimensions"),
        (partial(DoubleIntegrator, mass="heavy"), "`mass` must be finite and above 0, got 'heavy'"),
        (partial(PlanarArm, masses=math.inf), "`masses` must be finite and above 0, got inf"),
        (partial(DoubleIntegrator, force_cost=-1.0), "`force_cost` must be finite and at least 0, got -1.0"),
        (partial(DoubleIntegrator, goal=(1.0, math.nan)), "`goal` must be 2 finite numbers, got .*nan"),
        (partial(PlanarArm, obstacles=((0.0, 1.0),)), r"`obstacles\[0\]` must be 3 finite numbers"),
        (partial(PlanarArm, obstacles=((0.0, 1.0, 0.0),)), "`obstacles` must have radii above 0"),
    ],
)
def test_wrong_arguments(make, message):
    with pytest.raises(ValueError, match=message):
        make()
