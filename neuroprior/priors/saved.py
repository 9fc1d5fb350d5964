"""What `save` and `load` need of a module: its class by name, its arguments, and what it learned."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from torch import nn


class SavedModule(nn.Module, ABC):
    """A module that `neuroprior.save` writes and `neuroprior.load` reads: a prior of actions or of vectors."""

    known: ClassVar[dict[str, type["SavedModule"]]] = {}
    """Every subclass by name; `load` finds a folder's class here."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        SavedModule.known[cls.__name__] = cls

    @property
    @abstractmethod
    def config(self) -> dict[str, Any]:
        """The constructor's arguments that make a module like this one (JSON values)."""

    @property
    def learned(self) -> dict[str, Any]:
        """What `fit` found that is neither weights nor an argument (JSON values); saved with the module."""
        return {}

    def restore(self, learned: dict[str, Any]) -> None:
        """Take over what `learned` gave when the module was saved.

        Raises:
            ValueError: a value is not one that this module could have learned.
        """

    def __repr__(self) -> str:
        """The class with its constructor's arguments; priors made of priors show these in the same way."""
        return _call(type(self), self.config)


def _call(kind: type[SavedModule], config: Mapping[str, Any]) -> str:
    """A call of the constructor with these arguments, in the order of its parameters."""
    order = list(inspect.signature(kind).parameters)
    names = sorted(config, key=lambda name: order.index(name) if name in order else len(order))
    return f"{kind.__name__}({', '.join(f'{name}={_argument(config[name])}' for name in names)})"


def _argument(value: Any) -> str:
    if isinstance(value, Mapping) and set(value) == {"prior", "config"}:
        return _call(SavedModule.known[value["prior"]], value["config"])
    return f"[{', '.join(map(_argument, value))}]" if isinstance(value, list) else repr(value)
