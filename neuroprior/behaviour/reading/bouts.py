"""Rows of events: each with its start and stop, a duration, a start alone, or no time."""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neuroprior.behaviour.reading.frames import are_frames, number_rows, read_labelled_frames
from neuroprior.behaviour.reading.sequences import strings_of_sequences
from neuroprior.behaviour.reading.table import MIN_REPEATS, Floats, Part, Table
from neuroprior.behaviour.reading.times import CLOCKS, HALF_A_DAY, Times, over_midnight, smallest_unit


def rows_of_events(table: Table) -> Part:
    """Read one row an event: with start and stop, a duration, a start alone, or no time."""
    labels = table.labels(table.joined(table.roles.at["behaviour"]))
    if split := strings_of_sequences(table):
        return split
    start_times, stop_times, duration_times = table.times("start"), table.times("stop"), table.times("duration")
    nothing = np.full(table.size, np.nan)
    start = nothing if start_times is None else start_times.values
    stop = nothing if stop_times is None else stop_times.values
    if start_times and stop_times and start_times.kind != stop_times.kind and np.isfinite(stop).any():
        table.problems.add(f"`stop` must be {start_times.kind}, as `start` is, got {stop_times.kind}", [0], table.place)
    if start_times and start_times.kind == CLOCKS:
        start, stop = _past_midnight(table, start, stop)
    elif len(table.roles.at.get("stop", [])) > 1:  # the day of the start stands before the time of the stop
        stop = np.where(stop < start - HALF_A_DAY, stop + 86400, stop)
    start, stop = _with_durations(table, start, stop, duration_times)
    wrong = np.flatnonzero(stop < start - 1e-9)
    if wrong.size:
        what = f"the stop {stop[wrong[0]]:g} is before the start {start[wrong[0]]:g}"
        table.problems.add(f"`stop` must not be before `start`; {what}", wrong.tolist(), table.place)
    empty = (
        table.joined(table.roles.at.get("start", [])) == "" if start_times is not None else np.zeros(table.size, bool)
    )
    untimed = np.flatnonzero(np.isnan(start) & (labels != "") & empty)
    if untimed.size and untimed.size < table.size:
        table.problems.add("`start` must be known, got an empty cell", untimed.tolist(), table.place)
    if start_times is not None:
        table.split_sessions(start, labels, stop if np.isfinite(stop).any() else None)
        if np.isnan(stop).all() and are_frames(table, start, labels):
            return read_labelled_frames(table, start, labels)
    elif np.isnan(stop).all() and table.roles.program and table.roles.program.layout == "rows of frames":
        return read_labelled_frames(table, number_rows(table), labels)
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
    again: NDArray[np.bool_] = table.frame.assign(**{"\1": table.recording}).duplicated().to_numpy()
    return again & (stop > start)


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
            f"{apart.sum():,} durations are not the time from start to stop (first in"
            f" {table.place(int(apart.argmax()))});"
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
    once = float((np.abs(gaps - 1) < 1e-9).mean()) if len(gaps) else 0.0
    if 0.5 <= once < 1 and not (np.abs(gaps) < 1e-9).any() and table.options.ends == "auto":
        table.notes.append(
            f"{once:.0%} of the stops are 1 before the next start, and none is at it: if they are the last frame of a"
            " bout, say --ends inclusive"
        )
    alike = len(gaps) >= 2 and gaps[0] > 0 and np.all(np.abs(gaps - gaps[0]) < 1e-6 * max(gaps[0], 1))
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
            f"every stop is {step:g} before the next start: stops are read as the last unit of a bout, and"
            f" {step:g} added"
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
                f"{share:.0%} of the behaviours repeat the one before: if a row is a frame, --merge_repeats"
                " true makes each"
                " run one bout"
            )
    if only_starts:
        notes.append(
            "only starts are known: how long behaviours last is not (--ends next: each until the next one begins)"
        )
    return notes
