"""The worlds of `python -m eval live`: tables in which food grows. To add one, add it to `FORAGING_WORLDS`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from neuroprior.worlds import GridWorld, TabularWorld, egocentric, gridworld, labyrinth, maze


@dataclass(frozen=True)
class ForagingTask:
    """A table in which food grows.

    Attributes:
        about: what it is.
        table: makes the table of a seed.
        radius: of a patch of food, in actions, see `eval.live.foraging.patches`.
    """

    about: str
    table: Callable[[int], TabularWorld]
    radius: int


def _maze(seed: int) -> GridWorld:
    return maze(15, 15, seed=seed)


FORAGING_WORLDS = {
    "forage_grid": ForagingTask(
        "a grid of 20 x 20, a torus", lambda seed: gridworld(20, 20, edges="torus", seed=seed), 2
    ),
    "forage_maze": ForagingTask("a maze of 15 x 15 squares, seen from above", _maze, 5),
    "forage_egocentric": ForagingTask(
        "a maze of 15 x 15 squares, for an agent that turns and goes forward", lambda seed: egocentric(_maze(seed)), 8
    ),
    "forage_labyrinth": ForagingTask(
        "the labyrinth of the mice, 127 nodes of a binary tree", lambda seed: labyrinth(), 3
    ),
}
"""By name. A patch covers from a thirtieth (grid) to a twelfth (labyrinth) of each."""

ForagingWorldName: TypeAlias = Literal[tuple(FORAGING_WORLDS)]  # type: ignore[valid-type]
