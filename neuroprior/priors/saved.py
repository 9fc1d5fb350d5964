"""What `save` and `load` need of a module: its class by name, its arguments, and what it learned."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from neuroprior._registry import Registry


class SavedModule(nn.Module, ABC):
    """A module that `neuroprior.save` writes and `neuroprior.load` reads: a prior of actions or of vectors."""

    known: ClassVar[Registry[type["SavedModule"]]] = Registry()
    """Every subclass by name; `load` finds a folder's class here."""

    tables: tuple[str, ...] = ()
    """Buffers whose sizes depend on what was learned, so that they are taken from the file."""

    log_tables: tuple[str, ...] = ()
    """Buffers of log-probabilities, which may be -inf; everything else is finite."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        SavedModule.known.add(cls.__name__, cls)

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

    def tables_fit(self) -> bool:
        """Whether the `tables` are those of a module of this kind; checks what was read from a file."""
        return True

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """What `nn.Module` moves a module by; also refuses another precision, in which not every prior computes."""
        dtype = fn(torch.zeros(0, dtype=torch.float32)).dtype
        if dtype != torch.float32:
            raise ValueError(
                f"priors must compute in single precision, torch.float32, got {dtype}; on a GPU torch.autocast may do"
                " with less"
            )

        def move(values: Tensor) -> Tensor:
            moved = fn(values)
            return moved if moved.dtype == values.dtype else values.to(moved.device)  # counts are float64

        applied: Self = super()._apply(move, recurse)
        return applied

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *args: Any) -> None:
        for name in self.tables:
            if prefix + name in state_dict:
                device = getattr(self, name).device
                self.register_buffer(name, torch.empty_like(state_dict[prefix + name], device=device))
        super()._load_from_state_dict(state_dict, prefix, *args)
        if not self.tables_fit():
            raise RuntimeError(f"the tables of a {type(self).__name__} do not fit one another")

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
        kind = SavedModule.known.find(value["prior"])
        assert kind is not None
        return _call(kind, value["config"])
    return f"[{', '.join(map(_argument, value))}]" if isinstance(value, list) else repr(value)
