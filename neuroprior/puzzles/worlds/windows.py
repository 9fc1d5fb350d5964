"""Patterns: what lies in small windows around the mover of a puzzle, each pattern one number."""

from collections.abc import Sequence
from itertools import accumulate

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

    Attributes:
        num_codes: all codes are below it.
        radius: the rows or columns that windows reach away from the mover.
        offsets: the code of each window whose cells are all of kind 0.

    Raises:
        ValueError: there are no windows, one of them is none, or they have 2**31 patterns or more together.

    Example:
        >>> Windows(((0, 0, 2, 2), (0, 0, 1, 1)), base=3).offsets
        (0, 81)
    """

    def __init__(self, windows: Sequence[Window], base: int) -> None:
        self.windows, self.base = tuple(windows), base
        if not self.windows:
            raise ValueError("`windows` must hold at least one window, got none.")
        for k, window in enumerate(self.windows):
            whole = isinstance(window, Sequence) and len(window) == 4 and all(isinstance(n, int) for n in window)
            if not whole or min(window[2:]) < 1 or max(map(abs, window)) > FURTHEST:
                raise ValueError(
                    f"`windows[{k}]` must be integers (row, column, height, width), height and width at least 1 and"
                    f" none beyond {FURTHEST}, got {window!r}."
                )
        sizes = [base ** (height * width) for _, _, height, width in self.windows]
        *offsets, self.num_codes = accumulate(sizes, initial=0)
        self.offsets = tuple(offsets)
        if self.num_codes >= CODES:
            raise ValueError(
                f"`windows` must have fewer than 2**31 patterns, got {self.num_codes:,} of {base} kinds of cells."
                " Take smaller or fewer windows."
            )
        self.radius = max(
            max(-row, -column, row + height - 1, column + width - 1) for row, column, height, width in self.windows
        )
