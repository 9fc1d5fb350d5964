"""Receding-horizon control: plan, execute the beginning, and plan again."""

from time import perf_counter
from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_memory, check_sizes, kind_of
from neuroprior._random import generator_on
from neuroprior.control.planners.vector_planner import Memory, VectorPlanner
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.control.worlds.continuous_world import ContinuousWorld, check_is_continuous, check_outcome


class Control(NamedTuple):
    """What B runs of up to T steps did.

    Attributes:
        plans: what was executed, with the observation before each vector as context per step; each run is a group. A
            run that terminated is shorter.
        rewards: `[B, T]`, of the world's dtype (float32 where no run takes a step); 0 after a run terminated.
        states: `[B, T + 1, ...]`: the start, and the state after each step; the last one again after a run terminated.
        model_steps: int64 `[B]`: simulator steps that the planner took in each run, in all its decisions.
        seconds: that all decisions took together; executing them is not counted.
    """

    plans: VectorPlans
    rewards: Tensor
    states: Tensor
    model_steps: Tensor
    seconds: float


def control(
    planner: VectorPlanner,
    world: ContinuousWorld,
    state: Tensor,
    num_steps: int,
    generator: torch.Generator | None = None,
    *,
    replan_every: int = 1,
) -> Control:
    """Plan, execute the first vectors, plan again from the state that they led to and from what was planned, and so on.

    The plans that were executed are what a prior is fitted to.

    Args:
        planner: its plans have at least `replan_every` vectors.
        world: the world in which plans are executed, and tried by the planner.
        state: `[B, ...]`.
        num_steps: T, at least 1.
        generator: draws what the planner draws, and the steps of a stochastic world.
        replan_every: vectors that are executed before planning again: 1 is a closed loop, the length of the plans an
            open one.

    Raises:
        ValueError: an argument is out of range, plans are too short, or a method of the world returns a wrong shape or
            dtype.

    Example:
        >>> world, generator = DoubleIntegrator(), torch.Generator().manual_seed(0)
        >>> done = control(
        ...     ICEMPlanner(length=5, num_plans=16), world, world.reset(2, generator), num_steps=3, generator=generator
        ... )
        >>> done.plans.actions.shape
        torch.Size([2, 3, 2])
    """
    check_sizes(num_steps=num_steps, replan_every=replan_every)
    check_memory(8 * num_steps, num_steps=num_steps)
    if replan_every > planner.length:
        raise ValueError(f"`replan_every` must be at most the length of a plan, {planner.length}, got {replan_every}")
    check_is_continuous(world)
    world.check_state(state)
    generator, batch, seconds = generator_on(generator, state.device), len(state), 0.0
    actions = torch.zeros(batch, num_steps, world.action_size, device=state.device)
    observed = world.observe(state)
    if not isinstance(observed, Tensor) or not observed.is_floating_point() or observed.shape[:-1] != (batch,):
        raise ValueError(f"`observe` must return floating point features [{batch}, C], got {_kind(observed)}")
    seen = observed.new_zeros(batch, num_steps, *observed.shape[1:])
    rewards = torch.zeros(batch, num_steps, device=state.device)
    states = state[:, None].repeat(1, num_steps + 1, *[1] * (state.dim() - 1))
    model_steps = torch.zeros(batch, dtype=torch.long, device=state.device)
    going = ~_end_mask(world, state)
    # Runs that terminated are left out, so that nothing is planned or simulated for them.
    running, now = going.nonzero()[:, 0], state[going]
    lengths, plan = torch.zeros_like(model_steps), actions[:0]
    memory: Memory | None = None
    for t in range(num_steps):
        if len(running) == 0:
            break
        if t % replan_every == 0:
            began = perf_counter()
            decision = planner.plan(world, now, generator, memory)
            seconds += perf_counter() - began
            plan, memory = decision.plan, decision.memory
            model_steps[running] += decision.model_steps
        assert memory is not None
        action, observation = plan[:, t % replan_every], world.observe(now)
        now, reward = check_outcome(now, world.step(now, action, generator))
        rewards = rewards.to(torch.promote_types(rewards.dtype, reward.dtype))
        actions[running, t], seen[running, t], rewards[running, t] = action, observation, reward.to(rewards.dtype)
        states[running, t + 1] = now
        lengths[running] += 1
        memory = memory.moved_on(action[:, None], observation[:, None], planner.keep)
        going = ~_end_mask(world, now)
        if not going.all():
            states[running[~going], t + 1 :] = now[~going][:, None]
            running, now, plan, memory = running[going], now[going], plan[going], memory.rows(going)
    plans = VectorPlans(
        actions,
        world.action_low,
        world.action_high,
        lengths if bool((lengths < num_steps).any()) else None,
        seen,
        torch.arange(batch, device=state.device),
        world.action_names,
    )
    return Control(plans, rewards, states, model_steps, seconds)


def _end_mask(world: ContinuousWorld, state: Tensor) -> Tensor:
    """`world.terminated(state)`, checked: integers would be taken for the numbers of runs."""
    ended = world.terminated(state)
    if not isinstance(ended, Tensor) or ended.dtype != torch.bool or ended.shape != state.shape[:1]:
        raise ValueError(f"`terminated` must return bool [{len(state)}], got {_kind(ended)}")
    return ended


def _kind(value: object) -> str:
    return f"{value.dtype} {list(value.shape)}" if isinstance(value, Tensor) else kind_of(value)
