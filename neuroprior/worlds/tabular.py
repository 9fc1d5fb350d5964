"""Worlds that are tables: a transition table and any number of reward maps over it, all evaluated in one call."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_range, is_integer
from neuroprior._memory import new_empty
from neuroprior._random import generator_on
from neuroprior.worlds.observations import Categories
from neuroprior.worlds.outcomes import Outcomes
from neuroprior.worlds.world import Rollout, World, check_action, check_plans, join_states


class TabularWorld(World):
    """A world of S cells and A actions, with W reward maps over the same transition table.

    A state is one integer, `reward_map * S + cell`: a start chooses its map, and a batch may mix maps. With one map
    (W = 1) a state is just its cell.

    Each action leads to one cell, or, with `probability`, to one of K random outcomes. `rollout` then uses common
    random numbers for all plans of a start, which makes their differences less noisy: one uniform number for each start
    and step draws the same quantile of the outcomes of each plan's action.

    Its objective is "terminal", as in both simulations of the paper; `world.objective = "return"` changes it.

    Args:
        next_state: integers `[S, A]`: the cell that each action leads to. With `probability`, `[S, A, K]`: K outcomes.
        reward: floating point. `[S]`: the reward of arriving in a cell. `[S, A]`: the reward of an action in a cell.
            With `probability` also `[S, A, K]`: the reward of an outcome. `[W, S]`, `[W, S, A]` and `[W, S, A, K]`: the
            same for W reward maps. Where a shape could mean two of these (S = A), give all dimensions, or `[1, S]`.
        legal_actions: `[S, A]` bool: which actions are legal; None: all. Every cell needs at least one. With
            `probability` every action must be legal everywhere.
        action_names: A names, for tables and figures.
        probability: floating point `[S, A, K]`: the probability of each outcome; the K of an action sum to 1 within
            1e-6. Outcomes of probability 0 are never drawn. None: the world is deterministic.

    Attributes:
        next_state, reward: copies of what was given, `reward` always with a dimension for the maps.
        legal_table: `[S, A]` bool, or None where all actions are legal.
        outcomes: draws the outcomes; None for a deterministic world.
        compile_from: rollouts of at least so many steps go through a compiled loop, which gives the same: loading it is
            worth it only for many.
        num_layouts: number of layouts, see `layout`; 1 unless a subclass has more.

    Raises:
        ValueError: a shape, dtype or value is wrong.

    Example:
        >>> world = TabularWorld(next_state=torch.tensor([[0, 1], [0, 1]]), reward=torch.tensor([0.0, 1.0]))
        >>> state, reward = world.step(torch.tensor([0, 0]), torch.tensor([0, 1]))
        >>> state.tolist(), reward.tolist()
        ([0, 1], [0.0, 1.0])
    """

    objective: Literal["terminal", "return"] = "terminal"
    num_layouts: int = 1
    compile_from: int = 2**20

    shares_steps = True

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
        self.outcomes = None if probability is None else Outcomes(torch.as_tensor(probability), next_state.device)
        self.stochastic = self.outcomes is not None
        self._set_maps(_reward_maps(torch.as_tensor(reward, device=next_state.device), next_state.shape).clone())
        self.next_state = next_state.to(torch.long, copy=True).contiguous()
        self.legal_table = (
            None if legal_actions is None else _checked_legal(torch.as_tensor(legal_actions), self.next_state)
        )
        self.all_legal = self.legal_table is None
        self.observation = Categories(self.num_states)
        if action_names is not None and len(action_names) != self.num_actions:
            raise ValueError(f"`action_names` must have {self.num_actions} names, got {len(action_names)}")
        self.action_names = None if action_names is None else tuple(action_names)

    def _set_maps(self, reward: Tensor) -> None:
        """Take over `reward`: `[W, S]` (on arrival), `[W, S, A]` (on acting) or `[W, S, A, K]` (of an outcome)."""
        self.reward, self.num_maps = reward, len(reward)
        size = self.num_maps * self.num_states * self.num_actions
        if self.outcomes is not None:
            size = max(size, self.outcomes.table_size, reward.numel())
        if size >= 2**31:
            raise ValueError("reward: maps x states x actions must be below 2**31; use fewer maps in one world")

    @property
    def probability(self) -> Tensor | None:
        """The probabilities of the outcomes, `[S, A, K]` float64; None for a deterministic world."""
        return None if self.outcomes is None else self.outcomes.probability

    @property
    def device(self) -> torch.device:
        """Where the tables are."""
        return self.next_state.device

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
        """The layout of each state, between 0 and `num_layouts` - 1: parts of a table that no action connects."""
        return torch.zeros_like(state)

    def group(self, state: Tensor) -> Tensor | None:
        """The world that each state is in, `reward_map * num_layouts + layout`; None where there is only one."""
        if self.num_maps * self.num_layouts == 1:
            return None
        return self.reward_map(state) * self.num_layouts + self.layout(state)

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size]`, uniform over cells and reward maps."""
        check_count("batch_size", batch_size)
        generator = generator_on(generator, self.device)
        return torch.randint(self.num_maps * self.num_states, (batch_size,), generator=generator, device=self.device)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        if state.device.type == "cpu":
            self.check_state(state)
        action = check_action(action, len(state), self.num_actions)
        cell = self.cell(state)
        offset = state - cell
        taken = cell * self.num_actions + action
        outcome = taken
        if self.outcomes is not None:
            generator = generator_on(generator, self.device)
            uniform = torch.rand(taken.shape, generator=generator, device=self.device, dtype=torch.float32)
            outcome = self.outcomes.draw(taken, uniform)
        after = self.next_state.view(-1)[outcome]
        return after + offset, self.reward.view(-1)[self._reward_index(offset, taken, outcome, after)]

    def rollout(
        self, state: Tensor, plans: Tensor, generator: torch.Generator | None = None, keep_states: bool = False
    ) -> Rollout:
        """See `World.rollout`. In a stochastic world `generator` draws one uniform number for each start and step.

        Each step is one gather for the transitions and one for the rewards, on int32 tables. Many steps in a
        deterministic world go through a compiled loop (see `compile_from`), which gives the same.
        """
        self.check_state(state)
        check_plans(plans, state.shape[0], self.num_actions)
        batch, num_plans, length = plans.shape
        actions = self.num_actions
        table, flat_reward = self.next_state.int().view(-1), self.reward.view(-1)
        cell = self.cell(state)
        if self._is_compiled(plans):
            from neuroprior.worlds import compiled

            return Rollout(*compiled.rollout(table, self.reward, cell, state - cell, plans, keep_states))
        offset = (state - cell).int()[:, None]
        cell = cell.int()[:, None].expand(batch, num_plans)
        rewards = new_empty((length, batch, num_plans), self.reward)
        cells = []
        uniform = self._uniform(length, batch, generator)
        for t in range(length):
            taken = torch.add(plans[:, :, t].int(), cell, alpha=actions)
            outcome = taken
            if self.outcomes is not None:
                same = uniform[t, :, None].expand(batch, num_plans).reshape(-1)
                outcome = self.outcomes.draw(taken.reshape(-1), same).view(batch, num_plans)
            cell = table.index_select(0, outcome.reshape(-1)).view(batch, num_plans)
            at = self._reward_index(offset, taken, outcome, cell)
            torch.index_select(flat_reward, 0, at.reshape(-1), out=rewards[t].view(-1))
            if keep_states:
                cells.append(cell)
        states = None
        if keep_states:
            states = join_states(cells, state, (batch, num_plans)).to(state) + (state - self.cell(state))[:, None, None]
        return Rollout((cell + offset).long(), rewards.permute(1, 2, 0), states)

    def _uniform(self, length: int, batch: int, generator: torch.Generator | None) -> Tensor:
        """What the outcomes of a rollout are drawn by, `[L, B]`; empty in a deterministic world."""
        if self.outcomes is None:
            return torch.empty(0)
        generator = generator_on(generator, self.device)
        return torch.rand(length, batch, generator=generator, device=self.device, dtype=torch.float32)

    def _is_compiled(self, plans: Tensor) -> bool:
        """Returns whether the compiled loop can roll out `plans [B, P, L]`, and these are many."""
        able = self.outcomes is None and self.reward.dtype in (torch.float32, torch.float64)
        return able and plans.device.type == "cpu" and plans.numel() >= self.compile_from

    def _reward_index(self, offset: Tensor, taken: Tensor, outcome: Tensor, after: Tensor) -> Tensor:
        """The indices of the rewards of steps to the cells `after`; `offset` is the reward map * S."""
        if self.reward.dim() == 2:
            return after + offset
        if self.reward.dim() == 3:
            return taken + offset * self.num_actions
        return outcome + offset * (self.num_actions * self.next_state.shape[2])

    def mean_after(self, values: Tensor) -> Tensor:
        """The mean of `values [W, S]` over the cells that each action leads to: `[W, S, A]`."""
        after = values[:, self.next_state]
        return after if self.outcomes is None else self._mean(after)

    def mean_reward(self) -> Tensor:
        """The mean reward of each action in each cell, `[W, S, A]`."""
        if self.reward.dim() == 2:
            return self.mean_after(self.reward)
        return self.reward if self.reward.dim() == 3 else self._mean(self.reward)

    def _mean(self, values: Tensor) -> Tensor:
        """The mean `[W, S, A]` of `values [W, S, A, K]` over outcomes; impossible ones do not count, even infinite."""
        assert self.outcomes is not None
        probability = self.outcomes.probability
        return (values * probability).masked_fill(probability == 0, 0).sum(-1).to(values.dtype)

    def observe(self, state: Tensor) -> Tensor:
        """The cell of each state; the reward map is not observed."""
        return self.cell(state)

    def legal_actions(self, state: Tensor) -> Tensor:
        if self.legal_table is None:
            return super().legal_actions(state)
        return self.legal_table[self.cell(state)]

    def terminated(self, state: Tensor) -> Tensor:
        """Where every action stays in the cell, without reward."""
        cell = self.cell(state)
        ended = (self.next_state[cell].flatten(1) == cell[:, None]).all(1)
        rows = ended.nonzero()[:, 0]
        gains = self.reward[self.reward_map(state[rows]), cell[rows]]
        if gains.dim() == 3 and self.outcomes is not None:
            gains = gains.masked_fill(self.outcomes.probability[cell[rows]] == 0, 0)
        ended[rows] = (gains == 0).unsqueeze(-1).flatten(1).all(1)
        return ended

    def check_state(self, state: Tensor) -> None:
        super().check_state(state)
        if state.dim() != 1:
            raise ValueError(f"`state` must have shape [B], got {list(state.shape)}")
        if state.dtype != torch.int64:
            raise ValueError(f"`state` must be int64, got {str(state.dtype).removeprefix('torch.')}; use state.long()")
        check_range("state", state, self.num_maps * self.num_states, "states (reward maps x cells)")


def _check_shapes(next_state: Tensor, probability: Tensor | None, legal: Tensor | None) -> None:
    """Raise ValueError unless the shapes of the tables fit one another."""
    if probability is None:
        if next_state.dim() != 2 or 0 in next_state.shape:
            raise ValueError(
                f"`next_state` must have shape [S, A] (or [S, A, K], with probability=), got {list(next_state.shape)}"
            )
        return
    if next_state.dim() != 3 or 0 in next_state.shape:
        raise ValueError(f"`next_state` must be with probability: shape [S, A, K], got {list(next_state.shape)}")
    probability = torch.as_tensor(probability)
    if probability.shape != next_state.shape or not probability.is_floating_point():
        raise ValueError(
            f"`probability` must be floating point of shape {list(next_state.shape)}, as next_state,"
            f" got {str(probability.dtype).removeprefix('torch.')} of shape {list(probability.shape)}"
        )
    if legal is not None:
        raise ValueError("legal_actions: with probability every action must be legal in every cell; leave it out")


def _reward_maps(reward: Tensor, table: torch.Size) -> Tensor:
    """`reward` as `[W, S]` (on arrival), `[W, S, A]` (on acting) or `[W, S, A, K]` (of an outcome)."""
    if is_integer(reward) or reward.dtype == torch.bool:
        reward = reward.float()
    if not reward.is_floating_point():
        raise ValueError(f"`reward` must be real numbers, got {str(reward.dtype).removeprefix('torch.')}")
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
    raise ValueError(f"`reward` must be {', '.join(names[:-1])} or {names[-1]} with {sizes}, got {list(shape)}")


def _checked_legal(legal: Tensor, next_state: Tensor) -> Tensor:
    if legal.dtype != torch.bool or legal.shape != next_state.shape:
        raise ValueError(
            f"`legal_actions` must be bool of shape {list(next_state.shape)},"
            f" got {str(legal.dtype).removeprefix('torch.')} of shape {list(legal.shape)}"
        )
    stuck = (~legal.any(1)).nonzero()
    if len(stuck):
        raise ValueError(f"legal_actions[{int(stuck[0])}]: this state has no legal action; every state needs one")
    return legal.to(next_state.device, copy=True)


def check_tabular(world: object) -> None:
    """Raise ValueError unless a world is a table, which exact solutions need."""
    if not isinstance(world, TabularWorld):
        raise ValueError(f"`world` must be a TabularWorld, got {type(world).__name__}")
