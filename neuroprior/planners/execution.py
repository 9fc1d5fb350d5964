"""Executing plans: open loop, or planning anew after every few steps, which is what chance calls for."""

from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior.planners.planner import Planner
from neuroprior.randomness import generator_on
from neuroprior.worlds.world import World, check_sizes


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
    every: int = 1,
    generator: torch.Generator | None = None,
) -> Execution:
    """Plan, execute the first actions, and plan anew from where they led, again and again.

    Args:
        planner: whose plans have at least `every` actions.
        world: where; its steps are the real ones as well as those that the planner tries.
        state: `[B, ...]`.
        num_steps: T, at least 1.
        every: after so many actions it is planned anew: 1 is a closed loop, the length of the plans an open one.
        generator: draws what the planner draws, and what is random in the world.

    Raises:
        ValueError: an argument is out of range, or a plan is too short.
    """
    check_sizes(num_steps=num_steps, every=every)
    generator = generator_on(generator, state.device)
    columns: tuple[list[Tensor], ...] = ([], [], [])  # actions, rewards and states
    steps = 0
    for at in range(0, num_steps, every):
        decision = planner.plan(world, state, generator)
        steps += decision.model_steps
        wanted = min(every, num_steps - at)
        if decision.plan.shape[1] < wanted or (decision.lengths is not None and (decision.lengths < wanted).any()):
            raise ValueError(f"every: {wanted} actions are to be executed, but a plan has fewer; plan anew sooner")
        for t in range(wanted):
            action = decision.plan[:, t].long()
            state, reward = world.step(state, action, generator)
            for column, what in zip(columns, (action, reward, state), strict=True):
                column.append(what)
    actions, rewards, states = (torch.stack(column, 1) for column in columns)
    return Execution(actions, rewards, states, steps)
