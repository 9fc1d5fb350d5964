"""Files: CSV and JSON, each written to a temporary name first and renamed when whole; and what is too large to read."""

import errno
import json
import math
import os
import platform
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from secrets import token_hex
from typing import IO, Any

from neuroprior._version import __version__

PARTIAL = ".partial"
"""The ending of temporary files."""

MISSING_LABELS = (
    "", "nan", "na", "n/a", "n.a.", "<na>", "null", "?", "-", "#n/a", "#value!", "#ref!", "#name?", "#div/0!",
    "#num!",
)  # fmt: skip
"""What stands for no label in tables, in lower case."""


MAX_GROWTH, SMALL_BYTES = 100, 2**28
"""Data that take more memory than this many times what they hold are refused, unless they take few bytes."""

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
    except (ValueError, RecursionError) as error:
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
    """A file opened for writing beside its place, and moved there when the block ends without an error."""
    text = {} if "b" in mode else {"encoding": "utf-8", "newline": ""}
    with replacing(path) as partial, open(partial, mode, **text) as file:  # type: ignore[call-overload]
        yield file


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new file of a random name beside `path`, which takes its place when the block ends without an error.

    It is locked as long as it is written: what is left by a process that was killed is told by that it is not, and
    `clear` removes it.

    Raises:
        ValueError: the place is a directory.
        OSError: the file cannot be written.
    """
    if path.is_dir():
        raise ValueError(f"{path}: a directory; the name of a file is expected")
    try:
        partial, descriptor = _new_partial(path.parent)
        try:
            yield partial
            os.replace(partial, path)
        finally:
            with suppress(OSError):
                partial.unlink()
            if descriptor is not None:
                os.close(descriptor)
    except OSError as error:
        # A full disk error does not name the file, and that of an encoder has no number.
        if error.errno is None:
            raise OSError(f"{path}: {error}") from error
        raise OSError(error.errno, error.strerror, str(path)) from error


def _new_partial(folder: Path) -> tuple[Path, int | None]:
    """A new file of a name that nobody can guess, and what holds its lock; None where open files cannot be renamed."""
    while True:
        partial = folder / f".{token_hex(8)}{PARTIAL}"
        descriptor = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if sys.platform == "win32":
            os.close(descriptor)
            return partial, None
        lock(descriptor)
        if is_at(descriptor, partial):
            return partial, descriptor
        os.close(descriptor)  # `clear` was faster


def clear(folder: Path) -> None:
    """Remove the temporary files in a folder whose writers were killed; those that are being written stay."""
    for path in folder.glob(f".*{PARTIAL}"):
        if re.fullmatch(rf"\.[0-9a-f]{{16}}{re.escape(PARTIAL)}", path.name) is None:
            continue
        with suppress(OSError):
            if sys.platform == "win32":  # where a file that is open cannot be removed
                path.unlink()
                continue
            descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
            try:
                if lock(descriptor):
                    path.unlink()
            finally:
                os.close(descriptor)


def lock(descriptor: int) -> bool | None:
    """Lock an open file until it is closed, also by the end of the process, however it ends.

    Returns:
        False where another one has locked it; None where its file system has no locks.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return False if error.errno in (errno.EAGAIN, errno.EACCES, errno.EDEADLK) else None
    return True


def is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the one at `path`."""
    with suppress(OSError):
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    return False


def versions(*more: str) -> dict[str, str]:
    """The versions that results depend on, with those of more packages; without those that are not installed."""
    installed = {"neuroprior": __version__, "python": platform.python_version()}
    for name in ("torch", "numpy", "scipy", "lightning", "numba", *more):
        with suppress(PackageNotFoundError):
            installed[name] = version(name)
    return installed


def grows_too_much(needed: int, held: int) -> bool:
    """Whether data of `held` bytes, or in a file of so many, must not take `needed` bytes of memory."""
    return needed > max(MAX_GROWTH * held, SMALL_BYTES)
