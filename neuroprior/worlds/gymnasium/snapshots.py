"""Snapshots of Gymnasium environments: copies that are checked, and step counters that are set back."""

import copy
import itertools
import pickle
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from neuroprior.worlds.gymnasium.opening import TRUNCATED, Episode, Seen, layers
from neuroprior.worlds.gymnasium.states import IGNORED

WALKS, WALK_LENGTH = 8, 40


class Copier(NamedTuple):
    """A way to copy an environment: what `save` returns can be restored any number of times."""

    save: Callable[[Any], Any]
    restore: Callable[[Any], Any]


COPIERS = (Copier(pickle.dumps, pickle.loads), Copier(copy.deepcopy, copy.deepcopy))


def walks(num_actions: int) -> list[list[int]]:
    """A few sequences of random actions, the same each time."""
    drawn = np.random.default_rng(0).integers(num_actions, size=(WALKS, WALK_LENGTH))
    return [[int(action) for action in walk] for walk in drawn]


def follow(episode: Episode, actions: list[int]) -> list[Seen]:
    """What is seen on the way, up to the end of the episode."""
    course: list[Seen] = []
    for action in actions:
        course.append(episode.step(action))
        if course[-1].end:
            break
    return course


def first_difference(first: list[Seen], second: list[Seen]) -> str | None:
    """What differs between two courses, in words; None where nothing does."""
    for t, (one, other) in enumerate(zip(first, second, strict=False), start=1):
        if not np.array_equal(one.features, other.features, equal_nan=True):
            return f"the observation after {t} actions"
        if one.reward != other.reward:
            return f"the reward of action {t} ({one.reward:g} and {other.reward:g})"
        if one.end != other.end:
            return f"the end of the episode after {t} actions"
    return None if len(first) == len(second) else f"the length of the episode ({len(first)} and {len(second)})"


def unlike_itself(episode: Episode, seed: int) -> str | None:
    """What differs between two courses of the same actions from the same seed; None where nothing does."""
    for actions in walks(episode.num_actions):
        seen = episode.reset(seed)
        first = follow(episode, actions)
        again = episode.reset(seed)
        if not np.array_equal(seen, again, equal_nan=True):
            return "the first observation"
        difference = first_difference(first, follow(episode, actions))
        if difference is not None:
            return difference
    return None


def exact_copier(episode: Episode, seed: int) -> Copier | None:
    """The first way of copying after which copy and original go on alike, each by itself; None where there is none."""
    return next((copier for copier in COPIERS if _copies_exactly(episode, seed, copier)), None)


def _copies_exactly(episode: Episode, seed: int, copier: Copier) -> bool:
    original = episode.env
    try:
        for number, actions in enumerate(walks(episode.num_actions)):
            before, after = actions[: 4 * number], actions[4 * number :]
            episode.reset(seed)
            course = follow(episode, before)
            if course and course[-1].end:
                continue
            saved = copier.save(original)
            courses = []
            for env in (copier.restore(saved), original, copier.restore(saved)):
                episode.env = env
                courses.append(follow(episode, after))
            episode.env = original
            if first_difference(courses[0], courses[1]) or first_difference(courses[2], courses[1]):
                return False
    except Exception:  # an environment may fail to be copied in any way of its own
        return False
    finally:
        episode.env = original
    return True


class Counters:
    """The attributes of an environment that only count its steps; they are set back, so that they tell nothing apart.

    An attribute counts steps if on random walks it grows with each, by what does not depend on the actions, and if
    observations and ends are the same where it is set back after each step.

    Args:
        episode: an environment that copies exactly.
        seed: starts the walks.

    Attributes:
        names: pairs of a layer (0 is the outermost wrapper) and an attribute's name.
    """

    def __init__(self, episode: Episode, seed: int) -> None:
        self._values: list[Any] = []
        self.names = _growing(episode, seed)
        if self.names and not self._idle(episode, seed):
            self.names = []

    def remember(self, env: Any) -> None:
        """Take the values of an environment that was just reset as those to set back to."""
        found = layers(env)
        self._values = [vars(found[layer])[name] for layer, name in self.names]

    def set_back(self, env: Any) -> None:
        """Set the counters of `env` to what they were after its reset."""
        found = layers(env)
        for (layer, name), value in zip(self.names, self._values, strict=True):
            setattr(found[layer], name, value)

    def _idle(self, episode: Episode, seed: int) -> bool:
        """Whether observations and ends stay the same where the counters are set back."""
        for actions in walks(episode.num_actions):
            episode.reset(seed)
            counted = [seen._replace(reward=0.0) for seen in follow(episode, actions)]
            if counted[-1].end == TRUNCATED:  # a limit of time, as far as can be told, which need not count
                counted.pop()
            episode.reset(seed)
            self.remember(episode.env)
            uncounted = []
            for action in actions[: len(counted)]:
                uncounted.append(episode.step(action)._replace(reward=0.0))
                self.set_back(episode.env)
            if first_difference(counted, uncounted) is not None:
                return False
        return True


def _growing(episode: Episode, seed: int) -> list[tuple[int, str]]:
    """The numbers among the attributes that grow with each step, the same way on every walk."""
    courses: list[list[dict[tuple[int, str], Any]]] = []
    for actions in walks(episode.num_actions):
        episode.reset(seed)
        course = [_numbers(episode.env)]
        for action in actions:
            seen = episode.step(action)
            course.append(_numbers(episode.env))
            if seen.end:
                break
        courses.append(course)
    longest = max(courses, key=len)
    if len(longest) < 3:
        return []

    def counts(key: tuple[int, str]) -> bool:
        if any(key not in numbers for numbers in longest):
            return False
        clock = [numbers[key] for numbers in longest]
        grows = all(later > earlier for earlier, later in itertools.pairwise(clock))
        return grows and all(
            key in numbers and numbers[key] == clock[t] for course in courses for t, numbers in enumerate(course)
        )

    return [key for key in longest[0] if counts(key)]


def _numbers(env: Any) -> dict[tuple[int, str], Any]:
    """The attributes that are single numbers, by layer and name."""
    return {
        (number, name): value
        for number, layer in enumerate(layers(env))
        for name, value in vars(layer).items()
        if isinstance(value, (int, float, np.number)) and not isinstance(value, bool) and name not in IGNORED
    }
