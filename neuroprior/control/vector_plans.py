"""Executed plans whose actions are vectors: numbers between bounds, with lengths, contexts and groups."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neuroprior._checks import check_range, check_single_precision, check_sizes, is_integer
from neuroprior.plans.columns import check_distinct
from neuroprior.plans.sequences import Sequences, expand_context


@dataclass(frozen=True, eq=False, repr=False)
class VectorPlans(Sequences):
    """N executed plans of up to L vectors of D numbers, such as the torques of D joints.

    Attributes:
        actions: floating point `[N, L, D]` between the bounds; stored as float32. Beyond a plan's length they count for
            nothing (stored as 0). A millionth of the range beyond the bounds is rounding, and clipped.
        action_low, action_high: `[D]` float32, finite: the bounds of each dimension; never guessed from the data.
        lengths: integers `[N]`, the number of vectors of each plan; None where all have L.
        context: features of the states in which actions were chosen, floating point `[N, L, C]`, stored as float32;
            those that are given once a plan, `[N, C]`, hold at all of its steps. None for no context.
        group: integers `[N]` (subject, session, run): the plans of a group are not independent, and are held out
            together, unless there are few or very unequal ones; None if each plan is independent.
        action_names: names of the D dimensions, or None.

    Raises:
        ValueError: a shape, dtype or value is wrong; the message says which and where.

    Example:
        >>> plans = VectorPlans(torch.zeros(4, 10, 2), action_low=[-1.0, -1.0], action_high=[1.0, 1.0])
        >>> len(plans), plans.max_length, plans.action_low.tolist()
        (4, 10, [-1.0, -1.0])
    """

    actions: Tensor
    action_low: Tensor
    action_high: Tensor
    lengths: Tensor | None = None
    context: Tensor | None = None
    group: Tensor | None = None
    action_names: Sequence[str] | None = None

    def __post_init__(self) -> None:
        actions = as_floats("actions", self.actions)
        if actions.dim() != 3:
            raise ValueError(f"`actions` must have shape [N, L, D], got {list(actions.shape)}")
        num, length, size = actions.shape
        for name in ("action_low", "action_high"):
            bound = as_floats(name, getattr(self, name)).to(actions.device)
            if bound.shape != (size,):
                raise ValueError(f"`{name}` must have shape [{size}], as the vectors, got {list(bound.shape)}")
            object.__setattr__(self, name, bound)
        check_bounds(self.action_low, self.action_high)
        # From here on `self.mask()` can be asked.
        object.__setattr__(self, "actions", actions)
        if self.lengths is not None:
            lengths = _integers("lengths", self.lengths, num)
            check_range("lengths", lengths, length + 1, "possible lengths")
            object.__setattr__(self, "lengths", lengths.long())
        counts = self.mask()[..., None]
        check_vectors("actions", torch.where(counts, actions, self.action_low), self.action_low, self.action_high)
        inside = actions.clamp(self.action_low, self.action_high)
        object.__setattr__(self, "actions", inside.masked_fill(~counts, 0))
        if self.group is not None:
            object.__setattr__(self, "group", _integers("group", self.group, num))
        if self.context is not None:
            object.__setattr__(self, "context", self._check_context(num, length))
        if self.action_names is not None:
            if isinstance(self.action_names, str) or len(self.action_names) != size:
                raise ValueError(
                    f"`action_names` must be a list of {size} names, one a dimension, got {self.action_names!r}"
                )
            check_distinct("action_names", self.action_names)

    def _check_context(self, num: int, length: int) -> Tensor:
        """The context as it is stored."""
        context = as_floats("context", self.context)
        shape = tuple(context.shape)
        if shape[:-1] not in ((num,), (num, length)):
            raise ValueError(f"`context` must have shape [{num}, C] or [{num}, {length}, C], got {list(shape)}")
        context = expand_context(context, length).masked_fill(~self.mask()[..., None], 0)
        check_finite("context", context)
        check_single_precision("context", expand_context(torch.as_tensor(self.context), length)[self.mask()])
        return context

    @property
    def action_size(self) -> int:
        """The number of dimensions of an action, D."""
        return int(self.actions.shape[2])

    def without_context(self) -> "VectorPlans":
        """The same plans without their context."""
        return self if self.context is None else replace(self, context=None)

    def windows(self, length: int) -> Tensor:
        """All windows of `length` consecutive vectors, `[M, length, D]`, plan by plan in order; M may be 0.

        Raises:
            ValueError: `length` is no integer of at least 1.
        """
        check_sizes(length=length)
        if self.max_length < length:
            return self.actions.new_zeros(0, length, self.action_size)
        every = self.actions.unfold(1, length, 1).transpose(2, 3)
        ends = torch.arange(length, self.max_length + 1, device=self.actions.device)
        return every[ends <= self.mask().sum(1)[:, None]]


MIN_RELATIVE_WIDTH = 1e-4
"""The least width of a range, as a share of its bounds: float32 then has about a thousand numbers between them."""

MIN_WIDTH, MAX_WIDTH = 1e-30, 1e30
"""Widths of which float32 can hold the squares."""


def check_bounds(low: Tensor, high: Tensor) -> None:
    """Raise ValueError unless these are finite bounds `[D]` of ranges that float32 resolves, D of 1 or more."""
    if low.dim() != 1 or low.shape != high.shape or not len(low):
        raise ValueError(
            f"`action_low` and `action_high` must have shape [D], got {list(low.shape)} and {list(high.shape)}"
        )
    width, size = high - low, torch.maximum(low.abs(), high.abs())
    fits = (width > MIN_RELATIVE_WIDTH * size) & (width > MIN_WIDTH) & (width < MAX_WIDTH)
    if not fits.all():
        d = int((~fits).nonzero()[0, 0])
        raise ValueError(
            f"`action_low` must be below `action_high` by {MIN_WIDTH:g} to {MAX_WIDTH:g} and at least"
            f" {MIN_RELATIVE_WIDTH:g} of the bounds, got {float(low[d]):g} and {float(high[d]):g} in dimension {d}"
        )


def check_vectors(name: str, vectors: Tensor, low: Tensor, high: Tensor) -> None:
    """Raise ValueError unless `vectors [..., D]` are floating point numbers between `low [D]` and `high [D]`.

    A millionth of the range beyond the bounds is taken for rounding.
    """
    if not vectors.is_floating_point() or not vectors.dim() or vectors.shape[-1] != len(low):
        raise ValueError(
            f"`{name}` must be floating point vectors of {len(low)} numbers, got {vectors.dtype} {list(vectors.shape)}"
        )
    slack = 1e-6 * (high - low)
    inside = (vectors >= low - slack) & (vectors <= high + slack)
    if not inside.all():
        where = (~inside).nonzero()[0].tolist()
        d = where[-1]
        raise ValueError(
            f"`{name}` must be between the bounds {float(low[d]):g} and {float(high[d]):g} of dimension {d}, got"
            f" {float(vectors[tuple(where)]):g} at {where}"
        )


def check_finite(name: str, values: Tensor) -> None:
    """Raise ValueError unless all of `values` are finite."""
    if not values.isfinite().all():
        where = (~values.isfinite()).nonzero()[0].tolist()
        raise ValueError(f"`{name}` must be finite, got {float(values[tuple(where)])} at {where}")


def as_floats(name: str, values: object) -> Tensor:
    """Floating point numbers as float32; ValueError for anything else."""
    tensor = _as_tensor(name, values)
    if not tensor.is_floating_point() and not is_integer(tensor):
        raise ValueError(f"`{name}` must be numbers, got {tensor.dtype}")
    return tensor.detach().float()


def _integers(name: str, values: object, num: int) -> Tensor:
    """Integers `[num]`; ValueError for anything else."""
    tensor = _as_tensor(name, values)
    if not is_integer(tensor) or tensor.shape != (num,):
        raise ValueError(f"`{name}` must be integers of shape [{num}], got {tensor.dtype} {list(tensor.shape)}")
    return tensor


def _as_tensor(name: str, values: object) -> Tensor:
    try:
        return torch.as_tensor(values)
    except (OverflowError, RuntimeError, TypeError, ValueError):
        raise ValueError(f"`{name}` must be numbers, got {type(values).__name__}") from None
