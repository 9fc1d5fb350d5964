"""Telling states of Gymnasium environments apart, by all that they hold but their random generators."""

import hashlib
import random
from collections.abc import Iterator
from enum import Enum
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroprior.worlds.gymnasium.opening import import_gymnasium, layers

IGNORED = frozenset({"env", "spec", "_np_random_seed", "lastaction"})
"""Attributes that are no part of a state: what is wrapped is looked at by itself; toy texts only draw `lastaction`."""

GENERATORS = (np.random.Generator, np.random.RandomState, random.Random, torch.Generator)


def reseed(env: Any, seed: int) -> None:
    """Set all random generators that the environment and its wrappers hold, however deep, to other numbers."""
    writer = _Writer()
    writer.environment(env)
    for generator in writer.generators:
        if isinstance(generator, np.random.Generator):
            generator.bit_generator.state = type(generator.bit_generator)(seed).state
        elif isinstance(generator, torch.Generator):
            generator.manual_seed(seed)
        else:
            generator.seed(seed)


def digest(env: Any) -> bytes:
    """16 bytes that tell states apart: all attributes of an environment and its wrappers, but for random generators.

    Raises:
        ValueError: an attribute cannot be read.
    """
    writer = _Writer()
    writer.environment(env)
    text = "\n".join(writer.parts)
    return hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=16).digest()


class _Writer:
    """Writes values as text that depends on nothing but what they are: not on addresses, dtypes or insertion order.

    Attributes:
        parts: the text so far.
        generators: the random generators that were met, which are not written.
    """

    def __init__(self) -> None:
        self.parts: list[str] = []
        self.generators: list[Any] = []
        self._seen: dict[int, int] = {}
        self._kept: list[Any] = []  # so that no address is used twice
        self._space = import_gymnasium().Space

    def environment(self, env: Any) -> None:
        """The attributes of an environment and of its wrappers."""
        for layer in layers(env):
            self._attributes(layer)

    def _attributes(self, thing: Any) -> None:
        for name, value in sorted(vars(thing).items()):
            if name not in IGNORED:
                self.parts.append(name)
                self.value(value)

    def value(self, value: Any) -> None:
        """Any value, however deep."""
        if value is None or isinstance(value, (int, float, str, bytes, complex)):
            self.parts.append(repr(value.value if isinstance(value, Enum) else value))
        elif isinstance(value, np.generic):
            self.parts.append(repr(value.item()))
        elif isinstance(value, (FunctionType, BuiltinFunctionType, MethodType, ModuleType, type)):
            self.parts.append(getattr(value, "__qualname__", value.__name__))
        elif isinstance(value, GENERATORS):
            self.generators.append(value)
        elif isinstance(value, self._space):
            self.parts.append("space")
        elif isinstance(value, np.ndarray) and value.size > 64 and value.dtype != object:
            self.parts.append(f"{value.dtype}{value.shape}{value.tobytes().hex()}")
        elif isinstance(value, np.ndarray):
            self.value(value.tolist())
        elif isinstance(value, Tensor):
            self.value(value.detach().cpu().numpy())
        elif id(value) in self._seen:
            self.parts.append(f"@{self._seen[id(value)]}")
        else:
            if not isinstance(value, tuple):  # nobody can tell a tuple from its equal
                self._seen[id(value)] = len(self._seen)
                self._kept.append(value)
            self._compound(value)

    def _compound(self, value: Any) -> None:
        kind = type(value)
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
        elif _is_plain(value):
            self._attributes(value)
        else:
            self._reduced(value)

    def _reduced(self, value: Any) -> None:
        """What pickle would write of a value that has more to it than attributes."""
        try:
            reduced = value.__reduce_ex__(4)
        except Exception as error:
            raise ValueError(
                f'env: it holds a {type(value).__name__}, by which its states cannot be told apart; use method="step"'
            ) from error
        for part in reduced:
            self.value(list(part) if isinstance(part, Iterator) else part)


def _is_plain(value: Any) -> bool:
    """Whether a value is its attributes, and nothing else."""
    kind = type(value)
    if any(getattr(kind, name) is not getattr(object, name) for name in ("__reduce__", "__reduce_ex__")):
        return False
    return hasattr(value, "__dict__") and not any("__slots__" in vars(base) for base in kind.__mro__)
