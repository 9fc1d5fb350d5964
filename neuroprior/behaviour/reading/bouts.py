"""Rows of events: with start and stop, a duration, a start alone, or no time."""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neuroprior.behaviour.reading.frames import are_frames, number_rows, read_labelled_frames
from neuroprior.behaviour.reading.sequences import strings_of_sequences
from neuroprior.behaviour.reading.table import Floats, Part, Table
from neuroprior.behaviour.reading.times import CLOCKS, DAY, Times, smallest_unit


def rows_of_events(table: Table) -> Part:
    """Read one row an event: with start and stop, a duration, a start alone, or no time."""
    labels = table.labels(table.joined(table.roles.at["behaviour"]))
    if sequences := strings_of_sequences(table):
        return sequences
    start_times, stop_times, duration_times = table.times("start"), table.times("stop"), table.times("duration")
    unknown = np.full(table.size, np.nan)
    start = unknown if start_times is None else start_times.values
    stop = unknown if stop_times is None else stop_times.values
    if start_times and stop_times and start_times.kind != stop_times.kind and np.isfinite(stop).any():
        table.problems.add(f"`stop` must be {start_times.kind}, as `start` is, got {stop_times.kind}", [0], table.place)
    if start_times and start_times.kind == CLOCKS:
        start, stop = _count_past_midnight(table, start, stop)
    elif len(table.roles.at.get("stop", [])) > 1:  # the day of the start stands before the time of the stop
        stop = np.where(stop < start - DAY / 2, stop + DAY, stop)
    start, stop = _fill_by_durations(table, start, stop, duration_times)
    wrong = np.flatnonzero(stop < start - 1e-9)
    if wrong.size:
        texts = [
            table.joined(table.roles.at[use])[wrong[0]] if use in table.roles.at else f"{values[wrong[0]]:g}"
            for use, values in (("stop", stop), ("start", start))
        ]
        what = f"the stop {texts[0]} is before the start {texts[1]}"
        table.problems.add(f"`stop` must not be before `start`; {what}", wrong.tolist(), table.place)
    if start_times is not None:
        empty = table.joined(table.roles.at["start"]) == ""
        untimed = np.flatnonzero(np.isnan(start) & (labels != "") & empty)
        if 0 < untimed.size < table.size:
            table.problems.add("`start` must be known, got an empty cell", untimed.tolist(), table.place)
        table.split_sessions(start, labels, stop if np.isfinite(stop).any() else None)
        if np.isnan(stop).all() and are_frames(table, start, labels):
            return read_labelled_frames(table, start, labels)
    elif np.isnan(stop).all() and table.roles.program and table.roles.program.layout == "rows of frames":
        return read_labelled_frames(table, number_rows(table), labels)
    twice = _repeated_rows(table, start, stop)
    if twice.any():
        where = table.place(int(twice.argmax()))
        table.first_notes.append(f"{twice.sum():,} rows repeat an earlier row, and are left out (first in {where})")
    rows = np.flatnonzero(~twice)
    stop = _make_exclusive(table, start, stop)
    reading = table.part(rows, labels[rows], start[rows], stop[rows])
    reading.notes += _notes_on_labels(table, labels, reading, start_times is not None and bool(np.isnan(stop).all()))
    return reading


def _repeated_rows(table: Table, start: Floats, stop: Floats) -> NDArray[np.bool_]:
    """Return which rows repeat an earlier one cell by cell, bool `[rows]`, where starts and stops are known."""
    if np.isnan(start).all() or np.isnan(stop).all() or not (stop > start).any():
        return np.zeros(table.size, bool)
    again: NDArray[np.bool_] = table.frame.assign(**{"\1": table.recording}).duplicated().to_numpy()
    return again & (stop > start)


def _count_past_midnight(table: Table, start: Floats, stop: Floats) -> tuple[Floats, Floats]:
    """Return starts and stops counted on over midnight."""
    of_day = start
    start = table.over_midnight(start)
    stop = stop + np.nan_to_num(start - of_day)
    next_day = stop < start - DAY / 2
    stop = np.where(next_day, stop + DAY, stop)
    if next_day.any():
        table.note_midnight()
    return start, stop


def _fill_by_durations(table: Table, start: Floats, stop: Floats, duration: Times | None) -> tuple[Floats, Floats]:
    """Return starts and stops, filled by durations; durations that a user named count more than stops."""
    if duration is None:
        return start, stop
    seconds = duration.values
    negative = np.flatnonzero(seconds < 0)
    if negative.size:
        what = f"`duration` must be at least 0, got {seconds[negative[0]]:g}"
        table.problems.add(what, negative.tolist(), table.place)
    named = "duration" not in table.roles.inferred
    both = np.isfinite(seconds) & np.isfinite(stop) & np.isfinite(start)
    tolerance = 0.01 * (seconds + np.nanmedian(np.append(seconds, 1)) + 1e-9)
    differs = both & (np.abs(stop - start - seconds) > tolerance)
    if differs.any():
        where = table.place(int(differs.argmax()))
        table.first_notes.append(
            f"{differs.sum():,} durations are not the time from start to stop (first in {where});"
            f" the {'durations' if named else 'stops'} count"
        )
    use = np.isfinite(seconds) & (~np.isfinite(stop) | named)
    if "start" not in table.roles.at:
        # Without starts the events of a recording follow one another.
        unit, finite = table.unit_codes(), np.isfinite(seconds)
        ends = pd.Series(np.where(finite, seconds, 0)).groupby(unit).cumsum().to_numpy()
        all_finite = pd.Series(finite).groupby(unit).transform("all").to_numpy()
        return np.where(all_finite, ends - seconds, np.nan), np.where(all_finite, ends, np.nan)
    return start, np.where(use, start + seconds, stop)


def _make_exclusive(table: Table, start: Floats, stop: Floats) -> Floats:
    """Return stops as the first time after each bout.

    Where every stop is one unit before the next start, it is the last unit of its bout.
    """
    ends = table.options.ends
    if ends == "exclusive" or np.isnan(stop).all():
        return stop
    unit = table.unit_codes()
    order = np.lexsort((start, unit))
    same = np.diff(unit[order]) == 0
    gaps = (start[order][1:] - stop[order][:-1])[same]
    gaps = gaps[np.isfinite(gaps)]
    share = float((np.abs(gaps - 1) < 1e-9).mean()) if len(gaps) else 0.0
    if 0.5 <= share < 1 and not (np.abs(gaps) < 1e-9).any() and ends == "auto":
        table.notes.append(
            f"{share:.0%} of the stops are 1 before the next start, and none is at it: if they are the last frame of a"
            " bout, say --ends inclusive"
        )
    equal = len(gaps) >= 2 and gaps[0] > 0 and np.all(np.abs(gaps - gaps[0]) < 1e-6 * max(gaps[0], 1))
    if ends != "inclusive" and ("duration" in table.roles.at or not equal):
        return stop
    texts = np.concatenate(
        [table.frame[name].to_numpy(object) for use in ("start", "stop") for name in table.roles.at.get(use, [])]
    )
    step = smallest_unit(texts)
    if ends == "inclusive":
        return stop + step
    if abs(gaps[0] - step) >= 1e-6 * max(step, 1):
        return stop
    table.first_notes.append(
        f"every stop is {step:g} before the next start: stops are read as the last unit of a bout, and {step:g} added"
        " (--ends exclusive reads them as they are)"
    )
    return stop + step


def _notes_on_labels(table: Table, labels: NDArray[Any], reading: Part, only_starts: bool) -> list[str]:
    """Return notes on rows without a label, on labels that repeat, and on starts without stops."""
    notes = []
    missing = labels == ""
    if missing.any():
        what = f"rows have no label (first in {table.place(int(missing.argmax()))})"
        notes.append(f"{missing.sum():,} of {len(labels):,} {what}: {table.after_missing}")
    reading.note_repeats("behaviours", " if a row is a frame,")
    endless = reading.events["stop"].isna().to_numpy() & reading.events["start"].notna().to_numpy()
    if 0 < endless.sum() < len(endless) and table.options.ends != "next":
        where = table.place(int(reading.rows[endless.argmax()]))
        reading.first_notes.append(
            f"{endless.sum():,} of {len(endless):,} events have no stop (first in {where}): their durations are unknown"
            " (--ends next: until the next begins)"
        )
    if only_starts:
        notes.append("no stops are known, and no durations (--ends next: each behaviour lasts until the next begins)")
    return notes
