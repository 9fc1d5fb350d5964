"""Everything that an object holds, however deep, with the path that leads there."""

import math
from collections import deque
from collections.abc import Iterator
from functools import partial
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType, NoneType
from typing import Any

import numpy as np
from torch import Tensor

MAX_ELEMENTS = 64
"""Numbers of an array that are looked at one by one."""

Path = tuple[tuple[bool, Any], ...]
"""Steps from an object inwards: True and an attribute's name, or False and a key."""

ATOMS = (NoneType, int, float, complex, str, bytes, type, FunctionType, ModuleType, np.generic)


def walk(root: Any) -> Iterator[tuple[Path, Any]]:
    """Yields each value that `root` holds, after its path; an object that is held twice comes once."""
    seen, waiting = {id(root)}, deque[tuple[Path, Any]]([((), root)])
    while waiting:
        path, value = waiting.popleft()
        yield path, value
        for step, inner in _children(value):
            if not isinstance(inner, ATOMS):
                if id(inner) in seen:
                    continue
                seen.add(id(inner))
            waiting.append(((*path, step), inner))


def read(root: Any, path: Path) -> Any:
    """The value at the end of a path.

    Raises:
        LookupError, AttributeError, TypeError: the path leads nowhere.
    """
    for is_attribute, key in path:
        root = getattr(root, key) if is_attribute else root[key]
    return root


def write(root: Any, path: Path, value: Any) -> None:
    """Put a value at the end of a path."""
    holder, (is_attribute, key) = read(root, path[:-1]), path[-1]
    if is_attribute:
        setattr(holder, key, value)
    else:
        holder[key] = value


def name_path(path: Path) -> str:
    """A path as it stands in code, such as `memory["t"]`."""
    text = "".join(f".{key}" if is_attribute else f"[{key!r}]" for is_attribute, key in path)
    return text.removeprefix(".").replace("'", '"')


def _children(value: Any) -> Iterator[tuple[tuple[bool, Any], Any]]:
    """What a value holds itself, each after the step that leads to it."""
    if isinstance(value, ATOMS):
        return
    if isinstance(value, (BuiltinFunctionType, MethodType)):
        yield (True, "__self__"), value.__self__
        return
    if isinstance(value, dict):
        yield from (((False, key), inner) for key, inner in list(value.items()))
    elif isinstance(value, (list, tuple, deque)):
        yield from (((False, at), inner) for at, inner in enumerate(value))
    elif isinstance(value, np.ndarray) and value.dtype == object:
        yield from (((False, at), inner) for at, inner in np.ndenumerate(value))
    elif isinstance(value, (np.ndarray, Tensor)) and math.prod(value.shape) <= MAX_ELEMENTS:
        yield from (((False, at), value[at].item()) for at in np.ndindex(*value.shape))
    elif isinstance(value, partial):
        yield from (((True, name), getattr(value, name)) for name in ("func", "args", "keywords"))
        return
    names = dict.fromkeys(getattr(value, "__dict__", ()))
    for base in type(value).__mro__:
        slots = vars(base).get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            private = name.startswith("__") and not name.endswith("__")
            names[f"_{base.__name__.lstrip('_')}{name}" if private else name] = None
    for name in names:
        if isinstance(name, str) and name not in ("__dict__", "__weakref__") and hasattr(value, name):
            yield (True, name), getattr(value, name)
