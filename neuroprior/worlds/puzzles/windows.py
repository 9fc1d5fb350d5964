"""Patterns of Sokoban: what rectangles of cells around the player look like, as numbers."""

from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor

Window = tuple[int, int, int, int]
"""`(dy, dx, h, w)`: h x w cells, the top left one at the player's row + dy and column + dx."""

NUM_KINDS = 5
"""Kinds of cells: 0 floor, 1 wall, 2 goal, 3 box, 4 box on goal."""


def windows_within(h: int, w: int, distance: int) -> tuple[Window, ...]:
    """All h x w windows whose cells are at most `distance` rows and columns from the player, in row-major order."""
    return tuple(
        (dy, dx, h, w) for dy, dx in product(range(-distance, distance - h + 2), range(-distance, distance - w + 2))
    )


def _windows_holding(h: int, w: int) -> tuple[Window, ...]:
    """All h x w windows that hold the player's cell, in row-major order."""
    return tuple((dy, dx, h, w) for dy, dx in product(range(1 - h, 1), range(1 - w, 1)))


SOKOBAN_WINDOWS: tuple[Window, ...] = (
    *windows_within(3, 3, 4),
    *windows_within(4, 2, 3),
    *windows_within(2, 4, 3),
    *_windows_holding(2, 2),
    *_windows_holding(1, 2),
    *_windows_holding(2, 1),
)
"""The windows of a Sokoban world where none are given: much like those of Orseau, Hutter and Lelis (IJCAI 2023)."""


class WindowCodes:
    """The codes of the patterns in windows; see `SokobanWorld.observe`.

    Attributes:
        radius: how many rows or columns from the player the windows reach.
        num_codes: codes are below it.
        weights: float64 `[(2 * radius + 1)**2, F]`: the power of 5 by which each cell counts in each window.
        offsets: int64 `[F]`: the first code of each window.

    Raises:
        ValueError: there is no window, one has no cells, or there are 2**31 codes or more.
    """

    def __init__(self, windows: Sequence[Window]) -> None:
        if not windows or any(len(window) != 4 or min(window[2:]) < 1 for window in windows):
            raise ValueError("windows: one or more (dy, dx, h, w) with h and w of at least 1 are expected")
        sizes = [NUM_KINDS ** (h * w) for _, _, h, w in windows]
        self.num_codes = sum(sizes)
        if self.num_codes >= 2**31:
            raise ValueError(
                f"windows: they have {self.num_codes:,} codes, 5**(h * w) each, together; fewer than 2**31 are expected"
            )
        self.radius = max(max(abs(dy), abs(dy + h - 1), abs(dx), abs(dx + w - 1)) for dy, dx, h, w in windows)
        self.offsets = torch.tensor([0, *sizes[:-1]]).cumsum(0)
        side = 2 * self.radius + 1
        weights = torch.zeros(side, side, len(windows), dtype=torch.float64)
        for k, (dy, dx, h, w) in enumerate(windows):
            top, left = self.radius + dy, self.radius + dx
            powers = NUM_KINDS ** torch.arange(h * w - 1, -1, -1)
            weights[top : top + h, left : left + w, k] = powers.view(h, w).double()
        self.weights = weights.flatten(0, 1)

    def __call__(self, kinds: Tensor, row: Tensor, column: Tensor) -> Tensor:
        """int32 `[N, F]`: the codes in boards of `kinds [N, H, W]`, around `row [N]` and `column [N]`."""
        around = torch.nn.functional.pad(kinds, (self.radius,) * 4, value=1)
        near = torch.arange(2 * self.radius + 1, device=kinds.device)
        place = ((row[:, None] + near) * around.shape[2])[:, :, None] + (column[:, None] + near)[:, None]
        crop = around.flatten(1).gather(1, place.flatten(1))
        # Float64 is exact here: all sums are whole numbers below 2**31.
        return ((crop.double() @ self.weights.to(kinds.device)).long() + self.offsets.to(kinds.device)).int()
