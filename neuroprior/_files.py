"""Writing results: CSV and JSON, each to a temporary name first and renamed when whole."""

import json
import math
import os
import platform
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
