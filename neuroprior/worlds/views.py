"""What an agent sees around itself in a grid: which squares are free."""

from typing import Literal

import torch
from torch import Tensor


def check_view(view: int | None) -> None:
    """Raise ValueError unless `view` is a radius of at least 1, or None."""
    if view is not None and (isinstance(view, bool) or not isinstance(view, int) or view < 1):
        raise ValueError(f"view: a radius of at least 1 square is expected, not {view!r}")


def view_table(walls: Tensor, edges: Literal["wall", "torus"], radius: int, egocentric: bool) -> Tensor:
    """Which squares around each cell are free.

    Args:
        walls: bool `[M, H, W]`.
        edges: what is beyond the edge: "wall": walls. "torus": the other side.
        radius: how many squares are seen in each direction.
        egocentric: the agent has one of four headings in each square, and what is before it comes first.

    Returns:
        Bool `[M * H * W, C]`, with headings `[M * H * W * 4, C]`: C = (2 * radius + 1) ** 2 - 1 squares, row by row
        from the top left (seen along the heading), without the agent's own.
    """
    _, height, width = walls.shape
    size = 2 * radius + 1
    if edges == "torus":
        rows, columns = (torch.arange(-radius, n + radius, device=walls.device) % n for n in (height, width))
        free = ~walls[:, rows[:, None], columns]
    else:
        free = torch.nn.functional.pad(~walls, [radius] * 4)
    seen = free.unfold(1, size, 1).unfold(2, size, 1).reshape(-1, size, size)
    if egocentric:
        seen = torch.stack([seen.rot90(heading, (1, 2)) for heading in range(4)], 1)
    seen = seen.reshape(-1, size * size)
    return torch.cat([seen[:, : size * size // 2], seen[:, size * size // 2 + 1 :]], 1)
