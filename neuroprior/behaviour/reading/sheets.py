"""Files as sheets of text: formats, encodings, separators, headers and what stands above them."""

import csv
import datetime
import glob
import gzip
import io
import os
import re
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neuroprior._files import unquote_cell
from neuroprior.behaviour.reading.documents import check_format, read_array, read_json
from neuroprior.behaviour.reading.names import KNOWN_NAMES, PROGRAMS, STEM_NUMBER, plain
from neuroprior.behaviour.reading.problems import ReadingError

SEPARATORS = (",", ";", "\t", "|")
NAMED_SEPARATOR = re.compile(r'"?sep=(.)"?\s*', re.IGNORECASE)
"""A first line that names the separator for spreadsheets, such as `sep=;`."""

MAX_LINES_ABOVE = 100
"""Lines at most, from the beginning of a file, that may be its header."""

TABLE_SUFFIXES = (
    ".csv",
    ".tsv",
    ".txt",
    ".tab",
    ".xlsx",
    ".xls",
    ".ods",
    ".parquet",
    ".feather",
    ".h5",
    ".xes",
    ".json",
    ".npy",
)
"""Suffixes of the files of a folder that are read; .gz or .zip may follow."""

HEADER_LINES = re.compile(r"number of header lines:?", re.IGNORECASE)
NUMBER = re.compile(r"\s*[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?\s*")


@dataclass
class Sheet:
    """A table of text.

    Attributes:
        name: of the file, and of the sheet in it; for messages.
        stem: what the recording is called where no column says it.
        frame: a pandas frame of texts without space at their ends, "" where one is empty; no two columns share a name.
        lines: int `[rows]`, the number of each row in the file.
        header: whether the file names its columns; else they are numbered from 1.
        above: values of the "name, value" lines above the header, by name.
        separator: between cells; "" where the file is no text.
        notes: what a user should know of how it was read.
        is_file: whether rows are numbered as lines of a file.
        of_workbook: whether other sheets of the same file may hold something else.
    """

    name: str
    stem: str
    frame: Any
    lines: NDArray[np.int64]
    header: bool = True
    above: dict[str, str] = field(default_factory=dict)
    separator: str = ""
    notes: list[str] = field(default_factory=list)
    is_file: bool = True
    of_workbook: bool = False

    def place(self, row: int) -> str:
        """Return where a row stands, for messages."""
        return f"{self.name}, {'line' if self.is_file else 'row'} {self.lines[row]}"


def find_files(path: str | os.PathLike[str]) -> list[Path]:
    """Return the files of a path, a folder or a glob, in order.

    Raises:
        FileNotFoundError: there is no such file.
        ReadingError: a folder without tables.
    """
    path = Path(path)
    if path.is_dir():
        inside = [file for file in path.rglob("*") if _is_table(file)]
        files = sorted(file for file in inside if not _is_hidden(file.relative_to(path)))
        if not files:
            raise ReadingError(f"{path}: the folder must hold tables ({', '.join(TABLE_SUFFIXES)}), got none")
        return files
    if path.exists() or not glob.has_magic(str(path)):
        path.stat()
        return [path]
    matches = sorted(set(map(Path, glob.glob(str(path), recursive=True))))
    if not matches:
        raise FileNotFoundError(2, "No such file or directory", str(path))
    return [file for file in matches if file.is_file()]


def _is_hidden(path: Path) -> bool:
    """Return whether a path leads through what systems keep for themselves."""
    return any(part == "__MACOSX" or (part[0] == "." and part != "..") for part in path.parts)


def _is_table(file: Path) -> bool:
    name = file.name.lower().removesuffix(".gz").removesuffix(".zip")
    return file.is_file() and not name.startswith((".", "~")) and name.endswith(TABLE_SUFFIXES)


def read_sheets(path: Path, wanted: Sequence[str]) -> list[Sheet]:
    """Return the sheets of a file; a table of text has one.

    Args:
        path: the file.
        wanted: names of columns that the user gave; they tell the header.

    Raises:
        ReadingError: an empty file, or one that is no table.
    """
    content = path.read_bytes()
    if not content.strip():
        raise ReadingError(f"{path}: the file must hold a table, got an empty file")
    return list(_sheets_of_bytes(content, path.name, str(path), wanted))


def _sheets_of_bytes(content: bytes, name: str, label: str, wanted: Sequence[str]) -> Iterator[Sheet]:
    stem = re.sub(r"\.(gz|zip)$", "", name, flags=re.IGNORECASE)
    stem = stem.rpartition(".")[0] or stem
    if content[:2] == b"\x1f\x8b":
        try:
            content = gzip.decompress(content)
        except (OSError, EOFError) as error:
            raise ReadingError(f"{label}: the file must be a whole gzip archive, got one cut off ({error})") from None
        yield from _sheets_of_bytes(content, re.sub(r"\.gz$", "", name, flags=re.IGNORECASE), label, wanted)
    elif content[:4] == b"PK\x03\x04":
        yield from _sheets_of_zip(content, name, label, stem, wanted)
    elif content[:8] == b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1":
        yield from _sheets_of_workbook(content, label, stem, wanted)
    elif content[:4] == b"PAR1" or content[:6] == b"ARROW1":
        read = pd.read_parquet if content[:4] == b"PAR1" else pd.read_feather
        yield sheet_of_frame(_read_by_pandas(label, read, io.BytesIO(content)), label, stem)
    elif content[:8] == b"\x89HDF\r\n\x1a\n":
        yield sheet_of_frame(_read_by_pandas(label, pd.read_hdf, label), label, stem)
    elif content[:6] == b"\x93NUMPY":
        yield _sheet_of_document(*read_array(content, label), label, stem)
    elif content.lstrip()[:5] == b"<?xml" and b"<log" in content[:2000]:
        yield _sheet_of_xes(content, label, stem)
    elif content.lstrip()[:9].lower().startswith((b"<!doctype", b"<html", b"<?xml")):
        raise ReadingError(f"{label}: the file must be a table, got a web page or XML")
    elif _is_json(content, name):
        yield _sheet_of_document(*read_json(_decode(content, label)[0], label), label, stem)
    else:
        check_format(content, label)
        yield _sheet_of_text(content, label, stem, wanted)


def _is_json(content: bytes, name: str) -> bool:
    return name.lower().endswith(".json") or re.match(rb"\s*[\[{]\s*[\[{\"]", content) is not None


def _sheet_of_document(frame: pd.DataFrame, header: bool, label: str, stem: str) -> Sheet:
    sheet = sheet_of_frame(frame, label, stem)
    return sheet if header else _number_columns(sheet)


def _number_columns(sheet: Sheet) -> Sheet:
    """Return a sheet whose file does not name its columns: they are numbered from 1."""
    sheet.header = False
    sheet.notes.append(f"{sheet.name} has no header; its columns are numbered from 1")
    sheet.frame.columns = pd.Index([f"column {i + 1}" for i in range(sheet.frame.shape[1])])
    return sheet


def _read_by_pandas(label: str, read: Any, source: Any, **options: Any) -> Any:
    """Return what a reader of pandas returns that may need an extra, with errors of one line."""
    try:
        return read(source, **options)
    except ImportError as error:
        raise ImportError(f"{label}: {error} (pip install 'neuroprior[tables]' for Excel and Parquet)") from error
    except Exception as error:  # the libraries raise a dozen kinds over damaged bytes
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ReadingError(f"{label}: the file must be a whole table, got one that cannot be read ({reason})") from None


def _sheets_of_zip(content: bytes, name: str, label: str, stem: str, wanted: Sequence[str]) -> Iterator[Sheet]:
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
        members = [member for member in archive.namelist() if not member.endswith("/")]
        kind = archive.read("mimetype") if "mimetype" in members else b""
    except (zipfile.BadZipFile, EOFError) as error:
        raise ReadingError(f"{label}: the file must be a whole zip archive or workbook, got {error}") from None
    if "[Content_Types].xml" in members or b"opendocument" in kind:
        yield from _sheets_of_workbook(content, label, stem, wanted)
        return
    tables = [member for member in members if not _is_hidden(Path(member))]
    if not tables:
        raise ReadingError(f"{label}: the archive must hold tables, got none")
    number = Counter(Path(member).name for member in tables)
    for member in tables:
        called = label if len(tables) == 1 else f"{label}, {member}"
        table_name = Path(member).name if number[Path(member).name] == 1 else member
        yield from _sheets_of_bytes(archive.read(member), table_name, called, wanted)


def _sheets_of_workbook(content: bytes, label: str, stem: str, wanted: Sequence[str]) -> Iterator[Sheet]:
    options = {"sheet_name": None, "header": None, "dtype": object, "engine": "calamine"}
    pages = _read_by_pandas(label, pd.read_excel, io.BytesIO(content), **options)
    filled = {name: page for name, page in pages.items() if page.notna().any(axis=None)}
    if not filled:
        raise ReadingError(f"{label}: the workbook must hold a table, got empty sheets")
    for name, page in filled.items():
        cells = pd.DataFrame({i: _texts(page.iloc[:, i]) for i in range(page.shape[1])})
        called, page_stem = (label, stem) if len(filled) == 1 else (f"{label}, sheet {name!r}", str(name))
        sheet = _sheet_of_cells(cells, np.arange(1, len(cells) + 1), called, page_stem, "", wanted)
        sheet.of_workbook = len(filled) > 1
        yield sheet


def _sheet_of_xes(content: bytes, label: str, stem: str) -> Sheet:
    """Return an event log in XML as a table: one row an event, with the attributes of its case as `case:...`."""
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise ReadingError(f"{label}: the file must be whole XML, got {error}") from None
    rows = []
    for trace in root.iterfind("{*}trace"):
        case = {f"case:{item.get('key')}": item.get("value", "") for item in trace if "key" in item.attrib}
        for event in trace.iterfind("{*}event"):
            rows.append(case | {str(item.get("key")): item.get("value", "") for item in event})
    if not rows:
        raise ReadingError(f"{label}: the event log must hold events, got none")
    frame = pd.DataFrame(rows, dtype=object).fillna("")
    return Sheet(label, stem, frame, np.arange(1, len(frame) + 1), is_file=False)


def sheet_of_frame(frame: pd.DataFrame, name: str = "table", stem: str = "table") -> Sheet:
    """Return a pandas frame as a sheet; an index with names becomes columns.

    Raises:
        ReadingError: a file that holds no frame.
    """
    if not isinstance(frame, pd.DataFrame):
        raise ReadingError(f"`paths` must be files or pandas frames, got {type(frame).__name__}")
    if isinstance(frame.index, pd.DatetimeIndex | pd.TimedeltaIndex) and frame.index.name is None:
        frame = frame.rename_axis("time")
    if any(level is not None for level in frame.index.names):
        frame = frame.reset_index()
    if isinstance(frame.columns, pd.MultiIndex):
        frame = frame.set_axis([" ".join(map(str, filter(None, one))) for one in frame.columns], axis=1)
    columns = _distinct_names([_cell(column) for column in frame.columns])
    texts = pd.DataFrame({new: _texts(frame.iloc[:, i]) for i, new in enumerate(columns)})
    return Sheet(name, stem, texts, np.arange(len(frame)), is_file=False)


def _texts(column: "pd.Series[Any]") -> "pd.Series[Any]":
    """Return the cells as texts without space at their ends, "" for an empty cell."""
    codes, values = pd.factorize(column.astype(object))
    texts = np.array([*map(_cell, values), ""], dtype=object)
    return pd.Series(texts[codes], dtype=object)


def _cell(value: Any) -> str:
    if isinstance(value, bool | np.bool_):
        return str(int(value))
    if isinstance(value, float | np.floating):
        return "" if np.isnan(value) else str(int(value)) if float(value).is_integer() else repr(float(value))
    if isinstance(value, datetime.timedelta | np.timedelta64):
        return repr(pd.Timedelta(value).total_seconds())
    if isinstance(value, np.datetime64):
        value = pd.Timestamp(value)
    if isinstance(value, datetime.datetime):
        return value.isoformat(sep=" ")
    return "" if value is None or value is pd.NaT or value is pd.NA else str(value).strip()


def _sheet_of_text(content: bytes, label: str, stem: str, wanted: Sequence[str]) -> Sheet:
    text, notes = _decode(content, label)
    lines = text.split("\n")
    if first_line := re.fullmatch(r"FirstLineOfData=(\d+)", lines[0].strip()):
        return _sheet_of_jwatcher(lines, int(first_line[1]), label, stem)
    first = NAMED_SEPARATOR.fullmatch(lines[0])
    separator = first[1] if first else _separator(lines[: MAX_LINES_ABOVE + 200], wanted)
    skipped = 1 if first else 0
    if separator == " ":  # columns that are aligned by several spaces or tabs
        text = "\n".join(re.sub(r"[ \t]+", " ", line.strip()) for line in lines)
        lines = text.split("\n")
    width = max(line.count(separator) for line in lines) + 1
    options: dict[str, Any] = {"header": None, "names": range(width), "dtype": object, "keep_default_na": False}
    try:
        cells = pd.read_csv(
            io.StringIO(text), sep=separator, skiprows=skipped, skip_blank_lines=False, index_col=False, **options
        )
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        what = "a quote that is not closed" if "inside string" in str(error) else f"another text ({error})"
        raise ReadingError(f"{label}: the file must be a table, got {what}") from None
    for column in cells:
        cells[column] = _strip(cells[column])
    numbers = np.arange(len(cells)) + 1 + skipped
    if '"' in text:  # a quoted cell may go over several lines
        inside = sum(cells[column].str.count("\n").to_numpy(np.int64, na_value=0) for column in cells)
        numbers = numbers + np.cumsum(inside) - inside if np.any(inside) else numbers
    sheet = _sheet_of_cells(cells, numbers, label, stem, separator, wanted)
    sheet.notes += notes
    return sheet


def _sheet_of_jwatcher(lines: list[str], first: int, label: str, stem: str) -> Sheet:
    """Return a focal data file of JWatcher: milliseconds and the key that was pressed; EOF ends it."""
    pairs = [
        (number, _cells_of_line(line, ",")) for number, line in enumerate(lines[first - 1 :], first) if line.strip()
    ]
    rows = [(number, pair) for number, pair in pairs if len(pair) == 2 and pair[1] != "EOF"]
    frame = pd.DataFrame([pair for _, pair in rows], columns=["time (ms)", "behaviour"], dtype=object)
    notes = [f"{label} is read as a focal data file of JWatcher: when keys were pressed, in milliseconds"]
    return Sheet(label, stem, frame, np.array([number for number, _ in rows], np.int64), notes=notes)


def _strip(column: "pd.Series[Any]") -> "pd.Series[Any]":
    """Return cells of text without space around them, and names as they were before they were written."""
    codes, values = pd.factorize(column)
    texts = np.array([unquote_cell(str(value).strip()) for value in values], dtype=object)
    return pd.Series(texts[codes], dtype=object)


def _decode(content: bytes, label: str) -> tuple[str, list[str]]:
    """Return the text of a file, and a note if its encoding was guessed."""
    head = content[:200]
    notes: list[str] = []
    if content[:4] in (b"\xff\xfe\x00\x00", b"\x00\x00\xfe\xff"):
        encoding = "utf-32"
    elif content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encoding = "utf-16"
    elif b"\0" in head and len(head) > 3:  # without a mark: every second byte of ASCII is zero
        odd, even = head[1::2].count(0), head[::2].count(0)
        if min(odd, even) * 4 > max(odd, even) or max(odd, even) * 4 < len(head):
            raise ReadingError(f"{label}: the file must be a table of text, got binary data")
        encoding = "utf-16-le" if odd > even else "utf-16-be"
    else:
        encoding = "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:
        if encoding != "utf-8-sig":
            raise ReadingError(f"{label}: the file must be whole {encoding.upper()}, got one that is cut off") from None
        text = content.decode("cp1252", errors="replace")
        notes = [f"{label} is not UTF-8, and is read as Windows-1252 (Western European)"]
    if "\0" in text:
        raise ReadingError(f"{label}: the file must be a table of text, got binary data")
    return text.replace("\r\n", "\n").replace("\r", "\n").rstrip("\n"), notes


def _cells_of_line(line: str, separator: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:
        return []


def _separator(lines: Sequence[str], wanted: Sequence[str]) -> str:
    """Return the separator by which the lines have most cells, equally many in each.

    What counts first is the number of usual or wanted names in one line.
    """
    lines = [line for line in lines if line.strip()]
    names = KNOWN_NAMES | {plain(name) for name in wanted}
    best, best_rank = ",", (-1.0, -1.0)
    for separator in (*SEPARATORS, " "):
        rows = [_cells_of_line(line, separator) if separator != " " else line.split() for line in lines]
        sizes = Counter(map(len, rows))
        width, times = max(sizes.items(), key=lambda item: (item[1] * (item[0] > 1), item[0]))
        named = max(sum(plain(cell) in names for cell in row) if len(row) > 1 else 0 for row in rows)
        regular = times / len(rows) if width > 1 else 0.0
        if separator == " " and (regular < 1 or best_rank > (0, 0.5)):
            continue
        last = rows[-1] if width > 1 else []
        numbers = sum(map(_is_number, last)) / max(len(last), 1)
        rank = (float(named), regular * min(width, 50) ** 0.1 + 0.5 * numbers)
        if width > 1 and rank > best_rank:
            best, best_rank = separator, rank
    return best


def _sheet_of_cells(
    cells: Any, lines: NDArray[Any], name: str, stem: str, separator: str, wanted: Sequence[str]
) -> Sheet:
    """Return a sheet of rows of cells, with its header and without the lines above it."""
    filled = cells.ne("").any(axis=1).to_numpy()
    cells, lines = _drop_empty_columns(cells[filled]), np.asarray(lines)[filled]
    comment = cells[0].str.startswith("\\").to_numpy()  # the frequencies of Audacity's labels
    if comment.any() and not comment.all():
        cells, lines = cells[~comment].reset_index(drop=True), lines[~comment]
    remark = cells[0].str.startswith("#").to_numpy()
    remarks = int(np.argmin(remark)) if remark.any() and not remark.all() else 0
    sizes = cells.iloc[:2].ne("").sum(axis=1).tolist()
    is_header = remarks == 1 and sizes[0] > 1 and sizes[0] == sizes[1]  # such as "#,animal,behaviour"
    if remarks and not is_header:
        cells, lines = _drop_empty_columns(cells.iloc[remarks:]), lines[remarks:]
    sheet = Sheet(name, stem, cells, lines, separator=separator)
    top = cells.head(MAX_LINES_ABOVE).to_numpy(dtype=object).tolist()
    at, header = _find_header(top, cells, wanted)
    sheet.above = {row[0].rstrip(":"): row[1] for row in top[:at] if row[0] and len(row) > 1}
    if at:
        sheet.notes.append(f"the header of {name} is line {lines[at]}; what is above it is not read as rows")
    if header is None:
        sheet.frame = cells.iloc[at:].reset_index(drop=True)
        sheet.lines = lines[at:]
        return _number_columns(sheet)
    body = cells.iloc[at + 1 :].reset_index(drop=True)
    width = max((i for i, cell in enumerate(header, 1) if cell), default=0)
    surplus = body.iloc[:, width:]
    if surplus.shape[1] and surplus.ne("").any(axis=None):
        if surplus.shape[1] == 1 and surplus.ne("").all(axis=None) and header[0]:
            header = ["", *header]  # R writes the names of rows without a name of their column
        else:
            rows = np.flatnonzero(surplus.ne("").any(axis=1).to_numpy())
            if len(rows) < 0.5 * len(body):
                line = lines[at + 1 :][rows[0]]
                size = width + int((surplus.iloc[rows[0]] != "").to_numpy().nonzero()[0].max()) + 1
                raise ReadingError(
                    f"{name}, line {line}: a row must have {width} cells, as many as the header, got {size}"
                    f" ({len(rows):,} such rows); quote cells that hold {separator!r}"
                )
    sheet.frame = body.set_axis(
        _distinct_names([*header, *[""] * (body.shape[1] - len(header))][: body.shape[1]]), axis=1
    )
    sheet.lines = lines[at + 1 :]
    return sheet


def _drop_empty_columns(cells: Any) -> Any:
    cells = cells.loc[:, cells.ne("").any(axis=0)].reset_index(drop=True)
    return cells.set_axis(pd.RangeIndex(cells.shape[1]), axis=1)


def _distinct_names(names: Iterable[str]) -> list[str]:
    """Return names of columns that differ: empty ones become their position, repeated ones get a number."""
    distinct: list[str] = []
    for i, name in enumerate(names):
        name = name or f"(column {i + 1})"
        new, number = name, 2
        while new in distinct:
            new, number = f"{name} ({number})", number + 1
        distinct.append(new)
    return distinct


def _find_header(top: list[list[str]], cells: Any, wanted: Sequence[str]) -> tuple[int, list[str] | None]:
    """Return the position of the header and its cells; None for the cells where the file has none.

    The header is the line with most of the wanted names; else the line that the file itself says; else a known
    program's; else the first line that is as wide as the table, if it is unlike the rows below it.
    """
    plains = [[plain(cell) for cell in row] for row in top]
    if wanted:
        asked = {plain(name) for name in wanted}
        ranks = [(len(asked & set(row)), sum(name in KNOWN_NAMES for name in row if name)) for row in plains]
        if max(ranks, default=(0, 0))[0]:
            at = ranks.index(max(ranks))
            return at, top[at]
    for row in top[:MAX_LINES_ABOVE]:
        if HEADER_LINES.fullmatch(row[0]) and len(row) > 1 and row[1].isdecimal():
            at = _header_of_ethovision(top, int(row[1]))
            return at, top[at]
    for at, row in enumerate(plains):
        if any(program.needs <= set(row) for program in PROGRAMS):
            return at, top[at]
    widths = np.array([max((i for i, cell in enumerate(row, 1) if cell), default=0) for row in top])
    name_counts = [sum(name in KNOWN_NAMES for name in row) for row in plains]
    rows = widths[len(widths) // 2 :]
    usual = int(np.bincount(rows[rows > 0]).argmax()) if rows.size else 0
    for at, row in enumerate(top):
        words = [cell for cell in row if cell]
        if name_counts[at] < 2 and (len(set(words)) < len(words) or (widths[at] < max(usual - 2, 2) and usual > 1)):
            continue
        above = at > 0 and not _is_header(row, cells, at) and name_counts[at] < 2
        if above and widths[at] >= usual:
            break
        if _is_header(row, cells, at):
            return at, row
        if widths[at] >= usual:
            break
    start = next((i for i, width in enumerate(widths) if width >= min(usual, 2)), 0)
    return (start if start < 3 else 0), None


def _header_of_ethovision(top: list[list[str]], count: int) -> int:
    """Return the position of EthoVision's header: the last line but one of those it counts, before the units."""
    timed = [i for i, row in enumerate(top) if {"trial time", "recording time"} & set(map(plain, row))]
    return next((at for at in (count - 2, count - 1, *timed) if at in timed), 0)


def _is_header(row: list[str], cells: Any, at: int) -> bool:
    """Return whether a line names columns: by usual names, by its numbers, or since it is unlike the rows below."""
    words = [cell for cell in row if cell]
    if not words:
        return False
    if sum(plain(cell) in KNOWN_NAMES for cell in words) >= min(2, len(words)) and not all(map(_is_number, words)):
        return True
    if len(set(words)) < len(words):
        return False
    all_numbers = all(map(_is_number, words))
    if any(re.fullmatch(r"-?\d+[.,]\d+|\d+:\d\d(:\d\d.*)?", word) for word in words) and not all_numbers:
        return False  # a time among words is data
    below = cells.iloc[at + 1 :]
    if not len(below):
        return not any(map(_is_number, words))
    if all_numbers:
        likely = not row[0] or float(words[0].replace(",", ".")) in (0, 1) or len(words) > 5
        return len(words) > 2 and _count_up(words) and not _count_up(below.iloc[0]) and likely
    numbered = [STEM_NUMBER.fullmatch(word) for word in words]
    stems = Counter(match[1] for match in numbered if match)
    if stems and max(stems.values()) > max(2, len(words) // 2):
        return True
    for i, cell in enumerate(row):
        column = below.iloc[:, i]
        column = column[column != ""]
        if cell and not _is_number(cell) and len(column) > 1 and column.map(_is_number).all():
            return True
    values = set(pd.unique(below.iloc[:10_000].to_numpy(dtype=object).ravel()))
    return not values & set(words) and len(values) < max(3, len(below)) * below.shape[1]


def _count_up(row: Iterable[str]) -> bool:
    """Return whether the filled cells of a row are numbers that count up by one."""
    words = [cell for cell in row if cell]
    if not words or not all(map(_is_number, words)):
        return False
    numbers = [float(word.replace(",", ".")) for word in words]
    return all(b - a == 1 for a, b in pairwise(numbers))


def _is_number(text: str) -> bool:
    return NUMBER.fullmatch(text) is not None
