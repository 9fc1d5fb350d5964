"""Several state tensors in one: a prior made of others keeps their states side by side."""

from math import prod

import torch
from torch import Tensor

DIGITS = 2**24
"""Up to here float32 holds every integer: larger ones, up to its square, are kept as two numbers."""

HEADER = 3
"""Numbers that tell what each part is: 1 for integers, and its second and third dimension (0: there is none)."""


def pack(parts: list[Tensor]) -> Tensor:
    """States `[N]`, `[N, M]` or `[N, M, D]` as one tensor `[N, K]`, float32.

    Args:
        parts: floating point, or integers from 0 to 2**48 - 1; sizes may differ, and change from step to step.
    """
    heads, bodies = [], []
    for part in parts:
        whole = not part.is_floating_point()
        sizes = [*part.shape[1:], 0, 0][:2]
        heads += [float(whole), *map(float, sizes)]
        flat = part.reshape(len(part), -1) if part.numel() else part.new_zeros(len(part), 0)
        bodies += (
            [flat.div(DIGITS, rounding_mode="floor").float(), (flat % DIGITS).float()] if whole else [flat.float()]
        )
    head = torch.tensor(heads, device=parts[0].device).expand(len(parts[0]), len(heads))
    return torch.cat([head, *bodies], 1)


def unpack(packed: Tensor, number: int) -> list[Tensor]:
    """The `number` parts that were packed; of an empty batch empty ones of unknown size.

    Args:
        packed: `[N, K]`; all rows were packed together, or of the same sizes.
        number: of parts.
    """
    if len(packed) == 0:
        return [packed[:, :0]] * number
    heads = packed[0, : HEADER * number].long().tolist()
    at, parts = HEADER * number, []
    for kind, *sizes in zip(heads[::3], heads[1::3], heads[2::3], strict=True):
        shape = [size for size in sizes if size] or ([] if kind else [0])
        size = prod(shape)
        body = packed[:, at : at + size * (1 + kind)]
        at += size * (1 + kind)
        if kind:
            body = body[:, :size].long() * DIGITS + body[:, size:].long()
        parts.append(body.reshape(len(packed), *shape))
    return parts
