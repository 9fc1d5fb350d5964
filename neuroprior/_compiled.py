"""Compiled loops, which need the extra `fast`; everything works without them."""

from functools import cache
from importlib import import_module
from typing import Any


@cache
def compiled(name: str) -> Any:
    """The module of this name with compiled loops; None where numba is not installed, or does not work here."""
    try:
        return import_module(name)
    except Exception:  # a numba that does not fit numpy may fail in any way
        return None
