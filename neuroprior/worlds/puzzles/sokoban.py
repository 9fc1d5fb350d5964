"""Sokoban: boxes are pushed onto goals."""

from collections.abc import Sequence
from itertools import permutations
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_range
from neuroprior._hashing import row_hashes
from neuroprior._random import generator_on
from neuroprior.worlds.puzzles.reading import count_problem, read_sokoban
from neuroprior.worlds.puzzles.windows import SOKOBAN_WINDOWS, Window, WindowCodes
from neuroprior.worlds.world import World

FLOOR, WALL, GOAL, BOX, BOX_ON_GOAL, PLAYER, PLAYER_ON_GOAL = range(7)
_MOST_MATCHED = 5  # boxes: 120 permutations


class SokobanWorld(World):
    """Sokoban levels; see `sokoban`.

    A state is the board, uint8 `[H, W]`: 0 floor, 1 wall, 2 goal, 3 box, 4 box on goal, 5 player, 6 player on goal;
    beyond the board is wall. A solved board stays as it is.

    Attributes:
        boards: uint8 `[n, H, W]`: the levels.
        observation: "patterns" or "board".
        windows: those of the patterns.
        num_codes: the codes of the patterns are below it.
    """

    num_actions = 4
    action_names = ("up", "down", "left", "right")
    all_legal = False
    has_goal = True

    def __init__(self, boards: Tensor, observation: Literal["patterns", "board"], windows: Sequence[Window]) -> None:
        if observation not in ("patterns", "board"):
            raise ValueError(f'sokoban: observation must be "patterns" or "board", not {observation!r}')
        if boards.dim() != 3 or 0 in boards.shape:
            raise ValueError(f"levels: shape [n, H, W] is expected, none of them 0, not {list(boards.shape)}")
        check_range("levels", boards, 7, "codes of cells")
        self.boards, self.observation, self.windows = boards.to(torch.uint8), observation, tuple(windows)
        if (wrong := count_problem(self.boards.numpy(force=True))) is not None:
            raise ValueError(f"levels[{wrong[0]}]: {wrong[1]}")
        self._codes = WindowCodes(self.windows)
        self.num_codes = self._codes.num_codes

    @property
    def device(self) -> torch.device:
        """Where the levels are."""
        return self.boards.device

    def to(self, device: torch.device | str) -> "SokobanWorld":
        """Move the levels to `device`; returns self."""
        self.boards = self.boards.to(device)
        return self

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """Random levels, uint8 `[batch_size, H, W]`."""
        check_count("batch_size", batch_size, self.boards[0].numel())
        generator = generator_on(generator, self.device)
        return self.boards[torch.randint(len(self.boards), (batch_size,), generator=generator, device=self.device)]

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

    def terminated(self, state: Tensor) -> Tensor:
        """Where the level is solved."""
        return self.solved(state)

    def group(self, state: Tensor) -> Tensor:
        """A number of the walls, int64 `[N]`, at least 0: the same for the same walls, in any world of this size."""
        return row_hashes((state == WALL).to(torch.uint8)) & (2**63 - 1)

    def observe(self, state: Tensor) -> Tensor:
        """What `observation` says.

        "board": float32 `[N, 4 * H * W]`: where there are walls, goals, boxes and the player, one plane after another.

        "patterns": int32 `[N, F]`, one code for each of F windows. The cells of a window, row by row, are the digits
        of a number in base 5, the first one counting most: 0 floor, 1 wall (and whatever is beyond the board), 2 goal,
        3 box, 4 box on goal; the player's own cell counts as what is under it. To that number the sum of
        5**(h * w) over the windows before is added, so that no two windows share a code.
        """
        if self.observation == "board":
            goals = (state == GOAL) | (state == BOX_ON_GOAL) | (state == PLAYER_ON_GOAL)
            return torch.stack([state == WALL, goals, _is_box(state), state >= PLAYER], 1).flatten(1).float()
        kinds = state.masked_fill(state == PLAYER, FLOOR).masked_fill(state == PLAYER_ON_GOAL, GOAL)
        player, width = _player(state.flatten(1)), state.shape[2]
        return self._codes(kinds, player // width, player % width)

    def lower_bound(self, state: Tensor) -> Tensor:
        """A lower bound of the number of moves to a solved state, int64 `[N]`: an admissible heuristic.

        Boxes are matched with goals so that the sum of their Manhattan distances is least, where no level of the batch
        has more than 5 boxes; else it is the sum of each box's distance to the nearest goal.
        """
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
        if most > _MOST_MATCHED:
            return distance.amin(2).sum(1)
        orders = torch.tensor(list(permutations(range(most))), dtype=torch.long, device=state.device)
        return distance[:, torch.arange(most, device=state.device), orders].sum(2).amin(1)

    def check_state(self, state: Tensor) -> None:
        size = list(self.boards.shape[1:])
        if not isinstance(state, Tensor) or state.dtype != torch.uint8 or list(state.shape[1:]) != size:
            raise ValueError(f"state: uint8 of shape [B, {size[0]}, {size[1]}] is expected: boards")
        wrong = ((state >= PLAYER).flatten(1).sum(1) != 1).nonzero()
        if len(wrong):
            raise ValueError(f"state[{int(wrong[0])}]: a board with one player is expected")


def sokoban(
    levels: Any,
    *,
    observation: Literal["patterns", "board"] = "patterns",
    windows: Sequence[Window] | None = None,
) -> SokobanWorld:
    """Sokoban: a player pushes boxes, one at a time, onto goals.

    Args:
        levels: a file of levels (see `read_sokoban`), a list of level texts, or codes of cells `[n, H, W]`: 0 floor,
            1 wall, 2 goal, 3 box, 4 box on goal, 5 player, 6 player on goal.
        observation: "patterns": codes of what windows around the player look like; "board": the whole board. See
            `SokobanWorld.observe`.
        windows: of the patterns, `(dy, dx, h, w)` each; None: `SOKOBAN_WINDOWS`.

    Raises:
        ValueError: a level is none, or an argument is out of range; the message says which.
    """
    if isinstance(levels, str | Path):
        boards = torch.from_numpy(read_sokoban(levels))
    elif isinstance(levels, list | tuple) and all(isinstance(level, str) for level in levels):
        boards = torch.from_numpy(read_sokoban("\n;\n".join(["", *levels])))
    else:
        boards = torch.as_tensor(levels)
    return SokobanWorld(boards, observation, SOKOBAN_WINDOWS if windows is None else windows)


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
