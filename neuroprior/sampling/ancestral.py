"""Sampling plans from any prior through `start` and `step` alone: ancestral, by prefix tree, or along with a world."""

from typing import Literal, Protocol

import torch
from torch import Tensor

from neuroprior._checks import is_integer
from neuroprior._random import generator_on
from neuroprior.plans import is_per_step
from neuroprior.sampling.draws import (
    Draw,
    after_end,
    check_temperature,
    levels_worth_splitting,
    shuffled_rows,
    worth_splitting,
)
from neuroprior.sampling.rows import rows_of
from neuroprior.worlds.world import Rollout, World, join_states

CACHED, FEWEST = 2**19, 1024
"""Numbers in states, or logits, of plans that are drawn together on a CPU; and the fewest plans."""


class Steppable(Protocol):
    """What sampling knows of a prior."""

    num_actions: int
    context_per: Literal["plan", "step"] | None
    end: int | None

    @property
    def device(self) -> torch.device: ...

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]: ...

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]: ...

    def check_context_of(self, plans: Tensor | None, num_plans: int = 0, length: int = 0) -> None: ...


def advance(
    prior: Steppable, action: Tensor, state: Tensor, context: Tensor | None = None, room: int = 0
) -> tuple[Tensor, Tensor]:
    """`Prior.advance`, or a step where a prior has no such thing."""
    own = getattr(prior, "advance", None)
    return prior.step(action, state, context) if own is None else own(action, state, context, room)


def check_in_world(prior: Steppable, world: World, state: Tensor) -> None:
    """Raise ValueError unless a prior can act in a world from `state [B, ...]`."""
    world.check_state(state)
    if prior.end is not None:
        raise ValueError(
            "prior: it samples an end symbol, which is no action of the world; learn from plans without one"
        )
    if prior.num_actions != world.num_actions:
        raise ValueError(f"prior has {prior.num_actions} actions, the world {world.num_actions}")


def start_in_world(prior: Steppable, world: World, state: Tensor) -> tuple[Tensor, Tensor]:
    """What `prior.start` gives where the prior sees `state [B, ...]`.

    Raises:
        ValueError: the prior cannot act there, or what is seen is not what it sees.
    """
    check_in_world(prior, world, state)
    seen = world.observe(state) if prior.context_per is not None else None
    if seen is not None and is_per_step(seen):
        raise ValueError(f"observe: indices [N] or features [N, C] are expected, not {seen.dtype} {list(seen.shape)}")
    prior.check_context_of(seen, len(state))
    return prior.start(len(state), seen)


@torch.no_grad()
def sample(
    prior: Steppable,
    num_plans: int,
    length: int,
    context: Tensor | None = None,
    *,
    temperature: float = 1.0,
    generator: torch.Generator | None = None,
    method: Literal["auto", "ancestral", "tree"] = "auto",
    batch_size: int = 65_536,
) -> Tensor:
    """Independent plans from a prior, in random order.

    Plans that share a prefix share its evaluation: the number of plans is split multinomially over the distinct
    prefixes of each length ("tree"), which gives the same distribution as drawing each plan by itself ("ancestral").
    "auto" splits as long as prefixes are far fewer than plans, and goes on plan by plan from there.

    Args:
        prior: any prior.
        num_plans: number of plans, N.
        length: number of actions in a plan, L.
        context: None, one a plan (`[N]` indices or `[N, C]` features; plan i is drawn under context i), or one a step
            (`[N, L]`, `[N, L, C]`), where what will be seen is known beforehand.
        temperature: divides the logits; below 1 sharper, above 1 flatter.
        generator: the source of randomness; the same seed gives the same plans.
        method: how; see above. A context a step, and features, are always drawn plan by plan.
        batch_size: plans drawn together where they are drawn one by one; bounds memory.

    Returns:
        Actions `[N, L]`, uint8 (int64 where there are more than 256 actions). After the end symbol, for a prior that
        has one, there is nothing but end symbols; `Plans(..., end=...).without_end()` cuts them off.

    Raises:
        ValueError: an argument is out of range.
    """
    _check(num_plans, length, temperature, batch_size)
    context = None if context is None else torch.as_tensor(context, device=prior.device)
    if method not in ("auto", "ancestral", "tree"):
        raise ValueError(f'method: "auto", "ancestral" or "tree" is expected, not {method!r}')
    if context is not None and context.shape[0] != num_plans:
        raise ValueError(f"context: its first dimension must be num_plans = {num_plans}, not {context.shape[0]}")
    if context is not None and is_per_step(context) and context.shape[1] < length:
        raise ValueError(f"context: {length} steps are to be sampled, but it has only {context.shape[1]}")
    prior.check_context_of(context, num_plans, length)
    draw = Draw(prior.num_actions, temperature, generator_on(generator, prior.device), prior.end)
    if context is None:
        roots = torch.full((min(num_plans, 1),), num_plans, device=prior.device)
        return _grow(prior, roots, None, length, draw, method, batch_size)
    if is_per_step(context) or not is_integer(context):
        one_each = torch.ones(num_plans, dtype=torch.long, device=prior.device)
        return _grow(prior, one_each, context, length, draw, "ancestral", batch_size)
    distinct, which, counts = context.unique(return_inverse=True, return_counts=True)
    grouped = _grow(prior, counts, distinct, length, draw, method, batch_size)
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
    """Sample plans and try them in the same pass: the prior sees each state before it acts there.

    Plans from a start that begin alike share their beginning's evaluation and steps (see `sample`), unless the world
    says that chance has a part in it.

    The context of a prior that has one is `world.observe` of the start, and again of each further state unless the
    prior has learned from a context a plan. Actions that do not exist in a state (`world.legal`) are never sampled.

    Args:
        prior: any prior over the world's actions.
        world: the world.
        state: starts `[B, ...]`.
        num_plans: plans a start, P.
        length: number of actions in a plan, L.
        temperature: divides the logits.
        generator: draws actions and, in a world with chance, its steps.
        keep_states: also return the state after each step, in the rollout.

    Returns:
        Plans `[B, P, L]` and their `Rollout`.

    Raises:
        ValueError: an argument is out of range, or prior and world differ in their number of actions.
    """
    _check(num_plans, length, temperature, 1)
    logits, memory = start_in_world(prior, world, state)
    generator, batch = generator_on(generator, prior.device), len(state)
    draw = Draw(prior.num_actions, temperature, generator)
    now, root = state, torch.arange(batch, device=state.device)
    counts = torch.full((batch,), num_plans, device=state.device)
    tried: list[list[Tensor]] = [[], [], []]  # of each step: actions, rewards, states
    alone = False
    for t in range(length):
        if not world.all_legal:
            logits = logits.masked_fill(~world.legal_actions(now), -torch.inf)
        if not alone and (world.stochastic or 2 * logits.numel() > batch * num_plans):
            alone, row = True, shuffled_rows(counts, root, generator)
            logits, memory, now = _taken(row, logits, memory, now)
            tried = [_taken(row, *column) for column in tried]
        if alone:
            action = draw.actions(logits, draw.uniform((len(logits),), logits))
        else:
            children = draw.split(counts, logits)
            row, action = children.nonzero(as_tuple=True)
            counts = children[row, action]
            root, memory, now = _taken(row, root, memory, now)
            tried = [_taken(row, *column) for column in tried]
        now, reward = world.step(now, action, generator)
        for column, what in zip(tried, (action.to(draw.dtype), reward, now), strict=True):
            column.append(what)
        if not keep_states:
            tried[2].clear()
        if t + 1 < length:
            seen = world.observe(now) if prior.context_per == "step" else None
            logits, memory = advance(prior, action, memory, seen, length - t - 2 if alone else 0)
    if not alone:
        row = shuffled_rows(counts, root, generator)
        (now,), tried = _taken(row, now), [_taken(row, *column) for column in tried]
    course = join_states(tried[2], state, (batch, num_plans, *state.shape[1:])) if keep_states else None
    # no step at all leaves nothing to stack
    none = (torch.zeros(len(now), 0, dtype=draw.dtype), torch.zeros(len(now), 0))
    plans, gained = (
        torch.stack(steps, 1) if steps else empty.to(now.device) for steps, empty in zip(tried, none, strict=False)
    )
    shape = (batch, num_plans, length)
    return plans.view(shape), Rollout(now.view(*shape[:2], *state.shape[1:]), gained.view(shape), course)


def _taken(row: Tensor, *tensors: Tensor) -> list[Tensor]:
    """These rows of each."""
    return [rows_of(tensor, row) for tensor in tensors]


def _check(num_plans: int, length: int, temperature: float, batch_size: int) -> None:
    if num_plans < 0 or length < 0 or batch_size < 1:
        raise ValueError(
            "num_plans and length must not be negative and batch_size at least 1,"
            f" not {num_plans}, {length} and {batch_size}"
        )
    check_temperature(temperature)


def _grow(
    prior: Steppable,
    counts: Tensor,
    context: Tensor | None,
    length: int,
    draw: Draw,
    method: str,
    batch_size: int,
) -> Tensor:
    """`counts[r]` plans under `context[r]` for each root r: `[total, length]`, root by root, shuffled within."""
    total = int(counts.sum())
    if total == 0 or length == 0:
        return torch.empty(total, length, dtype=draw.dtype, device=counts.device)
    per_step = is_per_step(context)
    logits, state = prior.start(len(counts), context[:, 0] if context is not None and per_step else context)
    prefix = torch.empty(len(counts), 0, dtype=draw.dtype, device=counts.device)
    root = torch.arange(len(counts), device=counts.device)
    known = {"tree": True, "ancestral": False}
    while prefix.shape[1] < length and known.get(method, worth_splitting(len(counts) * draw.num_actions, total)):
        children = draw.split(counts, logits)
        parent, action = children.nonzero(as_tuple=True)
        counts = children[parent, action]
        prefix, root = _taken(parent, prefix, root)
        prefix = torch.cat([prefix, action[:, None].to(draw.dtype)], 1)
        if prefix.shape[1] < length:
            levels = levels_worth_splitting(len(counts), total, draw.num_actions)
            room = min(length - prefix.shape[1] - 1, levels)
            logits, state = advance(prior, action, rows_of(state, parent), None, room)
            logits = after_end(logits, action, draw.end)
    row = shuffled_rows(counts, root, draw.generator)
    depth = prefix.shape[1]
    begun = rows_of(prefix, row)
    if depth == length:
        return begun
    plans = torch.empty(total, length, dtype=draw.dtype, device=counts.device)
    plans[:, :depth] = begun
    for at in range(0, total, batch_size):
        some = row[at : at + batch_size]
        seen = context if per_step else None
        plans[at : at + batch_size, depth:] = _one_by_one(prior, some, logits, state, seen, range(depth, length), draw)
    return plans


def _one_by_one(
    prior: Steppable, row: Tensor, logits: Tensor, state: Tensor, context: Tensor | None, steps: range, draw: Draw
) -> Tensor:
    """The actions `[N, len(steps)]` of plans that go on by themselves, from what `row [N]` says of logits and state."""
    actions = torch.empty(len(row), len(steps), dtype=draw.dtype, device=row.device)
    uniform = draw.uniform((len(steps), len(row)), logits)
    together = len(row)
    if row.device.type == "cpu":  # states that fit a cache are several times as quick to read
        together = max(CACHED // max(state[0].numel(), logits.shape[1], 1), FEWEST)
    for at in range(0, len(row), together):
        part = slice(at, at + together)
        now, memory = _taken(row[part], logits, state)
        for k, t in enumerate(steps):
            action = draw.actions(now, uniform[k, part])
            actions[part, k] = action
            if k + 1 < len(steps):
                seen = None if context is None else context[row[part], t + 1]
                now, memory = advance(prior, action, memory, seen, len(steps) - k - 2)
                now = after_end(now, action, draw.end)
    return actions
