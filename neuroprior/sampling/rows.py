"""Rows of tensors, moved as single integers where they are short."""

import torch
from torch import Tensor

WIDE = {2: torch.int16, 4: torch.int32, 8: torch.int64}
"""Integers by their bytes."""


def rows_of(values: Tensor, row: Tensor) -> Tensor:
    """Returns the rows `row [M]` of `values [N, ...]`; several times as fast as `values[row]` for long rows."""
    if values.dim() == 2 and values.is_contiguous() and values.storage_offset() == 0 and not values.requires_grad:
        # A row of as many bytes as an integer is moved as one.
        whole = WIDE.get(values.shape[1] * values.element_size())
        if whole is not None and values.shape[1] > 1:
            return rows_of(values.view(whole).view(-1), row).view(values.dtype).view(-1, values.shape[1])
    return values.index_select(0, row)
