"""JSON and NumPy's arrays as pandas frames."""

import io
import json
from itertools import zip_longest
from typing import Any

import numpy as np
import pandas as pd

from neuroprior._files import grows_too_much
from neuroprior.behaviour.reading.names import KNOWN_NAMES, plain
from neuroprior.behaviour.reading.problems import ReadingError

OTHER_FORMATS = (
    ((b"MATLAB 5.0 MAT-file",), "MATLAB data", "writetable"),
    ((b"SQLite format 3\0",), "a database", "a query whose result is saved as CSV"),
    ((b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"), "a pickle, which could run a program", "frame.to_csv"),
    ((b"%PDF",), "a PDF", "the program that made it"),
)
"""The first bytes of files that are refused: what they are, and what writes a table instead."""

JSON_FORMS = "a list of records, lists of labels, or an object of these, or of bouts by behaviour, by recording"


def check_format(content: bytes, label: str) -> None:
    """Refuse files of programs whose data are no tables.

    Raises:
        ReadingError: the first bytes are those of such a file.
    """
    for beginnings, what, way in OTHER_FORMATS:
        if content.startswith(beginnings):
            raise ReadingError(f"{label}: the file must be a table, got {what}; write CSV ({way})")


def read_array(content: bytes, label: str) -> tuple[pd.DataFrame, bool]:
    """Return NumPy's array as a frame, and whether it names its columns, as structured arrays do.

    Raises:
        ReadingError: the array is not whole, or holds objects, numbers that are not whole, or more than two dimensions.
    """
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except (ValueError, EOFError, MemoryError) as error:
        reason = str(error).splitlines()[0]
        raise ReadingError(f"{label}: the file must be a whole array of numbers or texts, got {reason}") from None
    if array.dtype.names:
        return pd.DataFrame({name: array[name].ravel().tolist() for name in array.dtype.names}), True
    if array.ndim not in (1, 2) or not array.size:
        raise ReadingError(f"{label}: the array must have one or two dimensions, got the shape {list(array.shape)}")
    if array.dtype.kind not in "biuU" and not (array.dtype.kind == "f" and _are_whole(array)):
        raise ReadingError(f"{label}: the array must hold labels, whole numbers or texts, got {array.dtype}")
    return pd.DataFrame(array), False


def _are_whole(array: Any) -> bool:
    numbers = array[~np.isnan(array)]
    return bool((numbers % 1 == 0).all())


def read_json(text: str, label: str) -> tuple[pd.DataFrame, bool]:
    """Return a JSON document as a frame, and whether it names its columns.

    Records are rows, as are the lines of JSON Lines. An object of lists is a table, if two of its keys are usual names
    of columns; else each key is a recording, with its labels. What stands alone in an object is taken out of it.

    Raises:
        ReadingError: no whole JSON, or none of these forms.
    """
    try:
        document = json.loads(text)
    except RecursionError:
        raise ReadingError(f"{label}: the JSON must hold {JSON_FORMS}, got one nested too deep") from None
    except ValueError as error:
        try:
            document = [json.loads(line) for line in text.splitlines() if line.strip()]
        except ValueError:
            raise ReadingError(f"{label}: the file must be whole JSON, got {error}") from None
    if isinstance(document, dict) and document:
        if _are_bouts(document):
            return pd.DataFrame(_rows_of_bouts(document)), True
        if all(map(_are_bouts, document.values())):
            rows = [{"recording": name} | row for name, bouts in document.items() for row in _rows_of_bouts(bouts)]
            return pd.DataFrame(rows), True
    while (
        isinstance(document, dict)
        and len(document) == 1
        and isinstance(member := next(iter(document.values())), dict | list)
    ):
        document = member
    if isinstance(document, dict) and {"columns", "data"} <= document.keys():
        try:
            return pd.DataFrame(document["data"], columns=document["columns"]), True
        except (TypeError, ValueError) as error:
            raise ReadingError(f"{label}: the JSON's `data` must fit its `columns`, got {error}") from None
    if isinstance(document, dict) and {"schema", "data"} <= document.keys():
        document = document["data"]
    members = [*document.values()] if isinstance(document, dict) else document if isinstance(document, list) else []
    if members and all(isinstance(one, dict) for one in members):
        frame = _frame_of_records(members, label) if members is document else pd.DataFrame(document)
        if not frame.map(lambda cell: isinstance(cell, dict | list)).any(axis=None):
            return frame, True
    if members and all(map(_are_labels, members)):
        if members is document:
            return _frame_of_lists(members, label), False
        is_table = len(set(map(len, members))) == 1 and sum(plain(name) in KNOWN_NAMES for name in document) > 1
        records = [{"recording": name, "behaviour": labels} for name, labels in document.items()]
        return (pd.DataFrame(document) if is_table else _frame_of_records(records, label)), True
    if members is document and _are_labels(members):
        return pd.DataFrame({0: members}), False
    raise ReadingError(f"{label}: the JSON must hold {JSON_FORMS}, got another form")


def _are_bouts(value: Any) -> bool:
    """Return whether a value is an object of lists, by behaviour, of starts with their stops."""
    lists = isinstance(value, dict) and all(isinstance(spans, list) for spans in value.values())
    spans = [span for spans in value.values() for span in spans] if lists else []
    return bool(spans) and all(
        isinstance(span, list) and len(span) == 2 and all(isinstance(end, int | float | None) for end in span)
        for span in spans
    )


def _rows_of_bouts(bouts: dict[str, list[list[float | None]]]) -> list[dict[str, Any]]:
    return [
        {"behaviour": behaviour, "start": start, "stop": stop}
        for behaviour, spans in bouts.items()
        for start, stop in spans
    ]


def _are_labels(value: Any) -> bool:
    return isinstance(value, list) and not any(isinstance(one, dict | list) for one in value)


def _frame_of_records(records: list[dict[str, Any]], label: str) -> pd.DataFrame:
    """Return a row a record: objects inside become columns, and lists of labels numbered columns."""
    frame = pd.json_normalize(records, sep=" ")
    for name in list(frame.columns):
        is_list = frame[name].map(lambda value: isinstance(value, list))
        if not is_list.any():
            continue
        lists = [value if isinstance(value, list) else [] for value in frame[name]]
        if not all(map(_are_labels, lists)):
            raise ReadingError(f"{label}: the JSON must hold {JSON_FORMS}, got deeper lists in {name!r}")
        wide = _frame_of_lists(lists, label)
        wide = wide.set_axis([f"{name} {number}" for number in range(1, 1 + wide.shape[1])], axis=1)
        frame = frame.drop(columns=name).join(wide)
    return frame


def _frame_of_lists(lists: list[list[Any]], label: str) -> pd.DataFrame:
    """Return a row a list, filled up with None."""
    longest, total = max(map(len, lists)), sum(map(len, lists))
    if grows_too_much(longest * len(lists), total):
        raise ReadingError(f"{label}: lists must be of similar lengths, got {longest:,} of {total:,} labels in one")
    return pd.DataFrame([*zip(*zip_longest(*lists), strict=True)], dtype=object)
