"""Plans in CSV, one plan a row: columns `action_1`, `action_2`, ..., or no header."""

import csv
import math
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from neuroprior._files import quote_cell, written_whole
from neuroprior.plans.columns import (
    LARGEST_FLOAT,
    Column,
    Floats,
    Integers,
    Names,
    is_missing,
    named,
    number_in,
    open_text,
)
from neuroprior.plans.io.assembly import assembled
from neuroprior.plans.plans import Plans
from neuroprior.plans.sequences import constant_context

ROWS_AT_ONCE = 2**10
"""Rows that are parsed together; a few times faster than blocks that exceed the processor's cache."""

DELIMITERS = (",", ";", "\t")

OUR_COLUMN = re.compile(r"group|(action|context)_\d+|context")

OTHER_WORDS = re.compile(
    r"plan|action|session|subject|animal|behaviou?r|group|context|time|frame|event|label|trial|code"
)
"""Names of columns of tables of events."""

EVENTS = "a table of events, one action a row, is read by neuroprior.behaviour.read"

Row = list[str]
T = TypeVar("T")


def read_csv(path: Path, num_actions: int | None, action_names: Names | None) -> Plans:
    """Plans of a CSV file: see `read_plans`."""
    sheet = _Sheet(path)
    action_columns = sheet.numbered("action") if sheet.columns else list(range(sheet.width))
    at, feature_columns = sheet.columns, sheet.numbered("context")
    if "context" in at and feature_columns:
        raise ValueError(f"{path}, line 1: 'context' and 'context_1'; one of them is expected")
    actions = Column("action", action_names, num_actions, untyped=True, blank=True)
    others = {what: Column(what, untyped=True) for what in ("context", "group") if what in at}

    def parse(rows: list[Row]) -> tuple[Integers, Integers, Floats | None, list[Integers]]:
        flat, sizes = _actions(actions, action_columns, rows)
        features = _features(rows, feature_columns) if feature_columns else None
        return flat, sizes, features, [other.look_up([row[at[what]] for row in rows]) for what, other in others.items()]

    all_sizes, all_features, all_lines = [], [], []
    for block_lines, rows in sheet.blocks():
        flat, block_sizes, features, numbers = sheet.parse(parse, block_lines, rows)
        actions.add_numbers(flat)
        for other, block in zip(others.values(), numbers, strict=True):
            other.add_numbers(block)
        if features is not None:
            all_features.append(features)
        all_sizes.append(block_sizes)
        all_lines += block_lines
    if not all_lines:
        raise ValueError(f"{path}: a header and no plan below it")
    sizes = np.concatenate(all_sizes)
    ends = np.cumsum(sizes)

    def place(row: int) -> str:
        return f"{path}, line {all_lines[row]}"

    flat, names = actions.finish(lambda i: place(bisect_right(ends, i)))
    columns = {what: other.finish(place) for what, other in others.items()}
    context, context_names = columns.get("context", (np.concatenate(all_features) if all_features else None, None))
    group, group_names = columns.get("group", (None, None))
    return assembled(str(path), sizes, flat, num_actions, names, context, False, context_names, group, group_names)


def _actions(actions: Column, columns: list[int], rows: list[Row]) -> tuple[Integers, Integers]:
    """The actions of some rows end to end, and how many each row has; ValueError where one is missing."""
    texts = _cells(rows, columns)
    numbers = actions.look_up(texts).reshape(len(rows), len(columns))
    there = numbers >= 0
    sizes = there.sum(1)
    unlabelled = {text for text, number in actions.items() if number < 0 and text.strip()}
    if (there != (np.arange(len(columns)) < sizes[:, None])).any() or not unlabelled.isdisjoint(texts):
        raise ValueError("an action is missing before the plan's end; neuroprior.behaviour.read reads tables with gaps")
    return numbers[there], sizes


def _features(rows: list[Row], columns: list[int]) -> Floats:
    """The features `[rows, C]` of some columns; ValueError for what is not a finite number."""
    texts = _cells(rows, columns)
    values = np.array([_float(text) for text in texts])
    wrong = np.flatnonzero(~(np.abs(values) <= LARGEST_FLOAT))
    if wrong.size:
        raise ValueError(f"context {texts[wrong[0]]!r} is not a finite number")
    return values.reshape(len(rows), len(columns))


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


class _Sheet:
    """A CSV file: its columns, and its rows in blocks.

    Attributes:
        path: the file.
        columns: the position of each column by its name, in lower case; empty without a header.
        width: the number of cells of every row.

    Args:
        path: the file.

    Raises:
        ValueError: an empty file, one that is not UTF-8 or not CSV, a header with a column twice, or a table of events.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_text(path) as file:
            self.delimiter = _delimiter(next((line for line in file if line.strip()), ""))
        first = next((rows[0] for _, rows in self._all()), None)
        if first is None:
            raise ValueError(f"{path}: no rows; plans are expected")
        self.width = len(first)
        names = [cell.strip().lower() for cell in first]
        self.columns = {name: i for i, name in enumerate(names)} if "action_1" in names else {}
        repeated = [name for name, number in Counter(names).items() if number > 1 and OUR_COLUMN.fullmatch(name)]
        if self.columns and repeated:
            raise ValueError(f"{path}, line 1: the column {repeated[0]!r} is there twice; rename or remove one")
        word = next((name for name in names if OTHER_WORDS.fullmatch(name)), None)
        if not self.columns and word is not None:
            raise ValueError(f"{path}, line 1: a column {word!r}, and none 'action_1'; {EVENTS}")
        if first[0].strip().startswith("#"):
            raise ValueError(f"{path}, line 1: begins with #; leave a comment out, and the # before names of columns")

    def blocks(self) -> Iterator[tuple[list[int], list[Row]]]:
        """The rows below the header, all of `width` cells, in blocks, with the line on which each ends."""
        skip = int(bool(self.columns))
        for lines, rows in self._all():
            wrong = next((i for i, row in enumerate(rows) if len(row) != self.width), None)
            if wrong is not None:
                like = "header" if self.columns else "first row"
                raise ValueError(
                    f"{self.path}, line {lines[wrong]}: {len(rows[wrong])} cells, where the {like} has {self.width}"
                )
            if rows[skip:]:
                yield lines[skip:], rows[skip:]
            skip = 0

    def _all(self) -> Iterator[tuple[list[int], list[Row]]]:
        """All rows but blank ones."""
        with open_text(self.path) as file:
            reader = csv.reader(file, delimiter=self.delimiter, strict=True)
            lines: list[int] = []
            rows: list[Row] = []
            try:
                for row in reader:
                    if row:
                        lines.append(reader.line_num)
                        rows.append(row)
                    if len(rows) == ROWS_AT_ONCE:
                        yield lines, rows
                        lines, rows = [], []
            except csv.Error as error:
                raise ValueError(f"{self.path}, line {reader.line_num}: not CSV ({error})") from None
            if rows:
                yield lines, rows

    def parse(self, parse: Callable[[list[Row]], T], lines: list[int], rows: list[Row]) -> T:
        """What `parse` makes of a block; if that fails, the message names the first line that is wrong."""
        try:
            return parse(rows)
        except ValueError:
            for line, row in zip(lines, rows, strict=True):
                try:
                    parse([row])
                except ValueError as error:
                    raise ValueError(f"{self.path}, line {line}: {error}") from None
            raise

    def numbered(self, name: str) -> list[int]:
        """The positions of the columns `name_1`, `name_2`, ...; ValueError where one between them is missing."""
        positions = {}
        for column, i in self.columns.items():
            if match := re.fullmatch(rf"{name}_(\d+)", column):
                positions[int(match[1])] = i
        missing = next((number for number in range(1, len(positions) + 1) if number not in positions), None)
        if missing is not None:
            last = max(positions)
            raise ValueError(f"{self.path}, line 1: columns up to {name}_{last}, but {name}_{missing} is missing")
        return [positions[number] for number in range(1, len(positions) + 1)]


def _delimiter(line: str) -> str:
    """The delimiter of a file by its first line: the one with which it is a header, else the most frequent one."""
    rows = {}
    for delimiter in DELIMITERS:
        try:
            rows[delimiter] = next(csv.reader([line], delimiter=delimiter), [])
        except csv.Error:
            rows[delimiter] = []
    ours = {d: sum(cell.strip().lower() == "action_1" for cell in row) for d, row in rows.items()}
    return max(DELIMITERS, key=lambda d: (ours[d], len(rows[d])))


def _cells(rows: list[Row], columns: list[int]) -> list[str]:
    """The cells of some columns, row by row."""
    if columns == list(range(columns[0], columns[-1] + 1)):  # a slice is taken faster
        span = slice(columns[0], columns[-1] + 1)
        return [cell for row in rows for cell in row[span]]
    return [row[i] for row in rows for i in columns]


def write_csv(plans: Plans, path: Path) -> None:
    """Write a CSV file; `.tsv` has tabs."""
    _check_writable(plans, path)
    with written_whole(path) as file:
        writer = csv.writer(file, delimiter="\t" if path.suffix.lower() == ".tsv" else ",", lineterminator="\n")
        writer.writerows(_rows_of(plans))


def _check_writable(plans: Plans, path: Path) -> None:
    """Raise ValueError unless rows of these plans would be read as the same plans again."""
    if plans.end is not None:
        raise ValueError(
            f"{path}: CSV cannot say that an action is the end symbol; write plans.without_end(), or JSONL"
        )
    if plans.context is not None and constant_context(plans) is None:
        raise ValueError(f"{path}: CSV cannot hold a context that changes within plans; write .jsonl or .npz")
    if not plans.mask().any():
        raise ValueError(f"{path}: CSV cannot hold plans of which none has an action")
    for what in ("action", "context", "group"):
        for name in getattr(plans, f"{what}_names") or ():
            if not name.strip() or name != name.strip() or "\n" in name or "\r" in name:
                raise ValueError(
                    f"{path}: {what}_names: CSV cannot hold {name!r}; names without line breaks and without space at"
                    " either end are expected"
                )
            if is_missing(name):
                raise ValueError(f"{path}: {what}_names: CSV cannot hold {name!r}, which would be read as missing")
            if what != "group" and number_in(name) is not None:
                raise ValueError(f"{path}: {what}_names: CSV cannot hold {name!r}, which would be read as a number")


def _rows_of(plans: Plans) -> Iterator[list[Any]]:
    """The rows of a file, the header first."""
    width, context = plans.max_length, constant_context(plans)
    header = [f"action_{i + 1}" for i in range(width)]
    if context is not None:
        features = context.shape[-1] if context.is_floating_point() else 0
        header += [f"context_{i + 1}" for i in range(features)] or ["context"]
    yield header + ["group"] * (plans.group is not None)
    action_names, context_names, group_names = (
        None if names is None else list(map(quote_cell, names))
        for names in (plans.action_names, plans.context_names, plans.group_names)
    )
    for start in range(0, len(plans), 2**14):
        chunk = plans[start : start + 2**14]
        none: list[list[Any]] = [[]] * len(chunk)
        contexts = none if context is None else named(context[start : start + 2**14].tolist(), context_names)
        groups = none if chunk.group is None else named(chunk.group.tolist(), group_names)
        actions, lengths = named(chunk.actions.tolist(), action_names), chunk.mask().sum(1).tolist()
        for taken, length, *entries in zip(actions, lengths, contexts, groups, strict=True):
            more = [cell for entry in entries for cell in (entry if isinstance(entry, list) else [entry])]
            yield [*taken[:length], *[""] * (width - length), *more]
