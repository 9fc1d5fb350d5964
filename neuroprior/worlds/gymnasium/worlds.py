"""`from_gymnasium`: Gymnasium environments as worlds."""

import warnings
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

from neuroprior._checks import check_sizes
from neuroprior.worlds.gymnasium.environment import (
    Flattener,
    action_names,
    has_real_numbers,
    open_environment,
    without_limits,
)
from neuroprior.worlds.gymnasium.tables import enumerate_states, find_table, read_table
from neuroprior.worlds.observations import Features
from neuroprior.worlds.simulators.building import from_simulator
from neuroprior.worlds.simulators.driver import FromStep
from neuroprior.worlds.simulators.world import SimulatorWorld
from neuroprior.worlds.world import World

METHODS = ("auto", "table", "enumerate", "step")


def from_gymnasium(
    env: Any,
    *,
    method: Literal["auto", "table", "enumerate", "step"] = "auto",
    max_states: int = 100_000,
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
      What only grows with each step (step counters, lists of what happened) is set back to its first value before each
      step, however deep it is. So there is no time limit, and where a reward decreases with the number of steps
      (MiniGrid: 1 - 0.9 * steps / max_steps), it is the reward of a first step. The result is checked: transitions are
      repeated under other random numbers (those of the first 100 states and of every tenth), and random walks are
      compared with the table.
    - "step": any environment, by stepping copies of it, slowly. The result is a `SimulatorWorld`, as `from_simulator`
      makes it. Where the environment is random, each plan meets noise of its own.

    An environment that is given is never reset or stepped. One that was reset already is planned in from its present
    state by "step"; all others start by a reset. By "step" each start is a new reset unless there are `seeds`.
    "enumerate" has as many starts as `seeds`, so that with one seed every episode begins in the same state; where other
    seeds start otherwise, that is a warning.

    "auto" takes a table where there is one, and the environment does on random walks what it says. It steps where
    observations are real numbers or the environment is stochastic, and enumerates otherwise.

    Legal actions are those of a method `action_masks()` or `action_mask()`, of `info["action_mask"]`, or of an
    observation that is a dict, `observation["action_mask"]`. In tables all are legal: the masks of Taxi's `info` leave
    out what changes nothing, which its table has with its rewards.

    An episode that has ended stays in its last state, without rewards. Time limits that are wrappers (`TimeLimit`) are
    removed: plans have a length of their own.

    Args:
        env: the name of an environment, a `gymnasium.Env`, which is copied, or a function that makes one.
        method: see above.
        max_states: for "enumerate": the most states that may be found.
        starts: for tables: "initial": `reset` draws the initial states of episodes; "any": any reachable state that is
            not terminal, with equal probability.
        observations: for "enumerate": `observe` gives the environment's observations, float32 `[N, C]` (texts left
            out), instead of the number of the state. "step" always does; toy texts give the number of the state.
        progress: for "enumerate": show a bar on a terminal (needs rich).
        seed: of the environment's `reset` for "enumerate", and of the walks on which it is tried out.
        seeds: starts are resets by these, which `world.reset` draws with equal probability. For "enumerate" they are
            disjoint layouts in one world; see `world.layout(state)`.
        **make_options: for `gymnasium.make`.

    Returns:
        An `EpisodicWorld` (a `TabularWorld` with `starts`, `ended` and `layout`), or a `SimulatorWorld`.

    Raises:
        ImportError: Gymnasium, or the package of the environment, is not installed.
        ValueError: the environment cannot be made, its actions are not discrete, it does not do what the method needs
            (the message says what), or an argument is out of range.

    Warns:
        UserWarning: it is enumerated, and rewards depend on a counter of steps, which the table leaves out; or it
            starts otherwise with another seed, but no `seeds` are given.

    Example:
        >>> world = from_gymnasium("FrozenLake-v1", progress=False)
        >>> world.num_actions, world.stochastic
        (4, True)
    """
    if method not in METHODS:
        raise ValueError(f'`method` must be "auto", "table", "enumerate" or "step", got {method!r}')
    if starts not in ("initial", "any"):
        raise ValueError(f'`starts` must be "initial" or "any", got {starts!r}')
    check_sizes(max_states=max_states)
    chosen = [seed] if seeds is None else list(seeds) if isinstance(seeds, Iterable) else []
    if not chosen or any(not isinstance(one, int | np.integer) or one < 0 for one in chosen):
        raise ValueError(f"`seeds` must be one or more integers that are not negative, got {chosen or seeds}")
    opened, make = open_environment(env, make_options)
    table = read_table(opened) if method == "table" else find_table(opened) if method == "auto" else None
    if table is not None and seeds is not None:
        raise ValueError('seeds: a table read from P has one layout; use method="enumerate"')
    if table is not None:
        return table.start_anywhere() if starts == "any" else table
    flatten = Flattener(opened.observation_space)
    how: dict[str, Any] = {
        "observe": FromStep(flatten),
        "observation": Features(flatten.size),
        "action_names": action_names(opened),
    }
    if method != "step" and not (method == "auto" and has_real_numbers(opened.observation_space)):
        stepped = from_simulator(make, seed=seed, seeds=[int(one) for one in chosen], **how)
        if method == "enumerate" or not stepped.stochastic:
            table = enumerate_states(stepped, max_states, observations, progress, seed)
            if seeds is None and not _starts_alike(stepped, from_simulator(make, seed=seed, seeds=[seed + 1], **how)):
                warnings.warn(
                    f"env: it starts otherwise with another seed, but this world has seed {seed} alone: every episode"
                    " begins in the same state; for several starts give, for example, seeds=range(100), for one"
                    f" without this warning seeds=[{seed}]",
                    stacklevel=2,
                )
            return table.start_anywhere() if starts == "any" else table
    if starts == "any":
        raise ValueError('starts: "any" needs a table of all states, which method="step" does not have')
    running = seeds is None and hasattr(env, "step") and not isinstance(env, type)
    world = from_simulator(opened if running else make, seed=seed, seeds=None if seeds is None else chosen, **how)
    world.prepare = without_limits
    return world


def _starts_alike(world: SimulatorWorld, other: SimulatorWorld) -> bool:
    """Whether two worlds of one start each begin with the same observation."""
    return world.observe(world.reset(1)).equal(other.observe(other.reset(1)))
