"""Rows of CSV files in blocks: delimiter, header, and the lines they stand on."""

import csv
import re
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from neuroprior.plans.io.columns import Column, Floats, Integers, Names, Place, to_features
from neuroprior.plans.io.opening import open_text

BLOCK = 2**10
"""Rows that are in memory as texts at a time; a few times faster than blocks that no cache holds."""
DELIMITERS = (",", ";", "\t")
_OTHER_WORDS = re.compile(r"session|subject|animal|behaviou?r|group|context|time|frame|event|label|trial|code")
_WORDS = re.compile(r"plan|action(_1)?|context_1")
Row = list[str]
T = TypeVar("T")


class Sheet:
    """A CSV file: its columns, and its rows in blocks.

    Attributes:
        path: the file.
        header: the position of each column by its name, in lower case; None where the first row is data.
        width: the number of cells of every row.

    Raises:
        ValueError: an empty file, one that is not UTF-8 or not CSV, or a header with a column twice.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.header: dict[str, int] | None = None
        with open_text(path) as file:
            sample = next((line for line in file if line.strip()), "")
        self.delimiter = _delimiter(sample)
        first = next((row for _, rows in self._all() for row in rows), None)
        if first is None:
            raise ValueError(f"{path}: no rows; plans are expected")
        self.width = len(first)
        names = _header(first)
        if any(_WORDS.fullmatch(name) for name in names):
            known = [name for name in names if re.fullmatch(r"plan|group|(action|context)(_\d+)?", name)]
            twice = next((name for name in known if known.count(name) > 1), None)
            if twice is not None:
                raise ValueError(f"{path}, line 1: the column {twice!r} is there twice")
            self.header = {name: i for i, name in enumerate(names)}
        elif other := next((name for name in names if _OTHER_WORDS.fullmatch(name)), None):
            raise ValueError(
                f"{path}, line 1: looks like a header ({other!r}) without a column 'action' (or 'action_1', ...); name"
                " the column that holds the actions so, and 'plan' the one that tells sequences apart"
            )

    def blocks(self) -> Iterator[tuple[Integers, list[Row]]]:
        """The rows below the header, all of `width` cells, in blocks, with the line on which each ends."""
        skip = 0 if self.header is None else 1
        for lines, rows in self._all():
            if len({len(row) for row in rows} - {self.width}):
                wrong = next(i for i, row in enumerate(rows) if len(row) != self.width)
                like = "first row" if self.header is None else "header"
                raise ValueError(
                    f"{self.path}, line {lines[wrong]}: {len(rows[wrong])} cells, where the {like} has {self.width}"
                )
            yield lines[skip:], rows[skip:]
            skip = 0

    def _all(self) -> Iterator[tuple[Integers, list[Row]]]:
        """All rows but blank ones."""
        with open_text(self.path) as file:
            reader = csv.reader(file, delimiter=self.delimiter, strict=True)
            while True:
                start = reader.line_num
                try:
                    rows = list(islice(reader, BLOCK))
                except csv.Error as error:
                    raise ValueError(f"{self.path}, line {reader.line_num}: not CSV ({error})") from None
                if not rows:
                    return
                lines = np.arange(start + 1, start + len(rows) + 1)
                if reader.line_num != start + len(rows):  # a quoted cell goes over several lines
                    taken = [1 + sum(len(re.findall(r"\r\n|\r|\n", cell)) for cell in row) for row in rows]
                    lines = start + np.cumsum(taken)
                if not all(rows):
                    lines = lines[[bool(row) for row in rows]]
                    rows = [row for row in rows if row]
                yield lines, rows

    def column(self, name: str) -> int | None:
        """The position of a column, None where there is none."""
        return None if self.header is None else self.header.get(name)

    def numbered(self, name: str) -> list[int]:
        """The positions of the columns `name_1`, `name_2`, ...; ValueError where one between them is missing."""
        found = {}
        for column, i in (self.header or {}).items():
            if match := re.fullmatch(rf"{name}_(\d+)", column):
                found[int(match[1])] = i
        missing = next((number for number in range(1, len(found) + 1) if number not in found), None)
        if missing is not None:
            raise ValueError(f"{self.path}, line 1: columns up to {name}_{max(found)}, but {name}_{missing} is missing")
        return [found[number] for number in range(1, len(found) + 1)]

    def parse(self, parse: Callable[[list[Row]], T], lines: Integers, rows: list[Row]) -> T:
        """What `parse` makes of a block; if that fails, the message names the first line that is wrong."""
        try:
            return parse(rows)
        except ValueError:
            for line, row in zip(lines.tolist(), rows, strict=True):
                try:
                    parse([row])
                except ValueError as error:
                    raise ValueError(f"{self.path}, line {line}: {error}") from None
            raise


class Beside:
    """What stands beside the actions in a row: context and group.

    Raises:
        ValueError: the header has both `context` and `context_1`.
    """

    def __init__(self, sheet: Sheet) -> None:
        self.index, self.features = sheet.column("context"), sheet.numbered("context")
        if self.index is not None and self.features:
            raise ValueError(f"{sheet.path}, line 1: 'context' and 'context_1'; one of them is expected")
        self.context = Column("context", untyped=True)
        self.floats: list[Floats] = []
        self.group_at = sheet.column("group")
        self.group = Column("group", untyped=True)

    def parse(self, rows: list[Row]) -> tuple[Integers | Floats | None, Integers | None]:
        """The contexts and the groups of some rows; ValueError for one that is wrong."""
        context: Integers | Floats | None = None
        if self.index is not None:
            context = self.context.look_up([row[self.index] for row in rows])
        elif self.features:
            context = features(rows, self.features)
        at = self.group_at
        return context, None if at is None else self.group.look_up([row[at] for row in rows])

    def add(self, parsed: tuple[Integers | Floats | None, Integers | None]) -> None:
        """Take up what `parse` made of a block."""
        context, group = parsed
        if context is not None and self.features:
            self.floats.append(context.astype(np.float32))
        elif context is not None:
            self.context.add(context.astype(np.int64))
        if group is not None:
            self.group.add(group)

    def finish(self, place: Place) -> tuple[Integers | Floats | None, Names | None, Integers | None, Names | None]:
        """Contexts `[rows]` or `[rows, C]`, their names, groups `[rows]`, their names; None for what is not there."""
        context: tuple[Integers | Floats | None, Names | None] = (None, None)
        if self.features:
            context = np.concatenate(self.floats), None
        elif self.index is not None:
            context = self.context.finish(place)
        return *context, *((None, None) if self.group_at is None else self.group.finish(place))


def cells(rows: list[Row], columns: list[int]) -> list[str]:
    """The cells of some columns, row by row."""
    if len(columns) == 1:
        i = columns[0]
        return [row[i] for row in rows]
    if columns == list(range(columns[0], columns[-1] + 1)):  # a slice is taken faster
        part = slice(columns[0], columns[-1] + 1)
        return [cell for row in rows for cell in row[part]]
    return [row[i] for row in rows for i in columns]


def features(rows: list[Row], columns: list[int]) -> Floats:
    """The features `[rows, C]` of some columns; ValueError for what is not a finite number."""
    texts = list(cells(rows, columns))
    try:
        values = to_features([float(text) for text in texts]).reshape(len(rows), len(columns))
    except ValueError:
        values = None
    if values is None or not np.isfinite(values).all():
        wrong = next(text for text in texts if not _is_finite(text))
        raise ValueError(f"context {wrong!r} is not a finite number")
    return values


def _is_finite(text: str) -> bool:
    try:
        return bool(np.isfinite(to_features([float(text)])).all())
    except ValueError:
        return False


def _header(row: Row) -> list[str]:
    return [cell.strip().lower() for cell in row]


def _delimiter(line: str) -> str:
    """The delimiter of a file by its first line: that with which it is a header, else the most frequent one."""
    rows: dict[str, Any] = {}
    for delimiter in DELIMITERS:
        try:
            rows[delimiter] = next(csv.reader([line], delimiter=delimiter), [])
        except csv.Error:
            rows[delimiter] = []
    words = {d: sum(bool(_WORDS.fullmatch(name)) for name in _header(row)) for d, row in rows.items()}
    return max(DELIMITERS, key=lambda d: (words[d], len(rows[d])))
