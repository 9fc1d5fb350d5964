"""Where plans are learned from and where priors are compared in `python -m eval compare`: two worlds for each seed."""

from collections.abc import Callable
from copy import copy
from typing import Any, NamedTuple

import torch
from torch import Tensor

from eval import minigrid_worlds
from eval.under_way import UnderWay
from neuroprior import ExhaustivePlanner, PocketCube, TabularWorld, World, from_gymnasium, maze
from neuroprior.worlds import EpisodicWorld, goal_direction

MAPS = 100
"""Reward maps or layouts to learn in, and as many to be compared in, of each seed, where they cost nothing to make."""

LAYOUTS = (6, 2)
"""The same, for layouts of MiniGrid, whose states are searched one by one: to learn in, and to be compared in."""

SCRAMBLE = 9
"""Random moves before the cube is to be solved."""


LAST, TAKEN = 7, 3
"""Actions of the plan that is under way, and how many of them were executed."""


class Pair(NamedTuple):
    """Worlds of a seed: plans are collected in `training`, priors are compared in `held_out`."""

    training: World
    held_out: World


def both(seed: int, make: Callable[..., World], **how: Any) -> Pair:
    """Worlds of unlike seeds, even ones to learn in."""
    return Pair(make(seed=2 * seed, **how), make(seed=2 * seed + 1, **how))


def layouts(seed: int, make: Callable[..., World], **how: Any) -> Pair:
    """Grids with new walls and new rewards."""
    return both(seed, make, num_layouts=MAPS, reward_power=8.0, view=2, **how)


def split(seed: int, name: str) -> Pair:
    """One environment, started in any state that can be reached: a random half to learn from, the other held out."""
    world = from_gymnasium(name, starts="any")
    assert isinstance(world, EpisodicWorld)
    where = world.starts.nonzero()[:, 0]
    where = where[torch.randperm(len(where), generator=torch.Generator().manual_seed(seed))]
    halves = [copy(world), copy(world)]
    for half, kept in zip(halves, where.tensor_split([len(where) // 2]), strict=True):
        half.starts = torch.zeros_like(world.starts).index_fill(0, kept, 1 / len(kept))
    return Pair(*halves)


def lake(seed: int, slippery: bool) -> Pair:
    """Frozen lakes, each seed with holes of its own."""
    from gymnasium.envs.toy_text.frozen_lake import generate_random_map

    maps = [generate_random_map(size=8, seed=2 * seed + half) for half in (0, 1)]
    lakes = [from_gymnasium("FrozenLake-v1", desc=one, is_slippery=slippery, starts="any") for one in maps]
    return Pair(*lakes)


class _Scrambles(PocketCube):
    """The cube with half of its scrambled states, told by their number: those of one half are never in the other."""

    def __init__(self, half: int) -> None:
        super().__init__("half", SCRAMBLE, absorbing=True)
        self.half = half

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        own = torch.zeros(0, dtype=torch.long)
        while len(own) < batch_size:
            state = super().reset(2 * batch_size + 100, generator)
            own = torch.cat([own, state[(state * 2_654_435_761 >> 8) % 2 == self.half]])
        return own[:batch_size]


def scrambles(seed: int) -> Pair:
    """Cubes, the same for all seeds."""
    return Pair(_Scrambles(0), _Scrambles(1))


def minigrid(seed: int, environment: str) -> Pair:
    """Layouts of MiniGrid, each seed with its own; plans may start anywhere."""
    learned, others = LAYOUTS
    first = seed * (learned + others)
    here = range(first, first + learned), range(first + learned, first + learned + others)
    return Pair(*(minigrid_worlds.layouts(environment, seeds) for seeds in here))


def _guided(seed: int) -> World:
    """Mazes with goals, whose direction is seen beside the squares around: how far it is, and on which side."""
    world = maze(reward="goal", egocentric=True, num_layouts=MAPS, view=2, seed=seed)
    around, direction = world.observe, goal_direction(world)

    def seen(state: Tensor) -> Tensor:
        away = direction(state)
        return torch.cat([around(state), away / world.width, away.sign()], -1)

    world.observe = seen  # type: ignore[method-assign]
    return world


def goal_mazes(seed: int) -> Pair:
    """Mazes with goals."""
    return Pair(_guided(2 * seed), _guided(2 * seed + 1))


def under_way(seed: int) -> Pair:
    """The egocentric mazes after the first moves of the best of all plans of seven."""

    def middle(world: World) -> UnderWay:
        assert isinstance(world, TabularWorld)
        return UnderWay(world, ExhaustivePlanner(LAST), TAKEN)

    training, held_out = layouts(seed, maze, egocentric=True)
    return Pair(middle(training), middle(held_out))
