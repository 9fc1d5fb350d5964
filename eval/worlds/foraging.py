"""The worlds that agents live in for `python -m eval live`: tables in which food grows."""

from collections.abc import Callable
from dataclasses import dataclass

from neuroprior import TabularWorld, gridworld
from neuroprior.worlds import egocentric, labyrinth, maze


@dataclass(frozen=True)
class Home:
    """A table in which food grows.

    Attributes:
        name: as in `HOMES`.
        about: what it is.
        table: makes that of a seed.
        radius: of a patch of food, in actions, see `neuroprior.patches`.
    """

    name: str
    about: str
    table: Callable[[int], TabularWorld]
    radius: int


def _grid(seed: int) -> TabularWorld:
    return gridworld(20, 20, edges="torus", seed=seed)


def _maze(seed: int) -> TabularWorld:
    return maze(15, 15, seed=seed)


def _egocentric(seed: int) -> TabularWorld:
    return egocentric(maze(15, 15, seed=seed))


def _labyrinth(seed: int) -> TabularWorld:
    return labyrinth()


HOMES = {
    home.name: home
    for home in (
        Home("forage_grid", "a grid of 20 x 20, a torus", _grid, 2),
        Home("forage_maze", "a maze of 15 x 15 squares, seen from above", _maze, 5),
        Home(
            "forage_egocentric", "a maze of 15 x 15 squares, for an agent that turns and goes forward", _egocentric, 8
        ),
        Home("forage_labyrinth", "the labyrinth of the mice, 127 nodes of a binary tree", _labyrinth, 3),
    )
}
"""By their names in tables. A patch covers from a thirtieth (grid) to a twelfth (labyrinth) of each."""
