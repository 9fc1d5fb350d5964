"""Grid worlds: cells in a rectangle, four moves, independent random rewards."""

from typing import Literal

import torch
from torch import Tensor

from neuroprior.worlds.tabular import TabularWorld

MOVES = ("up", "right", "down", "left")
"""The four moves in the order of their numbers; the reversal of move a is (a + 2) % 4."""

_ROW_COLUMN = torch.tensor([[-1, 0], [0, 1], [1, 0], [0, -1]])


class GridWorld(TabularWorld):
    """A `TabularWorld` whose cells are the squares of a rectangle, row by row from the top left; see `gridworld`.

    Args:
        height, width, edges: see `gridworld`.
        reward: floating point `[W, S]`: the rewards of arriving in each cell, for W reward maps.

    Attributes:
        height, width: its size in cells.
        edges: "wall" or "torus".
    """

    def __init__(self, height: int, width: int, edges: Literal["wall", "torus"], reward: Tensor) -> None:
        self.height, self.width, self.edges = height, width, edges
        # One map cannot be mistaken for rewards of actions, as four maps of four cells could be.
        super().__init__(_moves(height, width, edges), reward[:1], action_names=MOVES)
        self._set_maps(reward)

    def coordinates(self, state: Tensor) -> Tensor:
        """Row and column of each state: `[..., 2]`."""
        cell = self.cell(state)
        return torch.stack([cell.div(self.width, rounding_mode="floor"), cell % self.width], -1)


def gridworld(
    height: int = 20,
    width: int = 20,
    edges: Literal["wall", "torus"] = "wall",
    *,
    reward_power: float = 1.0,
    num_worlds: int = 1,
    seed: int = 0,
) -> GridWorld:
    """A grid with independent random rewards, as in the paper's first simulation.

    Args:
        height, width: size in cells.
        edges: "wall": a move off the grid stays where it is. "torus": it comes back on the other side.
        reward_power: rewards are uniform numbers between 0 and 1 raised to this power; large powers leave few good
            cells. The power does not change which plan is best where rewards are compared, not added.
        num_worlds: number of reward maps, W.
        seed: gives the same rewards again.

    Raises:
        ValueError: an argument is out of range.
    """
    if not 0 < reward_power < float("inf"):
        raise ValueError(f"gridworld: reward_power must be positive and finite, not {reward_power}")
    if num_worlds < 1:
        raise ValueError(f"gridworld: num_worlds must be at least 1, not {num_worlds}")
    if height < 1 or width < 1:
        raise ValueError(f"gridworld: height and width must be at least 1, not {height} x {width}")
    if edges not in ("wall", "torus"):
        raise ValueError(f'gridworld: edges must be "wall" or "torus", not {edges!r}')
    uniform = torch.rand(num_worlds, height * width, generator=torch.Generator().manual_seed(seed))
    return GridWorld(height, width, edges, uniform.pow(reward_power))


def _moves(height: int, width: int, edges: str) -> Tensor:
    """The transition table `[height * width, 4]`."""
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    to = torch.stack([rows, columns], -1).view(-1, 1, 2) + _ROW_COLUMN
    size = torch.tensor([height, width])
    to = to % size if edges == "torus" else to.clamp(min=torch.zeros_like(size), max=size - 1)
    return to[..., 0] * width + to[..., 1]
