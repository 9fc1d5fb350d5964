"""Gymnasium environments: opened without time limits, with named actions, and observations as features."""

import copy
from collections.abc import Callable
from enum import Enum
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

NAMES = {
    "TaxiEnv": ("south", "north", "east", "west", "pickup", "dropoff"),
    "CliffWalkingEnv": ("up", "right", "down", "left"),
    "FrozenLakeEnv": ("left", "down", "right", "up"),
}
"""Names of the actions of the toy texts, which do not give them."""

REGISTERED_BY = {"MiniGrid": "minigrid", "BabyAI": "minigrid"}
"""Modules that must be imported before Gymnasium knows their environments."""


def open_environment(env: Any, options: dict[str, Any]) -> tuple[Any, Callable[[], Any]]:
    """The environment without its time limits and checks, and a function that makes others of its kind.

    Args:
        env: an instance, which stays as it is, a name, or a function.
        options: how one is made from its name.

    Raises:
        ImportError: Gymnasium is not installed.
        ValueError: it cannot be made, or its actions are not discrete.
    """
    gymnasium = import_gymnasium()
    if isinstance(env, str):
        make = partial(_make, env, options)
        opened = make()
    elif options:
        raise ValueError(f"{next(iter(options))}: options make an environment from its name; this one is made already")
    elif isinstance(env, gymnasium.Env):
        opened = without_limits(env)
        make = partial(copy.deepcopy, opened)
    else:
        opened = without_limits(env()) if callable(env) else env
        make = partial(_call, env)
    if not isinstance(opened, gymnasium.Env):
        raise ValueError(
            "`env` must be the name of an environment, a gymnasium.Env or a function that makes one, got"
            f" {type(env).__name__}"
        )
    if not isinstance(opened.action_space, gymnasium.spaces.Discrete):
        raise ValueError(f"`env` must have discrete actions, got those of the space {opened.action_space}")
    return opened, make


def import_gymnasium() -> Any:
    """The module, or an ImportError that says how to get it."""
    try:
        return import_module("gymnasium")
    except ImportError as error:
        raise ImportError(f"Gymnasium cannot be used ({error}); pip install 'neuroprior[gym]'") from error


def _make(name: str, options: dict[str, Any]) -> Any:
    gymnasium = import_gymnasium()
    for start, module in REGISTERED_BY.items():
        if name.startswith(start):
            try:
                import_module(module)
            except ImportError as error:
                raise ImportError(f"{name} needs {module} ({error}); pip install 'neuroprior[gym]'") from error
    try:
        return without_limits(gymnasium.make(name, disable_env_checker=True, **options))
    except (gymnasium.error.Error, ImportError, TypeError, ValueError, AssertionError) as error:
        raise ValueError(f"env: {name} cannot be made: {' '.join(str(error).split())[:200]}") from error


def _call(make: Callable[[], Any]) -> Any:
    return without_limits(make())


def without_limits(env: Any) -> Any:
    """`env` without time limits and checks at any depth; other wrappers are kept, and `env` itself stays as it is."""
    gymnasium = import_gymnasium()
    wrappers = gymnasium.wrappers
    if not isinstance(env, gymnasium.Wrapper):
        return env
    inner = without_limits(env.env)
    if isinstance(env, (wrappers.TimeLimit, wrappers.OrderEnforcing, wrappers.PassiveEnvChecker)):
        return inner
    outer = copy.copy(env)
    outer.env = inner
    return outer


def action_names(env: Any) -> tuple[str, ...] | None:
    """The names of the actions, where they are known."""
    base, number = env.unwrapped, int(env.action_space.n)
    names = NAMES.get(type(base).__name__, ())
    actions = getattr(base, "actions", None)
    if isinstance(actions, type) and issubclass(actions, Enum):
        names = tuple(action.name for action in actions)
    return names if len(names) == number else None


class Flattener:
    """The numbers in observations of any space, concatenated, without texts and all that has no fixed length.

    Args:
        space: of the observations.

    Attributes:
        size: how many numbers there are.
    """

    def __init__(self, space: Any) -> None:
        self._space = space
        self.size = len(self(copy.deepcopy(space).sample()))

    def __call__(self, observation: Any) -> np.ndarray[Any, Any]:
        """float32 `[C]`."""
        return self._flatten(self._space, observation)

    def _flatten(self, space: Any, observation: Any) -> np.ndarray[Any, Any]:
        spaces = import_gymnasium().spaces
        if isinstance(space, spaces.Dict):
            parts = [self._flatten(inner, observation[key]) for key, inner in space.spaces.items()]
        elif isinstance(space, spaces.Tuple):
            parts = [self._flatten(inner, value) for inner, value in zip(space.spaces, observation, strict=True)]
        elif _is_flat(space) and not isinstance(space, spaces.Text):
            parts = [np.asarray(spaces.flatten(space, observation), dtype=np.float32).ravel()]
        else:
            parts = []
        return np.concatenate([np.zeros(0, np.float32), *parts])


def has_real_numbers(space: Any) -> bool:
    """Whether observations of `space` hold floating point numbers."""
    spaces = import_gymnasium().spaces
    if isinstance(space, spaces.Dict):
        return any(has_real_numbers(inner) for inner in space.spaces.values())
    if isinstance(space, spaces.Tuple):
        return any(has_real_numbers(inner) for inner in space.spaces)
    return isinstance(space, spaces.Box) and bool(np.issubdtype(space.dtype, np.floating))


def _is_flat(space: Any) -> bool:
    """Whether each element of a space has the same number of numbers."""
    try:
        return bool(space.is_np_flattenable)
    except NotImplementedError:  # custom spaces need not say
        return False
