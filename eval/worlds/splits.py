"""Where plans are learned from and where priors are compared in `python -m eval compare`: three worlds a seed."""

from collections.abc import Callable
from copy import copy
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from eval.worlds import minigrid as minigrid_worlds
from eval.worlds.mid_plan import UnderWay
from neuroprior import ExhaustivePlanner, TabularWorld, World, from_gymnasium
from neuroprior.worlds import EpisodicWorld, PocketCube, goal_direction, maze

MAPS = 100
"""Reward maps or layouts in each of the three worlds of a seed, where they cost nothing to make."""

LAYOUTS = (8, 2, 2)
"""The same, for layouts of MiniGrid, whose states are searched one by one."""

SCRAMBLE = 9
"""Random moves before the cube is to be solved."""


LAST, TAKEN = 7, 3
"""Actions of the plan that is under way, and how many of them were executed."""


class Worlds(NamedTuple):
    """Worlds of a seed: plans are collected in `training`, priors are compared in `held_out`.

    Temperatures are chosen in `validation`: where they have learned priors are surer of themselves than elsewhere.
    """

    training: World
    validation: World
    held_out: World


def unlike(seed: int, make: Callable[..., World], **how: Any) -> Worlds:
    """Worlds of seeds of their own."""
    return Worlds(*(make(seed=len(Worlds._fields) * seed + part, **how) for part in range(len(Worlds._fields))))


def layouts(seed: int, make: Callable[..., World], **how: Any) -> Worlds:
    """Grids with new walls and new rewards."""
    return unlike(seed, make, num_layouts=MAPS, reward_power=8.0, view=2, **how)


def split(seed: int, name: str) -> Worlds:
    """One environment, started in any state that can be reached: a random half to learn from, a quarter held out."""
    world = from_gymnasium(name, starts="any")
    assert isinstance(world, EpisodicWorld)
    where = world.starts.nonzero()[:, 0]
    where = where[torch.randperm(len(where), generator=torch.Generator().manual_seed(seed))]
    parts = [copy(world) for _ in Worlds._fields]
    for part, kept in zip(parts, where.tensor_split([len(where) // 2, 3 * len(where) // 4]), strict=True):
        part.starts = torch.zeros_like(world.starts).index_fill(0, kept, 1 / len(kept))
    return Worlds(*parts)


def lake(seed: int, slippery: bool) -> Worlds:
    """Frozen lakes with holes of their own."""
    from gymnasium.envs.toy_text.frozen_lake import generate_random_map

    def make(seed: int) -> World:
        holes = generate_random_map(size=8, seed=seed)
        return from_gymnasium("FrozenLake-v1", desc=holes, is_slippery=slippery, starts="any")

    return unlike(seed, make)


class _Scrambles(PocketCube):
    """The cube with some quarters of its scrambled states, told by their number: those of one are never in another."""

    def __init__(self, *quarters: int) -> None:
        super().__init__("half", SCRAMBLE, absorbing=True)
        self.quarters = torch.tensor(quarters)

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        own = torch.zeros(0, dtype=torch.long)
        while len(own) < batch_size:
            state = super().reset(4 * batch_size + 100, generator)
            own = torch.cat([own, state[torch.isin((state * 2_654_435_761 >> 8) % 4, self.quarters)]])
        return own[:batch_size]


def scrambles(seed: int) -> Worlds:
    """Cubes, the same for all seeds."""
    return Worlds(_Scrambles(0, 1), _Scrambles(2), _Scrambles(3))


def minigrid(seed: int, environment: str) -> Worlds:
    """Layouts of MiniGrid, each seed with its own; plans may start anywhere."""
    bounds = pairwise(accumulate(LAYOUTS, initial=seed * sum(LAYOUTS)))
    return Worlds(*(minigrid_worlds.layouts(environment, range(first, last)) for first, last in bounds))


def _guided(seed: int) -> World:
    """Mazes with goals, whose direction is seen beside the squares around: how far it is, and on which side."""
    world = maze(reward="goal", egocentric=True, num_layouts=MAPS, view=2, seed=seed)
    around, direction = world.observe, goal_direction(world)

    def seen(state: Tensor) -> Tensor:
        away = direction(state)
        return torch.cat([around(state), away / world.width, away.sign()], -1)

    world.observe = seen  # type: ignore[method-assign]
    return world


def goal_mazes(seed: int) -> Worlds:
    """Mazes with goals."""
    return unlike(seed, _guided)


def under_way(seed: int) -> Worlds:
    """The egocentric mazes after the first moves of the best of all plans of seven."""

    def middle(world: World) -> UnderWay:
        assert isinstance(world, TabularWorld)
        return UnderWay(world, ExhaustivePlanner(LAST), TAKEN)

    return Worlds(*map(middle, layouts(seed, maze, egocentric=True)))
