"""Sampling plans from any prior through `start` and `step` alone: ancestral, by prefix tree, or along with a world."""

from typing import Literal, Protocol

import torch
from torch import Tensor

from neuroprior.plans import action_dtype, sees_each_step
from neuroprior.randomness import generator_on
from neuroprior.worlds.world import Rollout, World, is_integer, join_states


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
    if context is not None and sees_each_step(context) and context.shape[1] < length:
        raise ValueError(f"context: {length} steps are to be sampled, but it has only {context.shape[1]}")
    prior.check_context_of(context, num_plans, length)
    draw = _Draw(prior.num_actions, temperature, generator_on(generator, prior.device), prior.end)
    if context is None:
        roots = torch.full((min(num_plans, 1),), num_plans, device=prior.device)
        return _grow(prior, roots, None, length, draw, method, batch_size)
    if sees_each_step(context) or not is_integer(context):
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
    world.check_state(state)
    if prior.end is not None:
        raise ValueError("prior: it samples an end symbol, which is no action of the world")
    if prior.num_actions != world.num_actions:
        raise ValueError(f"prior has {prior.num_actions} actions, the world {world.num_actions}")
    generator = generator_on(generator, prior.device)
    draw = _Draw(prior.num_actions, temperature, generator)
    batch = state.shape[0]
    now = state.repeat_interleave(num_plans, 0)
    seen = world.observe(now) if prior.context_per is not None else None
    if seen is not None and sees_each_step(seen):
        raise ValueError(f"observe: indices [N] or features [N, C] are expected, not {seen.dtype} {list(seen.shape)}")
    prior.check_context_of(seen, len(now))
    logits, memory = prior.start(len(now), seen)
    actions, states = [torch.zeros(len(now), 0, dtype=draw.dtype, device=state.device)], []
    rewards = [torch.zeros(len(now), 0, device=state.device)]
    for t in range(length):
        if not world.all_legal:
            logits = logits.masked_fill(~world.legal(now), -torch.inf)
        action = draw.actions(logits)
        now, reward = world.step(now, action, generator)
        actions.append(action[:, None].to(draw.dtype))
        rewards.append(reward[:, None])
        if keep_states:
            states.append(now)
        if t + 1 < length:
            logits, memory = prior.step(action, memory, world.observe(now) if prior.context_per == "step" else None)
    shape = (batch, num_plans, *state.shape[1:])
    course = join_states(states, state, shape) if keep_states else None
    gained = torch.cat(rewards, 1).view(batch, num_plans, length)
    return torch.cat(actions, 1).view(batch, num_plans, length), Rollout(now.view(shape), gained, course)


def after_end(logits: Tensor, before: Tensor, end: int | None) -> Tensor:
    """`logits [..., A]`, but nothing else than the end symbol where the action `before [...]` was that symbol."""
    if end is None:
        return logits
    ended = torch.full_like(logits[..., :1], -torch.inf).repeat_interleave(logits.shape[-1], -1)
    ended[..., end] = 0
    return torch.where((before == end)[..., None], ended, logits)


def _check(num_plans: int, length: int, temperature: float, batch_size: int) -> None:
    if num_plans < 0 or length < 0 or batch_size < 1:
        raise ValueError(
            "num_plans and length must not be negative and batch_size at least 1,"
            f" not {num_plans}, {length} and {batch_size}"
        )
    if not 0 < temperature < float("inf"):
        raise ValueError(f"temperature: a positive finite number is expected, not {temperature}")


class _Draw:
    """Draws actions from logits."""

    def __init__(
        self, num_actions: int, temperature: float, generator: torch.Generator, end: int | None = None
    ) -> None:
        self.num_actions, self.temperature, self.generator, self.end = num_actions, temperature, generator, end
        self.dtype = action_dtype(num_actions)

    def actions(self, logits: Tensor) -> Tensor:
        """One action a row of `logits [N, A]`: int64 `[N]`. Actions of probability 0 are never drawn."""
        cumulative = self._probs(logits).cumsum(-1)
        total = cumulative[:, -1:]
        uniform = torch.rand(len(logits), 1, generator=self.generator, device=logits.device, dtype=cumulative.dtype)
        action = (cumulative <= uniform * total).sum(-1)
        # Rounding can carry uniform * total up to total itself, past the last action that has any probability.
        return torch.minimum(action, (cumulative < total).sum(-1))

    def _probs(self, logits: Tensor) -> Tensor:
        # The largest is taken off first, so that no temperature makes it infinite.
        return torch.softmax((logits - logits.amax(-1, keepdim=True)) / self.temperature, -1)

    def split(self, counts: Tensor, logits: Tensor) -> Tensor:
        """Split `counts [M]` multinomially by the rows of `logits [M, A]`: `[M, A]`, a binomial draw an action."""
        probs = self._probs(logits.double())
        # The share of an action among those not yet dealt out: exact 0 and 1 are kept by summing from the end.
        rest = probs.flip(-1).cumsum(-1).flip(-1)
        share = torch.where(rest > 0, probs / rest, 0).clamp_(0, 1)
        share[:, -1] = 1
        left = counts.double()
        parts = []
        for action in range(self.num_actions):
            part = torch.binomial(left, share[:, action].contiguous(), generator=self.generator)
            parts.append(part)
            left = left - part
        return torch.stack(parts, -1).long()


def _grow(
    prior: Steppable,
    counts: Tensor,
    context: Tensor | None,
    length: int,
    draw: _Draw,
    method: str,
    batch_size: int,
) -> Tensor:
    """`counts[r]` plans under `context[r]` for each root r: `[total, length]`, root by root, shuffled within."""
    total = int(counts.sum())
    plans = torch.empty(total, length, dtype=draw.dtype, device=counts.device)
    if total == 0 or length == 0:
        return plans
    per_step = sees_each_step(context)
    logits, state = prior.start(len(counts), context[:, 0] if context is not None and per_step else context)
    prefix = torch.empty(len(counts), 0, dtype=draw.dtype, device=counts.device)
    root = torch.arange(len(counts), device=counts.device)
    while prefix.shape[1] < length and _worth_splitting(method, len(counts) * draw.num_actions, total):
        children = draw.split(counts, logits)
        parent, action = children.nonzero(as_tuple=True)
        counts = children[parent, action]
        prefix = torch.cat([prefix[parent], action[:, None].to(draw.dtype)], 1)
        root = root[parent]
        if prefix.shape[1] < length:
            logits, state = prior.step(action, state[parent])
            logits = after_end(logits, action, draw.end)
        else:
            logits, state = logits[parent], state[parent]
    row = _shuffled_rows(counts, root, draw.generator)
    depth = prefix.shape[1]
    plans[:, :depth] = prefix[row]
    if depth == length:
        return plans
    for at in range(0, total, batch_size):
        some = row[at : at + batch_size]
        now, memory = logits[some], state[some]
        for t in range(depth, length):
            action = draw.actions(now)
            plans[at : at + batch_size, t] = action
            if t + 1 < length:
                seen = context[some, t + 1] if context is not None and per_step else None
                now, memory = prior.step(action, memory, seen)
                now = after_end(now, action, draw.end)
    return plans


def _worth_splitting(method: str, children: int, total: int) -> bool:
    """A split costs one evaluation a child; drawing plan by plan costs one a plan and needs no shuffling."""
    return method == "tree" or (method == "auto" and 8 * children <= total)


def _shuffled_rows(counts: Tensor, root: Tensor, generator: torch.Generator) -> Tensor:
    """The prefix of each plan: prefix m `counts[m]` times; root by root, in random order within a root."""
    row = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    if len(counts) == 1 or len(counts) == len(row) == int(root[-1]) + 1:
        return row
    row = row[torch.randperm(len(row), generator=generator, device=row.device)]
    if int(root[-1]) == 0:
        return row
    return row[root[row].argsort(stable=True)]
