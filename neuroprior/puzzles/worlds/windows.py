"""Patterns: what lies in small windows around the mover of a puzzle, each pattern one number."""

from collections.abc import Sequence

import torch
from torch import Tensor

Window = tuple[int, int, int, int]
"""The row and column of its first cell, counted from the mover, its height and its width."""

CODES = 2**31
"""Patterns are numbered below this."""

FURTHEST = 256
"""Rows or columns that windows may reach from the mover, or be high or wide."""


def windows_within(height: int, width: int, distance: int) -> tuple[Window, ...]:
    """All windows of a size whose cells are at most `distance` rows and columns from the mover.

    Args:
        height, width: of the windows.
        distance: in rows and columns.

    Example:
        >>> windows_within(3, 3, distance=1)
        ((-1, -1, 3, 3),)
    """
    rows = range(-distance, distance - height + 2)
    columns = range(-distance, distance - width + 2)
    return tuple((row, column, height, width) for row in rows for column in columns)


def windows_with_mover(height: int, width: int) -> tuple[Window, ...]:
    """All windows of a size that hold the mover's cell.

    Args:
        height, width: of the windows.

    Example:
        >>> len(windows_with_mover(2, 2))
        4
    """
    return tuple((row, column, height, width) for row in range(1 - height, 1) for column in range(1 - width, 1))


class Windows:
    """Numbers what lies in windows: a cell is of one of `base` kinds, a pattern what a window's cells are.

    The code of window k is `offsets[k]` plus the kinds of its cells, row by row, as a number to the base `base`, the
    first cell counting most; offsets keep windows apart.

    Args:
        windows: see `Window`.
        base: number of kinds.
        outside: the kind of what lies outside of the board.

    Attributes:
        num_codes: all codes are below it.
        radius: the rows or columns that windows reach away from the mover.
        offsets: int64 `[F]`.

    Raises:
        ValueError: there are no windows, one of them is none, or they have 2**31 patterns or more together.

    Example:
        >>> Windows(((0, 0, 2, 2),), base=3, outside=2).windows
        ((0, 0, 2, 2),)
    """

    def __init__(self, windows: Sequence[Window], base: int, outside: int) -> None:
        self.windows, self.base, self.outside = tuple(windows), base, outside
        if not self.windows:
            raise ValueError("windows: at least one is expected")
        for k, window in enumerate(self.windows):
            whole = (
                isinstance(window, Sequence) and len(window) == 4 and all(isinstance(number, int) for number in window)
            )
            if not whole or min(window[2:]) < 1 or max(map(abs, window)) > FURTHEST:
                raise ValueError(
                    f"windows[{k}]: integers (row, column, height, width) are expected, height and width at least 1 and"
                    f" none beyond {FURTHEST}, not {window!r}"
                )
        sizes = [base ** (height * width) for _, _, height, width in self.windows]
        self.num_codes = sum(sizes)
        if self.num_codes >= CODES:
            raise ValueError(
                f"windows: they have {self.num_codes:,} patterns of {base} kinds of cells; fewer than 2**31 are"
                " expected: take smaller or fewer windows"
            )
        self.offsets = torch.tensor([0, *sizes]).cumsum(0)[:-1]
        self.radius = max(
            max(-row, -column, row + height - 1, column + width - 1) for row, column, height, width in self.windows
        )
        # In the square around the mover, the cells of each window from its first; before them one that adds nothing.
        side, most = 2 * self.radius + 1, max(height * width for _, _, height, width in self.windows)
        self._cells = torch.full((most, len(self.windows)), side**2)
        for k, (row, column, height, width) in enumerate(self.windows):
            first = (self.radius + row) * side + self.radius + column
            own = first + torch.arange(height)[:, None] * side + torch.arange(width)
            self._cells[most - height * width :, k] = own.flatten()

    def codes(self, kinds: Tensor, row: Tensor, column: Tensor) -> Tensor:
        """The patterns around the mover.

        Args:
            kinds: integers `[N, H, W]` below `base`.
            row, column: int64 `[N]`: where the mover is.

        Returns:
            int32 `[N, F]`.
        """
        reach, device = self.radius, kinds.device
        around, each = torch.arange(2 * reach + 1, device=device), torch.arange(len(kinds), device=device)
        padded = torch.nn.functional.pad(kinds.int(), (reach,) * 4, value=self.outside)
        rows, columns = row[:, None] + around, column[:, None] + around
        square = padded[each[:, None, None], rows[:, :, None], columns[:, None, :]].flatten(1)
        square = torch.nn.functional.pad(square, (0, 1))  # and a cell of kind 0
        first, *others = self._cells.to(device)
        out = square.index_select(1, first)
        for cells in others:
            out.mul_(self.base).add_(square.index_select(1, cells))
        return out.add_(self.offsets.to(device, torch.int32))
