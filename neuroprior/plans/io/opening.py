"""Opening files of plans: what cannot be one is refused in one line."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


def check_file(path: Path) -> None:
    """Raise FileNotFoundError for no file, ValueError for a directory or an empty file."""
    if path.is_dir():
        raise ValueError(f"{path}: a directory; a file of plans is expected")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: an empty file; plans are expected")


@contextmanager
def open_text(path: Path) -> Iterator[IO[str]]:
    """A UTF-8 file, with or without a byte order mark, opened for reading; line ends are left as they are.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a directory, an empty file or one that is not UTF-8; the message names the line and the byte.
    """
    check_file(path)
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            yield file
    except UnicodeDecodeError:
        raise ValueError(_where_not_utf8(path)) from None


def _where_not_utf8(path: Path) -> str:
    # The decoder counts bytes from the start of its buffer: only a second look tells where in the file they are.
    with open(path, "rb") as file:
        for number, line in enumerate(file, 1):
            try:
                line.decode("utf-8")
            except UnicodeDecodeError as error:
                return f"{path}, line {number}: byte {error.start + 1} of the line is not UTF-8; save the file as UTF-8"
    return f"{path}: not UTF-8; save the file as UTF-8"
