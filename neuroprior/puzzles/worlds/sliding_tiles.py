"""Sliding tiles: the 8-, 15- and 24-puzzle and others."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_count, is_integer
from neuroprior._random import generator_on
from neuroprior.puzzles.worlds.puzzle import Observation, PuzzleWorld, board_tensor, reflected
from neuroprior.puzzles.worlds.reading import MOST_TILES, board_shape, read_tiles
from neuroprior.puzzles.worlds.windows import CODES, Window, Windows, windows_within


class SlidingTilesWorld(PuzzleWorld):
    """Sliding tiles; see `sliding_tiles`. A state is a board, uint8 `[B, H, W]` of tile numbers; 0 is the blank, which
    moves.

    In patterns a tile counts as how far it is from its place in the goal, in rows and columns, so that what is learned
    of one tile holds for others. Planes are the blank and the tiles.

    Args:
        boards: uint8 `[n, H, W]`; None: `reset` scrambles the goal.
        goal: uint8 `[H, W]`.
        windows, observation: see `PuzzleWorld`.
        scramble: number of random moves.

    Raises:
        ValueError: the goal cannot be reached from a board; the message says which.
    """

    def __init__(
        self,
        boards: Tensor | None,
        goal: Tensor,
        windows: Sequence[Window],
        observation: Observation,
        scramble: int,
    ) -> None:
        height, width = goal.shape
        kinds = _num_kinds(height, width)
        super().__init__(boards, (height, width), Windows(windows, kinds, 0), observation)
        self.goal, self.scramble, self.num_planes = goal, scramble, height * width
        if boards is not None:
            wrong = (~_solvable(boards, goal)).nonzero()
            if len(wrong):
                raise ValueError(
                    f"boards[{int(wrong[0])}]: the goal cannot be reached from this board (without goal= it is 0, 1, 2,"
                    " ... row by row)"
                )

    @property
    def device(self) -> torch.device:
        return self.goal.device

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """Random boards of those given, or the goal after random legal moves: uint8 `[batch_size, H, W]`."""
        if self.boards is not None:
            return super().reset(batch_size, generator)
        check_count("batch_size", batch_size, self.goal.numel())
        generator = generator_on(generator, self.device)
        state = self.goal.expand(batch_size, *self.goal.shape).contiguous()
        for _ in range(self.scramble if batch_size else 0):
            action = torch.multinomial(self.legal_actions(state).float(), 1, generator=generator)[:, 0]
            state = self._after(state, action)
        return state

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """The blank moves; an illegal action, and any action where the goal is reached, leaves the state as it is.

        The reward is 1 for the step that reaches the goal, else 0.
        """
        ended = self.solved(state)
        after = torch.where(ended[:, None, None], state, self._after(state, action))
        return after, (self.solved(after) & ~ended).float()

    def _after(self, state: Tensor, action: Tensor) -> Tensor:
        """Boards after a move of the blank, if it is legal."""
        flat = state.flatten(1)
        blank = _blank(flat)
        width = state.shape[2]
        legal = self.legal_actions(state).gather(1, action[:, None])[:, 0]
        move = torch.tensor([-width, width, -1, 1], device=state.device)[action]
        to = torch.where(legal, blank + move, blank)
        tile = flat.gather(1, to[:, None])
        return flat.scatter(1, blank[:, None], tile).scatter(1, to[:, None], 0).view_as(state)

    def legal_actions(self, state: Tensor) -> Tensor:
        """Moves of the blank that stay on the board: `[N, 4]` bool."""
        height, width = state.shape[1:]
        blank = _blank(state.flatten(1))
        row, column = blank // width, blank % width
        return torch.stack([row > 0, row < height - 1, column > 0, column < width - 1], 1)

    def solved(self, state: Tensor) -> Tensor:
        """Where the board is the goal."""
        return (state == self.goal).flatten(1).all(1)

    def mover(self, state: Tensor) -> Tensor:
        return _blank(state.flatten(1))

    def kinds(self, state: Tensor) -> Tensor:
        """1 for the tile that must go furthest up and left, and so on, row by row; 0 lies outside of the board."""
        flat = state.flatten(1).long()
        return self.tile_kinds()[flat, torch.arange(flat.shape[1], device=state.device)].view_as(state)

    def tile_kinds(self) -> Tensor:
        """The kind of each tile in each cell, int64 `[tiles, cells]`."""
        height, width = self.goal.shape
        cell, place = torch.arange(height * width, device=self.device), self._places()[:, None]
        down = place.div(width, rounding_mode="floor") - cell.div(width, rounding_mode="floor") + height - 1
        return 1 + down * (2 * width - 1) + place % width - cell % width + width - 1

    def planes(self, state: Tensor) -> Tensor:
        """One plane for the blank and each tile."""
        return torch.nn.functional.one_hot(state.long(), self.goal.numel()).permute(0, 3, 1, 2).float()

    def distances(self) -> Tensor:
        """The rows and columns from each cell to each tile's place, int64 `[tiles, cells]`; 0 for the blank."""
        width = self.goal.shape[1]
        cell, place = torch.arange(self.goal.numel(), device=self.device), self._places()[:, None]
        rows = (place.div(width, rounding_mode="floor") - cell.div(width, rounding_mode="floor")).abs()
        far = rows + (place % width - cell % width).abs()
        far[0] = 0
        return far

    def _places(self) -> Tensor:
        """The cell of each tile in the goal, int64 `[tiles]`."""
        return self.goal.flatten().long().argsort()

    def lower_bound(self, state: Tensor) -> Tensor:
        """The sum of the tiles' Manhattan distances from their places in the goal, int64 `[N]`: consistent."""
        tiles = state.flatten(1).long()
        return self.distances()[tiles, torch.arange(tiles.shape[1], device=state.device)].sum(1)

    def check_state(self, state: Tensor) -> None:
        super().check_state(state)
        _check_permutations("state", state)

    def symmetries(self) -> int:
        """Two for square boards whose blank belongs on the diagonal, which can be transposed; else one."""
        (height, width), blank = self.goal.shape, int(self._places()[0])
        return 2 if height == width and blank // width == blank % width else 1

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
    observation: Observation = "patterns",
    windows: Sequence[Window] | None = None,
    scramble: int = 100,
) -> SlidingTilesWorld:
    """Sliding tiles: the blank moves, and changes places with the tile that is there.

    Args:
        boards: a file of puzzles (see `read_tiles`), or integers `[n, H, W]`, or `[n, H * W]` with `shape`: the numbers
            of the tiles, 0 the blank; None: the goal is scrambled, and `shape` or `goal` is needed.
        shape: height and width.
        goal: integers `[H, W]`; None: 0, 1, 2, ... row by row.
        observation: see `PuzzleWorld`.
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
    given = None
    if boards is not None:
        is_file = isinstance(boards, str | Path)
        given = board_tensor("boards", read_tiles(boards, shape) if is_file else boards)
        if shape is not None and given.dim() == 2 and given.shape[1] == shape[0] * shape[1]:
            given = given.view(-1, *shape)
        if given.dim() != 3 or 0 in given.shape or (shape is not None and given.shape[1:] != shape):
            wanted = "[n, H, W], or [n, H * W] with shape=(H, W)," if shape is None else f"[n, {shape[0]}, {shape[1]}]"
            raise ValueError(f"boards: shape {wanted} is expected, not {list(given.shape)}")
        shape = (given.shape[1], given.shape[2])
    if goal is None:
        if shape is None:
            raise ValueError("sliding_tiles: give boards, shape or goal")
        goal = torch.arange(shape[0] * shape[1]).view(shape)
    goal = board_tensor("goal", goal)
    if goal.dim() != 2 or (shape is not None and goal.shape != shape):
        raise ValueError(
            f"goal: shape {'[H, W]' if shape is None else list(shape)} is expected, not {list(goal.shape)}"
        )
    if not 2 <= goal.numel() <= MOST_TILES:
        raise ValueError(f"goal: a board of 2 to {MOST_TILES} cells is expected, not {goal.numel()}")
    _check_permutations("goal", goal[None])
    if given is not None:
        _check_permutations("boards", given)
        given, goal = given.to(torch.uint8), goal.to(given.device)
    height, width = goal.shape
    windows = tile_windows(height, width) if windows is None else windows
    return SlidingTilesWorld(given, goal.to(torch.uint8), windows, observation, scramble)


def _check_permutations(name: str, boards: Tensor) -> None:
    """Raise ValueError unless each of `boards [n, H, W]` holds each tile once."""
    cells = boards.shape[1:].numel()
    if not is_integer(boards):
        raise ValueError(f"{name}: integers are expected, not {str(boards.dtype).removeprefix('torch.')}")
    wrong = (boards.flatten(1).long().sort(1).values != torch.arange(cells, device=boards.device)).any(1).nonzero()
    if len(wrong):
        which = name if name == "goal" else f"{name}[{int(wrong[0])}]"
        raise ValueError(f"{which}: each of 0 to {cells - 1} once is expected")


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
    blank = _blank(boards.flatten(1))
    away = (blank // width - order[0] // width).abs() + (blank % width - order[0] % width).abs()
    return (inversions + away) % 2 == 0


def _blank(flat: Tensor) -> Tensor:
    """int64 `[N]`: the cell of the blank in `flat [N, H * W]`."""
    return (flat == 0).to(torch.uint8).argmax(1)
