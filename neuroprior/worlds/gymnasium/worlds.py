"""`from_gymnasium`: Gymnasium environments as worlds."""

import warnings
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

from neuroprior._checks import check_sizes
from neuroprior.worlds.episodes import EpisodicWorld
from neuroprior.worlds.gymnasium.environment import Episode, import_gymnasium, open_environment
from neuroprior.worlds.gymnasium.stepping import SteppedWorld
from neuroprior.worlds.gymnasium.tables import enumerate_states, has_table, read_table
from neuroprior.worlds.world import World

METHODS = ("auto", "table", "enumerate", "step")


def from_gymnasium(
    env: Any,
    *,
    method: Literal["auto", "table", "enumerate", "step"] = "auto",
    max_states: int = 100_000,
    horizon: int = 200,
    starts: Literal["initial", "any"] = "initial",
    observations: bool = False,
    progress: bool = True,
    seed: int = 0,
    seeds: Iterable[int] | None = None,
    **make_options: Any,
) -> World:
    """A Gymnasium environment with discrete actions as a world to plan in.

    Three methods:

    - "table": toy texts (Taxi, CliffWalking, FrozenLake), whose transitions and their probabilities are read from their
      attribute `P`. The result is a `TabularWorld`.
    - "enumerate": any deterministic environment (such as MiniGrid). All reachable states are found breadth first, by
      copies of the environment, and compared by all attributes of it and its wrappers; the result is a `TabularWorld`.
      Attributes that only count steps are set back to their first value before each step: there is no time limit, and
      where a reward decreases with the number of steps (MiniGrid: 1 - 0.9 * steps / max_steps), it is the reward of a
      first step. The result is checked: transitions are repeated under other random numbers (those of the first 100
      states and of every tenth), and random walks are compared with the environment.
    - "step": any environment, by stepping copies of it, slowly. A state is the history of actions since the start,
      which is replayed where the environment cannot be copied; the result is a `SteppedWorld`. What is random is
      determined by the seed: a plan that is executed gives what it gave when it was tried.

    "enumerate" and "step" have as many starts as `seeds`, so that with one seed every episode begins in the same state;
    where other seeds start otherwise, that is a warning.

    "auto" takes a table where there is one, steps where observations are real numbers, and enumerates otherwise.

    An episode that has ended stays in its last state, without rewards. Time limits that are wrappers (`TimeLimit`) are
    removed: plans have a length of their own.

    Args:
        env: the name of an environment, or a `gymnasium.Env`, which is then reset, stepped and copied.
        method: see above.
        max_states: for "enumerate": the most states that may be found.
        horizon: for "step": the most actions that a state may hold.
        starts: for tables: "initial": `reset` draws the initial states of episodes; "any": any reachable state that is
            not terminal, with equal probability.
        observations: for "enumerate": `observe` gives the environment's observations, float32 `[N, C]` (texts left
            out), instead of the number of the state. "step" always does; toy texts give the number of the state.
        progress: for "enumerate": show a bar on a terminal (needs rich).
        seed: of the environment's `reset`; not for "table", which draws starts itself.
        seeds: several of them, instead of `seed`: disjoint layouts in one world, which `reset` draws with equal
            probability; see `world.layout(state)`.
        **make_options: for `gymnasium.make`.

    Returns:
        An `EpisodicWorld` (a `TabularWorld` with `starts`, `ended` and `layout`), or a `SteppedWorld`.

    Raises:
        ImportError: Gymnasium, or the package of the environment, is not installed.
        ValueError: the environment cannot be made, its actions are not discrete, it does not do what the method needs
            (the message says what), or an argument is out of range.

    Warns:
        UserWarning: there is one start, as no `seeds` are given, but the environment starts otherwise with another seed
                (not for "table").

    Example:
        >>> world = from_gymnasium("FrozenLake-v1", progress=False)
        >>> world.num_actions, world.stochastic
        (4, True)
    """
    if method not in METHODS:
        raise ValueError(f'`method` must be "auto", "table", "enumerate" or "step", got {method!r}')
    if starts not in ("initial", "any"):
        raise ValueError(f'`starts` must be "initial" or "any", got {starts!r}')
    check_sizes(max_states=max_states, horizon=horizon)
    given = [seed] if seeds is None else list(seeds)
    if not given or any(not isinstance(one, int | np.integer) or one < 0 for one in given):
        raise ValueError(f"`seeds` must be one or more integers that are not negative, got {given}")
    chosen = [int(one) for one in given]
    opened = open_environment(env, make_options)
    if method == "auto":
        real = _has_real_numbers(opened.observation_space)
        method = "table" if has_table(opened) else "step" if real else "enumerate"
    if method == "step":
        if starts == "any":
            raise ValueError('starts: "any" needs a table of all states, which method="step" does not have')
        world: World = SteppedWorld(opened, chosen, horizon)
    elif method == "enumerate":
        world = enumerate_states(opened, chosen, max_states, progress, observations)
    elif seeds is not None:
        raise ValueError('seeds: a table read from P has one layout; use method="enumerate"')
    else:
        world = read_table(opened)
    if method != "table" and seeds is None and not _starts_alike(opened, seed, seed + 1):
        warnings.warn(
            f"env: it starts otherwise with another seed, but this world has seed {seed} alone: every episode begins in"
            " the same state; for several starts give, for example, seeds=range(100), for one without this warning"
            f" seeds=[{seed}]",
            stacklevel=2,
        )
    return world.start_anywhere() if isinstance(world, EpisodicWorld) and starts == "any" else world


def _starts_alike(env: Any, *seeds: int) -> bool:
    """Whether the first observation is the same after a reset from either of two seeds."""
    first, second = (Episode(env).reset(seed) for seed in seeds)
    return np.array_equal(first, second, equal_nan=True)


def _has_real_numbers(space: Any) -> bool:
    """Whether observations of `space` hold floating point numbers."""
    spaces = import_gymnasium().spaces
    if isinstance(space, spaces.Dict):
        return any(_has_real_numbers(inner) for inner in space.spaces.values())
    if isinstance(space, spaces.Tuple):
        return any(_has_real_numbers(inner) for inner in space.spaces)
    return isinstance(space, spaces.Box) and bool(np.issubdtype(space.dtype, np.floating))
