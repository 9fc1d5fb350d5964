"""What the columns of a table hold: as a user says, or as their names and cells tell."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
import pandas as pd

from neuroprior.behaviour.reading.names import (
    ANIMALS,
    DEEPETHOGRAM,
    HOUSINGS,
    NAMES,
    OF_NO_SUBJECT,
    ORDERS,
    PERIODS,
    PROGRAMS,
    SIMBA,
    STEM_NUMBER,
    SUMMARY,
    SURE_SEPARATORS,
    WORDS,
    Program,
    plain,
)
from neuroprior.behaviour.reading.problems import Problems, ReadingError
from neuroprior.behaviour.reading.sheets import Sheet
from neuroprior.behaviour.reading.times import MISSING_TIMES, SECONDS, YEAR_FIRST, count_times, read_times, unit_of_name

NOT_USED = "none"
"""Stands for a column's name: no column has this use."""

INDICATORS = frozenset(("0", "1", "", "-1", "true", "false", "0.0", "1.0", "-1.0"))
MONTH = re.compile(r"(jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*[._\- ]?(\d{2}|\d{4})", re.IGNORECASE)
DATE_INSIDE = r"\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}:\d{2}:\d{2}"
"""Occurs in lines of logs that have no cells."""

NO_BEHAVIOURS = re.compile(r"(low[_ ]prob|in zone|result|probability|arena|zone|place|site|location)", re.IGNORECASE)
"""Columns of zeros and ones that programs write beside those of behaviours."""

MAX_CODES = 20
"""Different numbers at most, not all whole, that are labels, such as doses."""

MAX_OBSERVERS = 10
"""Different observers at most, where no user named their column."""

KIND_OF_ROW = "last word of the label"
"""A column of starts and stops that stood in one with the behaviours."""

MIN_WIDE = 3
"""Columns at least, where each row is a sequence."""

MIN_FRAME_ROWS, MIN_EXCESS = 20, 0.2
"""Rows at least, and how much more often a cell is as the one above it than as the one before it, beyond chance, where
rows may be frames and columns subjects."""


@dataclass(frozen=True)
class Columns:
    """What columns hold. A use without a name here gets the column with a usual name; "none" leaves it out.

    Attributes:
        behaviour: a name; several, whose labels are joined, or which hold 0 and 1, one a behaviour; or a range such as
            "Jul.93:Jun.99" where a row is a sequence.
        subject: the animal or person; without it each recording is one; or a range such as "m1:m9" of columns that each
            hold the labels of one, at the frame of the row.
        recording: the session, observation or video; without it each file is one.
        start, stop, duration: when a behaviour began and ended, or how long it took: numbers, h:m:s or dates. Where
            starts and stops are rows of their own, `start` is the time of each row.
        event_type: whether a row is a start or a stop.
        observer: who scored.
        factors: what recordings can be compared by: treatment, sex, day.
        context: what the animal observed, or where it was: labels, or columns of numbers.

    Example:
        >>> Columns(behaviour="Behavior", factors=["sex", "treatment"]).named()["factors"]
        ['sex', 'treatment']
    """

    behaviour: str | Sequence[str] | None = None
    subject: str | Sequence[str] | None = None
    recording: str | Sequence[str] | None = None
    start: str | Sequence[str] | None = None
    stop: str | Sequence[str] | None = None
    duration: str | Sequence[str] | None = None
    event_type: str | Sequence[str] | None = None
    observer: str | Sequence[str] | None = None
    factors: str | Sequence[str] | None = None
    context: str | Sequence[str] | None = None

    def named(self) -> dict[str, list[str]]:
        """Return the names of columns by use, without the uses that have none."""
        uses = {use: value for use, value in asdict(self).items() if value is not None}
        return {
            use: [value] if isinstance(value, str) else [str(name) for name in value] for use, value in uses.items()
        }


def make_columns(columns: Columns | Mapping[str, Any] | None) -> Columns:
    """Return `Columns` of a dict of some of its attributes.

    Raises:
        ValueError: there is no such use, or names are no texts.
    """
    if columns is None or isinstance(columns, Columns):
        return columns or Columns()
    uses = [one.name for one in fields(Columns)]
    wrong = ", ".join(map(repr, sorted(set(columns) - set(uses)))) if isinstance(columns, Mapping) else repr(columns)
    if wrong:
        raise ValueError(f"`columns` must map some of {', '.join(uses)} to names of columns, got {wrong}")
    return Columns(**{use: _check_names(use, value) for use, value in columns.items() if value is not None})


def _check_names(use: str, value: Any) -> str | list[str]:
    if isinstance(value, str | int):
        return str(value)
    if isinstance(value, Iterable) and len(names := [str(one) for one in value]):
        return names
    raise ValueError(f"`columns.{use}` must be the name of a column or a list of names, got {value!r}")


@dataclass
class Roles:
    """What the columns of a sheet hold.

    Attributes:
        at: names of the sheet's columns by use; uses without a column are left out.
        inferred: uses that no user named.
        layout: "events", "rows of starts and stops", "rows of frames", "columns of behaviours" (0 and 1), "columns of
            subjects" (frames) or "rows of sequences".
        program: the program that wrote the file; None where it is not known.
        notes: a line each.
    """

    at: dict[str, list[str]]
    inferred: set[str] = field(default_factory=set)
    layout: str = "events"
    program: Program | None = None
    notes: list[str] = field(default_factory=list)

    def used(self) -> set[str]:
        """Return all columns that have a use."""
        return {name for names in self.at.values() for name in names}

    def infer(self, use: str, names: list[str]) -> None:
        """Give a use columns that no user named."""
        self.at[use] = names
        self.inferred.add(use)


def find_roles(sheet: Sheet, columns: Columns, words: Mapping[str, str]) -> Roles:
    """Return what the columns of a sheet hold.

    Raises:
        ReadingError: a name of the user is no column, or no column holds behaviours.
    """
    named, ranges, problems = _resolve(sheet, columns)
    if problems:
        raise ReadingError(problems)
    plains = _plain_names(sheet.frame)
    program = next((one for one in PROGRAMS if one.needs <= set(plains)), None) if sheet.header else None
    roles = Roles({use: names for use, names in named.items() if names}, program=program)
    _drop_empty(sheet, roles)
    _drop_index(sheet, roles)
    if not sheet.header and not named:
        _guess_roles(sheet, roles)
        _check_direction(sheet, roles)
        return roles
    if program:
        for use, wanted in program.columns.items():
            column = next((plains[one] for one in wanted if one in plains), None)
            if use not in named and column and sheet.frame[column].ne("").any():
                roles.infer(use, [column])
        roles.layout = program.layout or "events"
    closed = {*named, *(program.columns if program else ())}
    for use in ("event_type", "start", "stop", "duration", "recording", "subject", "observer", "factors", "context"):
        if use not in closed:
            _find_use(sheet, roles, use, words)
    if "start" in roles.inferred and program is None:
        _add_dates(sheet, roles)
    _add_factors_above(sheet, roles, closed)
    if {"plan", "action"} <= set(_plain_names(sheet.frame)) and not {"subject", "factors"} & closed:
        _take_group_as_subject(sheet, roles)
    if "subject" in ranges:
        roles.at["behaviour"], roles.layout = roles.at.pop("subject"), "columns of subjects"
    else:
        _choose_behaviour(sheet, roles, "behaviour" in ranges, closed)
    _choose_layout(sheet, roles, words)
    if program is None and roles.layout != "rows of sequences":
        _fill_down(sheet, roles)
    if "recording" not in closed:
        _choose_recordings(sheet, roles)
    if roles.layout == "events" and "start" not in roles.at:
        _sort_by_numbers(sheet, roles)
    _check_direction(sheet, roles)
    if roles.layout == "rows of sequences":
        for use in ("start", "stop", "duration"):
            if use in roles.inferred:
                del roles.at[use]
        if "subject" not in named and "group" not in map(plain, named.get("factors", [])):
            _take_group_as_subject(sheet, roles)
    if "start" not in named:
        _check_is_no_summary(sheet, roles)
    _note_unused(sheet, roles, words)
    return roles


def _plain_names(names: Iterable[str]) -> dict[str, str]:
    """Return columns by their names as `plain` writes them; the first of two that are alike."""
    return {plain(name): name for name in reversed(list(names))}


def _take_group_as_subject(sheet: Sheet, roles: Roles) -> None:
    """Read a column called group as the subject, where there is none: in tables of plans groups are independent."""
    group = _plain_names(sheet.frame).get("group")
    if group and "subject" not in roles.at:
        roles.infer("subject", [group])
        roles.at["factors"] = [name for name in roles.at.get("factors", []) if name != group]


def _resolve(sheet: Sheet, columns: Columns) -> tuple[dict[str, list[str]], set[str], list[str]]:
    """Return the sheet's columns for the user's names by use, the uses that are ranges, and what is wrong."""
    resolved: dict[str, list[str]] = {}
    ranges: set[str] = set()
    problems: list[str] = []
    for use, names in columns.named().items():
        if names == [NOT_USED]:
            resolved[use] = []
            continue
        chosen: list[str] = []
        for name in names:
            exact = _column(sheet, name) or _line_above(sheet, name)
            if exact is not None:
                chosen.append(exact)
                continue
            ends = [_column(sheet, end) for end in name.split(":")]
            parts = [_column(sheet, column) for column in name.split(",")]
            every = list(sheet.frame.columns)
            if len(ends) == 2 and None not in ends:
                first, last = sorted((every.index(str(ends[0])), every.index(str(ends[1]))))
                chosen += every[first : last + 1]
                ranges.add(use)
            elif len(parts) > 1 and None not in parts:
                chosen += map(str, parts)
            else:
                missing = name.split(",")[parts.index(None)] if len(parts) > 1 else name
                shown = ", ".join(every[:30]) + (", ..." if len(every) > 30 else "")
                problems.append(f"{sheet.name}: `columns.{use}` must be one of {shown}, got {missing.strip()!r}")
        resolved[use] = list(dict.fromkeys(chosen))
    return resolved, ranges, problems


def _column(sheet: Sheet, name: str) -> str | None:
    """Return the column of a name: the same, else but for case and space, else but for punctuation and units."""
    every = list(sheet.frame.columns)
    if name in every:
        return name
    for form in (lambda text: text.strip().lower(), plain):
        same = [one for one in every if form(one) == form(name)]
        if len(same) == 1:
            return str(same[0])
    return None


def _line_above(sheet: Sheet, name: str) -> str | None:
    """Add a column of a line "name, value" above the header, and return its name; None for no such line."""
    value = next((value for key, value in sheet.above.items() if plain(key) == plain(name) and value), None)
    if value is None:
        return None
    sheet.frame[name] = value
    return name


def _drop_empty(sheet: Sheet, roles: Roles) -> None:
    """Leave out uses whose columns are empty."""
    for use in [use for use in ("subject", "recording", "observer") if use in roles.at]:
        if all(sheet.frame[name].eq("").all() for name in roles.at[use]):
            roles.notes.append(f"the column {roles.at[use][0]!r} is empty, and not used as {use}")
            del roles.at[use]


def _fill_down(sheet: Sheet, roles: Roles) -> None:
    """Let what stands in the first row of a subject, recording or level alone, as in merged cells, go on below it.

    Levels go on within a subject and a recording alone, where their cells are filled.
    """
    frame, behaviour = sheet.frame, roles.at["behaviour"][0]
    whole: list[str] = []
    for use in ("subject", "recording", "factors"):
        for name in roles.at.get(use, []):
            column = frame[name]
            filled = column != ""
            if len(frame) and filled.iloc[0] and filled.mean() < 2 / 3:
                is_repeated = (column[filled].shift() == column[filled]).any()  # may be forgotten in some rows
                as_others = frame[behaviour][~filled].isin(frame[behaviour][filled]).mean() >= 0.5  # not of nobody
                if not is_repeated and as_others:
                    frame[name] = column.where(filled).groupby(_number_groups(frame, whole)).ffill().fillna("")
                    what = f"the column {name!r} is filled where its values begin"
                    roles.notes.append(f"{what}, and each is read to go on below it")
            if use != "factors" and frame[name].ne("").all():
                whole.append(name)


def _drop_index(sheet: Sheet, roles: Roles) -> None:
    """Leave out columns without a name that count the rows or are empty."""
    for name in list(sheet.frame.columns):
        unnamed = name.startswith("(column ") or name.lower().startswith("unnamed:") or name == "index"
        if not unnamed or name in roles.used():
            continue
        numbers = pd.to_numeric(sheet.frame[name], errors="coerce").to_numpy(np.float64)
        if len(numbers) and np.isfinite(numbers).all() and (np.diff(numbers) == 1).all() and numbers[0] in (0, 1):
            sheet.frame = sheet.frame.drop(columns=name)
            roles.notes.append(f"the first column of {sheet.name} counts the rows, and is not used")
        elif sheet.frame[name].eq("").all():
            sheet.frame = sheet.frame.drop(columns=name)


def _guess_roles(sheet: Sheet, roles: Roles) -> None:
    """Give roles to the columns of Audacity's labels (start, stop, label), of frames, or of a sequence a row."""
    frame = sheet.frame
    numeric = [bool(pd.to_numeric(frame[name].str.replace(",", "."), errors="coerce").notna().all()) for name in frame]
    names = list(frame.columns)
    if len(names) in (2, 3) and numeric[:2] == [True, True]:
        start, stop = (pd.to_numeric(frame[name].str.replace(",", ".")) for name in names[:2])
        decimals = all(frame[name].str.contains("[.,]").all() for name in names[:2])
        if len(names) == 2 and decimals:
            raise ReadingError(f"{sheet.name}: labels of Audacity must have a name each, got starts and stops alone")
        if len(names) == 3 and (decimals or not numeric[2]) and bool((stop >= start).all()):
            roles.at = {"start": [names[0]], "stop": [names[1]], "behaviour": [names[2]]}
            roles.notes.append(f"{sheet.name} is read as labels of Audacity: start, stop, label")
            return
    kinds = (r"-?(\d+:)?\d+:\d+([.,]\d+)?", YEAR_FIRST)
    clocks = [name for name in names if any(frame[name].str.fullmatch(kind).all() for kind in kinds)]
    if len(names) == 1 and frame[names[0]].str.contains(DATE_INSIDE).mean() > 0.9:
        raise ReadingError(
            f"{sheet.name}: a row must be cells with one separator, below a header, got a text with a date,"
            f" {frame[names[0]].iloc[0]!r}"
        )
    if clocks:
        raise ReadingError(
            f"{sheet.name}: the file must have a header, got data in its first line; name columns by number, such as"
            f" --columns.start {clocks[0]!r} --columns.behaviour {names[-1]!r}"
        )
    roles.infer("behaviour", names)
    roles.layout = "rows of sequences" if len(names) > 1 else "events"


def _find_use(sheet: Sheet, roles: Roles, use: str, words: Mapping[str, str]) -> None:
    """Give a use the column with its name; one that holds something else is left out with a note."""
    plains = _plain_names(sheet.frame)
    candidates = [plains[name] for name in NAMES[use] if name in plains and plains[name] not in roles.used()]
    if use == "event_type":
        kinds = {name: _event_words(sheet.frame[name], words) for name in candidates}
        kept = [name for name, kind in kinds.items() if kind == {"start", "stop"} or "lifecycle" in name.lower()]
        kept = kept or [name for name in sheet.frame if _event_words(sheet.frame[name], words) == {"start", "stop"}]
        kept = kept or [name for name in candidates if sorted(sheet.frame[name].unique()) == ["0", "1"]]
    elif use in ("start", "stop", "duration"):
        kept = []
        _check_is_in_one_column(sheet, candidates)
        for name in candidates:
            times, digits, filled = count_times(sheet.frame[name].to_numpy(object))
            bounds = name.lower().endswith("min") and f"{name[:-3]}max" in map(str.lower, sheet.frame)
            if use == "duration" and (bounds or _is_length_of_all(sheet, roles, name)):
                continue
            if filled and (times * 2 > filled or digits * 2 > filled or (times and name == candidates[0])):
                kept.append(name)  # what cannot be read in it is an error
            elif filled and name == candidates[0]:
                roles.notes.append(f"the column {name!r} holds no times, and is not used as {use}")
        if use == "stop" and "start" not in roles.at:
            kept = []
    elif use == "factors":
        kept = [name for name in candidates if sheet.frame[name].ne("").any()]
    elif use == "context":
        kept = _contexts(sheet, roles)
    else:
        kept = [name for name in candidates if sheet.frame[name].ne("").any()]
        if use == "observer":
            kept = [name for name in kept if sheet.frame[name].nunique() <= MAX_OBSERVERS]
        elif candidates and not kept:
            roles.notes.append(f"the column {candidates[0]!r} is empty, and not used as {use}")
        elif use == "subject" and not kept:
            free = [name for name in sheet.frame if name not in roles.used() and sheet.frame[name].duplicated().any()]
            others = (*NAMES["behaviour"], *OF_NO_SUBJECT)
            ids = [name for name in free if plain(name).endswith(" id") and plain(name)[:-3] not in others]
            fallback = (*ANIMALS, *(HOUSINGS if "recording" not in roles.at else ()))
            likely = [name for name in free if plain(name) in fallback]
            starts = _starts(sheet, roles) if likely else None
            kept = ids if len(ids) == 1 else [one for one in likely if _are_numbered_anew(sheet.frame, starts, [], one)]
    if kept:
        roles.infer(use, kept if use in ("factors", "context", "recording") else kept[:1])


def _check_is_in_one_column(sheet: Sheet, candidates: list[str]) -> None:
    """Refuse hours, minutes and seconds that each have a column of their own.

    Raises:
        ReadingError: columns of one name differ in their unit, and the smaller units stay below 60.
    """
    parts = [name for name in sheet.frame if candidates and plain(name) == plain(candidates[0])]
    of_unit = {unit_of_name(name): name for name in parts}
    small = [sheet.frame[of_unit[unit]] for unit in ("min", "s") if unit in of_unit]
    if len(of_unit.keys() & {"h", "min", "s"}) > 1 and all(
        pd.to_numeric(one, errors="coerce").max() < 60 for one in small
    ):
        raise ReadingError(
            f"{sheet.name}: a time must stand in one column, got {', '.join(parts)}; join them, such as 9:05:30"
        )


def _choose_recordings(sheet: Sheet, roles: Roles) -> None:
    """Keep the columns that tell recordings apart: the first, and those that divide its recordings.

    Days come first within which sessions are numbered anew. Notes and leaves out columns that differ in each row of a
    subject or of a recording, such as trials of one choice.
    """
    chosen: list[str] = []
    subjects, candidates = roles.at.get("subject", []), roles.at.pop("recording", [])
    are_rows = roles.layout != "rows of sequences"
    times = _starts(sheet, roles) if are_rows else None
    names = [*(_periods(sheet, roles, candidates, times) if are_rows else []), *candidates]
    may_count = are_rows and len(sheet.frame) > 2 and (not subjects or bool(sheet.frame.duplicated(subjects).any()))
    # Where behaviours do not recur, each may be a sequence.
    recur = len(names) > 1 and bool(sheet.frame[roles.at["behaviour"]].duplicated().mean() >= 0.5)
    for name in names:
        groups = sheet.frame.groupby([*chosen, name], sort=False).ngroups
        before = sheet.frame.groupby(chosen, sort=False).ngroups if chosen else 0
        within = chosen if chosen and recur and _rise(sheet.frame, times, [*subjects, *chosen]) else []
        if may_count and not sheet.frame.duplicated([*subjects, *within, name]).any():
            where = "of a recording, " if within else "of a subject, " if subjects else ""
            roles.notes.append(f"the column {name!r} differs in each row {where}and is not used as recording")
        elif groups > before:
            chosen.append(name)
    if chosen:
        roles.infer("recording", chosen)


def _sort_by_numbers(sheet: Sheet, roles: Roles) -> None:
    """Sort the rows of each recording by a column that numbers them, where there is one."""
    keys = [*roles.at.get("subject", []), *roles.at.get("recording", [])]
    for name in [name for name in sheet.frame if plain(name) in ORDERS and name not in roles.used()]:
        numbers = pd.to_numeric(sheet.frame[name], errors="coerce")
        if numbers.isna().any() or sheet.frame.duplicated([*keys, name]).any():
            continue
        group = _number_groups(sheet.frame, keys)
        if (numbers.groupby(group).diff().dropna() > 0).all():
            return
        order = np.lexsort((numbers, group))
        sheet.frame, sheet.lines = sheet.frame.iloc[order].reset_index(drop=True), sheet.lines[order]
        roles.notes.append(f"rows are sorted by the column {name!r}, which numbers them")
        return


def _periods(sheet: Sheet, roles: Roles, recordings: list[str], times: Any) -> list[str]:
    """Return the columns of days or weeks in which sessions are numbered anew, and of blocks in which trials are."""
    others = [name for use, names in roles.at.items() if use != "factors" for name in names]
    subjects = roles.at.get("subject", [])
    are_trials = bool(recordings) and all(plain(name).startswith("trial") for name in recordings)
    blocks = ("block",) if are_trials and sheet.frame.duplicated([*subjects, *recordings]).any() else ()
    periods = [
        name for name in sheet.frame if plain(name) in (*PERIODS, *blocks) and name not in [*others, *recordings]
    ]
    keys = [*subjects, *([] if are_trials else recordings)]
    return [name for name in periods if _are_numbered_anew(sheet.frame, times, keys, name)]


def _are_numbered_anew(frame: Any, times: Any, keys: list[str], name: str) -> bool:
    """Return whether the rows of each value of a column stand together within `keys`, and its times begin anew.

    Without times (None), whether most values have several rows.
    """
    number = frame.groupby([*keys, name], sort=False).ngroup().to_numpy()
    key = _number_groups(frame, keys)
    order = np.argsort(key, kind="stable")
    number, key = number[order], key[order]
    begins = np.flatnonzero(np.diff(number, prepend=-1) != 0)
    if len(begins) != len(np.unique(number)) or frame[name].eq("").any() or frame[name].nunique() < 2:
        return False
    if times is None:
        return float(np.median(np.diff(np.append(begins, len(number))))) >= 2
    ordered = times[order]
    changes = begins[1:][key[begins[1:]] == key[begins[1:] - 1]]
    return len(changes) > 0 and float((ordered[changes] < ordered[changes - 1]).mean()) > 0.9


def _number_groups(frame: Any, keys: list[str]) -> Any:
    """Return the number of each row's group, int64 `[rows]`, in the order of appearance; one without keys."""
    return frame.groupby(keys, sort=False).ngroup().to_numpy() if keys else np.zeros(len(frame), np.int64)


def _read_quietly(sheet: Sheet, use: str, name: str) -> Any:
    """Return the times in a column, float64 `[rows]`, whatever is wrong with them."""
    texts = sheet.frame[name].to_numpy(object)
    return read_times(texts, use, sheet.place, Problems(), separator=sheet.separator).values


def _starts(sheet: Sheet, roles: Roles) -> Any:
    """Return the times of the starts, float64 `[rows]`; None without a column of them."""
    return _read_quietly(sheet, "start", roles.at["start"][-1]) if "start" in roles.at else None


def _rise(frame: Any, times: Any, keys: list[str]) -> bool:
    """Return whether times, if there are any, rise from row to row within `keys`."""
    if times is None:
        return True
    steps = pd.Series(times).groupby(_number_groups(frame, keys)).diff().dropna()
    return not len(steps) or bool((steps >= 0).mean() > 0.95)


def _is_length_of_all(sheet: Sheet, roles: Roles, name: str) -> bool:
    """Return whether a duration is the same in all rows, and longer than the time between most of them."""
    if "start" not in roles.at or sheet.frame[name].nunique() > 1 or len(sheet.frame) < 3:
        return False
    length = _read_quietly(sheet, "duration", name)[0]
    factor = SECONDS.get(unit_of_name(name), 1.0) / SECONDS.get(unit_of_name(roles.at["start"][-1]), 1.0)
    steps = np.diff(np.sort(_starts(sheet, roles)))
    return bool(np.median(steps) < 0.5 * length * factor)


def _add_dates(sheet: Sheet, roles: Roles) -> None:
    """Put a column of dates before times of day, so that days do not lie upon one another."""
    plains = _plain_names(sheet.frame)
    dates = [plains[name] for name in NAMES["date"] if name in plains and plains[name] not in roles.used()]
    start = sheet.frame[roles.at["start"][0]]
    words = pd.Series(pd.unique(start[start != ""])[:100], dtype=object)
    clock = r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?( ?[ap]m)?"
    if not dates or not len(words) or not words.str.fullmatch(clock, case=False).all():
        return
    times, _, filled = count_times(sheet.frame[dates[0]].to_numpy(object))
    if filled and times == filled:
        for use in ("start", "stop"):
            if use in roles.inferred:
                roles.at[use] = [dates[0], *roles.at[use]]
        roles.notes.append(f"times of day are of the days in the column {dates[0]!r}")


def _add_factors_above(sheet: Sheet, roles: Roles, closed: set[str]) -> None:
    """Take factors that stand above the header as columns."""
    if "factors" in closed:
        return
    for name, value in sheet.above.items():
        if plain(name) in NAMES["factors"] and value and name not in sheet.frame:
            sheet.frame[name] = value
            roles.infer("factors", [*roles.at.get("factors", []), name])


def _contexts(sheet: Sheet, roles: Roles) -> list[str]:
    """Return the columns called context, or context_1, context_2, ..., if all their cells are filled."""
    names = [name for name in sheet.frame if re.fullmatch(r"context( \d+)?", plain(name)) and name not in roles.used()]
    empty = [name for name in names if sheet.frame[name].eq("").any()]
    if empty:
        roles.notes.append(f"the column {empty[0]!r} has empty cells, and is not used as context")
        return []
    return names


def _event_words(column: "pd.Series[Any]", words: Mapping[str, str]) -> set[str]:
    """Return whether the words of a column stand for "start" and "stop"; "" for words that stand for no kind."""
    kinds = {word: kind for kind, names in WORDS.items() for word in names} | {k.lower(): v for k, v in words.items()}
    return {kinds.get(text.lower(), "") for text in pd.unique(column) if text} - {"point"}


def _choose_behaviour(sheet: Sheet, roles: Roles, is_range: bool, closed: set[str]) -> None:
    """Give roles the columns of behaviours where no user named them, and the layout that they tell."""
    frame = sheet.frame
    if names := roles.at.get("behaviour"):
        if "behaviour" not in roles.inferred and len(names) > 1:
            in_range = is_range or _is_numbered(names)
            zeros = all(_is_indicator(frame[name]) for name in names)
            if zeros and not (is_range and _is_numbered(names) and not _are_channels(sheet, roles, names)):
                roles.layout = "columns of behaviours"
            elif in_range or (len(names) >= MIN_WIDE and "start" not in roles.at and _share_labels(frame, names)):
                roles.layout = "rows of sequences"
        return
    free = [name for name in frame if name not in roles.used()]
    plains = _plain_names(free)
    usual = [plains[name] for name in NAMES["behaviour"] if name in plains]
    usual = [name for name in usual if not len(frame) or frame[name].ne("").any()]
    usual = [name for name in usual if not _is_measured(frame[name])]
    usual = [name for name in usual if plain(name) != "name" or "stop" in roles.at]
    if "behaviour" in closed and roles.program and roles.program.layout == "columns of behaviours":
        usual = []
    wide = _numbered_run(frame, free) if roles.program is None else []
    zeros = bool(wide) and not _names_behaviours(wide) and all(_is_indicator(frame[name]) for name in wide)
    if zeros and _are_channels(sheet, roles, wide):
        wide = []
    if wide and (not usual or len(wide) > 5 or _names_behaviours(wide)):
        roles.at["behaviour"], roles.layout = wide, "rows of sequences"
    elif roles.program and roles.program.columns.get("behaviour"):
        wanted = ", ".join(roles.program.columns["behaviour"])
        raise ReadingError(f"{sheet.name}: {roles.program.name}, must have a column of labels ({wanted}), got none")
    elif usual:
        roles.at["behaviour"] = ([name for name in usual if plain(name) != "name"] or usual)[:1]
    elif (
        (indicators := _indicator_columns(frame, free))
        and not (len(indicators) == 1 and _only_label(frame, free))
        and ("stop" not in roles.at or _are_bins(sheet, roles) or _are_exclusive(frame, indicators))  # else flags
    ):
        roles.at["behaviour"], roles.layout = indicators, "columns of behaviours"
        if any(name.startswith("Probability_") for name in free):
            roles.program = SIMBA
        elif indicators[0].lower() == "background":
            roles.program = DEEPETHOGRAM
    elif run := _labelled_run(frame, free, 2 if "start" in roles.at else MIN_WIDE):
        roles.at["behaviour"], roles.layout = run, "rows of sequences"
    elif label := ("start" not in roles.at and _only_string(frame, free)) or (roles.at and _only_label(frame, free)):
        roles.at["behaviour"] = [label]
    else:
        uses = "; ".join(f"{use} is {', '.join(names)}" for use, names in roles.at.items())
        every = ", ".join(list(frame.columns)[:30])
        raise ReadingError(
            f"{sheet.name}: a column must hold behaviours, got {every}{f' ({uses})' if uses else ''};"
            " say which does (--columns.behaviour NAME)"
        )
    roles.inferred.add("behaviour")


def _is_one(column: "pd.Series[Any]") -> Any:
    return column.isin(["1", "1.0", "True", "true"])


def _is_indicator(column: "pd.Series[Any]") -> bool:
    """Return whether a column holds zeros and ones, or true and false; -1 and empty cells are not scored."""
    values = {str(text).lower() for text in pd.unique(column)}
    other = values - INDICATORS - frozenset(MISSING_TIMES)
    if not other:
        return bool({"0", "1", "true", "false", "0.0", "1.0"} & values)
    # A slip of the pen in a column of zeros and ones is an error of its own, and makes no other column of it.
    wrong = column.str.lower().isin(other).sum()
    return {"0", "1"} <= values and wrong <= max(1, 0.01 * len(column)) and len(other) <= 2


def _is_measured(column: "pd.Series[Any]") -> bool:
    """Return whether a column holds measurements: numbers, often not whole, or hundreds of different ones."""
    numbers = pd.to_numeric(column[column != ""], errors="coerce")
    if not len(numbers) or numbers.isna().mean() > 0.1:
        return False
    different = numbers.nunique()
    if (numbers % 1 != 0).mean() > 0.1:
        return different > MAX_CODES
    return different > max(300, 0.5 * len(numbers)) and len(numbers) > 600


def _indicator_columns(frame: Any, free: list[str]) -> list[str]:
    """Return the columns of zeros and ones that are behaviours; in SimBA's tables those that have a probability."""
    names = [name for name in free if _is_indicator(frame[name]) and not NO_BEHAVIOURS.match(name)]
    chosen = [name for name in names if f"Probability_{name}" in frame.columns]
    names = chosen or names
    return names if any(_is_one(frame[name]).any() for name in names) else []


def _are_channels(sheet: Sheet, roles: Roles, names: list[str]) -> bool:
    """Return whether columns of zeros and ones are behaviours of frames, and not steps of one sequence a row.

    Frames have a time, or one behaviour each.
    """
    ones = sum(_is_one(sheet.frame[name]).astype(int) for name in names)
    return "start" in roles.at or float((ones == 1).mean()) > 0.95


def _is_numbered(names: list[str]) -> bool:
    """Return whether names are one stem with numbers that count up, or months."""
    return len(names) >= MIN_WIDE and (all(map(MONTH.fullmatch, names)) or _runs(names) == [names])


def _runs(names: list[str]) -> list[list[str]]:
    """Return the runs of names that are one stem with numbers that count up, or months."""
    runs: list[list[str]] = []
    last: tuple[str, int] | None = None
    for name in names:
        match = STEM_NUMBER.fullmatch(name)
        key = ("month", -1) if MONTH.fullmatch(name) else (match[1] or "", int(match[2])) if match else None
        if key and last and key[0] == last[0] and (key[1] > last[1] or key[1] == -1):
            runs[-1].append(name)
        else:
            runs.append([name])
        last = key
    return runs


def _numbered_run(frame: Any, free: list[str]) -> list[str]:
    """Return the longest run of numbered columns that hold labels."""
    runs = [run for run in _runs(free) if len(run) >= MIN_WIDE]
    runs = [run for run in runs if not any(_is_measured(frame[name]) for name in run)]
    runs = [run for run in runs if _names_behaviours(run) or _share_labels(frame, run)]
    return max(runs, key=len, default=[])


def _names_behaviours(run: list[str]) -> bool:
    """Return whether numbered columns are called behaviours."""
    return plain(run[0]).startswith(("action ", "behavior ", "behaviour "))


def _share_labels(frame: Any, names: list[str]) -> bool:
    """Return whether columns share labels: on average, more than half of those of one occur in others."""
    sets = [set(pd.unique(frame[name])) - {""} for name in names]
    sets = [one for one in sets if one]
    if len(sets) < 2:
        return False
    shares = [len(one & set().union(*(sets[:i] + sets[i + 1 :]))) / len(one) for i, one in enumerate(sets)]
    return float(np.mean(shares)) > 0.5


def _labelled_run(frame: Any, free: list[str], min_columns: int) -> list[str]:
    """Return the longest run of neighbouring columns that share labels, which are texts and no numbers."""
    best: list[str] = []
    run: list[str] = []
    labels = {name: set(pd.unique(frame[name])) - {""} for name in free}
    for name in free:
        numbers = pd.to_numeric(pd.Series(list(labels[name]), dtype=object), errors="coerce")
        if not labels[name] or numbers.isna().mean() <= 0.5:
            run = []
        elif run and _share_labels(frame, [run[-1], name]):
            run = [*run, name]
        else:
            run = [name]
        best = run if len(run) > len(best) else best
    if len(best) < min_columns:
        return []
    if min_columns >= MIN_WIDE:
        return best
    # Beside a time a neighbour that shows few of their labels is one of them.
    common = set().union(*(labels[name] for name in best))
    shares = [len(labels[name] & common) / max(len(labels[name]), 1) for name in free]
    fits = [share >= 0.5 and not NO_BEHAVIOURS.match(name) for share, name in zip(shares, free, strict=True)]
    first, last = free.index(best[0]), free.index(best[-1])
    while first > 0 and fits[first - 1]:
        first -= 1
    while last + 1 < len(free) and fits[last + 1]:
        last += 1
    return free[first : last + 1]


def _are_exclusive(frame: Any, indicators: list[str]) -> bool:
    """Return whether one of several columns of zeros and ones is one in nearly each row."""
    ones = sum(_is_one(frame[name]).astype(int) for name in indicators)
    return len(indicators) > 1 and float((ones == 1).mean()) > 0.95


def _only_string(frame: Any, free: list[str]) -> str | None:
    """Return the only column whose cells are sequences with a separator that no word holds; None for several."""
    mark = "|".join(map(re.escape, SURE_SEPARATORS))
    strings = [name for name in free if len(frame) and frame[name].str.contains(mark, regex=True).mean() > 0.5]
    return strings[0] if len(strings) == 1 else None


def _only_label(frame: Any, free: list[str]) -> str | None:
    """Return the only column whose name ends in a word for labels, or else whose texts recur; None for several."""
    endings = ("behavior", "behaviour", "label", "state", "syllable")
    labels = [name for name in free if plain(name).split(" ")[-1] in endings]
    if len(labels) == 1:
        return labels[0]
    texts = []
    for name in free:
        words = frame[name][frame[name] != ""]
        number = pd.to_numeric(words, errors="coerce").notna().mean() if len(words) else 1
        times, _, filled = count_times(words.to_numpy(object))
        if number < 0.5 and times * 2 < max(filled, 1) and 1 < words.nunique() <= max(2, len(words) // 3):
            texts.append(name)
    return texts[0] if len(texts) == 1 else None


def _check_is_no_summary(sheet: Sheet, roles: Roles) -> None:
    """Refuse a table of totals and means, which holds no events.

    Raises:
        ReadingError: no column holds times, and an unused one is called a total, a mean or a number.
    """
    if roles.layout != "events" or {"start", "stop"} & roles.at.keys():
        return
    words = [name for name in sheet.frame if name not in roles.used() and len(sheet.frame)]
    sums = [name for name in words if sheet.frame[name].str.lower().str.contains(SUMMARY).mean() > 0.5]
    if sums:
        raise ReadingError(f"{sheet.name}: a row must be an event, got totals (column {sums[0]!r}); export the events")
    totals = [name for name in sheet.frame if name not in roles.used() and SUMMARY.search(plain(name))]
    numbers = [name for name in totals if pd.to_numeric(sheet.frame[name], errors="coerce").notna().any()]
    if numbers:
        raise ReadingError(
            f"{sheet.name}: a row must be an event, got a table of totals (column {numbers[0]!r}); export the events,"
            " or say --columns.start none if rows are events in their order"
        )


def _choose_layout(sheet: Sheet, roles: Roles, words: Mapping[str, str]) -> None:
    """Choose between events and rows of starts and stops, and leave out inferred uses that the layout has not."""
    _split_event_words(sheet, roles, words)
    if roles.layout in ("rows of sequences", "columns of behaviours", "columns of subjects"):
        if "event_type" in roles.inferred:
            roles.at.pop("event_type", None)
    elif "event_type" in roles.at:
        column = sheet.frame[roles.at["event_type"][0]]
        coded = set(column.unique()) == {"0", "1"}
        if "event_type" in roles.inferred and "start" not in _event_words(column, words) and not coded:
            del roles.at["event_type"]  # an event log whose rows are all of one kind
            roles.layout = "events"
        else:
            roles.layout = "rows of starts and stops"
            if "stop" in roles.inferred:
                del roles.at["stop"]


def _split_event_words(sheet: Sheet, roles: Roles, words: Mapping[str, str]) -> None:
    """Part labels such as "groom start" and "groom stop" into the behaviour and the kind of row, if all are such."""
    taken = {"stop", "duration", "event_type"} & roles.at.keys()
    if roles.layout != "events" or taken or "start" not in roles.at or len(roles.at["behaviour"]) > 1:
        return
    name = roles.at["behaviour"][0]
    codes, labels = pd.factorize(sheet.frame[name])
    parts = pd.Series(labels, dtype=object).str.extract(r"^(.*\w)[\s_:.\-]+(\w+)$")
    if parts.isna().any(axis=None) or _event_words(parts[1], words) != {"start", "stop"}:
        return
    parts = parts.take(codes).reset_index(drop=True)
    keys = [sheet.frame[one] for use in ("recording", "subject") for one in roles.at.get(use, [])]
    kinds = parts[1].str.lower().groupby([*keys, parts[0]], sort=False)
    if (kinds.shift() == parts[1].str.lower()).mean() > 0.05 or (kinds.transform("size") < 2).mean() > 0.05:
        return  # they do not take turns
    sheet.frame[name], sheet.frame[KIND_OF_ROW] = parts[0], parts[1]
    roles.infer("event_type", [KIND_OF_ROW])
    roles.notes.append(f"the last words of {name!r} say which rows are starts and which stops")


def _check_direction(sheet: Sheet, roles: Roles) -> None:
    """Tell columns of subjects, in which a row is a frame, from rows of sequences, where no user says which.

    Names such as "mouse 1" tell it, and "action 1". Else cells of frames are as those above them, those of sequences as
    those before, more often than by chance.

    Raises:
        ReadingError: it may be either.
    """
    if roles.layout != "rows of sequences" or "behaviour" not in roles.inferred or "subject" in roles.at:
        return
    names = roles.at["behaviour"]
    if _names_behaviours(names):
        return
    cells = sheet.frame[names].to_numpy(object)
    chance_above = float(np.mean([_share_alike(column) for column in cells.T]))
    above = _share_equal(cells[1:], cells[:-1]) - chance_above
    excess = above - (_share_equal(cells[:, 1:], cells[:, :-1]) - _share_alike(cells.ravel()))
    stems = {plain(match[1] or "") for name in names if (match := STEM_NUMBER.fullmatch(name))}
    timed = _has_equal_steps(sheet, roles)
    if (stems and stems <= set(NAMES["subject"])) or (timed and excess > MIN_EXCESS):
        roles.layout = "columns of subjects"
    elif (timed and excess > -MIN_EXCESS) or (len(cells) >= MIN_FRAME_ROWS and excess > MIN_EXCESS):
        span = f"'{names[0]}:{names[-1]}'"
        raise ReadingError(
            f"{sheet.name}: a row must be a sequence or a frame, got a table that may be either; say whether each"
            f" column is a subject (--columns.subject {span}) or each row a sequence (--columns.behaviour {span})"
        )


def _share_alike(cells: Any) -> float:
    """Return the chance that two of the filled cells are equal."""
    counts = pd.Series(cells[cells != ""]).value_counts(normalize=True).to_numpy()
    return float((counts**2).sum())


def _share_equal(cells: Any, others: Any) -> float:
    """Return the share of cells that are equal to those at the same places in others, where neither is empty."""
    filled = (cells != "") & (others != "")
    return float((cells == others)[filled].mean()) if filled.any() else 0.0


def _has_equal_steps(sheet: Sheet, roles: Roles) -> bool:
    """Return whether there are times that grow by equal steps from row to row of each recording."""
    if "start" not in roles.at:
        return False
    times = _starts(sheet, roles)
    same = np.diff(_number_groups(sheet.frame, roles.at.get("recording", []))) == 0
    steps = np.diff(times)[same]
    return len(steps) > 1 and bool((np.isclose(steps, np.nanmedian(steps), rtol=0.02) & (steps > 0)).mean() > 0.9)


def _are_bins(sheet: Sheet, roles: Roles) -> bool:
    """Return whether all rows take equally long, as bins of time do."""
    lengths = _read_quietly(sheet, "stop", roles.at["stop"][-1]) - _starts(sheet, roles)
    return len(lengths) > 1 and bool(np.isclose(lengths, np.nanmedian(lengths), rtol=0.02).mean() > 0.9)


def _note_unused(sheet: Sheet, roles: Roles, words: Mapping[str, str]) -> None:
    """Add notes on columns without a use, above all on those that tell starts from stops."""
    unused = [name for name in sheet.frame.columns if name not in roles.used()]
    for name in unused if roles.layout == "events" and "event_type" not in roles.at else []:
        if _event_words(sheet.frame[name], words) == {"start", "stop"}:
            roles.notes.append(
                f"the column {name!r} seems to say which rows are starts and which stops, and is not used"
                f" (--columns.event_type {name!r}): each row is read as an event"
            )
    unused = [name for name in unused if not name.startswith("(column ")]
    if unused:
        shown = ", ".join(unused[:8]) + (f" and {len(unused) - 8} more" if len(unused) > 8 else "")
        roles.notes.append(f"columns that are not used: {shown}")
