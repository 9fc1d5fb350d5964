"""States of priors: a tensor, or a tuple of states, each tensor with the batch as its first dimension."""

from collections.abc import Callable
from typing import Any, TypeAlias

import torch
from torch import Tensor

from neuroprior._checks import describe, is_integer
from neuroprior.sampling.rows import rows_of

State: TypeAlias = Any
"""A tensor, or a tuple of states. A prior knows which it takes, so type checkers are told nothing."""


def map_state(function: Callable[..., Tensor], *states: State) -> State:
    """Returns the state that `function` makes of the corresponding tensors of states of one structure.

    Example:
        >>> map_state(torch.add, (torch.tensor([1]), torch.tensor([2])), (torch.tensor([10]), torch.tensor([20])))
        (tensor([11]), tensor([22]))
    """
    if isinstance(states[0], Tensor):
        return function(*states)
    return tuple(map_state(function, *parts) for parts in zip(*states, strict=True))


def select_rows(state: State, row: Tensor | slice) -> State:
    """Returns the rows `row` (integers `[M]`, or a slice) of the `state` of N plans.

    Example:
        >>> select_rows((torch.tensor([1, 2, 3]), torch.tensor([[4], [5], [6]])), torch.tensor([2, 0]))
        (tensor([3, 1]), tensor([[6], [4]]))
    """
    if isinstance(row, slice):
        return map_state(lambda values: values[row], state)
    if row.dtype not in (torch.int32, torch.int64):  # the only ones that torch selects by
        if not is_integer(row):
            raise ValueError(f"`row` must be integers [M] or a slice, got {describe(row)}")
        row = row.long()
    return map_state(lambda values: rows_of(values, row), state)


def join_rows(*states: State) -> State:
    """Returns one state of the plans of all of these states, one after the other."""
    return map_state(lambda *values: torch.cat(values), *states)


def tensors_in(state: State) -> list[Tensor]:
    """Returns all tensors of a state, in order."""
    return [state] if isinstance(state, Tensor) else [values for inner in state for values in tensors_in(inner)]


def has_rows(state: State, num: int) -> bool:
    """Returns whether a state is one of `num` plans: a tensor of so many rows, or a tuple of such states."""
    if isinstance(state, tuple):
        return len(state) > 0 and all(has_rows(inner, num) for inner in state)
    return isinstance(state, Tensor) and state.dim() > 0 and len(state) == num


def numbers_in(state: State) -> int:
    """Returns how many numbers a state of N plans has, N times those of a plan."""
    return sum(values.numel() for values in tensors_in(state))


class StateStore:
    """Keeps states of many plans, by how many actions are behind them: the states of some priors grow.

    Example:
        >>> store = StateStore()
        >>> row = store.keep(0, torch.tensor([5, 6, 7]))
        >>> store.take(0, row[[2, 0]])
        tensor([7, 5])
    """

    def __init__(self) -> None:
        self._states, self._used = list[State](), list[int]()

    def keep(self, depth: int, state: State) -> Tensor:
        """Returns the rows, int64 `[M]` on the CPU, in which states of M plans are kept from now on."""
        while depth >= len(self._states):
            self._states.append(None)
            self._used.append(0)
        first, new = self._used[depth], len(tensors_in(state)[0])
        last, kept = first + new, self._states[depth]
        if kept is None or last > len(tensors_in(kept)[0]):
            room = map_state(lambda values: values.new_empty(2 * last, *values.shape[1:]), state)
            if kept is not None:
                map_state(lambda more, old: more[:first].copy_(old[:first]), room, kept)
            self._states[depth] = kept = room
        map_state(lambda all_, values: all_[first:last].copy_(values), kept, state)
        self._used[depth] = last
        return torch.arange(first, last)

    def take(self, depth: int, row: Tensor) -> State:
        """Returns the states that are kept in some rows."""
        kept = self._states[depth]
        return select_rows(kept, row.to(tensors_in(kept)[0].device))
