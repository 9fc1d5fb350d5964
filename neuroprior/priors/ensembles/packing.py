"""Several state tensors in one: a prior made of other priors holds their states side by side."""

from math import prod

import torch
from torch import Tensor

DIGITS = 2**24
"""Up to here float32 represents every integer; larger ones, up to its square, are stored as two numbers."""

MOST_DIMENSIONS = 4
"""Dimensions of a part, beside the batch."""

HEADER = 2 + MOST_DIMENSIONS
"""Numbers that describe each part: its kind (1 for integers, 2 for bool), its number of dimensions, and these."""


def pack(parts: list[Tensor]) -> Tensor:
    """States `[N, ...]` as one tensor `[N, K]`, float32.

    Args:
        parts: floating point, bool, or integers from 0 to 2**48 - 1; sizes may differ, and change from step to step.

    Raises:
        ValueError: a part has more than `MOST_DIMENSIONS` dimensions beside the batch.
    """
    heads, bodies = [], []
    for part in parts:
        sizes = part.shape[1:]
        if len(sizes) > MOST_DIMENSIONS:
            raise ValueError(f"state: at most {MOST_DIMENSIONS} dimensions beside the batch are kept, not {len(sizes)}")
        kind = 2 if part.dtype == torch.bool else int(not part.is_floating_point())
        heads += [kind, len(sizes), *sizes, *[0] * (MOST_DIMENSIONS - len(sizes))]
        flat = part.reshape(len(part), prod(sizes))
        bodies += (
            [flat.div(DIGITS, rounding_mode="floor").float(), (flat % DIGITS).float()] if kind == 1 else [flat.float()]
        )
    head = torch.tensor(heads, device=parts[0].device).float().expand(len(parts[0]), len(heads))
    return torch.cat([head, *bodies], 1)


def unpack(packed: Tensor, number: int) -> list[Tensor]:
    """The `number` parts that were packed; for an empty batch, empty parts of unknown size.

    Args:
        packed: `[N, K]`; all rows were packed together, or of the same sizes.
        number: of parts.
    """
    if len(packed) == 0:
        return [packed[:, :0]] * number
    heads = packed[0, : HEADER * number].long().view(number, HEADER).tolist()
    at, parts = HEADER * number, []
    for kind, dimensions, *sizes in heads:
        shape = sizes[:dimensions]
        size = prod(shape)
        body = packed[:, at : at + size * (1 + (kind == 1))]
        at += body.shape[1]
        if kind == 1:
            body = body[:, :size].long() * DIGITS + body[:, size:].long()
        elif kind == 2:
            body = body.bool()
        parts.append(body.reshape(len(packed), *shape))
    return parts
