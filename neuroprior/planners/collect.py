"""Collecting executed plans: what a planner chooses in a world is what a prior learns from."""

from typing import Literal

import torch
from torch import Tensor

from neuroprior.planners.planner import Planner
from neuroprior.plans import Plans, is_per_step
from neuroprior.worlds.world import World


def collect(
    planner: Planner,
    world: World,
    num_plans: int | None = None,
    *,
    state: Tensor | None = None,
    context: Literal["plan", "step"] | None = None,
    min_score: float | None = None,
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
        min_score: keep only the plans whose score is higher: those that led somewhere, where most do not. None: all.
        generator: draws the starts and whatever the planner draws.

    Returns:
        N plans, fewer with `min_score`, each up to where it was over (`World.terminated`). In a table of several worlds, the
        world is the plan's group, see `World.group`.

    Raises:
        ValueError: neither or both of `num_plans` and `state` are given, one is out of range, or no plan scored more
            than `min_score`.
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
    plan, score, _, _, lengths = planner.plan(world, state, generator)
    course = _course(world, state, plan, generator)
    lengths = _lengths(world, course, lengths)
    if min_score is not None:
        kept = score > min_score
        if not kept.any():
            most = f"; the best {float(score.max())}" if len(score) else ""
            raise ValueError(f"min_score: none of {len(state)} plans scored more than {min_score}{most}")
        plan, state, lengths = plan[kept], state[kept], None if lengths is None else lengths[kept]
        course = course[kept]
    if context is not None and is_per_step(world.observe(state[:1])):
        raise ValueError("observe: indices [N] or floating point features [N, C] are expected of a world")
    seen = observed(world, course, context)
    return Plans(plan, world.num_actions, lengths, world.action_names, seen, world.group(state))


def observed(world: World, course: Tensor, context: Literal["plan", "step"] | None) -> Tensor | None:
    """What is seen along `course [N, L, ...]`, the states before each action: at the start, in each, or None."""
    if context is None:
        return None
    if context == "plan":
        return world.observe(course[:, 0])
    seen = world.observe(course.flatten(0, 1))
    return seen.view(*course.shape[:2], *seen.shape[1:])


def executed(world: World, course: Tensor) -> Tensor:
    """How many actions are executed along `course [N, L, ...]`, the states before each, until it is over: `[N]`."""
    here = ~world.terminated(course.flatten(0, 1)).view(course.shape[:2])
    return here.long().cumprod(1).sum(1)


def _course(world: World, state: Tensor, plan: Tensor, generator: torch.Generator | None) -> Tensor:
    """The states `[N, L, ...]` before each action of `plan [N, L]`; with chance, of one course of events."""
    course = []
    for t in range(plan.shape[1]):
        course.append(state)
        state, _ = world.step(state, plan[:, t].long(), generator)
    return torch.stack(course, 1)


def _lengths(world: World, course: Tensor, lengths: Tensor | None) -> Tensor | None:
    """How many actions of each plan of `lengths` are executed `[N]`; None: all."""
    taken = executed(world, course)
    if lengths is not None:
        return torch.minimum(taken, lengths)
    return taken if bool((taken < course.shape[1]).any()) else None
