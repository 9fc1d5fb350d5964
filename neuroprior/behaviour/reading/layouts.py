"""The layouts of tables, each read as events: rows of events, of starts and stops, of frames, and of sequences."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neuroprior.behaviour.reading.columns import Roles
from neuroprior.behaviour.reading.names import NO_SUBJECT, WORDS, plain
from neuroprior.behaviour.reading.options import Options
from neuroprior.behaviour.reading.problems import Problems
from neuroprior.behaviour.reading.sheets import Sheet
from neuroprior.behaviour.reading.times import CLOCKS, DATES, Times, over_midnight, read_times, smallest_unit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

JOIN = "|"
"""Between the labels of several columns."""

TOGETHER = "+"
"""Between behaviours that are done at once."""

UNSCORED = "\1"
"""In place of the label of a frame that nobody scored; numpy would drop a zero."""

MIN_REPEATS = 0.3
"""Share of rows with the label of the row before, at least which rows at equal steps are frames."""

MAX_OVERLAP = 0.05
"""Share of bouts that overlap a bout of the same behaviour, above which something is wrong."""

SPS = re.compile(r"\(?([^(),]+),\s*(\d+(?:\.\d+)?)\)?")
SPLITS = ("-", "|", ";", ",", " ", "/")


@dataclass
class Part:
    """Events of one sheet.

    Attributes:
        events: a frame with the columns `recording, subject, behaviour, start, stop` ("" for no label), `observer` where
            one is used, factors and contexts, in the order of the recordings and of time.
        fragment: int `[events]`, numbered from 0; between two fragments of one recording nobody watched, or nothing
            was scored.
        rows: int `[events]`, the row of the sheet that each begins with.
        unit: of the times: "s", "frames", "steps" or "" where it is not known.
        notes, first_notes: a line each; the first ones are weighty.
        empty: recordings without events.
        spans: when each recording was watched, where rows say so; see `Recordings.spans`.
    """

    sheet: Sheet
    roles: Roles
    events: pd.DataFrame
    fragment: Integers
    rows: Integers
    unit: str = ""
    notes: list[str] = field(default_factory=list)
    first_notes: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    spans: pd.DataFrame | None = None


class Table:
    """A sheet whose columns are known, and what its layouts share.

    Args:
        sheet: the sheet.
        roles: what its columns hold.
        options: how it is read.
        problems: gets what is wrong.
    """

    def __init__(self, sheet: Sheet, roles: Roles, options: Options, problems: Problems) -> None:
        self.sheet, self.roles, self.options, self.problems = sheet, roles, options, problems
        self.notes: list[str] = [*sheet.notes, *roles.notes]
        self.first_notes: list[str] = []
        self.empty: list[str] = []
        self.unit = roles.program.unit if roles.program else ""
        self._drop_rows()
        self.frame = sheet.frame
        self.size = len(self.frame)
        self.recording = self._keys("recording", self._name_of_file())
        self.subject = self._subjects()
        self.observer = self._keys("observer", "")
        self.has_time = bool(self.roles.at.get("start"))

    def place(self, row: int) -> str:
        """Return where a row stands."""
        return self.sheet.place(row)

    def _drop_rows(self) -> None:
        """Leave out a row of units below the header, totals, and rows that a program writes twice."""
        sheet, at = self.sheet, self.roles.at
        if not len(sheet.frame):
            return
        keep = np.ones(len(sheet.frame), bool)
        timed = [name for use in ("start", "stop", "duration") for name in at.get(use, [])]
        label = [name for name in at.get("behaviour", []) if self.roles.layout != "rows of sequences"]
        first = sheet.frame.iloc[0]
        units = [first[name] for name in timed]
        if units and all(
            re.fullmatch(r"\(?(s|ms|sec|seconds?|min|frames?|h|)\)?", text, re.IGNORECASE) for text in units
        ):
            if any(units):
                keep[0] = False
                self.notes.append(f"line {sheet.lines[0]} holds units, and is not read as a row")
                self.unit = self.unit or ("s" if "s" in units[0].lower() and "m" not in units[0].lower() else units[0])
        if label and self.roles.layout == "events":
            nothing = sheet.frame[label + timed].eq("").all(axis=1).to_numpy()
            whose = [name for use in ("recording", "subject") for name in at.get(use, [])]
            unowned = np.zeros(len(keep), bool)
            for name in whose:
                empty = sheet.frame[name].eq("").to_numpy()
                unowned |= empty & (not empty.all())
            loose = nothing & (unowned if whose else np.zeros(len(keep), bool)) & keep
            if loose.any():
                keep &= ~loose
                row = int(loose.argmax())
                self.notes.append(
                    f"{loose.sum():,} rows without behaviour, time and owner are left out ({sheet.place(row)})"
                )
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
            return texts[0]
        codes = [pd.factorize(one) for one in texts]
        key = np.zeros(self.size, np.int64)
        for numbers, values in codes:
            key = key * (len(values) + 1) + numbers
        kinds, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        labels = [JOIN.join(str(one[i]) for one in texts if one[i]) for i in first]
        return np.array([*labels, ""], dtype=object)[inverse] if len(kinds) else np.array([], dtype=object)

    def _name_of_file(self) -> str:
        above = {plain(name): value for name, value in self.sheet.above.items()}
        named = next(
            (above[key] for key in ("observation id", "trial name", "observation", "video") if above.get(key)), ""
        )
        return re.sub(r"\s+", " ", named) or self.sheet.stem

    def _keys(self, use: str, default: str) -> NDArray[Any]:
        names = self.roles.at.get(use)
        if not names:
            return np.full(self.size, default, dtype=object)
        keys = _whole_numbers(self.joined(names))
        empty = keys == ""
        if use == "recording" and empty.any() and not empty.all():
            rows = np.flatnonzero(empty)
            self.notes.append(
                f"{rows.size:,} rows have no recording ({self.place(int(rows[0]))}); they are called {default!r}"
            )
        return np.where(empty, default, keys)

    def _subjects(self) -> NDArray[Any]:
        names = self.roles.at.get("subject")
        if not names:
            above = {plain(name): value for name, value in self.sheet.above.items()}
            owner = next((above[key] for key in ("subject name", "animal id", "subject") if above.get(key)), "")
            return np.full(self.size, owner, dtype=object) if owner else np.full(self.size, "", dtype=object)
        keys = _whole_numbers(self.joined(names))
        codes, values = pd.factorize(keys)
        nobody = np.array([str(one).lower() in NO_SUBJECT for one in values] or [False])
        if nobody.any():
            self.notes.append(
                f"{int(nobody[codes].sum()):,} rows are of {values[nobody.argmax()]!r}, taken as a subject"
            )
        return keys

    def labels(self, texts: NDArray[Any]) -> NDArray[Any]:
        """Return labels as the user wants them: "" where one is missing, renamed, and without those to drop."""
        codes, values = pd.factorize(texts)
        labels = [self.options.label(str(value)) for value in values]
        numbers = [label for label in labels if label]
        if "-1" in numbers and all(number.isdecimal() for number in numbers if number != "-1"):
            rows = np.flatnonzero(np.array(labels, dtype=object)[codes] == "-1")
            self.first_notes.append(
                f"the label -1 ({rows.size:,} rows, first in {self.place(int(rows[0]) % max(self.size, 1))}) stands for none, as"
                " clusterings write it; --rename -1=noise makes it a behaviour"
            )
            labels = ["" if label == "-1" else label for label in labels]
        found = np.array([*labels, ""], dtype=object)[codes]
        if self.options.missing == "error" and (found == "").any():
            rows = np.flatnonzero(found == "")
            what = f"`behaviour` must be known, got {str(texts[rows[0]])!r}"
            self.problems.add(what, (rows % max(self.size, 1)).tolist(), self.place)
        return found

    def times(self, use: str) -> Times | None:
        """Return the times of a use, or None; day by day on from midnight where they are times of day."""
        names = self.roles.at.get(use)
        if not names:
            return None
        texts = self.frame[names[0]].to_numpy(object)
        for name in names[1:]:
            texts = texts + " " + self.frame[name].to_numpy(object)
        found = read_times(
            texts, use, self.place, self.problems, separator=self.sheet.separator, day_first=self.options.day_first
        )
        if use == "start":
            if found.kind == CLOCKS or found.kind == DATES:
                self.unit = "s"
            else:
                self.unit = self.unit or _unit_of(names[0], self.sheet.above)
        return found

    def unit_codes(self) -> Integers:
        """Return the number of the recording and subject (and observer) of each row."""
        key = pd.Series(list(zip(self.recording, self.subject, self.observer, strict=True)), dtype=object)
        return pd.factorize(key)[0].astype(np.int64)

    def split_sessions(self, start: Floats, labels: NDArray[Any], stop: Floats | None = None) -> None:
        """Give sessions without a name one each, where the time starts again within a recording.

        Rows that are merely in another order than time, such as sorted by behaviour, are left as they are.
        """
        unit = self.unit_codes()
        order = np.argsort(unit, kind="stable")
        when, same = start[order], np.diff(unit[order], prepend=-1) == 0
        known = pd.Series(when).groupby(unit[order]).ffill().to_numpy(np.float64)
        back = np.zeros(len(order), bool)
        back[1:] = same[1:] & (known[1:] < known[:-1])
        if not back.any():
            return
        block_sorted = np.cumsum(back | ~same)
        block = np.empty(len(order), np.int64)
        block[order] = block_sorted
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
            return
        if stop is not None and not _overlaps(unit, start, stop) > MAX_OVERLAP:
            return
        chosen = set(again.index[restarts])
        rows = np.array([int(np.flatnonzero(block == one)[0]) for one in sorted(chosen)])
        if "recording" in self.roles.at:
            what = "the time starts again within a recording; say which column tells its sessions apart (--columns.recording)"
            self.problems.add(what, rows.tolist(), self.place)
            return
        number = blocks.index.isin(chosen)
        session = pd.Series(number, index=blocks.index).groupby(blocks["unit"]).cumsum().add(1)
        numbers = session.reindex(block).to_numpy(np.int64)
        self.recording = np.array(
            [f"{name} ({n})" for name, n in zip(self.recording, numbers, strict=True)], dtype=object
        )
        self.first_notes.append(
            f"the time starts again {len(rows):,} times, first in {self.place(int(rows[0]))}: what follows is read as another"
            " recording"
        )

    def part(
        self, rows: Integers, labels: NDArray[Any], start: Floats, stop: Floats, cut: NDArray[np.bool_] | None = None
    ) -> Part:
        """Return the events of rows, in the order of their recordings and of time.

        Args:
            rows: int `[events]`.
            labels: `[events]`, "" where none is known: what follows is another fragment.
            start, stop: float64 `[events]`.
            cut: bool `[events]`, True where a fragment begins; None: after events without a label.
        """
        events = pd.DataFrame({
            "recording": self.recording[rows], "subject": self.subject[rows], "behaviour": labels,
            "start": start, "stop": stop,
        })  # fmt: skip
        if "observer" in self.roles.at:
            events["observer"] = self.observer[rows]
        for name in [*self.roles.at.get("factors", []), *self.roles.at.get("context", [])]:
            events[name] = self.frame[name].to_numpy(object)[rows]
        keys = ["recording", "subject", "observer"] if "observer" in events else ["recording", "subject"]
        # Recordings stay in the order in which they appear.
        appear = [pd.factorize(events[key])[0] for key in keys]
        untimed = np.isnan(start)
        clock = np.where(untimed, -np.inf, start) if not untimed.all() else np.zeros(len(start))
        if untimed.any() and not untimed.all():
            clock = pd.Series(start).groupby(list(appear)).ffill().fillna(-np.inf).to_numpy()
        order = np.lexsort((np.arange(len(events)), clock, *reversed(appear)))
        events, rows = events.iloc[order].reset_index(drop=True), rows[order]
        begin = np.zeros(len(events), bool)
        for codes in appear:
            begin |= np.diff(codes[order], prepend=-1) != 0
        if cut is not None:
            begin |= cut[order]
        missing = events["behaviour"].eq("").to_numpy()
        begin[1:] |= missing[:-1]
        fragment = np.cumsum(begin | missing) - 1
        events, fragment, rows = events[~missing].reset_index(drop=True), fragment[~missing], rows[~missing]
        fragment = np.unique(fragment, return_inverse=True)[1].astype(np.int64)
        return Part(self.sheet, self.roles, events, fragment, rows, self.unit, self.notes, self.first_notes, self.empty)


def _whole_numbers(keys: NDArray[Any]) -> NDArray[Any]:
    """Return keys without the ".0" that pandas adds to whole numbers beside empty cells."""
    codes, values = pd.factorize(keys)
    if len(values) and all(re.fullmatch(r"-?\d+\.0|", str(value)) for value in values):
        return np.array([str(value).removesuffix(".0") for value in values], dtype=object)[codes]
    return keys


def _unit_of(name: str, above: Mapping[str, str]) -> str:
    low = name.lower()
    if "frame" in low or "image" in low:
        return "frames"
    if re.search(r"\b(ms|msec|milliseconds?)\b", low.replace("_", " ")):
        return "ms"
    return "s" if re.search(r"\b(s|sec|secs|seconds?|sf)\b", low.replace("_", " ")) else ""


def _overlaps(unit: Integers, start: Floats, stop: Floats) -> float:
    """Return the share of bouts that begin before an earlier one of the same unit ended."""
    order = np.lexsort((start, unit))
    latest = pd.Series(stop[order]).groupby(unit[order]).cummax().to_numpy()
    same = np.diff(unit[order], prepend=-1) == 0
    before = np.append(np.nan, latest[:-1])
    size = np.abs(np.where(np.isfinite(before), before, 0)) * 1e-9 + 1e-9
    return float((same & (start[order] < before - size)).mean()) if len(order) else 0.0


def rows_of_events(table: Table) -> Part:
    """Read one row an event: with start and stop, a duration, a start alone, or no time."""
    labels = table.labels(table.joined(table.roles.at["behaviour"]))
    if split := _strings_of_sequences(table):
        return split
    start_times, stop_times, duration_times = table.times("start"), table.times("stop"), table.times("duration")
    nothing = np.full(table.size, np.nan)
    start = nothing if start_times is None else start_times.values
    stop = nothing if stop_times is None else stop_times.values
    if start_times and stop_times and start_times.kind != stop_times.kind and np.isfinite(stop).any():
        table.problems.add(f"`stop` must be {start_times.kind}, as `start` is, got {stop_times.kind}", [0], table.place)
    if start_times and start_times.kind == CLOCKS:
        start, stop = _past_midnight(table, start, stop)
    start, stop = _with_durations(table, start, stop, duration_times)
    wrong = np.flatnonzero(stop < start - 1e-9)
    if wrong.size:
        what = f"the stop {stop[wrong[0]]:g} is before the start {start[wrong[0]]:g}"
        table.problems.add(f"`stop` must not be before `start`; {what}", wrong.tolist(), table.place)
    untimed = np.flatnonzero(np.isnan(start) & (labels != "")) if start_times is not None else np.array([], int)
    if untimed.size and untimed.size < table.size:
        table.problems.add("`start` must be known, got an empty cell", untimed.tolist(), table.place)
    if start_times is not None:
        table.split_sessions(start, labels, stop if np.isfinite(stop).any() else None)
        if np.isnan(stop).all() and _are_frames(table, start, labels):
            return _part_of_frames(table, start, labels)
    elif np.isnan(stop).all() and table.roles.program and table.roles.program.layout == "rows of frames":
        return _part_of_frames(table, _positions(table), labels)
    twice = _repeated_rows(table, start, stop)
    if twice.any():
        table.first_notes.append(
            f"{twice.sum():,} rows are there twice, and read once ({table.place(int(twice.argmax()))})"
        )
    rows = np.flatnonzero(~twice)
    start, stop = _exclusive(table, start, stop)
    part = table.part(rows, labels[rows], start[rows], stop[rows])
    part.notes += _notes_on_labels(table, labels, part, start_times is not None and bool(np.isnan(stop).all()))
    return part


def _repeated_rows(table: Table, start: Floats, stop: Floats) -> NDArray[np.bool_]:
    """Return which rows are, cell by cell, an earlier one, where they say when."""
    if np.isnan(start).all() or np.isnan(stop).all() or not (stop > start).any():
        return np.zeros(table.size, bool)
    return table.frame.assign(**{"\1": table.recording}).duplicated().to_numpy() & (stop > start)


def _past_midnight(table: Table, start: Floats, stop: Floats) -> tuple[Floats, Floats]:
    start, midnights = over_midnight(start, table.unit_codes())
    days = np.floor(start / 86400) * 86400
    stop = stop + np.where(np.isnan(days), 0, days)
    late = stop < start - 12 * 3600
    stop = np.where(late, stop + 86400, stop)
    if midnights or late.any():
        table.first_notes.append("times of day go on over midnight; they are counted on from the first day")
    return start, stop


def _with_durations(table: Table, start: Floats, stop: Floats, duration: Times | None) -> tuple[Floats, Floats]:
    """Return starts and stops, filled by durations; what a user named beats what was found."""
    if duration is None:
        return start, stop
    seconds = duration.values
    negative = np.flatnonzero(seconds < 0)
    if negative.size:
        table.problems.add(
            f"`duration` must be at least 0, got {seconds[negative[0]]:g}", negative.tolist(), table.place
        )
    named, stops = "duration" not in table.roles.found, "stop" not in table.roles.found
    both = np.isfinite(seconds) & np.isfinite(stop) & np.isfinite(start)
    apart = both & (np.abs(stop - start - seconds) > 0.01 * (seconds + np.nanmedian(np.append(seconds, 1)) + 1e-9))
    counts = (named and not (stops and "stop" in table.roles.at)) or (named and stops)
    if apart.any():
        which = "durations" if counts else "stops"
        table.first_notes.append(
            f"{apart.sum():,} durations are not the time from start to stop (first in {table.place(int(apart.argmax()))});"
            f" the {which} count"
        )
    use = np.isfinite(seconds) & (~np.isfinite(stop) | counts)
    if "start" not in table.roles.at:
        # Without starts the events of a recording follow one another.
        unit = pd.Series(np.where(np.isfinite(seconds), seconds, 0)).groupby(table.unit_codes())
        ends = unit.cumsum().to_numpy()
        known = pd.Series(np.isfinite(seconds)).groupby(table.unit_codes()).transform("all").to_numpy()
        return np.where(known, ends - seconds, np.nan), np.where(known, ends, np.nan)
    return start, np.where(use, start + seconds, stop)


def _exclusive(table: Table, start: Floats, stop: Floats) -> tuple[Floats, Floats]:
    """Return stops as the time when nothing more belongs to a bout.

    Where every stop is one unit before the next start, it is the last unit of its bout.
    """
    ends = table.options.ends
    if ends == "exclusive" or np.isnan(stop).all():
        return start, stop
    unit = table.unit_codes()
    order = np.lexsort((start, unit))
    same = np.diff(unit[order])[: len(order) - 1] == 0
    gaps = (start[order][1:] - stop[order][:-1])[same]
    gaps = gaps[np.isfinite(gaps)]
    alike = len(gaps) >= 3 and gaps[0] > 0 and np.all(np.abs(gaps - gaps[0]) < 1e-6 * max(gaps[0], 1))
    if ends != "inclusive" and not (alike and "duration" not in table.roles.at):
        return start, stop
    texts = np.concatenate(
        [table.frame[name].to_numpy(object) for use in ("start", "stop") for name in table.roles.at.get(use, [])]
    )
    step = smallest_unit(texts)
    if ends == "inclusive":
        return start, stop + step
    if abs(gaps[0] - step) < 1e-6 * max(step, 1):
        table.first_notes.append(
            f"every stop is {step:g} before the next start: stops are read as the last unit of a bout, and {step:g} added"
            " (--ends exclusive reads them as they are)"
        )
        return start, stop + step
    return start, stop


def _notes_on_labels(table: Table, labels: NDArray[Any], part: Part, only_starts: bool) -> list[str]:
    notes = []
    missing = int((labels == "").sum())
    if missing:
        row = int((labels == "").argmax())
        what = "nothing is known there, and another fragment begins after each"
        notes.append(f"{missing:,} of {len(labels):,} rows have no label (first in {table.place(row)}): {what}")
    behaviour = part.events["behaviour"].to_numpy(object)
    if len(behaviour) > 1:
        again = (behaviour[1:] == behaviour[:-1]) & (np.diff(part.fragment) == 0)
        if (share := again.mean()) > MIN_REPEATS:
            table.first_notes.append(
                f"{share:.0%} of the behaviours repeat the one before: if a row is a frame, --merge_repeats true makes each"
                " run one bout"
            )
    if only_starts:
        notes.append(
            "only starts are known: how long behaviours last is not (--ends next: each until the next one begins)"
        )
    return notes


def rows_of_starts_and_stops(table: Table) -> Part:
    """Read starts and stops that are rows of their own, and points; see `WORDS`."""
    if "start" not in table.roles.at:
        table.problems.add(
            "`columns.start` must name the time of each row where starts and stops are rows", [0], table.place
        )
        table.problems.stop()
    times = table.times("start")
    assert times is not None
    when = times.values
    if times.kind == CLOCKS:
        when, midnights = over_midnight(when, table.unit_codes())
        if midnights:
            table.first_notes.append("times of day go on over midnight; they are counted on from the first day")
    texts = table.joined(table.roles.at["behaviour"])
    kinds = _kinds_of_rows(table)
    untimed = np.flatnonzero(np.isnan(when))
    if untimed.size:
        table.problems.add("`start` must be known, got an empty cell", untimed.tolist(), table.place)
        table.problems.stop()
    modifiers = [name for name in table.frame if plain(name).startswith("modifier") and name not in table.roles.used()]
    pairs = _pair(table.unit_codes(), texts, when, kinds)
    if (
        pairs.unpaired.size
        or _overlaps(table.unit_codes()[kinds == 0], when[kinds == 0], pairs.stop[kinds == 0]) > MAX_OVERLAP
    ):
        table.split_sessions(when, texts)
        pairs = _pair(table.unit_codes(), texts, when, kinds)
    if modifiers and pairs.unpaired.size:
        key = table.joined([*table.roles.at["behaviour"], *modifiers])
        with_modifiers = _pair(table.unit_codes(), key, when, kinds)
        if with_modifiers.unpaired.size < pairs.unpaired.size:
            pairs = with_modifiers
            table.notes.append(f"starts and stops are paired by {', '.join(modifiers)} as well")
    durations = table.times("duration")
    stop = pairs.stop
    if durations is not None:
        fill = np.isnan(stop) & np.isfinite(durations.values) & (durations.values > 0) & (kinds == 0)
        stop = np.where(fill, when + durations.values, stop)
        pairs = pairs._replace(unpaired=pairs.unpaired[~fill[pairs.unpaired]])
    if pairs.unpaired.size and table.options.unpaired == "error":
        row = int(pairs.unpaired[0])
        what = "a stop without a start" if kinds[row] == 1 else "a start without a stop"
        way = "--unpaired drop leaves such rows out, --unpaired open keeps starts whose stop is not known"
        table.problems.add(f"{texts[row]!r} has {what}; {way}", pairs.unpaired.tolist(), table.place)
    elif pairs.unpaired.size:
        done = (
            "left out"
            if table.options.unpaired == "drop"
            else "starts without a stop kept, stops without a start left out"
        )
        table.first_notes.append(f"{pairs.unpaired.size:,} rows are starts or stops without the other: {done}")
    keep = kinds != 1
    if table.options.unpaired == "drop":
        keep[pairs.unpaired] = False
    keep &= kinds >= 0
    rows = np.flatnonzero(keep)
    labels = table.labels(texts)
    part = table.part(rows, labels[rows], when[rows], stop[rows])
    return part


def _kinds_of_rows(table: Table) -> Integers:
    """Return 0 for starts, 1 for stops, 2 for points, -1 for rows that are none."""
    column = table.frame[table.roles.at["event_type"][0]]
    numbers = {"start": 0, "stop": 1, "point": 2}
    known = {word: numbers[kind] for kind, words in WORDS.items() for word in words}
    known |= {word.lower(): numbers[kind] for word, kind in table.options.words.items()}
    codes, values = pd.factorize(column)
    words = [str(value).lower() for value in values]
    if set(words) <= {"0", "1"} and not set(words) & set(table.options.words):
        known |= {"1": 0, "0": 1}
    kinds = np.array([known.get(word, -1) for word in words], np.int64)[codes]
    lifecycle = table.roles.program is not None and table.roles.program.name.startswith("XES")
    wrong = np.flatnonzero(kinds < 0)
    if wrong.size and lifecycle:
        left = sorted({str(column.iloc[row]) for row in wrong})
        table.notes.append(f"{wrong.size:,} rows are neither starts nor completions ({', '.join(left)}), and left out")
    elif wrong.size:
        given = column.iloc[int(wrong[0])]
        what = f"`event_type` must be a word for a start, a stop or a point, got {given!r}"
        table.problems.add(f"{what}; say what it means (--words {given or 'WORD'}=start)", wrong.tolist(), table.place)
        table.problems.stop()
    if lifecycle:
        kinds = _instants(table, kinds)
    return kinds


def _instants(table: Table, kinds: Integers) -> Integers:
    """Return the kinds with completions without a start as points, as in event logs."""
    times = table.times("start")
    assert times is not None
    pairs = _pair(table.unit_codes(), table.joined(table.roles.at["behaviour"]), times.values, kinds)
    alone = pairs.unpaired[kinds[pairs.unpaired] == 1]
    if alone.size:
        table.notes.append(f"{alone.size:,} completions have no start, and are read as points")
    kinds = kinds.copy()
    kinds[alone] = 2
    return kinds


class Pairs(NamedTuple):
    """Starts and stops that belong together.

    Attributes:
        stop: float64 `[rows]`, when what began in a row ended; of points their time; NaN where it is not known.
        unpaired: int `[K]`, rows that are starts or stops without the other.
    """

    stop: Floats
    unpaired: Integers


def _pair(unit: Integers, labels: NDArray[Any], when: Floats, kinds: Integers) -> Pairs:
    """Pair each start with the next stop of the same label; at equal times a stop closes the earlier start."""
    label = pd.factorize(labels)[0].astype(np.int64)
    key = unit * (int(label.max(initial=0)) + 1) + label
    rows = np.flatnonzero((kinds == 0) | (kinds == 1))
    stop = np.where(kinds == 2, when, np.nan)
    order = rows[np.lexsort((rows, when[rows], key[rows]))]
    # At equal times an open bout is closed first; else it is opened first.
    change = np.where(kinds[order] == 0, 1, -1)
    new_key = np.diff(key[order], prepend=-1) != 0
    tie = np.cumsum(new_key | (np.diff(when[order], prepend=np.nan) != 0))
    total = np.cumsum(change)
    first_of_key = np.maximum.accumulate(np.where(new_key, np.arange(len(order)), 0))
    base = np.where(first_of_key > 0, total[first_of_key - 1], 0)
    first_of_tie = np.maximum.accumulate(np.where(np.diff(tie, prepend=0) != 0, np.arange(len(order)), 0))
    open_before = np.where(first_of_tie > first_of_key, total[first_of_tie - 1], base) - base if len(order) else base
    first = np.where(open_before > 0, kinds[order] == 0, kinds[order] == 1)
    order = order[np.lexsort((np.arange(len(order)), first, tie))]
    is_stop = kinds[order] == 1
    new_key = np.diff(key[order], prepend=-1) != 0
    follows = np.zeros(len(order), bool)
    follows[1:] = ~is_stop[:-1] & is_stop[1:] & ~new_key[1:]
    at = np.flatnonzero(follows)
    stop[order[at - 1]] = when[order[at]]
    paired = np.zeros(len(kinds), bool)
    paired[order[at]] = paired[order[at - 1]] = True
    return Pairs(stop, np.flatnonzero(((kinds == 0) | (kinds == 1)) & ~paired))


def _positions(table: Table) -> Floats:
    """Return the number of each row within its recording, from 0: frames without a time."""
    return pd.Series(np.zeros(table.size)).groupby(table.unit_codes()).cumcount().to_numpy(np.float64)


def _are_frames(table: Table, start: Floats, labels: NDArray[Any]) -> bool:
    """Whether rows are frames: at equal steps, and many with the label of the row before."""
    if table.roles.program and table.roles.program.layout == "rows of frames":
        return True
    unit = table.unit_codes()
    same = np.diff(unit) == 0
    steps = np.diff(start)[same]
    if len(steps) < 5:
        return False
    step = float(np.nanmedian(steps))
    regular = step > 0 and float((np.abs(steps - step) < 0.02 * step).mean()) > 0.9
    repeats = float((labels[1:] == labels[:-1])[same].mean())
    return regular and repeats > MIN_REPEATS


def _part_of_frames(table: Table, start: Floats, labels: NDArray[Any]) -> Part:
    """Read rows of frames: a run of one label is one bout, from its first frame to the one after its last."""
    unit = table.unit_codes()
    order = np.lexsort((np.arange(table.size), start, unit))
    unit, when, label = unit[order], start[order], labels[order]
    same = np.diff(unit) == 0
    steps = np.diff(when)[same]
    step = float(np.median(steps)) if len(steps) else 1.0
    regular = len(steps) > 0 and float((np.abs(steps - step) < 0.02 * max(step, 1e-12)).mean()) > 0.9
    begin = np.append(True, ~same)
    hole = np.zeros(len(order), bool)
    if regular:
        hole[1:] = same & (np.diff(when) > 1.5 * step)
    new = begin | hole | np.append(True, label[1:] != label[:-1])
    after = np.append(when[1:], np.nan)
    after[np.append(~same, True)] = (when + (step if regular else 0.0))[np.append(~same, True)]
    if regular:
        after[:-1][hole[1:]] = when[:-1][hole[1:]] + step
    first = np.flatnonzero(new)
    last = np.append(first[1:] - 1, len(order) - 1)
    rows = order[first]
    words = (
        table.frame[table.roles.at["behaviour"][0]].to_numpy(object)[rows]
        if len(table.roles.at["behaviour"]) == 1
        else label[first]
    )
    # An empty cell says that nothing was done; a word for missing, that nobody knows.
    blank = (label[first] == "") & ((words == "") | (table.options.missing == "nothing"))
    start_of, stop_of = when[first], after[last]
    cut = hole[first]
    lost = ((label[first] == "") & ~blank) | (label[first] == UNSCORED)
    cut = cut | np.append(False, lost[:-1])
    keep = (label[first] != "") & ~lost
    carried = np.maximum.accumulate(np.where(cut, np.arange(len(first)), -1))
    previous = np.append(-1, np.flatnonzero(keep))
    cut_kept = carried[keep] > previous[:-1][: keep.sum()]
    table.notes.append(
        f"each row is a frame of {step:g} {table.unit or 'in the unit of the time'}: runs of one label are read as bouts"
        if regular
        else "rows say when something changes: a label lasts until the next row"
    )
    if blank.any():
        table.notes.append("frames with an empty cell were watched, and nothing was scored in them")
    part = table.part(rows[keep], label[first][keep], start_of[keep], stop_of[keep], cut_kept)
    # What was watched does not begin with the first behaviour, but with the first frame.
    stretch = np.cumsum(begin[first] | cut)[~lost]
    seen = pd.DataFrame({
        "recording": table.recording[rows][~lost], "subject": table.subject[rows][~lost], "stretch": stretch,
        "start": start_of[~lost], "stop": stop_of[~lost],
    })  # fmt: skip
    spans = seen.groupby("stretch", sort=False).agg(
        recording=("recording", "first"), subject=("subject", "first"), start=("start", "min"), stop=("stop", "max")
    )
    return replace(part, spans=spans.reset_index(drop=True))


def rows_of_frames(table: Table) -> Part:
    """Read one row a frame with one label."""
    labels = table.labels(table.joined(table.roles.at["behaviour"]))
    times = table.times("start")
    start = _positions(table) if times is None else times.values
    if times is None:
        table.unit = "frames"
    else:
        table.split_sessions(start, labels)
    return _part_of_frames(table, start, labels)


def columns_of_behaviours(table: Table) -> Part:
    """Read one row a frame with a column of zeros and ones for each behaviour; -1 is not scored."""
    names = table.roles.at["behaviour"]
    values = [table.frame[name].str.lower().to_numpy(object) for name in names]
    on = np.stack([np.isin(value, ["1", "1.0", "true"]) for value in values], 1)
    unscored = np.stack([np.isin(value, ["-1", "-1.0"]) for value in values], 1).all(1)
    times = table.times("start")
    index = table.frame.columns[0]
    if times is None and index.startswith("(column ") and index not in names:
        table.roles.at["start"] = [index]
        times, table.unit = table.times("start"), "frames"
    start = _positions(table) if times is None else times.values
    if times is None:
        table.unit = "frames"
    shown = [table.options.label(name) for name in names]
    several = int((on.sum(1) > 1).sum())
    never = [name for name, column in zip(names, on.T, strict=True) if not column.any()]
    if never:
        table.notes.append(f"behaviours that never occur: {', '.join(never)}")
    if unscored.any():
        table.notes.append(f"{int(unscored.sum()):,} rows are -1 in all columns: they were not scored")
    table.split_sessions(start, on.argmax(1).astype(str).astype(object))
    if several and table.options.overlaps != "join":
        table.first_notes.append(
            f"{several:,} of {table.size:,} rows have several behaviours at once; each is read for itself (--overlaps join"
            " reads them as one)"
        )
        return _separate_behaviours(table, on, unscored, start, shown)
    kinds, inverse = np.unique(on, axis=0, return_inverse=True)
    words = [TOGETHER.join(name for name, yes in zip(shown, kind, strict=True) if yes and name) for kind in kinds]
    labels = np.array(words, dtype=object)[inverse.ravel()]
    if several:
        some = next(word for word in words if TOGETHER in word)
        table.first_notes.append(
            f"{several:,} of {table.size:,} rows have several behaviours, read as one, such as {some!r}"
        )
    return _part_of_frames(table, start, np.where(unscored, UNSCORED, labels))


def _separate_behaviours(
    table: Table, on: NDArray[np.bool_], unscored: NDArray[np.bool_], start: Floats, names: list[str]
) -> Part:
    parts = []
    for i, name in enumerate(names):
        labels = np.where(unscored, UNSCORED, np.where(on[:, i], name, "")).astype(object)
        parts.append(_part_of_frames(table, start, labels))
    table.notes = list(dict.fromkeys(table.notes))
    events = pd.concat([one.events for one in parts], ignore_index=True)
    rows = np.concatenate([one.rows for one in parts])
    order = events.assign(_row=rows).sort_values(["recording", "subject", "start"], kind="stable").index.to_numpy()
    events, rows = events.iloc[order].reset_index(drop=True), rows[order]
    spans = parts[0].spans
    assert spans is not None
    owners = pd.concat([spans, events], ignore_index=True)
    unit = pd.factorize(owners["recording"] + "\0" + owners["subject"])[0]
    width = float(owners["start"].max() - owners["start"].min()) + 1
    place = unit * width + (owners["start"] - owners["start"].min()).to_numpy()
    order = np.argsort(place[: len(spans)], kind="stable")
    fragment = order[np.searchsorted(place[: len(spans)][order], place[len(spans) :], "right") - 1]
    return replace(parts[0], events=events, fragment=fragment.astype(np.int64), rows=rows, notes=table.notes)


def rows_of_sequences(table: Table) -> Part:
    """Read one row a sequence, a behaviour in each column; empty cells behind the last one are its end."""
    names = table.roles.at["behaviour"]
    cells = table.frame[names].to_numpy(object)
    labels = table.labels(cells.ravel()).reshape(cells.shape)
    reach = np.where(labels != "", np.arange(1, 1 + len(names)), 0).max(1, initial=0)
    empty = int((reach == 0).sum())
    row_names = next((name for name in table.frame if name.startswith("(column ")), None)
    if "recording" not in table.roles.at:
        if row_names and table.frame[row_names].is_unique:
            table.recording = table.frame[row_names].to_numpy(object)
        elif "subject" in table.roles.at and pd.Series(table.subject).is_unique:
            table.recording = table.subject
        elif whose := _names_of_rows(table):
            table.recording = table.frame[whose].to_numpy(object)
            table.notes.append(f"the column {whose!r} is taken for the names of the recordings")
        else:
            table.recording = np.array([str(i + 1) for i in range(table.size)], dtype=object)
    if empty:
        table.notes.append(f"{empty:,} rows have no behaviour (first in {table.place(int((reach == 0).argmax()))})")
        table.empty = [str(name) for name in table.recording[reach == 0]]
    taken = np.arange(len(names)) < reach[:, None]
    rows, steps = taken.nonzero()
    flat = labels[taken]
    table.unit = table.unit or "steps"
    if (flat == "").any():
        table.notes.append(
            f"{int((flat == '').sum()):,} cells within sequences have no label: another fragment begins after each"
        )
    part = table.part(rows.astype(np.int64), flat, steps.astype(np.float64), steps + 1.0)
    again = (part.events["behaviour"].to_numpy()[1:] == part.events["behaviour"].to_numpy()[:-1]) & (
        np.diff(part.fragment) == 0
    )
    if len(again) and again.mean() > MIN_REPEATS:
        part.first_notes.append(
            f"{again.mean():.0%} of the cells repeat the one before: --merge_repeats true makes each run one bout"
        )
    return part


def _names_of_rows(table: Table) -> str | None:
    """Return the first column that is not used and holds a name of its own in each row, if there is one."""
    used = table.roles.used()
    texts = (name for name in table.frame if name not in used and table.frame[name].is_unique)
    return next((str(name) for name in texts if not table.frame[name].str.fullmatch(r"[-\d.,]*").any()), None)


def _strings_of_sequences(table: Table) -> Part | None:
    """Read sequences that each stand in one cell: "a-b-c", or "(school,3)-(work,16)" with durations (SPS)."""
    names = table.roles.at["behaviour"]
    if table.roles.at.get("start") or len(names) > 1 or not table.size:
        return None
    cells = pd.Series(table.joined(names))
    filled = cells[cells != ""]
    if not len(filled):
        return None
    timed = filled.str.fullmatch(r"\(?[^(),]+,\s*\d+(\.\d+)?\)?(\s*-\s*\(?[^(),]+,\s*\d+(\.\d+)?\)?)*")
    own = plain(names[0]) in ("sequence", "seq", "sequences")
    separator = ""
    if not (timed.mean() > 0.9):
        keys = pd.Series(list(zip(table.recording, table.subject, strict=True)))
        alone = own or ("subject" in table.roles.at and keys.is_unique)
        counts = {one: float(filled.str.contains(one, regex=False).mean()) for one in SPLITS}
        separator = max(SPLITS, key=lambda one: counts[one])
        if not alone or counts[separator] <= 0.5:
            return None
        pieces = {word for text in filled for word in text.split(separator)}
        if len(pieces) >= filled.str.split(separator, regex=False).str.len().sum() * 0.9 and len(filled) > 1:
            return None
    table.unit = "steps"
    if "recording" not in table.roles.at:
        by_subject = "subject" in table.roles.at and pd.Series(table.subject).is_unique
        table.recording = (
            table.subject if by_subject else np.array([str(i + 1) for i in range(table.size)], dtype=object)
        )
    rows: list[int] = []
    labels: list[str] = []
    lengths: list[float] = []
    for row, text in enumerate(cells):
        pieces_of = SPS.findall(text) if not separator else [(word.strip(), "1") for word in text.split(separator)]
        rows += [row] * len(pieces_of)
        labels += [word.strip() for word, _ in pieces_of]
        lengths += [float(length) for _, length in pieces_of]
    row_of = np.array(rows, np.int64)
    ends = pd.Series(lengths).groupby(row_of).cumsum().to_numpy()
    what = "states with durations" if not separator else f"behaviours parted by {separator!r}"
    table.notes.append(f"each cell of {names[0]!r} is read as a sequence, {what}")
    named = table.labels(np.array(labels, dtype=object))
    return table.part(row_of, named, ends - np.array(lengths), ends)


LAYOUTS = {
    "events": rows_of_events,
    "rows of starts and stops": rows_of_starts_and_stops,
    "rows of frames": rows_of_frames,
    "columns of behaviours": columns_of_behaviours,
    "rows of sequences": rows_of_sequences,
}
