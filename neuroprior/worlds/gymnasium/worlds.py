"""`from_gymnasium`: Gymnasium environments as worlds."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from neuroprior.worlds.gymnasium.enumeration import enumerate_states
from neuroprior.worlds.gymnasium.opening import import_gymnasium, open_environment
from neuroprior.worlds.gymnasium.stepping import SteppedWorld
from neuroprior.worlds.gymnasium.tables import has_table, read_table
from neuroprior.worlds.world import World

if TYPE_CHECKING:
    import gymnasium

METHODS = ("auto", "table", "enumerate", "step")


def from_gymnasium(
    env: "str | gymnasium.Env[Any, Any]",
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

    Three ways, by `method`:

    - "table": toy texts (Taxi, CliffWalking, FrozenLake), whose transitions are read from their attribute `P`, with
      their probabilities where there is chance. The result is a `TabularWorld`.
    - "enumerate": any environment without chance (MiniGrid, say). All states that can be reached are found breadth
      first, by copies of the environment, and told apart by all attributes of it and its wrappers; the result is a
      `TabularWorld`. Attributes that only count steps are set back to their first value before each step: there is no
      limit of time, and where a reward falls with the number of steps (MiniGrid: 1 - 0.9 * steps / max_steps), it is
      the reward of a first step. What was found is checked: transitions are repeated under other random numbers (those
      of the first 100 states and of every tenth), and random walks compared with the environment.
    - "step": any environment, by stepping copies of it, slowly. A state is the history of actions since the start,
      which is replayed where copies cannot be trusted; the result is a `SteppedWorld`. Chance is whatever the seed
      makes of it: plans are tried on the very course that they would take.

    "auto" takes a table where there is one, steps where observations are real numbers, and enumerates otherwise.

    An episode that has ended stays as it is, without rewards. Limits of time that are wrappers (`TimeLimit`) are taken
    off: plans have a length of their own.

    Args:
        env: the name of an environment, or one, which is then reset, stepped and copied.
        method: see above.
        max_states: for "enumerate": the most states that may be found.
        horizon: for "step": the most actions that a state may have behind it.
        starts: "initial": `reset` draws how episodes start. "any": any state that can be reached and is no end, with
            equal probability; for tables.
        observations: for "enumerate": `observe` returns the environment's observations, float32 `[N, C]` (texts left
            out), rather than the number of the state. "step" always does; the toy texts show the number of the state.
        progress: for "enumerate": show a bar on a terminal (needs rich).
        seed: of the environment's `reset`; for all but "table", which draws starts itself.
        seeds: several of them, instead of `seed`: layouts, disjoint and side by side in one world, that `reset` draws
            from equally. `world.layout(state)` tells which.
        **make_options: for `gymnasium.make`.

    Returns:
        An `EpisodicWorld` (a `TabularWorld` with `starts`, `ended` and `layout`), or a `SteppedWorld`.

    Raises:
        ImportError: Gymnasium, or the package of the environment, is not installed.
        ValueError: the environment cannot be made, its actions are not discrete, it does not do what the method needs
            (the message says what), or an argument is out of range.
    """
    if method not in METHODS:
        raise ValueError(f'method: "auto", "table", "enumerate" or "step" is expected, not {method!r}')
    if starts not in ("initial", "any"):
        raise ValueError(f'starts: "initial" or "any" is expected, not {starts!r}')
    if max_states < 1 or horizon < 1:
        raise ValueError(f"max_states and horizon: at least 1 is expected, not {max_states} and {horizon}")
    given = [seed] if seeds is None else list(seeds)
    if not given or any(not isinstance(one, int | np.integer) or one < 0 for one in given):
        raise ValueError(f"seeds: one or more integers that are not negative are expected, not {given}")
    chosen = [int(one) for one in given]
    opened = open_environment(env, make_options)
    if method == "auto":
        real = _has_real_numbers(opened.observation_space)
        method = "table" if has_table(opened) else "step" if real else "enumerate"
    if method == "step":
        if starts == "any":
            raise ValueError('starts: "any" needs a table of all states, which method="step" does not have')
        return SteppedWorld(opened, chosen, horizon)
    if method == "table" and seeds is not None:
        raise ValueError('seeds: a table read from P has one layout; use method="enumerate"')
    if method == "table":
        world = read_table(opened)
    else:
        world = enumerate_states(opened, chosen, max_states, progress, observations)
    return world.start_anywhere() if starts == "any" else world


def _has_real_numbers(space: Any) -> bool:
    """Whether observations of `space` hold floating point numbers."""
    spaces = import_gymnasium().spaces
    if isinstance(space, spaces.Dict):
        return any(_has_real_numbers(inner) for inner in space.spaces.values())
    if isinstance(space, spaces.Tuple):
        return any(_has_real_numbers(inner) for inner in space.spaces)
    return isinstance(space, spaces.Box) and bool(np.issubdtype(space.dtype, np.floating))
