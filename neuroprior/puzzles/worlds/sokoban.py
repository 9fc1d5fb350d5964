"""Sokoban: push all boxes onto goals."""

from collections.abc import Sequence
from itertools import permutations
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_range
from neuroprior._hashing import row_hashes
from neuroprior.puzzles.worlds.puzzle import Observation, PuzzleWorld, board_tensor, reflected
from neuroprior.puzzles.worlds.reading import count_problem, read_sokoban
from neuroprior.puzzles.worlds.windows import Window, Windows, windows_with_mover, windows_within

FLOOR, WALL, GOAL, BOX, BOX_ON_GOAL, PLAYER, PLAYER_ON_GOAL = range(7)

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

MATCHED = 5
"""Up to so many boxes are matched with goals; with more, each goes to its nearest goal."""


class SokobanWorld(PuzzleWorld):
    """Sokoban levels of one size; see `sokoban`.

    A state is a board, uint8 `[B, H, W]`, of cells 0 floor, 1 wall, 2 goal, 3 box, 4 box on goal, 5 player, 6 player on
    goal. In patterns a cell is one of the first five; the player's own counts as what is under it, and what lies beyond
    the board as wall. Planes are walls, goals, boxes and the player.

    Args:
        boards: uint8 `[n, H, W]`.
        windows, observation: see `PuzzleWorld`.

    Raises:
        ValueError: a board is no level; the message says which.
    """

    num_planes = 4

    boards: Tensor

    def __init__(self, boards: Tensor, windows: Sequence[Window], observation: Observation) -> None:
        if boards.dim() != 3 or 0 in boards.shape:
            raise ValueError(f"levels: codes [n, H, W] are expected, not {list(boards.shape)}")
        check_range("levels", boards, PLAYER_ON_GOAL + 1, "codes of cells")
        boards = boards.to(torch.uint8)
        if (wrong := count_problem(boards.cpu().numpy())) is not None:
            raise ValueError(f"levels[{wrong[0]}]: {wrong[1]}")
        shape = boards.shape[1], boards.shape[2]
        super().__init__(boards, shape, Windows(windows, KINDS, WALL), observation)

    @property
    def device(self) -> torch.device:
        return self.boards.device

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """One step; an illegal action, and any action where the level is solved, leaves the state as it is.

        The reward is 1 for the step that solves the level, else 0.
        """
        board, player, offsets = _padded(state)
        first = player + offsets[action]
        second = first + offsets[action]
        here, beside, behind = (board.gather(1, place[:, None])[:, 0] for place in (player, first, second))
        pushes = _is_box(beside)
        moves = (_is_free(beside) | pushes & _is_free(behind)) & ~self.solved(state)
        left = torch.where(here == PLAYER_ON_GOAL, GOAL, FLOOR)
        entered = torch.where((beside == GOAL) | (beside == BOX_ON_GOAL), PLAYER_ON_GOAL, PLAYER)
        pushed = torch.where(behind == GOAL, BOX_ON_GOAL, BOX)
        for place, old, new, changes in (
            (player, here, left, moves),
            (first, beside, entered, moves),
            (second, behind, pushed, moves & pushes),
        ):
            board.scatter_(1, place[:, None], torch.where(changes, new.to(torch.uint8), old)[:, None])
        after = board.view(len(state), state.shape[1] + 4, state.shape[2] + 4)[:, 2:-2, 2:-2].contiguous()
        return after, (moves & self.solved(after)).float()

    def legal_actions(self, state: Tensor) -> Tensor:
        """Moves to a free cell, and pushes of a box to a free cell: `[N, 4]` bool. Where there are none: all."""
        board, player, offsets = _padded(state)
        beside, behind = board.gather(1, player[:, None] + offsets), board.gather(1, player[:, None] + 2 * offsets)
        legal = _is_free(beside) | _is_box(beside) & _is_free(behind)
        return legal | ~legal.any(1, keepdim=True)

    def solved(self, state: Tensor) -> Tensor:
        """Where all boxes are on goals."""
        return ~(state == BOX).flatten(1).any(1)

    def mover(self, state: Tensor) -> Tensor:
        return _player(state.flatten(1))

    def kinds(self, state: Tensor) -> Tensor:
        return state.masked_fill(state == PLAYER, FLOOR).masked_fill(state == PLAYER_ON_GOAL, GOAL)

    def planes(self, state: Tensor) -> Tensor:
        goals = (state == GOAL) | (state == BOX_ON_GOAL) | (state == PLAYER_ON_GOAL)
        return torch.stack([state == WALL, goals, _is_box(state), state >= PLAYER], 1).float()

    def group(self, state: Tensor) -> Tensor:
        """A number of the walls, int64 `[N]`, at least 0: the same for the same walls, in any world of this size."""
        return row_hashes((state == WALL).to(torch.uint8)) & (2**63 - 1)

    def lower_bound(self, state: Tensor) -> Tensor:
        """A lower bound of the number of moves to a solved state, int64 `[N]`: an admissible heuristic.

        Boxes are matched with goals so that the sum of their Manhattan distances is least; with more than 5 boxes it is
        the sum of each box's distance to the nearest goal.
        """
        many = _is_box(state).flatten(1).sum(1) > MATCHED
        if bool(many.any()) and not bool(many.all()):
            bound = torch.zeros(len(state), dtype=torch.long, device=state.device)
            bound[many], bound[~many] = self.lower_bound(state[many]), self.lower_bound(state[~many])
            return bound
        flat = state.flatten(1)
        boxes = _is_box(flat).int()
        goals = ((flat == GOAL) | (flat == BOX_ON_GOAL) | (flat == PLAYER_ON_GOAL)).int()
        most = int(boxes.sum(1).max()) if len(state) else 0
        (is_box, box), (is_goal, goal) = boxes.topk(most), goals.topk(most)
        width, far = state.shape[2], state.shape[1] + state.shape[2]
        distance = (box[:, :, None] // width - goal[:, None] // width).abs()
        distance = distance + (box[:, :, None] % width - goal[:, None] % width).abs()
        # Levels with fewer boxes are filled up with boxes and goals that can only be matched with one another.
        both, neither = is_box[:, :, None] * is_goal[:, None], (1 - is_box[:, :, None]) * (1 - is_goal[:, None])
        distance = distance * both + far * most * (1 - both - neither)
        if most > MATCHED:
            return distance.amin(2).sum(1)
        orders = torch.tensor(list(permutations(range(most))), dtype=torch.long, device=state.device)
        return distance[:, torch.arange(most, device=state.device), orders].sum(2).amin(1)

    def check_state(self, state: Tensor) -> None:
        super().check_state(state)
        check_range("state", state, PLAYER_ON_GOAL + 1, "codes of cells")
        of_player, of_box, of_goal = state >= PLAYER, state == BOX, (state == GOAL) | (state == PLAYER_ON_GOAL)
        players, missing = of_player.flatten(1).sum(1), of_box.flatten(1).sum(1) - of_goal.flatten(1).sum(1)
        wrong = ((players != 1) | (missing != 0)).nonzero()
        if len(wrong):
            raise ValueError(
                f"state[{int(wrong[0])}]: a board with one player, and as many boxes as goals, is expected"
            )

    def symmetries(self) -> int:
        """Eight for square boards, else four."""
        return 8 if self.shape[0] == self.shape[1] else 4

    def transformed(self, state: Tensor, number: int) -> Tensor:
        return reflected(state, number)


def sokoban(
    levels: Any, *, observation: Observation = "patterns", windows: Sequence[Window] = SOKOBAN_WINDOWS
) -> SokobanWorld:
    """Sokoban: a player pushes boxes, one at a time, onto goals.

    Args:
        levels: a file of levels (see `read_sokoban`), a list of level texts, or boards `[n, H, W]`, see `SokobanWorld`.
        observation: see `PuzzleWorld`.
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
            raise ValueError(f"levels: one in each of {len(levels)} texts is expected, not {len(boards)} together")
    else:
        boards = board_tensor("levels", levels)
    return SokobanWorld(boards, windows, observation)


def _player(flat: Tensor) -> Tensor:
    """int64 `[N]`: the player's cell in `flat [N, H * W]`."""
    return (flat >= PLAYER).to(torch.uint8).argmax(1)


def _padded(state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Boards `[N, (H + 4) * (W + 4)]` within two rows of wall, the player's cell `[N]`, and the four moves `[4]`."""
    board = torch.nn.functional.pad(state, (2, 2, 2, 2), value=WALL)
    width = board.shape[2]
    flat = board.flatten(1)
    return flat, _player(flat), torch.tensor([-width, width, -1, 1], device=state.device)


def _is_box(cells: Tensor) -> Tensor:
    return (cells == BOX) | (cells == BOX_ON_GOAL)


def _is_free(cells: Tensor) -> Tensor:
    return (cells == FLOOR) | (cells == GOAL)
