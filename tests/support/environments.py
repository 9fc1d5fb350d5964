"""Small Gymnasium environments, each with one habit that a world must cope with or refuse."""

import random
import re

import gymnasium
import numpy as np
from gymnasium import spaces


class Corridor(gymnasium.Env):
    """Five squares in a row, actions 5 (left) and 6 (right), a step counter; the last square ends the episode.

    Its rewards fall with the number of steps, as MiniGrid's do.
    """

    length = 5

    def __init__(self):
        self.action_space = spaces.Discrete(2, start=5)
        self.observation_space = spaces.Discrete(10)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.clock, self.visited = 0, 0, {0}
        return self.place, {}

    def step(self, action):
        self.clock += 1
        self.place = min(max(self.place + 2 * (action - 5) - 1, 0), self.length - 1)
        done = self.place == self.length - 1
        return self.place, done * (1 - 0.9 * self.clock / 100), done, False, {}


class NumpyClock(Corridor):
    """Counts its steps with one of NumPy's integers."""

    def reset(self, *, seed=None, options=None):
        found = super().reset(seed=seed)
        self.clock = np.int64(0)
        return found


class Layouts(Corridor):
    """The seed decides how long the corridor is, three to nine squares, and where one starts."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.length = int(self.np_random.integers(3, 10))
        self.place = int(self.np_random.integers(self.length - 1))
        return self.place, {}


class Keys(Corridor):
    """Two switches that are hidden, as a set of numbers, and the second opens only after the first."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Discrete(3)

    def step(self, action):
        if action == 0:
            self.visited = self.visited | {1}
        elif action == 1 and 1 in self.visited:
            self.visited = {2} | self.visited
        done = action == 2 and 2 in self.visited
        return 0, float(done), done, False, {}


class Light(Corridor):
    """Moves only every third step: the counter is part of the state, and grows without end."""

    def step(self, action):
        if self.clock % 3:
            self.clock += 1
            return self.place, 0.0, False, False, {}
        observed, _, _, _, info = super().step(action)
        return observed, 0.0, False, False, info


class Fuse(Corridor):
    """Ends after six steps, which its observations show."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Discrete(100)

    def step(self, action):
        super().step(action)
        return self.place + 10 * self.clock, 0.0, self.clock == 6, False, {}


class Slippery(Corridor):
    """Goes the wrong way with probability 1/4, by its own generator: it repeats itself from a seed."""

    def step(self, action):
        slips = self.np_random.random() < 0.25
        return super().step(11 - action if slips else action)


class Dice:
    def __init__(self, generator, draw):
        self.generator, self.draw = generator, draw


class Deep(Corridor):
    """Slips by one of several kinds of generators, which it holds in an object of its own."""

    def __init__(self, make, draw):
        super().__init__()
        self.make, self.draw = make, draw

    def reset(self, *, seed=None, options=None):
        self.dice = Dice(self.make(seed), self.draw)
        return super().reset(seed=seed)

    def step(self, action):
        slips = self.dice.draw(self.dice.generator) < 0.4
        return super().step(11 - action if slips else action)


class Unseeded(Corridor):
    """Slips by the global generator: nothing repeats itself."""

    def step(self, action):
        return super().step(11 - action if random.random() < 0.25 else action)


class Forgetful(Slippery):
    """A copy of it is a new one: it forgets where it is."""

    def __reduce__(self):
        return _started, ()

    def __deepcopy__(self, memo):
        return _started()


def _started():
    env = Forgetful()
    env.reset(seed=0)
    return env


class Uncopied(Corridor):
    """Holds what cannot be copied: a generator."""

    def reset(self, *, seed=None, options=None):
        observed, info = super().reset(seed=seed)
        self.hidden = (n for n in range(3))
        return observed, info


class Opaque(Corridor):
    """Holds what can be copied but not read: a match of a regular expression."""

    def reset(self, *, seed=None, options=None):
        observed, info = super().reset(seed=seed)
        self.hidden = re.match("a", "a")
        return observed, info


class Hidden(Corridor):
    """Keeps its place in `keep`, a way to hold one number."""

    def __init__(self, keep, read):
        super().__init__()
        self.keep, self.read = keep, read

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.kept = self.keep(0)
        return 0, {}

    def step(self, action):
        place = min(max(self.read(self.kept) + 2 * (action - 5) - 1, 0), self.length - 1)
        self.kept = self.keep(place)
        done = place == self.length - 1
        return 0, float(done), done, False, {}


class Pictures(Corridor):
    """Observations of several kinds."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Dict(
            {
                "picture": spaces.Box(0, 255, (2, 2), np.uint8),
                "place": spaces.Discrete(5),
                "say": spaces.Text(10),
                "two": spaces.Tuple((spaces.MultiBinary(1), spaces.Discrete(2, start=3))),
            }
        )

    def _seen(self):
        picture = np.full((2, 2), self.place, np.uint8)
        return {"picture": picture, "place": self.place, "say": "hello", "two": (np.array([1], np.int8), 4)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action):
        _, *rest = super().step(action)
        return self._seen(), *rest
