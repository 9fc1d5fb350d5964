"""MuJoCo tasks against Gymnasium's own `env.step`, `env.reset` and observations."""

import contextlib
import math
import sys

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco")
pytest.importorskip("imageio")  # Gymnasium's environments need it, our worlds do not
gymnasium = pytest.importorskip("gymnasium")

import mujoco  # noqa: E402

from neuroprior.control import from_mujoco  # noqa: E402
from tests.support.sources import seeded  # noqa: E402

TASKS = ["HalfCheetah-v5", "Swimmer-v5", "Hopper-v5", "Walker2d-v5", "Reacher-v5", "Pusher-v5"]
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


def world_of(task, **options):
    return from_mujoco(task, num_threads=1, **options)


@pytest.fixture(scope="module", params=TASKS)
def episodes(request, tmp_path_factory):
    """50 random steps of `env.step`: states before and after, actions, rewards, ends."""
    with contextlib.chdir(tmp_path_factory.mktemp("log")):  # where MuJoCo logs what is deprecated in Gymnasium's file
        env = gymnasium.make(request.param).unwrapped
    env.reset(seed=0)
    random = np.random.default_rng(0)
    rows = []
    for _ in range(50):
        before = snapshot(env)
        action = random.uniform(env.action_space.low, env.action_space.high)
        _, reward, ended, _, _ = env.step(action)
        after = snapshot(env)
        mujoco.mj_kinematics(env.model, env.data)
        rows.append(
            (before, action, after, reward, ended, env._get_rew(action)[0] if "Reacher" in request.param else 0)
        )
        if ended:
            env.reset()
    return request.param, env, [torch.from_numpy(np.array(column)) for column in zip(*rows, strict=True)]


def snapshot(env):
    state = np.zeros(mujoco.mj_stateSize(env.model, FULL))
    mujoco.mj_getState(env.model, env.data, state, FULL)
    return state


def test_steps_are_those_of_the_environment(episodes):
    task, _, (before, actions, after, rewards, ended, fresh) = episodes
    world = world_of(task)
    state, reward = world.step(before, actions)
    torch.testing.assert_close(state, after, rtol=0, atol=1e-9)
    assert world.terminated(state).equal(ended)
    if task == "Reacher-v5":
        torch.testing.assert_close(reward, fresh, rtol=0, atol=1e-9)
        torch.testing.assert_close(reward, rewards, rtol=0, atol=5e-3)
        assert float((reward - rewards).abs().median()) < 1e-5
    else:
        torch.testing.assert_close(reward, rewards, rtol=0, atol=1e-9)


def test_observations_and_bounds_are_those_of_the_environment(episodes):
    task, env, (before, *_) = episodes
    world = world_of(task)
    due = []
    for state in before:
        env.set_state(*np.split(state.numpy()[1:], [env.model.nq]))
        due.append(env._get_obs())
    torch.testing.assert_close(world.observe(before), torch.from_numpy(np.array(due)).float(), rtol=1e-6, atol=1e-6)
    assert np.array_equal(world.action_low, env.action_space.low)
    assert np.array_equal(world.action_high, env.action_space.high)


def test_starts_have_the_distribution_of_the_environment(episodes):
    """Two-sample Kolmogorov-Smirnov tests of each coordinate, with a false-alarm probability of 1e-6 together."""
    from scipy.stats import ks_2samp

    task, env, _ = episodes
    ours = world_of(task).reset(500, seeded(0)).numpy()
    env.reset(seed=1)
    theirs = []
    for _ in range(500):
        env.reset()
        theirs.append(snapshot(env))
    theirs = np.array(theirs)
    for d in range(1, ours.shape[1]):
        if np.ptp(theirs[:, d]) == 0:
            assert (ours[:, d] == theirs[0, d]).all()
        else:
            assert ks_2samp(ours[:, d], theirs[:, d]).pvalue > 1e-6 / ours.shape[1]


def test_a_terminated_state_stays_and_gives_nothing():
    world = world_of("Hopper-v5")
    start = world.reset(1, seeded(0))
    fallen = start.clone()
    fallen[:, 3] = 0.3
    plans = torch.ones(1, 1, 60, 3)
    rollout = world.rollout(start, plans, keep_states=True)
    ended = world.terminated(rollout.states[0, 0])
    first = int(ended.nonzero()[0])
    assert first < 59
    assert ended[first:].all()
    assert not rollout.rewards[0, 0, first + 1 :].any()
    assert rollout.rewards[0, 0, : first + 1].all()
    assert (rollout.states[0, 0, first:] == rollout.states[0, 0, first]).all()
    still = world.rollout(fallen, plans)
    assert still.final_state[0].equal(fallen)
    assert not still.rewards.any()


@pytest.mark.parametrize("task", ["HalfCheetah-v5", "Pusher-v5"])
def test_threads_change_nothing(task):
    one, two = world_of(task), from_mujoco(task, num_threads=2)
    start = one.reset(5, seeded(0))
    plans = one.action_low + (one.action_high - one.action_low) * torch.rand(
        5, 7, 6, one.action_size, generator=seeded(0)
    )
    assert one.rollout(start, plans).rewards.equal(two.rollout(start, plans).rewards)


@pytest.mark.parametrize("task", TASKS[:4])
def test_a_goal_of_running_is_a_speed(task):
    plain, goal = world_of(task), world_of(task, goal=-1.5)
    start = plain.reset(4, seeded(0))
    action = torch.rand(4, plain.action_size, generator=seeded(0))
    after, reward = plain.step(start, action)
    speed = (after[:, 1] - start[:, 1]) / plain.seconds
    torch.testing.assert_close(goal.step(start, action)[1], reward - speed - (speed + 1.5).abs())


@pytest.mark.parametrize("task", TASKS[4:])
def test_a_goal_of_reaching_is_a_place(task):
    world = world_of(task, goal=(0.1, -0.15))
    data = mujoco.MjData(world.model)
    mujoco.mj_setState(world.model, data, world.reset(1, seeded(0))[0].numpy(), FULL)
    mujoco.mj_kinematics(world.model, data)
    place = data.body("target" if task == "Reacher-v5" else "goal").xpos[:2]
    assert np.allclose(place, [0.1, -0.15])


def test_masses_are_a_factor_of_inertia():
    """Also what MuJoCo derives from them, and what follows for the motion."""
    light, heavy = world_of("Swimmer-v5"), world_of("Swimmer-v5", masses=2.0)
    assert np.allclose(heavy.model.body_mass, 2 * light.model.body_mass)
    assert np.allclose(heavy.model.body_inertia, 2 * light.model.body_inertia)
    assert np.allclose(heavy.model.body_subtreemass, 2 * light.model.body_subtreemass)
    start = light.reset(3, seeded(0))
    action = torch.ones(3, 2)
    assert not light.step(start, action)[0].allclose(heavy.step(start, action)[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "Chess-v0"}, "`task` must be one of HalfCheetah-v5, .*, got 'Chess-v0'"),
        ({"task": "HalfCheetah-v5", "masses": math.nan}, "`masses` must be finite and above 0"),
        ({"task": "HalfCheetah-v5", "goal": (1.0, 2.0)}, "`goal` of HalfCheetah-v5 must be a finite speed"),
        ({"task": "Reacher-v5", "goal": 1.0}, "`goal` must be 2 finite numbers"),
        ({"task": "Reacher-v5", "goal": (0.1, 0.5)}, "`goal` must be from -0.27 to 0.27"),
        ({"task": "Reacher-v5", "num_threads": 0}, "num_threads"),
    ],
)
def test_wrong_arguments(options, message):
    with pytest.raises(ValueError, match=message):
        from_mujoco(**options)


def test_pictures_are_drawn_or_the_reason_is_told():
    world = world_of("HalfCheetah-v5")
    try:
        frames = world.render(world.reset(2, seeded(0)), 64, 48)
    except ValueError as error:
        if "MUJOCO_GL" not in str(error):
            raise
    else:
        assert frames.shape == (2, 48, 64, 3)
        assert frames.dtype == torch.uint8
        assert frames.float().std() > 0


def test_without_mujoco_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"pip install neuroprior\[mujoco\]"):
        from_mujoco("Hopper-v5")


def test_tasks_are_simulated_on_the_cpu():
    world = world_of("Reacher-v5")
    assert world.to("cpu") is world
    with pytest.raises(ValueError, match="simulates on the CPU"):
        world.to("cuda")
