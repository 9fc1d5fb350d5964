"""Worlds that are tables: a transition table and any number of reward maps over it, all evaluated in one call."""

from collections.abc import Sequence

import torch
from torch import Tensor

from neuroprior.randomness import generator_on
from neuroprior.worlds.world import Rollout, World, check_plans, check_range, is_integer, join_states


class TabularWorld(World):
    """A deterministic world of S cells and A actions, with W reward maps over the same transition table.

    A state is one integer, `reward_map * S + cell`: a start chooses its map, and a batch may mix maps. With one map
    (W = 1) a state is just its cell.

    Args:
        next_state: integers `[S, A]`: the cell that each action leads to.
        reward: floating point. `[S]`: the reward of arriving in a cell. `[S, A]`: the reward of an action in a cell.
            `[W, S]` and `[W, S, A]`: the same for W reward maps. Where a shape could mean two of these (S = A), give
            all three dimensions, or `[1, S]`.
        legal: `[S, A]` bool: which actions exist; None where all do. Every cell needs at least one.
        action_names: A names, for tables and figures.

    Raises:
        ValueError: a shape, dtype or value is wrong.
    """

    def __init__(
        self,
        next_state: Tensor,
        reward: Tensor,
        legal: Tensor | None = None,
        action_names: Sequence[str] | None = None,
    ) -> None:
        next_state = torch.as_tensor(next_state)
        if next_state.dim() != 2 or 0 in next_state.shape:
            raise ValueError(f"next_state: shape [S, A] is expected, not {list(next_state.shape)}")
        self.num_states, self.num_actions = next_state.shape
        check_range("next_state", next_state, self.num_states, "states")
        self._set_maps(_reward_maps(torch.as_tensor(reward, device=next_state.device), *next_state.shape))
        self.next_state = next_state.long()
        self.legal_actions = None if legal is None else _legal_table(torch.as_tensor(legal), self.next_state)
        self.all_legal = self.legal_actions is None
        if action_names is not None and len(action_names) != self.num_actions:
            raise ValueError(f"action_names: {self.num_actions} names are expected, not {len(action_names)}")
        self.action_names = None if action_names is None else tuple(action_names)

    def _set_maps(self, reward: Tensor) -> None:
        """Take over `reward`, `[W, S]` (on arrival) or `[W, S, A]` (on acting)."""
        self.reward, self.num_maps = reward, len(reward)
        if self.num_maps * self.num_states * self.num_actions >= 2**31:
            raise ValueError("reward: maps x states x actions must be below 2**31; use fewer maps in one world")

    @property
    def device(self) -> torch.device:
        """Where the tables are."""
        return self.next_state.device

    def to(self, device: torch.device | str) -> "TabularWorld":
        """Move the tables to `device`; returns self."""
        self.next_state, self.reward = self.next_state.to(device), self.reward.to(device)
        if self.legal_actions is not None:
            self.legal_actions = self.legal_actions.to(device)
        return self

    def state(self, cell: Tensor, reward_map: Tensor | int = 0) -> Tensor:
        """The states `[N]` of `cell [N]` under `reward_map` (an integer or `[N]`)."""
        check_range("cell", torch.as_tensor(cell), self.num_states, "cells")
        check_range("reward_map", torch.as_tensor(reward_map), self.num_maps, "reward maps")
        return torch.as_tensor(cell).long() + torch.as_tensor(reward_map, device=cell.device).long() * self.num_states

    def cell(self, state: Tensor) -> Tensor:
        """The cell of each state, between 0 and S - 1."""
        return state % self.num_states

    def reward_map(self, state: Tensor) -> Tensor:
        """The reward map of each state, between 0 and W - 1."""
        return state.div(self.num_states, rounding_mode="floor")

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size]`, uniform over cells and reward maps."""
        generator = generator_on(generator, self.device)
        return torch.randint(self.num_maps * self.num_states, (batch_size,), generator=generator, device=self.device)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        cell = self.cell(state)
        offset = state - cell
        taken = cell * self.num_actions + action
        after = self.next_state.view(-1)[taken] + offset
        if self.reward.dim() == 2:
            return after, self.reward.view(-1)[after]
        return after, self.reward.view(-1)[offset * self.num_actions + taken]

    def rollout(
        self, state: Tensor, plans: Tensor, generator: torch.Generator | None = None, keep_states: bool = False
    ) -> Rollout:
        """See `World.rollout`. One gather a step for the transitions and one for the rewards, on int32 tables."""
        self.check_state(state)
        check_plans(plans, state.shape[0], self.num_actions)
        batch, num_plans, length = plans.shape
        actions = self.num_actions
        table, flat_reward = self.next_state.int().view(-1), self.reward.view(-1)
        per_action = self.reward.dim() == 3
        cell = self.cell(state)
        offset = (state - cell).int()[:, None]
        cell = cell.int()[:, None].expand(batch, num_plans)
        rewards = self.reward.new_empty(length, batch, num_plans)
        cells = []
        for t in range(length):
            taken = torch.add(plans[:, :, t].int(), cell, alpha=actions)
            cell = table.index_select(0, taken.reshape(-1)).view(batch, num_plans)
            at = taken + offset * actions if per_action else cell + offset
            torch.index_select(flat_reward, 0, at.reshape(-1), out=rewards[t].view(-1))
            if keep_states:
                cells.append(cell)
        course = None
        if keep_states:
            course = join_states(cells, state, (batch, num_plans)).to(state) + (state - self.cell(state))[:, None, None]
        return Rollout((cell + offset).long(), rewards.permute(1, 2, 0), course)

    def observe(self, state: Tensor) -> Tensor:
        """The cell of each state: an agent sees where it is, not which reward map holds."""
        return self.cell(state)

    def legal(self, state: Tensor) -> Tensor:
        if self.legal_actions is None:
            return super().legal(state)
        return self.legal_actions[self.cell(state)]

    def check_state(self, state: Tensor) -> None:
        if state.dim() != 1:
            raise ValueError(f"state: shape [B] is expected, not {list(state.shape)}")
        if state.dtype != torch.int64:
            raise ValueError(
                f"state: int64 is expected, not {str(state.dtype).removeprefix('torch.')}; use state.long()"
            )
        check_range("state", state, self.num_maps * self.num_states, "states (reward maps x cells)")


def _reward_maps(reward: Tensor, states: int, actions: int) -> Tensor:
    """`reward` as `[W, S]` (on arrival) or `[W, S, A]` (on acting)."""
    if is_integer(reward) or reward.dtype == torch.bool:
        reward = reward.float()
    if not reward.is_floating_point():
        raise ValueError(f"reward: real numbers are expected, not {str(reward.dtype).removeprefix('torch.')}")
    if reward.isnan().any():
        raise ValueError(f"reward{reward.isnan().nonzero()[0].tolist()}: NaN is not a reward")
    shape = tuple(reward.shape)
    if shape == (states, actions) and states == actions:
        raise ValueError(
            f"reward: shape {list(shape)} may mean [S, A] or [W, S] here (S = A = {states}):"
            " give [1, S, A] for rewards of actions, or [W, S, A] with the same reward for each action"
        )
    if shape == (states,):
        return reward[None].contiguous()
    if shape == (states, actions):
        return reward[None].contiguous()
    if len(shape) >= 2 and shape[0] > 0 and shape[1:] in ((states,), (states, actions)):
        return reward.contiguous()
    raise ValueError(
        f"reward: [S], [S, A], [W, S] or [W, S, A] with S = {states}, A = {actions} is expected, not {list(shape)}"
    )


def _legal_table(legal: Tensor, next_state: Tensor) -> Tensor:
    if legal.dtype != torch.bool or legal.shape != next_state.shape:
        raise ValueError(
            f"legal: bool of shape {list(next_state.shape)} is expected,"
            f" not {str(legal.dtype).removeprefix('torch.')} of shape {list(legal.shape)}"
        )
    stuck = (~legal.any(1)).nonzero()
    if len(stuck):
        raise ValueError(f"legal[{int(stuck[0])}]: this state has no legal action; every state needs one")
    return legal.to(next_state.device)
