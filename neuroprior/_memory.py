"""New memory for large tensors."""

import numpy as np
import torch
from torch import Tensor

LARGE = 2**25
"""Bytes from which memory that was freed is given back to Linux, so that all of it is new each time."""


def new_empty(shape: tuple[int, ...], like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """An uninitialised tensor on the device of `like`, and of its dtype unless another is given.

    Large ones on a CPU are allocated by numpy, whose large pages are there several times as soon as the many small ones
    that torch asks for.
    """
    dtype = like.dtype if dtype is None else dtype
    size = torch.Size(shape)
    if like.device.type != "cpu" or size.numel() * dtype.itemsize < LARGE:
        return torch.empty(size, dtype=dtype, device=like.device)
    return torch.from_numpy(np.empty(size.numel() * dtype.itemsize, np.uint8)).view(dtype).view(size)
