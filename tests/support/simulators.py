"""Small simulators of one's own, each with one habit that a world must cope with or refuse."""

import copy
import random

import gymnasium
import numpy as np


class Walk:
    """A line of numbers from 0: action 0 goes down, 1 goes up; 3 ends the episode with a reward of 1."""

    def __init__(self):
        self.place = 0

    def step(self, action):
        self.place += 2 * action - 1
        return self.place, float(self.place == 3), self.place == 3


class Slip(Walk):
    """Goes the other way with probability 0.3, by a generator of any kind that it is given."""

    def __init__(self, draw):
        super().__init__()
        self.draw = draw

    def step(self, action):
        return super().step(1 - action if self.draw.random() < 0.3 else action)


class Unseedable(Walk):
    """Slips by a generator that it makes at each step."""

    def step(self, action):
        return super().step(1 - action if np.random.default_rng().random() < 0.3 else action)


class Cells(Walk):
    """Holds its place in a list."""

    def __init__(self):
        self.cells = [0]

    def step(self, action):
        self.cells[0] += 2 * action - 1
        return self.cells[0], float(self.cells[0] == 3), self.cells[0] == 3


class ShallowClone(Cells):
    def clone(self):
        return copy.copy(self)


class ClassHeld(Walk):
    """Holds its place in a list of its class."""

    cells = [0]  # noqa: RUF012

    def step(self, action):
        self.cells[0] += 2 * action - 1
        return self.cells[0], 0.0, False


class Clone(Cells):
    def clone(self):
        other = Clone()
        other.cells = list(self.cells)
        return other

    def __deepcopy__(self, memo):
        raise AssertionError("it has a clone()")


class States(Cells):
    """Gives its state away, which then goes on to change."""

    def get_state(self):
        return self.cells

    def set_state(self, cells):
        self.cells = cells


class Doors:
    """Rooms in a row; from a room only the action of its number (modulo 3) leads on, any other raises an error."""

    def __init__(self):
        self.room = 0

    def step(self, action):
        assert self.legal()[action]
        self.room += 1
        return self.room, float(self.room == 4), False

    def legal(self):
        return np.arange(3) == self.room % 3 if self.room < 4 else np.zeros(3, bool)


class DoorsWithMethod(Doors):
    def action_masks(self):
        return self.legal()


class DoorsWithInfo(Doors):
    def step(self, action):
        return *super().step(action), False, {"action_mask": self.legal().astype(np.int8)}


class NoisyStart(gymnasium.Env):
    """Where it starts is random; its steps are not."""

    observation_space, action_space = gymnasium.spaces.Discrete(50), gymnasium.spaces.Discrete(2)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = int(self.np_random.integers(0, 3))
        return self.cell, {}

    def step(self, action):
        self.cell = max(self.cell + 2 * int(action) - 1, 0)
        return self.cell, float(self.cell == 4), self.cell == 4, False, {}


class NoisySteps(NoisyStart):
    """Starts at 1; steps slip by Gymnasium's generator."""

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 1
        return self.cell, {}

    def step(self, action):
        return super().step(1 - action if self.np_random.random() < 0.3 else action)


class NoisyByModule(NoisySteps):
    """Slips by the module `random`."""

    def step(self, action):
        return NoisyStart.step(self, 1 - action if random.random() < 0.3 else action)


SIGMAS = 5
"""Standard errors by which two means may differ: by chance more with a probability of 6e-7."""


class ReusedReward:
    """Returns the same array as reward after each step, with another value."""

    def __init__(self):
        self.place, self.reward = 0, np.zeros(())

    def step(self, action):
        self.place += 2 * action - 1
        self.reward[...] = self.place
        return None, self.reward, False


class ReusedObservation:
    """Observes the same array after each step, with another value."""

    def __init__(self):
        self.seen = np.zeros(1, np.float32)

    def step(self, action):
        self.seen[0] += 2 * action - 1
        return self.seen, 0.0, False


class GoalOutsideState:
    """Its goal is no part of what `get_state` returns, and differs from one to another."""

    def __init__(self, goal):
        self.goal, self.place = goal, 0

    def get_state(self):
        return self.place

    def set_state(self, place):
        self.place = place

    def step(self, action):
        self.place += 2 * action - 1
        return None, float(self.place == self.goal), self.place == self.goal


class Views:
    """Two arrays that are one: copies by pickle lose that."""

    def __init__(self):
        self.board, self.time = np.zeros(40), 0
        self.grid = self.board.reshape(8, 5)

    def step(self, action):
        self.board[self.time] = action + 1
        self.time += 1
        return None, float(self.grid.sum() if action == 0 else 0.5), self.time == 40
