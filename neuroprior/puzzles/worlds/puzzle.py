"""What Sokoban and sliding tiles share: a mover that goes up, down, left or right, patterns around it, and a goal."""

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import check_count
from neuroprior._random import generator_on
from neuroprior.puzzles.worlds.rules import (
    ACTIONS,
    SOKOBAN,
    TILES,
    Array,
    Rules,
    bound_boards,
    legal_in_boards,
    observe_boards,
    step_boards,
)
from neuroprior.puzzles.worlds.windows import Windows
from neuroprior.worlds.observations import Patterns
from neuroprior.worlds.world import World, check_action


class PuzzleWorld(World):
    """A puzzle on a board `[H, W]`; the state is the board itself.

    Moving where one cannot changes nothing. The reward of the step that solves a board is 1, all others are 0; in a
    solved board nothing moves any more. The rules are compiled loops on the CPU; states elsewhere are copied there and
    back.

    Args:
        boards: uint8 `[n, H, W]`: those to start from; None: `reset` makes its own.
        shape: H and W.
        windows: whose patterns are observed.
        kinds: int64 `[contents, H * W]`: what each content of a cell counts as in patterns.
        outside: the kind of what lies outside of the board.
        goal, distances: see `Rules`.
    """

    num_actions = ACTIONS
    all_legal = False
    has_goal = True
    action_names = ("up", "down", "left", "right")

    def __init__(
        self,
        boards: Tensor | None,
        shape: tuple[int, int],
        windows: Windows,
        *,
        kinds: Array,
        outside: int,
        goal: Array,
        distances: Array,
    ) -> None:
        self.boards, self.shape, self.windows = boards, shape, windows
        self.observation = Patterns(len(windows.windows))
        random, reach = np.random.default_rng(0), windows.radius
        keys = random.integers(2**63, size=(len(kinds) + 1, kinds.shape[1]), dtype=np.uint64)
        shifted = [(row + reach, column + reach, height, width) for row, column, height, width in windows.windows]
        self.rules = Rules(
            puzzle=TILES if len(goal) else SOKOBAN,
            width=shape[1],
            goal=goal,
            distances=distances,
            keys=keys,
            kinds=kinds,
            base=windows.base,
            outside=outside,
            windows=np.array(shifted, np.int32),
            offsets=np.array(windows.offsets, np.int64),
            radius=reach,
        )

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Where the boards are."""

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

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """One step; an illegal action, and any action where the puzzle is solved, leaves the state as it is.

        The reward is 1 for the step that solves the puzzle, else 0.
        """
        PuzzleWorld.check_state(self, state)  # what is on the boards is known where a search begins
        return self._step(state, check_action(action, len(state), self.num_actions), absorbing=True)

    def _step(self, state: Tensor, action: Tensor, absorbing: bool) -> tuple[Tensor, Tensor]:
        boards = flat_boards(state)
        after, reward = np.empty_like(boards), np.zeros(len(boards), np.float32)
        step_boards(self.rules, boards, action.cpu().numpy(), absorbing, after, reward)
        reached = torch.from_numpy(after).view(state.shape)
        return reached.to(state.device), torch.from_numpy(reward).to(state.device)

    def legal_actions(self, state: Tensor) -> Tensor:
        """Actions that move something, `[N, 4]` bool; where there are none, all."""
        legal = np.empty((len(state), ACTIONS), bool)
        legal_in_boards(self.rules, flat_boards(state), legal)
        return torch.from_numpy(legal).to(state.device)

    def terminated(self, state: Tensor) -> Tensor:
        """Where the puzzle is solved."""
        return self.solved(state)

    def observe(self, state: Tensor) -> Tensor:
        """The active patterns, int32 `[N, F]`."""
        codes = np.empty((len(state), len(self.windows.windows)), np.int32)
        observe_boards(self.rules, flat_boards(state), codes)
        return torch.from_numpy(codes).to(state.device)

    def lower_bound(self, state: Tensor) -> Tensor:
        """A number of moves, int64 `[N]`, that a solution needs at least: a heuristic.

        Of sliding tiles it is the sum of the tiles' Manhattan distances from their places, which is consistent. In
        Sokoban boxes are matched with goals so that the sum of their Manhattan distances is least; with more than 5
        boxes it is the sum of each box's distance to the nearest goal.
        """
        bound = np.empty(len(state), np.int64)
        bound_boards(self.rules, flat_boards(state), bound)
        return torch.from_numpy(bound).to(state.device)

    def check_state(self, state: Tensor) -> None:
        if not isinstance(state, Tensor) or state.dtype != torch.uint8 or tuple(state.shape[1:]) != self.shape:
            got = f"{state.dtype} {list(state.shape)}" if isinstance(state, Tensor) else type(state).__name__
            raise ValueError(f"`state` must be boards, uint8 [B, {self.shape[0]}, {self.shape[1]}], got {got}.")


def flat_boards(state: Tensor) -> Array:
    """Boards `[N, H, W]` as rows of cells for compiled loops, `[N, H * W]`."""
    return np.ascontiguousarray(state.cpu().flatten(1).numpy())


def board_tensor(name: str, boards: Any) -> Tensor:
    """Boards as a tensor; ValueError for what is none."""
    try:
        return torch.as_tensor(boards)
    except (RuntimeError, TypeError, ValueError):
        raise ValueError(f"`{name}` must be a file or boards of one size, got this {type(boards).__name__}.") from None


def reflected(board: Tensor, number: int) -> Tensor:
    """Boards `[N, H, W]` under a symmetry; see `PuzzleWorld.transformed_actions`."""
    if number & 4:
        board = board.transpose(1, 2)
    turned = [dim for bit, dim in ((1, 1), (2, 2)) if number & bit]
    return board.flip(turned).contiguous() if turned else board.contiguous()
