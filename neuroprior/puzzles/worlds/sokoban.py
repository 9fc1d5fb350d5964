"""Sokoban: push all boxes onto goals."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import check_range
from neuroprior._hashing import row_hashes
from neuroprior.puzzles.worlds.puzzle import PuzzleWorld, board_tensor, reflected
from neuroprior.puzzles.worlds.reading import count_problem, read_sokoban
from neuroprior.puzzles.worlds.rules import BOX, PLAYER_ON_GOAL, WALL
from neuroprior.puzzles.worlds.windows import Window, Windows, windows_with_mover, windows_within

KINDS = 5
"""Kinds of cells in patterns: floor, wall, goal, box, box on a goal; the player's cell is what lies under it."""

SOKOBAN_WINDOWS: tuple[Window, ...] = (
    *windows_within(3, 3, 4),
    *windows_within(4, 2, 3),
    *windows_within(2, 4, 3),
    *windows_with_mover(2, 2),
    *windows_with_mover(1, 2),
    *windows_with_mover(2, 1),
)
"""Windows of 3 x 3, 4 x 2, 2 x 4, 2 x 2, 1 x 2 and 2 x 1 cells around the player, 105 in all."""


class SokobanWorld(PuzzleWorld):
    """Sokoban levels of one size; see `sokoban`.

    A state is a board, uint8 `[B, H, W]`, of cells 0 floor, 1 wall, 2 goal, 3 box, 4 box on goal, 5 player, 6 player on
    goal. In patterns a cell is one of the first five; the player's own counts as what is under it, and what lies beyond
    the board as wall.

    Args:
        boards: uint8 `[n, H, W]`.
        windows: whose patterns are observed.

    Raises:
        ValueError: a board is no level; the message says which.
    """

    boards: Tensor

    def __init__(self, boards: Tensor, windows: Sequence[Window]) -> None:
        if boards.dim() != 3 or 0 in boards.shape:
            raise ValueError(f"`levels` must be codes [n, H, W], got shape {list(boards.shape)}.")
        check_levels("levels", boards)
        shape = boards.shape[1], boards.shape[2]
        kinds = np.repeat(np.arange(KINDS)[:, None], shape[0] * shape[1], 1)
        super().__init__(
            boards.to(torch.uint8),
            shape,
            Windows(windows, KINDS),
            kinds=kinds,
            outside=WALL,
            goal=np.zeros(0, np.uint8),
            distances=np.zeros((0, kinds.shape[1])),
        )

    @property
    def device(self) -> torch.device:
        return self.boards.device

    def solved(self, state: Tensor) -> Tensor:
        """Where all boxes are on goals."""
        return ~(state == BOX).flatten(1).any(1)

    def group(self, state: Tensor) -> Tensor:
        """A number of the walls, int64 `[N]`, at least 0: the same for the same walls, in any world of this size."""
        return row_hashes((state == WALL).to(torch.uint8)) & (2**63 - 1)

    def check_state(self, state: Tensor) -> None:
        super().check_state(state)
        check_levels("state", state)

    def symmetries(self) -> int:
        """Eight for square boards, else four."""
        return 8 if self.shape[0] == self.shape[1] else 4

    def transformed(self, state: Tensor, number: int) -> Tensor:
        return reflected(state, number)


def check_levels(name: str, boards: Tensor) -> None:
    """Raise ValueError unless each of `boards [n, H, W]` holds codes of cells, one player and a goal for each box."""
    check_range(name, boards, PLAYER_ON_GOAL + 1, "codes of cells")
    if (problem := count_problem(boards.cpu().numpy())) is not None:
        raise ValueError(f"`{name}[{problem[0]}]` {problem[1]}")


def sokoban(levels: Any, *, windows: Sequence[Window] = SOKOBAN_WINDOWS) -> SokobanWorld:
    """Sokoban: a player pushes boxes, one at a time, onto goals.

    Args:
        levels: a file of levels (see `read_sokoban`), a list of level texts, or boards `[n, H, W]`, see `SokobanWorld`.
        windows: of the patterns.

    Raises:
        ValueError: a level is none, or an argument is out of range; the message says which.
        OSError: the file cannot be read.

    Example:
        >>> world = sokoban(read_sokoban("#####\\n#@$.#\\n#####"))
        >>> state, reward = world.step(world.reset(1), torch.tensor([3]))
        >>> world.solved(state).tolist()
        [True]
    """
    if isinstance(levels, str | Path):
        boards = torch.from_numpy(read_sokoban(levels))
    elif isinstance(levels, list | tuple) and all(isinstance(level, str) for level in levels):
        boards = torch.from_numpy(read_sokoban("\n;\n".join(["", *levels])))
        if len(boards) != len(levels):
            raise ValueError(f"`levels` must hold one level in each text, got {len(boards)} in {len(levels)} texts.")
    else:
        boards = board_tensor("levels", levels)
    return SokobanWorld(boards, windows)
