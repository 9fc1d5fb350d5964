"""The worlds of `python -m eval compare`, and what is optimised, seen and learned from in each."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from eval.worlds import minigrid as minigrid_worlds
from eval.worlds.mid_plan import UnderWay
from eval.worlds.splits import (
    LAST,
    MAPS,
    TAKEN,
    Worlds,
    goal_mazes,
    lake,
    layouts,
    minigrid,
    scrambles,
    split,
    under_way,
    unlike,
)
from neuroprior import TabularWorld, World, gridworld, oracle
from neuroprior.worlds import PocketCube, four_rooms, maze
from neuroprior.worlds.cube import FACES
from neuroprior.worlds.grid import MOVES, TURNS


@dataclass(frozen=True)
class Task:
    """A world of the comparison.

    Attributes:
        name: as in `TASKS`.
        action_names: of its actions, in the order of their numbers.
        about: what it is, what differs between the worlds of a seed, and what is optimised.
        worlds: makes the worlds of a seed.
        depth: of the exhaustive planner whose plans are learned from first.
        lengths: numbers of actions in the plans of the rounds of growth; the last is that of the comparison.
        objective, discount, any_prefix: what planners optimise, see `neuroprior.Planner`.
        min_score: plans that scored no more than this are not learned from; None: all are.
        sees: what `World.observe` of these worlds shows, for priors that see; None: nothing that would be of use.
        near: sets of its features; chains may see one of them alone, as they must have met what they see.
        sights: what priors see where nothing else is asked for, see `eval.compare.settings.SEES`.
        times: plans are looked for from so many times as many starts, where most starts lead nowhere.
        numbered: what is seen is the number of a state, which is of no use at the start, as other starts are held out.
    """

    name: str
    action_names: tuple[str, ...]
    about: str
    worlds: Callable[[int], Worlds]
    depth: int
    lengths: tuple[int, ...]
    objective: Literal["terminal", "return"] = "terminal"
    discount: float = 1.0
    any_prefix: bool = False
    min_score: float | None = None
    sees: str | None = None
    near: tuple[tuple[int, ...], ...] = ()
    sights: tuple[str, ...] = ("nothing",)
    times: int = 1
    numbered: bool = False

    @property
    def num_actions(self) -> int:
        """Number of actions."""
        return len(self.action_names)

    @property
    def length(self) -> int:
        """Actions in the plans that are compared."""
        return self.lengths[-1]

    def shows(self, sees: str) -> bool:
        """Whether priors that see so much (see `eval.compare.settings.SEES`) are shown something of use."""
        if self.sees is None or sees == "nothing":
            return sees == "nothing"
        return sees == "each step" or not self.numbered

    @property
    def scoring(self) -> dict[str, Any]:
        """What planners optimise, as their arguments."""
        return {"objective": self.objective, "discount": self.discount, "any_prefix": self.any_prefix}


# Later is worth less, so that the best plans go straight there.
_goal: dict[str, Any] = {"objective": "return", "discount": 0.95, "min_score": 0.0}
_neighbours = "which of the 24 squares around it are free"
# The eight squares around, and those that actions lead or turn to, of five rows of five without the one in the middle.
_nearest = ((6, 7, 8, 11, 12, 15, 16, 17), (7, 11, 12))
_nearest_of_four = (_nearest[0], (7, 11, 12, 16))
_grid_about = "the reward where a plan ends; new walls and rewards held out"


def _minigrid(name: str, about: str, environment: str) -> Task:
    """One of MiniGrid's worlds."""
    how: dict[str, Any] = {"near": minigrid_worlds.NEAR, "sights": ("nothing", "each step"), "times": 3} | _goal
    about = f"MiniGrid {about}; reaching it; new layouts held out"
    sees = "the seven by seven squares before it"
    return Task(
        name, minigrid_worlds.MOVES, about, partial(minigrid, environment=environment), 5, (9, 16), sees=sees, **how
    )


_tasks = (
    Task(
        "grid",
        MOVES,
        "the paper's grid: 20 x 20, a torus, independent rewards; the reward where a plan ends; new rewards held out",
        partial(unlike, make=gridworld, edges="torus", num_worlds=MAPS),
        4,
        (6, 8),
    ),
    Task(
        "four_rooms",
        MOVES,
        f"four rooms, 13 x 13, doors at random places, four moves; {_grid_about}",
        partial(layouts, make=four_rooms),
        5,
        (10, 16),
        sees=_neighbours,
        near=_nearest_of_four,
        sights=("nothing", "start"),
        times=2,
    ),
    Task(
        "maze",
        MOVES,
        f"mazes with some loops, 15 x 15, four moves; {_grid_about}",
        partial(layouts, make=maze),
        5,
        (10, 16),
        sees=_neighbours,
        near=_nearest_of_four,
        sights=("nothing", "start"),
        times=2,
    ),
    Task(
        "egocentric",
        TURNS,
        f"the same mazes for an agent that turns left, turns right or goes forward; {_grid_about}",
        partial(layouts, make=maze, egocentric=True),
        7,
        (11, 16),
        sees=_neighbours + ", as it is turned",
        near=_nearest,
        sights=("nothing", "start", "each step"),
        times=2,
    ),
    Task(
        "goal_maze",
        TURNS,
        "the same mazes with a goal, and one more way to look: where the goal lies; reaching it; new walls and goals"
        " held out",
        goal_mazes,
        7,
        (11, 16),
        sees=_neighbours + ", and how far ahead and aside the goal is",
        # With the side on which the goal is, and no more, chains meet the same sights again.
        near=tuple((*squares, 26, 27) for squares in _nearest),
        sights=("nothing", "each step"),
        times=8,
        **_goal,
    ),
    Task(
        "under_way",
        TURNS,
        f"the egocentric mazes, planning anew after the first {TAKEN} of {LAST} moves; {_grid_about}",
        under_way,
        7,
        (11, 16),
        sees="what is left of the last plan",
        near=tuple(tuple(range(len(TURNS) * left)) for left in (1, 2)),
        sights=("nothing", "start"),
        times=2,
    ),
    Task(
        "taxi",
        ("south", "north", "east", "west", "pickup", "dropoff"),
        "Taxi: fetch a passenger and bring it; the sum of rewards; a quarter of all states to start from held out",
        partial(split, name="Taxi-v4"),
        5,
        (10, 16),
        "return",
        sees="the whole state",
        numbered=True,
        sights=("nothing", "each step"),
    ),
    Task(
        "cliff",
        MOVES,
        "CliffWalking: go around a cliff; the sum of rewards; a quarter of all squares to start from held out",
        partial(split, name="CliffWalking-v1"),
        5,
        (10, 16),
        "return",
        sees="the square",
        numbered=True,
        sights=("nothing", "each step"),
    ),
    Task(
        "frozen_lake",
        ("left", "down", "right", "up"),
        "FrozenLake, 8 x 8, not slippery: to the goal, between holes; reaching it; new lakes held out",
        partial(lake, slippery=False),
        5,
        (9, 14),
        **_goal,
    ),
    Task(
        "slippery",
        ("left", "down", "right", "up"),
        "FrozenLake, 8 x 8, slippery: a third of the moves go where they should; how likely a plan reaches the goal;"
        " new lakes held out",
        partial(lake, slippery=True),
        5,
        (9, 14),
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
        "the 2 x 2 x 2 cube after nine random moves, half turns too; passing the solved state; a quarter held out",
        scrambles,
        4,
        (6, 7, 8),
        sees="the whole cube",
        sights=("nothing", "each step"),
        times=8,
        **_goal,
    ),
)
TASKS = {task.name: task for task in _tasks}
"""By name."""


def best_score(task: Task, world: World, state: Tensor, length: int) -> Tensor:
    """What the best plan of `length` actions (with chance, the best policy) scores from each of `state [B]`: `[B]`."""
    if isinstance(world, PocketCube):
        distance = world.distance(state)
        there = (distance > 0) & (distance <= length)
        return torch.where(there, task.discount ** (distance.float() - 1), 0.0)
    if isinstance(world, UnderWay):
        return best_score(task, world.world, state[:, 0], length)
    assert isinstance(world, TabularWorld)
    return oracle(world, state, length, **task.scoring)
