"""Rows of frames: with labels, or with a column of zeros and ones for each behaviour."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neuroprior.behaviour.reading.columns import INDICATORS, Roles
from neuroprior.behaviour.reading.sheets import Sheet
from neuroprior.behaviour.reading.table import MIN_REPEATS, Floats, Part, Table
from neuroprior.behaviour.reading.times import MISSING_TIMES, smallest_unit

TOGETHER = "+"
"""Between behaviours that are done at once."""

NAME_OF_COLUMN, LABEL_IN_COLUMN = "name of the column", "label in the column"
"""Columns of a table that had a column for each subject."""

MIN_FRAME_REPEATS = 0.6
"""As `MIN_REPEATS`, where no name says that rows are frames: of two labels at random, half repeat."""

MIN_REGULAR = 0.9
"""Share of equal steps between rows, above which rows are frames."""

MAX_CHANNEL_LABELS = 40
"""Different labels at most of a column that is another channel of behaviours."""


def number_rows(table: Table) -> Floats:
    """Return the number of each row within its recording, from 0, float64 `[rows]`: the time of frames without one."""
    numbers = pd.Series(np.zeros(table.size)).groupby(table.unit_codes()).cumcount()
    return np.asarray(numbers, np.float64)


def are_frames(table: Table, start: Floats, labels: NDArray[Any]) -> bool:
    """Return whether rows are frames: at equal steps, and many with the label of the row before."""
    if table.roles.program and table.roles.program.layout == "rows of frames":
        return True
    unit = table.unit_codes()
    order = np.lexsort((start, unit))
    same, labels = np.diff(unit[order]) == 0, labels[order]
    if same.sum() < 5:
        return False
    repeats = float((labels[1:] == labels[:-1])[same].mean())
    # Events have labels: blank ones at equal steps are frames in which nothing is done.
    sure = table.unit == "frames" or float((labels == "").mean()) > 0.05
    threshold = MIN_REPEATS if sure else MIN_FRAME_REPEATS
    return _usual_step(table, np.diff(start[order])[same]) is not None and repeats > threshold


def _usual_step(table: Table, steps: Floats) -> float | None:
    """Return the mean step between frames; None where steps differ by more than the rounding of times."""
    if not len(steps):
        return None
    step = float(np.median(steps))
    names = table.roles.at.get("start")
    rounding = smallest_unit(table.frame[names[-1]].to_numpy(object)) if names else 0
    near = np.abs(steps - step) <= max(0.02 * step, min(1.01 * rounding, 0.5 * step))
    if step <= 0:
        return None
    whole = np.round(steps / step)  # frames may be missing where they are numbered
    regular = near | ((whole > 1) & (np.abs(steps - whole * step) < 1e-9)) if table.unit == "frames" else near
    if regular.mean() <= MIN_REGULAR:
        return None
    return float(np.mean(steps[near]))


def read_channels(table: Table, start: Floats, channels: Sequence[NDArray[Any]], lost: NDArray[np.bool_]) -> Part:
    """Read frames: in each channel a run of one label is a bout, from its first frame to the one after its last.

    Args:
        table: the table.
        start: float64 `[rows]`, when each frame begins.
        channels: labels, str `[rows]` each; "" where nothing is done.
        lost: bool `[rows]`, frames that were not scored.
    """
    unit = table.unit_codes()
    order = np.lexsort((np.arange(table.size), start, unit))
    unit, when, lost = unit[order], start[order], lost[order]
    same = np.diff(unit) == 0
    step = _usual_step(table, np.diff(when)[same])
    begin = np.append(True, ~same)
    after = np.append(when[1:], np.nan)
    ends = np.append(~same, True)
    after[ends] = when[ends] + (step or 0.0)
    if step is not None:
        hole = np.append(False, same & (np.diff(when) > 1.5 * step))
        after[:-1][hole[1:]] = when[:-1][hole[1:]] + step
        begin |= hole
        unit_name = table.unit or "in the unit of the time"
        table.notes.append(f"each row is a frame, of length {step:.4g} {unit_name}: runs of one label are bouts")
    else:
        table.notes.append("rows are not at equal steps: each label lasts until the next row")
    stretch = np.cumsum(begin | np.append(False, lost[1:] != lost[:-1]))
    bouts: list[tuple[Any, ...]] = []
    for labels in channels:
        label = labels[order]
        first = np.flatnonzero(np.append(True, (label[1:] != label[:-1]) | (np.diff(stretch) != 0)))
        last = np.append(first[1:] - 1, len(order) - 1)
        kept = (label[first] != "") & ~lost[first]
        first, last = first[kept], last[kept]
        bouts.append((order[first], label[first], when[first], after[last], stretch[first]))
    rows, names, starts, stops, stretches = (np.concatenate(columns) for columns in zip(*bouts, strict=True))
    reading = table.part(rows.astype(np.int64), names, starts, stops, stretches)
    # What was watched begins with the first frame, not with the first behaviour.
    frames = pd.DataFrame({
        "recording": table.recording[order], "subject": table.subject[order], "stretch": stretch,
        "start": when, "stop": after,
    })[~lost]  # fmt: skip
    spans = frames.groupby("stretch", sort=False).agg(
        recording=("recording", "first"), subject=("subject", "first"), start=("start", "min"), stop=("stop", "max")
    )
    return replace(reading, spans=spans.reset_index(drop=True))


def rows_of_frames(table: Table) -> Part:
    """Read one row a frame with one label."""
    labels = table.labels(table.joined(table.roles.at["behaviour"]))
    times = table.times("start")
    start = number_rows(table) if times is None else times.values
    if times is None:
        table.unit = "frames"
    else:
        table.split_sessions(start, labels)
    return read_labelled_frames(table, start, labels)


def melt_subjects(sheet: Sheet, roles: Roles) -> tuple[Sheet, Roles]:
    """Return columns of subjects as rows of frames: one row for each subject and frame, in this order."""
    names, frame = roles.at["behaviour"], sheet.frame
    long = frame.melt(
        [name for name in frame if name not in names], names, var_name=NAME_OF_COLUMN, value_name=LABEL_IN_COLUMN
    )
    shown = f"{names[0]}, {names[1]}, ... ({len(names)} columns)" if len(names) > 2 else " and ".join(names)
    note = f"{shown}: each is read as one subject with a label at each frame (--columns.behaviour"
    note += f" '{names[0]}:{names[-1]}' if each row is a sequence)"
    at = roles.at | {"behaviour": [LABEL_IN_COLUMN], "subject": [NAME_OF_COLUMN]}
    inferred = roles.inferred | ({"subject"} if "behaviour" in roles.inferred else set())
    lines = np.tile(sheet.lines, len(names))
    return (
        replace(sheet, frame=long, lines=lines),
        replace(roles, at=at, inferred=inferred, layout="rows of frames", notes=[*roles.notes, note]),
    )


def read_labelled_frames(table: Table, start: Floats, labels: NDArray[Any]) -> Part:
    """Read frames with one label each; other columns of labels are further channels.

    In an empty cell nothing was done. A word for missing says that the frame was not scored.
    """
    names = table.roles.at["behaviour"]
    blank = table.joined(names) == ""
    lost = (labels == "") & (table.options.missing == "gap" if table.options.missing else ~blank)
    others = _other_channels(table) if "behaviour" in table.roles.inferred else []
    if not others:
        if lost.any():
            row = table.place(int(lost.argmax()))
            table.notes.append(f"{int(lost.sum()):,} frames have no label (first in {row}): nothing is known of them")
        if (blank & ~lost).any() and table.options.missing != "label":
            table.notes.append("frames with an empty cell were watched, and nothing was scored in them")
        return read_channels(table, start, [labels], lost)
    channels = {names[0]: labels, **{name: table.labels(table.frame[name].to_numpy(object)) for name in others}}
    sets = [set(pd.unique(channel)) - {""} for channel in channels.values()]
    if sum(map(len, sets)) > len(set().union(*sets)):  # the same label in two channels is not the same behaviour
        for name, channel in channels.items():
            channels[name] = np.array([label and f"{name}: {label}" for label in channel], object)
    table.roles.at["behaviour"] = list(channels)
    table.first_notes.append(f"the columns {', '.join(channels)} hold labels at each frame: each is read for itself")
    return read_channels(table, start, list(channels.values()), np.zeros(table.size, bool))


def _other_channels(table: Table) -> list[str]:
    """Return columns without a use that hold a few labels in runs, as that of the behaviours does."""
    used = table.roles.used()
    same = np.diff(table.unit_codes()) == 0
    names = []
    for name in table.frame:
        cells = table.frame[name]
        words = pd.unique(cells[cells != ""])
        if name in used or not 1 <= len(words) <= MAX_CHANNEL_LABELS:
            continue
        if {word.lower() for word in words} <= INDICATORS:
            continue
        is_text = pd.to_numeric(pd.Series(words, dtype=object), errors="coerce").isna().all()
        values = cells.to_numpy(object)
        changes = (values[1:] != values[:-1])[same]
        if is_text and changes.any() and (~changes).mean() > MIN_REPEATS:
            names.append(str(name))
    return names


def columns_of_behaviours(table: Table) -> Part:
    """Read one row a frame with a column of zeros and ones for each behaviour; -1 is not scored."""
    names = table.roles.at["behaviour"]
    values = [table.frame[name].str.lower().to_numpy(object) for name in names]
    for name, value in zip(names, values, strict=True):
        wrong = np.flatnonzero(~np.isin(value, [*INDICATORS, *MISSING_TIMES]))
        if wrong.size:
            what = f"{name!r} must be 0 or 1, got {str(value[wrong[0]])!r}"
            table.problems.add(what, wrong.tolist(), table.place)
    on = np.stack([np.isin(value, ["1", "1.0", "true"]) for value in values], 1)
    unscored = np.logical_or.reduce([np.isin(value, [*MISSING_TIMES[1:], "-1", "-1.0"]) for value in values])
    unscored |= np.logical_and.reduce([value == "" for value in values])
    times = table.times("start")
    index = table.frame.columns[0]
    if times is None and index.startswith("(column ") and index not in names:
        table.roles.at["start"] = [index]
        times, table.unit = table.times("start"), "frames"
    start = number_rows(table) if times is None else times.values
    if times is None:
        table.unit = "frames"
    labels = [table.options.label(name) for name in names]
    several = int((on.sum(1) > 1).sum())
    never = [name for name, column in zip(names, on.T, strict=True) if not column.any()]
    if never:
        table.notes.append(f"behaviours that never occur: {', '.join(never)}")
    if unscored.any():
        table.notes.append(f"{int(unscored.sum()):,} rows are empty, -1 or missing: they were not scored")
    table.split_sessions(start, on.argmax(1).astype(str).astype(object))
    if table.options.overlaps != "join":
        if several:
            table.first_notes.append(
                f"{several:,} of {table.size:,} rows have several behaviours at once; each is read for itself"
                " (--overlaps join reads them as one)"
            )
        channels = [np.where(column, name, "").astype(object) for name, column in zip(labels, on.T, strict=True)]
        return read_channels(table, start, channels, unscored)
    kinds, inverse = np.unique(on, axis=0, return_inverse=True)
    words = [TOGETHER.join(name for name, yes in zip(labels, kind, strict=True) if yes and name) for kind in kinds]
    if several:
        example = next(word for word in words if TOGETHER in word)
        what = f"rows have several behaviours at once, read as one, such as {example!r}"
        table.first_notes.append(f"{several:,} of {table.size:,} {what}")
    return read_channels(table, start, [np.array(words, dtype=object)[inverse.ravel()]], unscored)
