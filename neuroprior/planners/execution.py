"""Executing plans: open loop, or planning anew after every few steps, which is what chance calls for."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.planners.planner import Decision, Planner
from neuroprior.worlds.world import World

Change = Callable[[Tensor, torch.Generator | None], Tensor]
"""What happens to states `[B, ...]` beside the agent's own steps."""


class Execution(NamedTuple):
    """What was done from B starts.

    Attributes:
        actions: `[B, T]`.
        rewards: `[B, T]`: what was met, not what was planned for.
        states: `[B, T, ...]`: after each action.
        model_steps: simulator steps for each start, in all decisions together; those executed do not count.
    """

    actions: Tensor
    rewards: Tensor
    states: Tensor
    model_steps: int


def execute(
    planner: Planner,
    world: World,
    state: Tensor,
    num_steps: int,
    replan_every: int = 1,
    generator: torch.Generator | None = None,
    change: Change | None = None,
) -> Execution:
    """Plan, execute the first actions, and plan anew from where they led, again and again.

    Args:
        planner: whose plans have at least `replan_every` actions.
        world: where; its steps are the real ones as well as those that the planner tries.
        state: `[B, ...]`.
        num_steps: T, at least 1.
        replan_every: after so many actions it is planned anew: 1 is a closed loop, the length of the plans an open one.
        generator: draws what the planner draws, and what is random in the world.
        change: what happens after each step besides, unforeseen by the planner (such as `ForagingWorld.regrow`).

    Raises:
        ValueError: an argument is out of range, or a plan is too short.
    """
    check_sizes(num_steps=num_steps, replan_every=replan_every)
    generator = generator_on(generator, state.device)
    parts = []
    for at in range(0, num_steps, replan_every):
        decision = planner.plan(world, state, generator)
        done = follow(decision, world, state, min(replan_every, num_steps - at), generator, change)
        state = done.states[:, -1]
        parts.append(done)
    return joined(parts)


def follow(
    decision: Decision,
    world: World,
    state: Tensor,
    num_steps: int,
    generator: torch.Generator | None = None,
    change: Change | None = None,
) -> Execution:
    """Execute the first `num_steps` actions of what was decided for `state [B, ...]`; see `execute`."""
    plan, lengths = decision.plan, decision.lengths
    if plan.shape[1] < num_steps or (lengths is not None and (lengths < num_steps).any()):
        raise ValueError(
            f"replan_every: {num_steps} actions are to be executed, but a plan has fewer; plan anew sooner"
        )
    columns: tuple[list[Tensor], ...] = ([], [], [])  # actions, rewards and states
    for t in range(num_steps):
        action = plan[:, t].long()
        state, reward = world.step(state, action, generator)
        state = state if change is None else change(state, generator)
        for column, what in zip(columns, (action, reward, state), strict=True):
            column.append(what)
    actions, rewards, states = (torch.stack(column, 1) for column in columns)
    return Execution(actions, rewards, states, decision.model_steps)


def joined(parts: Sequence[Execution]) -> Execution:
    """What was done one after another, as one."""
    actions, rewards, states = (
        torch.cat([getattr(part, name) for part in parts], 1) for name in ("actions", "rewards", "states")
    )
    return Execution(actions, rewards, states, sum(part.model_steps for part in parts))
