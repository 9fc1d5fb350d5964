"""The worlds of `python -m eval live`: tables in which food grows. To add one, add it to `FORAGING_WORLDS`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from neuroprior.worlds import TabularWorld, egocentric, gridworld, labyrinth, maze


@dataclass(frozen=True)
class ForagingTask:
    """A table in which food grows.

    Attributes:
        name: as in `FORAGING_WORLDS`.
        about: what it is.
        table: makes the table of a seed.
        radius: of a patch of food, in actions, see `neuroprior.worlds.patches`.
    """

    name: str
    about: str
    table: Callable[[int], TabularWorld]
    radius: int


def _grid(seed: int) -> TabularWorld:
    return gridworld(20, 20, edges="torus", seed=seed)


def _maze(seed: int) -> TabularWorld:
    return maze(15, 15, seed=seed)


_tasks = (
    ForagingTask("forage_grid", "a grid of 20 x 20, a torus", _grid, 2),
    ForagingTask("forage_maze", "a maze of 15 x 15 squares, seen from above", _maze, 5),
    ForagingTask(
        "forage_egocentric",
        "a maze of 15 x 15 squares, for an agent that turns and goes forward",
        lambda seed: egocentric(_maze(seed)),
        8,
    ),
    ForagingTask("forage_labyrinth", "the labyrinth of the mice, 127 nodes of a binary tree", lambda seed: labyrinth(), 3),
)
FORAGING_WORLDS = {task.name: task for task in _tasks}
"""By name. A patch covers from a thirtieth (grid) to a twelfth (labyrinth) of each."""

ForagingWorldName = Literal[tuple(FORAGING_WORLDS)]  # type: ignore[valid-type]
