"""Moving little memory: rows moved as single integers, and spare room behind states that grow with each step."""

import torch
from torch import Tensor

WIDE = {2: torch.int16, 4: torch.int32, 8: torch.int64}
"""Integers by their bytes."""

MARK = "room_to_advance"
"""Attribute of tensors that were allocated with spare room, for states that are overwritten."""


def rows_of(values: Tensor, row: Tensor) -> Tensor:
    """The rows `row [M]` of `values [N, ...]`; several times as fast as `values[row]` for long rows.

    Rows of states with spare room get as much room again.
    """
    base = values._base
    if base is None or values.dim() != 2 or extended(values, values.shape[1]) is None:
        return _selected(values, row)
    taken = _selected(base, row)
    setattr(taken, MARK, True)
    return taken[:, : values.shape[1]]


def _selected(values: Tensor, row: Tensor) -> Tensor:
    if values.dim() == 2 and values.is_contiguous() and values.storage_offset() == 0 and not values.requires_grad:
        # A row of as many bytes as an integer is moved as one.
        whole = WIDE.get(values.shape[1] * values.element_size())
        if whole is not None and values.shape[1] > 1:
            return _selected(values.view(whole).view(-1), row).view(values.dtype).view(-1, values.shape[1])
    return values.index_select(0, row)


def states_with_room(like: Tensor, size: int, room: int) -> Tensor:
    """Uninitialised states `[N, size]`, like `like [N, ...]`, with room for `room` more numbers in each row."""
    taken = like.new_empty(len(like), size + room)
    setattr(taken, MARK, True)
    return taken[:, :size]


def extended(state: Tensor, size: int) -> Tensor | None:
    """`state [N, ...]` together with its spare room, `[N, size]`; None where it has not so much room."""
    base = state._base
    if (
        base is None
        or not getattr(base, MARK, False)
        or state.storage_offset() != 0
        or state.stride() != base.stride()
        or len(state) != len(base)
        or base.shape[1] < size
    ):
        return None
    return state.as_strided((len(state), size), state.stride())
