"""What plans of numbered actions and plans of vectors have in common: they are split into training and validation."""

import hashlib
from abc import ABC
from collections.abc import Iterator, Sequence
from dataclasses import replace
from numbers import Integral, Real
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from neuroprior._checks import check_count, describe, is_integer, is_number
from neuroprior._random import generator_on


def as_index(index: Any, num: int) -> Tensor | slice:
    """Returns a slice, or which of `num` plans are meant: int64 `[M]`, or a bool mask `[num]`.

    Raises:
        IndexError: the number of a single plan, which would not be plans; what is out of range; or no index.
    """
    if isinstance(index, slice):
        return index
    if isinstance(index, Integral) or getattr(index, "ndim", None) == 0:
        number = int(index)
        raise IndexError(
            f"`plans` must be indexed by a slice or a tensor; plans[{number} : {number + 1 or ''}] is one plan"
        )
    chosen = torch.as_tensor(index)
    chosen = chosen.long() if is_integer(chosen) or not chosen.numel() else chosen
    mask = chosen.dtype == torch.bool
    if chosen.dim() != 1 or not (mask or is_integer(chosen)) or (mask and len(chosen) != num):
        raise IndexError(f"`plans` must be indexed by a slice, integers [M] or bool [{num}], got {describe(chosen)}")
    wrong = chosen[:0] if mask else chosen[(chosen < -num) | (chosen >= num)]
    if len(wrong):
        raise IndexError(f"`plans` must be indexed by integers from 0 to {num - 1}, got {int(wrong[0])}")
    return chosen


class Sequences(ABC):
    """N executed plans of up to L actions of some kind.

    Attributes:
        actions: `[N, L, ...]`.
        lengths: integers `[N]`, the number of actions of each plan; None where all have L.
        context: what is known before each action, `[N, L]` or `[N, L, C]`; None for no context.
        group: integers `[N]`: the plans of a group are not independent; None if each plan is independent.
    """

    PER_PLAN: ClassVar[tuple[str, ...]] = ("lengths", "group")
    """Fields with an entry for each plan, `[N]`: tensors, or texts. A subclass adds its own."""

    PER_ACTION: ClassVar[tuple[str, ...]] = ("actions", "context")
    """Fields whose tensors have an entry for each action of each plan, `[N, L, ...]`. A subclass adds its own."""

    actions: Tensor
    lengths: Tensor | None
    context: Tensor | None
    group: Tensor | None

    def __repr__(self) -> str:
        """The numbers, and the shapes of the tensors."""
        parts = []
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                parts.append(f"{name} {list(value.shape)}")
            elif isinstance(value, int):
                parts.append(f"{name} {value}")
        return f"{type(self).__name__}({', '.join(parts)})"

    def __len__(self) -> int:
        """The number of plans, N."""
        return self.actions.shape[0]

    @property
    def max_length(self) -> int:
        """The number of columns of `actions`, L."""
        return self.actions.shape[1]

    def mask(self) -> Tensor:
        """`[N, L]` bool: True where a plan has an action."""
        if self.lengths is None:
            return torch.ones(self.actions.shape[:2], dtype=torch.bool, device=self.actions.device)
        return torch.arange(self.max_length, device=self.actions.device) < self.lengths[:, None]

    def to(self, device: torch.device | str) -> Self:
        """These plans with all tensors on `device`."""
        moved = {name: value.to(device) for name, value in vars(self).items() if isinstance(value, Tensor)}
        if all(value is getattr(self, name) for name, value in moved.items()):
            return self
        return replace(self, **moved)  # type: ignore[type-var]

    def __getitem__(self, index: Tensor | slice) -> Self:
        """The plans at `index` (a slice, integers or a bool mask)."""
        index = as_index(index, len(self))
        return replace(self, **self.select_rows((*self.PER_PLAN, *self.PER_ACTION), index))  # type: ignore[type-var]

    def select_rows(self, names: Sequence[str], index: Tensor | slice) -> dict[str, Any]:
        """The fields of these names that the plans have, each of the plans at `index` alone."""
        values = {name: getattr(self, name) for name in names}
        return {name: _rows(each, index) for name, each in values.items() if each is not None}

    def __iter__(self) -> Iterator[Self]:
        """Each plan, as plans of one."""
        return (self[i : i + 1] for i in range(len(self)))

    __reversed__ = None

    def steps(self, first: int = 0, stop: int | None = None) -> Self:
        """Actions `first` to `stop` - 1 of each plan, with what belongs to them; shorter plans have fewer, or none.

        Args:
            first: how many actions of each plan are left out at its beginning, at least 0.
            stop: the number of the first action that is left out at the end; None: none is.

        Raises:
            ValueError: `first` is negative, or `stop` is less than `first`.
        """
        check_count("first", first, 0)
        if stop is not None:
            check_count("stop", stop, 0)
        stop = self.max_length if stop is None else min(stop, self.max_length)
        if stop < min(first, self.max_length):
            raise ValueError(f"`stop` must be at least {first}, the first action, got {stop}")
        parts = {name: getattr(self, name) for name in self.PER_ACTION}
        cut = {name: values[:, first:stop] for name, values in parts.items() if values is not None}
        if self.lengths is not None:
            cut["lengths"] = (self.lengths - first).clamp(0, max(stop - first, 0))
        return replace(self, **cut)  # type: ignore[type-var]

    def trimmed(self) -> Self:
        """The same plans without the columns in which none has an action."""
        if self.lengths is None or not len(self):
            return self
        longest = int(self.lengths.max())
        return self if longest == self.max_length else self.steps(stop=longest)

    def split(self, validation: float = 0.1, generator: torch.Generator | None = None) -> tuple[Self, Self]:
        """Split at random into plans for training and plans for validation; groups stay together.

        One plan alone is cut in time: its last actions are held out.

        Args:
            validation: the share of plans (of groups, where there are any; of the actions of a single plan) held out,
                between 0 and 1; at least one plan, group or action is kept on each side.
            generator: draws the split.

        Raises:
            ValueError: `validation` is not between 0 and 1, or there are fewer than two plans or groups, and not a
                single plan of at least two actions.
        """
        check_validation(validation)
        length = int(self.mask().sum()) if len(self) == 1 else 0
        if length > 1:
            cut = length - min(max(round(length * validation), 1), length - 1)
            return self.steps(0, cut), self.steps(cut, length)
        unit = torch.arange(len(self)) if self.group is None else self.group.unique(return_inverse=True)[1].cpu()
        units = int(unit.max()) + 1 if len(unit) else 0
        if units < 2:
            what = "plans" if self.group is None else "groups"
            raise ValueError(f"plans: {units} {what} cannot be split in two; at least two are needed")
        held_out = min(max(round(units * validation), 1), units - 1)
        order = torch.randperm(units, generator=generator_on(generator, "cpu"))
        chosen = torch.zeros(units, dtype=torch.bool)
        chosen[order[:held_out]] = True
        index = chosen[unit].to(self.actions.device)
        return self[~index], self[index]


def _rows(values: Tensor | Sequence[str], index: Tensor | slice) -> Tensor | Sequence[str]:
    """The entries at `index` of a tensor, or of texts."""
    if isinstance(values, Tensor):
        return values[index]
    if isinstance(index, slice):
        return tuple(values)[index]
    return tuple(values[i] for i in torch.arange(len(values))[torch.as_tensor(index).cpu()].tolist())


def is_per_plan(context: Tensor) -> bool:
    """Returns whether a context is given once a plan: indices `[N]` or features `[N, C]`.

    Example:
        >>> is_per_plan(torch.zeros(4, dtype=torch.long)), is_per_plan(torch.zeros(4, 5, dtype=torch.long))
        (True, False)
    """
    return context.dim() == (1 if is_integer(context) else 2)


def expand_context(context: Tensor, length: int) -> Tensor:
    """Returns a `context` before each of `length` steps, `[N, L]` or `[N, L, C]`; one given once a plan is repeated.

    Example:
        >>> expand_context(torch.tensor([5, 3]), 2).tolist()
        [[5, 5], [3, 3]]
    """
    if not is_per_plan(context):
        return context
    return context[:, None].expand(len(context), length, *context.shape[1:])


def constant_context(plans: Sequences) -> Tensor | None:
    """Returns the context of each plan, `[N]` or `[N, C]`, where it never changes within a plan; else None.

    Example:
        >>> constant_context(Plans(torch.zeros(2, 3, dtype=torch.long), 2, context=torch.tensor([5, 3]))).tolist()
        [5, 3]
    """
    context = plans.context
    if context is None or plans.max_length == 0 or (is_integer(context) and context.dim() == 3):
        return None
    first = context[:, :1]
    same = (context == first) if context.dim() == 2 else (context == first).all(-1)
    return first[:, 0] if bool((same | ~plans.mask()).all()) else None


def check_validation(share: object) -> None:
    """Raise ValueError for what is no share of plans that can be held out."""
    if not is_number(share) or not 0 < share < 1:
        said = share if isinstance(share, Real | str | None) else type(share).__name__
        raise ValueError(f"`validation` must be a share between 0 and 1, got {said}")


def plans_digest(plans: Sequences) -> str:
    """A digest of all that plans hold."""
    digest = hashlib.sha256()
    for name, value in vars(plans).items():
        if isinstance(value, Tensor):
            digest.update(f"{name} {value.dtype} {[*value.shape]}".encode())
            digest.update(value.cpu().contiguous().numpy().tobytes())
        else:
            digest.update(f"{name} {value!r}".encode())
    return digest.hexdigest()
