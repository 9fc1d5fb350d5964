"""Hashes of whatever simulators hold."""

import hashlib
from collections.abc import Iterator
from enum import Enum
from functools import lru_cache
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType, NoneType
from typing import Any

import numpy as np
from torch import Tensor

from neuroprior.worlds.simulators.generators import GENERATORS

GYMNASIUM_MODULES = ("gymnasium.spaces", "gymnasium.envs.registration")
"""Where classes are defined whose objects say how an environment was made, and are no part of its state."""

SEED_NAME = "_np_random_seed"
"""The attribute in which Gymnasium's environments remember the seed of their last reset."""

MUTABLE = (list, dict, set, np.ndarray, Tensor)


def digest(value: Any) -> bytes:
    """A hash of a value, 16 bytes: of all that it holds, however deep, except random generators.

    Raises:
        ValueError: something that it holds cannot be read.
    """
    writer = _Writer()
    writer.value(value)
    text = "\n".join(writer.parts)
    return hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=16).digest()


def fingerprint(value: Any) -> bytes:
    """A hash of a value and of what its class holds; of what cannot be read, always the same."""
    try:
        of_class = [
            inner
            for kind in type(value).__mro__
            for name, inner in vars(kind).items()
            if isinstance(inner, MUTABLE) and not name.startswith("__")  # such as those that pickle writes
        ]
        return digest([value, of_class])
    except ValueError:
        return b""


class _Writer:
    """Writes values as text that depends on nothing but what they are: not on addresses, dtypes or insertion order.

    Attributes:
        parts: the text so far.
    """

    def __init__(self) -> None:
        self.parts: list[str] = []
        self._seen: dict[int, int] = {}
        self._kept: list[Any] = []  # so that no address is used twice

    def _attributes(self, thing: Any) -> None:
        values = vars(thing)
        for name in sorted(values.keys() - {SEED_NAME}):
            self.parts.append(name)
            self.value(values[name])

    def value(self, value: Any) -> None:
        """Any value, however deep."""
        kind: Any = type(value)
        way = _way(kind)
        if way == "value":
            self.parts.append(repr(value))
        elif way == "enum":
            self.parts.append(repr(value.value))
        elif way == "scalar":
            self.parts.append(repr(value.item()))
        elif way == "named":
            self.parts.append(getattr(value, "__qualname__", value.__name__))
        elif way == "left out":
            self.parts.append("-")
        elif way == "array" and value.size > 64 and value.dtype != object:
            self.parts.append(f"{value.dtype}{value.shape}{value.tobytes().hex()}")
        elif way == "array":
            self.value(value.tolist())
        elif way == "tensor":
            self.value(value.detach().cpu().numpy())
        elif id(value) in self._seen:
            self.parts.append(f"@{self._seen[id(value)]}")
        else:
            if not isinstance(value, tuple):  # equal tuples cannot be distinguished
                self._seen[id(value)] = len(self._seen)
                self._kept.append(value)
            self._compound(value)

    def _compound(self, value: Any) -> None:
        kind: Any = type(value)
        self.parts.append("list" if kind is tuple else kind.__qualname__)
        if kind in (list, tuple):
            self.parts.append(str(len(value)))
            for inner in value:
                self.value(inner)
        elif kind in (set, frozenset):
            self.parts.append(",".join(sorted(repr(inner) for inner in value)))
        elif kind is dict:
            self.parts.append(str(len(value)))
            for key in sorted(value, key=repr):
                self.parts.append(repr(key))
                self.value(value[key])
        elif _is_plain(kind):
            self._attributes(value)
        else:
            self._reduction(value)

    def _reduction(self, value: Any) -> None:
        """What pickle would write, for a value that is more than its attributes."""
        try:
            reduced = value.__reduce_ex__(4)
        except Exception as error:
            raise ValueError(f"a {type(value).__name__} cannot be read, so that states cannot be compared") from error
        for entry in reduced:
            self.value(list(entry) if isinstance(entry, Iterator) else entry)


@lru_cache(1000)
def _way(kind: type) -> str:
    """How values of a type are written; one that is made of others, "compound"."""
    if issubclass(kind, (NoneType, int, float, str, bytes, complex)):
        return "enum" if issubclass(kind, Enum) else "value"
    if kind.__module__.startswith(GYMNASIUM_MODULES):
        return "left out"
    ways: dict[str, Any] = {
        "scalar": np.generic,
        "named": (FunctionType, BuiltinFunctionType, MethodType, ModuleType, type),
        "left out": GENERATORS,
        "array": np.ndarray,
        "tensor": Tensor,
    }
    return next((way for way, kinds in ways.items() if issubclass(kind, kinds)), "compound")


@lru_cache(1000)
def _is_plain(kind: type) -> bool:
    """Whether values of a type are their attributes, and nothing else."""
    if any(getattr(kind, name) is not getattr(object, name) for name in ("__reduce__", "__reduce_ex__")):
        return False
    return kind.__dictoffset__ != 0 and not any(vars(base).get("__slots__") for base in kind.__mro__)
