"""Sliding tiles: the 8-, 15- and 24-puzzle and others."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_sizes
from neuroprior._random import generator_on
from neuroprior.worlds.puzzles.files import check_boards, read_tiles
from neuroprior.worlds.puzzles.puzzle import STEPS, Observation, PuzzleWorld, reflected
from neuroprior.worlds.puzzles.windows import Window, Windows, windows_within


class SlidingTilesWorld(PuzzleWorld):
    """Sliding tiles; see `sliding_tiles`. A state is a board, uint8 `[B, H, W]` of tile numbers; 0 is the blank, which
    moves.

    In patterns a tile counts as how far it is from its place in the goal, in rows and columns, so that what is learned
    of one tile holds for others.

    Attributes:
        goal: uint8 `[H, W]`.
        scramble: `reset` makes so many random moves from the goal; None: it draws from `boards`.
    """

    def __init__(
        self, boards: Tensor, goal: Tensor, scramble: int | None, windows: Sequence[Window], observation: Observation
    ) -> None:
        height, width = goal.shape
        kinds = (2 * height - 1) * (2 * width - 1) + 1
        super().__init__(boards, Windows(windows, kinds, 0), observation)
        self.goal, self.scramble, self.num_planes = goal, scramble, height * width
        self._place = goal.flatten().long().argsort()

    def to(self, device: torch.device | str) -> "SlidingTilesWorld":
        super().to(device)
        self.goal, self._place = self.goal.to(device), self._place.to(device)
        return self

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """Boards `[batch_size, H, W]`: drawn from `boards`, or scrambled."""
        if self.scramble is None:
            return super().reset(batch_size, generator)
        check_count("batch_size", batch_size)
        generator = generator_on(generator, self.device)
        state = self.goal.expand(batch_size, *self.goal.shape).contiguous()
        for _ in range(self.scramble):
            weights = torch.rand(batch_size, 4, generator=generator, device=self.device)
            state = self._moved(state, weights.masked_fill(~self.legal_actions(state), -1).argmax(1))
        return state

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        before = self.solved(state)
        after = torch.where(before[:, None, None], state, self._moved(state, action))
        return after, (self.solved(after) & ~before).float()

    def _moved(self, state: Tensor, action: Tensor) -> Tensor:
        row, blank = torch.arange(len(state), device=state.device), self.mover(state)
        steps = torch.tensor([dy * state.shape[2] + dx for dy, dx in STEPS], device=state.device)
        able = self.legal_actions(state)[row, action]
        to = torch.where(able, blank + steps[action], blank)
        flat = state.flatten(1).clone()
        flat[row, blank] = flat[row, to]
        flat[row, to] = 0
        return flat.view_as(state)

    def legal_actions(self, state: Tensor) -> Tensor:
        height, width = state.shape[1:]
        blank = self.mover(state)
        y, x = blank.div(width, rounding_mode="floor"), blank % width
        return torch.stack([y > 0, y < height - 1, x > 0, x < width - 1], 1)

    def solved(self, state: Tensor) -> Tensor:
        return (state == self.goal).flatten(1).all(1)

    def mover(self, state: Tensor) -> Tensor:
        return (state == 0).flatten(1).long().argmax(1)

    def kinds(self, state: Tensor) -> Tensor:
        """1 for the tile that must go furthest up and left, and so on, row by row; 0 lies outside of the board."""
        return self.tile_kinds()[state.flatten(1).long(), torch.arange(state[0].numel(), device=state.device)].view_as(state)

    def tile_kinds(self) -> Tensor:
        """The kind of each tile in each cell, int64 `[tiles, cells]`."""
        height, width = self.goal.shape
        cell, place = torch.arange(height * width, device=self.device), self._place[:, None]
        down = place.div(width, rounding_mode="floor") - cell.div(width, rounding_mode="floor") + height - 1
        return 1 + down * (2 * width - 1) + place % width - cell % width + width - 1

    def planes(self, state: Tensor) -> Tensor:
        """One plane for the blank and each tile."""
        return torch.nn.functional.one_hot(state.long(), state[0].numel()).permute(0, 3, 1, 2).float()

    def distances(self) -> Tensor:
        """The rows and columns from each cell to each tile's place, int64 `[tiles, cells]`; 0 for the blank."""
        width = self.goal.shape[1]
        cell, place = torch.arange(self.goal.numel(), device=self.device), self._place[:, None]
        rows = (place.div(width, rounding_mode="floor") - cell.div(width, rounding_mode="floor")).abs()
        far = rows + (place % width - cell % width).abs()
        far[0] = 0
        return far

    def lower_bound(self, state: Tensor) -> Tensor:
        """The Manhattan distance: the sum of each tile's rows and columns to its place, without the blank's."""
        tiles = state.flatten(1).long()
        return self.distances()[tiles, torch.arange(tiles.shape[1], device=state.device)].sum(1)

    def symmetries(self) -> int:
        """Two where transposing the board and renaming the tiles leaves the goal as it is; else one."""
        height, width = self.goal.shape
        return 2 if height == width and bool((self.transformed(self.goal[None], 1)[0] == self.goal).all()) else 1

    def transformed(self, state: Tensor, number: int) -> Tensor:
        if number == 0:
            return state
        size = self.goal.numel()
        renamed = torch.arange(size, device=self.device)
        renamed[self.goal.flatten().long()] = self.goal.transpose(0, 1).flatten().long()
        return renamed[reflected(state, 4).long()].to(torch.uint8)

    def transformed_actions(self, number: int) -> Tensor:
        return super().transformed_actions(4 if number else 0)


def tile_windows(height: int, width: int) -> tuple[Window, ...]:
    """All single cells of the board, pairs of neighbours at most two from the blank, and 2 x 2 squares with it."""
    return (
        *windows_within(1, 1, max(height, width) - 1),
        *windows_within(1, 2, 2),
        *windows_within(2, 1, 2),
        *windows_within(2, 2, 1),
    )


def sliding_tiles(
    boards: Tensor | str | Path | None = None,
    *,
    shape: tuple[int, int] | None = None,
    goal: Tensor | None = None,
    scramble: int = 1000,
    observation: Observation = "patterns",
    windows: Sequence[Window] | None = None,
) -> SlidingTilesWorld:
    """Sliding tiles on a board: the blank moves up, down, left or right, and the tile that was there takes its place.

    Args:
        boards: integers `[n, H, W]`, or `[n, H * W]` with `shape`: 0 the blank, each number below H * W once; or the
            path of a file with a board a line; None: boards of `shape` by random moves from the goal.
        shape: rows and columns; None: those of the boards, or of a square with as many tiles as a line of the file has.
        goal: integers `[H, W]`; None: 0, 1, 2, ... row by row.
        scramble: number of random moves, where there are no boards.
        observation: see `PuzzleWorld`.
        windows: see `Windows`; None: `tile_windows`.

    Raises:
        ValueError: a board is none, or cannot be solved; the message says which.
        OSError: the file cannot be read.
    """
    if boards is None:
        if shape is None:
            raise ValueError("boards: some are expected, or the shape of boards to scramble")
        check_sizes(rows=shape[0], columns=shape[1], scramble=scramble)
        given = torch.arange(shape[0] * shape[1]).view(1, *shape)
    else:
        given = boards if isinstance(boards, Tensor) else read_tiles(boards, shape)
        if given.dim() == 2 and shape is not None and given.shape[1] == shape[0] * shape[1]:
            given = given.view(-1, *shape)
    given = check_boards("boards", given)
    height, width = given.shape[1:]
    wanted = torch.arange(height * width).view(1, height, width) if goal is None else goal[None]
    wanted = check_boards("goal", wanted)[0]
    if wanted.shape != given.shape[1:]:
        raise ValueError(f"goal: shape [{height}, {width}] is expected, not {list(wanted.shape)}")
    if boards is None:
        given = wanted[None]
    odd = _parity(given) != _parity(wanted[None])
    if bool(odd.any()):
        raise ValueError(
            f"boards[{int(odd.nonzero()[0])}]: no moves lead from it to the goal (its parity is not that of the goal)"
        )
    windows = tile_windows(height, width) if windows is None else windows
    return SlidingTilesWorld(given, wanted, None if boards is not None else scramble, windows, observation)


def _parity(board: Tensor) -> Tensor:
    """`[N]`, 0 or 1: of the permutation and of the blank's row and column together; moves do not change it."""
    tiles = board.flatten(1).long()
    earlier = torch.ones(tiles.shape[1], tiles.shape[1], dtype=torch.bool).triu(1).to(tiles.device)
    inversions = ((tiles[:, :, None] > tiles[:, None, :]) & earlier).sum((1, 2))
    blank = (tiles == 0).long().argmax(1)
    return (inversions + blank.div(board.shape[2], rounding_mode="floor") + blank % board.shape[2]) % 2
