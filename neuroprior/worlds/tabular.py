"""Worlds that are tables: a transition table and any number of reward maps over it, all evaluated in one call."""

from collections.abc import Sequence

import torch
from torch import Tensor

from neuroprior._checks import check_range, is_integer
from neuroprior._random import generator_on
from neuroprior.worlds import compiled
from neuroprior.worlds.chance import Chance
from neuroprior.worlds.world import Rollout, World, check_plans, join_states


class TabularWorld(World):
    """A world of S cells and A actions, with W reward maps over the same transition table.

    A state is one integer, `reward_map * S + cell`: a start chooses its map, and a batch may mix maps. With one map
    (W = 1) a state is just its cell.

    Each action leads to one cell, or, where there are `probability`, to one of K cells by chance. `rollout` then lets
    all plans of a start meet the same chance (common random numbers), so that their differences are less noisy: one
    uniform number a start and step draws the same quantile of what may come of each plan's action.

    Args:
        next_state: integers `[S, A]`: the cell that each action leads to. With chance `[S, A, K]`: its K outcomes.
        reward: floating point. `[S]`: the reward of arriving in a cell. `[S, A]`: the reward of an action in a cell.
            With chance also `[S, A, K]`: the reward of an outcome. `[W, S]`, `[W, S, A]` and `[W, S, A, K]`: the same
            for W reward maps. Where a shape could mean two of these (S = A), give all dimensions, or `[1, S]`.
        legal_actions: `[S, A]` bool: which actions exist; None where all do. Every cell needs at least one. With chance every
            action must exist everywhere.
        action_names: A names, for tables and figures.
        probability: floating point `[S, A, K]`: the probability of each outcome; the K of an action sum to 1 within
            1e-6. What has probability 0 is never drawn. None: no chance.

    Attributes:
        next_state, reward: as they came, `reward` always with a dimension for the maps.
        probability: `[S, A, K]` float64, or None.
        num_layouts: number of layouts, see `layout`; 1 unless a subclass has more.

    Raises:
        ValueError: a shape, dtype or value is wrong.
    """

    num_layouts: int = 1

    def __init__(
        self,
        next_state: Tensor,
        reward: Tensor,
        legal_actions: Tensor | None = None,
        action_names: Sequence[str] | None = None,
        *,
        probability: Tensor | None = None,
    ) -> None:
        next_state = torch.as_tensor(next_state)
        _check_shapes(next_state, probability, legal_actions)
        self.num_states, self.num_actions = next_state.shape[:2]
        check_range("next_state", next_state, self.num_states, "states")
        self.chance = None if probability is None else Chance(torch.as_tensor(probability), next_state.device)
        self.stochastic = self.chance is not None
        self._set_maps(_reward_maps(torch.as_tensor(reward, device=next_state.device), next_state.shape))
        self.next_state = next_state.long().contiguous()
        self.legal_table = (
            None if legal_actions is None else _checked_legal(torch.as_tensor(legal_actions), self.next_state)
        )
        self.all_legal = self.legal_table is None
        if action_names is not None and len(action_names) != self.num_actions:
            raise ValueError(f"action_names: {self.num_actions} names are expected, not {len(action_names)}")
        self.action_names = None if action_names is None else tuple(action_names)

    def _set_maps(self, reward: Tensor) -> None:
        """Take over `reward`: `[W, S]` (on arrival), `[W, S, A]` (on acting) or `[W, S, A, K]` (of an outcome)."""
        self.reward, self.num_maps = reward, len(reward)
        size = self.num_maps * self.num_states * self.num_actions
        if self.chance is not None:
            size = max(size, self.chance.table_size, reward.numel())
        if size >= 2**31:
            raise ValueError("reward: maps x states x actions must be below 2**31; use fewer maps in one world")

    @property
    def probability(self) -> Tensor | None:
        """The probabilities of the outcomes, `[S, A, K]` float64; None where there is no chance."""
        return None if self.chance is None else self.chance.probability

    @property
    def device(self) -> torch.device:
        """Where the tables are."""
        return self.next_state.device

    def to(self, device: torch.device | str) -> "TabularWorld":
        """Move the tables to `device`; returns self."""
        self.next_state, self.reward = self.next_state.to(device), self.reward.to(device)
        if self.legal_table is not None:
            self.legal_table = self.legal_table.to(device)
        if self.chance is not None:
            self.chance.to(device)
        return self

    def state(self, cell: Tensor, reward_map: Tensor | int = 0) -> Tensor:
        """The states `[N]` of `cell [N]` under `reward_map` (an integer or `[N]`)."""
        check_range("cell", torch.as_tensor(cell), self.num_states, "cells")
        check_range("reward_map", torch.as_tensor(reward_map), self.num_maps, "reward maps")
        return torch.as_tensor(cell).long() + torch.as_tensor(reward_map, device=cell.device).long() * self.num_states

    def cell(self, state: Tensor) -> Tensor:
        """The cell of each state, between 0 and S - 1."""
        return state if self.num_maps == 1 else state % self.num_states

    def reward_map(self, state: Tensor) -> Tensor:
        """The reward map of each state, between 0 and W - 1."""
        return state.div(self.num_states, rounding_mode="floor")

    def layout(self, state: Tensor) -> Tensor:
        """The layout of each state, between 0 and `num_layouts` - 1: parts of a table that no action joins."""
        return torch.zeros_like(state)

    def group(self, state: Tensor) -> Tensor | None:
        """The world that each state is in, `reward_map * num_layouts + layout`; None where there is but one."""
        if self.num_maps * self.num_layouts == 1:
            return None
        return self.reward_map(state) * self.num_layouts + self.layout(state)

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size]`, uniform over cells and reward maps."""
        generator = generator_on(generator, self.device)
        return torch.randint(self.num_maps * self.num_states, (batch_size,), generator=generator, device=self.device)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        cell = self.cell(state)
        offset = state - cell
        taken = cell * self.num_actions + action
        outcome = taken
        if self.chance is not None:
            generator = generator_on(generator, self.device)
            uniform = torch.rand(taken.shape, generator=generator, device=self.device, dtype=torch.float32)
            outcome = self.chance.draw(taken, uniform)
        after = self.next_state.view(-1)[outcome]
        return after + offset, self.reward.view(-1)[self._reward_index(offset, taken, outcome, after)]

    def rollout(
        self, state: Tensor, plans: Tensor, generator: torch.Generator | None = None, keep_states: bool = False
    ) -> Rollout:
        """See `World.rollout`. One gather a step for the transitions and one for the rewards, on int32 tables.

        Many plans without chance go through a compiled loop, where numba is installed; it gives the same.

        With chance, `generator` gives one uniform number a start and step, however many plans there are.
        """
        self.check_state(state)
        check_plans(plans, state.shape[0], self.num_actions)
        batch, num_plans, length = plans.shape
        actions = self.num_actions
        table, flat_reward = self.next_state.int().view(-1), self.reward.view(-1)
        cell = self.cell(state)
        if self.chance is None and compiled.worth_compiling(plans, self.reward):
            return Rollout(*compiled.rollout(table, self.reward, cell, state - cell, plans, keep_states))
        offset = (state - cell).int()[:, None]
        cell = cell.int()[:, None].expand(batch, num_plans)
        rewards = self.reward.new_empty(length, batch, num_plans)
        cells = []
        uniform = self._uniform(length, batch, generator)
        for t in range(length):
            taken = torch.add(plans[:, :, t].int(), cell, alpha=actions)
            outcome = taken
            if self.chance is not None:
                same = uniform[t, :, None].expand(batch, num_plans).reshape(-1)
                outcome = self.chance.draw(taken.reshape(-1), same).view(batch, num_plans)
            cell = table.index_select(0, outcome.reshape(-1)).view(batch, num_plans)
            at = self._reward_index(offset, taken, outcome, cell)
            torch.index_select(flat_reward, 0, at.reshape(-1), out=rewards[t].view(-1))
            if keep_states:
                cells.append(cell)
        course = None
        if keep_states:
            course = join_states(cells, state, (batch, num_plans)).to(state) + (state - self.cell(state))[:, None, None]
        return Rollout((cell + offset).long(), rewards.permute(1, 2, 0), course)

    def _uniform(self, length: int, batch: int, generator: torch.Generator | None) -> Tensor:
        """What chance makes of a rollout, `[L, B]`; nothing is drawn where there is none."""
        if self.chance is None:
            return torch.empty(0)
        generator = generator_on(generator, self.device)
        return torch.rand(length, batch, generator=generator, device=self.device, dtype=torch.float32)

    def _reward_index(self, offset: Tensor, taken: Tensor, outcome: Tensor, after: Tensor) -> Tensor:
        """Where the rewards of steps to the cells `after` stand among all rewards; `offset` is the reward map * S."""
        if self.reward.dim() == 2:
            return after + offset
        if self.reward.dim() == 3:
            return taken + offset * self.num_actions
        return outcome + offset * (self.num_actions * self.next_state.shape[2])

    def mean_after(self, values: Tensor) -> Tensor:
        """The mean of `values [W, S]` over the cells that each action leads to, `[W, S, A]`, for sums over chance."""
        after = values[:, self.next_state]
        return after if self.chance is None else self._mean(after)

    def mean_reward(self) -> Tensor:
        """The mean reward of each action in each cell, `[W, S, A]`."""
        if self.reward.dim() == 2:
            return self.mean_after(self.reward)
        return self.reward if self.reward.dim() == 3 else self._mean(self.reward)

    def _mean(self, outcomes: Tensor) -> Tensor:
        """The mean `[W, S, A]` of `outcomes [W, S, A, K]`; one that cannot occur has no part in it, infinite or not."""
        assert self.chance is not None
        probability = self.chance.probability
        return (outcomes * probability).masked_fill(probability == 0, 0).sum(-1).to(outcomes.dtype)

    def observe(self, state: Tensor) -> Tensor:
        """The cell of each state: an agent sees where it is, not which reward map holds."""
        return self.cell(state)

    def legal_actions(self, state: Tensor) -> Tensor:
        if self.legal_table is None:
            return super().legal_actions(state)
        return self.legal_table[self.cell(state)]

    def terminated(self, state: Tensor) -> Tensor:
        """Where every action stays, without reward."""
        cell = self.cell(state)
        over = (self.next_state[cell].flatten(1) == cell[:, None]).all(1)
        here = over.nonzero()[:, 0]
        gains = self.reward[self.reward_map(state[here]), cell[here]]
        if gains.dim() == 3 and self.chance is not None:
            gains = gains.masked_fill(self.chance.probability[cell[here]] == 0, 0)
        over[here] = (gains == 0).unsqueeze(-1).flatten(1).all(1)
        return over

    def check_state(self, state: Tensor) -> None:
        if state.dim() != 1:
            raise ValueError(f"state: shape [B] is expected, not {list(state.shape)}")
        if state.dtype != torch.int64:
            raise ValueError(
                f"state: int64 is expected, not {str(state.dtype).removeprefix('torch.')}; use state.long()"
            )
        check_range("state", state, self.num_maps * self.num_states, "states (reward maps x cells)")


def _check_shapes(next_state: Tensor, probability: Tensor | None, legal: Tensor | None) -> None:
    """Raise ValueError unless the tables fit one another; what is in them is not looked at."""
    if probability is None:
        if next_state.dim() != 2 or 0 in next_state.shape:
            raise ValueError(
                f"next_state: shape [S, A] (or [S, A, K], with probability=) is expected, not {list(next_state.shape)}"
            )
        return
    if next_state.dim() != 3 or 0 in next_state.shape:
        raise ValueError(f"next_state: with probability, shape [S, A, K] is expected, not {list(next_state.shape)}")
    probability = torch.as_tensor(probability)
    if probability.shape != next_state.shape or not probability.is_floating_point():
        raise ValueError(
            f"probability: floating point of shape {list(next_state.shape)}, as next_state, is expected,"
            f" not {str(probability.dtype).removeprefix('torch.')} of shape {list(probability.shape)}"
        )
    if legal is not None:
        raise ValueError("legal_actions: with probability every action must exist in every cell; leave it out")


def _reward_maps(reward: Tensor, table: torch.Size) -> Tensor:
    """`reward` as `[W, S]` (on arrival), `[W, S, A]` (on acting) or `[W, S, A, K]` (of an outcome)."""
    if is_integer(reward) or reward.dtype == torch.bool:
        reward = reward.float()
    if not reward.is_floating_point():
        raise ValueError(f"reward: real numbers are expected, not {str(reward.dtype).removeprefix('torch.')}")
    if reward.isnan().any():
        raise ValueError(f"reward{reward.isnan().nonzero()[0].tolist()}: NaN is not a reward")
    shape = tuple(reward.shape)
    letters = "SAK"[: len(table)]
    kinds = {letters[:n]: tuple(table[:n]) for n in range(1, len(table) + 1)}
    of_one = [kind for kind, size in kinds.items() if shape == size]
    of_many = [kind for kind, size in kinds.items() if len(shape) > 1 and shape[0] > 0 and shape[1:] == size]
    if of_one and of_many and max(shape) > 1:
        one, many = ", ".join(of_one[0]), ", ".join(of_many[0])
        raise ValueError(
            f"reward: shape {list(shape)} may mean [{one}] or [W, {many}] here ({' = '.join(of_one[0])} = {shape[0]}):"
            f" give [1, {one}], or [W, {one}] with the same rewards repeated where [W, {many}] is meant"
        )
    if of_one:
        return reward[None].contiguous()
    if of_many:
        return reward.contiguous()
    names = [f"[{', '.join(kind)}]" for kind in kinds] + [f"[W, {', '.join(kind)}]" for kind in kinds]
    sizes = ", ".join(f"{letter} = {size}" for letter, size in zip(letters, table, strict=True))
    raise ValueError(f"reward: {', '.join(names[:-1])} or {names[-1]} with {sizes} is expected, not {list(shape)}")


def _checked_legal(legal: Tensor, next_state: Tensor) -> Tensor:
    if legal.dtype != torch.bool or legal.shape != next_state.shape:
        raise ValueError(
            f"legal_actions: bool of shape {list(next_state.shape)} is expected,"
            f" not {str(legal.dtype).removeprefix('torch.')} of shape {list(legal.shape)}"
        )
    stuck = (~legal.any(1)).nonzero()
    if len(stuck):
        raise ValueError(f"legal_actions[{int(stuck[0])}]: this state has no legal action; every state needs one")
    return legal.to(next_state.device)
