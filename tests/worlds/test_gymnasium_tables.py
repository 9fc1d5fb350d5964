"""Toy texts as tables, against the environments themselves; start states, ends; what is refused."""

import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv

from neuroprior import from_gymnasium
from neuroprior.testing import check_world
from neuroprior.worlds import EpisodicWorld
from tests.support.environments import Corridor
from tests.support.sources import FALSE_ALARM, p_value, refuses, seeded

TOYS = {
    "Taxi-v4": (501, 6, "south"),
    "CliffWalking-v1": (48, 4, "up"),
    "FrozenLake-v1": (16, 4, "left"),
}


def toy(name, **options):
    if name == "FrozenLake-v1":
        options = {"is_slippery": False, **options}
    return gymnasium.make(name, **options).unwrapped, from_gymnasium(name, **options)


@pytest.mark.parametrize("name", TOYS)
def test_the_table_does_what_the_environment_does(name):
    env, world = toy(name)
    states, actions, first = TOYS[name]
    assert isinstance(world, EpisodicWorld)
    assert (world.num_states, world.num_actions, world.action_names[0]) == (states, actions, first)
    assert not world.stochastic
    env.action_space.seed(0)
    state, ends = env.reset(seed=0)[0], 0
    for _ in range(5000):
        assert world.state_of(env).tolist() == [state]
        action = int(env.action_space.sample())
        observed, reward, terminated, _, _ = env.step(action)
        after, gained = world.step(torch.tensor([state]), torch.tensor([action]))
        assert float(gained) == pytest.approx(reward)
        assert bool(world.ended[after]) == terminated
        if not terminated:
            assert int(after) == observed
        ends += terminated
        state = env.reset()[0] if terminated else observed
    assert ends > 0 or name == "CliffWalking-v1"


@pytest.mark.parametrize("options", [{}, {"map_name": "8x8"}, {"success_rate": 0.8}])
def test_slippery_ice_has_the_probabilities_of_the_environment(options):
    env, world = toy("FrozenLake-v1", is_slippery=True, **options)
    assert world.stochastic
    over = {s for row in env.P.values() for outcomes in row.values() for _, s, _, end in outcomes if end}
    assert over == set(world.ended.nonzero()[:, 0].tolist())
    for state, row in env.P.items():
        for action, outcomes in row.items():
            due, found = {}, {}
            for probability, after, reward, _ in outcomes:
                due[after, float(reward)] = due.get((after, float(reward)), 0) + probability
            for k, probability in enumerate(world.probability[state, action].tolist()):
                key = int(world.next_state[state, action, k]), float(world.reward[0, state, action, k])
                found[key] = found.get(key, 0) + probability
            assert {key: p for key, p in found.items() if p > 0} == pytest.approx(due)


def test_a_rainy_taxi_slips():
    env, world = toy("Taxi-v4", is_rainy=True)
    assert world.stochastic
    state, action = env.encode(2, 2, 0, 1), 1
    expected = sum(p * s for p, s, _, _ in env.P[state][action])
    assert float((world.probability[state, action] * world.next_state[state, action]).sum()) == pytest.approx(expected)


def test_starts():
    env, world = toy("CliffWalking-v1")
    assert world.reset(5).tolist() == [36] * 5
    env, world = toy("Taxi-v4")
    drawn = world.reset(30_000, seeded(0))
    assert p_value(drawn, torch.cat([torch.as_tensor(env.initial_state_distrib), torch.zeros(1)])) > FALSE_ALARM
    anywhere = from_gymnasium("FrozenLake-v1", starts="any").reset(20_000, seeded(1))
    live = torch.tensor([0, 1, 2, 3, 4, 6, 8, 9, 10, 13, 14])
    assert p_value(anywhere, torch.zeros(16).index_fill(0, live, 1.0)) > FALSE_ALARM
    with_passenger = from_gymnasium("Taxi-v4", starts="any").starts
    # The taxi, the passenger in it or at one of three corners: not where he wants to go, where the episode ends.
    assert int((with_passenger > 0).sum()) == 25 * 4 * 4


class Drawn(gymnasium.Env):
    """Steps are drawn from the table `P`."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = int(self.np_random.choice(len(self.P), p=self.initial_state_distrib))
        return self.s, {}

    def step(self, action):
        outcomes = self.P[self.s][action]
        number = self.np_random.choice(len(outcomes), p=[outcome[0] for outcome in outcomes])
        _, self.s, reward, ended = outcomes[number]
        return self.s, reward, ended, False, {}


def test_an_end_that_is_also_passed_through_gets_a_state_of_its_own():
    """From 1 the episode may end in 2, or go on from there."""

    class Both(Drawn):
        def __init__(self):
            self.action_space = gymnasium.spaces.Discrete(2)
            self.observation_space = gymnasium.spaces.Discrete(3)
            self.initial_state_distrib = [1.0, 0.0, 0.0]
            self.P = {
                0: {0: [(1.0, 1, 0.0, False)], 1: [(1.0, 0, 0.0, False)]},
                1: {0: [(1.0, 2, 5.0, True)], 1: [(0.5, 2, 1.0, False), (0.5, 0, 2.0, False)]},
                2: {0: [(1.0, 0, 0.0, False)], 1: [(1.0, 1, 3.0, False)]},
            }

    world = from_gymnasium(Both())
    assert world.ended.tolist() == [False, False, False, True]
    assert world.next_state[1].tolist() == [[3, 0], [2, 0]]
    assert world.probability[1].tolist() == [[1, 0], [0.5, 0.5]]
    assert world.reward[0, 1].tolist() == [[5, 0], [1, 2]]
    assert world.next_state[3].tolist() == [[3, 3], [3, 3]]
    assert world.reward[0, 3].abs().sum() == 0
    check_world(world)


class Line(Drawn):
    """Three states in a row; the last one ends the episode."""

    action_space, observation_space = gymnasium.spaces.Discrete(2), gymnasium.spaces.Discrete(3)
    initial_state_distrib = (1.0, 0.0, 0.0)

    def __init__(self):
        self.P = {s: {a: [(1.0, min(s + a, 2), float(s + a), s + a > 1)] for a in range(2)} for s in range(3)}


class Masked(FrozenLakeEnv):
    def action_masks(self):
        return np.array([True, True, True, self.s > 3])


class Moved(FrozenLakeEnv):
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 14
        return 14, {}


class Generous(Line):
    def step(self, action):
        state, reward, *rest = super().step(action)
        return state, reward + 10, *rest


class Elsewhere(Line):
    initial_state_distrib = (0.0, 1.0, 0.0)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 0
        return 0, {}


def test_a_table_is_read_where_the_environment_does_what_it_says():
    assert from_gymnasium(Line()).num_states == 3
    lake = from_gymnasium(FrozenLakeEnv(is_slippery=False), progress=False)
    masked = from_gymnasium(Masked(is_slippery=False), progress=False)
    assert (lake.all_legal, masked.all_legal) == (True, False)
    moved = from_gymnasium(Moved(is_slippery=False), progress=False)
    assert moved.rollout(moved.reset(1), torch.tensor([[[2]]])).rewards.item() == 1  # from 14 to the right
    generous = from_gymnasium(Generous(), progress=False)
    assert generous.rollout(generous.reset(1), torch.tensor([[[1, 1]]])).rewards.tolist() == [[[11, 12]]]
    patched = Line()
    patched.step = Generous.step.__get__(patched)
    for changed, words in (
        (Masked(), "its `action_masks` is the user's"),
        (Moved(), "its `reset` is the user's"),
        (Generous(), "reward or end than its table says"),
        (Elsewhere(), "it starts in state 0"),
    ):
        with refuses('method="table"', words):
            from_gymnasium(changed, method="table")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({0: {0: [(0.5, 1, 0.0, False)], 1: [(1.0, 0, 0.0, False)]}}, "must sum to 1, got 0.5"),
        ({0: {0: [(1.0, 1, 0.0, False)]}}, "another form (KeyError"),
        ({0: {0: [(1.0, 1, 0.0)], 1: []}}, "another form (ValueError"),
        ({0: {0: [(1.0, 7, 0.0, False)], 1: [(1.0, 0, 0.0, False)]}}, "another"),
    ],
)
def test_tables_that_are_none(change, words):
    env = Line()
    env.P = env.P | change
    env.step = lambda action: (0, 0.0, False, False, {})
    with refuses('method="table"', words):
        from_gymnasium(env, method="table")


class RareNoise(gymnasium.Env):
    """A line of 300 states, in one of which a coin sends to the beginning."""

    action_space, observation_space = gymnasium.spaces.Discrete(2), gymnasium.spaces.Discrete(301)

    def __init__(self, noisy):
        self.noisy = noisy

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 0
        return 0, {}

    def step(self, action):
        if self.s == self.noisy and self.np_random.random() < 0.5:
            self.s = 0
        else:
            self.s = min(self.s + int(action), 300)
        return self.s, float(self.s == 300), self.s == 300, False, {}


@pytest.mark.parametrize("noisy", [155, 157, 203])
def test_noise_in_one_state_far_away_is_found(noisy):
    with refuses("led to two different states", 'method="step"'):
        from_gymnasium(RareNoise(noisy), method="enumerate", progress=False)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: from_gymnasium("Nope-v0"), ["Nope-v0 cannot be made", "doesn't exist"]),
        (lambda: from_gymnasium("FrozenLake-v1", colour="red"), ["cannot be made", "colour"]),
        (lambda: from_gymnasium("Pendulum-v1"), ["those of the space Box", "discrete actions"]),
        (lambda: from_gymnasium(3), ["a function that makes one, got int"]),
        (lambda: from_gymnasium(Corridor(), colour="red"), ["colour: options make an environment from its name"]),
        (lambda: from_gymnasium(Corridor(), method="table"), ['method="table"', "attribute P"]),
        (lambda: from_gymnasium("Taxi-v4", method="table", fickle_passenger=True), ["fickle_passenger"]),
        (lambda: from_gymnasium("Taxi-v4", method="guess"), ["`method` must", "'guess'"]),
        (lambda: from_gymnasium("Taxi-v4", starts="all"), ["`starts` must", "'all'"]),
        (lambda: from_gymnasium("Taxi-v4", seeds=[1, 2]), ["seeds: a table read from P has one layout"]),
        (lambda: from_gymnasium("CartPole-v1", seeds=[]), ["`seeds` must be one or more integers"]),
        (lambda: from_gymnasium("CartPole-v1", seed=-1), ["`seeds` must be one or more integers", "[-1]"]),
        (lambda: from_gymnasium("CartPole-v1", starts="any"), ['starts: "any" needs a table']),
    ],
)
def test_refusals(call, words):
    with refuses(*words):
        call()


def test_an_episodic_world_is_checked():
    stay, good = torch.zeros(2, 1, dtype=torch.long), torch.tensor([True, False])

    def make(ended, starts=(1.0, 1.0), reward=((0.0, 0.0),)):
        return EpisodicWorld(stay, torch.tensor(reward), None, torch.tensor(starts), ended)

    assert make(ended=good).ended.tolist() == [True, False]
    with refuses("ended: every action must stay"):
        make(ended=~good)
    with refuses("`starts` must be one entry for each of 2 states, got 3"):
        make(ended=good, starts=(1.0, 1.0, 1.0))
    with refuses("`starts` must be probabilities"):
        make(ended=good, starts=(0.0, 0.0))
    two = make(ended=good, reward=((0.0, 0.0), (0.0, 0.0)), starts=(0.0, 1.0))
    assert sorted(two.reset(100, seeded(0)).unique().tolist()) == [1, 3]
    weights = torch.tensor([2.0, 6.0])
    assert p_value(make(ended=good, starts=weights.tolist()).reset(4000, seeded(0)), weights) > FALSE_ALARM


def test_what_cannot_occur_is_no_start():
    """Three states in a row; the first action may lead back, with probability 0, to a fourth."""
    after = torch.tensor([[[1, 3]], [[2, 3]], [[2, 2]], [[3, 3]]])
    probability = torch.tensor([[[1.0, 0.0]]]).expand(4, 1, 2)
    ended = torch.tensor([False, False, True, False])
    world = EpisodicWorld(after, torch.zeros(4), None, torch.eye(4)[0], ended, probability=probability)
    assert world.start_anywhere().starts.tolist() == [0.5, 0.5, 0, 0]


def test_gymnasium_is_imported_only_where_it_is_needed(monkeypatch):
    code = "import sys, neuroprior.testing, neuroprior.control.worlds; print({'gymnasium', 'mujoco'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with refuses("pip install 'neuroprior[gym]'", error=ImportError):
        from_gymnasium("Taxi-v4")


def test_goals_of_minigrid_are_solved():
    pytest.importorskip("minigrid")
    world = from_gymnasium("MiniGrid-Empty-5x5-v0", progress=False)
    states = torch.arange(world.num_states)
    assert world.has_goal
    assert world.solved(states).equal(world.terminated(states))
    assert 0 < world.solved(states).sum() < len(states)


def test_lava_and_holes_are_no_goals():
    world = from_gymnasium("FrozenLake-v1")
    states = torch.arange(16)
    assert world.solved(states).nonzero().flatten().tolist() == [15]
    assert world.terminated(states).sum() == 5


def test_a_class_of_one_s_own_is_not_read_by_the_table_of_its_parent():
    class Cold(gymnasium.envs.toy_text.frozen_lake.FrozenLakeEnv):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            return observation, reward - 1, *rest

    world = from_gymnasium(Cold(is_slippery=False), progress=False)
    assert world.rollout(world.reset(1), torch.tensor([[[2, 2, 1, 1]]])).rewards.flatten().tolist() == [-1.0] * 4
