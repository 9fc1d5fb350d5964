"""Rows of sequences: a behaviour in each column, or a whole sequence in one cell."""

import re
from typing import Any

import numpy as np
import pandas as pd

from neuroprior.behaviour.reading.names import SEQUENCE_MISSING, SURE_SEPARATORS, plain
from neuroprior.behaviour.reading.problems import ReadingError
from neuroprior.behaviour.reading.table import Part, Table

STATE_AND_DURATION = re.compile(r"\(?([^(),]+),\s*(\d+(?:\.\d+)?)\)?")
SEPARATORS = (*SURE_SEPARATORS, ";", "-", ",", " ", "/")
"""Separators of behaviours in a sequence in one cell."""

ARROWS = (" > ", "->")
LIST = r"\[.*\]|\(.*\)|\{.*\}"
"""A list that a program has written as a text."""

CALLED_SEQUENCES = ("sequence", "seq", "sequences", "string", "song")
MIN_LETTERS, MAX_KINDS, MIN_RECURRENCE = 5, 12, 4
"""Letters of a sequence in the mean at least, different ones at most, and how often each occurs at least in the mean,
where letters are behaviours."""

MIN_SEPARATED = 0.3
"""Share of cells with a separator, at least, for cells to be sequences."""


def rows_of_sequences(table: Table) -> Part:
    """Read one row a sequence, with a behaviour in each column; it ends with the last filled cell."""
    names = table.roles.at["behaviour"]
    cells = table.frame[names].to_numpy(object)
    cells = np.where(np.isin(cells, SEQUENCE_MISSING), "", cells)
    labels = table.labels(cells.ravel()).reshape(cells.shape)
    reach = np.where(labels != "", np.arange(1, 1 + len(names)), 0).max(1, initial=0)
    empty = int((reach == 0).sum())
    row_names = next((name for name in table.frame if name.startswith("(column ")), None)
    if "recording" not in table.roles.at:
        if row_names and table.frame[row_names].is_unique:
            table.recording = table.frame[row_names].to_numpy(object)
        elif not table.is_row_a_subject() and (column := _names_of_rows(table)):
            table.recording = table.frame[column].to_numpy(object)
            table.notes.append(f"the column {column!r} is taken for the names of the recordings")
        else:
            table.name_rows()
    if empty:
        table.notes.append(f"{empty:,} rows have no behaviour (first in {table.place(int((reach == 0).argmax()))})")
        table.empty = [str(name) for name in table.recording[reach == 0]]
    taken = np.arange(len(names)) < reach[:, None]
    rows, steps = taken.nonzero()
    flat = labels[taken]
    table.unit = table.unit or "steps"
    if (flat == "").any():
        what = f"cells within sequences have no label: {table.after_missing}"
        table.notes.append(f"{(flat == '').sum():,} {what}")
    reading = table.part(rows.astype(np.int64), flat, steps.astype(np.float64), steps + 1.0)
    reading.note_repeats("cells")
    return reading


def _items_of_lists(table: Table, texts: Any) -> Any:
    """Return the items of lists with commas between them, parted by commas or, of numbers, by spaces; None for none."""
    inside = texts.str.slice(1, -1).str.strip()
    if (cut := inside.str.contains("...", regex=False)).any():
        raise ReadingError(f"{table.place(int(cut.idxmax()))}: lists must be whole, got {texts[cut].iloc[0]!r}")
    if inside.str.contains(",", regex=False).any():
        return inside.str.replace(r"['\"]", "", regex=True).str.replace(r"\s*,\s*", ",", regex=True)
    if inside.str.fullmatch(r"(-?\d+\s*)+").all() and inside.str.contains(r"\s").any():
        return inside.str.replace(r"\s+", ",", regex=True)
    return None


def _are_letters(texts: Any) -> bool:
    """Return whether texts are strings of letters or digits that are behaviours: no text recurs, but letters do."""
    together = "".join(texts)
    if len(set(together)) > MAX_KINDS or pd.to_numeric(texts, errors="coerce").is_monotonic_increasing:
        return False
    return bool(
        texts.str.fullmatch(r"[^\W\d_]+|\d+").all()
        and texts.str.len().mean() >= MIN_LETTERS
        and texts.nunique() >= 0.9 * len(texts)
        and len(together) >= MIN_RECURRENCE * len(set(together))
    )


def _best_separator(texts: Any, separators: list[str]) -> str:
    """Return the separator by which texts have the fewest different pieces, such as the space in "self-groom rear"."""
    pieces = {one: len({word.strip() for text in texts for word in text.split(one)}) for one in separators}
    return min(separators, key=lambda one: pieces[one], default="")


def _names_of_rows(table: Table) -> str | None:
    """Return the first unused column with a different name in each row; None for none."""
    used = table.roles.used()
    columns = (name for name in table.frame if name not in used and table.frame[name].is_unique)
    return next((str(name) for name in columns if not table.frame[name].str.fullmatch(r"[-\d.,]*").any()), None)


def strings_of_sequences(table: Table) -> Part | None:
    """Read sequences that each stand in one cell: "a-b-c", or "(school,3)-(work,16)" with durations (SPS)."""
    names = table.roles.at["behaviour"]
    if table.roles.at.get("start") or len(names) > 1 or not table.size:
        return None
    cells = pd.Series(table.joined(names))
    filled = cells[cells != ""]
    if not len(filled):
        return None
    filled = filled.str.replace(r"([^\s/()-]+)/(\d+(?:\.\d+)?)(?=-|$)", r"(\1,\2)", regex=True)
    cells = cells.where(cells == "", filled.reindex(cells.index))
    timed = filled.str.fullmatch(r"\(?[^(),]+,\s*\d+(\.\d+)?\)?(\s*-\s*\(?[^(),]+,\s*\d+(\.\d+)?\)?)*")
    is_sequence = plain(names[0]) in CALLED_SEQUENCES or not table.sheet.header
    separator, letters = "", False
    if timed.mean() <= 0.9:
        if filled.str.fullmatch(LIST).all() and (inside := _items_of_lists(table, filled)) is not None:
            is_sequence, filled = True, inside
        elif letters := plain(names[0]) in CALLED_SEQUENCES and _are_letters(filled):
            filled = filled.map(" ".join)
        cells = cells.where(cells == "", filled.reindex(cells.index))
        keys = pd.Series(list(zip(table.recording, table.subject, strict=True)))
        counts = {one: float(filled.str.contains(one, regex=False).mean()) for one in SEPARATORS}
        alone = is_sequence or ("subject" in table.roles.at and keys.is_unique)
        alone = alone or any(counts[one] > 0.9 and filled.str.count(re.escape(one)).max() > 1 for one in ARROWS)
        separator = max(SEPARATORS, key=lambda one: counts[one])
        separator = _best_separator(filled, [one for one in SEPARATORS if counts[one] >= MIN_SEPARATED]) or separator
        if not alone or counts[separator] < MIN_SEPARATED:
            return None
        pieces = [word for text in filled for word in text.split(separator)]
        if len(set(pieces)) >= 0.9 * len(pieces) and len(filled) > 1:
            return None
    table.unit = "steps"
    if "recording" not in table.roles.at:
        table.name_rows()
    rows: list[int] = []
    labels: list[str] = []
    lengths: list[float] = []
    for row, text in enumerate(cells):
        pieces_of = (
            STATE_AND_DURATION.findall(text)
            if not separator
            else [(word.strip(), "1") for word in text.split(separator)]
        )
        rows += [row] * len(pieces_of)
        labels += [word.strip() for word, _ in pieces_of]
        lengths += [float(length) for _, length in pieces_of]
    row_of = np.array(rows, np.int64)
    ends = pd.Series(lengths).groupby(row_of).cumsum().to_numpy().astype(np.float64)
    parted = "each letter a behaviour" if letters else f"behaviours parted by {separator!r}"
    what = parted if separator else "states with durations"
    table.notes.append(f"each cell of {names[0]!r} is read as a sequence, {what}")
    named = table.labels(np.array(["" if word in SEQUENCE_MISSING else word for word in labels], dtype=object))
    return table.part(row_of, named, (ends - np.array(lengths)).astype(np.float64), ends)
