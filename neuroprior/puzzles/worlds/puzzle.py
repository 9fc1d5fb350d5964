"""What puzzles on a board have in common: a mover that goes up, down, left or right, and a goal."""

from abc import abstractmethod
from typing import Any, Literal

import torch
from torch import Tensor

from neuroprior._checks import check_count
from neuroprior._random import generator_on
from neuroprior.puzzles.worlds.windows import Windows
from neuroprior.worlds.world import World

Observation = Literal["patterns", "board"]


class PuzzleWorld(World):
    """A puzzle on a board `[H, W]`; the state is the board itself.

    Moving where one cannot changes nothing. The reward of the step that solves a board is 1, all others are 0; in a
    solved board nothing moves any more.

    Args:
        boards: uint8 `[n, H, W]`: those to start from; None: `reset` makes its own.
        shape: H and W.
        windows: whose patterns are observed.
        observation: "patterns": int32 `[N, F]`, the active patterns of a state, see `Windows`. "board": float32
            `[N, C * H * W]`: planes of the board, one after the other.

    Attributes:
        boards, shape, windows, observation: as given.
        num_planes: C.

    Raises:
        ValueError: an argument is wrong.
    """

    num_actions = 4
    all_legal = False
    has_goal = True
    action_names = ("up", "down", "left", "right")
    num_planes: int

    def __init__(
        self, boards: Tensor | None, shape: tuple[int, int], windows: Windows, observation: Observation
    ) -> None:
        if observation not in ("patterns", "board"):
            raise ValueError(f'observation: "patterns" or "board" is expected, not {observation!r}')
        self.boards, self.shape, self.windows, self.observation = boards, shape, windows, observation

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Where the boards are."""

    @abstractmethod
    def mover(self, state: Tensor) -> Tensor:
        """The cell of the mover, int64 `[N]`: its row times W plus its column."""

    @abstractmethod
    def kinds(self, state: Tensor) -> Tensor:
        """The kind of each cell, `[N, H, W]` below `windows.base`, for patterns."""

    @abstractmethod
    def planes(self, state: Tensor) -> Tensor:
        """The planes of boards, float32 `[N, C, H, W]`."""

    @abstractmethod
    def lower_bound(self, state: Tensor) -> Tensor:
        """A number of moves, int64 `[N]`, that a solution needs at least: a heuristic that is consistent."""

    @abstractmethod
    def symmetries(self) -> int:
        """How many reflections and rotations, the board itself among them, map solutions to solutions."""

    @abstractmethod
    def transformed(self, state: Tensor, number: int) -> Tensor:
        """Boards `[N, H, W]` under a symmetry, numbered from 0, which changes nothing."""

    def transformed_actions(self, number: int) -> Tensor:
        """What each action is under a symmetry, int64 `[4]`: see `transformed`."""
        # Bit 2 of the number transposes, bit 0 then turns rows around, bit 1 columns.
        action = torch.tensor([2, 3, 0, 1]) if number & 4 else torch.arange(4)
        if number & 1:
            action = torch.tensor([1, 0, 2, 3])[action]
        if number & 2:
            action = torch.tensor([0, 1, 3, 2])[action]
        return action

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """Boards `[batch_size, H, W]` drawn uniformly from `boards`."""
        assert self.boards is not None
        check_count("batch_size", batch_size, self.boards[0].numel())
        generator = generator_on(generator, self.device)
        return self.boards[torch.randint(len(self.boards), (batch_size,), generator=generator, device=self.device)]

    def terminated(self, state: Tensor) -> Tensor:
        """Where the puzzle is solved."""
        return self.solved(state)

    def observe(self, state: Tensor) -> Tensor:
        """The active patterns, int32 `[N, F]`, or the planes of the board, float32 `[N, C * H * W]`."""
        if self.observation == "board":
            return self.planes(state).flatten(1)
        mover, width = self.mover(state), state.shape[2]
        row = mover.div(width, rounding_mode="floor")
        return self.windows.codes(self.kinds(state), row, mover - row * width)

    def check_state(self, state: Tensor) -> None:
        height, width = self.shape
        if not isinstance(state, Tensor) or state.dtype != torch.uint8 or tuple(state.shape[1:]) != self.shape:
            raise ValueError(f"state: uint8 of shape [B, {height}, {width}] is expected: boards")


def board_tensor(name: str, boards: Any) -> Tensor:
    """Boards as a tensor; ValueError for what is none."""
    try:
        return torch.as_tensor(boards)
    except (RuntimeError, TypeError, ValueError):
        raise ValueError(
            f"{name}: a file or boards of one size are expected, not this {type(boards).__name__}"
        ) from None


def reflected(board: Tensor, number: int) -> Tensor:
    """Boards `[N, H, W]` under a symmetry; see `PuzzleWorld.transformed_actions`."""
    if number & 4:
        board = board.transpose(1, 2)
    turned = [dim for bit, dim in ((1, 1), (2, 2)) if number & bit]
    return board.flip(turned).contiguous() if turned else board.contiguous()
