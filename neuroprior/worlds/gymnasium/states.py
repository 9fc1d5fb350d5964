"""States of Gymnasium environments: copied and restored, compared by all attributes, step counters set back."""

import copy
import hashlib
import itertools
import pickle
import random
from collections.abc import Callable, Iterator
from enum import Enum
from functools import lru_cache
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType, NoneType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuroprior.worlds.gymnasium.environment import TRUNCATED, Episode, Transition, import_gymnasium, layers

WALKS, WALK_LENGTH = 8, 40
"""Random walks by which environments are checked, and actions in each."""

IGNORED = frozenset({"env", "spec", "_np_random_seed", "lastaction"})
"""Attributes that are no part of a state: wrapped environments are read by themselves; `lastaction` is only drawn."""

GENERATORS = (np.random.Generator, np.random.RandomState, random.Random, torch.Generator)


class Copier(NamedTuple):
    """A way to copy an environment: what `save` returns can be restored any number of times."""

    save: Callable[[Any], Any]
    restore: Callable[[Any], Any]


COPIERS = (Copier(pickle.dumps, pickle.loads), Copier(copy.deepcopy, copy.deepcopy))


def walks(num_actions: int) -> list[list[int]]:
    """A few sequences of random actions, the same each time."""
    drawn = np.random.default_rng(0).integers(num_actions, size=(WALKS, WALK_LENGTH))
    return [[int(action) for action in walk] for walk in drawn]


def follow(episode: Episode, actions: list[int]) -> list[Transition]:
    """The transitions of these actions, up to the end of the episode."""
    trajectory: list[Transition] = []
    for action in actions:
        trajectory.append(episode.step(action))
        if trajectory[-1].end:
            break
    return trajectory


def first_difference(first: list[Transition], second: list[Transition]) -> str | None:
    """What differs between two trajectories, in words; None: nothing."""
    for t, (one, other) in enumerate(zip(first, second, strict=False), start=1):
        if not np.array_equal(one.features, other.features, equal_nan=True):
            return f"the observation after {t} actions"
        if one.reward != other.reward:
            return f"the reward of action {t} ({one.reward:g} and {other.reward:g})"
        if one.end != other.end:
            return f"the end of the episode after {t} actions"
    return None if len(first) == len(second) else f"the length of the episode ({len(first)} and {len(second)})"


def nondeterminism(episode: Episode, seed: int) -> str | None:
    """What differs between two trajectories of the same actions from the same seed; None: nothing."""
    for actions in walks(episode.num_actions):
        observation = episode.reset(seed)
        first = follow(episode, actions)
        again = episode.reset(seed)
        if not np.array_equal(observation, again, equal_nan=True):
            return "the first observation"
        difference = first_difference(first, follow(episode, actions))
        if difference is not None:
            return difference
    return None


def exact_copier(episode: Episode, seed: int) -> Copier | None:
    """The first way of copying after which copy and original behave alike, independently; None: there is none."""
    return next((copier for copier in COPIERS if _copies_exactly(episode, seed, copier)), None)


def _copies_exactly(episode: Episode, seed: int, copier: Copier) -> bool:
    original = episode.env
    try:
        for number, actions in enumerate(walks(episode.num_actions)):
            before, after = actions[: 4 * number], actions[4 * number :]
            episode.reset(seed)
            trajectory = follow(episode, before)
            if trajectory and trajectory[-1].end:
                continue
            saved = copier.save(original)
            trajectories = []
            for env in (copier.restore(saved), original, copier.restore(saved)):
                episode.env = env
                trajectories.append(follow(episode, after))
            episode.env = original
            if first_difference(trajectories[0], trajectories[1]) or first_difference(trajectories[2], trajectories[1]):
                return False
    except Exception:  # an environment may fail to be copied in any way of its own
        return False
    finally:
        episode.env = original
    return True


class Counters:
    """The attributes of an environment that only count its steps; set back, so that states do not differ by them.

    An attribute counts steps if on random walks it increases with each step, independently of the actions, and if
    observations and ends are the same when it is set back after each step.

    Args:
        episode: an environment that copies exactly.
        seed: starts the walks.

    Attributes:
        names: pairs of a layer (0 is the outermost wrapper) and an attribute's name.
    """

    def __init__(self, episode: Episode, seed: int) -> None:
        self._values: list[Any] = []
        self.names = _increasing(episode, seed)
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
        """Whether observations and ends stay the same when the counters are set back."""
        for actions in walks(episode.num_actions):
            episode.reset(seed)
            counted = [step._replace(reward=0.0) for step in follow(episode, actions)]
            if counted[-1].end == TRUNCATED:  # presumably a time limit, which need not be the same
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


def _increasing(episode: Episode, seed: int) -> list[tuple[int, str]]:
    """The numbers among the attributes that increase with each step, in the same way on every walk."""
    walked: list[list[dict[tuple[int, str], Any]]] = []
    for actions in walks(episode.num_actions):
        episode.reset(seed)
        values = [_numbers(episode.env)]
        for action in actions:
            ended = episode.step(action).end
            values.append(_numbers(episode.env))
            if ended:
                break
        walked.append(values)
    longest = max(walked, key=len)
    if len(longest) < 3:
        return []

    def counts(key: tuple[int, str]) -> bool:
        if any(key not in numbers for numbers in longest):
            return False
        clock = [numbers[key] for numbers in longest]
        increases = all(later > earlier for earlier, later in itertools.pairwise(clock))
        return increases and all(
            key in numbers and numbers[key] == clock[t] for values in walked for t, numbers in enumerate(values)
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


def reseed(env: Any, seed: int) -> None:
    """Set all random generators that the environment and its wrappers hold, however deep, to other numbers."""
    writer = _Writer()
    writer.environment(env)
    for generator in writer.generators:
        if isinstance(generator, np.random.Generator):
            generator.bit_generator.state = type(generator.bit_generator)(seed).state
        elif isinstance(generator, torch.Generator):
            generator.manual_seed(seed)
        else:
            generator.seed(seed)


def digest(env: Any) -> bytes:
    """A hash of the state, 16 bytes: of all attributes of an environment and its wrappers except random generators.

    Raises:
        ValueError: an attribute cannot be read.
    """
    writer = _Writer()
    writer.environment(env)
    text = "\n".join(writer.parts)
    return hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=16).digest()


class _Writer:
    """Writes values as text that depends on nothing but what they are: not on addresses, dtypes or insertion order.

    Attributes:
        parts: the text so far.
        generators: the random generators, which are not written.
    """

    def __init__(self) -> None:
        self.parts: list[str] = []
        self.generators: list[Any] = []
        self._seen: dict[int, int] = {}
        self._kept: list[Any] = []  # so that no address is used twice

    def environment(self, env: Any) -> None:
        """The attributes of an environment and of its wrappers."""
        for layer in layers(env):
            self._attributes(layer)

    def _attributes(self, thing: Any) -> None:
        values = vars(thing)
        for name in _written(tuple(values)):
            self.parts.append(name)
            self.value(values[name])

    def value(self, value: Any) -> None:
        """Any value, however deep."""
        kind: Any = type(value)
        way = _way(kind)
        if way == "value":
            self.parts.append(repr(value))
        elif way == "enum":
            self.parts.append(repr(value.value))
        elif way == "scalar":
            self.parts.append(repr(value.item()))
        elif way == "named":
            self.parts.append(getattr(value, "__qualname__", value.__name__))
        elif way == "generator":
            self.generators.append(value)
        elif way == "space":
            self.parts.append("space")
        elif way == "array" and value.size > 64 and value.dtype != object:
            self.parts.append(f"{value.dtype}{value.shape}{value.tobytes().hex()}")
        elif way == "array":
            self.value(value.tolist())
        elif way == "tensor":
            self.value(value.detach().cpu().numpy())
        elif id(value) in self._seen:
            self.parts.append(f"@{self._seen[id(value)]}")
        else:
            if not isinstance(value, tuple):  # equal tuples cannot be distinguished
                self._seen[id(value)] = len(self._seen)
                self._kept.append(value)
            self._compound(value)

    def _compound(self, value: Any) -> None:
        kind: Any = type(value)
        self.parts.append("list" if kind is tuple else kind.__qualname__)
        if kind in (list, tuple):
            self.parts.append(str(len(value)))
            for inner in value:
                self.value(inner)
        elif kind in (set, frozenset):
            self.parts.append(",".join(sorted(repr(inner) for inner in value)))
        elif kind is dict:
            self.parts.append(str(len(value)))
            for key in sorted(value, key=repr):
                self.parts.append(repr(key))
                self.value(value[key])
        elif _is_plain(kind):
            self._attributes(value)
        else:
            self._reduced(value)

    def _reduced(self, value: Any) -> None:
        """What pickle would write, for a value that is more than its attributes."""
        try:
            reduced = value.__reduce_ex__(4)
        except Exception as error:
            raise ValueError(
                f'env: it holds a {type(value).__name__}, by which its states cannot be compared; use method="step"'
            ) from error
        for part in reduced:
            self.value(list(part) if isinstance(part, Iterator) else part)


@lru_cache(1000)
def _way(kind: type) -> str:
    """How values of a type are written; one that is made of others, "compound"."""
    if issubclass(kind, (NoneType, int, float, str, bytes, complex)):
        return "enum" if issubclass(kind, Enum) else "value"
    ways = {
        "scalar": np.generic,
        "named": (FunctionType, BuiltinFunctionType, MethodType, ModuleType, type),
        "generator": GENERATORS,
        "space": import_gymnasium().Space,
        "array": np.ndarray,
        "tensor": Tensor,
    }
    return next((way for way, kinds in ways.items() if issubclass(kind, kinds)), "compound")


@lru_cache(1000)
def _written(names: tuple[str, ...]) -> list[str]:
    """Those of the attributes that are part of a state, in order."""
    return sorted(name for name in names if name not in IGNORED)


@lru_cache(1000)
def _is_plain(kind: type) -> bool:
    """Whether values of a type are their attributes, and nothing else."""
    if any(getattr(kind, name) is not getattr(object, name) for name in ("__reduce__", "__reduce_ex__")):
        return False
    return kind.__dictoffset__ != 0 and not any("__slots__" in vars(base) for base in kind.__mro__)
