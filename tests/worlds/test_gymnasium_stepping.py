"""Gymnasium environments that are stepped, or planned in while they run, against the environments themselves."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from neuroprior import ExhaustivePlanner, SamplingPlanner, UniformPrior, from_gymnasium
from neuroprior.testing import check_world
from neuroprior.worlds import EpisodicWorld, SimulatorWorld
from neuroprior.worlds.simulators.fingerprints import digest
from neuroprior.worlds.simulators.generators import state_of_generators
from tests.support import environments, simulators
from tests.support.sources import every_plan, refuses, seeded

NAMES = ("CartPole-v1", "MountainCar-v0")


def real_trajectory(env, seed, actions, first=0):
    """Observations and rewards of a trajectory, and how many of the actions were taken."""
    first_observed, _ = env.reset(seed=seed)
    observations, rewards = [first_observed], []
    for action in actions:
        observed, reward, terminated, truncated, _ = env.step(action + first)
        observations.append(observed)
        rewards.append(reward)
        if terminated or truncated:
            break
    return observations, rewards


@pytest.mark.parametrize("name", NAMES)
def test_rollouts_are_the_environments(name):
    """Without their time limits: 250 actions are more than MountainCar's 200."""
    world = from_gymnasium(name, seeds=[4, 9])
    assert isinstance(world, SimulatorWorld)
    state = world.reset(40, seeded(0)).unique()
    assert len(state) == 2
    plans = torch.randint(world.num_actions, (2, 3, 250), generator=seeded(0))
    rollout = world.rollout(state, plans, keep_states=True)
    env = gymnasium.make(name).unwrapped
    for b, seed in enumerate([4, 9]):
        for p in range(3):
            observations, rewards = real_trajectory(env, seed, plans[b, p].tolist())
            assert rollout.rewards[b, p].tolist() == rewards + [0.0] * (250 - len(rewards))
            shown = world.observe(rollout.states[b, p])[: len(rewards)]
            assert shown.equal(torch.from_numpy(np.array(observations[1:], dtype=np.float32)))


@pytest.mark.parametrize("method", ["auto", "enumerate", "step"])
@pytest.mark.parametrize("name", ["CartPole-v1", "MiniGrid-DoorKey-5x5-v0", "CliffWalking-v1"])
def test_an_environment_is_left_alone(name, method):
    if (name, method) == ("CartPole-v1", "enumerate"):
        return
    pytest.importorskip("minigrid")
    env = gymnasium.make(name)
    env.reset(seed=3)
    env.step(1)

    def snapshot():
        return digest(vars(env)), digest(vars(env.unwrapped)), state_of_generators([env.unwrapped.np_random])

    before = snapshot()
    how = {"seeds": [3]} if method == "enumerate" else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of one start alone
        world = from_gymnasium(env, method=method, progress=False, **how)
    if method == "step":
        assert world.observe(world.reset(1)).equal(world.observe(world.state_of(env)))
    elif method == "enumerate":
        state, _ = world.step(world.reset(1), torch.tensor([1]))
        assert world.state_of(env).equal(state)
    world.rollout(world.reset(2), torch.ones(2, 3, 4, dtype=torch.long))
    assert snapshot() == before


def test_a_running_environment_is_controlled():
    """Planning again after each step keeps the pole up, from a state in which it falls."""
    env = gymnasium.make("CartPole-v1")
    env.reset(seed=7)
    for _ in range(3):
        env.step(1)
    world = from_gymnasium(env)
    assert world.observe(world.reset(1))[0].tolist() == pytest.approx(np.float32(env.unwrapped.state).tolist())
    planner = SamplingPlanner(UniformPrior(2), 20, 64, objective="return")
    generator = seeded(0)
    for _ in range(40):
        decision = planner.plan(world, world.state_of(env), generator)
        _, _, fallen, _, _ = env.step(int(decision.plan[0, 0]))
        assert not fallen


def test_a_function_makes_environments():
    world = from_gymnasium(simulators.NoisyStart, method="step")
    cells = world.observe(world.reset(300, seeded(0))).argmax(1)
    assert cells.unique().tolist() == [0, 1, 2]
    assert not world.stochastic
    check_world(world)


def test_auto_steps_what_is_stochastic():
    assert from_gymnasium(environments.Slippery()).stochastic
    assert isinstance(from_gymnasium(environments.Corridor()), EpisodicWorld)
    with refuses('starts: "any" needs a table'):
        from_gymnasium(environments.Slippery(), starts="any")


class Rooms(gymnasium.Env):
    """Four rooms in a row; only the door of the room's number leads on, any other to a pit; masks are in `info`."""

    observation_space, action_space = spaces.Discrete(5), spaces.Discrete(3)

    def info(self):
        return {"action_mask": (np.arange(3) == self.room).astype(np.int8)}

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.room = 0
        return self.room, self.info()

    def step(self, action):
        self.room = self.room + 1 if action == self.room else 4
        return self.room, float(self.room == 3), self.room >= 3, False, self.info()


@pytest.mark.parametrize("method", ["enumerate", "step"])
def test_masks_of_environments(method):
    world = from_gymnasium(Rooms(), method=method)
    assert not world.all_legal
    assert world.legal_actions(world.reset(1)).tolist() == [[True, False, False]]
    for planner in (SamplingPlanner(UniformPrior(3), 3, 4, objective="return"), ExhaustivePlanner(3)):
        decision = planner.plan(world, world.reset(2), seeded(0))
        assert decision.plan.tolist() == [[0, 1, 2]] * 2
        assert decision.score.tolist() == [1, 1]
    if method == "enumerate":  # the pit is never reached
        assert world.num_states == 4
        assert world.rollout(world.reset(1), every_plan(3, 3)[None]).rewards.sum() == 1
    check_world(world)


class Ring(gymnasium.Env):
    """Ten cells in a ring, and something that grows with each step."""

    observation_space, action_space = spaces.Discrete(10), spaces.Discrete(2)

    def __init__(self, first, grow, matters=None):
        self.first, self.grow, self.matters = first, grow, matters

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.cell, self.memory = 0, {"deep": [self.first()]}
        return 0, {}

    def step(self, action):
        self.memory["deep"][0] = self.grow(self.memory["deep"][0])
        back = self.matters is not None and self.matters(self.memory["deep"][0])
        self.cell = (self.cell + (-1 if back else 1) * (2 * int(action) - 1)) % 10
        return self.cell, float(self.cell == 5), False, False, {}


def appended(history):
    history.append("step")
    return history


GROWING = {
    "number": (int, lambda n: n + 1, lambda n: n % 3 == 0),
    "countdown": (float, lambda x: x - 0.5, lambda x: x % 1 == 0),
    "list": (list, appended, lambda history: len(history) % 3 == 0),
    "set": (set, lambda s: s | {len(s)}, lambda s: len(s) % 3 == 0),
    "text": (str, lambda s: s + "a", lambda s: len(s) % 3 == 0),
    "array": (lambda: np.zeros(3), lambda a: a + np.eye(3)[1], lambda a: a[1] % 3 == 0),
    "tensor": (lambda: torch.zeros(2), lambda a: a + 1, lambda a: a[0] % 3 == 0),
}


@pytest.mark.parametrize("name", GROWING)
def test_what_grows_is_set_back_or_named(name):
    first, grow, matters = GROWING[name]
    assert from_gymnasium(Ring(first, grow)).num_states == 10
    with refuses('`memory["deep"][0]', "changes with each step", 'method="step"'):
        from_gymnasium(Ring(first, grow, matters))


def test_a_stepped_minigrid_conforms():
    pytest.importorskip("minigrid")
    check_world(from_gymnasium("MiniGrid-DoorKey-5x5-v0", method="step", seeds=[0]), num_states=10)


class Zoo(gymnasium.Env):
    """A line of 9 places, on by one or by two; its observation says what is legal, as PettingZoo's do."""

    action_space = gymnasium.spaces.Discrete(2)
    observation_space = gymnasium.spaces.Dict(
        {"place": gymnasium.spaces.Discrete(9), "action_mask": gymnasium.spaces.MultiBinary(2)}
    )

    def observe(self):
        return {"place": self.place, "action_mask": np.array([True, self.place not in (2, 4)], np.int8)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self.observe(), {}

    def step(self, action):
        self.place = min(self.place + 1 + int(action), 8)
        return self.observe(), float(self.place), self.place == 8, False, {}


@pytest.mark.parametrize("method", ["step", "enumerate"])
def test_masks_in_observations_count(method):
    world = from_gymnasium(Zoo, method=method, progress=False)
    start = world.reset(1)
    assert not world.all_legal
    decision = SamplingPlanner(UniformPrior(2), 4, 64, objective="return").plan(world, start, seeded(0))
    assert decision.plan.tolist() == [[1, 0, 1, 1]]  # not 2, 4, 6 and 8
    assert decision.score.tolist() == [2 + 3 + 5 + 7]
