"""Numbers that stand for the rows of a tensor, by which equal rows are found without comparing rows."""

import torch
from torch import Tensor


def row_hashes(rows: Tensor) -> Tensor:
    """A number for each of `rows [M, ...]`, int64 `[M]`: the same for the same row, and hardly ever for another.

    Two different rows have the same number once in about 2**63 times; integers `[M]` are their own numbers.
    """
    if rows.dim() == 1 and not rows.is_floating_point():
        return rows.long()
    # Numbers are compared by their bits (the sum makes 0.0 of -0.0); rows are hashed by a sum with random odd weights.
    flat = rows[:, None] if rows.dim() == 1 else rows.flatten(1)
    bits = (flat.double() + 0.0).view(torch.int64) if flat.is_floating_point() else flat.long()
    weight = torch.Generator().manual_seed(0)
    factors = torch.randint(-(2**62), 2**62, (bits.shape[1],), generator=weight).to(bits.device) * 2 + 1
    mixed = (bits ^ _shift(bits, 29)) * factors
    return (mixed ^ _shift(mixed, 32)).sum(1)


def _shift(bits: Tensor, places: int) -> Tensor:
    """Bits shifted to the right; zeros come from the left, also into negative numbers."""
    return (bits >> places) & ((1 << (64 - places)) - 1)
