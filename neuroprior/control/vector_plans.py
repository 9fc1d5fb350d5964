"""Executed plans whose actions are vectors: numbers between bounds, with lengths, contexts and groups."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import check_range, check_share, check_single_precision, check_sizes, is_integer
from neuroprior.plans.columns import check_distinct
from neuroprior.plans.sequences import Sequences, check_index, counted


@dataclass(frozen=True, eq=False, repr=False)
class VectorPlans(Sequences):
    """N executed plans of up to L vectors of D numbers, such as the torques of D joints.

    Attributes:
        actions: floating point `[N, L, D]` between the bounds; stored as float32. Beyond a plan's length they count for
            nothing (stored as 0). A millionth of the range beyond the bounds is rounding, and clipped.
        action_low, action_high: `[D]` float32, finite: the bounds of each dimension; never guessed from the data.
        lengths: integers `[N]`, the number of vectors of each plan; None where all have L.
        context: features of the states in which actions were chosen, floating point, one row per plan `[N, C]` or per
            step `[N, L, C]`; stored as float32. None for no context.
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
        if actions.dim() != 3 or not actions.shape[2]:
            raise ValueError(f"actions: shape [N, L, D] is expected, D of 1 or more, not {list(actions.shape)}")
        object.__setattr__(self, "actions", actions)
        num, length, size = actions.shape
        for name in ("action_low", "action_high"):
            bound = as_floats(name, getattr(self, name)).to(actions.device)
            if bound.shape != (size,) or not bound.isfinite().all():
                raise ValueError(f"{name}: {size} finite numbers are expected, one a dimension, not {bound.tolist()}")
            object.__setattr__(self, name, bound)
        if not bool((self.action_low < self.action_high).all()):
            d = int((self.action_low >= self.action_high).nonzero()[0, 0])
            raise ValueError(
                f"action_low[{d}]: {float(self.action_low[d]):g} is not below action_high[{d}],"
                f" {float(self.action_high[d]):g}"
            )
        check_widths(self.action_low, self.action_high)
        if self.lengths is not None:
            lengths = _integers("lengths", self.lengths)
            if lengths.shape != (num,):
                raise ValueError(f"lengths: shape [{num}] is expected, not {list(lengths.shape)}")
            check_range("lengths", lengths, length + 1, "possible lengths")
            object.__setattr__(self, "lengths", lengths.long())
            actions = actions.masked_fill(~self.mask()[..., None], 0)
        slack = 1e-6 * (self.action_high - self.action_low)
        inside = (actions >= self.action_low - slack) & (actions <= self.action_high + slack)
        wrong = ~inside & self.mask()[..., None]
        if wrong.any():
            where = wrong.nonzero()[0].tolist()
            low, high = float(self.action_low[where[2]]), float(self.action_high[where[2]])
            raise ValueError(
                f"actions{where}: {float(actions[tuple(where)]):g} is not between the bounds of dimension {where[2]},"
                f" {low:g} and {high:g}"
            )
        kept = actions.clamp(self.action_low, self.action_high)
        object.__setattr__(self, "actions", kept.masked_fill(~self.mask()[..., None], 0))
        if self.group is not None:
            group = _integers("group", self.group)
            if not is_integer(group) or group.shape != (num,):
                raise ValueError(
                    f"group: integers of shape [{num}] are expected, not {group.dtype} {list(group.shape)}"
                )
            object.__setattr__(self, "group", group)
        if self.context is not None:
            self._check_context(num, length)
        if self.action_names is not None:
            if not isinstance(self.action_names, Sequence | np.ndarray) or isinstance(self.action_names, str):
                raise ValueError(f"action_names: a list is expected, not {type(self.action_names).__name__}")
            if len(self.action_names) != size:
                raise ValueError(f"action_names: {size} are expected, one a dimension, not {self.action_names!r}")
            check_distinct("action_names", self.action_names)

    def _check_context(self, num: int, length: int) -> None:
        context = as_floats("context", self.context)
        shape = tuple(context.shape)
        if shape[:-1] not in ((num,), (num, length)):
            raise ValueError(
                f"context: features of shape [{num}, C] or [{num}, {length}, C] are expected, not {list(shape)}"
            )
        if len(shape) == 3:
            context = context.masked_fill(~self.mask()[..., None], 0)
        if not context.isfinite().all():
            where = (~context.isfinite()).nonzero()[0].tolist()
            raise ValueError(f"context{where}: {float(context[tuple(where)])} is not a finite number")
        given = torch.as_tensor(self.context)
        if given.dtype == torch.float64:
            check_single_precision("context", counted(given, self.mask()))
        object.__setattr__(self, "context", context)

    @property
    def action_size(self) -> int:
        """The number of dimensions of an action, D."""
        return int(self.actions.shape[2])

    def __getitem__(self, index: Tensor | slice) -> "VectorPlans":
        """The plans at `index` (a slice, integers or a bool mask), as `VectorPlans`."""
        check_index(index)

        def pick(values: Tensor | None) -> Tensor | None:
            return None if values is None else values[index]

        return replace(
            self,
            actions=self.actions[index],
            lengths=pick(self.lengths),
            context=pick(self.context),
            group=pick(self.group),
        )

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

    def at_bounds(self, share: float = 1e-3) -> Tensor:
        """In each dimension the share of vectors at a bound, or within `share` of the range of one: float32 `[D]`."""
        check_share("share", share)
        slack = share * (self.action_high - self.action_low)
        near = (self.actions <= self.action_low + slack) | (self.actions >= self.action_high - slack)
        return near[self.mask()].float().mean(0)


COARSEST = 1e-4
"""The least width of a range, as a share of its bounds: float32 then has about a thousand numbers between them."""

WIDTHS = 1e-30, 1e30
"""The least and the greatest width of a range: float32 can hold their squares."""


def check_widths(low: Tensor, high: Tensor) -> None:
    """Raise ValueError where the numbers between bounds `low` and `high [D]` are too few, or too large, for float32."""
    width = high - low
    fits = (width > COARSEST * torch.maximum(low.abs(), high.abs())) & (width > WIDTHS[0]) & (width < WIDTHS[1])
    if not fits.all():
        d = int((~fits).nonzero()[0, 0])
        raise ValueError(
            f"action_low[{d}], action_high[{d}]: a range that float32 resolves is expected (1e-30 to 1e30 wide, and at"
            f" least {COARSEST:g} of its bounds), not {float(low[d]):g} to {float(high[d]):g}"
        )


def same_bounds(bound: Tensor, other: Tensor, width: Tensor) -> bool:
    """Whether two bounds `[D]` of ranges of `width [D]` are the same, but for a hundred-thousandth of the range."""
    return bound.shape == other.shape and bool(((bound - other).abs() <= 1e-5 * width).all())


def as_floats(name: str, values: object) -> Tensor:
    """Floating point numbers as float32; ValueError for anything else."""
    try:
        tensor = torch.as_tensor(values)
    except (OverflowError, RuntimeError, TypeError, ValueError):
        raise ValueError(f"{name}: an array of numbers is expected, not {type(values).__name__}") from None
    if not tensor.is_floating_point() and not is_integer(tensor):
        raise ValueError(f"{name}: numbers are expected, not {tensor.dtype}")
    return tensor.detach().float()


def _integers(name: str, values: object) -> Tensor:
    """`values` as a tensor, whose dtype is checked later; ValueError for what cannot be one."""
    try:
        return torch.as_tensor(values)
    except (OverflowError, RuntimeError, TypeError, ValueError):
        raise ValueError(f"{name}: integers are expected, not {type(values).__name__}") from None
