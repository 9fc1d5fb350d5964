"""Sokoban: push all boxes onto goals."""

from collections.abc import Sequence
from itertools import permutations
from pathlib import Path

import torch
from torch import Tensor

from neuroprior._hashing import row_hashes
from neuroprior.worlds.puzzles.files import read_sokoban
from neuroprior.worlds.puzzles.puzzle import STEPS, Observation, PuzzleWorld, reflected
from neuroprior.worlds.puzzles.windows import Window, Windows, windows_with_mover, windows_within

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
"""Up to so many boxes are matched with goals in the heuristic; with more, each goes to its nearest goal."""


class SokobanWorld(PuzzleWorld):
    """Sokoban levels of one size; see `sokoban`. A state is a board, uint8 `[B, H, W]`, its cells 0 floor, 1 wall,
    2 goal, 3 box, 4 box on a goal, 5 player, 6 player on a goal."""

    num_planes = 4

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        before = self.solved(state)
        possible, mover, there, behind = self._moves(state)
        row = torch.arange(len(state), device=state.device)
        able = possible[row, action] & ~before
        flat = state.flatten(1).clone()
        rows, at, to, beyond = row[able], mover[able], there[row, action][able], behind[row, action][able]
        pushed = _boxes(flat[rows, to])
        self._place(flat, rows[pushed], beyond[pushed], BOX)
        flat[rows[pushed], to[pushed]] -= BOX - FLOOR - (flat[rows[pushed], to[pushed]] == BOX_ON_GOAL).to(torch.uint8)
        flat[rows, at] = torch.where(flat[rows, at] == PLAYER_ON_GOAL, GOAL, FLOOR).to(torch.uint8)
        self._place(flat, rows, to, PLAYER)
        after = flat.view_as(state)
        return after, (self.solved(after) & ~before).float()

    def _place(self, flat: Tensor, rows: Tensor, cells: Tensor, what: int) -> None:
        """Put a box or the player on floor or goal."""
        on_goal = (flat[rows, cells] == GOAL).to(torch.uint8)
        flat[rows, cells] = what + on_goal

    def _moves(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Which moves can be made, bool `[N, 4]`; the player's cell `[N]`, that it would enter and the next `[N, 4]`."""
        height, width = state.shape[1:]
        flat, mover = state.flatten(1), self.mover(state)
        y, x = mover.div(width, rounding_mode="floor"), mover % width
        cells, kinds = [], []
        for far in (1, 2):
            to_y = torch.stack([y + far * dy for dy, _ in STEPS], 1)
            to_x = torch.stack([x + far * dx for _, dx in STEPS], 1)
            inside = (to_y >= 0) & (to_y < height) & (to_x >= 0) & (to_x < width)
            cell = (to_y * width + to_x).where(inside, 0)
            cells.append(cell)
            kinds.append(flat.gather(1, cell).where(inside, WALL))
        free = (kinds[0] == FLOOR) | (kinds[0] == GOAL)
        push = _boxes(kinds[0]) & ((kinds[1] == FLOOR) | (kinds[1] == GOAL))
        return free | push, mover, *cells

    def legal_actions(self, state: Tensor) -> Tensor:
        """Moves onto a free cell, and pushes of a box onto one; all where there are none at all, to no effect."""
        possible = self._moves(state)[0]
        return possible | ~possible.any(1, keepdim=True)

    def solved(self, state: Tensor) -> Tensor:
        return ~(state == BOX).flatten(1).any(1)

    def mover(self, state: Tensor) -> Tensor:
        return (state >= PLAYER).flatten(1).long().argmax(1)

    def kinds(self, state: Tensor) -> Tensor:
        under = torch.tensor([FLOOR, WALL, GOAL, BOX, BOX_ON_GOAL, FLOOR, GOAL], device=state.device)
        return under[state.long()]

    def planes(self, state: Tensor) -> Tensor:
        """Walls, goals, boxes and the player."""
        goal = (state == GOAL) | (state == BOX_ON_GOAL) | (state == PLAYER_ON_GOAL)
        return torch.stack([state == WALL, goal, _boxes(state), state >= PLAYER], 1).float()

    def lower_bound(self, state: Tensor) -> Tensor:
        """The pushes of the cheapest matching of boxes with goals, in rows and columns; walls and other boxes ignored.

        With more than 5 boxes each goes to its nearest goal.
        """
        number, width = len(state), state.shape[2]
        flat = state.flatten(1)
        boxes, goals = _boxes(flat), (flat == GOAL) | (flat == BOX_ON_GOAL) | (flat == PLAYER_ON_GOAL)
        if number == 0:
            return torch.zeros(0, dtype=torch.long, device=state.device)
        most = int(boxes.sum(1).max())
        if most == 0:
            return torch.zeros(number, dtype=torch.long, device=state.device)
        box, there = _places(boxes, most)
        goal, wanted = _places(goals, int(goals.sum(1).max()))
        dy = (box.div(width, rounding_mode="floor")[:, :, None] - goal.div(width, rounding_mode="floor")[:, None]).abs()
        distance = dy + (box[:, :, None] % width - goal[:, None] % width).abs()
        far = distance.shape[2] * 2 * max(state.shape[1:]) + 1
        distance = distance.masked_fill(~wanted[:, None], far).masked_fill(~there[:, :, None], 0)
        if most > MATCHED or goal.shape[1] > MATCHED + 1:
            return distance.amin(2).sum(1)
        matchings = torch.tensor(list(permutations(range(goal.shape[1]), most)), device=state.device)
        every = distance[:, torch.arange(most, device=state.device), matchings]  # [N, matchings, boxes]
        return every.sum(-1).amin(1)

    def group(self, state: Tensor) -> Tensor:
        """The number of the level's walls: levels with the same walls have the same number."""
        return row_hashes((state == WALL).flatten(1))

    def symmetries(self) -> int:
        """Eight for square boards, else four."""
        return 8 if self.boards.shape[1] == self.boards.shape[2] else 4

    def transformed(self, state: Tensor, number: int) -> Tensor:
        return reflected(state, number)


def sokoban(
    levels: Tensor | Sequence[str] | str | Path,
    *,
    observation: Observation = "patterns",
    windows: Sequence[Window] = SOKOBAN_WINDOWS,
) -> SokobanWorld:
    """Sokoban: a player pushes boxes onto goals, up, down, left or right; it never pulls.

    Args:
        levels: uint8 boards `[n, H, W]` (see `SokobanWorld`), the path of a file, or texts of levels; see `read_sokoban`.
        observation, windows: what is observed, see `PuzzleWorld`.

    Raises:
        ValueError: a level is none; the message says which and why.
        OSError: the file cannot be read.
    """
    boards = levels if isinstance(levels, Tensor) else read_sokoban(levels)
    if boards.dim() != 3 or boards.dtype != torch.uint8 or len(boards) == 0:
        raise ValueError(f"levels: uint8 boards [n, H, W] are expected, not {boards.dtype} {list(boards.shape)}")
    for what, wrong in (
        ("a cell above 6", (boards > PLAYER_ON_GOAL).flatten(1).any(1)),
        ("not exactly one player", (boards >= PLAYER).flatten(1).sum(1) != 1),
        ("more boxes than goals", _boxes(boards).flatten(1).sum(1) > _goals(boards).flatten(1).sum(1)),
    ):
        if bool(wrong.any()):
            raise ValueError(f"levels[{int(wrong.nonzero()[0])}]: {what}")
    return SokobanWorld(boards, Windows(windows, KINDS, WALL), observation)


def _boxes(cells: Tensor) -> Tensor:
    return (cells == BOX) | (cells == BOX_ON_GOAL)


def _goals(cells: Tensor) -> Tensor:
    return (cells == GOAL) | (cells == BOX_ON_GOAL) | (cells == PLAYER_ON_GOAL)


def _places(marked: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """The numbers `[N, most]` of the marked cells of each row `[N, cells]`, and which of these numbers count."""
    order = marked.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :most]
    return order, marked.gather(1, order)
