"""Recorded plans of a table of events, one action a row, as behaviour is coded in a laboratory.

For the time being: all of this module gives way to a reader of recordings. Needs pandas (`pip install
'neuroprior[report]'`), which holds the table.
"""

import contextlib
import csv
import math
import os
import re
import unicodedata
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from neuroprior._checks import check_flags, is_number, precision_lost
from neuroprior.behaviour.analysis.comparison import never_occur
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.plans.columns import (
    LARGEST_FLOAT,
    Column,
    Floats,
    Integers,
    Names,
    as_single,
    check_names,
    is_missing,
    listed,
    number_in,
    open_text,
    padded,
)
from neuroprior.plans.io.assembly import assembled

Missing = Literal["gap", "label", "error"]
"""What rows without a label do."""

MISSING: tuple[Missing, ...] = ("gap", "label", "error")

EVENT_TYPES = ("START", "STOP", "POINT")
"""Values of the column `Columns.event_type`: an action begins, ends, or takes no time."""

ROUNDING = 4
"""Of the last binary digits: so far may the sum of a start and a duration be from the time that it stands for."""

ALIKE = 0.01
"""A duration and the time from start to stop are taken for the same where they differ by at most this share of the
duration and the median duration together.
"""

UNLABELLED = "missing"
"""The action of rows without a label, where these are to count as one."""

CLOCK, DATE = r"\s*(?:(\d+):)?(\d+):(\d+(?:[.,]\d*)?)\s*", r"\s*\d{4}[-/.]\d{1,2}[-/.]\d{1,2}([T ].*)?\s*"
"""Times that are no numbers: hours, minutes and seconds, or a date and perhaps a time of day."""

NUMBERS, CLOCKS, DATES, ZONED_DATES = "numbers", "times of day", "dates", "dates with a time zone"
"""Kinds of times."""

ZONED = r".*[T ].*(Z|[+-]\d{2}:?\d{2})\s*"
"""A date and time with a time zone."""

DAY = r"\s*\d{1,2}[-/.]\d{1,2}[-/.]\d{2,4}([T ].*)?\s*"
"""A date that ends with the year: whether its day or its month comes first cannot be known."""

COMMA = re.compile(r"^(\s*-?\d+),(\d+\s*)$")
"""A number with a decimal comma."""

HALF_A_DAY = 12 * 3600


@dataclass(frozen=True)
class Columns:
    """Which columns of a table of events hold what; where none is given, the column of that name, if there is one.

    Attributes:
        action: what was done: names, or whole numbers from 0.
        plan: which rows belong together, such as the session; with a group, the same name in two groups is two plans.
            Without it each group is one plan, and without a group the whole table is one.
        context: what was known when the action was chosen: a column of names or whole numbers, or columns of features.
        group: what is independent, such as the animal.
        condition: what is to be compared, such as the treatment or the genotype; one for each plan.
        start: when the action began: numbers, times of day or dates; the rows of a plan are put in this order.
        stop: when it ended, as `start`.
        duration: how long it took, in place of `stop`; where both are there, it counts.
        event_type: START, STOP or POINT, where the start and the stop of an action are rows of their own, as in the
            tabular export of BORIS; `start` is the time of each row then.

    Example:
        >>> Columns(action="behaviour", plan="session", group="animal").group
        'animal'
    """

    action: str | None = None
    plan: str | None = None
    context: str | Sequence[str] | None = None
    group: str | None = None
    condition: str | None = None
    start: str | None = None
    stop: str | None = None
    duration: str | None = None
    event_type: str | None = None


class Table:
    """A table of events with its columns found.

    Args:
        frame: a pandas frame.
        columns: where they are, or a dict of the same.
        place: what messages call a row, by its number in the frame.
        of: the table itself in messages, such as the name of its file.
        decimal: "," where numbers may be written so.

    Raises:
        ValueError: a column is not there, twice, or the action's is not known.
    """

    def __init__(
        self,
        frame: Any,
        columns: Columns | Mapping[str, Any] | None,
        place: Callable[[int], str],
        of: str = "table",
        decimal: str = ".",
    ) -> None:
        self.decimal = decimal
        self.frame, self.place, self.of = frame, place, of
        self.times = ""  # of which kind starts and stops are
        if not hasattr(frame, "columns") or not hasattr(frame, "iloc"):
            raise ValueError(f"{of}: a pandas frame is expected, not {type(frame).__name__}")
        if not isinstance(columns, Columns | Mapping | None):
            raise ValueError(f"`columns` must say what each holds, as {{'action': 'behaviour'}}, got {columns!r}.")
        try:
            given = asdict(columns if isinstance(columns, Columns) else Columns(**(columns or {})))
        except TypeError as error:
            raise ValueError(f"`columns` must be some of {', '.join(asdict(Columns()))} ({error}).") from None
        context = given.pop("context")
        features = [context] if isinstance(context, str) else list(context or ())
        self.at = {what: self._find(what, name) for what, name in given.items() if name is not None}
        self.context = [self._find("context", name) for name in features]
        if len(set(self.context)) < len(self.context):
            raise ValueError(f"`columns.context` must not name a column twice, got {', '.join(map(str, features))}.")
        taken = {*self.at.values(), *self.context}
        usual = {str(name).strip().lower(): i for i, name in reversed(list(enumerate(frame.columns))) if i not in taken}
        named = list(map(str, frame.columns))
        for what in given:
            if what not in self.at and what != "event_type" and named.count(what) > 1:
                raise ValueError(f"{of}: the column {what!r} is there twice")
        self.by_name: list[str] = []  # what was not given, and found by its name
        for what in given:
            # A column of the name event_type may hold anything, so it is used only where it is given.
            if what not in self.at and what in usual and what != "event_type":
                self.at[what] = usual[what]
                self.by_name += [what] if any(given.values()) else []
        if not self.context:
            numbered = [f"context_{i}" for i in range(1, 1 + len(frame.columns))]
            self.context = [usual[name] for name in ("context", *numbered) if name in usual]
        if "action" not in self.at:
            raise ValueError(
                f"{of}: no column 'action'; say which holds the actions (columns.action) of {self._names()}"
            )
        # One column may be both, such as days that are plans and conditions.
        once = [
            i
            for what, i in self.at.items()
            if what != "condition" or i not in (self.at.get("plan"), self.at.get("group"))
        ]
        twice = [name for i, name in enumerate(frame.columns) if once.count(i) > 1]
        if twice:
            uses = " and ".join(what for what, i in self.at.items() if frame.columns[i] == twice[0])
            raise ValueError(f"`columns` must not name one column for {uses}, got {twice[0]!r}.")

    def _names(self) -> str:
        return ", ".join(map(str, self.frame.columns))

    def _find(self, what: str, name: Any) -> int:
        """The position of a column by its name; by its name in lower case where that is the only one."""
        name, names = str(name), list(map(str, self.frame.columns))
        found = [i for i, known in enumerate(names) if known == name]
        found = found or [i for i, known in enumerate(names) if known.strip().lower() == name.strip().lower()]
        if len(found) != 1:
            once = "a column that is there once" if found else f"one of {self._names()}"
            several = what == "context" and all(part.strip() in names for part in name.split(","))
            hint = f" (several are given as '[{name}]')" if several else ""
            raise ValueError(f"`columns.{what}` must be {once}, got {name!r}{hint}.")
        return found[0]

    def texts(self, position: int) -> tuple[Integers, list[str]]:
        """The entries of a column: for each row the number of its text, -1 where it is missing; and the texts."""
        import pandas as pd

        column = self.frame.iloc[:, position].astype(object)
        try:
            codes, values = pd.factorize(column)
        except TypeError as error:
            name = self.frame.columns[position]
            raise ValueError(f"{self.of}: column {name!r}: names or numbers are expected ({error})") from None
        labels = [_text(value).strip() for value in values]
        number = {label: i for i, label in enumerate(dict.fromkeys(labels)) if not is_missing(label)}
        order = {label: i for i, label in enumerate(number)}
        lookup = np.array([*(order.get(label, -1) for label in labels), -1], np.int64)
        return lookup[codes], list(order)

    def numbers(self, what: str, position: int, times: bool = False) -> NDArray[np.float64]:
        """The numbers of a column, or its times in seconds; NaN where they are missing.

        Raises:
            ValueError: an entry is no finite number (or time).
        """
        import pandas as pd

        column = self.frame.iloc[:, position]
        if pd.api.types.is_datetime64_any_dtype(column) or pd.api.types.is_timedelta64_dtype(column):
            dates = pd.api.types.is_datetime64_any_dtype(column)
            self._check_kind(what, (ZONED_DATES if column.dt.tz is not None else DATES) if dates else CLOCKS)
            return _seconds(column)
        if self.decimal == ",":
            column = column.map(_with_point)
        missing = column.isna() | column.map(lambda value: isinstance(value, str) and is_missing(value))
        values = pd.to_numeric(column.where(~missing), errors="coerce")
        if times and values[~missing].isna().any():
            texts = column.where(~missing).astype(object).astype(str)
            if texts[~missing].str.fullmatch(CLOCK).all():
                self._check_kind(what, CLOCKS)
                values = self._clock(what, texts)
            elif texts[~missing].str.fullmatch(DATE).all():
                self._check_kind(what, ZONED_DATES if texts[~missing].str.fullmatch(ZONED).any() else DATES)
                with contextlib.suppress(ValueError, TypeError):
                    values = pd.Series(_seconds(_dates(texts.where(~missing))))
        elif times and what != "duration" and not missing.all():
            self._check_kind(what, NUMBERS)
        found: NDArray[np.float64] = values.to_numpy(np.float64, na_value=np.nan)
        wrong = np.flatnonzero(~np.isfinite(found) & ~missing.to_numpy())
        if wrong.size:
            text, kind = str(column.iloc[wrong[0]]), "a number or a time" if times else "a finite number"
            if times and re.fullmatch(f"{DATE}|{DAY}", text):
                kind = "a date that can be read with the others; all as year-month-day are expected"
            elif times and re.fullmatch(CLOCK, text):
                kind = "a time that can be read with the others; all as h:m:s (below 60) or as numbers are expected"
            elif re.fullmatch(r"\s*-?\d+,\d+\s*", text):
                kind += " (a decimal point is expected, no comma)"
            raise ValueError(f"{self.place(wrong[0])}: {what} {text!r} is not {kind}")
        return found

    def _check_kind(self, what: str, kind: str) -> None:
        if what == "duration":  # it is taken from no other time
            return
        if self.times not in ("", kind):
            raise ValueError(f"{self.of}: {what}: {kind} in one column, {self.times} in another; one kind is expected")
        self.times = kind

    def _clock(self, what: str, texts: Any) -> Any:
        """Seconds of texts such as 1:02:03.5 and 2:03.5; NaN for what is none, or has 60 seconds.

        Two numbers are minutes and seconds where one of the column has a fraction, or is beyond the hours of a day.

        Raises:
            ValueError: two numbers may be hours and minutes as well.
        """
        parts = texts.str.extract(CLOCK)
        hours, minutes, seconds = (parts[i].str.replace(",", ".").astype(float) for i in range(3))
        two = hours.isna() & minutes.notna()
        if two.any() and not (parts[2][two].str.contains("[.,]") | (minutes[two] > 23)).any():
            row = int(two.to_numpy().argmax())
            raise ValueError(
                f"{self.place(row)}: {what} {texts.iloc[row]!r} may be hours and minutes, or minutes and seconds;"
                " times as h:m:s are expected"
            )
        return (3600 * hours.fillna(0) + 60 * minutes + seconds).where((seconds < 60) & (hours.isna() | (minutes < 60)))

    def unused(self) -> dict[int, str]:
        """The names of the columns that hold nothing, by their positions."""
        used = {*self.at.values(), *self.context}
        names = [str(name).strip() or f"(without a name, column {i + 1})" for i, name in enumerate(self.frame.columns)]
        return {i: name for i, name in enumerate(names) if i not in used}


def _text(value: Any) -> str:
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def _with_point(value: Any) -> Any:
    """A number with a point in place of its decimal comma; all else as it is."""
    return COMMA.sub(r"\1.\2", value) if isinstance(value, str) else value


def _dates(texts: Any) -> Any:
    """Dates with the year first, with or without time and zone; those without are taken to be in one zone."""
    import pandas as pd

    padded_day = texts.str.strip().str.replace(
        r"^(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})", lambda m: f"{m[1]}-{m[2]:0>2}-{m[3]:0>2}", regex=True
    )
    return pd.to_datetime(padded_day, format="ISO8601", utc=True)


def _seconds(column: Any) -> NDArray[np.float64]:
    """Times in seconds; dates since 1970, so that those of two columns can be compared."""
    since = column
    if "datetime" in str(column.dtype):
        since = column - type(column.min())(0, tz=column.dt.tz) if column.notna().any() else column - column
    found: NDArray[np.float64] = since.dt.total_seconds().to_numpy(np.float64)
    return found


def plans_of_frame(
    frame: Any,
    columns: Columns | Mapping[str, Any] | None = None,
    *,
    missing: Missing = "gap",
    merge_repeats: bool = False,
    max_gap: float | None = None,
    num_actions: int | None = None,
    action_names: Sequence[str] | None = None,
) -> RecordedPlans:
    """Recorded plans of a table of events, one action a row.

    Whole numbers are indices, and other labels names, which are numbered in sorted order. Labels count without space at
    their ends; a label that is empty, NaN, NA, N/A, null, ? or - is missing. What was noticed (gaps, names that are
    nearly the same, columns without use) stands in `notes`.

    Args:
        frame: a pandas frame.
        columns: where one is not given, the column of that very name is taken, if there is one (but for event_type).
        missing: what rows without a label do: a "gap" ends the plan, and another one begins after it; as "label" they
            count as an action, "missing"; "error" refuses them. Without groups the parts of a plan become one.
        merge_repeats: take the same label in successive rows for one action, as in tables with a row a frame; its
            context is that of the first of these rows, and it lasts as long as they do together, or as many rows as
            they are where no times are known.
        max_gap: a longer pause between the end of an action and the start of the next one ends the plan, too; in the
            unit of `start` (seconds, for times of day and dates). An unknown end counts as the action's start. None: no
            pause does.
        num_actions: A; None: the number of names, else the largest action + 1.
        action_names: A names in the order of their numbers; None: the names that occur, sorted.

    Raises:
        ValueError: a column is not there, or an entry is wrong; the message names the row.
    """
    options: dict[str, Any] = {"missing": missing, "merge_repeats": merge_repeats, "max_gap": max_gap}
    return RecordedPlans(**fields_of(frame, columns, num_actions=num_actions, action_names=action_names, **options))


def fields_of(
    frame: Any,
    columns: Columns | Mapping[str, Any] | None = None,
    *,
    missing: str = "gap",
    merge_repeats: bool = False,
    max_gap: float | None = None,
    num_actions: int | None = None,
    action_names: Sequence[str] | None = None,
    place: Callable[[int], str] = "row {}".format,
    of: str = "table",
    decimal: str = ".",
) -> dict[str, Any]:
    """What `RecordedPlans` are made of, by name; see `plans_of_frame`.

    Args:
        frame, columns, missing, merge_repeats, max_gap, num_actions, action_names: see there.
        place: what messages call a row, by its number.
        of: the table itself in messages.
        decimal: "," where numbers may be written so.

    Raises:
        ValueError: the table holds no plans, or an argument is wrong.
    """
    if missing not in MISSING:
        raise ValueError(f"`missing` must be one of {', '.join(MISSING)}, got {missing!r}.")
    if max_gap is not None and (not is_number(max_gap) or not 0 <= max_gap < np.inf):
        raise ValueError(f"`max_gap` must be at least 0, got {max_gap!r}.")
    check_flags(merge_repeats=merge_repeats)
    names = check_names(num_actions, action_names)
    table = Table(frame, columns, place, of, decimal)
    if not len(frame):
        raise ValueError(f"{of}: a header and no row below it")
    noted: list[str] = []
    if "event_type" in table.at:
        table, noted = _paired(table)
    place = table.place
    plan, plan_names = _plans_of_rows(table)
    start = table.numbers("start", table.at["start"], times=True) if "start" in table.at else None
    order, notes = _order(table, plan, plan_names, start)
    notes += noted
    codes, labels = table.texts(table.at["action"])
    notes += _alike(labels, "action")
    without = codes < 0
    if missing == "error" and without.any():
        first_row = int(without.argmax())
        raise ValueError(f"{place(first_row)}: action: no label; a number or a name is expected (missing='error')")
    if missing == "label":
        labels = labels if UNLABELLED in labels else [*labels, UNLABELLED]
        codes = np.where(without, labels.index(UNLABELLED), codes)
        without = codes < 0

    # From here on everything is in the order of the plans, and `row` says where it stands in the table.
    row = order
    plan, codes, without = plan[row], codes[row], without[row]
    begin = np.diff(plan, prepend=-1) != 0
    when = None if start is None else start[row]
    seconds, ends = _durations(table, when, row, begin)
    if when is not None:
        ties = ~begin[1:] & (when[1:] == when[:-1])
        if ties.any():
            twice = int((ties & (codes[1:] == codes[:-1])).sum())
            notes.append(
                f"{int(ties.sum()):,} actions begin at the same time as the one before them; they are in the order of"
                f" the file ({twice:,} are the same action: perhaps rows that are there twice)"
            )
    if "stop" in table.at and seconds is not None and ends is not None and when is not None:
        early = ~begin[1:] & (when[1:] < ends[:-1] - _rounded(when[1:], ends[:-1]))
        if early.any():
            notes.append(f"{int(early.sum()):,} actions begin before the one before them ended")
        if "duration" in table.at and not np.isnan(seconds).all():
            notes += _contradictions(table, row, seconds, ends)
    pause = np.zeros(len(row), bool)
    if max_gap is not None:
        if when is None or ends is None or not {"stop", "duration"} & table.at.keys():
            raise ValueError("`columns` must have start, and stop or duration, with `max_gap`.")
        endless = np.isnan(ends)
        if endless.any():
            notes.append(f"{int(endless.sum()):,} actions without an end count for max_gap as ended when they began")
        latest = _running_maximum(np.where(endless, when, ends), plan)
        error = _rounded(when[1:], latest[:-1], max_gap)
        pause[1:] = ~begin[1:] & (when[1:] - latest[:-1] > max_gap + error)
    if without.all():
        raise ValueError(f"{of}: no row has an action")
    # A gap is a run of rows without a label between actions of one plan, or a pause.
    cut = begin | pause | np.concatenate([[False], without[:-1]])
    piece = np.cumsum(cut)[~without]
    row, plan, codes = row[~without], plan[~without], codes[~without]
    seconds = None if seconds is None else seconds[~without]
    when = None if when is None else when[~without]
    gaps = int((np.diff(piece, prepend=-1) != 0).sum() - (np.diff(plan, prepend=-1) != 0).sum())
    if without.any():
        notes.append(f"{int(without.sum()):,} rows have no label")
    if left_out := len(plan_names) - len(np.unique(plan)):
        notes.append(f"{left_out:,} plans without any label are left out")
    if gaps:
        notes.append(f"{gaps:,} gaps end a plan, and the next begins after each")
    if merge_repeats:
        first = (np.diff(piece, prepend=-1) != 0) | (np.diff(codes, prepend=-1) != 0)
        runs = np.cumsum(first) - 1
        # A run lasts as long as its rows do together; without any times, as many rows as it has.
        weight = np.ones(len(row)) if seconds is None else seconds
        seconds = np.bincount(runs, weight).astype(np.float64)
        row, plan, codes, piece = row[first], plan[first], codes[first], piece[first]
        when = None if when is None else when[first]
    starts = np.flatnonzero(np.diff(piece, prepend=-1))
    lengths = np.diff(np.append(starts, len(piece)))

    actions, action_found = _numbered("action", codes, labels, names, num_actions, lambda i: place(int(row[i])))
    found: dict[str, Any] = {"action_names": action_found}
    if num_actions is None and action_found is None:
        num_actions = int(actions.max()) + 1
        notes += _never_notes(actions, num_actions)
    found["num_actions"] = len(action_found) if action_found is not None else num_actions
    found["actions"] = torch.from_numpy(padded(actions, lengths, of))
    found["lengths"] = None if (lengths == lengths.max()).all() else torch.from_numpy(lengths)
    if table.context:
        found |= _context(table, row, lengths, notes)
    if when is not None:
        found["began"] = torch.from_numpy(padded(when, lengths, of))
    if seconds is not None:
        found["durations"] = torch.from_numpy(padded(seconds.astype(np.float32), lengths, of))
        if unknown := int(np.isnan(seconds).sum()):
            notes.append(f"the durations of {unknown:,} of {len(seconds):,} actions are not known")
    for what in ("group", "condition"):
        if what in table.at:
            texts, known = table.texts(table.at[what])
            values = _of_plans(what, texts[row], plan, lambda i: place(int(row[i])))[starts]
            notes += _alike(known, what)
            number, kept = _numbered(what, values, known, None, None, lambda i: place(int(row[starts[i]])))
            found |= _named(what, number, kept)
    if "plan" in table.at:
        codes_of, called = table.texts(table.at["plan"])
        own_names = tuple(called[code] for code in codes_of[row[starts]].tolist())
        if own_names != tuple(map(str, range(len(own_names)))):  # plans that are numbered from 0 have no names
            found["recording"] = own_names
    if gaps and "group" not in table.at:
        # The parts of a plan are not independent of one another.
        kept_plans, group = np.unique(plan[starts], return_inverse=True)
        found |= _named("group", group, tuple(plan_names[i] for i in kept_plans))
        notes.append("the parts of a plan form a group")
    if "group" in table.by_name:
        notes.append("the column 'group' is taken for what is independent, such as the animal")
    unused = table.unused()
    for position, name in unused.items():
        words = {word.upper() for word in table.texts(position)[1]}
        if {"START", "STOP"} <= words <= set(EVENT_TYPES):
            notes.append(
                f"the column {name!r} holds START and STOP, and is not used (columns.event_type): each is an action"
            )
    if unused:
        notes.append(f"columns that are not used: {listed(list(unused.values()))}")
    # Names of columns may have characters that no file can hold.
    return found | {"notes": tuple(note.encode("utf-8", "replace").decode() for note in notes)}


def _paired(table: Table) -> tuple[Table, list[str]]:
    """The table with a row for each action, made of one whose starts and stops are rows of their own; and a note."""
    if "start" not in table.at:
        raise ValueError("`columns.start` must be given with `columns.event_type`.")
    if given := [what for what in ("stop", "duration") if what in table.at]:
        raise ValueError(f"`columns.{given[0]}` must be left out where stops are rows (`columns.event_type`).")
    plan, _ = _plans_of_rows(table)
    time = table.numbers("start", table.at["start"], times=True)
    action, labels = table.texts(table.at["action"])
    kinds, words = table.texts(table.at["event_type"])
    known = np.array([*(EVENT_TYPES.index(w.upper()) if w.upper() in EVENT_TYPES else -1 for w in words), -1])
    kind = known[kinds]
    if (kind < 0).any():
        row = int((kind < 0).argmax())
        found = words[kinds[row]] if kinds[row] >= 0 else "an empty cell"
        raise ValueError(f"{table.place(row)}: event_type: {', '.join(EVENT_TYPES)} are expected, not {found}")
    # The starts and stops of each action of a plan in the order of time, and of the file where times are the same.
    order = np.lexsort((np.arange(len(plan)), time, action, plan))
    order = order[kind[order] != EVENT_TYPES.index("POINT")]
    is_stop = kind[order] == EVENT_TYPES.index("STOP")
    first = (np.diff(plan[order], prepend=-1) != 0) | (np.diff(action[order], prepend=-2) != 0)
    after_start = np.append(False, ~is_stop[:-1]) & ~first
    wrong = np.flatnonzero(is_stop != after_start)
    if wrong.size:
        row = int(order[wrong[0]])
        label = labels[action[row]] if action[row] >= 0 else "no label"
        what = "STOP without a START" if is_stop[wrong[0]] else "START, and no STOP since the last one"
        raise ValueError(f"{table.place(row)}: {label!r}: a {what}; mend the row, or name the subject (columns.group)")
    stop = np.where(kind == EVENT_TYPES.index("POINT"), time, np.nan)
    ended = order[1:][is_stop[1:]]
    stop[order[:-1][is_stop[1:]]] = time[ended]
    rows = np.flatnonzero(kind != EVENT_TYPES.index("STOP"))
    frame = table.frame.iloc[rows].reset_index(drop=True)
    frame.isetitem(table.at["start"], time[rows])
    frame.isetitem(table.at["event_type"], stop[rows])
    paired = copy(table)
    paired.frame, paired.times = frame, ""
    paired.place = lambda i: table.place(int(rows[i]))
    paired.at = {"stop" if what == "event_type" else what: at for what, at in table.at.items()}
    open_ended = int(np.isnan(stop[rows]).sum())
    return paired, [f"{open_ended:,} actions have a START and no STOP"] if open_ended else []


def _plans_of_rows(table: Table) -> tuple[Integers, list[str]]:
    """For each row the number of its plan, in order of appearance, and the plans' names."""
    parts, names = [], []
    for what in ("group", "plan"):
        if what not in table.at:
            continue
        codes, labels = table.texts(table.at[what])
        if (codes < 0).any():
            row = int((codes < 0).argmax())
            raise ValueError(f"{table.place(row)}: {what}: an empty cell; the name or number of the {what} is expected")
        parts.append(codes)
        names.append(labels)
    if not parts:
        return np.zeros(len(table.frame), np.int64), ["table"]
    both = np.stack(parts)
    pairs, first, inverse = np.unique(both, axis=1, return_index=True, return_inverse=True)
    order = first.argsort()
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    known_as = [
        ", ".join(known[code] for known, code in zip(names, pair, strict=True)) for pair in pairs.T[order].tolist()
    ]
    return rank[inverse.reshape(-1)], known_as


def _order(
    table: Table, plan: Integers, names: list[str], start: NDArray[np.float64] | None
) -> tuple[Integers, list[str]]:
    """The rows in the order of plans and, where it is known, of time; and a note where that is another order."""
    if start is None:
        starts = np.flatnonzero(np.diff(plan, prepend=-1))
        again = np.flatnonzero(plan[starts] != np.arange(len(starts)))
        if again.size:
            # Two pieces may be one plan in a file sorted by time, or two plans of subjects whose plans are each
            # counted from 1: only the user can know.
            row = int(starts[again[0]])
            raise ValueError(
                f"{table.place(row)}: plan {names[plan[row]]!r} goes on after another plan; sort the rows by plan, name"
                " a column of times (start), or give each plan a name of its own"
            )
        return np.arange(len(plan)), []
    if np.isnan(start).any():
        row = int(np.isnan(start).argmax())
        raise ValueError(f"{table.place(row)}: start: an empty cell; a time is expected")
    order = np.lexsort((start, plan))
    moved = bool((np.diff(order) < 0).any())
    notes = ["rows are put in the order of their start"] * moved
    texts = table.frame.iloc[:, table.at["start"]].astype(str)
    back = (np.diff(start) < -HALF_A_DAY) & (np.diff(plan) == 0)
    if back.any() and texts.str.fullmatch(CLOCK).all():
        row = int(back.argmax())
        times = f"from {texts.iloc[row]} to {texts.iloc[row + 1]} ({table.place(row + 1)})"
        notes.append(f"times of day go back {times}; past midnight they need a date")
    return order, notes


def _durations(
    table: Table, when: NDArray[np.float64] | None, row: Integers, begin: NDArray[np.bool_]
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """The duration and the end of each action, in the order of `row`; NaN where not known, None where none is."""
    for what in ("duration", "stop"):
        if what in table.at:
            values = table.numbers(what, table.at[what], times=True)[row]
            if what == "stop" and when is None:
                raise ValueError("`columns.start` must be given with `columns.stop`.")
            since: Any = 0.0 if what == "duration" or when is None else when
            taken = values - since
            if (taken < 0).any():
                wrong = int((taken < 0).argmax())
                raise ValueError(
                    f"{table.place(int(row[wrong]))}: {what}: the action takes {taken[wrong]:g}; 0 or more is expected"
                )
            return taken, values if what == "stop" else None if when is None else when + taken
    if when is None:
        return None, None
    # An action goes on until the next one begins; when the last one of a plan ended is not known.
    until: NDArray[np.float64] = np.append(when[1:], np.nan).astype(np.float64)
    until[np.append(begin[1:], True)] = np.nan
    return until - when, until


def _contradictions(table: Table, row: Integers, seconds: NDArray[np.float64], ends: NDArray[np.float64]) -> list[str]:
    """A note where durations are not the time from start to stop, or the stops are no times at all."""
    try:
        apart = np.abs(table.numbers("stop", table.at["stop"], times=True)[row] - ends)
    except ValueError:
        return ["the stops are not read as times; the column of durations counts"]
    other = row[apart > ALIKE * (seconds + np.nanmedian(seconds))]
    if not other.size:
        return []
    first = table.place(int(other.min()))
    return [
        f"{other.size:,} durations, the first in {first}, are not the time from start to stop; the column of durations"
        " counts"
    ]


def _rounded(*times: Any) -> Any:
    """By how much sums and differences of times may be wrong."""
    return ROUNDING * np.spacing(np.maximum.reduce(np.broadcast_arrays(*map(np.abs, times))))


def _running_maximum(ends: NDArray[np.float64], plan: Integers) -> NDArray[np.float64]:
    """The latest end so far in each plan."""
    import pandas as pd

    return np.asarray(pd.Series(ends).groupby(plan).cummax(), np.float64)


def _numbered(
    what: str,
    codes: Integers,
    labels: list[str],
    names: Names | None,
    count: int | None,
    place: Callable[[int], str],
) -> tuple[Integers, Names | None]:
    """Numbers, and the names that they stand for: see `Column.finish`."""
    column = Column(what, names, count, untyped=True)
    occur = np.unique(codes)
    try:
        kept = column.look_up([labels[i] for i in occur])
    except ValueError:
        for i, code in enumerate(codes.tolist()):
            try:
                column.look_up([labels[code]])
            except ValueError as error:
                raise ValueError(f"{place(i)}: {error}") from None
        raise
    lookup = np.zeros(len(labels), np.int64)
    lookup[occur] = kept
    column.add_numbers(lookup[codes])
    return column.finish(place)


def _named(what: str, numbers: Integers, names: Names | None) -> dict[str, Any]:
    found: dict[str, Any] = {what: torch.from_numpy(numbers.astype(np.int64))}
    return found | {f"{what}_names": names}


def _context(table: Table, row: Integers, lengths: Integers, notes: list[str]) -> dict[str, Any]:
    """The context of each step: names or whole numbers of one column, or features; `notes` gets what is lost of it."""
    place = table.place
    if len(table.context) == 1:
        codes, labels = table.texts(table.context[0])
        codes = codes[row]
        if (codes < 0).any():
            raise ValueError(
                f"{place(int(row[(codes < 0).argmax()]))}: context: an empty cell ({int((codes < 0).sum())} in all); a"
                " context is expected, such as a name of its own where it is not known"
            )
        if table.decimal == ",":
            points = list(map(_with_point, labels))
            labels = labels if None in map(number_in, points) else points  # a comma may be part of a name
        try:
            numbers, names = _numbered("context", codes, labels, None, None, lambda i: place(int(row[i])))
        except ValueError as error:
            if "whole number" not in str(error):
                raise
        else:
            return _named("context", padded(numbers, lengths, table.of), names)
    columns = [table.numbers("context", at)[row] for at in table.context]
    whole = np.stack(columns, 1)
    features = as_single(f"{table.of}: context", whole)
    wrong = np.argwhere(~np.isfinite(features))
    if wrong.size:
        raise ValueError(f"{place(int(row[wrong[0, 0]]))}: context: a finite number is expected in each column")
    for c in precision_lost(torch.from_numpy(whole), torch.from_numpy(_std_within_plans(whole, lengths))):
        notes.append(
            f"feature {c + 1} of the context is about {whole[:, c].mean():.4g}, where single precision hardly holds how"
            " it varies within plans; subtract a constant from it"
        )
    return {"context": torch.from_numpy(padded(features, lengths, table.of))}


def _std_within_plans(features: Floats, lengths: Integers) -> Floats:
    """Standard deviations `[C]` of `features [S, C]` from the means of their plans; of constants exactly 0."""
    plan, first = np.repeat(np.arange(len(lengths)), lengths), np.cumsum(lengths) - lengths
    shifted = features - features[first[plan]]
    sums = np.stack([np.bincount(plan, values, len(lengths)) for values in shifted.T], 1)
    std: Floats = np.std(shifted - (sums / np.maximum(lengths, 1)[:, None])[plan], 0)
    return std


def _of_plans(what: str, codes: Integers, plan: Integers, place: Callable[[int], str]) -> Integers:
    """What plans have one of; ValueError where a row has another than the first row of its plan, or none."""
    starts = np.flatnonzero(np.diff(plan, prepend=-1))
    own = np.repeat(codes[starts], np.diff(np.append(starts, len(plan))))
    wrong = np.flatnonzero((codes != own) | (codes < 0))
    if wrong.size:
        empty = codes[wrong[0]] < 0
        kind = "an empty cell" if empty else f"another {what} than on the plan's first row"
        raise ValueError(f"{place(int(wrong[0]))}: {what}: {kind}; a plan has one {what}")
    return codes


def _alike(labels: list[str], what: str) -> list[str]:
    """Notes on names that differ in case, spaces, dashes or underscores only, and on a number in several spellings."""
    numbers = [number_in(label) for label in labels]
    named = None in numbers
    alike: dict[str, list[str]] = {}
    for label, number in zip(labels, numbers, strict=True):
        if number is None:
            plain = unicodedata.normalize("NFC", label.casefold())  # a letter may be written as one character or as two
            alike.setdefault(re.sub(r"[\s_-]", "", plain), []).append(label)
        elif not named:
            alike.setdefault(f"= {number:.17g}", []).append(label)
    sets = ", ".join(" and ".join(map(repr, each)) for key, each in alike.items() if key and len(each) > 1)
    means = "nearly the same; rename them if they mean the same" if named else "the same number, and count as the same"
    return [f"{what}s {sets} are {means}"] if sets else []


def _never_notes(actions: Integers, num_actions: int) -> list[str]:
    """A note where some of the action numbers below the largest never occur: codes from 1, say, or with gaps."""
    never = never_occur(np.unique(actions), num_actions)
    return [f"actions are numbers from 0 to {num_actions - 1}, of which {never}"] if never else []


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


def read_events(
    path: str | os.PathLike[str],
    *,
    num_actions: int | None = None,
    action_names: Sequence[str] | None = None,
    columns: Columns | Mapping[str, Any] | None = None,
    missing: Missing = "gap",
    merge_repeats: bool = False,
    max_gap: float | None = None,
) -> RecordedPlans:
    """Recorded plans of a CSV or TSV file: with one action a row, or with one plan a row.

    One action a row: columns `plan` and `action`, and perhaps `context` (or `context_1`, `context_2`, ..., features),
    `group`, `condition`, `start`, `stop` or `duration`; or other columns, which `columns` names. See `plans_of_frame`.
    One plan a row: columns `action_1`, `action_2`, ..., and perhaps a context, `plan` (the name of the recording),
    `group` and `condition`; a label that is missing before the plan's end is a gap.

    Args:
        path: the file.
        num_actions, action_names, columns, missing, merge_repeats, max_gap: see `plans_of_frame`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: an argument or the file is wrong; the message names the file and the line.
        ImportError: pandas is needed, and not installed.
    """
    if not isinstance(columns, Columns | Mapping | None):
        raise ValueError(f"`columns` must say what each holds, as in {{'action': 'behaviour'}}, got {columns!r}")
    given = columns if isinstance(columns, Columns | None) else {k: v for k, v in columns.items() if v is not None}
    table: dict[str, Any] = {"columns": given} if given not in (None, {}, Columns()) else {}
    table |= {"missing": missing} if missing != "gap" else {}
    table |= {"merge_repeats": merge_repeats} if merge_repeats is not False else {}
    table |= {} if max_gap is None else {"max_gap": max_gap}
    sheet = _Sheet(Path(path), table.get("columns"))
    plans = _read(sheet, num_actions, check_names(num_actions, action_names), **table)
    return replace(plans, notes=(*plans.notes, sheet.note)) if sheet.note else plans


def _read(sheet: "_Sheet", num_actions: int | None, action_names: Names | None, **table: Any) -> RecordedPlans:
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
    plans = RecordedPlans.of(
        assembled(str(path), sizes, flat, num_actions, names, context, False, context_names, group, group_names)
    )
    if num_actions is None and names is None:
        plans = replace(plans, notes=_never_notes(flat, plans.num_actions))
    if "condition" in found:
        number, condition_names = found["condition"]
        condition = torch.from_numpy(number.astype(np.int64))
        plans = replace(plans, condition=condition, condition_names=condition_names)
    return replace(plans, recording=plan_names) if plan_names else plans


def _read_events(sheet: "_Sheet", **table: Any) -> RecordedPlans:
    """Plans of a file with one action a row."""
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
        return RecordedPlans(**fields_of(frame, place=place, of=str(sheet.path), decimal=decimal, **table))
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


def _read_gaps(sheet: "_Sheet", action_columns: list[int], **table: Any) -> RecordedPlans:
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
    fields = fields_of(frame, place=lambda i: f"{sheet.path}, line {lines[row[i]]}", of=str(sheet.path), **table)
    rows_of = fields.pop("recording", None)
    if "plan" in sheet.columns:
        called = cells[:, sheet.columns["plan"]]
        pieces = range(len(fields["actions"])) if rows_of is None else map(int, rows_of)
        fields["recording"] = tuple(str(called[i]) for i in pieces)
    if fields.get("context") is not None:
        fields["context"] = fields["context"][:, 0]  # one for each plan, repeated on its rows
    if empty := int((reach == 0).sum()):
        fields["notes"] = (*fields["notes"], f"{empty:,} plans without any label are left out")
    return RecordedPlans(**fields)


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
