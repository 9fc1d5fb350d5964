"""What a file of plans holds, gathered block by block into numpy arrays and put together as `Plans`."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neuroprior.plans.plans import Plans, action_dtype

Integers = NDArray[np.integer[Any]]
Floats = NDArray[np.float32]
Names = tuple[str, ...]
Place = Callable[[int], str]
"""Where an entry stands: its position among all the entries to "FILE, line N"."""

MOST_ENTRIES = 2**33
LARGEST_INTEGER = 2**62


class Column(dict[str, int]):
    """Actions, contexts or groups of a file: whole numbers, or texts, which are numbered as they appear.

    It is the mapping from a text to its number, so that a block of cells is looked up at the speed of a dict.

    Args:
        what: "action", "context" or "group", for messages.
        names: those there are, in the order of their numbers; None where the file tells.
        count: how many there are, where that is known.
        untyped: texts are cells of a CSV file: whole numbers where all of them can be read as such.
    """

    def __init__(self, what: str, names: Names | None = None, count: int | None = None, untyped: bool = False) -> None:
        super().__init__()
        self.what = what
        self.names = names
        self.count = len(names) if names is not None else count
        self.untyped = untyped
        self.blank: int | None = None
        self.labels: dict[str, int] = {}
        self.blocks: list[Integers] = []

    def __missing__(self, text: str) -> int:
        """Number a text that was not seen before; ValueError (which does not know the line) for one that is none."""
        label = text.strip() if self.untyped else text
        if self.untyped and not label and self.blank is not None:
            number = self.blank
        else:
            if self.untyped and label not in self.labels:
                self._check(label)
            number = self.labels.setdefault(label, len(self.labels))
        self[text] = number
        return number

    def _check(self, label: str) -> None:
        if self.names is not None and label in self.names:
            return
        if not label:
            raise ValueError(f"{self.what}: an empty cell; a number or a name is expected")
        if isinstance(number_in(label, self.what), float):
            hint = "features go into columns context_1, context_2, ..." if self.what == "context" else "or a name"
            raise ValueError(f"{self.what} {label!r} is not a whole number ({hint})")

    def look_up(self, texts: Sequence[str]) -> Integers:
        """The numbers `[len(texts)]` of texts, in order of appearance."""
        return np.fromiter(map(self.__getitem__, texts), np.int64, len(texts))

    def add(self, values: Integers | Sequence[int]) -> None:
        """Add a block of numbers: whole numbers of the file, or what `look_up` gave."""
        block = np.asarray(values, np.int64)
        if block.size and block.min() >= 0:
            block = block.astype(np.min_scalar_type(int(block.max())))
        self.blocks.append(block)

    def finish(self, place: Place) -> tuple[Integers, Names | None]:
        """All numbers, in the order in which they were added, and the names that they stand for (None for none).

        Raises:
            ValueError: an entry that is none of the names, negative or too large; the message says where.
        """
        values: Integers = np.concatenate(self.blocks) if self.blocks else np.zeros(0, np.int64)
        self.blocks = []
        if not self.labels:
            return self._in_range(values, place), self.names
        labels = list(self.labels)
        numbers = [number_in(label, self.what) if self.untyped else None for label in labels]
        named = self.names is not None and all(label in self.names for label in labels)
        if not named and all(number is not None for number in numbers):
            return self._in_range(np.array(numbers, np.int64)[values], place), self.names
        names = self.names if self.names is not None else tuple(sorted(labels))
        wrong = self._wrong_label(labels, numbers)
        if wrong is not None:
            raise ValueError(f"{place(int((values == wrong[0]).argmax()))}: {wrong[1]}")
        rank = {name: number for number, name in enumerate(names)}
        table = np.array([rank[label] for label in labels], np.min_scalar_type(len(names)))
        return table[values], names

    def _wrong_label(self, labels: list[str], numbers: list[int | float | None]) -> tuple[int, str] | None:
        """The number of the first text that is wrong among named ones, and what is wrong with it."""
        if self.names is not None:
            known = ", ".join(self.names[:8]) + (", ..." if len(self.names) > 8 else "")
            wrong = next((i for i, label in enumerate(labels) if label not in self.names), None)
            return None if wrong is None else (wrong, f"{self.what} {labels[wrong]!r} is none of {known}")
        # One subject called 12b makes names of the other subjects' numbers; an action or a context among numbers that
        # is none is rather a slip, and would reorder them all.
        is_number = [number is not None for number in numbers]
        if self.what != "group" and any(is_number):
            wrong = is_number.index(not is_number[0])
            kinds = ("a name where others are numbers", "a number where others are names")
            hint = "; give action_names if all are names, or name the columns of a header action_1, ..."
            hint = hint if self.what == "action" else ""
            return wrong, f"{self.what} {labels[wrong]!r} is {kinds[is_number[wrong]]}{hint}"
        if self.count is not None and len(labels) > self.count:
            return self.count, f"{self.what} {labels[self.count]!r} is one more than the {self.count} there are"
        return None

    def _in_range(self, values: Integers, place: Place) -> Integers:
        if not values.size:
            return values
        lowest, stop = (0 if self.what != "group" or self.names else -LARGEST_INTEGER), self.count or LARGEST_INTEGER
        if values.min() < lowest or values.max() >= stop:
            wrong = int(((values < lowest) | (values >= stop)).argmax())
            expected = f"0 to {stop - 1} are expected" if self.count else "0 or more is expected"
            raise ValueError(f"{place(wrong)}: {self.what} {values[wrong]} is out of range; {expected}")
        return values


def number_in(text: str, what: str = "action") -> int | float | None:
    """The number that a cell holds: int if it is whole, float if not, None for a name.

    What pandas and numpy make of whole numbers (1.0, 1e+00) is whole; a context with a decimal point is a feature.
    """
    if text.lstrip("+-").isdecimal() and text.isascii():
        return int(text) if len(text) < 18 else float(text)
    try:
        value = float(text) if "_" not in text else None
    except ValueError:
        return None
    whole = value is not None and value.is_integer() and abs(value) < 2**53 and what != "context"
    return int(value) if whole and value is not None else value


def to_features(values: Iterable[float]) -> Floats:
    """float32 of Python's floats; what is too large becomes infinite, without a warning."""
    with np.errstate(over="ignore"):
        return np.array(values, np.float64).astype(np.float32)


@dataclass
class Gathered:
    """Plans end to end: S actions of N plans, with what belongs to them.

    Attributes:
        name: the file, for messages.
        lengths: `[N]`.
        actions: `[S]`.
        num_actions: None for one more than the largest.
        context: `[N]` or `[N, C]`, or, where `per_step`, `[S]` or `[S, C]`.
        group: `[N]`.
    """

    name: str
    lengths: Integers
    actions: Integers
    num_actions: int | None = None
    action_names: Names | None = None
    context: Integers | Floats | None = None
    per_step: bool = False
    context_names: Names | None = None
    group: Integers | None = None
    group_names: Names | None = None
    end: int | None = None

    def plans(self) -> Plans:
        """They as `Plans`, padded to the longest; ValueError names the file."""
        num_actions = self.num_actions
        if self.action_names is not None:
            if num_actions not in (None, len(self.action_names)):
                raise ValueError(
                    f"{self.name}: {len(self.action_names)} names of {num_actions} actions; give action_names"
                )
            num_actions = len(self.action_names)
        if num_actions is None and not len(self.actions):
            raise ValueError(f"{self.name}: no plan has an action, so num_actions must be given")
        num_actions = int(self.actions.max()) + 1 if num_actions is None else num_actions
        dtype = torch.empty(0, dtype=action_dtype(num_actions)).numpy().dtype
        longest = int(self.lengths.max()) if len(self.lengths) else 0
        context = self.context
        if context is not None:
            context = context if context.dtype == np.float32 else context.astype(np.int64)
            context = pad(context, self.lengths, self.name) if self.per_step else context
        try:
            return Plans(
                torch.from_numpy(pad(self.actions.astype(dtype), self.lengths, self.name)),
                num_actions,
                None if self.end is None and (self.lengths == longest).all() else torch.from_numpy(self.lengths),
                self.action_names,
                None if context is None else torch.from_numpy(context),
                None if self.group is None else torch.from_numpy(self.group.astype(np.int64)),
                self.context_names,
                self.group_names,
                self.end,
            )
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from error


def pad(values: NDArray[Any], lengths: Integers, name: str) -> NDArray[Any]:
    """`[N, L, ...]` of values `[S, ...]` that stand end to end, zero after the end of a plan.

    Raises:
        ValueError: too many entries to pad: one long plan among many short ones.
    """
    longest = int(lengths.max()) if len(lengths) else 0
    shape = (len(lengths), longest, *values.shape[1:])
    entries = len(lengths) * longest * int(np.prod(values.shape[1:]))
    if entries > MOST_ENTRIES:
        raise ValueError(
            f"{name}: {len(lengths)} plans padded to the longest, plan {int(lengths.argmax()) + 1} of {longest} "
            f"actions, are {entries} entries, more than {MOST_ENTRIES}; cut long plans in pieces"
        )
    if len(values) == len(lengths) * longest:
        return values.reshape(shape)
    padded = np.zeros(shape, values.dtype)
    padded[np.arange(longest) < lengths[:, None]] = values
    return padded


def check_names(num_actions: int | None, action_names: Sequence[str] | None) -> Names | None:
    """The names as a tuple; ValueError where they or the number of actions cannot be."""
    if num_actions is not None and (type(num_actions) is not int or num_actions < 1):
        raise ValueError(f"num_actions: an integer of at least 1 is expected, not {num_actions!r}")
    if action_names is None:
        return None
    names = tuple(action_names)
    if isinstance(action_names, str) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"action_names: a list of names is expected, not {action_names!r}")
    if len(set(names)) < len(names):
        raise ValueError(f"action_names: {next(n for n in names if names.count(n) > 1)!r} is there twice")
    if num_actions not in (None, len(names)):
        raise ValueError(f"action_names: {num_actions} are expected, not {len(names)}")
    return names


def renamed(plans: Plans, names: Names | None, place: str) -> Plans:
    """The same plans with actions numbered as in `names`; those that have no names yet are given them.

    Raises:
        ValueError: an action's name is none of `names`, or their number is another.
    """
    if names is None or (plans.action_names is not None and tuple(plans.action_names) == names):
        return plans
    old = plans.action_names
    if old is None:
        if plans.num_actions != len(names):
            raise ValueError(f"{place}: {plans.num_actions} actions, but {len(names)} names of actions are given")
        return replace(plans, action_names=names)
    unknown = next((name for name in old if name not in names), None)
    if unknown is not None:
        raise ValueError(f"{place}: action {unknown!r} is none of {', '.join(names)}")
    number = torch.tensor([names.index(name) for name in old])
    return replace(
        plans,
        actions=number[plans.actions.long()],
        num_actions=len(names),
        lengths=plans.mask().sum(1) if plans.end is not None else plans.lengths,
        action_names=names,
        end=None if plans.end is None else int(number[plans.end]),
    )
