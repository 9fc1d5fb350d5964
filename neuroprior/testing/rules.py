"""What the conformance suites share."""

from collections.abc import Callable

import torch
from torch import Tensor

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
