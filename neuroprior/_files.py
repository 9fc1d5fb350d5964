"""Writing results: CSV and JSON, each to a temporary name first and renamed when whole."""

import json
import math
import os
import platform
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any

from neuroprior._version import __version__

MISSING_LABELS = (
    "", "nan", "na", "n/a", "n.a.", "<na>", "null", "?", "-", "#n/a", "#value!", "#ref!", "#name?", "#div/0!",
    "#num!",
)  # fmt: skip
"""What stands for no label in tables, in lower case."""


FORMULA = re.compile(r"'*[=+@\t\r-]")
"""How a cell begins that a spreadsheet takes for a formula; an apostrophe before it says that it is a text."""


def quote_cell(text: str) -> str:
    """Returns a name as a cell of a CSV file: an apostrophe before what would be a formula. Numbers stay as they are.

    Example:
        >>> quote_cell("=1+1"), quote_cell("-1"), quote_cell("rest")
        ("'=1+1", '-1', 'rest')
    """
    return f"'{text}" if FORMULA.match(text) and _is_text(text.lstrip("'")) else text


def unquote_cell(text: str) -> str:
    """Returns the name that `quote_cell` wrote as a cell.

    Example:
        >>> unquote_cell("'=1+1"), unquote_cell("'tis")
        ('=1+1', "'tis")
    """
    return text[1:] if text.startswith("'") and quote_cell(text[1:]) == text else text


def quote_frame(frame: Any) -> Any:
    """Returns a frame of pandas with its names, in cells and of columns, as `quote_cell` writes them."""

    def cell(value: Any) -> Any:
        return quote_cell(value) if isinstance(value, str) else value

    return frame.apply(lambda column: column.map(cell) if column.dtype.kind == "O" else column).rename(columns=cell)


def _is_text(text: str) -> bool:
    """Whether a cell is neither a number nor what stands for no label."""
    try:
        float(text)
    except ValueError:
        return text.strip().lower() not in MISSING_LABELS
    return False


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write an object as JSON; numbers that are not finite, which JSON does not have, become null."""
    write_whole(path, json.dumps(_finite(content), indent=2, allow_nan=False).encode() + b"\n")


def read_json(path: Path) -> Any:
    """What a file of JSON holds.

    Raises:
        ValueError: it is not JSON.
        OSError: the file cannot be read.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not JSON ({error})") from error


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all; see `written_whole`."""
    with written_whole(path, "wb") as file:
        file.write(content)


@contextmanager
def written_whole(path: Path, mode: str = "w") -> Iterator[IO[Any]]:
    """A file opened for writing beside its place, and moved there when the block ends without an error.

    Raises:
        ValueError: the place is a directory.
        OSError: the file cannot be written.
    """
    if path.is_dir():
        raise ValueError(f"{path}: a directory; the name of a file is expected")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")  # another process may write the same file
    text = {} if "b" in mode else {"encoding": "utf-8", "newline": ""}
    try:
        with open(partial, mode, **text) as file:  # type: ignore[call-overload]
            yield file
        os.replace(partial, path)
    except OSError as error:
        # A full disk error does not name the file, and that of an encoder has no number.
        if error.errno is None:
            raise OSError(f"{path}: {error}") from error
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def versions(*more: str) -> dict[str, str]:
    """The versions that results depend on, with those of more packages; without those that are not installed."""
    found = {"neuroprior": __version__, "python": platform.python_version()}
    for name in ("torch", "numpy", "scipy", "lightning", "numba", *more):
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
