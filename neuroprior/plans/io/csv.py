"""Plans in CSV, one plan a row (`action_1`, `action_2`, ...) or one step a row (`plan`, `action`)."""

import csv
import math
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from neuroprior._files import written_whole
from neuroprior.plans.columns import (
    LARGEST_FLOAT,
    Column,
    Columns,
    Floats,
    Integers,
    Names,
    fields_of_events,
    open_text,
)
from neuroprior.plans.io.assembly import assembled
from neuroprior.plans.plans import Plans
from neuroprior.plans.rows import check_readable, rows_of
from neuroprior.plans.sequences import constant_context

ROWS_AT_ONCE = 2**10
"""Rows that are parsed together; a few times faster than blocks that exceed the processor's cache."""

DELIMITERS = (",", ";", "\t")
SEPARATOR = re.compile(r'"?sep=([,;\t])"?[,;\t]*\s*', re.IGNORECASE)
"""A first line that names the delimiter for spreadsheets, such as `sep=;`."""

OUR_WORDS = re.compile(r"plan|action(_1)?|context_1")
OUR_COLUMNS = re.compile(r"plan|group|condition|start|stop|duration|(action|context)(_\d+)?")
PARTS = {"plan", "group"}
"""A header with `action` has at least one of these."""

MOST_ABOVE = 100
"""Lines at the beginning of a file that may be the header."""

OTHER_WORDS = re.compile(r"session|subject|animal|behaviou?r|group|context|time|frame|event|label|trial|code")
Row = list[str]
T = TypeVar("T")


def read_csv(path: Path, num_actions: int | None, action_names: Names | None, **table: Any) -> Plans:
    """Plans of a CSV file: see `read_plans`."""
    sheet = _Sheet(path, table.get("columns"))
    plans = _read(sheet, num_actions, action_names, **table)
    return replace(plans, notes=(*plans.notes, sheet.note)) if sheet.note else plans


def _read(sheet: "_Sheet", num_actions: int | None, action_names: Names | None, **table: Any) -> Plans:
    path = sheet.path
    action_columns = sheet.numbered("action") if sheet.has_header else list(range(sheet.width))
    if "columns" in table or not action_columns:
        return _read_events(sheet, num_actions=num_actions, action_names=action_names, **table)
    at = sheet.columns
    if "action" in at:
        raise ValueError(f"{path}, line {sheet.top}: 'action' and 'action_1'; one of them is expected")
    feature_columns = sheet.numbered("context")
    if "context" in at and feature_columns:
        raise ValueError(f"{path}, line {sheet.top}: 'context' and 'context_1'; one of them is expected")
    actions = Column("action", action_names, num_actions, untyped=True, blank=True)
    others = {what: Column(what, untyped=True) for what in ("context", "group", "condition") if what in at}

    def parse(rows: list[Row]) -> tuple[Integers, Integers | None, Floats | None, list[Integers]]:
        flat, sizes = _actions(actions, action_columns, rows)
        features = _features(rows, feature_columns) if feature_columns else None
        return flat, sizes, features, [other.look_up([row[at[what]] for row in rows]) for what, other in others.items()]

    all_sizes, all_features, all_lines = [], [], []
    plan_names: list[str] = []
    for block_lines, rows in sheet.blocks():
        flat, block_sizes, features, numbers = sheet.parse(parse, block_lines, rows)
        if block_sizes is None or table:
            return _read_gaps(sheet, action_columns, num_actions=num_actions, action_names=action_names, **table)
        actions.add_numbers(flat)
        for other, block in zip(others.values(), numbers, strict=True):
            other.add_numbers(block)
        if features is not None:
            all_features.append(features)
        if "plan" in at:
            plan_names += [row[at["plan"]].strip() for row in rows]
        all_sizes.append(block_sizes)
        all_lines.append(block_lines.astype(np.uint32))
    sizes, lines = np.concatenate(all_sizes), np.concatenate(all_lines)
    if not len(lines):
        raise ValueError(f"{path}: a header and no plan below it")
    ends = np.cumsum(sizes)

    def place(row: int) -> str:
        return f"{path}, line {lines[row]}"

    flat, names = actions.finish(lambda i: place(bisect_right(ends, i)))
    found = {what: other.finish(place) for what, other in others.items()}
    context, context_names = found.get("context", (np.concatenate(all_features) if all_features else None, None))
    group, group_names = found.get("group", (None, None))
    plans = assembled(str(path), sizes, flat, num_actions, names, context, False, context_names, group, group_names)
    if "condition" in found:
        number, condition_names = found["condition"]
        condition = torch.from_numpy(number.astype(np.int64))
        plans = replace(plans, condition=condition, condition_names=condition_names)
    return replace(plans, plan_names=plan_names) if plan_names else plans


def _read_events(sheet: "_Sheet", **table: Any) -> Plans:
    """Plans of a file with one action a row; see `Plans.from_dataframe`."""
    pd = _pandas(sheet.path)
    if not sheet.columns:
        raise ValueError(f"{sheet.path}, line {sheet.top}: a header is expected, and this looks like data")
    blocks = list(sheet.blocks())
    lines = np.concatenate([lines for lines, _ in blocks])
    frame = pd.DataFrame([row for _, rows in blocks for row in rows], columns=sheet.header, dtype=object)
    usual = "action" in sheet.columns and bool(PARTS & sheet.columns.keys())
    if not table.keys() - {"num_actions", "action_names"} and not usual:
        raise ValueError(
            f"{sheet.path}, line {sheet.top}: both columns 'plan' and 'action', or 'action_1', are expected; or"
            " say which columns they are (--columns.action, --columns.plan; with the first alone the file is one plan)"
        )
    try:
        # Where semicolons part the columns, commas are decimal: so spreadsheets write in much of Europe.
        decimal = "," if sheet.delimiter == ";" else "."
        place = lambda i: f"{sheet.path}, line {lines[i]}"  # noqa: E731
        return Plans(**fields_of_events(frame, place=place, of=str(sheet.path), decimal=decimal, **table))
    except ValueError as error:
        named = str(sheet.path) in str(error)
        raise error if named else ValueError(f"{sheet.path}: {error}") from None


def _pandas(path: Path) -> Any:
    try:
        import pandas
    except ImportError as error:
        raise ImportError(
            f"{path}: files with one action a row or with missing labels need pandas: pip install 'neuroprior[report]'"
        ) from error
    return pandas


def _read_gaps(sheet: "_Sheet", action_columns: list[int], **table: Any) -> Plans:
    """Plans of a file with one plan a row, with missing labels or with options of tables: as one with an action a row.

    Empty cells behind the last action of a row are the end of its plan.
    """
    pd = _pandas(sheet.path)
    blocks = list(sheet.blocks())
    lines = np.concatenate([lines for lines, _ in blocks])
    cells = np.array([[cell.strip() for cell in row] for _, rows in blocks for row in rows], dtype=object)
    actions = cells[:, action_columns]
    reach = np.where(actions != "", np.arange(1, 1 + len(action_columns)), 0).max(1, initial=0)
    taken = np.arange(len(action_columns)) < reach[:, None]
    row = taken.nonzero()[0]
    others = {
        name: cells[row, i]
        for name, i in sheet.columns.items()
        if re.fullmatch(r"group|condition|context(_\d+)?", name)
    }
    frame = pd.DataFrame({"plan": row, "action": actions[taken]} | others)
    fields = fields_of_events(frame, place=lambda i: f"{sheet.path}, line {lines[row[i]]}", of=str(sheet.path), **table)
    rows_of = fields.pop("plan_names", None)
    if "plan" in sheet.columns:
        called = cells[:, sheet.columns["plan"]]
        pieces = range(len(fields["actions"])) if rows_of is None else map(int, rows_of)
        fields["plan_names"] = tuple(str(called[i]) for i in pieces)
    if fields.get("context") is not None:
        fields["context"] = fields["context"][:, 0]  # one for each plan, repeated on its rows
    if empty := int((reach == 0).sum()):
        fields["notes"] = (*fields["notes"], f"{empty:,} plans without any label are left out")
    return Plans(**fields)


def _actions(actions: Column, columns: list[int], rows: list[Row]) -> tuple[Integers, Integers | None]:
    """The actions of some rows end to end, and how many each row has; None where labels are missing within plans."""
    numbers = actions.look_up(_cells(rows, columns)).reshape(len(rows), len(columns))
    there = numbers >= 0
    sizes = there.sum(1)
    unlabelled = any(number < 0 and text.strip() for text, number in actions.items())
    if unlabelled or (there != (np.arange(len(columns)) < sizes[:, None])).any():
        return numbers[there], None
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
        has_header: whether the first row names the columns; else it is data.
        columns: the position of each column by its name, in lower case; empty without a header.
        header: the names of the columns as they are.
        width: the number of cells of every row.
        top: the number of the line with which the table begins.
        note: what is above the table; empty for nothing.

    Args:
        path: the file.
        given: the columns that the user names: the first line that has all of them is the header.

    Raises:
        ValueError: an empty file, one that is not UTF-8 or not CSV, or a header with a column twice.
    """

    def __init__(self, path: Path, given: Columns | Mapping[str, Any] | None = None) -> None:
        self.path = path
        with open_text(path) as file:
            lines = list(islice(file, MOST_ABOVE)) or [""]
            sample = next((each for each in chain(lines, file) if each.strip()), "")
        said, found = SEPARATOR.fullmatch(lines[0]), _find_header(lines, given)
        self.top, self.note = 1, ""
        if said:
            self.top, self.note = 2, f"line 1 names the delimiter, {said[1]!r}, and is not read as a plan"
        elif found and any(line.strip() for line in lines[: found[0]]):
            self.top, self.note = found[0] + 1, f"the header is line {found[0] + 1}; what is above it is not read"
        self.delimiter = said[1] if said else found[1] if found else _delimiter(sample)
        first = next((row for _, rows in self._all() for row in rows), None)
        if first is None:
            raise ValueError(f"{path}: no rows; plans are expected")
        self.width = len(first)
        names = _words(first)
        self.header = [cell.strip() for cell in first]
        self.has_header = given is not None or any(OUR_WORDS.fullmatch(name) for name in names)
        if self.has_header:
            known = Counter(name for name in names if OUR_COLUMNS.fullmatch(name))
            twice = next((name for name, times in known.items() if times > 1), None)
            if twice is not None:
                raise ValueError(f"{path}, line {self.top}: the column {twice!r} is there twice; rename or remove one")
        elif other := next((name for name in names if OTHER_WORDS.fullmatch(name)), None):
            raise ValueError(
                f"{path}, line {self.top}: looks like a header ({other!r}) without a column 'action' (or 'action_1',"
                " ...); say which column holds the actions (--columns.action), and which says to which plan a row"
                " belongs (--columns.plan)"
            )
        elif self.header[0].startswith("#"):
            raise ValueError(
                f"{path}, line {self.top}: begins with #; leave a comment out, and the # before names of columns"
            )
        self.columns = {name: i for i, name in enumerate(names)} if self.has_header else {}

    def blocks(self) -> Iterator[tuple[Integers, list[Row]]]:
        """The rows below the header, all of `width` cells, in blocks, with the line on which each ends."""
        skip, begins = int(self.has_header), True
        for lines, rows in self._all():
            if len({len(row) for row in rows} - {self.width}):
                wrong = next(i for i, row in enumerate(rows) if len(row) != self.width)
                like = "header" if self.has_header else "first row"
                above = wrong == 1 and begins
                hint = "; if its header is further down, give its names (--columns.action), or remove what is above"
                raise ValueError(
                    f"{self.path}, line {lines[wrong]}: {len(rows[wrong])} cells, where the {like} has {self.width}"
                    f"{hint * above}"
                )
            yield lines[skip:], rows[skip:]
            skip, begins = 0, False

    def _all(self) -> Iterator[tuple[Integers, list[Row]]]:
        """All rows but blank ones."""
        with open_text(self.path) as file:
            before = self.top - 1
            reader = csv.reader(islice(file, before, None), delimiter=self.delimiter, strict=True)
            while True:
                start = before + reader.line_num
                try:
                    rows = list(islice(reader, ROWS_AT_ONCE))
                except csv.Error as error:
                    raise ValueError(f"{self.path}, line {before + reader.line_num}: not CSV ({error})") from None
                if not rows:
                    return
                lines = np.arange(start + 1, start + len(rows) + 1)
                if before + reader.line_num != start + len(rows):  # a quoted cell goes over several lines
                    taken = [1 + sum(len(re.findall(r"\r\n|\r|\n", cell)) for cell in row) for row in rows]
                    lines = start + np.cumsum(taken)
                if not all(rows):
                    lines = lines[[bool(row) for row in rows]]
                    rows = [row for row in rows if row]
                yield lines, rows

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

    def numbered(self, name: str) -> list[int]:
        """The positions of the columns `name_1`, `name_2`, ...; ValueError where one between them is missing."""
        found = {}
        for column, i in self.columns.items():
            if match := re.fullmatch(rf"{name}_(\d+)", column):
                found[int(match[1])] = i
        missing = next((number for number in range(1, len(found) + 1) if number not in found), None)
        if missing is not None:
            raise ValueError(
                f"{self.path}, line {self.top}: columns up to {name}_{max(found)}, but {name}_{missing} is missing"
            )
        return [found[number] for number in range(1, len(found) + 1)]


def _words(row: Row) -> list[str]:
    return [cell.strip().lower() for cell in row]


def _parted(line: str) -> dict[str, Row]:
    """The cells of a line for each delimiter."""
    rows: dict[str, Row] = {}
    for delimiter in DELIMITERS:
        try:
            rows[delimiter] = next(csv.reader([line], delimiter=delimiter), [])
        except csv.Error:
            rows[delimiter] = []
    return rows


def _find_header(lines: list[str], given: Columns | Mapping[str, Any] | None) -> tuple[int, str] | None:
    """The number from 0 of the line that names the columns, and its delimiter; None where no line is known to.

    What is above it must begin with a comment or a shorter line, or have another width: else it is a row of the table.
    """
    columns = given if isinstance(given, Mapping | None) else asdict(given)
    given_names = [one if isinstance(one, list | tuple) else [one] for one in (columns or {}).values()]
    wanted = set(_words([str(name) for name in chain(*given_names) if name is not None]))
    rows = [_parted(line) for line in lines]
    for number, parted in enumerate(rows):
        for delimiter, row in parted.items():
            words = set(_words(row))
            is_header = wanted <= words if wanted else "action_1" in words or (words > {"action"} and words & PARTS)
            if is_header:
                above = [other[delimiter] for other in rows[:number] if other[delimiter]]
                unlike = not above or above[0][0].startswith("#") or _width(above[0]) < len(row)
                return (number, delimiter) if unlike or any(len(other) != len(row) for other in above) else None
    return None


def _width(row: Row) -> int:
    """The number of cells up to the last one that holds something."""
    return max((i for i, cell in enumerate(row, 1) if cell.strip()), default=0)


def _delimiter(line: str) -> str:
    """The delimiter of a file by its first line: the one with which it is a header, else the most frequent one."""
    rows = _parted(line)
    words = {d: sum(bool(OUR_WORDS.fullmatch(name)) for name in _words(row)) for d, row in rows.items()}
    return max(DELIMITERS, key=lambda d: (words[d], len(rows[d])))


def _cells(rows: list[Row], columns: list[int]) -> list[str]:
    """The cells of some columns, row by row."""
    if columns == list(range(columns[0], columns[-1] + 1)):  # a slice is taken faster
        part = slice(columns[0], columns[-1] + 1)
        return [cell for row in rows for cell in row[part]]
    return [row[i] for row in rows for i in columns]


def write_csv(plans: Plans, path: Path, layout: str | None) -> None:
    """Write a CSV file; `.tsv` has tabs."""
    if layout not in (None, "plan", "step"):
        raise ValueError(f"`layout` must be 'plan', 'step' or None, got {layout!r}")
    check_readable(plans, str(path), "CSV")
    lengths = plans.mask().sum(1)
    varies = plans.context is not None and constant_context(plans) is None
    per_step = varies or plans.durations is not None
    by_step = layout == "step" or (layout is None and per_step)
    if per_step and not by_step:
        raise ValueError(
            f"{path}: a context or a duration per step cannot be written with one plan a row; use layout='step'"
        )
    if by_step and not lengths.all():
        raise ValueError(
            f"{path}: plan {int((lengths == 0).nonzero()[0])} has no actions, and no row with layout='step'"
        )
    with written_whole(path) as file:
        writer = csv.writer(file, delimiter="\t" if path.suffix.lower() == ".tsv" else ",", lineterminator="\n")
        writer.writerows(rows_of(plans, by_step))
