"""Starts and stops that are rows of their own, and points."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neuroprior.behaviour.reading.names import WORDS, plain
from neuroprior.behaviour.reading.table import MAX_OVERLAP, Floats, Integers, Part, Table, overlapping
from neuroprior.behaviour.reading.times import CLOCKS


def rows_of_starts_and_stops(table: Table) -> Part:
    """Read starts, stops and points, each in a row of its own; `WORDS` tells them apart."""
    if "start" not in table.roles.at:
        what = "`columns.start` must name the column of times, since rows are starts and stops"
        table.problems.add(what, [0], table.place)
        table.problems.stop()
    times = table.times("start")
    assert times is not None
    when = times.values
    if times.kind == CLOCKS:
        when = table.over_midnight(when)
    texts = table.joined(table.roles.at["behaviour"])
    kinds = _kinds_of_rows(table)
    untimed = np.flatnonzero(np.isnan(when))
    if untimed.size:
        table.problems.add("`start` must be known, got an empty cell", untimed.tolist(), table.place)
        table.problems.stop()
    used = table.roles.used()
    modifiers = [name for name in table.frame if plain(name).startswith("modifier") and name not in used]
    pairs = _pair(table.unit_codes(), texts, when, kinds)
    is_start = kinds == 0
    overlaps = overlapping(table.unit_codes()[is_start], when[is_start], pairs.stop[is_start])
    if pairs.unpaired.size or len(overlaps) > MAX_OVERLAP * is_start.sum():
        table.split_sessions(when, texts)
        pairs = _pair(table.unit_codes(), texts, when, kinds)
    if modifiers and pairs.unpaired.size:
        key = table.joined([*table.roles.at["behaviour"], *modifiers])
        with_modifiers = _pair(table.unit_codes(), key, when, kinds)
        if with_modifiers.unpaired.size < pairs.unpaired.size:
            pairs = with_modifiers
            table.notes.append(f"starts and stops are paired by {', '.join(modifiers)} as well")
    stop = pairs.stop
    if (durations := table.times("duration")) is not None:
        fill = np.isnan(stop) & np.isfinite(durations.values) & (durations.values > 0) & (kinds == 0)
        stop = np.where(fill, when + durations.values, stop)
        pairs = pairs._replace(unpaired=pairs.unpaired[~fill[pairs.unpaired]])
    if pairs.unpaired.size and table.options.unpaired == "error":
        row = int(pairs.unpaired[0])
        what = "a stop without a start" if kinds[row] == 1 else "a start without a stop"
        way = "--unpaired drop leaves such rows out, --unpaired open keeps starts whose stop is not known"
        table.problems.add(f"{texts[row]!r} has {what}; {way}", pairs.unpaired.tolist(), table.place)
    elif pairs.unpaired.size:
        drop = table.options.unpaired == "drop"
        done = "left out" if drop else "starts without a stop kept, stops without a start left out"
        table.first_notes.append(f"{pairs.unpaired.size:,} rows are starts or stops without the other: {done}")
    keep = (kinds == 0) | (kinds == 2)
    if table.options.unpaired == "drop":
        keep[pairs.unpaired] = False
    rows = np.flatnonzero(keep)
    labels = table.labels(texts)
    return table.part(rows, labels[rows], when[rows], stop[rows])


def _kinds_of_rows(table: Table) -> Integers:
    """Return 0 for starts, 1 for stops, 2 for points, -1 for rows that are none."""
    column = table.frame[table.roles.at["event_type"][0]]
    numbers = {"start": 0, "stop": 1, "point": 2}
    kind_of = {word: numbers[kind] for kind, words in WORDS.items() for word in words}
    kind_of |= {word.lower(): numbers[kind] for word, kind in table.options.words.items()}
    codes, values = pd.factorize(column)
    words = [str(value).lower() for value in values]
    if set(words) <= {"0", "1"} and not set(words) & set(table.options.words):
        kind_of |= {"1": 0, "0": 1}
    kinds = np.array([kind_of.get(word, -1) for word in words], np.int64)[codes]
    lifecycle = table.roles.program is not None and table.roles.program.name.startswith("XES")
    wrong = np.flatnonzero(kinds < 0)
    if wrong.size and lifecycle:
        others = ", ".join(sorted({str(column.iloc[row]) for row in wrong}))
        table.notes.append(f"{wrong.size:,} rows are neither starts nor completions ({others}), and are left out")
    elif wrong.size:
        word = column.iloc[int(wrong[0])]
        what = f"`event_type` must be a word for a start, a stop or a point, got {word!r}"
        table.problems.add(f"{what}; say what it means (--words {word or 'WORD'}=start)", wrong.tolist(), table.place)
        table.problems.stop()
    if lifecycle:
        kinds = _instants(table, kinds)
    return kinds


def _instants(table: Table, kinds: Integers) -> Integers:
    """Return the kinds of rows, with completions that have no start as points."""
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
    """Pair each start with the next stop of the same label; at equal times a stop closes the earlier start.

    All are `[rows]`: the number of the recording and subject, the label, the time, and the kind (`_kinds_of_rows`).
    """
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
