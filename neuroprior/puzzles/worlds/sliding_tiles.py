"""Sliding tiles: the 8-, 15- and 24-puzzle and others."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import check_count, is_integer
from neuroprior._random import generator_on
from neuroprior.puzzles.worlds.puzzle import PuzzleWorld, board_tensor, reflected
from neuroprior.puzzles.worlds.reading import MOST_TILES, board_shape, read_tiles
from neuroprior.puzzles.worlds.windows import CODES, Window, Windows, windows_within


class SlidingTilesWorld(PuzzleWorld):
    """Sliding tiles; see `sliding_tiles`. A state is a board, uint8 `[B, H, W]` of tile numbers; 0 is the blank, which
    moves.

    In patterns a tile counts as how far it is from its place in the goal, in rows and columns, so that what is learned
    of one tile holds for others.

    Args:
        boards: uint8 `[n, H, W]`; None: `reset` scrambles the goal.
        goal: uint8 `[H, W]`.
        windows: whose patterns are observed.
        scramble: number of random moves.

    Raises:
        ValueError: the goal cannot be reached from a board; the message says which.
    """

    def __init__(self, boards: Tensor | None, goal: Tensor, windows: Sequence[Window], scramble: int) -> None:
        height, width = goal.shape
        self.goal, self.scramble = goal, scramble
        flat = goal.flatten().cpu().numpy()
        self.blank = int(flat.argmin())
        # From each cell to each tile's place, [tiles, cells].
        place, cell = flat.argsort()[:, None], np.arange(len(flat))
        rows, columns = place // width - cell // width, place % width - cell % width
        distances = (abs(rows) + abs(columns)).astype(np.float64)
        # 1 for the tile that must go furthest up and left, and so on, row by row; 0 lies outside of the board.
        kinds = 1 + (rows + height - 1) * (2 * width - 1) + columns + width - 1
        super().__init__(
            boards,
            (height, width),
            Windows(windows, _num_kinds(height, width)),
            kinds=kinds,
            outside=0,
            goal=flat,
            distances=distances,
        )
        if boards is not None:
            wrong = (~_solvable(boards, goal)).nonzero()
            if len(wrong):
                raise ValueError(
                    f"`boards[{int(wrong[0])}]` must be a board from which the goal can be reached (without goal= it is"
                    " 0, 1, 2, ... row by row), got one from which it cannot."
                )

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """Random boards of those given, or the goal after random legal moves: uint8 `[batch_size, H, W]`."""
        if self.boards is not None:
            return super().reset(batch_size, generator)
        check_count("batch_size", batch_size, self.goal.numel())
        generator = generator_on(generator, self.device)
        state = self.goal.expand(batch_size, *self.goal.shape).contiguous()
        for _ in range(self.scramble if batch_size else 0):
            action = torch.multinomial(self.legal_actions(state).float(), 1, generator=generator)[:, 0]
            state, _ = self._step(state, action, absorbing=False)
        return state

    @property
    def device(self) -> torch.device:
        return self.goal.device

    def solved(self, state: Tensor) -> Tensor:
        """Where the board is the goal."""
        return (state == self.goal).flatten(1).all(1)

    def check_state(self, state: Tensor) -> None:
        super().check_state(state)
        _check_permutations("state", state)

    def symmetries(self) -> int:
        """Two for square boards whose blank belongs on the diagonal, which can be transposed; else one."""
        height, width = self.shape
        return 2 if height == width and self.blank // width == self.blank % width else 1

    def transformed(self, state: Tensor, number: int) -> Tensor:
        if number == 0:
            return state
        renamed = torch.arange(self.goal.numel(), device=self.device)
        renamed[self.goal.flatten().long()] = self.goal.transpose(0, 1).flatten().long()
        return renamed[reflected(state, 4).long()].to(torch.uint8)

    def transformed_actions(self, number: int) -> Tensor:
        return super().transformed_actions(4 if number else 0)


def tile_windows(height: int, width: int) -> tuple[Window, ...]:
    """All single cells of the board, pairs of neighbours at most two from the blank, and 2 x 2 squares with it.

    On boards of 7 x 7 and more, which have too many such squares to be numbered, there are none.

    Args:
        height, width: of the board.

    Example:
        >>> len(tile_windows(3, 3))
        69
    """
    pairs = (*windows_within(1, 2, 2), *windows_within(2, 1, 2))
    squares = windows_within(2, 2, 1)
    if len(squares) * _num_kinds(height, width) ** 4 >= CODES // 2:
        squares = ()
    cells = ((row, column, 1, 1) for row in range(1 - height, height) for column in range(1 - width, width))
    return *cells, *pairs, *squares


def _num_kinds(height: int, width: int) -> int:
    """How far a tile can be from its place, in rows and columns, and what lies outside of the board."""
    return (2 * height - 1) * (2 * width - 1) + 1


def sliding_tiles(
    boards: Any = None,
    *,
    shape: tuple[int, int] | None = None,
    goal: Any = None,
    windows: Sequence[Window] | None = None,
    scramble: int = 100,
) -> SlidingTilesWorld:
    """Sliding tiles: the blank moves, and changes places with the tile that is there.

    Args:
        boards: a file of puzzles (see `read_tiles`), or integers `[n, H, W]`, or `[n, H * W]` with `shape`: the numbers
            of the tiles, 0 the blank; None: the goal is scrambled, and `shape` or `goal` is needed.
        shape: height and width.
        goal: integers `[H, W]`; None: 0, 1, 2, ... row by row.
        windows: of the patterns; None: `tile_windows`.
        scramble: number of random moves from the goal, where there are no boards.

    Raises:
        ValueError: a board is none, or cannot be solved (the message names the first one), or an argument is out of
            range.

    Example:
        >>> world = sliding_tiles(shape=(3, 3), scramble=20)
        >>> world.reset(5, torch.Generator().manual_seed(0)).shape
        torch.Size([5, 3, 3])
    """
    check_count("scramble", scramble)
    if shape is not None:
        shape = board_shape(shape)
    starts = None
    if boards is not None:
        is_file = isinstance(boards, str | Path)
        starts = board_tensor("boards", read_tiles(boards, shape) if is_file else boards)
        if shape is not None and starts.dim() == 2 and starts.shape[1] == shape[0] * shape[1]:
            starts = starts.view(-1, *shape)
        if starts.dim() != 3 or 0 in starts.shape or (shape is not None and starts.shape[1:] != shape):
            wanted = "[n, H, W], or [n, H * W] with shape=(H, W)" if shape is None else f"[n, {shape[0]}, {shape[1]}]"
            raise ValueError(f"`boards` must have the shape {wanted}, got {list(starts.shape)}.")
        _check_permutations("boards", starts)
        starts, shape = starts.to(torch.uint8), (starts.shape[1], starts.shape[2])
    if goal is None and shape is None:
        raise ValueError("`sliding_tiles` must be given boards, shape or goal, got none of them.")
    goal = board_tensor("goal", torch.arange(shape[0] * shape[1]).view(shape) if goal is None and shape else goal)
    if goal.dim() != 2 or (shape is not None and goal.shape != shape):
        expected = "[H, W]" if shape is None else str(list(shape))
        raise ValueError(f"`goal` must have the shape {expected}, got {list(goal.shape)}.")
    if not 2 <= goal.numel() <= MOST_TILES:
        raise ValueError(f"`goal` must be a board of 2 to {MOST_TILES} cells, got {goal.numel()}.")
    _check_permutations("goal", goal[None])
    goal = goal.to(torch.uint8) if starts is None else goal.to(starts.device, torch.uint8)
    return SlidingTilesWorld(starts, goal, tile_windows(*goal.shape) if windows is None else windows, scramble)


def _check_permutations(name: str, boards: Tensor) -> None:
    """Raise ValueError unless each of `boards [n, H, W]` holds each tile once."""
    cells = boards.shape[1:].numel()
    if not is_integer(boards):
        raise ValueError(f"`{name}` must be integers, got {boards.dtype}.")
    wrong = (boards.flatten(1).long().sort(1).values != torch.arange(cells, device=boards.device)).any(1).nonzero()
    if len(wrong):
        which = name if name == "goal" else f"{name}[{int(wrong[0])}]"
        tiles = boards[int(wrong[0])].flatten().tolist()
        raise ValueError(f"`{which}` must hold each of 0 to {cells - 1} once, got {tiles}.")


def _solvable(boards: Tensor, goal: Tensor) -> Tensor:
    """Whether `goal [H, W]` can be reached from `boards [n, H, W]`: `[n]` bool."""
    order = goal.flatten().long().argsort()
    place = order[boards.flatten(1).long()]  # where the tile of each cell belongs
    if min(goal.shape) == 1:  # tiles in one row cannot pass one another
        tiles = place[place != order[0]].view(len(boards), -1)
        return (tiles.diff(dim=1) > 0).all(1)
    # A move exchanges two tiles, which changes the parity of the permutation, and that of the blank's distance.
    inversions = sum((place[:, i, None] > place[:, i + 1 :]).sum(1) for i in range(place.shape[1]))
    width = goal.shape[1]
    blank = (boards.flatten(1) == 0).to(torch.uint8).argmax(1)
    away = (blank // width - order[0] // width).abs() + (blank % width - order[0] % width).abs()
    return (inversions + away) % 2 == 0
