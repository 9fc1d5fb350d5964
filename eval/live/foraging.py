"""Foraging: food is eaten where the agent arrives, and regrows elsewhere, in patches that change with the season."""

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_range, check_sizes
from neuroprior._random import generator_on
from neuroprior.worlds.grid import GridWorld
from neuroprior.worlds.tabular import TabularWorld
from neuroprior.worlds.world import World


class ForagingWorld(World):
    """Items of food in a table: arriving at items eats them, each for a reward of 1.

    A state is int64 `[N, 2 + K]`: the cell, the time (steps since `reset`), and the places of the K items; eaten items
    are at place `num_places`, which is nowhere. The state is Markov, so that every planner can plan here.

    Planners know where food is, but not where it will regrow: in the steps that they try, eaten food is gone. It comes
    back by `regrow`, which `execute` and `Agent` apply after each executed step (their argument `change`): eaten items
    regrow at random places of the season, and at the beginning of a new season all items move to new places.

    Args:
        table: the table in which the agent moves, of one layout; its rewards are not used.
        growth: floating point `[E, places]`: the unnormalised probabilities of the places at which food grows, in each
            of E seasons, which follow one another cyclically.
        period: steps in a season.
        num_items: K.

    Attributes:
        num_places: number of places for food: the squares of a grid (`GridWorld.square`), the cells of another table.
        table, growth, period, num_items: as given.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> table = gridworld(5, 5, seed=0)
        >>> world = ForagingWorld(
        ...     table, patches(table, num_seasons=2, radius=1, generator=torch.Generator().manual_seed(0)), period=20
        ... )
        >>> world.reset(3, torch.Generator().manual_seed(0)).shape[0]
        3
    """

    def __init__(self, table: TabularWorld, growth: Tensor, period: int, num_items: int = 4) -> None:
        check_sizes(period=period, num_items=num_items)
        if not isinstance(table, TabularWorld):
            raise ValueError(f"`table` must be a TabularWorld, got {type(table).__name__}")
        if table.num_layouts > 1:
            raise ValueError(f"`table` must have one layout, got {table.num_layouts}")
        self.place = places(table)
        self.num_places = int(self.place.max()) + 1
        growth = torch.as_tensor(growth, device=table.device)
        if growth.dim() != 2 or growth.shape[1] != self.num_places or not growth.is_floating_point() or not len(growth):
            raise ValueError(
                f"`growth` must be floating point of shape [E, {self.num_places}],"
                f" got {str(growth.dtype).removeprefix('torch.')} of shape {list(growth.shape)}"
            )
        if not growth.isfinite().all() or (growth < 0).any() or (growth.sum(1) <= 0).any():
            raise ValueError("`growth` must be finite numbers of at least 0, in each season one above it")
        self.table, self.growth, self.period, self.num_items = table, growth, period, num_items
        self.num_actions, self.action_names = table.num_actions, table.action_names
        self.all_legal, self.stochastic, self.observation = table.all_legal, table.stochastic, table.observation

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """States `[batch_size, 2 + K]` at time 0: random cells, with food at random places of the first season."""
        check_count("batch_size", batch_size, 8 * (2 + self.num_items))
        generator = generator_on(generator, self.table.device)
        cell = self.table.cell(self.table.reset(batch_size, generator))
        nowhere = cell.new_full((batch_size, self.num_items), self.num_places)
        return self.regrow(torch.cat([torch.stack([cell, torch.zeros_like(cell)], 1), nowhere], 1), generator)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        cell, _ = self.table.step(state[:, 0], action, generator)
        items = state[:, 2:]
        eaten = items == self.place[cell][:, None]
        left = items.masked_fill(eaten, self.num_places)
        return torch.cat([cell[:, None], state[:, 1:2] + 1, left], 1), eaten.sum(1).float()

    def regrow(self, state: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """`state [N, 2 + K]` after food has regrown; planners do not foresee this."""
        generator = generator_on(generator, self.table.device)
        time, items = state[:, 1], state[:, 2:]
        season = self.season(state)
        up_to = self.growth.double().cumsum(1)
        height = torch.rand(items.shape, generator=generator, device=state.device, dtype=torch.float64)
        # Places of probability 0 are never drawn: `right` finds the next place of a probability above 0.
        place = torch.searchsorted(up_to[season], height * up_to[season, -1:], right=True)
        new = (items == self.num_places) | (time % self.period == 0)[:, None]
        return torch.cat([state[:, :2], torch.where(new, place.clamp(max=self.num_places - 1), items)], 1)

    def season(self, state: Tensor) -> Tensor:
        """The season, from 0, in each of `state [N, 2 + K]`: `[N]`."""
        return state[:, 1].div(self.period, rounding_mode="floor") % len(self.growth)

    def observe(self, state: Tensor) -> Tensor:
        """The table's observation of the cell; food is not observed."""
        return self.table.observe(state[:, 0])

    def legal_actions(self, state: Tensor) -> Tensor:
        return self.table.legal_actions(state[:, 0])

    def check_state(self, state: Tensor) -> None:
        super().check_state(state)
        if state.dim() != 2 or state.shape[1] != 2 + self.num_items:
            raise ValueError(f"`state` must have shape [B, {2 + self.num_items}], got {list(state.shape)}")
        if state.dtype != torch.int64:
            raise ValueError(f"`state` must be int64, got {str(state.dtype).removeprefix('torch.')}")
        check_range("state[:, 0]", state[:, 0], self.table.num_states, "cells")
        check_range("state[:, 2:]", state[:, 2:], self.num_places + 1, "places, nowhere among them")
        if (state[:, 1] < 0).any():
            raise ValueError("`state[:, 1]` must be a time of at least 0")


def places(table: TabularWorld) -> Tensor:
    """The place of each cell of a table, `[S]`: its square in a grid, else the cell itself."""
    cell = torch.arange(table.num_states, device=table.device)
    return table.square(cell) if isinstance(table, GridWorld) else cell


def patches(table: TabularWorld, num_seasons: int, radius: int, generator: torch.Generator | None = None) -> Tensor:
    """Growth for `ForagingWorld`: in each season food grows in one patch around a random cell.

    Args:
        table: a deterministic table.
        num_seasons: E.
        radius: a patch is all places that can be reached from its centre with so many actions.
        generator: draws the centres, as `table.reset` draws starts.

    Returns:
        `[E, places]` float32: 1 in the patch, 0 elsewhere.

    Raises:
        ValueError: an argument is out of range, or the table is stochastic.

    Example:
        >>> patches(gridworld(5, 5, seed=0), num_seasons=2, radius=1, generator=torch.Generator().manual_seed(0)).shape
        torch.Size([2, 25])
    """
    check_sizes(num_seasons=num_seasons, radius=radius)
    if table.stochastic:
        raise ValueError("`table` must be a deterministic one")
    generator = generator_on(generator, table.device)
    reached = torch.zeros(num_seasons, table.num_states, device=table.device)
    reached.scatter_(1, table.cell(table.reset(num_seasons, generator))[:, None], 1.0)
    for _ in range(radius):
        further = reached[:, :, None].expand(-1, -1, table.num_actions).flatten(1)
        if table.legal_table is not None:
            further = further * table.legal_table.flatten()
        to = table.next_state.flatten().expand_as(further)
        reached = reached.scatter_reduce(1, to, further, "amax")
    place = places(table)
    growth = torch.zeros(num_seasons, int(place.max()) + 1, device=table.device)
    return growth.scatter_reduce(1, place.expand_as(reached), reached, "amax")
