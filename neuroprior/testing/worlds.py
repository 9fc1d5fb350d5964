"""The conformance suite of worlds."""

from collections.abc import Callable
from functools import partial
from numbers import Integral
from typing import Any, cast

import torch
from torch import Tensor

from neuroprior.testing.chi_square import alike
from neuroprior.testing.rules import FALSE_ALARM, WORLD_CHECKS, check_by_kind, raises, require, same
from neuroprior.worlds import SimulatorWorld, TabularWorld, World
from neuroprior.worlds.world import check_objective, step_alive

Simulator = Any
"""A world, of numbered actions or of vectors."""

TIMES = 200
"""Rollouts from each start, in a stochastic world."""


def check_world(world: Any, num_states: int = 50, length: int = 6, seed: int = 0) -> None:
    """Raise AssertionError, with a message that says how, unless `world` does what a world must.

    `reset`, `step`, `observe`, `legal_actions`, `terminated`, `solved` and `group` return what the interface says, for
    each state independently of its batch; `step` does not change its arguments, and does not stop at illegal actions
    in starts; the same seed gives the same states and rewards; `rollout` equals stepping, passes through the states to
    which shorter plans lead, and raises ValueError for plans of a wrong shape, dtype or range. A stochastic world
    says so, and its rollouts have the distribution of its steps (chi-square tests, with a false-alarm probability of
    1e-6 together); those of a table use common random numbers for all plans of a start. Terminated states among those
    that random plans reach stay as they are, and give a reward of 0.

    A `ContinuousWorld` is checked by `neuroprior.control.check_continuous_world`.

    Args:
        world: the world to check.
        num_states: how many random states.
        length: of the plans.
        seed: draws states and plans.

    Raises:
        AssertionError: the world breaks a rule.

    Example:
        >>> check_world(gridworld(5, 5, seed=0))
    """
    if check_by_kind(WORLD_CHECKS, world, length, num_states, seed):
        return
    require(isinstance(world, World), f"`world` must be a World, got {type(world).__name__}")
    number = getattr(world, "num_actions", None)
    has_actions = isinstance(number, Integral) and int(number) > 0
    require(has_actions, f"`num_actions` must be an integer above 0, got {number!r}")
    try:
        check_objective(world.objective, world.discount)
    except ValueError as error:
        raise AssertionError(str(error)) from error
    generator = torch.Generator().manual_seed(seed)
    state = check_reset(world, num_states, seed)
    plans, wrong_plans = _plans(world, state, length, generator)
    _check_illegal(world, state, generator)
    check_dynamics(world, state, plans, wrong_plans, _check_choices, generator, seed)


def check_reset(world: Simulator, num_states: int, seed: int) -> Tensor:
    """The starts `[N, ...]` of a world, which are right and depend on the seed alone."""
    state: Tensor = world.reset(num_states, torch.Generator().manual_seed(seed))
    again = world.reset(num_states, torch.Generator().manual_seed(seed))
    require(isinstance(state, Tensor), f"reset must return a tensor, not {type(state).__name__}")
    require(len(state) == num_states, f"reset({num_states}) gave {len(state)} states")
    require(not state.isnan().any(), "reset: NaN in the states")
    require(state.equal(again), "reset: the same seed gave other states")
    return state


def check_dynamics(
    world: Simulator,
    state: Tensor,
    plans: Tensor,
    wrong_plans: dict[str, Tensor],
    check_queries: Callable[[Any, Tensor], None],
    generator: torch.Generator,
    seed: int,
) -> None:
    """Steps, rollouts and queries of a world, of numbered actions or of vectors.

    Args:
        world: the world.
        state: starts `[N, ...]`.
        plans: `[N, 3, L]`, or `[N, 3, L, D]` of vectors.
        wrong_plans: plans that `rollout` must refuse, by what is wrong with them.
        check_queries: checks what else the world answers about states `[M, ...]` that plans lead to.
        generator: draws actions.
        seed: of steps and rollouts.
    """
    num_states, length = len(state), plans.shape[2]
    _check_step(world, state, plans[:, 0, 0], seed)
    _check_reached(world, state, plans, check_queries, generator)
    by_steps, rewards, random = _step_through(world, state, plans, seed)
    rollout = world.rollout(state, plans, torch.Generator().manual_seed(seed))
    require(
        rollout.rewards.shape == plans.shape[:3],
        f"rollout: rewards {list(rollout.rewards.shape)}, not {list(plans.shape[:3])}",
    )
    shape = (num_states, 3, *state.shape[1:])
    require(rollout.final_state.shape == shape, f"rollout: final_state {list(rollout.final_state.shape)}, not {shape}")
    if not random:
        require(same(rollout.final_state, by_steps), "rollout ends in other states than stepping")
        require(same(rollout.rewards, rewards), "rollout gives other rewards than stepping")
    else:
        require(world.stochastic, "step: its outcomes are random, but the world's `stochastic` is False")
        _check_distribution(world, state, plans[:, 0], seed)
    none = world.rollout(state, plans[:, :, :0])
    require(none.final_state[:, 0].equal(state), "rollout of plans of length 0 must end where it starts")
    wrong_plans["plans without their dimension P"] = plans[:, 0]
    wrong_plans["plans for too few starts"] = plans[1:]
    for what, wrong in wrong_plans.items():
        require(raises(partial(world.rollout, state, wrong)), f"rollout must raise ValueError for {what}")
    try:
        kept = world.rollout(state, plans, torch.Generator().manual_seed(seed), keep_states=True).states
    except TypeError as error:
        raise AssertionError(f"rollout: with keep_states=True: {error}") from error
    require(
        kept is not None and same(kept[:, :, -1], rollout.final_state),
        "rollout: with keep_states=True the last of the states is not the final one",
    )
    assert kept is not None
    if not random and length > 1:
        half = length // 2
        shorter = world.rollout(state, plans[:, :, :half], torch.Generator().manual_seed(seed)).final_state
        require(same(kept[:, :, half - 1], shorter), "rollout: states on the way are not those of shorter plans")


def _plans(world: World, state: Tensor, length: int, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
    """Random plans of numbers `[N, 3, L]`, and wrong ones."""
    actions = world.num_actions
    plans = torch.randint(actions, (len(state), 3, length), generator=generator).to(state.device)
    return plans, {
        "plans of floating point numbers": plans.float(),
        "actions past the last": plans + actions,
        "negative actions": plans - actions,
    }


def _check_reached(
    world: Simulator,
    state: Tensor,
    plans: Tensor,
    check_queries: Callable[[Any, Tensor], None],
    generator: torch.Generator,
) -> None:
    """In the states that plans lead to: queries; terminated ones stay, and give nothing."""
    states = [state.repeat_interleave(plans.shape[1], 0)]
    for actions in plans.flatten(0, 1).unbind(1):
        states.append(_step_alive(world, states[-1], actions, generator)[0])
    reached = torch.cat(states)
    _check_queries(world, reached)
    check_queries(world, reached)
    ends = reached[world.terminated(reached)]
    if len(ends):
        action = plans[:, 0, 0]
        action = action[torch.randint(len(action), (len(ends),), generator=generator).to(action.device)]
        after, reward = world.step(ends, action, generator)
        require(after.equal(ends), "step: terminated states must stay as they are")
        require(not reward.any(), "step: the reward from terminated states must be 0")


def _legal_actions(world: World, state: Tensor) -> Tensor:
    """What `legal_actions` returns, of the right shape."""
    legal, shape = world.legal_actions(state), [len(state), world.num_actions]
    require(legal.dtype == torch.bool and list(legal.shape) == shape, f"legal_actions must be bool {shape}")
    return legal


def _check_illegal(world: World, state: Tensor, generator: torch.Generator) -> None:
    """`step` takes actions that are not legal, which planners may try before they leave the plan out."""
    where, action = (~_legal_actions(world, state)).nonzero(as_tuple=True)
    if len(where):
        try:
            world.step(state[where], action, generator)
        except Exception as error:
            raise AssertionError(
                f"step: it stops at actions that are not legal ({error}); planners may try these, and leave them out"
            ) from error


def _check_step(world: Simulator, state: Tensor, action: Tensor, seed: int) -> None:
    """`step`: shapes, dtypes, seeds, and no change to what it was given."""
    kept = state.clone(), action.clone()
    outcome: object = world.step(state, action, torch.Generator().manual_seed(seed))
    pair = isinstance(outcome, tuple) and [isinstance(value, Tensor) for value in outcome] == [True, True]
    require(pair, "step must return a tuple of two tensors: the next state and the reward")
    after, reward = cast(tuple[Tensor, Tensor], outcome)
    require(state.equal(kept[0]), "step changed the state that it was given")
    require(action.equal(kept[1]), "step changed the action that it was given")
    require(after.shape == state.shape, f"step: state {list(after.shape)}, not {list(state.shape)}")
    require(after.dtype == state.dtype, f"step: state of {after.dtype}, not {state.dtype}")
    require(reward.shape == action.shape[:1], f"step: reward {list(reward.shape)}, not {list(action.shape[:1])}")
    require(reward.is_floating_point(), f"step: reward of {reward.dtype}, not floating point")
    require(not reward.isnan().any(), "step: NaN in the reward")
    require(not after.isnan().any(), "step: NaN in the next state")
    again, gained = world.step(state, action, torch.Generator().manual_seed(seed))
    require(after.equal(again), "step: the same seed gave other states")
    require(same(reward, gained), "step: the same seed gave other rewards")


def _check_queries(world: Simulator, state: Tensor) -> None:
    """`observe` and `terminated`."""
    if isinstance(world, World):
        _check_observation(world, state)
    ended = world.terminated(state)
    require(isinstance(ended, Tensor), f"terminated must return a tensor, not {type(ended).__name__}")
    require(ended.dtype == torch.bool and ended.shape == state.shape[:1], f"terminated must be bool [{len(state)}]")
    check_batch("terminated", world.terminated, state, ended)


def _check_observation(world: World, state: Tensor) -> None:
    """What is observed is declared, and is what was declared."""
    if world.observation is None:
        silent = raises(partial(world.observe, state))
        require(silent, "observation: `observe` is written, but what it gives is not declared")
        return
    try:
        observed = world.context(state)
    except ValueError as error:
        raise AssertionError(str(error)) from error
    require(not observed.isnan().any(), "observe: NaN in the observations")
    check_batch("observe", world.context, state, observed)


def _check_choices(world: World, state: Tensor) -> None:
    """`solved`, `legal_actions` and `group`."""
    solved = world.solved(state)
    require(solved.dtype == torch.bool and solved.shape == state.shape[:1], f"solved must be bool [{len(state)}]")
    check_batch("solved", world.solved, state, solved)
    require(world.has_goal or not solved.any(), "solved: a goal is reached, but has_goal is False")
    legal = _legal_actions(world, state)
    check_batch("legal_actions", world.legal_actions, state, legal)
    if world.all_legal:
        require(bool(legal.all()), "all_legal is True, but legal_actions leaves some out")
    group = world.group(state)
    if group is not None:
        fits = isinstance(group, Tensor) and group.dtype == torch.int64 and group.shape == state.shape[:1]
        require(fits, f"group must return int64 [{len(state)}], or None")
        check_batch("group", lambda batch: cast(Tensor, world.group(batch)), state, group)


def check_batch(name: str, query: Callable[[Tensor], Tensor], state: Tensor, whole: Tensor) -> None:
    """What is found in a state, `whole` in all of them, does not depend on its batch, nor on its place there."""
    for rows in (slice(len(state) // 2, None), slice(1, None), slice(0, 1)):
        alone = same(query(state[rows]), whole[rows])
        require(alone, f"{name}: what is found in a state depends on its batch")


def _step_alive(
    world: Simulator, state: Tensor, action: Tensor, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """A step as planners take it: where no action is legal the episode is over, whatever `step` returns there."""
    return (
        step_alive(world, state, action, generator)
        if isinstance(world, World)
        else world.step(state, action, generator)
    )


def _step_through(world: Simulator, state: Tensor, plans: Tensor, seed: int) -> tuple[Tensor, Tensor, bool]:
    """Final states `[B, P]` and rewards `[B, P, L]` of single steps, and whether their outcomes are random."""
    batch, num_plans, length = plans.shape[:3]
    finals, rewards = [], []
    random = False
    for p in range(num_plans):
        now, row = state, []
        for t in range(length):
            after, reward = _step_alive(world, now, plans[:, p, t], torch.Generator().manual_seed(seed))
            other = _step_alive(world, now, plans[:, p, t], torch.Generator().manual_seed(seed + 1))
            random = random or not (other[0].equal(after) and other[1].equal(reward))
            if not random:
                half = _step_alive(world, now[batch // 2 :], plans[batch // 2 :, p, t])
                alone = same(half[0], after[batch // 2 :]) and same(half[1], reward[batch // 2 :])
                require(alone, "step: what happens in a state depends on its batch")
            now = after
            row.append(reward)
        finals.append(now)
        rewards.append(torch.stack(row, -1))
    return torch.stack(finals, 1), torch.stack(rewards, 1), random


def _check_distribution(world: Simulator, state: Tensor, plans: Tensor, seed: int) -> None:
    """Rollouts in a stochastic world against steps, `TIMES` from each start `[N, ...]` by its plan."""
    generator = torch.Generator().manual_seed(seed)
    group = torch.arange(len(state)).repeat_interleave(TIMES)
    now, plans = state.repeat_interleave(TIMES, 0), plans.repeat_interleave(TIMES, 0)
    rollout = world.rollout(now, plans[:, None], generator)
    again = world.rollout(now, plans[:, None], torch.Generator().manual_seed(seed))
    require(same(rollout.final_state, again.final_state), "rollout: the same seed gave other states")
    rewards = []
    for t in range(plans.shape[1]):
        now, reward = _step_alive(world, now, plans[:, t], generator)
        rewards.append(reward)
    final = _comparable(world, rollout.final_state[:, 0])
    observed = torch.cat([final, rollout.rewards[:, 0].double()], 1)
    due = torch.cat([_comparable(world, now), torch.stack(rewards, 1).double()], 1)
    for column in range(observed.shape[1]):
        p = alike(observed[:, column].cpu(), due[:, column].cpu(), group)
        what = "rewards" if column >= observed.shape[1] - plans.shape[1] else "final states"
        require(p > FALSE_ALARM / observed.shape[1], f"{what} of rollout do not fit those of steps: p = {p:.2g}")
    if isinstance(world, TabularWorld):
        twice = world.rollout(state, plans[::TIMES, None].expand(-1, 2, -1), generator)
        require(
            twice.rewards[:, 0].equal(twice.rewards[:, 1]), "rollout: the same plan twice had different random numbers"
        )


def _comparable(world: Simulator, state: Tensor) -> Tensor:
    """What `state [N, ...]` says by itself, float64 `[N, K]`: of a simulator's, which are numbered, the observation."""
    if isinstance(world, SimulatorWorld):
        state = state[:, None][:, :0] if world.observation is None else world.observe(state)
    return state.reshape(len(state), -1).double()
