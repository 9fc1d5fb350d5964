"""What wings add to the core, found by name: the core imports no wing, and asks here."""

from collections.abc import Iterator
from importlib import import_module
from typing import Generic, TypeVar

WINGS = ("neuroprior.behaviour", "neuroprior.control", "neuroprior.puzzles")

T = TypeVar("T")


class Registry(Generic[T]):
    """Entries by name. A name that is not known yet is looked for in the wings, which add theirs when imported.

    Args:
        entries: those of the core.

    Example:
        >>> from neuroprior._registry import Registry
        >>> numbers = Registry(one=1)
        >>> numbers.add("two", 2)
        >>> numbers.find("two"), numbers.find("three")
        (2, None)
    """

    def __init__(self, **entries: T) -> None:
        self._entries = entries

    def add(self, name: str, entry: T) -> None:
        """Enter `entry`; an entry of the same name is replaced."""
        self._entries[name] = entry

    def find(self, name: str) -> T | None:
        """Return the entry of this name, or None."""
        if name not in self._entries:
            import_wings()
        return self._entries.get(name)

    def __iter__(self) -> Iterator[str]:
        """The names of all entries, those of the wings last."""
        import_wings()
        return iter(self._entries)

    def items(self) -> list[tuple[str, T]]:
        """Return the entries known so far, with their names; imports no wing."""
        return list(self._entries.items())


_ADDING = {"neuroprior.behaviour": "neuroprior.behaviour.durations.semi_markov"}
"""The modules of wings that add to the registries, where it is not the wing itself."""


def import_wings() -> None:
    """Import all wings, which add what they have to the registries."""
    for wing in WINGS:
        import_module(_ADDING.get(wing, wing))
