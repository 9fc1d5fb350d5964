"""What the conformance suites share."""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

from neuroprior._registry import Registry

Check = Callable[[Any, int | None, int, int], None]

PRIOR_CHECKS: Registry[tuple[type, Check]] = Registry()
WORLD_CHECKS: Registry[tuple[type, Check]] = Registry()
"""Conformance suites of priors and worlds of other kinds that wings add: the class, and its suite. It takes the object,
the length of plans (None: the suite's choice), a number of samples or of states, and a seed."""

Result = TypeVar("Result")

FALSE_ALARM = 1e-6
"""The probability with which correct code fails one of the tests of random draws."""


def require(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)


def same(first: Tensor, second: Tensor) -> bool:
    """Equal, up to rounding where they are floating point numbers."""
    if first.is_floating_point():
        return first.shape == second.shape and torch.allclose(first, second.to(first), atol=1e-5, equal_nan=True)
    return first.equal(second)


def raises(call: Callable[[], object]) -> bool:
    try:
        call()
    except ValueError:
        return True
    return False


def unless_refused(call: Callable[[], Result]) -> Result:
    """What `call` returns; AssertionError, with its message, where it raises ValueError."""
    try:
        return call()
    except ValueError as error:
        raise AssertionError(str(error).removeprefix("prior: ")) from error


def check_by_kind(
    checks: Registry[tuple[type, Check]], value: object, length: int | None, number: int, seed: int
) -> bool:
    """Run the suite of the wing whose class `value` belongs to; return whether there is one."""
    for _, (kind, check) in checks.items():
        if isinstance(value, kind):
            check(value, length, number, seed)
            return True
    return False
