"""Enumerated environments against what is known of their states, against themselves, and what is refused."""

import copy
import pickle
import random
import warnings
from collections import deque
from dataclasses import dataclass
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch

from neuroprior import ExhaustivePlanner, from_gymnasium, oracle
from neuroprior.testing import check_world
from tests.support import environments
from tests.support.sources import refuses, seeded


def minigrid_key(env, ended):
    """All of MiniGrid's hidden state but for its step counter, as its authors name it."""
    carrying = None if env.carrying is None else env.carrying.encode()
    return env.grid.encode().tobytes(), tuple(int(v) for v in env.agent_pos), int(env.agent_dir), carrying, ended


def number_of_states(env):
    """By a search that knows MiniGrid."""
    found, waiting = {minigrid_key(env, False)}, [env]
    while waiting:
        saved = pickle.dumps(waiting.pop())  # several times as fast to copy from as the environment itself
        for action in range(7):
            after = pickle.loads(saved)
            after.step_count = 0
            _, _, ended, _, _ = after.step(action)
            key = minigrid_key(after, ended)
            if key not in found:
                found.add(key)
                waiting += [] if ended else [after]
    return len(found)


@pytest.mark.parametrize("kind", [environments.Corridor, environments.NumpyClock])
def test_a_corridor_and_its_counter(kind):
    world = from_gymnasium(kind(), observations=True)
    assert world.next_state.tolist() == [[0, 1], [0, 2], [1, 3], [2, 4], [4, 4]]
    assert world.ended.tolist() == [False] * 4 + [True]
    assert world.reset(3).tolist() == [0] * 3
    # The reward of a first step, whatever the number of steps before it.
    assert world.reward[0].nonzero().tolist() == [[3, 1]]
    assert float(world.reward[0, 3, 1]) == pytest.approx(1 - 0.9 / 100)
    assert world.observe(torch.arange(5)).equal(torch.eye(5, 10))
    assert from_gymnasium(environments.Corridor()).observe(torch.arange(5)).tolist() == [0, 1, 2, 3, 4]
    check_world(world)


def test_states_with_equal_observations_are_distinguished():
    world = from_gymnasium(environments.Keys())
    assert world.num_states == 4
    assert world.next_state[0].tolist() == [1, 0, 0]
    start = world.reset(1)
    assert [float(oracle(world, start, length, any_prefix=True)) for length in (2, 3)] == [0, 1]
    assert ExhaustivePlanner(3).plan(world, start).plan.tolist() == [[0, 1, 2]]


@dataclass
class Box:
    number: int


class Slotted:
    __slots__ = ("number",)

    def __init__(self, number):
        self.number = number


class SlottedBefore(Slotted):
    """Has a place for any attribute, and keeps its number in the slot of its base class."""


class Private:
    __slots__ = ("__number",)

    def __init__(self, number):
        self.__number = number

    def number(self):
        return self.__number


class NamedList(list):
    pass


def named_list(number):
    made = NamedList()
    made.number = number
    return made


WAYS_TO_KEEP = {
    "array": (np.array, int),
    "large array": (lambda n: np.full((10, 10), n), lambda kept: int(kept[0, 0])),
    "array of objects": (lambda n: np.array([{"n": n}], object), lambda kept: kept[0]["n"]),
    "tensor": (torch.tensor, int),
    "object": (Box, lambda kept: kept.number),
    "slots": (Slotted, lambda kept: kept.number),
    "inherited slots": (SlottedBefore, lambda kept: kept.number),
    "private slots": (Private, lambda kept: kept.number()),
    "deep": (lambda n: {"a": [(Box(n),)]}, lambda kept: kept["a"][0][0].number),
    "set": (lambda n: {n}, min),
    "deque": (lambda n: deque([n]), lambda kept: kept[0]),
    "partial": (lambda n: partial(int, n), lambda kept: kept()),
    "subclass": (named_list, lambda kept: kept.number),
    "float": (lambda n: n / 7, lambda kept: round(kept * 7)),
}


@pytest.mark.parametrize("way", WAYS_TO_KEEP)
def test_states_are_distinguished_however_they_are_stored(way):
    world = from_gymnasium(environments.Hidden(*WAYS_TO_KEEP[way]))
    assert world.next_state.tolist() == [[0, 1], [0, 2], [1, 3], [2, 4], [4, 4]]


def test_a_counter_that_matters_is_kept():
    with refuses("`clock` changes with each step, and matters", 'method="step"'):
        from_gymnasium(environments.Light())
    world = from_gymnasium(environments.Fuse(), observations=True)
    state = world.reset(1)
    for step in range(6):
        assert not world.ended[state]
        assert int(world.observe(state).argmax()) // 10 == step
        state, _ = world.step(state, torch.tensor([1]))
    assert world.ended[state]


def test_limits_of_time_are_taken_off_and_other_wrappers_kept():
    limited = gymnasium.wrappers.TimeLimit(environments.Corridor(), 2)
    doubled = gymnasium.wrappers.TransformReward(limited, lambda reward: 2 * reward)
    world = from_gymnasium(doubled)
    assert float(oracle(world, world.reset(1), 4, objective="return")) == pytest.approx(2 * (1 - 0.9 / 100))
    assert doubled.env is limited


def test_observations_of_many_kinds():
    world = from_gymnasium(environments.Pictures(), observations=True)
    state, _ = world.step(world.reset(1), torch.tensor([1]))
    picture, place, two = [1.0] * 4, [0.0, 1, 0, 0, 0], [1.0, 0, 1]
    assert world.observe(state)[0].tolist() == [*picture, *place, *two]


@pytest.mark.parametrize(
    ("name", "limit"),
    [
        pytest.param("MiniGrid-DoorKey-5x5-v0", 250, marks=pytest.mark.slow, id="key"),
        pytest.param("MiniGrid-MultiRoom-N2-S4-v0", 40, id="rooms"),
    ],
)
def test_minigrid(name, limit):
    world = from_gymnasium(name, seeds=[5], observations=True)
    env = gymnasium.make(name).unwrapped
    env.reset(seed=5)
    assert world.num_states == number_of_states(copy.deepcopy(env))
    assert world.action_names == ("left", "right", "forward", "pickup", "drop", "toggle", "done")
    env.action_space.seed(0)
    state, ends = world.reset(1), 0
    for _ in range(400):
        env.step_count = 0  # so that rewards are those of a first step, and time never runs out
        action = int(env.action_space.sample())
        observed, reward, ended, _, _ = env.step(action)
        state, gained = world.step(state, torch.tensor([action]))
        assert float(gained) == pytest.approx(reward)
        assert bool(world.ended[state]) == ended
        features = world.observe(state)[0]
        assert features[:4].argmax() == observed["direction"]
        assert features[4:].equal(torch.as_tensor(observed["image"]).float().flatten())
        if ended:
            env.reset(seed=5)
            state, ends = world.reset(1), ends + 1
    best = float(oracle(world, world.reset(1), 60, objective="terminal", any_prefix=True))
    assert best == pytest.approx(1 - 0.9 / limit)
    check_world(world)


def test_layouts_side_by_side():
    seeds = [3, 11, 7, 8]
    world = from_gymnasium(environments.Layouts(), seeds=seeds)
    assert world.num_layouts == 4
    layout = world.layout(torch.arange(world.num_states))
    assert world.layout(world.next_state).equal(layout[:, None].expand(-1, 2))
    single = [from_gymnasium(environments.Layouts(), seeds=[seed]) for seed in seeds]
    sizes = [one.num_states for one in single]
    assert layout.bincount().tolist() == sizes
    assert len(set(sizes)) > 1
    assert world.layout(world.starts.nonzero()[:, 0]).tolist() == [0, 1, 2, 3]
    for one, first in zip(single, torch.tensor([0, *sizes]).cumsum(0).tolist(), strict=False):
        own = slice(first, first + one.num_states)
        assert (world.next_state[own] - first).equal(one.next_state)
        assert world.reward[0, own].equal(one.reward[0])
    anywhere = from_gymnasium(environments.Layouts(), seeds=seeds, starts="any")
    assert (anywhere.starts > 0).equal(~anywhere.ended)
    check_world(anywhere)


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (environments.Slippery, ["it is stochastic", 'method="step"']),
        (environments.Unseeded, ["it is stochastic"]),
        (environments.Forgetful, ["it is stochastic"]),
        (environments.Uncopied, ["copies of it do not behave as it does"]),
        (environments.Opaque, ["a Match cannot be read", 'method="step"']),
    ],
)
def test_what_cannot_be_enumerated_is_refused(env, words):
    with refuses(*words):
        from_gymnasium(env, method="enumerate")


@pytest.mark.parametrize(
    ("make", "draw"),
    [
        (np.random.default_rng, lambda dice: dice.random()),
        (np.random.RandomState, lambda dice: dice.rand()),
        (random.Random, lambda dice: dice.random()),
        (seeded, lambda dice: float(torch.rand((), generator=dice))),
    ],
    ids=["generator", "random state", "random", "torch"],
)
def test_randomness_deep_inside_is_noticed(make, draw):
    with refuses("it is stochastic"):
        from_gymnasium(environments.Deep(make, draw), method="enumerate")
    assert from_gymnasium(environments.Deep(make, draw)).stochastic


def test_too_many_states():
    with refuses("max_states: there are more than 3 states", "allow more"):
        from_gymnasium(environments.Corridor(), max_states=3)
    assert from_gymnasium(environments.Corridor(), max_states=5).num_states == 5


def test_a_bar_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    from_gymnasium(environments.Corridor())
    assert "5 of 5 states" in capsys.readouterr().err
    from_gymnasium(environments.Corridor(), progress=False)
    assert capsys.readouterr().err == ""


def test_one_start_for_all_episodes_is_said():
    """Without seeds this table holds what can be reached from one of many starts, which nothing else would show."""
    with pytest.warns(UserWarning, match="seed 3 alone.*seeds=range"):
        world = from_gymnasium(environments.Layouts(), seed=3)
    assert int((world.starts > 0).sum()) == 1
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="env: it starts otherwise")
        from_gymnasium(environments.Layouts(), seeds=[3])
        from_gymnasium(environments.Corridor())


def test_rewards_that_depend_on_a_counter_are_said():
    """Each second step pays: in a table each does, as the first."""

    class Rhythm(gymnasium.Env):
        action_space, observation_space = gymnasium.spaces.Discrete(2), gymnasium.spaces.Discrete(11)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.cell, self.time = 5, 0
            return 5, {}

        def step(self, action):
            self.time += 1
            self.cell = min(10, max(0, self.cell + 2 * int(action) - 1))
            return self.cell, float(action == self.time % 2), False, False, {}

    with pytest.warns(UserWarning, match="rewards depend on `time`, which each step changes") as caught:
        from_gymnasium(Rhythm(), progress=False)
    assert caught[0].filename == __file__
    world = from_gymnasium(Rhythm(), method="step", progress=False)
    assert world.rollout(world.reset(1), torch.tensor([[[1, 0, 0, 1]]])).rewards.flatten().tolist() == [1, 1, 0, 0]
