"""Executing plans: `execute` in open or closed loop, and `collect` executed plans for a prior to be fitted to."""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_memory, check_sizes, is_number, kind_of
from neuroprior._random import generator_on
from neuroprior.planners.planner import Decision, Planner, check_is_planner
from neuroprior.plans import Plans
from neuroprior.worlds.world import World, check_is_world, is_over, step_alive

Change = Callable[[Tensor, torch.Generator | None], Tensor]
"""A change of states `[B, ...]` that is not caused by the agents' own steps."""


class Execution(NamedTuple):
    """What was executed from B starts.

    Attributes:
        actions: `[B, T]`.
        rewards: `[B, T]`: the actual rewards, not the planned ones.
        states: `[B, T, ...]`: after each action.
        model_steps: simulator steps that the planner took for each start, in all its decisions.
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
    """Plan, execute the first actions, replan from the state that they led to, and so on.

    Args:
        planner: its plans have at least `replan_every` actions, or end where the world terminates.
        world: the world in which plans are executed, and tried by the planner.
        state: `[B, ...]`.
        num_steps: T, at least 1.
        replan_every: actions that are executed before replanning: 1 is a closed loop, the length of the plans an open
            one.
        generator: draws what the planner draws, and the steps of a stochastic world.
        change: applied to the states after each step; the planner does not foresee it.

    Raises:
        ValueError: an argument is out of range, or a plan is too short.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> execute(ExhaustivePlanner(depth=3), world, torch.tensor([0, 12]), num_steps=4).rewards.shape
        torch.Size([2, 4])
    """
    check_sizes(num_steps=num_steps, replan_every=replan_every)
    check_memory(8 * num_steps, num_steps=num_steps)
    check_is_planner(planner)
    check_is_world(world)
    check_change(change)
    world.check_state(state)
    generator = generator_on(generator, state.device)
    parts = []
    for at in range(0, num_steps, replan_every):
        decision = planner.plan(world, state, generator)
        execution = follow(decision, world, state, min(replan_every, num_steps - at), generator, change)
        state = execution.states[:, -1]
        parts.append(execution)
    return join_executions(parts)


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
    """Plan from many starts, and keep the plans that were chosen.

    Args:
        planner: chooses the plans.
        world: the world.
        num_plans: plan from so many starts, drawn by `world.reset`.
        state: or plan from these starts, `[N, ...]`.
        context: what is recorded with the plans: "plan": `world.context` of the start; "step": of the state before each
            action; None: nothing.
        min_score: keep only plans with a higher score: in worlds where most plans lead nowhere. None: all.
        generator: draws the starts, and whatever the planner draws.

    Returns:
        N plans, fewer with `min_score`, each up to the action with which it terminated (`World.terminated`). Their
        groups are the independent worlds that they were collected in, see `World.group`.

    Raises:
        ValueError: neither or both of `num_plans` and `state` are given, an argument is out of range, or no plan scored
            more than `min_score`.

    Example:
        >>> plans = collect(
        ...     ExhaustivePlanner(depth=3),
        ...     gridworld(5, 5, seed=0),
        ...     num_plans=10,
        ...     generator=torch.Generator().manual_seed(0),
        ... )
        >>> plans.actions.shape
        torch.Size([10, 3])
    """
    if (num_plans is None) == (state is None):
        raise ValueError("one of `num_plans` and `state` must be given, got both or neither")
    if context not in (None, "plan", "step"):
        raise ValueError(f'`context` must be "plan", "step" or None, got {context!r}')
    if min_score is not None and not is_number(min_score):
        raise ValueError(f"`min_score` must be a number, got {min_score!r}")
    check_is_planner(planner)
    check_is_world(world)
    if state is None:
        check_sizes(num_plans=num_plans)
        assert num_plans is not None
        check_memory(8 * num_plans, num_plans=num_plans)
        state = world.reset(num_plans, generator)
    decision = planner.plan(world, state, generator)
    plan, score, lengths = decision.plan, decision.score, decision.lengths
    _, states = _step_through(world, state, plan, generator)
    before = torch.cat([state[:, None], states[:, :-1]], 1)[:, : plan.shape[1]]
    steps = executed_steps(world, before)
    if lengths is not None:
        lengths = torch.minimum(steps, lengths)
    elif bool((steps < plan.shape[1]).any()):
        lengths = steps
    if min_score is not None:
        kept = score > min_score
        if not kept.any():
            best = f"; the best {float(score.max())}" if len(score) else ""
            raise ValueError(f"min_score: none of {len(state)} plans scored more than {min_score}{best}")
        plan, state, before = plan[kept], state[kept], before[kept]
        lengths = None if lengths is None else lengths[kept]
    observed = world.context(state) if context == "plan" else observations(world, before, context)
    return Plans(plan, world.num_actions, lengths, world.action_names, observed, world.group(state))


def follow(
    decision: Decision,
    world: World,
    state: Tensor,
    num_steps: int,
    generator: torch.Generator | None = None,
    change: Change | None = None,
) -> Execution:
    """Execute the first `num_steps` actions of a decision for `state [B, ...]`; see `execute`."""
    plan = torch.nn.functional.pad(decision.plan, (0, max(num_steps - decision.plan.shape[1], 0)))
    actions = plan[:, :num_steps].long()
    rewards, states = _step_through(world, state, actions, generator, change)
    lengths = actions.new_tensor(decision.plan.shape[1]) if decision.lengths is None else decision.lengths
    lengths = lengths.expand(len(state)).long()
    short = (lengths < num_steps).nonzero()[:, 0]
    if len(short):  # a plan may be shorter where the episode ends with it
        last = lengths[short]
        ended = is_over(world, torch.cat([state[:, None], states], 1)[short, last])
        if not ended.all():
            raise ValueError(
                f"replan_every: {num_steps} actions are to be executed, but a plan has fewer,"
                f" {int(last[~ended][0])}, and its episode goes on"
            )
    return Execution(actions, rewards, states, decision.model_steps)


def join_executions(parts: Sequence[Execution]) -> Execution:
    """Executions one after another, as one."""
    actions, rewards, states = (
        torch.cat([getattr(execution, name) for execution in parts], 1) for name in ("actions", "rewards", "states")
    )
    return Execution(actions, rewards, states, sum(execution.model_steps for execution in parts))


def observations(world: World, before: Tensor, context: Literal["plan", "step"] | None) -> Tensor | None:
    """The context of executed plans: what the world observes in the states `before [N, L, ...]` the actions.

    "plan": `[N]` or `[N, C]`, in the first state; "step": `[N, L]`, `[N, L, F]` or `[N, L, C]`, in
    each; None: None.
    """
    if context is None:
        return None
    if context == "plan":
        return world.context(before[:, 0])
    observed = world.context(before.flatten(0, 1))
    return observed.view(*before.shape[:2], *observed.shape[1:])


def executed_steps(world: World, before: Tensor) -> Tensor:
    """How many actions are executed until the episode is over, `[N]`; `before [N, L, ...]`: the states before them."""
    going = ~is_over(world, before.flatten(0, 1)).view(before.shape[:2])
    return going.long().cumprod(1).sum(1)


def check_change(change: object) -> None:
    """Raise ValueError unless it is a function, or None."""
    if change is not None and not callable(change):
        raise ValueError(f"`change` must be a function of states and a generator, got {change!r}")


def _apply_change(change: Change, state: Tensor, generator: torch.Generator | None) -> Tensor:
    """The states after a change; raises ValueError where these are no such states."""
    after: object = change(state, generator)
    if not isinstance(after, Tensor) or after.shape != state.shape or after.dtype != state.dtype:
        got = f"{after.dtype} {list(after.shape)}" if isinstance(after, Tensor) else kind_of(after)
        raise ValueError(f"`change` must be {state.dtype} {list(state.shape)}, states as given, got {got}")
    return after


def _step_through(
    world: World, state: Tensor, plans: Tensor, generator: torch.Generator | None, change: Change | None = None
) -> tuple[Tensor, Tensor]:
    """The rewards `[N, L]`, and the states `[N, L, ...]` after each action, of `plans [N, L]` from `state [N, ...]`."""
    rewards, states = [], []
    if plans.shape[1] == 0:
        return torch.zeros(plans.shape, device=state.device), state[:, None][:, :0]
    for t in range(plans.shape[1]):
        state, reward = step_alive(world, state, plans[:, t].long(), generator)
        state = state if change is None else _apply_change(change, state, generator)
        rewards.append(reward)
        states.append(state)
    return torch.stack(rewards, 1), torch.stack(states, 1)
