"""Plans of a table of events, one action a row, as behaviour is coded in a laboratory.

Needs pandas (`pip install 'neuroprior[report]'`), which holds the table.
"""

import contextlib
import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neuroprior._checks import check_flags, is_number, precision_lost
from neuroprior.plans.columns import (
    Column,
    Columns,
    Floats,
    Integers,
    Missing,
    Names,
    as_single,
    check_names,
    is_missing,
    listed,
    never_notes,
    number_in,
    padded,
)

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
    """What `Plans` are made of, by name; see `Plans.from_dataframe`.

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
    starts = np.flatnonzero(np.diff(piece, prepend=-1))
    lengths = np.diff(np.append(starts, len(piece)))

    actions, action_found = _numbered("action", codes, labels, names, num_actions, lambda i: place(int(row[i])))
    found: dict[str, Any] = {"action_names": action_found}
    if num_actions is None and action_found is None:
        num_actions = int(actions.max()) + 1
        notes += never_notes(actions, num_actions)
    found["num_actions"] = len(action_found) if action_found is not None else num_actions
    found["actions"] = torch.from_numpy(padded(actions, lengths, of))
    found["lengths"] = None if (lengths == lengths.max()).all() else torch.from_numpy(lengths)
    if table.context:
        found |= _context(table, row, lengths, notes)
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
            found["plan_names"] = own_names
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
    return found | {"notes": tuple(notes)}


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
