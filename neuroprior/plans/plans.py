"""Executed plans in memory: actions with lengths, contexts and groups."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log2
from typing import Any, Self, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from neuroprior._checks import check_count, check_memory, check_range, check_sizes, is_integer, is_whole
from neuroprior.plans.columns import check_distinct
from neuroprior.plans.sequences import Sequences, expand_context

MOST_BITS = 48
"""The most binary digits of the number of plans that `all_plans` lists, on any machine."""

MOST_ACTIONS = 2**31
"""The most actions; larger numbers are unlikely to be indices of actions."""

HALF_PAIR = re.compile("[\ud800-\udfff]")
"""Half of a surrogate pair, which UTF-8 has no bytes for."""


@dataclass(frozen=True, eq=False, repr=False)
class Plans(Sequences):
    """N executed plans of up to L actions.

    Attributes:
        actions: integers `[N, L]` between 0 and `num_actions` - 1; stored as uint8 where `num_actions` <= 256, else
            int64. Beyond a plan's length they count for nothing (stored as 0).
        num_actions: the number of actions, A; never guessed from the data.
        lengths: integers `[N]`, the number of actions of each plan; None where all have L.
        action_names: A names, or None.
        context: what is known before each action, such as the agent's observation: indices (integers) `[N, L]`;
            features (floating point) `[N, L, C]`; several indices, `[N, L, F]`, stored as int32: the patterns that are
            active in each state; None for no context. What is given once a plan, `[N]` or `[N, C]`, is the context of
            all of its steps.
        group: integers `[N]` (subject, session, world): the plans of a group are not independent, and are held out
            together (see `CombinedPrior` for an exception); None if each plan is independent.
        context_names: names of the context indices, numbered from 0, or None.
        group_names: names of the groups, numbered from 0, or None.
        end: the action that stands for the end of the plan (see `with_end`), or None. It may only be a plan's last.

    Raises:
        ValueError: a shape, dtype or value is wrong; the message says which and where.

    Example:
        >>> steps = torch.tensor([[0, 1, 1], [2, 0, 0]])
        >>> plans = Plans(steps, 3, lengths=torch.tensor([3, 1]), action_names=("eat", "rest", "walk"))
        >>> len(plans), plans.max_length
        (2, 3)
        >>> plans.mask().tolist()
        [[True, True, True], [True, False, False]]
        >>> plans[1:].actions.tolist()
        [[2, 0, 0]]
    """

    actions: Tensor
    num_actions: int
    lengths: Tensor | None = None
    action_names: Sequence[str] | None = None
    context: Tensor | None = None
    group: Tensor | None = None
    context_names: Sequence[str] | None = None
    group_names: Sequence[str] | None = None
    end: int | None = None

    def __post_init__(self) -> None:
        check_sizes(num_actions=self.num_actions)
        object.__setattr__(self, "num_actions", int(self.num_actions))
        if self.num_actions > MOST_ACTIONS:
            raise ValueError(f"num_actions: at most {MOST_ACTIONS}, not {self.num_actions}; number the actions from 0")
        actions = as_numbers("actions", self.actions)
        if actions.dim() != 2:
            raise ValueError(f"`actions` must have shape [N, L], got {list(actions.shape)}")
        object.__setattr__(self, "actions", actions)
        if self.end is not None:
            self._check_end(actions)
        num, length = actions.shape
        if self.lengths is not None:
            lengths = as_numbers("lengths", self.lengths)
            check_shape("lengths", lengths, (num,))
            check_range("lengths", lengths, length + 1, "possible lengths")
            object.__setattr__(self, "lengths", lengths.long())
            actions = actions.masked_fill(~self.mask(), 0) if is_integer(actions) else actions
        check_range("actions", actions, self.num_actions, "actions")
        object.__setattr__(self, "actions", actions.to(action_dtype(self.num_actions)))
        if check_texts("action_names", self.action_names) and len(self.action_names or ()) != self.num_actions:
            raise ValueError(
                f"`action_names` must be {self.num_actions} names, one an action, got {len(self.action_names or ())}"
            )
        if self.group is not None:
            object.__setattr__(self, "group", as_integers("group", self.group, num))
        if self.context is not None:
            context = as_numbers("context", self.context)
            check_context(context, num, length)
            context = as_single(context)
            context = context.to(torch.int32) if has_patterns(context) else self._context_of_steps(context)
            object.__setattr__(self, "context", context)
        check_distinct("action_names", self.action_names)
        check_numbered("group", self.group, self.group_names)
        check_numbered("context", self.context, self.context_names)

    def _context_of_steps(self, context: Tensor) -> Tensor:
        """The context before each step; beyond a plan's length it is 0."""
        context = expand_context(context, self.max_length)
        if self.lengths is None:
            return context
        beyond = ~self.mask()
        return context.masked_fill(beyond if context.dim() == 2 else beyond[..., None], 0)

    def _check_end(self, actions: Tensor) -> None:
        """Check that `end` only closes plans; where lengths are not given, take them from it."""
        if not is_whole(self.end) or not 0 <= self.end < self.num_actions:
            raise ValueError(f"`end` must be one of the {self.num_actions} actions, got {self.end!r}")
        position = torch.arange(1, actions.shape[1] + 1, device=actions.device)
        first = torch.where(actions == self.end, position, actions.shape[1]).amin(1) if actions.shape[1] else None
        if self.lengths is None:
            object.__setattr__(self, "lengths", position.new_zeros(len(actions)) if first is None else first)
        elif first is not None and bool((first < torch.as_tensor(self.lengths)).any()):
            plan = int((first < torch.as_tensor(self.lengths)).nonzero()[0, 0])
            raise ValueError(f"actions[{plan}]: goes on after the end symbol {self.end}, at action {int(first[plan])}")

    def mask(self, end: bool = True) -> Tensor:
        """`[N, L]` bool: True where a plan has an action; with `end` False, one that is not the end symbol."""
        taken = super().mask()
        return taken if end or self.end is None else taken & (self.actions != self.end)

    def with_end(self, name: str = "end") -> Self:
        """The same plans, each closed by one action more, number A, that stands for the end of the plan.

        A prior that learns from them predicts when plans end, and samples plans of unequal lengths. The last context
        is repeated for the added action.

        Args:
            name: of the added action, where actions have names.

        Raises:
            ValueError: the plans have such an action already.
        """
        if self.end is not None:
            raise ValueError(f"end: these plans have an end symbol already, action {self.end}")
        lengths = self.mask().sum(1)
        actions = functional.pad(self.actions.long(), (0, 1)).scatter(1, lengths[:, None], self.num_actions)
        context = self.context
        if context is not None:
            last = (lengths - 1).clamp(min=0)
            closing = context[torch.arange(len(self), device=context.device), last] if self.max_length else None
            if closing is None:
                raise ValueError("context: plans without any action have no context to repeat")
            context = torch.cat([context, torch.zeros_like(context[:, :1])], 1)
            context[torch.arange(len(self), device=context.device), lengths] = closing
        names = None if self.action_names is None else (*self.action_names, name)
        more: dict[str, Any] = self.added_fields(self.PER_ACTION)
        more = {name: functional.pad(values, (0, 1)) for name, values in more.items()}
        return replace(
            self,
            actions=actions,
            num_actions=self.num_actions + 1,
            lengths=lengths + 1,
            action_names=names,
            context=context,
            end=self.num_actions,
            **more,
        )

    def added_fields(self, names: Sequence[str]) -> dict[str, Any]:
        """Those of the fields of these names that the plans have and a subclass of `Plans` adds."""
        values = {name: getattr(self, name) for name in names if name not in (*Plans.PER_PLAN, *Plans.PER_ACTION)}
        return {name: each for name, each in values.items() if each is not None}

    def without_end(self) -> Self:
        """The same plans without the end symbol, which must be the last action, and with their lengths.

        Raises:
            ValueError: the plans have no end symbol, or it is not action A - 1.
        """
        if self.end is None or self.end != self.num_actions - 1:
            raise ValueError(f"`end` must be the last action, {self.num_actions - 1}, got {self.end!r}")
        taken = self.mask(end=False)
        lengths = taken.sum(1)
        opened = replace(
            self,
            actions=self.actions.masked_fill(~taken, 0),
            num_actions=self.num_actions - 1,
            lengths=lengths,
            action_names=None if self.action_names is None else self.action_names[:-1],
            end=None,
        )
        return opened.trimmed()

    def without_context(self) -> Self:
        """The same plans without their context."""
        return self if self.context is None else replace(self, context=None, context_names=None)


AnyPlans = TypeVar("AnyPlans", bound=Plans)


def check_are_plans(plans: object) -> None:
    """Raise ValueError for what is not `Plans`."""
    if not isinstance(plans, Plans):
        raise ValueError(f"`plans` must be Plans, as in Plans(actions, num_actions), got {type(plans).__name__}")


def check_plain_plans(plans: Plans, place: object) -> None:
    """Raise ValueError for plans of a subclass that have what `Plans` have no field for, and only `.npz` files hold."""
    more = plans.added_fields((*plans.PER_PLAN, *plans.PER_ACTION))
    if more:
        raise ValueError(f"{place}: {', '.join(more)} of {type(plans).__name__} are written to .npz files only")


def all_plans(num_actions: int, length: int) -> Tensor:
    """All A**L plans `[A**L, L]`, int64; row n is n written in base A.

    Args:
        num_actions: A.
        length: L.

    Raises:
        ValueError: an argument is out of range, or there are too many plans.

    Example:
        >>> all_plans(2, 2).tolist()
        [[0, 0], [0, 1], [1, 0], [1, 1]]
    """
    check_sizes(num_actions=num_actions)
    check_count("length", length)
    if length * log2(num_actions) > MOST_BITS:
        raise ValueError(f"length: {num_actions}**{length} plans are too many; list fewer or shorter ones")
    check_memory(8 * num_actions**length * max(length, 1), num_actions=num_actions, length=length)
    base = num_actions ** torch.arange(length - 1, -1, -1)
    return torch.arange(num_actions**length)[:, None].div(base, rounding_mode="floor") % num_actions


def action_dtype(num_actions: int) -> torch.dtype:
    """How actions are stored: uint8 where it suffices, else int64.

    Example:
        >>> action_dtype(256), action_dtype(257)
        (torch.uint8, torch.int64)
    """
    return torch.uint8 if num_actions <= 256 else torch.int64


def check_context(context: Tensor, num_plans: int, length: int) -> None:
    """Raise ValueError unless `context` fits `num_plans` plans of `length` actions, as in `Plans.context`.

    Example:
        >>> check_context(torch.zeros(5, 3, dtype=torch.long), num_plans=5, length=3)
    """
    shape = tuple(context.shape)
    if has_patterns(context):
        if shape[:2] != (num_plans, length):
            raise ValueError(f"`context` must be patterns [{num_plans}, {length}, F], got {list(shape)}")
        check_patterns(context)
        return
    if is_integer(context):
        if shape not in ((num_plans,), (num_plans, length)):
            raise ValueError(
                f"`context` must be indices of shape [{num_plans}] or [{num_plans}, {length}], or patterns"
                f" [{num_plans}, {length}, F], got {list(shape)}"
            )
        return
    if not context.is_floating_point():
        raise ValueError(f"`context` must be indices or floating point features, got {context.dtype}")
    if len(shape) not in (2, 3) or shape[0] != num_plans or (len(shape) == 3 and shape[1] != length):
        raise ValueError(
            f"`context` must be features of shape [{num_plans}, C] or [{num_plans}, {length}, C], got {list(shape)}"
        )
    if not context.isfinite().all():
        where = (~context.isfinite()).nonzero()[0].tolist()
        raise ValueError(f"context{where}: {float(context[tuple(where)])} is not a finite number")


def has_patterns(context: Tensor | None) -> bool:
    """True for the context of plans that is several indices per step, `[N, L, F]`.

    Example:
        >>> has_patterns(torch.zeros(4, 5, 7, dtype=torch.int32)), has_patterns(torch.zeros(4, 5, dtype=torch.long))
        (True, False)
    """
    return context is not None and context.dim() == 3 and is_integer(context)


def check_patterns(patterns: Tensor) -> None:
    """Raise ValueError unless these are integers from 0 to 2**31 - 1.

    Example:
        >>> check_patterns(torch.tensor([[0, 7, 2**31 - 1]]))
    """
    check_range("context", patterns, 2**31, "patterns")


def as_numbers(name: str, values: Any) -> Tensor:
    """Numbers as a tensor without gradients; ValueError for names, and for rows of unequal lengths."""
    try:
        return torch.as_tensor(values).detach()
    except (RuntimeError, TypeError, ValueError):
        raise ValueError(
            f"`{name}` must be numbers in rows of one length (names go into {name.removesuffix('s')}_names, and how"
            " long each plan is into lengths)"
        ) from None


def as_single(values: Tensor) -> Tensor:
    """Numbers in half precision in single precision, in which priors compute; others as they are."""
    return values.float() if values.is_floating_point() and values.dtype.itemsize < 4 else values


def as_integers(name: str, values: Any, num: int) -> Tensor:
    """Integers `[num]`, one for each plan; ValueError for anything else."""
    numbers = as_numbers(name, values)
    if not is_integer(numbers):
        raise ValueError(f"`{name}` must be integers, got {str(numbers.dtype).removeprefix('torch.')}")
    check_shape(name, numbers, (num,))
    return numbers


def check_shape(name: str, values: Tensor, shape: tuple[int, ...]) -> None:
    """Raise ValueError for a tensor of another shape."""
    if tuple(values.shape) != shape:
        raise ValueError(f"`{name}` must have shape {list(shape)}, got {list(values.shape)}")


def check_texts(what: str, names: Sequence[str] | None) -> bool:
    """Whether there are names; ValueError unless they are texts, and names such as a file can hold."""
    if names is not None and (
        not isinstance(names, Sequence) or isinstance(names, str) or not all(isinstance(name, str) for name in names)
    ):
        raise ValueError(f"`{what}` must be a list of texts, got {names!r}")
    for name in filter(HALF_PAIR.search, names or ()):
        raise ValueError(f"{what}: {name!r} has a broken character, half of a surrogate pair, which no file can hold")
    return names is not None


def check_numbered(what: str, numbers: Tensor | None, names: Sequence[str] | None) -> None:
    """Raise ValueError unless names, where there are any, are different texts, one for each of the integers."""
    if not check_texts(f"{what}_names", names) or names is None:
        return
    check_distinct(f"{what}_names", names)
    if numbers is None or not is_integer(numbers):
        raise ValueError(f"`{what}_names` must come with the integers in {what} that they name")
    check_range(what, numbers, len(names), f"{what} names")
