"""Exact solutions in tables: the best plan (`oracle`), scores of plans (`expected_score`), state values."""

import itertools
import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_range, check_sizes, is_number
from neuroprior.planners.planner import settle_objective, value_of
from neuroprior.worlds.tabular import TabularWorld, check_tabular
from neuroprior.worlds.world import check_plans

OUTCOMES_AT_ONCE = 2**22
"""Plans times cells times outcomes of an action that are computed together; bounds memory."""


def oracle(
    world: TabularWorld,
    state: Tensor,
    length: int,
    *,
    objective: Literal["terminal", "return"] | None = None,
    discount: float | None = None,
    value: Callable[[Tensor], Tensor] | None = None,
    any_prefix: bool = False,
) -> Tensor:
    """The exact highest score of all legal plans of `length` actions, by finite-horizon dynamic programming.

    In a stochastic world it is the highest expected score of all closed-loop policies, which choose each action in the
    state that the earlier ones led to: an upper bound for plans, whose actions are fixed in advance.

    Args:
        world: a table.
        state: starts `[B]`.
        length: number of actions, at least 1.
        objective, discount, value, any_prefix: see `Planner`.

    Returns:
        `[B]` floating point. Takes `length * W * S * A` operations whatever B is.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = TabularWorld(torch.tensor([[0, 1], [2, 0], [2, 2]]), torch.tensor([0.0, 0.5, 1.0]))
        >>> (
        ...     oracle(world, torch.tensor([0, 1]), length=1).tolist(),
        ...     oracle(world, torch.tensor([0, 1]), length=2).tolist(),
        ... )
        ([0.5, 1.0], [1.0, 1.0])
    """
    check_sizes(length=length)
    check_tabular(world)
    objective, discount = settle_objective(world, objective, discount)
    world.check_state(state)
    maps, states, actions = world.num_maps, world.num_states, world.num_actions
    reward = world.mean_reward()
    best = torch.zeros(maps, states, device=world.device, dtype=reward.dtype)
    if value is not None:
        best = value_of(value, torch.arange(maps * states, device=world.device)).view(maps, states).to(reward.dtype)
    prefix = torch.full_like(best, -torch.inf)
    for left in range(length):
        after = world.mean_after(best)
        if objective == "return":
            after = reward + discount * after
        elif left == 0:
            after = reward + after
        if world.legal_table is not None:
            after = after.masked_fill(~world.legal_table, -torch.inf)
        best = after.view(maps, states, actions).amax(-1)
        prefix = torch.maximum(prefix, best)
    return (prefix if any_prefix else best).view(-1)[state]


@torch.no_grad()
def expected_score(
    world: TabularWorld,
    state: Tensor,
    plans: Tensor,
    *,
    objective: Literal["terminal", "return"] | None = None,
    discount: float | None = None,
    value: Callable[[Tensor], Tensor] | None = None,
    lengths: Tensor | None = None,
) -> Tensor:
    """The exact expected score of plans that are executed in open loop, whatever their actions lead to.

    The score that a planner gives the plan it chose is the greatest of many noisy means, and so biased upwards (the
    winner's curse); this one is exact. In a deterministic world it is the plan's score.

    Args:
        world: a table.
        state: starts `[B]`.
        plans: integers `[B, P, L]`; for one plan per start, `plans[:, None]`.
        objective, discount, value: see `Planner`.
        lengths: integers `[B, P]`, 1 to L: how many actions of each plan are executed; None: all.

    Returns:
        `[B, P]` floating point. Takes `B * P * L * S * K` operations.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world, start, plans = gridworld(5, 5, seed=0), torch.tensor([0, 12]), torch.tensor([[[0, 1]], [[2, 3]]])
        >>> torch.equal(expected_score(world, start, plans), world.rollout(start, plans).rewards[..., -1])
        True
    """
    check_tabular(world)
    objective, discount = settle_objective(world, objective, discount)
    world.check_state(state)
    check_plans(plans, len(state), world.num_actions)
    batch, num_plans, length = plans.shape
    if length < 1:
        raise ValueError("`plans` must have at least one action, got 0")
    if lengths is None:
        lengths = torch.full((batch, num_plans), length, device=state.device)
    _check_lengths(lengths, plans.shape)
    worth = torch.zeros(world.num_maps * world.num_states, device=world.device)
    if value is not None:
        worth = value_of(value, torch.arange(len(worth), device=world.device))
    table = _Table(world, worth)
    outcomes = 1 if world.probability is None else world.probability.shape[2]
    size = max(OUTCOMES_AT_ONCE // (world.num_states * outcomes), 1)
    rows = zip(
        state.repeat_interleave(num_plans).split(size),
        plans.reshape(-1, length).split(size),
        lengths.reshape(-1).split(size),
        strict=True,
    )
    scores = [table.scores(*chunk, objective == "terminal", discount) for chunk in rows]
    return torch.cat(scores).view(batch, num_plans).to(world.reward.dtype)


class _Table:
    """A world's transitions and mean rewards, action by action: `[A, S * K]` and `[W * A, S]`."""

    def __init__(self, world: TabularWorld, worth: Tensor) -> None:
        self.world = world
        shape = world.num_actions, -1
        self.next_state = world.next_state.transpose(0, 1).reshape(shape)
        self.probability = None if world.probability is None else world.probability.transpose(0, 1).reshape(shape)
        self.reward = world.mean_reward().double().transpose(1, 2).reshape(-1, world.num_states)
        self.worth = worth.double().view(-1, world.num_states)

    def scores(self, state: Tensor, plans: Tensor, lengths: Tensor, terminal: bool, discount: float) -> Tensor:
        """The expected scores `[N]` of the first `lengths [N]` actions of `plans [N, L]` from `state [N]`."""
        world = self.world
        reward_map = world.reward_map(state)
        # The probability of each cell, [N, S].
        share = torch.zeros(len(state), world.num_states, device=state.device, dtype=torch.float64)
        share.scatter_(1, world.cell(state)[:, None], 1.0)
        score = torch.zeros(len(state), device=state.device, dtype=torch.float64)
        for t in range(plans.shape[1]):
            action, executed = plans[:, t].long(), t < lengths
            reward = _mean(share, self.reward.index_select(0, reward_map * world.num_actions + action))
            counts = lengths == t + 1 if terminal else executed
            score = torch.where(counts, score + discount**t * reward, score)
            share = torch.where(executed[:, None], self._propagate(share, action), share)
        weight = 1.0 if terminal else discount ** lengths.double()
        return score + weight * _mean(share, self.worth.index_select(0, reward_map))

    def _propagate(self, share: Tensor, action: Tensor) -> Tensor:
        """The probability of each cell after one more `action [N]`."""
        to = self.next_state.index_select(0, action)
        outcomes = to.shape[1] // share.shape[1]
        weight = share.repeat_interleave(outcomes, 1)
        if self.probability is not None:
            weight = weight * self.probability.index_select(0, action)
        return torch.zeros_like(share).scatter_add_(1, to, weight)


def _mean(share: Tensor, values: Tensor) -> Tensor:
    """The mean `[N]` of `values [N, S]`; a cell of probability 0 does not count, even if its value is infinite."""
    return (share * values).masked_fill(share == 0, 0).sum(1)


def _check_lengths(lengths: Tensor, shape: torch.Size) -> None:
    if lengths.shape != shape[:2]:
        raise ValueError(f"`lengths` must have shape [B, P] = {list(shape[:2])}, got {list(lengths.shape)}")
    check_range("lengths", lengths, shape[2] + 1, "lengths")
    if (lengths < 1).any():
        where = (lengths < 1).nonzero()[0].tolist()
        raise ValueError(f"lengths{where}: at least one action must be executed, not 0")


@torch.no_grad()
def value_iteration(
    world: TabularWorld,
    *,
    discount: float = 0.9,
    goal: int | None = None,
    sweeps: int | None = None,
    tolerance: float = 1e-9,
) -> Tensor:
    """Returns optimal state values, exact or after some sweeps.

    With a goal, the reward is 1 for reaching it and 0 otherwise, whatever rewards the world has. A cell at distance d
    then has the value discount ** (d - 1), and the goal itself 1 / discount: a planner that maximises the value of the
    final cell must prefer the goal to the cells beside it.

    Args:
        world: gives the transitions, the legal actions and, without a goal, the rewards of its W reward maps.
        discount: the factor for a reward one step later: at least 0 (with a goal: above 0) and below 1.
        goal: the goal's cell, for the values of reaching it; None: the world's own rewards, for ever.
        sweeps: stop after so many synchronous sweeps from values of 0: with a goal, cells farther from it than that
            then still have the value 0. None: until convergence.
        tolerance: converged is when no value changes by more than this; values are then within
            tolerance * discount / (1 - discount) of the true ones. With a goal in a deterministic world, when no value
            changes at all.

    Returns:
        `[W, S]` float64; with a goal `[1, S]`.

    Raises:
        ValueError: an argument is out of range, or the reward of a legal action is infinite.

    Example:
        >>> world = TabularWorld(torch.tensor([[0, 1], [1, 1]]), torch.tensor([0.0, 1.0]))
        >>> value_iteration(world, discount=0.5).round(decimals=2).tolist()
        [[2.0, 2.0]]
    """
    if sweeps is not None:
        check_count("sweeps", sweeps, 0)
    if not (is_number(tolerance) and tolerance > 0):
        raise ValueError(f"`tolerance` must be above 0, got {tolerance!r}.")
    if not (is_number(discount) and 0 <= discount < 1) or (goal is not None and discount == 0):
        raise ValueError(f"`discount` must be at least 0 (with a goal: above 0) and below 1, got {discount!r}.")
    if goal is not None:
        goal, tolerance = check_goal(world, goal), tolerance if world.stochastic else 0.0
    rewards = _action_rewards(world, goal is not None)
    values = rewards.new_zeros(rewards.shape[0], world.num_states)
    if goal is not None:
        values[:, goal] = 1 / discount
    most = math.inf
    for _ in itertools.count() if sweeps is None else range(sweeps):
        before, values = values, (rewards + discount * world.mean_after(values)).amax(-1)
        if goal is not None:
            values[:, goal] = 1 / discount
        # Each sweep shrinks the largest change at least by the discount; rounding must not hide that.
        most = min(float((values - before).abs().max()), most * discount)
        if sweeps is None and not most > tolerance:
            break
    return values


def _action_rewards(world: TabularWorld, none: bool) -> Tensor:
    """The reward of each action in each cell, `[W, S, A]` float64, or 0 `[1, S, A]`; -inf where it is not legal."""
    shape = 1, world.num_states, world.num_actions
    rewards = (world.reward.new_zeros(shape) if none else world.mean_reward()).double()
    legal = world.legal_actions(torch.arange(world.num_states, device=world.device))
    for where in (rewards.isinf() & legal).nonzero().tolist()[:1]:
        raise ValueError(f"world: the reward of [map, cell, action] {where} is infinite; values need finite ones")
    return rewards.masked_fill(~legal, -torch.inf)


def check_goal(world: TabularWorld, goal: int) -> int:
    """Returns `goal`, a cell of the world; ValueError where it is none, or the world is no table."""
    check_tabular(world)
    if goal not in range(world.num_states):
        raise ValueError(f"`goal` must be a cell from 0 to {world.num_states - 1}, got {goal!r}.")
    return int(goal)
