"""Which columns of a table hold what: those that a user names, and those that are known by their names."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
import pandas as pd

from neuroprior.behaviour.reading.names import DEEPETHOGRAM, NAMES, PROGRAMS, SIMBA, SUMMARY, WORDS, Program, plain
from neuroprior.behaviour.reading.problems import ReadingError
from neuroprior.behaviour.reading.sheets import Sheet
from neuroprior.behaviour.reading.times import MISSING_TIMES, count_times

NOT_USED = "none"
"""In place of a column's name: the column that would be found is left out."""

INDICATORS = frozenset(("0", "1", "", "-1", "true", "false", "0.0", "1.0", "-1.0"))
MONTH = re.compile(r"(jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*[._\- ]?(\d{2}|\d{4})", re.IGNORECASE)
STEM_NUMBER = re.compile(r"(.*?[^\d.])?[._\- ]?(\d+)")
NO_BEHAVIOURS = re.compile(r"(low[_ ]prob|in zone|result|probability|arena|zone)", re.IGNORECASE)
"""Columns of zeros and ones that programs write beside those of behaviours."""

MAX_CODES = 20
"""Numbers that are not whole, such as doses, that may be labels."""

MAX_OBSERVERS = 10
"""Observers at most, where their column is not named."""

MIN_WIDE = 3
"""Columns at least of which one row is a sequence, where they are not named."""


@dataclass(frozen=True)
class Columns:
    """Which columns hold what. What is not named is found by its name; "none" leaves a use out.

    Attributes:
        behaviour: a name; several, whose labels are joined, or which hold 0 and 1, one for each behaviour; or a range
            such as "Jul.93:Jun.99" where a row is a sequence.
        subject: the animal or person; without it each recording is one.
        recording: the session, observation or video; without it each file is one.
        start, stop, duration: when a behaviour began and ended, or how long it took: numbers, h:m:s or dates. Where
            starts and stops are rows of their own, `start` is the time of each row.
        event_type: what says whether a row is a start or a stop.
        observer: who scored.
        factors: treatment, sex, day: what recordings can be compared by.
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
        """Return the names that were given, by use."""
        given = {use: value for use, value in asdict(self).items() if value is not None}
        return {use: [value] if isinstance(value, str) else [str(one) for one in value] for use, value in given.items()}


def make_columns(given: Columns | Mapping[str, Any] | None) -> Columns:
    """Return `Columns` of what a user gave.

    Raises:
        ValueError: a use that there is not, or names that are no texts.
    """
    if given is None or isinstance(given, Columns):
        return given or Columns()
    uses = [one.name for one in fields(Columns)]
    if not isinstance(given, Mapping) or set(given) - set(uses):
        wrong = ", ".join(map(repr, sorted(set(given) - set(uses)))) if isinstance(given, Mapping) else repr(given)
        raise ValueError(f"`columns` must map some of {', '.join(uses)} to names of columns, got {wrong}")
    values = {use: _names(use, value) for use, value in given.items() if value is not None}
    return Columns(**values)


def _names(use: str, value: Any) -> str | list[str]:
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
        found: uses that no user named.
        layout: "events", "rows of starts and stops", "rows of frames", "columns of behaviours" (0 and 1) or
            "rows of sequences".
        program: that wrote the file, if it is known.
        notes: a line each.
    """

    at: dict[str, list[str]]
    found: set[str] = field(default_factory=set)
    layout: str = "events"
    program: Program | None = None
    notes: list[str] = field(default_factory=list)

    def used(self) -> set[str]:
        """Return all columns that have a use."""
        return {name for names in self.at.values() for name in names}


def find_roles(sheet: Sheet, columns: Columns, words: Mapping[str, str]) -> Roles:
    """Return what the columns of a sheet hold.

    Raises:
        ReadingError: a name that was given is no column, or no column holds behaviours.
    """
    named, ranges, problems = _resolve(sheet, columns)
    if problems:
        raise ReadingError(problems)
    plains: dict[str, str] = {}
    for name in reversed(sheet.frame.columns):
        plains[plain(name)] = name
    program = next((one for one in PROGRAMS if one.needs <= set(plains)), None) if sheet.header else None
    roles = Roles({use: names for use, names in named.items() if names}, program=program)
    _drop_empty(sheet, roles)
    _drop_index(sheet, roles)
    if not sheet.header and not named:
        return _without_header(sheet, roles)
    if program:
        for use, wanted in program.columns.items():
            column = next((plains[one] for one in wanted if one in plains), None)
            if use not in named and column and sheet.frame[column].ne("").any():
                roles.at[use], roles.found = [column], {*roles.found, use}
        roles.layout = program.layout or "events"
    closed = {*named, *(program.columns if program else ())}
    for use in ("event_type", "start", "stop", "duration", "recording", "subject", "observer", "factors", "context"):
        if use not in closed:
            _find_use(sheet, roles, use, words)
    if "start" in roles.found and program is None:
        _add_dates(sheet, roles)
    _add_factors_above(sheet, roles, closed)
    plains = {plain(name): name for name in reversed(sheet.frame.columns)}
    group = plains.get("group")
    if (
        group
        and "subject" not in roles.at
        and not {"subject", "factors"} & closed
        and {"plan", "action"} <= set(plains)
    ):
        # In tables of plans a group is what is independent.
        roles.at["subject"], roles.found = [group], {*roles.found, "subject"}
        roles.at["factors"] = [name for name in roles.at.get("factors", []) if name != group]
    _choose_behaviour(sheet, roles, "behaviour" in ranges, closed)
    _choose_layout(sheet, roles, words)
    if roles.layout == "rows of sequences":
        for use in ("start", "stop", "duration"):
            if use in roles.found:
                del roles.at[use]
        group = next(
            (name for name in sheet.frame if plain(name) == "group" and name not in named.get("factors", [])), None
        )
        if "subject" not in roles.at and group and "subject" not in named:
            roles.at["subject"], roles.at["factors"] = (
                [group],
                [one for one in roles.at.get("factors", []) if one != group],
            )
    if "start" not in named:
        check_is_no_summary(sheet, roles)
    _note_unused(sheet, roles, words)
    return roles


def _resolve(sheet: Sheet, columns: Columns) -> tuple[dict[str, list[str]], set[str], list[str]]:
    """Return the sheet's columns for the names that were given, which uses are ranges, and what is wrong."""
    found: dict[str, list[str]] = {}
    ranges: set[str] = set()
    problems: list[str] = []
    for use, names in columns.named().items():
        if names == [NOT_USED]:
            found[use] = []
            continue
        chosen: list[str] = []
        for name in names:
            exact = _column(sheet, name) or _line_above(sheet, name)
            if exact is not None:
                chosen.append(exact)
                continue
            ends = [_column(sheet, part) for part in name.split(":")]
            parts = [_column(sheet, part) for part in name.split(",")]
            every = list(sheet.frame.columns)
            if len(ends) == 2 and None not in ends:
                first, last = sorted((every.index(str(ends[0])), every.index(str(ends[1]))))
                chosen += every[first : last + 1]
                ranges.add(use)
            elif len(parts) > 1 and None not in parts:
                chosen += map(str, parts)
            else:
                missing = (
                    [part for part in name.split(",") if _column(sheet, part) is None] if len(parts) > 1 else [name]
                )
                shown = ", ".join(every[:30]) + (", ..." if len(every) > 30 else "")
                problems.append(f"{sheet.name}: `columns.{use}` must be one of {shown}, got {missing[0].strip()!r}")
        found[use] = list(dict.fromkeys(chosen))
    return found, ranges, problems


def _column(sheet: Sheet, name: str) -> str | None:
    """Return the column of a name: exactly, else but for case and space, else but for punctuation and units."""
    every = list(sheet.frame.columns)
    if name in every:
        return name
    for form in (lambda text: text.strip().lower(), plain):
        same = [one for one in every if form(one) == form(name)]
        if len(same) == 1:
            return str(same[0])
    return None


def _line_above(sheet: Sheet, name: str) -> str | None:
    """Return a column made of a line "name, value" above the header, where there is one of this name."""
    value = next((value for key, value in sheet.above.items() if plain(key) == plain(name) and value), None)
    if value is None:
        return None
    sheet.frame[name] = value
    return name


def _drop_empty(sheet: Sheet, roles: Roles) -> None:
    for use in [use for use in ("subject", "recording", "observer") if use in roles.at]:
        if all(sheet.frame[name].eq("").all() for name in roles.at[use]):
            roles.notes.append(f"the column {roles.at[use][0]!r} is empty, and not used as {use}")
            del roles.at[use]


def _drop_index(sheet: Sheet, roles: Roles) -> None:
    """Leave out columns without a name that count the rows; others without a name keep their position as name."""
    for name in list(sheet.frame.columns):
        unnamed = name.startswith("(column ") or name.lower().startswith("unnamed:") or name == "index"
        if not unnamed or name in roles.used():
            continue
        numbers = pd.to_numeric(sheet.frame[name], errors="coerce").to_numpy(np.float64)
        if len(numbers) and np.isfinite(numbers).all() and (np.diff(numbers) == 1).all() and numbers[0] in (0, 1):
            sheet.frame = sheet.frame.drop(columns=name)
            roles.notes.append(
                f"the first column of {sheet.name} counts the rows, and is not used" if numbers.size else ""
            )
        elif sheet.frame[name].eq("").all():
            sheet.frame = sheet.frame.drop(columns=name)


def _without_header(sheet: Sheet, roles: Roles) -> Roles:
    """Labels of Audacity (start, stop, label), one column of frames, or one sequence a row."""
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
            return roles
    clocks = [name for name in names if frame[name].str.fullmatch(r"-?(\d+:)?\d+:\d+([.,]\d+)?").all()]
    if clocks:
        raise ReadingError(
            f"{sheet.name}: the file must have a header, got data in its first line; name columns by number, such as"
            f" --columns.start {clocks[0]!r} --columns.behaviour {names[-1]!r}"
        )
    roles.at["behaviour"] = names
    roles.found.add("behaviour")
    roles.layout = "rows of sequences" if len(names) > 1 else "events"
    return roles


def _find_use(sheet: Sheet, roles: Roles, use: str, words: Mapping[str, str]) -> None:
    """Find the column of a use by its name; one that holds something else is left out with a note."""
    plains = {plain(name): name for name in reversed(sheet.frame.columns)}
    candidates = [plains[name] for name in NAMES[use] if name in plains and plains[name] not in roles.used()]
    if use == "event_type":
        kinds = {name: event_words(sheet.frame[name], words) for name in candidates}
        kept = [name for name, kind in kinds.items() if kind == {"start", "stop"} or "lifecycle" in name.lower()]
        kept = kept or [name for name in sheet.frame if event_words(sheet.frame[name], words) == {"start", "stop"}]
        kept = kept or [name for name in candidates if sorted(sheet.frame[name].unique()) == ["0", "1"]]
    elif use in ("start", "stop", "duration"):
        kept = []
        for name in candidates:
            times, digits, filled = count_times(sheet.frame[name].to_numpy(object))
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
        if use == "recording":
            kept = _finest(sheet, kept, roles)
    if kept:
        roles.at[use] = kept if use in ("factors", "context", "recording") else kept[:1]
        roles.found.add(use)


def _finest(sheet: Sheet, names: list[str], roles: Roles) -> list[str]:
    """Return the columns that tell recordings apart: the first, and those that divide its recordings.

    Columns by which each row would be a recording of its own, such as trials of one choice, are left out with a note.
    """
    chosen: list[str] = []
    for name in names:
        groups = sheet.frame.groupby([*chosen, name], sort=False).ngroups
        before = sheet.frame.groupby(chosen, sort=False).ngroups if chosen else 0
        if len(sheet.frame) > 2 and groups == len(sheet.frame):
            roles.notes.append(f"the column {name!r} differs in each row, and is not used as recording")
        elif groups > before:
            chosen.append(name)
    return chosen


def _add_dates(sheet: Sheet, roles: Roles) -> None:
    """Put a column of dates before times of day, so that days do not lie upon one another."""
    plains = {plain(name): name for name in reversed(sheet.frame.columns)}
    dates = [plains[name] for name in NAMES["date"] if name in plains and plains[name] not in roles.used()]
    start = sheet.frame[roles.at["start"][0]]
    words = pd.Series(pd.unique(start[start != ""])[:100], dtype=object)
    if (
        not dates
        or not len(words)
        or not words.str.fullmatch(r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?( ?[ap]m)?", case=False).all()
    ):
        return
    times, _, filled = count_times(sheet.frame[dates[0]].to_numpy(object))
    if filled and times == filled:
        for use in ("start", "stop"):
            if use in roles.found:
                roles.at[use] = [dates[0], *roles.at[use]]
        roles.notes.append(f"times are those of the days in {dates[0]!r}")


def _add_factors_above(sheet: Sheet, roles: Roles, closed: set[str]) -> None:
    """Take factors that stand above the header as columns."""
    if "factors" in closed:
        return
    for name, value in sheet.above.items():
        if plain(name) in NAMES["factors"] and value and name not in sheet.frame:
            sheet.frame[name] = value
            roles.at["factors"] = [*roles.at.get("factors", []), name]
            roles.found.add("factors")


def _contexts(sheet: Sheet, roles: Roles) -> list[str]:
    """Return the columns that are called context, or context_1, context_2, ..., if all their cells are filled."""
    names = [name for name in sheet.frame if re.fullmatch(r"context( \d+)?", plain(name)) and name not in roles.used()]
    empty = [name for name in names if sheet.frame[name].eq("").any()]
    if empty:
        roles.notes.append(f"the column {empty[0]!r} has empty cells, and is not used as context")
        return []
    return names


def event_words(column: "pd.Series[Any]", words: Mapping[str, str]) -> set[str]:
    """Return the kinds (start, stop, point) that the words of a column stand for; "" for a word that is none."""
    kinds = {word: kind for kind, names in WORDS.items() for word in names} | {k.lower(): v for k, v in words.items()}
    return {kinds.get(text.lower(), "") for text in pd.unique(column) if text} - {"point"}


def _choose_behaviour(sheet: Sheet, roles: Roles, is_range: bool, closed: set[str]) -> None:
    """Find the columns of behaviours where none are named; and what several named ones mean."""
    frame = sheet.frame
    if roles.at.get("behaviour"):
        names = roles.at["behaviour"]
        if "behaviour" not in roles.found and len(names) > 1:
            in_range = is_range or _is_numbered(names)
            zeros = all(_is_indicator(frame[name]) for name in names)
            if zeros and not (is_range and _is_numbered(names) and not _are_channels(sheet, roles, names)):
                roles.layout = "columns of behaviours"
            elif in_range or (len(names) >= MIN_WIDE and "start" not in roles.at and _share_labels(frame, names)):
                roles.layout = "rows of sequences"
        return
    free = [name for name in frame if name not in roles.used()]
    plains = {plain(name): name for name in reversed(free)}
    known = [plains[name] for name in NAMES["behaviour"] if name in plains]
    known = [name for name in known if not len(frame) or frame[name].ne("").any()]
    known = [name for name in known if not _is_measured(frame[name])]
    known = [name for name in known if plain(name) != "name" or "stop" in roles.at]
    if "behaviour" in closed and roles.program and roles.program.layout == "columns of behaviours":
        known = []
    wide = _numbered_run(frame, free) if roles.program is None else []
    zeros = bool(wide) and not _names_behaviours(wide) and all(_is_indicator(frame[name]) for name in wide)
    if zeros and _are_channels(sheet, roles, wide):
        wide = []
    if wide and (not known or len(wide) > 5 or _names_behaviours(wide)):
        roles.at["behaviour"], roles.layout = wide, "rows of sequences"
    elif roles.program and roles.program.columns.get("behaviour"):
        wanted = ", ".join(roles.program.columns["behaviour"])
        raise ReadingError(f"{sheet.name}: {roles.program.name}, must have a column of labels ({wanted}), got none")
    elif known:
        text = [name for name in known if plain(name) != "name"] or known
        roles.at["behaviour"] = text[:1]
    elif indicators := _indicator_columns(frame, free):
        roles.at["behaviour"], roles.layout = indicators, "columns of behaviours"
        if any(name.startswith("Probability_") for name in free):
            roles.program = SIMBA
        elif indicators[0].lower() == "background":
            roles.program = DEEPETHOGRAM
    elif run := _labelled_run(frame, free):
        roles.at["behaviour"], roles.layout = run, "rows of sequences"
    elif (one := _only_label(frame, free)) and len(roles.at) > 0:
        roles.at["behaviour"] = [one]
    else:
        uses = "; ".join(f"{use} is {', '.join(names)}" for use, names in roles.at.items())
        every = ", ".join(list(frame.columns)[:30])
        raise ReadingError(
            [
                f"{sheet.name}: no column is known to hold behaviours; say which does (--columns.behaviour NAME),"
                f" of {every}" + (f" ({uses})" if uses else "")
            ]
        )
    roles.found.add("behaviour")


def _is_indicator(column: "pd.Series[Any]") -> bool:
    values = {str(text).lower() for text in pd.unique(column)}
    other = values - INDICATORS - frozenset(MISSING_TIMES)
    if not other:
        return bool({"0", "1", "true", "false", "0.0", "1.0"} & values)
    # A slip of the pen in a column of zeros and ones is an error of its own, and makes no other column of it.
    wrong = column.str.lower().isin(other).sum()
    return {"0", "1"} <= values and wrong <= max(1, 0.01 * len(column)) and len(other) <= 2


def _is_measured(column: "pd.Series[Any]") -> bool:
    """Whether a column holds measurements: mostly numbers that are not whole, or hundreds of different ones."""
    numbers = pd.to_numeric(column[column != ""], errors="coerce")
    if not len(numbers) or numbers.isna().mean() > 0.1:
        return False
    different = numbers.nunique()
    if (numbers % 1 != 0).mean() > 0.1:
        return different > MAX_CODES
    return different > max(300, 0.5 * len(numbers)) and len(numbers) > 600


def _indicator_columns(frame: Any, free: list[str]) -> list[str]:
    """Return the columns of zeros and ones that are behaviours; with SimBA's probabilities, those that have one."""
    names = [name for name in free if _is_indicator(frame[name]) and not NO_BEHAVIOURS.match(name)]
    chosen = [name for name in names if f"Probability_{name}" in frame.columns]
    names = chosen or names
    return names if any(frame[name].isin(["1", "1.0", "True", "true"]).any() for name in names) else []


def _are_channels(sheet: Sheet, roles: Roles, names: list[str]) -> bool:
    """Whether columns of zeros and ones are behaviours of frames, and not steps of a sequence a row.

    Frames have a time; or one behaviour each.
    """
    ones = sum(sheet.frame[name].isin(["1", "1.0", "True", "true"]).astype(int) for name in names)
    return "start" in roles.at or float((ones == 1).mean()) > 0.95


def _is_numbered(names: list[str]) -> bool:
    return len(names) >= MIN_WIDE and (all(map(MONTH.fullmatch, names)) or _runs(names) == [names])


def _runs(names: list[str]) -> list[list[str]]:
    """Return runs of columns whose names are one stem and numbers that count, or months."""
    runs: list[list[str]] = []
    last: tuple[str, int] | None = None
    for name in names:
        match = STEM_NUMBER.fullmatch(name)
        key = ("month", -1) if MONTH.fullmatch(name) else (match[1] or "", int(match[2])) if match else None
        follows = key is not None and last is not None and key[0] == last[0]
        if follows and key is not None and last is not None and (key[1] > last[1] or key[1] == -1):
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
    """Whether numbered columns are called behaviours, so that nothing else tells that they are."""
    return plain(run[0]).startswith(("action ", "behavior ", "behaviour "))


def _share_labels(frame: Any, names: list[str]) -> bool:
    """Whether columns hold the same labels: most of those of each column occur in others."""
    sets = [set(pd.unique(frame[name])) - {""} for name in names]
    sets = [one for one in sets if one]
    if len(sets) < 2:
        return False
    whole = [len(one & set().union(*(sets[:i] + sets[i + 1 :]))) / len(one) for i, one in enumerate(sets)]
    return float(np.mean(whole)) > 0.5


def _labelled_run(frame: Any, free: list[str]) -> list[str]:
    """Return the longest run of neighbouring columns that share names (no numbers) as labels."""
    best: list[str] = []
    run: list[str] = []
    for name in free:
        texts = pd.unique(frame[name][frame[name] != ""])
        is_text = len(texts) > 0 and pd.to_numeric(pd.Series(texts, dtype=object), errors="coerce").isna().mean() > 0.5
        run = [*run, name] if is_text and (not run or _share_labels(frame, [run[-1], name])) else [name] * int(is_text)
        best = run if len(run) > len(best) else best
    return best if len(best) >= MIN_WIDE else []


def _only_label(frame: Any, free: list[str]) -> str | None:
    """Return the one column of names that recur, or whose name ends as that of labels does."""
    ends = [
        name for name in free if plain(name).split(" ")[-1] in ("behavior", "behaviour", "label", "state", "syllable")
    ]
    if len(ends) == 1:
        return ends[0]
    texts = []
    for name in free:
        words = frame[name][frame[name] != ""]
        number = pd.to_numeric(words, errors="coerce").notna().mean() if len(words) else 1
        times, _, filled = count_times(words.to_numpy(object))
        if number < 0.5 and times * 2 < max(filled, 1) and 1 < words.nunique() <= max(2, len(words) // 3):
            texts.append(name)
    return texts[0] if len(texts) == 1 else None


def check_is_no_summary(sheet: Sheet, roles: Roles) -> None:
    """Refuse a table of totals and means, which holds no events.

    Raises:
        ReadingError: no time is known, and a column that is not used is called a total, a mean or a number.
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
    if roles.layout in ("rows of sequences", "columns of behaviours"):
        roles.at.pop("event_type", None) if "event_type" in roles.found else None
        return
    if "event_type" in roles.at:
        kinds = event_words(sheet.frame[roles.at["event_type"][0]], words)
        coded = set(sheet.frame[roles.at["event_type"][0]].unique()) == {"0", "1"}
        if "event_type" in roles.found and "start" not in kinds and not coded:
            del roles.at["event_type"]  # an event log whose rows are all of one kind
            roles.layout = "events"
        else:
            roles.layout = "rows of starts and stops"
            if "stop" in roles.found:
                del roles.at["stop"]


def _note_unused(sheet: Sheet, roles: Roles, words: Mapping[str, str]) -> None:
    used = roles.used()
    for name in sheet.frame.columns:
        if name in used or "event_type" in roles.at or roles.layout != "events":
            continue
        kinds = event_words(sheet.frame[name], words)
        if kinds == {"start", "stop"}:
            roles.notes.append(
                f"the column {name!r} seems to say which rows are starts and which stops, and is not used"
                f" (--columns.event_type {name!r}): each row is read as an event"
            )
    unused = [name for name in sheet.frame.columns if name not in used and not name.startswith("(column ")]
    if unused:
        shown = ", ".join(unused[:8]) + (f" and {len(unused) - 8} more" if len(unused) > 8 else "")
        roles.notes.append(f"columns that are not used: {shown}")
