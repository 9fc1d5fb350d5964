"""Gymnasium environments: opened without time limits, with named actions, and observations as features."""

import copy
from enum import Enum
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

NAMES = {
    "TaxiEnv": ("south", "north", "east", "west", "pickup", "dropoff"),
    "CliffWalkingEnv": ("up", "right", "down", "left"),
    "FrozenLakeEnv": ("left", "down", "right", "up"),
}
"""Names of the actions of the toy texts, which do not give them."""

REGISTERED_BY = {"MiniGrid": "minigrid", "BabyAI": "minigrid"}
"""Modules that must be imported before Gymnasium knows their environments."""

RUNNING, TERMINATED, TRUNCATED = 0, 1, 2


def open_environment(env: Any, options: dict[str, Any]) -> Any:
    """The environment without its time limits and checks: an instance, or one made from its name.

    Raises:
        ImportError: Gymnasium is not installed.
        ValueError: it cannot be made, or its actions are not discrete.
    """
    gymnasium = import_gymnasium()
    if isinstance(env, str):
        env = _make(gymnasium, env, options)
    elif not isinstance(env, gymnasium.Env):
        raise ValueError(f"`env` must be the name of an environment or a gymnasium.Env, got {type(env).__name__}")
    elif options:
        raise ValueError(f"{next(iter(options))}: options make an environment from its name; this one is made already")
    env = _without_limits(gymnasium, env)
    if not isinstance(env.action_space, gymnasium.spaces.Discrete):
        raise ValueError(f"`env` must have discrete actions, got those of the space {env.action_space}")
    return env


def import_gymnasium() -> Any:
    """The module, or an ImportError that says how to get it."""
    try:
        return import_module("gymnasium")
    except ImportError as error:
        raise ImportError(f"Gymnasium cannot be used ({error}); pip install 'neuroprior[gym]'") from error


def _make(gymnasium: Any, name: str, options: dict[str, Any]) -> Any:
    for start, module in REGISTERED_BY.items():
        if name.startswith(start):
            try:
                import_module(module)
            except ImportError as error:
                raise ImportError(f"{name} needs {module} ({error}); pip install 'neuroprior[gym]'") from error
    try:
        return gymnasium.make(name, disable_env_checker=True, **options)
    except (gymnasium.error.Error, ImportError, TypeError, ValueError, AssertionError) as error:
        raise ValueError(f"env: {name} cannot be made: {' '.join(str(error).split())[:200]}") from error


def _without_limits(gymnasium: Any, env: Any) -> Any:
    """`env` without time limits and checks at any depth; other wrappers are kept."""
    wrappers = gymnasium.wrappers
    if not isinstance(env, gymnasium.Wrapper):
        return env
    inner = _without_limits(gymnasium, env.env)
    if isinstance(env, (wrappers.TimeLimit, wrappers.OrderEnforcing, wrappers.PassiveEnvChecker)):
        return inner
    outer = copy.copy(env)  # the caller's wrapper stays as it is
    outer.env = inner
    return outer


def layers(env: Any) -> list[Any]:
    """The wrappers of an environment from the outermost inwards, and the environment itself."""
    found = [env]
    while "env" in vars(found[-1]):
        found.append(found[-1].env)
    return found


def action_names(env: Any) -> tuple[str, ...] | None:
    """The names of the actions, where they are known."""
    base, number = env.unwrapped, int(env.action_space.n)
    names = NAMES.get(type(base).__name__, ())
    actions = getattr(base, "actions", None)
    if isinstance(actions, type) and issubclass(actions, Enum):
        names = tuple(action.name for action in actions)
    return names if len(names) == number else None


class Transition(NamedTuple):
    """What one step gives: the observation, float32 `[C]`, the reward, and whether and how the episode ended."""

    features: np.ndarray[Any, Any]
    reward: float
    end: int


class Episode:
    """An environment in which actions count from 0 and observations are features.

    Args:
        env: with discrete actions.

    Attributes:
        env: the environment; others of its kind may be put in its place.
        num_actions: number of actions.
    """

    def __init__(self, env: Any) -> None:
        self.env = env
        self.num_actions = int(env.action_space.n)
        self._first, self._space = int(env.action_space.start), env.observation_space
        self._spaces = import_gymnasium().spaces

    def reset(self, seed: int) -> np.ndarray[Any, Any]:
        """Reset from `seed`; the observation, float32 `[C]`."""
        observation, _ = self.env.reset(seed=seed)
        return self._features(self._space, observation)

    def step(self, action: int) -> Transition:
        """Take an action."""
        observation, reward, terminated, truncated, _ = self.env.step(action + self._first)
        end = TERMINATED if terminated else TRUNCATED if truncated else RUNNING
        return Transition(self._features(self._space, observation), float(reward), end)

    def _features(self, space: Any, observation: Any) -> np.ndarray[Any, Any]:
        """The numbers in an observation of any space, concatenated, without texts and all that has no fixed length."""
        spaces = self._spaces
        if isinstance(space, spaces.Dict):
            parts = [self._features(inner, observation[key]) for key, inner in space.spaces.items()]
        elif isinstance(space, spaces.Tuple):
            parts = [self._features(inner, part) for inner, part in zip(space.spaces, observation, strict=True)]
        elif _is_flat(space) and not isinstance(space, spaces.Text):
            parts = [np.asarray(spaces.flatten(space, observation), dtype=np.float32).ravel()]
        else:
            parts = []
        return np.concatenate([np.zeros(0, np.float32), *parts])


def _is_flat(space: Any) -> bool:
    """Whether each element of a space has the same number of numbers."""
    try:
        return bool(space.is_np_flattenable)
    except NotImplementedError:  # custom spaces need not say
        return False


def stacked(features: list[np.ndarray[Any, Any]]) -> Tensor:
    """float32 `[N, C]`."""
    return torch.from_numpy(np.stack(features))
