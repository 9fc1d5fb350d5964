"""Sampling plans from any prior: one by one, by prefix tree, or together with a world."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import check_count, check_memory, check_range, check_sizes, describe, is_integer
from neuroprior._random import generator_on
from neuroprior._threads import share
from neuroprior.plans.plans import action_dtype, as_single
from neuroprior.plans.sequences import is_per_plan
from neuroprior.sampling.draws import (
    Draw,
    are_few,
    check_temperature,
    shuffled_rows,
    worth_splitting,
)
from neuroprior.sampling.prefixes import Prefixes
from neuroprior.sampling.states import State, map_state, numbers_in, select_rows
from neuroprior.sampling.stepping import Steppable, Stepper, check_outputs, legal_logits
from neuroprior.worlds.world import Rollout, World, join_states, step_alive

Mask: TypeAlias = Callable[[Tensor], Any]
"""Which actions may be drawn next, bool `[N, A]`, after the actions drawn so far, int64 `[N, t]`."""

CACHED, FEWEST = 2**19, 1024
"""On a CPU, plans are stepped in parts of at most `CACHED` numbers in their states (or logits), so that they fit a
processor's cache, and of at least `FEWEST` plans.
"""


@torch.no_grad()
def sample(
    prior: Steppable,
    num_plans: int,
    length: int,
    context: Tensor | None = None,
    *,
    past: Tensor | None = None,
    state: tuple[Tensor, State] | None = None,
    mask: Tensor | Mask | None = None,
    temperature: float = 1.0,
    generator: torch.Generator | None = None,
    method: Literal["auto", "ancestral", "tree"] = "auto",
    batch_size: int = 65_536,
) -> Tensor:
    """Independent plans from a prior, in random order.

    Plans that share a prefix share its evaluation: the number of plans is split multinomially over the distinct
    prefixes of each length ("tree"), which gives the same distribution as drawing each plan by itself ("ancestral").
    "auto" splits as long as there are far fewer prefixes than plans, and draws plan by plan from there on; plans that
    still begin alike are stepped once. On a GPU, up to 32,768 plans are stepped each by itself, which is faster. Many
    plans of a small chain are drawn from alias tables of several actions.

    Args:
        prior: any prior.
        num_plans: number of plans, N.
        length: number of actions in a plan, L.
        context: None; one per plan (`[N]` indices or `[N, C]` features; plan i is drawn under context i); or one per
            step (`[N, L]`, `[N, L, C]`; after a past of T actions `[N, T + L, ...]`), where it is known beforehand.
        past: integers, the actions that were executed before, which the plans go on from: `[T]`, the same for all
            plans, or `[N, T]`. None: plans begin.
        state: instead of a past, what the prior's `start` or its last `step` returned: logits and state, of one row,
            which all plans go on from, or of N rows. So a planner that executes and replans steps its prior once for
            each executed action. It is left as it is. A context, one per step, is then that of the steps to come.
        mask: which actions may be drawn: bool (or integers 0 and 1) `[A]`, `[L, A]` or `[N, L, A]`; or a function of
            the actions drawn, int64 `[N, t]`, that returns bool `[N, A]`.
        temperature: divides the logits; below 1 sharper, above 1 flatter.
        generator: the source of randomness; the same seed gives the same plans.
        method: see above. With a mask, a context per step, features, pasts `[N, T]` or a state of N rows, plans are
            always drawn plan by plan.
        batch_size: number of plans that are drawn together when drawing plan by plan; bounds memory.

    Returns:
        Actions `[N, L]`, uint8 (int64 for more than 256 actions). For a prior with an end symbol, only end symbols
        follow the first one; `Plans(..., end=...).without_end()` cuts them off.

    Raises:
        ValueError: an argument is out of range, or no action may be drawn.

    Example:
        >>> sample(UniformPrior(4), num_plans=3, length=5, generator=torch.Generator().manual_seed(0)).shape
        torch.Size([3, 5])
    """
    _check(num_plans, length, temperature, batch_size)
    if not hasattr(prior, "num_actions"):
        raise ValueError(
            f"`prior` must be one over numbered actions, got {type(prior).__name__}; priors over vectors have a"
            " method sample of their own"
        )
    # Memory of the plans, and of the uniform numbers with which some are drawn together.
    each = action_dtype(prior.num_actions).itemsize
    check_memory((each * num_plans + 4 * min(num_plans, batch_size)) * length, num_plans=num_plans, length=length)
    stepper = Stepper(prior)
    device = stepper.device
    context = None if context is None else as_single(torch.as_tensor(context, device=device).detach())
    if method not in ("auto", "ancestral", "tree"):
        raise ValueError(f'`method` must be "auto", "ancestral" or "tree", got {method!r}')
    if context is not None and context.shape[0] != num_plans:
        raise ValueError(f"context: its first dimension must be num_plans = {num_plans}, not {context.shape[0]}")
    if state is not None and past is not None:
        raise ValueError("`past` must be None with a state, which knows it, got both")
    past = _checked_past(past, num_plans, prior.num_actions).to(device)
    steps = past.shape[-1] + length
    if context is not None and not is_per_plan(context) and context.shape[1] < steps:
        what = "to be sampled" if steps == length else "in the past and to be sampled"
        raise ValueError(f"context: {steps} steps are {what}, but it has only {context.shape[1]}")
    if state is None or context is not None:
        stepper.check_context(context, num_plans, steps)
    draw = Draw(prior.num_actions, temperature, generator_on(generator, device))
    if num_plans == 0 or length == 0:
        return torch.empty(num_plans, length, dtype=draw.dtype, device=device)
    per_step = context if context is not None and not is_per_plan(context) else None
    with stepper.threads_for(num_plans):
        which = None  # in which order plans are drawn, where it is not that of their contexts
        if state is not None:
            if context is not None and per_step is None:
                raise ValueError("`context` must be one per step with a state, which knows the one before")
            roots = _checked_state(state, num_plans, prior.num_actions)
        elif past.dim() == 2 or (context is not None and not (is_per_plan(context) and is_integer(context))):
            roots = _begin(stepper, num_plans, context, past, length)
        elif context is None:
            roots = _begin(stepper, 1, None, past, length)
        else:
            distinct, which, counts = context.unique(return_inverse=True, return_counts=True)
            roots = _begin(stepper, len(distinct), distinct, past, length)
        ahead = None if per_step is None else per_step[:, past.shape[-1] :]
        if which is None:  # one root for all plans, or one for each
            counts = torch.full((len(roots[0]),), num_plans if len(roots[0]) == 1 else 1, device=device)
        if mask is not None:
            row = torch.arange(len(counts), device=device).repeat_interleave(counts) if which is None else which
            return _sample_masked(stepper, row, *roots, ahead, mask, length, draw)
        method = "ancestral" if ahead is not None or (which is None and len(counts) > 1) else method
        grouped = _sample_from_roots(stepper, counts, *roots, ahead, length, draw, method, batch_size)
        if which is None:
            return grouped
        plans = torch.empty_like(grouped)
        plans[which.argsort(stable=True)] = grouped
        return plans


@torch.no_grad()
def sample_in_world(
    prior: Steppable,
    world: World,
    state: Tensor,
    num_plans: int,
    length: int,
    *,
    temperature: float = 1.0,
    generator: torch.Generator | None = None,
    keep_states: bool = False,
) -> tuple[Tensor, Rollout]:
    """Sample plans and step the world along, so that the prior gets each observation before it chooses an action.

    The plans of a start that share a prefix share its evaluation and its steps, unless the world is stochastic or the
    plans are few for a GPU (see `sample`).

    The context of a prior that takes one is `world.observe` of the start, and again of each further state unless the
    prior was fitted to one context per plan. Actions that are not legal (`world.legal_actions`) are never sampled.

    Args:
        prior: any prior over the world's actions.
        world: the world.
        state: starts `[B, ...]`.
        num_plans: plans for each start, P.
        length: number of actions in a plan, L.
        temperature: divides the logits.
        generator: draws actions and, in a stochastic world, its steps.
        keep_states: also return the state after each step, in the rollout.

    Returns:
        Plans `[B, P, L]`, uint8 (int64 for more than 256 actions), and their `Rollout`.

    Raises:
        ValueError: an argument is out of range, or prior and world differ in their number of actions.

    Example:
        >>> plans, rollout = sample_in_world(
        ...     UniformPrior(4), gridworld(5, 5, seed=0), torch.tensor([0, 12]), num_plans=6, length=3
        ... )
        >>> plans.shape, rollout.final_state.shape
        (torch.Size([2, 6, 3]), torch.Size([2, 6]))
    """
    _check(num_plans, length, temperature, 1)
    # Memory of the plans and their rewards.
    check_memory(5 * len(state) * num_plans * length, num_plans=num_plans, length=length)
    stepper = Stepper(prior)
    with stepper.threads_for(len(state) * num_plans):
        return _sample_in_world(stepper, world, state, num_plans, length, temperature, generator, keep_states)


def _sample_in_world(
    stepper: Stepper,
    world: World,
    state: Tensor,
    num_plans: int,
    length: int,
    temperature: float,
    generator: torch.Generator | None,
    keep_states: bool,
) -> tuple[Tensor, Rollout]:
    """As `sample_in_world`."""
    logits, hidden = stepper.start_in(world, state)
    generator, batch = generator_on(generator, logits.device), len(state)
    draw = Draw(stepper.num_actions, temperature, generator)
    now, root = state, torch.arange(batch, device=state.device)
    counts = torch.full((batch,), num_plans, device=state.device)
    begun: list[list[Tensor]] = [[], [], []]  # actions, rewards and states of each step of the tree
    depth, alone = 0, world.stochastic or are_few(batch * num_plans, state.device)
    while depth < length and not alone and 2 * logits.numel() <= batch * num_plans:
        children = draw.split(counts, legal_logits(world, now, logits))
        row, action = children.nonzero(as_tuple=True)
        counts = children[row, action]
        root, hidden, now = _select_each(row, root, hidden, now)
        begun = [_select_each(row, *column) for column in begun]
        now, reward = step_alive(world, now, action, generator)
        for column, values in zip(begun, (action.to(draw.dtype), reward, now), strict=True):
            column.append(values)
        if not keep_states:
            begun[2].clear()
        depth += 1
        if depth < length:
            logits, hidden = stepper.step_in(world, action, hidden, now)
    row = shuffled_rows(counts, root, generator)
    steps = range(depth, length)
    uniform = None if world.stochastic else draw.uniform((len(steps), len(row)), logits)
    shares = stepper.shares and world.shares_steps and uniform is not None
    parts = _parts(len(row), logits, hidden, shares) if shares else [slice(0, len(row))]
    ends: dict[int, tuple[Tensor, list[list[Tensor]]]] = {}  # last states and columns of each part

    def draw_chunk(number: int) -> None:
        rows = row[parts[number]]
        history = [_select_each(rows, *column) for column in begun]
        plans, (current, after, memory) = _begin_prefixes(rows, draw, uniform is not None, now, logits, hidden)
        for k in range(len(steps)):
            numbers = None if uniform is None else uniform[k, parts[number]]
            action = draw.actions(legal_logits(world, current, after), numbers, plans.row)
            parent, last = plans.extend(action)
            if parent is not None:
                current, memory = _select_each(parent, current, memory)
            current, reward = step_alive(world, current, last, generator)
            history[0].append(action.to(draw.dtype))
            history[1].append(plans.of_each(reward))
            if keep_states:
                history[2].append(plans.of_each(current))
            if k + 1 < len(steps):
                after, memory = stepper.step_in(world, last, memory, current)
        ends[number] = plans.of_each(current), history

    share(draw_chunk, range(len(parts)))
    final = torch.cat([ends[number][0] for number in range(len(parts))])
    columns = zip(*(ends[number][1] for number in range(len(parts))), strict=True)
    joined = [[torch.cat(of) for of in zip(*column, strict=True)] for column in columns]
    states = join_states(joined[2], state, (batch, num_plans, *state.shape[1:])) if keep_states else None
    # There is nothing to stack where there are no steps.
    empty = (torch.zeros(len(final), 0, dtype=draw.dtype), torch.zeros(len(final), 0))
    plans, rewards = (
        torch.stack(column, 1) if column else none.to(final.device) for column, none in zip(joined, empty, strict=False)
    )
    shape = (batch, num_plans, length)
    return plans.view(shape), Rollout(final.view(*shape[:2], *state.shape[1:]), rewards.view(shape), states)


def _parts(number: int, logits: Tensor, state: State, shares: bool) -> list[slice]:
    """Parts of so many plans that are stepped together: on a CPU, as many as have states that fit a cache."""
    parts = 1
    if logits.device.type == "cpu" and len(logits):  # states that fit a cache are read several times as fast
        together = max(CACHED // max(numbers_in(state) // len(logits), logits.shape[1], 1), FEWEST)
        parts = max(-(-number // together), 1)
        if shares and number >= 2 * FEWEST:
            parts = -(-parts // torch.get_num_threads()) * torch.get_num_threads()
    return [slice(number * k // parts, number * (k + 1) // parts) for k in range(parts)]


def _select_each(row: Tensor, *states: Any) -> list[Any]:
    """The rows `row` of each tensor or state."""
    return [select_rows(state, row) for state in states]


def _begin_prefixes(row: Tensor, draw: Draw, shared: bool, *states: Any) -> tuple[Prefixes, list[Any]]:
    """Plans that go on from rows `row [N]` of tensors or states, and of these the rows from the first to the last.

    Those that begin alike are stepped once where they are `shared`, unless they are few for the device.
    """
    first, behind = (int(row.min()), int(row.max()) + 1) if len(row) else (0, 0)
    plans = Prefixes(row - first, behind - first, draw.num_actions, shared and not are_few(len(row), row.device))
    return plans, [select_rows(state, slice(first, behind)) for state in states]


def _check(num_plans: int, length: int, temperature: float, batch_size: int) -> None:
    check_count("num_plans", num_plans, 0)
    check_count("length", length, 0)
    check_sizes(batch_size=batch_size)
    check_temperature(temperature)


def _checked_past(past: Tensor | None, num_plans: int, num_actions: int) -> Tensor:
    """The past `[T]` or `[N, T]`, int64; T is 0 where there is none."""
    if past is None:
        return torch.zeros(0, dtype=torch.long)
    past = torch.as_tensor(past)
    if past.dim() not in (1, 2) or (past.dim() == 2 and len(past) != num_plans):
        raise ValueError(f"`past` must be actions [T] or [{num_plans}, T], got {list(past.shape)}")
    if past.numel():
        check_range("past", past, num_actions, "actions")
    return past.long()


def _checked_state(state: tuple[Tensor, State], num_plans: int, num_actions: int) -> tuple[Tensor, State]:
    """A copy of the logits and the state of one row or N, which may be overwritten.

    Raises:
        ValueError: it is none.
    """
    shape = list(getattr(state[0], "shape", [])) if isinstance(state, tuple) and state else []
    if len(shape) != 2:
        raise ValueError("`state` must be what `start` or `step` returned, logits [N, A] and a state")
    if shape[1] != num_actions or shape[0] not in (1, num_plans):
        raise ValueError(
            f"`state` must be of 1 row or of num_plans = {num_plans}, with {num_actions} logits each, got {shape}"
        )
    logits, hidden = check_outputs(state, shape[0], num_actions, "step")
    return logits, map_state(torch.clone, hidden)


def _begin(stepper: Stepper, num_roots: int, context: Tensor | None, past: Tensor, length: int) -> tuple[Tensor, State]:
    """Logits and state of each root after its `past [T]` or `[roots, T]`, under its context; `length` steps follow."""
    per_step = context is not None and not is_per_plan(context)
    logits, state = stepper.start(num_roots, context[:, 0] if context is not None and per_step else context)
    behind = past.shape[-1]
    for t, action in enumerate(past.expand(num_roots, behind).unbind(1)):
        current = context[:, t + 1] if context is not None and per_step else None
        logits, state = stepper.step(action, state, current)
    return logits, state


def _sample_masked(
    stepper: Stepper,
    row: Tensor,
    logits: Tensor,
    state: State,
    context: Tensor | None,
    mask: Tensor | Mask,
    length: int,
    draw: Draw,
) -> Tensor:
    """Plans `[N, length]` of actions that a mask allows; plan i goes on from row `row[i]` of logits and state."""
    plans = torch.empty(len(row), length, dtype=torch.long, device=row.device)
    logits, state = logits[row], select_rows(state, row)
    for t in range(length):
        allowed = _allowed_actions(mask, plans, t, draw.num_actions).to(logits.device)
        if not allowed.any(-1).all():
            raise ValueError(f"`mask` must allow an action in each plan, got none at step {t}")
        plans[:, t] = draw.actions(logits.masked_fill(~allowed, -torch.inf))
        if t + 1 < length:
            current = None if context is None else context[:, t + 1]
            logits, state = stepper.step(plans[:, t], state, current)
    return plans.to(draw.dtype)


def _allowed_actions(mask: Tensor | Mask, plans: Tensor, step: int, num_actions: int) -> Tensor:
    """Which actions may be drawn next, bool `[A]` or `[N, A]`, in `plans [N, L]` of which `step` actions are drawn."""
    num_plans, length = plans.shape
    allowed = mask(plans[:, :step]) if callable(mask) else mask
    if isinstance(allowed, Sequence | np.ndarray):
        allowed = torch.as_tensor(allowed)
    if isinstance(allowed, Tensor) and is_integer(allowed) and ((allowed == 0) | (allowed == 1)).all():
        allowed = allowed.bool()
    shapes = [[num_actions], [length, num_actions], [num_plans, length, num_actions]]
    if callable(mask):
        shapes = [[num_plans, num_actions]]
    if not isinstance(allowed, Tensor) or allowed.dtype != torch.bool or list(allowed.shape) not in shapes:
        due = " or ".join(map(str, shapes))
        raise ValueError(f"`mask` must {'return' if callable(mask) else 'be'} bool {due}, got {describe(allowed)}")
    return allowed if callable(mask) or allowed.dim() == 1 else allowed[..., step, :]


def _sample_from_roots(
    stepper: Stepper,
    counts: Tensor,
    logits: Tensor,
    state: State,
    context: Tensor | None,
    length: int,
    draw: Draw,
    method: str,
    batch_size: int,
) -> Tensor:
    """`counts[r]` plans from each root r: `[total, length]`, root by root, shuffled within.

    Args:
        stepper: the prior.
        counts: int64 `[roots]`.
        logits, state: of the roots.
        context: None, or that of each step to come; then each root has one plan.
        length, draw, method, batch_size: see `sample`.
    """
    total = int(counts.sum())
    whole = stepper.draw_plans(state, counts, length, draw) if method == "auto" and context is None else None
    if whole is not None:
        return whole
    prefix = torch.empty(len(counts), 0, dtype=draw.dtype, device=counts.device)
    root = torch.arange(len(counts), device=counts.device)
    always = {"tree": True, "ancestral": False}
    if are_few(total, counts.device):
        always["auto"] = False
    while prefix.shape[1] < length and always.get(method, worth_splitting(len(counts) * draw.num_actions, total)):
        children = draw.split(counts, logits)
        parent, action = children.nonzero(as_tuple=True)
        counts = children[parent, action]
        prefix, root = _select_each(parent, prefix, root)
        prefix = torch.cat([prefix, action[:, None].to(draw.dtype)], 1)
        if prefix.shape[1] < length:
            logits, state = stepper.step(action, select_rows(state, parent))
    row = shuffled_rows(counts, root, draw.generator)
    depth, begun = prefix.shape[1], prefix[row]
    if depth == length:
        return begun
    plans = torch.empty(total, length, dtype=draw.dtype, device=counts.device)
    plans[:, :depth] = begun
    for at in range(0, total, batch_size):
        rows, span = row[at : at + batch_size], slice(at, at + batch_size)
        plans[span, depth:] = _sample_one_by_one(stepper, rows, logits, state, context, range(depth, length), draw)
    return plans


def _sample_one_by_one(
    stepper: Stepper, row: Tensor, logits: Tensor, state: State, context: Tensor | None, steps: range, draw: Draw
) -> Tensor:
    """The actions `[N, len(steps)]` of N plans at these `steps`; plan i continues row `row[i]` of logits and state."""
    actions = torch.empty(len(row), len(steps), dtype=draw.dtype, device=row.device)
    uniform = draw.uniform((len(steps), len(row)), logits)

    def draw_chunk(span: slice) -> None:
        plans, (now, hidden) = _begin_prefixes(row[span], draw, context is None, logits, state)
        for k, t in enumerate(steps):
            action = draw.actions(now, uniform[k, span], plans.row)
            actions[span, k] = action
            if k + 1 < len(steps):
                parent, last = plans.extend(action)
                if parent is not None:
                    hidden = select_rows(hidden, parent)
                if plans.row is None and context is None:
                    later_actions = stepper.draw_rest(last, hidden, uniform[k + 1 :, span], draw.temperature)
                    if later_actions is not None:
                        actions[span, k + 1 :] = later_actions
                        return
                next_context = None if context is None else context[row[span], t + 1]
                now, hidden = stepper.step(last, hidden, next_context)

    parts = _parts(len(row), logits, state, stepper.shares)
    if stepper.shares:
        share(draw_chunk, parts)
    else:
        for span in parts:
            draw_chunk(span)
    return actions
