"""What the readers of plans share: opening files, columns of numbers or names, padding."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from numpy.typing import NDArray

from neuroprior._checks import check_memory, check_single_precision, is_whole, warn_caller
from neuroprior._files import MISSING_LABELS, grows_too_much, unquote_cell

Integers = NDArray[np.integer[Any]]
Floats = NDArray[np.floating[Any]]
Names = tuple[str, ...]
Place = Callable[[int], str]
"""Where an entry stands: its position among all the entries to "FILE, line N"."""

MOST_COUNTED = 2**16
"""The most actions that are counted by the largest number among them."""

LARGEST_INTEGER = 2**62
LARGEST_FLOAT = float(np.finfo(np.float32).max)
BLOCK = 2**20
"""Entries that a column holds as Python's integers or texts before they become an array."""

SHOWN = 8
"""Names in a note; more are left out."""

NUMBERED = ("action", "context")
"""Columns that hold numbers or names alone. Elsewhere, as among groups, one name makes names of all."""

_MISSING = frozenset(MISSING_LABELS)


def is_missing(text: str) -> bool:
    """Whether a cell holds no label."""
    return text.strip().lower() in _MISSING


def check_file(path: Path) -> None:
    """Raise FileNotFoundError for no file, ValueError for a directory or an empty file."""
    if path.is_dir():
        raise ValueError(f"{path}: a directory; a file of plans is expected")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: an empty file; plans are expected")


def check_plain(path: Path) -> None:
    """Raise ValueError for a file whose beginning is not that of a text in UTF-8, or is that of a web page."""
    with open(path, "rb") as file:
        begin = file.read(1024)
    if b"\0" in begin[:4]:  # of UTF-16 the first letter shows it
        raise ValueError(f"{path}, line 1: not UTF-8 (UTF-16, or no text at all); save the file as UTF-8")
    if begin.lstrip().lower().startswith((b"<!doctype", b"<html", b"<?xml")):
        raise ValueError(f"{path}: a web page or XML; plans are expected")


@contextmanager
def open_text(path: Path) -> Iterator[IO[str]]:
    """A UTF-8 file, with or without a byte order mark, opened for reading; line ends are left as they are.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a directory, an empty file or one that is not UTF-8; the message names the line and the byte.
    """
    check_file(path)
    check_plain(path)
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            yield file
    except UnicodeDecodeError:
        raise ValueError(f"{path}{_not_utf8(path)}; save the file as UTF-8") from None


def _not_utf8(path: Path) -> str:
    # The error counts bytes from the start of a buffer: the file is read again to find the line.
    with open(path, "rb") as file:
        for number, line in enumerate(file, 1):
            try:
                line.decode("utf-8")
            except UnicodeDecodeError as error:
                return f", line {number}: byte {error.start + 1} of the line is not UTF-8"
    return ": not UTF-8"


class Column(dict[str, int]):
    """The actions, contexts or groups of a file: whole numbers, or texts, which are numbered as they appear.

    The object is itself the mapping from a text to its number, so that texts are looked up at the speed of a dict.

    Args:
        what: "action", "context" or "group", for messages.
        names: the possible names in the order of their numbers; None where the file decides.
        count: how many different ones are possible, if known.
        untyped: texts are cells of a CSV file: whole numbers if all of them can be read as such.
        blank: a missing label is allowed, and gets the number -1.
    """

    def __init__(
        self,
        what: str,
        names: Names | None = None,
        count: int | None = None,
        untyped: bool = False,
        blank: bool = False,
    ) -> None:
        super().__init__()
        self.what, self.names, self.untyped, self.blank = what, names, untyped, blank
        self.count = len(names) if names is not None else count
        self.labels: dict[str, int] = {}
        self.waiting: list[Any] = []
        self.blocks: list[Integers] = []

    def __missing__(self, text: str) -> int:
        """Number a new text; ValueError (which does not know the line) for one that is neither a number nor a name."""
        label = unquote_cell(text.strip()) if self.untyped else text
        if self.blank and is_missing(label) and label not in (self.names or ()):
            number = -1
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
            raise ValueError(f"`{self.what}` must be a number or a name, got an empty cell")
        if self.what in NUMBERED and isinstance(number_in(label, self.what), float):
            hint = "features go into columns context_1, context_2, ..." if self.what == "context" else "or a name"
            raise ValueError(f"{self.what} {label!r} is not a whole number ({hint})")

    def look_up(self, texts: Sequence[str]) -> Integers:
        """The numbers `[len(texts)]` of texts, in order of appearance."""
        return np.fromiter(map(self.__getitem__, texts), np.int64, len(texts))

    def add(self, values: Sequence[int | str]) -> None:
        """Append whole numbers or texts, the same kind in all calls."""
        self.waiting.extend(values)
        if len(self.waiting) >= BLOCK:
            self._pack()

    def add_numbers(self, numbers: Integers) -> None:
        """Append a block of what `look_up` gave."""
        if numbers.size and numbers.min() >= 0:
            numbers = numbers.astype(np.min_scalar_type(int(numbers.max())))
        self.blocks.append(numbers)

    def _pack(self) -> None:
        is_text = bool(self.waiting) and type(self.waiting[0]) is str
        self.add_numbers(self.look_up(self.waiting) if is_text else np.array(self.waiting, np.int64))
        self.waiting = []

    def numbers(self) -> Integers:
        """All entries in the order in which they were added; texts by their number in order of appearance."""
        if self.waiting or not self.blocks:
            self._pack()
        self.blocks = [np.concatenate(self.blocks)]
        return self.blocks[0]

    def finish(self, place: Place) -> tuple[Integers, Names | None]:
        """All numbers, in the order in which they were added, and the names that they stand for (None for none).

        Raises:
            ValueError: an entry that is none of the names, negative or too large; the message says where.
        """
        values = self.numbers()
        if not self.labels:
            return self._in_range(values, place), self.names
        labels = list(self.labels)
        numbers = [number_in(label, self.what) if self.untyped else None for label in labels]
        named = self.names is not None and all(label in self.names for label in labels)
        whole = all(isinstance(number, int) or (number is not None and self.what in NUMBERED) for number in numbers)
        if not named and whole:
            return self._in_range(np.array(numbers, np.int64)[values], place), self.names
        names = self.names if self.names is not None else tuple(sorted(labels))
        wrong = self._wrong_label(labels, numbers)
        if wrong is not None:
            raise ValueError(f"{place(int((values == wrong[0]).argmax()))}: {wrong[1]}")
        rank = {name: number for number, name in enumerate(names)}
        return np.array([rank[label] for label in labels], np.min_scalar_type(len(names)))[values], names

    def _wrong_label(self, labels: list[str], numbers: list[int | float | None]) -> tuple[int, str] | None:
        """The number of the first text that is wrong among names, and what is wrong with it."""
        if self.names is not None:
            wrong = next((i for i, label in enumerate(labels) if label not in self.names), None)
            return None if wrong is None else (wrong, f"{self.what} {labels[wrong]!r} is none of {listed(self.names)}")
        missing = [i for i, label in enumerate(labels) if self.what == "action" and is_missing(label)]
        if missing:
            return missing[0], f"action {labels[missing[0]]!r} means no label; give action_names if it is an action"
        # One subject called 12b makes names of the other subjects' numbers; a name among numbers of actions or contexts
        # is rather a slip, and would renumber them all.
        is_number = [number is not None for number in numbers]
        if self.what in NUMBERED and any(is_number):
            wrong = is_number.index(not is_number[0])
            kinds = ("a name where others are numbers", "a number where others are names")
            hint = "; give action_names if all are names, or name the columns of a header action_1, ..."
            hint = hint if self.what == "action" else ""
            return wrong, f"{self.what} {labels[wrong]!r} is {kinds[is_number[wrong]]}{hint}"
        if self.count is not None and len(labels) > self.count:
            return self.count, f"{self.what} {labels[self.count]!r} is one more than the {self.count} there are"
        return None

    def _in_range(self, values: Integers, place: Place) -> Integers:
        lowest, stop = (0 if self.what in NUMBERED or self.names else -LARGEST_INTEGER), self.count or LARGEST_INTEGER
        if values.size and (values.min() < lowest or values.max() >= stop):
            wrong = int(((values < lowest) | (values >= stop)).argmax())
            expected = f"0 to {stop - 1} are expected" if self.count else "0 or more is expected"
            raise ValueError(f"{place(wrong)}: {self.what} {values[wrong]} is out of range; {expected}")
        return values


def number_in(text: str, what: str = "action") -> int | float | None:
    """The number in a cell: int if it is whole, float if not, None for a name.

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


def named(values: Any, names: Sequence[str] | None) -> Any:
    """Numbers, in lists of any depth, replaced by their names where there are any: for writing."""
    if names is None:
        return values
    return [named(value, names) for value in values] if isinstance(values, list) else names[values]


def warn_of_unused(path: Path, what: str, names: Sequence[str]) -> None:
    """Warn of arrays or keys of a file that are not used, such as misspelt ones."""
    if names:
        warn_caller(f"{path}: {what} that are not used: {listed(names)}")


def listed(values: Sequence[Any] | NDArray[Any], number: int | None = None) -> str:
    """The first `SHOWN` of some values, and how many more there are; `number` of them in all."""
    more = (len(values) if number is None else number) - SHOWN
    return ", ".join(map(str, values[:SHOWN])) + (f" and {more:,} more" if more > 0 else "")


def check_distinct(what: str, names: Sequence[str] | None) -> None:
    """Raise ValueError where a name occurs twice, so that a text would stand for two numbers."""
    if names is not None and len(set(names)) < len(names):
        twice = next(name for name in names if list(names).count(name) > 1)
        raise ValueError(f"`{what}` must be different names, got {twice!r} twice")


def check_names(num_actions: int | None, action_names: Sequence[str] | None) -> Names | None:
    """The names as a tuple; ValueError for names, or a number of actions, that are impossible."""
    if num_actions is not None and (not is_whole(num_actions) or num_actions < 1):
        raise ValueError(f"`num_actions` must be an integer of at least 1, got {num_actions!r}")
    if action_names is None:
        return None
    names = tuple(action_names)
    if isinstance(action_names, str) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"`action_names` must be a list of names, got {action_names!r}")
    check_distinct("action_names", names)
    if num_actions not in (None, len(names)):
        raise ValueError(f"`action_names` must be {num_actions} names, as many as num_actions, got {len(names)}")
    return names


def count_up_to(largest: int) -> int:
    """How many actions there are if nothing but the largest number among them says so.

    Raises:
        ValueError: it is too large to be taken for one of as many; it may be a time, or the number of an animal.
    """
    if largest >= MOST_COUNTED:
        raise ValueError(
            f"`actions` must be below {MOST_COUNTED} where nothing says how many there are, got {largest}; give"
            " num_actions or action_names"
        )
    return largest + 1


def as_single(name: str, features: NDArray[Any]) -> NDArray[np.float32]:
    """Features `[N, C]` as float32; ValueError where these would not hold how they vary."""
    check_single_precision(name, torch.from_numpy(features))
    return features.astype(np.float32)


def padded(values: NDArray[Any], lengths: Integers, source: str) -> NDArray[Any]:
    """`[N, L, ...]` of values `[S, ...]`, zero after the end of a plan; ValueError where nearly all would be zeros."""
    longest = int(lengths.max()) if len(lengths) else 0
    shape = (len(lengths), longest, *values.shape[1:])
    needed = len(lengths) * longest * (values.nbytes // max(len(values), 1))
    if grows_too_much(needed, values.nbytes):
        raise ValueError(
            f"{source}: {len(lengths):,} plans with {len(values):,} actions would take {needed:,} bytes, padded to the"
            f" longest, plan {int(lengths.argmax()) + 1} of {longest:,} actions; cut it into several plans, or keep it"
            " in a file of its own"
        )
    check_memory(needed, plans=f"{len(lengths):,} of up to {longest:,} actions")
    if len(values) == len(lengths) * longest:
        return values.reshape(shape)
    wide = np.zeros(shape, values.dtype)
    wide[np.arange(longest) < lengths[:, None]] = values
    return wide
