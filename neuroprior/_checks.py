"""Checks of arguments, each of which names the argument that is wrong."""

import operator
import os
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from numbers import Real
from typing import Any, TypeGuard

import numpy as np
import torch
from torch import Tensor


def is_integer(values: Tensor) -> bool:
    """True for a tensor of whole numbers (bool is not one)."""
    return not (values.is_floating_point() or values.is_complex() or values.dtype == torch.bool)


LOST = 0.05
"""Share of the standard deviation of a feature that may be lost in single precision."""

CONSTANT = 1e-10
"""Standard deviation of a feature, relative to its largest value, below which it counts as constant but for noise."""


def check_single_precision(name: str, features: Tensor) -> None:
    """Raise ValueError where `features [..., C]` vary by so little, far from 0, that float32 does not hold it."""
    if features.dtype != torch.float64 or not features.numel():
        return
    values = features.flatten(0, -2)
    lost = precision_lost(values, values.std(0, correction=0))
    if lost:
        c = lost[0]
        raise ValueError(
            f"{name}: feature {c + 1} of {values.shape[1]} is about {float(values[:, c].mean()):.4g}, where single"
            " precision does not hold how it varies; subtract a constant from it"
        )


def precision_lost(values: Tensor, std: Tensor) -> list[int]:
    """Which features of `values [N, C]` differ by so little, by standard deviations `std [C]`, that float32 loses it.

    Features that hardly vary, relative to their size, count as constant.
    """
    lost = []
    for c, column in enumerate(values.unbind(1)):  # one at a time, which takes little memory
        error, largest = (column - column.float()).std(correction=0), column.abs().max()
        if error > LOST * std[c] and std[c] > CONSTANT * largest and largest > torch.finfo(torch.float32).tiny:
            lost.append(c)
    return lost


def check_range(name: str, values: Tensor, stop: int, what: str) -> None:
    """Raise ValueError unless `values` are integers from 0 to `stop` - 1; the message names the first that is not."""
    if not is_integer(values):
        raise ValueError(f"`{name}` must be integers, got {str(values.dtype).removeprefix('torch.')}")
    if values.numel() == 0:
        return
    # torch cannot compare the wider unsigned types.
    values = values.long() if values.dtype in (torch.uint16, torch.uint32, torch.uint64) else values
    low, high = _extremes(values)
    if low < 0 or high >= stop:
        where = ((values < 0) | (values.long() >= stop)).nonzero()[0].tolist()
        value = int(values[tuple(where)])
        raise ValueError(f"{name}{where}: {value} is out of range: there are {stop} {what}, 0 to {stop - 1}")


def _extremes(values: Tensor) -> tuple[int, int]:
    """The least and the greatest of some integers."""
    if values.dtype == torch.uint8 and values.device.type == "cpu":
        # On one thread: those of torch, once awake, would be in the way of the threads of a compiled loop.
        return 0, int(values.numpy().max())
    low, high = torch.aminmax(values)
    return int(low), int(high)


def kind_of(value: object) -> str:
    """The name of its class; of a class that stands where an object should, that it is one."""
    return f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__


def describe(value: object) -> str:
    """The dtype and shape of a tensor; of anything else, the name of its class."""
    return f"{value.dtype} {list(value.shape)}" if isinstance(value, Tensor) else kind_of(value)


def as_list(name: str, values: Any) -> list[Any]:
    """A list of the values, numpy's and torch's as Python's numbers; raises ValueError for a single one."""
    numbers = values.tolist() if hasattr(values, "tolist") else values
    if not isinstance(numbers, Iterable) or isinstance(numbers, str):
        raise ValueError(f"`{name}` must be a list of numbers, got {values!r}")
    return [one.item() if hasattr(one, "item") else one for one in numbers]


def is_whole(value: object) -> TypeGuard[int]:
    """True for an integer of any library, such as `env.action_space.n` of Gymnasium; bool is none.

    Example:
        >>> is_whole(np.int64(3)), is_whole(True), is_whole(3.0)
        (True, False, False)
    """
    if isinstance(value, bool | np.bool_) or getattr(value, "dtype", None) == torch.bool:
        return False
    try:
        operator.index(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return False
    return True


def check_sizes(**sizes: object) -> None:
    """Raise ValueError, naming the argument, unless all are integers of at least 1."""
    for name, size in sizes.items():
        if not is_whole(size) or size < 1:
            raise ValueError(f"`{name}` must be an integer of at least 1, got {size!r}")


def check_count(name: str, count: object, bytes_each: int = 8) -> None:
    """Raise ValueError, naming the argument, unless it is an integer of at least 0 that fits in memory."""
    if not is_whole(count) or count < 0:
        raise ValueError(f"`{name}` must be an integer of at least 0, got {count!r}")
    check_memory(bytes_each * count, **{name: count})


def is_number(value: object) -> TypeGuard[float]:
    """True for a real number, of numpy, too (bool is none). NaN is one, of which no comparison holds."""
    return isinstance(value, Real) and not isinstance(value, bool)


def check_seed(seed: object) -> None:
    """Raise ValueError unless it is an integer that torch takes as a seed."""
    if not is_whole(seed) or not -(2**63) <= seed < 2**63:
        raise ValueError(f"`seed` must be an integer from -2**63 to 2**63 - 1, got {seed!r}")


def check_flags(**flags: object) -> None:
    """Raise ValueError, naming the argument, unless all are True or False."""
    for name, flag in flags.items():
        if not isinstance(flag, bool | np.bool_):
            raise ValueError(f"`{name}` must be True or False, got {flag!r}")


def check_choices(name: str, values: object, choices: Sequence[str], least: int = 1) -> None:
    """Raise ValueError unless `values` are at least so many of the choices."""
    names = values if isinstance(values, Sequence) and not isinstance(values, str) else None
    if names is None or len(names) < least or any(one not in list(choices) for one in names):
        raise ValueError(f"`{name}` must be a list of some of {', '.join(choices)}, got {values!r}.")


def check_share(name: str, share: object) -> None:
    """Raise ValueError, naming the argument, unless it is a number from 0 to 1."""
    if not is_number(share) or not 0 <= share <= 1:
        raise ValueError(f"`{name}` must be a number from 0 to 1, got {share!r}")


def check_same_names(
    name: str, expected: Sequence[str] | None, names: Sequence[str] | None, where: str, whose: str, remedy: str = ""
) -> None:
    """Raise ValueError where both have names and these are not the same, in the same order.

    Without names the numbers are taken to mean the same.

    Args:
        name: of the argument, such as "action_names".
        expected, names: the names that are expected, and those that are there.
        where, whose: what has the names, and what the expected ones.
        remedy: the end of the message.
    """
    if expected is None or names is None:
        return
    expected, names = (tuple(map(str, texts)) for texts in (expected, names))
    if expected != names:
        remedy = remedy or "number them alike"
        raise ValueError(f"{name}: {', '.join(names)} in {where}, {', '.join(expected)} in {whose}; {remedy}")


def check_alike_named(named: Mapping[str, Sequence[str] | None], remedy: str, what: str = "action_names") -> None:
    """Raise ValueError unless all that have names have the same ones; see `check_same_names`.

    Args:
        named: the names of each, by what has them.
        remedy: the end of the message.
        what: the names are, "action_names" or "context_names".
    """
    names_of = {where: names for where, names in named.items() if names is not None}
    first = next(iter(names_of), "")
    for where, names in names_of.items():
        check_same_names(what, names_of[first], names, where, first, remedy)


def check_memory(needed: int, **arguments: object) -> None:
    """Raise ValueError, naming the arguments, where they need more memory than there is, see `memory_within`.

    Args:
        needed: bytes, at least.
        **arguments: those that decide it.
    """
    there = _memory.get() or physical_memory()
    if there is not None and needed > there:
        names, values = " and ".join(arguments), " and ".join(map(str, arguments.values()))
        where = "this machine" if _memory.get() is None else "a prior of this size"
        raise ValueError(f"{names}: {values} would need at least {needed:,} bytes of memory, and {where} has {there:,}")


_memory: ContextVar[int | None] = ContextVar("memory", default=None)


@contextmanager
def memory_within(most: int) -> Iterator[None]:
    """Let `check_memory` allow no more than so many bytes, whatever the machine has."""
    token = _memory.set(most)
    try:
        yield
    finally:
        _memory.reset(token)


@cache
def physical_memory() -> int | None:
    """Bytes of memory of this machine; None where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # of Windows, and of systems without these names
        return None


def warn_caller(message: str) -> None:
    """Warn where the library was called from."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("neuroprior."):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)
