"""Rows of frames: with one label, or with a column of zeros and ones for each behaviour."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neuroprior.behaviour.reading.table import MIN_REPEATS, Floats, Part, Table

TOGETHER = "+"
"""Between behaviours that are done at once."""

UNSCORED = "\1"
"""In place of the label of a frame that nobody scored; numpy would drop a zero."""


def number_rows(table: Table) -> Floats:
    """Return the number of each row within its recording, from 0: frames without a time."""
    found: Floats = pd.Series(np.zeros(table.size)).groupby(table.unit_codes()).cumcount().to_numpy().astype(np.float64)
    return found


def are_frames(table: Table, start: Floats, labels: NDArray[Any]) -> bool:
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


def part_of_frames(table: Table, start: Floats, labels: NDArray[Any]) -> Part:
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
        f"each row is a frame of {step:g} {table.unit or 'in the unit of the time'}: runs of one label are read"
        " as bouts"
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
    start = number_rows(table) if times is None else times.values
    if times is None:
        table.unit = "frames"
    else:
        table.split_sessions(start, labels)
    return part_of_frames(table, start, labels)


def columns_of_behaviours(table: Table) -> Part:
    """Read one row a frame with a column of zeros and ones for each behaviour; -1 is not scored."""
    names = table.roles.at["behaviour"]
    values = [table.frame[name].str.lower().to_numpy(object) for name in names]
    on = np.stack([np.isin(value, ["1", "1.0", "true"]) for value in values], 1)
    unscored = np.logical_and.reduce([np.isin(value, ["-1", "-1.0"]) for value in values])
    times = table.times("start")
    index = table.frame.columns[0]
    if times is None and index.startswith("(column ") and index not in names:
        table.roles.at["start"] = [index]
        times, table.unit = table.times("start"), "frames"
    start = number_rows(table) if times is None else times.values
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
            f"{several:,} of {table.size:,} rows have several behaviours at once; each is read for itself"
            " (--overlaps join"
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
    return part_of_frames(table, start, np.where(unscored, UNSCORED, labels))


def _separate_behaviours(
    table: Table, on: NDArray[np.bool_], unscored: NDArray[np.bool_], start: Floats, names: list[str]
) -> Part:
    parts = []
    for i, name in enumerate(names):
        labels = np.where(unscored, UNSCORED, np.where(on[:, i], name, "")).astype(object)
        parts.append(part_of_frames(table, start, labels))
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
