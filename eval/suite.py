"""The worlds of `python -m eval compare`: where plans are learned from, and where they are tried."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from neuroprior import PocketCube, World, four_rooms, from_gymnasium, gridworld, maze
from neuroprior.worlds import EpisodicWorld
from neuroprior.worlds.cube import FACES
from neuroprior.worlds.grid import MOVES, TURNS

MAPS = 20
"""Reward maps or layouts to learn in, and as many to be compared in, of each seed, where they cost nothing to make."""

LAYOUTS = 3
"""The same, for layouts of MiniGrid, whose states are searched one by one."""


class Pair(NamedTuple):
    """Worlds of a seed: plans are collected in `training`, priors are compared in `held_out`."""

    training: World
    held_out: World


@dataclass(frozen=True)
class Task:
    """A world of the comparison.

    Attributes:
        name: as in `TASKS`.
        action_names: of its actions, in the order of their numbers.
        about: what it is, what differs between training and held-out worlds, and what is optimised.
        worlds: makes the worlds of a seed.
        depth: of the exhaustive planner whose plans are learned from first.
        lengths: numbers of actions in the plans of the rounds of growth; the last is that of the comparison.
        objective, discount, any_prefix: what planners optimise, see `neuroprior.Planner`.
        above: plans that scored no more than this are not learned from; None: all are.
        sees: what `World.observe` of these worlds shows, for priors that see; None: nothing that would be of use.
        near: the features of it that are nearest; chains may see these alone, as they must have met what they see.
    """

    name: str
    action_names: tuple[str, ...]
    about: str
    worlds: Callable[[int], Pair]
    depth: int
    lengths: tuple[int, ...]
    objective: Literal["terminal", "return"] = "terminal"
    discount: float = 1.0
    any_prefix: bool = False
    above: float | None = None
    sees: str | None = None
    near: tuple[int, ...] | None = None

    @property
    def num_actions(self) -> int:
        """Number of actions."""
        return len(self.action_names)

    @property
    def length(self) -> int:
        """Actions in the plans that are compared."""
        return self.lengths[-1]

    @property
    def scoring(self) -> dict[str, Any]:
        """What planners optimise, as their arguments."""
        return {"objective": self.objective, "discount": self.discount, "any_prefix": self.any_prefix}


def _both(make: Callable[..., World], **how: Any) -> Callable[[int], Pair]:
    """Worlds of unlike seeds, even ones to learn in."""

    def made(seed: int) -> Pair:
        return Pair(make(seed=2 * seed, **how), make(seed=2 * seed + 1, **how))

    return made


def _layouts(make: Callable[..., World], **how: Any) -> Callable[[int], Pair]:
    """Grids with new walls and new rewards."""
    return _both(make, num_layouts=MAPS, view=2, **how)


def _split(name: str, **options: Any) -> Callable[[int], Pair]:
    """One environment, started in any state that can be reached: a random half to learn from, the other held out."""

    def made(seed: int) -> Pair:
        world = from_gymnasium(name, starts="any", **options)
        assert isinstance(world, EpisodicWorld)
        where = world.starts.nonzero()[:, 0]
        where = where[torch.randperm(len(where), generator=torch.Generator().manual_seed(seed))]
        halves = [copy(world), copy(world)]
        for half, kept in zip(halves, where.tensor_split([len(where) // 2]), strict=True):
            half.starts = torch.zeros_like(world.starts).index_fill(0, kept, 1 / len(kept))
        return Pair(*halves)

    return made


def _lake(slippery: bool) -> Callable[[int], Pair]:
    """Frozen lakes, each seed with holes of its own."""

    def made(seed: int) -> Pair:
        from gymnasium.envs.toy_text.frozen_lake import generate_random_map

        maps = [generate_random_map(size=8, seed=2 * seed + half) for half in (0, 1)]
        lakes = [from_gymnasium("FrozenLake-v1", desc=one, is_slippery=slippery, starts="any") for one in maps]
        return Pair(*lakes)

    return made


class _Scrambles(PocketCube):
    """The cube with half of its scrambled states, told by their number: those of one half are never in the other."""

    def __init__(self, half: int) -> None:
        super().__init__("half", 7, absorbing=True)
        self.half = half

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        own = torch.zeros(0, dtype=torch.long)
        while len(own) < batch_size:
            state = super().reset(2 * batch_size + 100, generator)
            own = torch.cat([own, state[(state * 2_654_435_761 >> 8) % 2 == self.half]])
        return own[:batch_size]


# Later is worth less, so that the best plans go straight there.
_goal: dict[str, Any] = {"objective": "return", "discount": 0.95, "above": 0.0}
_neighbours = "which of the 24 squares around it are free"
_nearest = (6, 7, 8, 11, 12, 15, 16, 17)
_grid_about = "the reward where a plan ends; new walls and rewards held out"


def _minigrid(name: str, about: str, environment: str) -> Task:
    """MiniGrid: each seed with layouts of its own, some to learn in and some held out; starts are all that can be."""

    def made(seed: int) -> Pair:
        first = 2 * LAYOUTS * seed
        seeds = (range(first, first + LAYOUTS), range(first + LAYOUTS, first + 2 * LAYOUTS))
        how: dict[str, Any] = {"starts": "any", "observations": True, "progress": False}
        return Pair(*(from_gymnasium(environment, seeds=some, **how) for some in seeds))

    moves = ("left", "right", "forward", "pickup", "drop", "toggle", "done")
    about = f"MiniGrid {about}; reaching it; new layouts held out"
    return Task(name, moves, about, made, 5, (8, 12, 16), sees="the seven by seven squares before it", **_goal)


_tasks = (
    Task(
        "grid",
        MOVES,
        "the paper's grid: 20 x 20, a torus, independent rewards; the reward where a plan ends; new rewards held out",
        _both(partial(gridworld, 20, 20, edges="torus"), num_worlds=MAPS),
        4,
        (6, 8),
    ),
    Task(
        "four_rooms",
        MOVES,
        f"four rooms, 13 x 13, doors at random places, four moves; {_grid_about}",
        _layouts(partial(four_rooms, reward_power=8.0)),
        5,
        (8, 12, 16),
        sees=_neighbours,
        near=_nearest,
    ),
    Task(
        "maze",
        MOVES,
        f"mazes with some loops, 15 x 15, four moves; {_grid_about}",
        _layouts(partial(maze, reward_power=8.0)),
        5,
        (8, 12, 16),
        sees=_neighbours,
        near=_nearest,
    ),
    Task(
        "egocentric",
        TURNS,
        f"the same mazes for an agent that turns left, turns right or goes forward; {_grid_about}",
        _layouts(partial(maze, reward_power=8.0, egocentric=True)),
        7,
        (10, 13, 16),
        sees=_neighbours + ", as it is turned",
        near=_nearest,
    ),
    Task(
        "taxi",
        ("south", "north", "east", "west", "pickup", "dropoff"),
        "Taxi: fetch a passenger and bring it; the sum of rewards; half of all states to start from held out",
        _split("Taxi-v4"),
        5,
        (8, 12, 16),
        "return",
        sees="the whole state",
    ),
    Task(
        "cliff",
        MOVES,
        "CliffWalking: go around a cliff; the sum of rewards; half of all squares to start from held out",
        _split("CliffWalking-v1"),
        5,
        (8, 12, 16),
        "return",
        sees="the square",
    ),
    Task(
        "frozen_lake",
        ("left", "down", "right", "up"),
        "FrozenLake, 8 x 8, not slippery: to the goal, between holes; reaching it; new lakes held out",
        _lake(slippery=False),
        5,
        (8, 11, 14),
        **_goal,
    ),
    Task(
        "slippery",
        ("left", "down", "right", "up"),
        "FrozenLake, 8 x 8, slippery: a third of the moves go where they should; how likely a plan reaches the goal;"
        " new lakes held out",
        _lake(slippery=True),
        5,
        (8, 11, 14),
        "return",
    ),
    _minigrid("minigrid_four_rooms", "FourRooms: to a goal square, seven actions", "MiniGrid-FourRooms-v0"),
    _minigrid(
        "minigrid_multi_room",
        "MultiRoom: through the doors of four rooms to a goal square",
        "MiniGrid-MultiRoom-N4-S5-v1",
    ),
    _minigrid(
        "minigrid_door_key", "DoorKey, 6 x 6: fetch a key, open a door, go to a goal square", "MiniGrid-DoorKey-6x6-v0"
    ),
    Task(
        "cube",
        tuple(face + turn for face in FACES for turn in ("", "2", "'")),
        "the 2 x 2 x 2 cube after seven random moves, half turns too; passing the solved state; half of them held out",
        lambda seed: Pair(_Scrambles(0), _Scrambles(1)),
        4,
        (5, 6, 7),
        sees="the whole cube",
        **_goal,
    ),
)
TASKS = {task.name: task for task in _tasks}
"""By name."""


def best_score(task: Task, world: World, state: Tensor, length: int) -> Tensor:
    """What the best plan of `length` actions (with chance, the best policy) scores from each of `state [B]`: `[B]`."""
    from neuroprior import TabularWorld, oracle

    if isinstance(world, PocketCube):
        distance = world.distance(state)
        there = (distance > 0) & (distance <= length)
        return torch.where(there, task.discount ** (distance.float() - 1), 0.0)
    assert isinstance(world, TabularWorld)
    return oracle(world, state, length, **task.scoring)
