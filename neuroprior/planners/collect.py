"""Collecting executed plans: what a planner chooses in a world is what a prior learns from."""

from collections.abc import Iterator
from typing import Literal

import torch
from torch import Tensor

from neuroprior.planners.planner import Planner
from neuroprior.plans import Plans, sees_each_step
from neuroprior.worlds.tabular import TabularWorld
from neuroprior.worlds.world import World


def collect(
    planner: Planner,
    world: World,
    num_plans: int | None = None,
    *,
    state: Tensor | None = None,
    context: Literal["plan", "step"] | None = None,
    generator: torch.Generator | None = None,
) -> Plans:
    """Plan from many starts and keep the plans that were chosen.

    Args:
        planner: chooses the plans.
        world: where.
        num_plans: plan from so many starts that `world.reset` draws.
        state: or plan from these, `[N, ...]`.
        context: what is recorded beside the plans: "plan": `world.observe` of the start; "step": of the state before
            each action; None: nothing.
        generator: draws the starts and whatever the planner draws.

    Returns:
        N plans. In a table with several reward maps, the map is the plan's group.

    Raises:
        ValueError: neither or both of `num_plans` and `state` are given, or one is out of range.
    """
    if (num_plans is None) == (state is None):
        raise ValueError("collect: give either num_plans or state")
    if context not in (None, "plan", "step"):
        raise ValueError(f'context: "plan", "step" or None is expected, not {context!r}')
    if state is None:
        assert num_plans is not None
        if num_plans < 1:
            raise ValueError(f"num_plans: at least 1 is expected, not {num_plans}")
        state = world.reset(num_plans, generator)
    plan, _, _, _, lengths = planner.plan(world, state, generator)
    seen = None
    if context is not None and sees_each_step(world.observe(state[:1])):
        raise ValueError("observe: indices [N] or floating point features [N, C] are expected of a world")
    if context == "plan":
        seen = world.observe(state)
    elif context == "step":
        seen = torch.stack(list(_observations(world, state, plan, generator)), 1)
    group, names = None, None
    if isinstance(world, TabularWorld):
        group, names = (world.reward_map(state) if world.num_maps > 1 else None), world.action_names
    return Plans(plan, world.num_actions, lengths, names, seen, group)


def _observations(world: World, state: Tensor, plan: Tensor, generator: torch.Generator | None) -> Iterator[Tensor]:
    """What is seen before each action of `plan [N, L]`."""
    for t in range(plan.shape[1]):
        yield world.observe(state)
        state, _ = world.step(state, plan[:, t].long(), generator)
