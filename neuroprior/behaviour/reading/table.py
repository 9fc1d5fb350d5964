"""A sheet with the roles of its columns, and the events read from it: what all layouts share."""

import re
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neuroprior.behaviour.reading.columns import Roles
from neuroprior.behaviour.reading.names import NO_SUBJECT, TOTALS, plain
from neuroprior.behaviour.reading.options import Options
from neuroprior.behaviour.reading.problems import Problems
from neuroprior.behaviour.reading.sheets import Sheet
from neuroprior.behaviour.reading.times import NUMBERS, SECONDS, Times, over_midnight, read_times, unit_of_name

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

JOIN = "|"
"""Between the labels of several columns."""

UNIT_CELL = re.compile(r"\(?(s|ms|sec|seconds|min|frames|h|)\)?", re.IGNORECASE)
"""A cell of a row of units below the header."""

MIN_REPEATS = 0.3
"""Share of rows that repeat the label of the row before, above which rows at equal steps are frames."""

MAX_OVERLAP = 0.05
"""Share of bouts at most that may overlap an earlier one of the same behaviour."""


@dataclass
class Part:
    """Events of one sheet.

    Attributes:
        events: a pandas frame with the columns `recording, subject, behaviour, start, stop` ("" for no label),
            `observer` where one is used, factors and contexts, in the order of the recordings and of time.
        fragment: int `[events]`, numbered from 0; between two fragments of one recording nobody watched, or nothing
            was scored.
        rows: int `[events]`, the row of the sheet that each begins with.
        unit: of the times: "s", "frames", "steps" or "" where it is not known.
        notes, first_notes: a line each; the first ones are weighty.
        empty: recordings without events.
        spans: when each recording was watched, where rows say so; see `Recordings.spans`.
        renamed: labels that the user renames and that occur.
    """

    sheet: Sheet
    roles: Roles
    events: Any
    fragment: Integers
    rows: Integers
    unit: str = ""
    notes: list[str] = field(default_factory=list)
    first_notes: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    spans: pd.DataFrame | None = None
    renamed: set[str] = field(default_factory=set)

    def note_repeats(self, what: str, when: str = "") -> None:
        """Notes that many labels repeat the one before, and how repeats become one bout.

        Args:
            what: the table's word for what has a label.
            when: a condition for that, with a comma.
        """
        behaviour = self.events["behaviour"].to_numpy(object)
        repeats = (behaviour[1:] == behaviour[:-1]) & (np.diff(self.fragment) == 0)
        if len(repeats) and (share := repeats.mean()) > MIN_REPEATS:
            advice = f"{when} --merge_repeats true makes each run one bout"
            self.first_notes.append(f"{share:.0%} of the {what} repeat the one before:{advice}")


class Table:
    """A sheet with the roles of its columns, and what its layouts share.

    Args:
        sheet: the sheet.
        roles: what its columns hold.
        options: how it is read.
        problems: receives what is wrong.
    """

    def __init__(self, sheet: Sheet, roles: Roles, options: Options, problems: Problems) -> None:
        self.sheet, self.roles, self.options, self.problems = sheet, roles, options, problems
        self.notes: list[str] = [*sheet.notes, *roles.notes]
        self.first_notes: list[str] = []
        self.empty: list[str] = []
        self.renamed: set[str] = set()
        self.unit = roles.program.unit if roles.program else ""
        self._drop_rows()
        self.frame = sheet.frame
        self.size = len(self.frame)
        self.recording = self._keys("recording", self._name_of_file())
        self.subject = self._subjects()
        self.observer = self._keys("observer", "")

    def place(self, row: int) -> str:
        """Return where a row stands."""
        return self.sheet.place(row)

    def _drop_rows(self) -> None:
        """Leave out a row of units below the header, rows without content, and rows that a program writes twice."""
        sheet, at = self.sheet, self.roles.at
        if not len(sheet.frame):
            return
        keep = np.ones(len(sheet.frame), bool)
        timed = [name for use in ("start", "stop", "duration") for name in at.get(use, [])]
        label = [name for name in at.get("behaviour", []) if self.roles.layout != "rows of sequences"]
        first = sheet.frame.iloc[0]
        units = [first[name] for name in timed]
        if any(units) and all(map(UNIT_CELL.fullmatch, units)):
            keep[0] = False
            self.notes.append(f"line {sheet.lines[0]} holds units, and is not read as a row")
            self.unit = self.unit or units[0].strip("()").lower().removesuffix("ec").removesuffix("econds")
        if label and self.roles.layout == "events":
            unowned = np.zeros(len(keep), bool)
            for name in [name for use in ("recording", "subject") for name in at.get(use, [])]:
                empty = sheet.frame[name].eq("").to_numpy()
                unowned |= empty & (not empty.all())
            loose = sheet.frame[label + timed].eq("").all(axis=1).to_numpy() & unowned & keep
            if loose.any():
                keep &= ~loose
                first_loose = sheet.place(int(loose.argmax()))
                what = "rows without behaviour and time, and without recording or subject, are left out"
                self.notes.append(f"{loose.sum():,} {what} (first in {first_loose})")
        if len(label) == 1 and len(sheet.frame) > 1:
            total = sheet.frame[label[0]].str.lower().isin(TOTALS).to_numpy()
            below = np.logical_and.accumulate(total[::-1])[::-1]  # from the first of those at the end on
            if below.any() and not total[~below].any():
                keep &= ~below
                row = int(below.argmax())
                self.notes.append(f"{below.sum():,} rows of totals at the end are left out ({sheet.place(row)})")
        view = next((name for name in sheet.frame if plain(name) == "view"), None)
        if self.roles.program and self.roles.program.name.startswith("Raven") and view:
            twice = sheet.frame.drop(columns=view).duplicated().to_numpy()
            if twice.any():
                keep &= ~twice
                self.notes.append(f"{twice.sum():,} rows are other views of the same selections, and left out")
        if not keep.all():
            sheet.frame = sheet.frame[keep].reset_index(drop=True)
            sheet.lines = sheet.lines[keep]

    def joined(self, names: list[str]) -> NDArray[Any]:
        """Return the texts of columns, joined by "|" where there are several; empty ones are left out."""
        texts = [self.frame[name].to_numpy(object) for name in names]
        if len(texts) == 1:
            return np.asarray(texts[0], dtype=object)
        codes = _number_rows(texts)
        _, first = np.unique(codes, return_index=True)
        labels = [JOIN.join(str(one[i]) for one in texts if one[i]) for i in first]
        return np.array(labels, dtype=object)[codes]

    def _name_of_file(self) -> str:
        name = self._text_above("observation id", "trial name", "observation", "video")
        return re.sub(r"\s+", " ", name) or self.sheet.stem

    def _text_above(self, *keys: str) -> str:
        """Return what stands above the header by the first of some names; "" for none."""
        above = {plain(name): value for name, value in self.sheet.above.items()}
        return next((above[key] for key in keys if above.get(key)), "")

    def _keys(self, use: str, default: str) -> NDArray[Any]:
        names = self.roles.at.get(use)
        if not names:
            return np.full(self.size, default, dtype=object)
        keys = _whole_numbers(self.joined(names))
        empty = keys == ""
        if use == "recording" and empty.any() and not empty.all():
            where = self.place(int(empty.argmax()))
            self.notes.append(f"{empty.sum():,} rows have no recording (first in {where}), and are called {default!r}")
        return np.where(empty, default, keys)

    def _subjects(self) -> NDArray[Any]:
        names = self.roles.at.get("subject")
        if not names:
            return np.full(self.size, self._text_above("subject name", "animal id", "subject"), dtype=object)
        keys = _whole_numbers(self.joined(names))
        nobody = pd.Series(keys, dtype=object).str.lower().isin(NO_SUBJECT).to_numpy()
        if nobody.any():
            self.notes.append(f"{nobody.sum():,} rows are of {keys[nobody.argmax()]!r}, taken as a subject")
        return keys

    def labels(self, texts: NDArray[Any]) -> NDArray[Any]:
        """Return labels as the options say: renamed, "" where one is missing."""
        codes, values = pd.factorize(texts)
        each = max(len(texts) // max(self.size, 1), 1)  # cells of a row, where a row is a sequence
        labels = [self.options.label(str(value)) for value in values]
        self.renamed |= {str(value) for value in values} & self.options.rename.keys()
        numbers = [label for label in labels if label]
        if "-1" in numbers and all(number.isdecimal() for number in numbers if number != "-1"):
            rows = np.flatnonzero(np.array(labels, dtype=object)[codes] == "-1")
            self.first_notes.append(
                f"the label -1 ({rows.size:,} rows, first in {self.place(int(rows[0]) // each)})"
                " stands for none, as clusterings write it; --rename -1=noise makes it a behaviour"
            )
            labels = ["" if label == "-1" else label for label in labels]
        renamed = np.array([*labels, ""], dtype=object)[codes]
        if self.options.missing == "error" and (renamed == "").any():
            rows = np.flatnonzero(renamed == "")
            what = f"`behaviour` must be known, got {str(texts[rows[0]])!r}"
            self.problems.add(what, (rows // each).tolist(), self.place)
        return renamed

    def times(self, use: str) -> Times | None:
        """Return the times of a use (start, stop or duration); None where no column holds them."""
        names = self.roles.at.get(use)
        if not names:
            return None
        texts = self.frame[names[0]].to_numpy(object)
        for name in names[1:]:
            days = pd.Series(texts, dtype=object).str.replace(r"[ T]00:00(:00)?$", "", regex=True).to_numpy(object)
            texts = days + " " + self.frame[name].to_numpy(object)
        times = read_times(
            texts, use, self.place, self.problems, separator=self.sheet.separator, day_first=self.options.day_first
        )
        if use == "start":
            self.unit = (unit_of_name(names[0]) or self.unit) if times.kind == NUMBERS else "s"
        elif times.kind == NUMBERS:
            return self._convert_to_unit_of_starts(use, names[0], times)
        return times

    def _convert_to_unit_of_starts(self, use: str, name: str, times: Times) -> Times | None:
        """Return times in the unit of the starts, where the names of both columns say theirs.

        Frames beside seconds cannot be compared: a column that no user named is left out, a named one is an error.
        """
        start = self.roles.at.get("start", [""])[-1]
        unit, start_unit = unit_of_name(name), unit_of_name(start)
        if not start:
            self.unit = self.unit or unit
        if not unit or not start_unit or unit == start_unit:
            return times
        if unit in SECONDS and start_unit in SECONDS:
            self.notes.append(f"the column {name!r} is read in {start_unit}, as {start!r} is")
            return times._replace(values=times.values * (SECONDS[unit] / SECONDS[start_unit]))
        if use in self.roles.inferred:
            what = f"the column {name!r} is in {unit} where {start!r} is in {start_unit}"
            self.notes.append(f"{what}, and is not used as {use}")
            del self.roles.at[use]
            return None
        what = f"`{use}` must be in {start_unit}, as {start!r} is, got {name!r} in {unit}"
        self.problems.add(what, [0], self.place)
        return None

    def unit_codes(self) -> Integers:
        """Return the number of the recording and subject (and observer) of each row."""
        return _number_rows([self.recording, self.subject, self.observer])

    def over_midnight(self, times_of_day: Floats) -> Floats:
        """Return times of day, float64 `[rows]`, counted on over midnight in each recording, and note it."""
        counted, midnights = over_midnight(times_of_day, self.unit_codes())
        if midnights:
            self.note_midnight()
        return counted

    def note_midnight(self) -> None:
        """Note, once, that times of day go on over midnight."""
        what = "times of day go on over midnight; they are counted on from the first day"
        if what not in self.first_notes:
            self.first_notes.append(what)

    def is_row_a_subject(self) -> bool:
        """Return whether a column holds subjects, and no two rows share one."""
        return "subject" in self.roles.at and pd.Series(self.subject).is_unique

    def name_rows(self) -> None:
        """Make each row a recording, named by its subject where no two rows share one, else by its number."""
        if self.is_row_a_subject():
            self.recording = self.subject
        else:
            self.recording = np.arange(1, self.size + 1).astype(str).astype(object)

    def split_sessions(self, start: Floats, labels: NDArray[Any], stop: Floats | None = None) -> None:
        """Make each session a recording of its own, where the time starts again within a recording.

        Rows merely in another order than time, such as sorted by behaviour, stay in their recording.
        """
        unit = self.unit_codes()
        order = np.argsort(unit, kind="stable")
        when, same = start[order], np.diff(unit[order], prepend=-1) == 0
        latest = pd.Series(when).groupby(unit[order]).ffill().to_numpy(np.float64)
        back = np.zeros(len(order), bool)
        back[1:] = same[1:] & (latest[1:] < latest[:-1])
        if not back.any():
            return
        block = np.empty(len(order), np.int64)
        block[order] = np.cumsum(back | ~same)
        frame = pd.DataFrame({"unit": unit, "block": block, "start": start, "label": labels})
        blocks = frame.groupby("block").agg(
            unit=("unit", "first"),
            low=("start", "min"),
            high=("start", "max"),
            size=("start", "size"),
            kinds=("label", "nunique"),
        )
        blocks["before"] = blocks.groupby("unit")["high"].shift()
        blocks["lowest"] = blocks.groupby("unit")["low"].transform("min")
        again = blocks.dropna(subset="before")
        span = (again["before"] - again["lowest"]).clip(lower=0)
        restarts = (again["low"] - again["lowest"] <= 0.5 * span) & (again["kinds"] > 1) & (again["size"] >= 3)
        if not len(again) or restarts.mean() < 0.9:
            row = int(np.flatnonzero(block == again.index[0])[0])
            self.notes.append(f"rows are not in the order of time (first in {self.place(row)}), and are sorted by it")
            return
        if stop is not None and len(overlapping(unit, start, stop)) <= MAX_OVERLAP * len(start):
            return
        chosen = set(again.index[restarts])
        rows = np.array([int(np.flatnonzero(block == one)[0]) for one in sorted(chosen)])
        if "recording" in self.roles.at:
            what = "the time starts again within a recording; name the column of its sessions (--columns.recording)"
            self.problems.add(what, rows.tolist(), self.place)
            return
        number = blocks.index.isin(chosen)
        session = pd.Series(number, index=blocks.index).groupby(blocks["unit"]).cumsum().add(1)
        numbers = session.reindex(block).to_numpy(np.int64)
        self.recording = np.array(
            [f"{name} ({n})" for name, n in zip(self.recording, numbers, strict=True)], dtype=object
        )
        self.first_notes.append(
            f"the time starts again {len(rows):,} times, first in {self.place(int(rows[0]))}: what follows is"
            " read as another recording"
        )

    @property
    def after_missing(self) -> str:
        """What notes say of rows without a label."""
        return "nothing was done in them" if self.options.missing == "nothing" else "another sequence begins after each"

    def part(
        self, rows: Integers, labels: NDArray[Any], start: Floats, stop: Floats, stretch: Integers | None = None
    ) -> Part:
        """Return the events of rows, in the order of their recordings and of time.

        Args:
            rows: int `[events]`.
            labels: str `[events]`, "" where none is known: what follows is another fragment, unless nothing was done.
            start, stop: float64 `[events]`, NaN where not known.
            stretch: int `[events]`, the stretch of its recording, between two gaps, that each is in; None: one.
        """
        events = pd.DataFrame({
            "recording": self.recording[rows], "subject": self.subject[rows], "behaviour": labels,
            "start": start, "stop": stop,
        })  # fmt: skip
        if "observer" in self.roles.at:
            events["observer"] = self.observer[rows]
        for name in [*self.roles.at.get("factors", []), *self.roles.at.get("context", [])]:
            events[name] = self.frame[name].to_numpy(object)[rows]
        # Recordings stay in the order in which they appear.
        unit = self.unit_codes()[rows]
        untimed = np.isnan(start)
        clock = np.where(untimed, -np.inf, start) if not untimed.all() else np.zeros(len(start))
        if untimed.any() and not untimed.all():
            clock = pd.Series(start).groupby(unit).ffill().fillna(-np.inf).to_numpy()
        order = np.lexsort((np.arange(len(events)), clock, unit))
        events, rows = events.iloc[order].reset_index(drop=True), rows[order]
        begin = np.diff(unit[order], prepend=-1) != 0
        if stretch is not None:
            begin |= np.diff(stretch[order], prepend=-1) != 0
        missing = events["behaviour"].eq("").to_numpy()
        if self.options.missing != "nothing":
            begin[1:] |= missing[:-1]
            begin |= missing
        fragment = np.cumsum(begin) - 1
        events, fragment, rows = events[~missing].reset_index(drop=True), fragment[~missing], rows[~missing]
        fragment = np.unique(fragment, return_inverse=True)[1].astype(np.int64)
        reading = Part(self.sheet, self.roles, events, fragment, rows, self.unit, self.notes, self.first_notes)
        return replace(reading, empty=self.empty, renamed=self.renamed)


def _number_rows(columns: list[NDArray[Any]]) -> Integers:
    """Return a number for each row, int64 `[rows]`, equal where all columns are, in the order of appearance."""
    numbers = np.zeros(len(columns[0]), np.int64)
    for codes, values in map(pd.factorize, columns):
        numbers = pd.factorize(numbers * (len(values) + 1) + codes)[0].astype(np.int64)
    return numbers


def _whole_numbers(keys: NDArray[Any]) -> NDArray[Any]:
    """Return keys without the ".0" that pandas adds to whole numbers beside empty cells."""
    codes, values = pd.factorize(keys)
    if len(values) and all(re.fullmatch(r"-?\d+\.0|", str(value)) for value in values):
        return np.array([str(value).removesuffix(".0") for value in values], dtype=object)[codes]
    return keys


def overlapping(unit: Integers, start: Floats, stop: Floats) -> Integers:
    """Return the bouts that begin before an earlier one of the same unit ended, in the order of units and starts."""
    order = np.lexsort((start, unit))
    latest = pd.Series(stop[order]).groupby(unit[order]).cummax().to_numpy()
    same = np.diff(unit[order], prepend=-1) == 0
    before = np.append(np.nan, latest[:-1])
    rounding = np.abs(before) * 1e-9 + 1e-9
    late: Integers = order[same & (start[order] < before - rounding)]
    return late
