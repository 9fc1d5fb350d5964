"""How the three worlds of a seed are made in `python -m eval compare`: for training, validation and comparison."""

from collections.abc import Callable
from copy import copy
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from eval.worlds import minigrid
from eval.worlds.mid_plan import MidPlanWorld
from neuroprior.planners import ExhaustivePlanner
from neuroprior.worlds import (
    EpisodicWorld,
    Features,
    PocketCube,
    TabularWorld,
    World,
    from_gymnasium,
    goal_direction,
    maze,
)

MAPS = 100
"""Reward maps or layouts in each of the three worlds of a seed, where they cost nothing to make."""

LAYOUTS = (8, 2, 2)
"""The same for layouts of MiniGrid, whose states are enumerated one by one."""

SCRAMBLE = 9
"""Random moves before the cube is to be solved."""

LAST, TAKEN = 7, 3
"""Mid-plan: the actions of the earlier plan, and how many of them were executed."""


class Worlds(NamedTuple):
    """The worlds of a seed.

    Plans are collected in `training`, and priors are compared in `held_out`. Sampling temperatures are chosen in
    `validation`, since priors are more certain in the world that they learned in.
    """

    training: World
    validation: World
    held_out: World


def from_seeds(seed: int, make: Callable[..., World], **how: Any) -> Worlds:
    """Three worlds made by `make(seed=..., **how)`, each with a seed of its own."""
    return Worlds(*(make(seed=len(Worlds._fields) * seed + number, **how) for number in range(len(Worlds._fields))))


def grid_layouts(seed: int, make: Callable[..., World], **how: Any) -> Worlds:
    """Grids with new walls and new rewards."""
    return from_seeds(seed, make, num_layouts=MAPS, reward_power=8.0, view=2, **how)


def split_starts(seed: int, name: str) -> Worlds:
    """One Gymnasium environment whose reachable states are split: half for training, a quarter each for the others."""
    world = from_gymnasium(name, starts="any")
    assert isinstance(world, EpisodicWorld)
    where = world.starts.nonzero()[:, 0]
    where = where[torch.randperm(len(where), generator=torch.Generator().manual_seed(seed))]
    parts = [copy(world) for _ in Worlds._fields]
    for split, kept in zip(parts, where.tensor_split([len(where) // 2, 3 * len(where) // 4]), strict=True):
        split.starts = torch.zeros_like(world.starts).index_fill(0, kept, 1 / len(kept))
    return Worlds(*parts)


def frozen_lakes(seed: int, slippery: bool) -> Worlds:
    """Frozen lakes, each with holes of its own."""
    from gymnasium.envs.toy_text.frozen_lake import generate_random_map

    def make(seed: int) -> World:
        holes = generate_random_map(size=8, seed=seed)
        return from_gymnasium("FrozenLake-v1", desc=holes, is_slippery=slippery, starts="any")

    return from_seeds(seed, make)


class _Scrambles(PocketCube):
    """The cube, started in some quarters of its scrambled states, which a hash assigns to the quarters."""

    def __init__(self, *quarters: int) -> None:
        super().__init__("half", SCRAMBLE, absorbing=True)
        self.quarters = torch.tensor(quarters)

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        states = torch.zeros(0, dtype=torch.long)
        while len(states) < batch_size:
            state = super().reset(4 * batch_size + 100, generator)
            states = torch.cat([states, state[torch.isin((state * 2_654_435_761 >> 8) % 4, self.quarters)]])
        return states[:batch_size]


def scrambled_cubes(seed: int) -> Worlds:
    """Cubes, the same for all seeds; no start of one is a start of another."""
    return Worlds(_Scrambles(0, 1), _Scrambles(2), _Scrambles(3))


def minigrid_layouts(seed: int, environment: str) -> Worlds:
    """Layouts of MiniGrid, each seed with its own; plans may start anywhere."""
    bounds = pairwise(accumulate(LAYOUTS, initial=seed * sum(LAYOUTS)))
    return Worlds(*(minigrid.layouts(environment, range(first, last)) for first, last in bounds))


def goal_mazes(seed: int) -> Worlds:
    """Mazes with goals; the squares around the agent and the distance and side of the goal are observed."""

    def make(seed: int) -> World:
        world = maze(reward="goal", egocentric=True, num_layouts=MAPS, view=2, seed=seed)
        around, direction = world.observe, goal_direction(world)

        def observe(state: Tensor) -> Tensor:
            away = direction(state)
            return torch.cat([around(state), away / world.width, away.sign()], -1)

        world.observe = observe  # type: ignore[method-assign]
        world.observation = Features(observe(torch.zeros(1, dtype=torch.long)).shape[1])
        return world

    return from_seeds(seed, make)


def mid_plan(seed: int) -> Worlds:
    """The egocentric mazes after the first moves of the best of all plans of `LAST` moves."""

    def replanned(world: World) -> MidPlanWorld:
        assert isinstance(world, TabularWorld)
        return MidPlanWorld(world, ExhaustivePlanner(LAST), TAKEN)

    return Worlds(*map(replanned, grid_layouts(seed, maze, egocentric=True)))
