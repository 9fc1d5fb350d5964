"""Contexts of a JSONL file: of which kind they are, for the file as a whole, and their numbers."""

from itertools import chain
from typing import Any

import numpy as np

from neuroprior.plans.io.columns import LARGEST_INTEGER, Column, Floats, Integers, Names, Place, to_features

KINDS = {
    "none": "no context",
    "index": "an integer",
    "name": "a name",
    "numbers": "a list of numbers",
    "names": "a list of names",
    "rows": "a list of lists of numbers",
    "empty": "an empty list",
}
LISTS = ("numbers", "names", "rows")
LARGEST_FLOAT = float(np.finfo(np.float32).max)


class Contexts:
    """The contexts of the plans read so far.

    Args:
        names: of the contexts, from the file's header.
    """

    def __init__(self, names: Names | None) -> None:
        self.kind: str | None = None  # None until a plan tells: an empty list does not
        self.any_empty = False
        self.any_float = False
        self.width = -1
        self.column = Column("context", names)
        self.floats: list[Floats] = []
        self.sizes: list[Integers] = []
        self.waiting: list[Any] = []
        self.waiting_sizes: list[int] = []

    def add(self, value: Any) -> None:
        """Take up the context of one plan, None where it has none; ValueError where it is wrong or of another kind."""
        kind = self._kind_of(value)
        before = self.kind or ("empty" if self.any_empty else None)
        fits = {None: True, "empty": kind in (*LISTS, "empty")}.get(before, kind == before)
        if not fits and not (kind == "empty" and before in LISTS):
            raise ValueError(f"context: {KINDS[kind]}, where the plans before have {KINDS[before or 'none']}")
        if kind == "empty":
            self.any_empty = True
        else:
            self.kind = kind
        if kind in ("index", "name"):
            self.waiting.append(value)
        elif kind == "rows":
            self.waiting.extend(chain.from_iterable(value))
        elif kind != "none":
            self.waiting.extend(value)
        self.waiting_sizes.append(len(value) if isinstance(value, list) else 1)

    def _kind_of(self, value: Any) -> str:
        if value is None:
            return "none"
        if type(value) is str:
            return "name"
        if type(value) is int:
            _check_numbers([value], {int})
            return "index"
        if type(value) is not list:
            raise ValueError(f"context: {shown(value)} is neither an integer, a name nor a list")
        kinds = set(map(type, value))
        if not kinds:
            return "empty"
        if kinds == {str}:
            return "names"
        if kinds == {list}:
            self._check_rows(value)
            return "rows"
        _check_numbers(value, kinds)
        self.any_float = self.any_float or float in kinds
        return "numbers"

    def _check_rows(self, rows: list[list[Any]]) -> None:
        for row in rows:
            if not row:
                raise ValueError("context: an empty list of features")
            _check_numbers(row, set(map(type, row)))
            if self.width == -1:
                self.width = len(row)
            if len(row) != self.width:
                raise ValueError(f"context: {len(row)} features of a step, where the steps before have {self.width}")

    def flush(self) -> None:
        """Turn what was taken up since the last time into arrays."""
        self.sizes.append(np.array(self.waiting_sizes, np.int64))
        if self.kind in ("name", "names"):
            self.column.add(self.column.look_up(self.waiting))
        elif self.kind == "rows" or (self.kind == "numbers" and self.any_float):
            self.floats.append(to_features(self.waiting))
        else:  # whole numbers so far: they are features if a later plan has a decimal point
            self.column.add(self.waiting)
        self.waiting, self.waiting_sizes = [], []

    def finish(
        self, lengths: Integers, plan: Place, step: Place
    ) -> tuple[Integers | Floats | None, Names | None, bool]:
        """The contexts `[N]`, `[N, C]`, `[S]` or `[S, C]`, their names, and whether there is one a step.

        Args:
            lengths: `[N]`.
            plan: the place of a plan.
            step: the place of a step.
        """
        sizes = np.concatenate(self.sizes)
        if self.kind == "none":
            return None, None, False
        if self.kind in ("index", "name"):
            return *self.column.finish(plan), False
        if self.kind == "numbers" and self.any_float:
            wrong = np.flatnonzero(sizes != sizes[0])
            if wrong.size:
                i = int(wrong[0])
                raise ValueError(f"{plan(i)}: context: {sizes[i]} features, where the first plan has {sizes[0]}")
            whole = [block.astype(np.float32) for block in self.column.blocks]
            return np.concatenate([*whole, *self.floats]).reshape(len(sizes), -1), None, False
        wrong = np.flatnonzero(sizes != lengths)
        if wrong.size:
            i = int(wrong[0])
            hint = "; features of a plan need a decimal point, as in 1.0" if self.kind == "numbers" else ""
            raise ValueError(f"{plan(i)}: context: {sizes[i]} entries for {lengths[i]} actions{hint}")
        if self.kind == "rows":
            return np.concatenate(self.floats).reshape(-1, self.width), None, True
        return *self.column.finish(step), True


def _check_numbers(values: list[Any], kinds: set[type]) -> None:
    if not kinds <= {int, float}:
        wrong = next(value for value in values if type(value) not in (int, float))
        raise ValueError(f"context: {shown(wrong)} is not a number, where numbers are expected")
    largest = LARGEST_FLOAT if float in kinds else LARGEST_INTEGER
    if not -largest <= min(values) <= max(values) <= largest:
        raise ValueError(f"context: {shown(max(values, key=abs))} is too large")


def shown(value: Any) -> str:
    """A value for a message, not longer than a part of a line."""
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:36]} ..."
