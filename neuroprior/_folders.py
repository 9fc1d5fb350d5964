"""A folder belongs to one run: it is claimed, cleared of what a killed run left, and knows which files are its own."""

import inspect
import json
import os
import platform
import random
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar, cast

from neuroprior._files import clear, is_at, lock, read_json, write_whole

F = TypeVar("F", bound=Callable[..., Any])

LOCK, FILES = ".neuroprior.lock", ".neuroprior.json"
"""In a folder: what its run holds locked, which goes with the run; and the names of the results there."""

SECONDS = 1.0
"""For which a run waits for a folder."""


class Claim:
    """A folder that a run has claimed; see `claim`.

    Attributes:
        folder: its path.
    """

    def __init__(self, folder: Path, replaces: bool, owns_all: bool, command: str) -> None:
        self.folder, self._replaces, self._owns_all, self._command = folder, replaces, owns_all, command

    def check(self, names: Iterable[str]) -> None:
        """Raise ValueError if a file of one of these names is there, and no earlier run wrote it as a result.

        Results of another command are those of somebody who may want to keep them.
        """
        self._check(names, *self._results())

    def _check(self, names: Iterable[str], results: set[str], command: str) -> None:
        if self._command and command not in ("", self._command) and any(map(self._is_there, results)):
            raise ValueError(
                f"`out` must be a folder without results of another command, got {self.folder}: {command}."
            )
        for name in names:
            if name not in results and not self._owns_all and self._is_there(name):
                raise ValueError(
                    f"`out` must be a folder without {name}, or with that of an earlier run, got {self.folder}."
                )

    def add(self, names: Iterable[str]) -> None:
        """Enter files that are written next as results of this run.

        The first ones take the place of all results that are there: these are removed, so that no two runs' results are
        mixed, whenever a run is killed.

        Raises:
            ValueError: see `check`.
        """
        names = {*names}
        if not names or self._owns_all:
            return
        results, command = self._results()
        self._check(names, results, command)
        if self._replaces:
            self._replaces = False
            for name in results:
                (self.folder / name).unlink(missing_ok=True)
            results = set()
        if not names <= results:
            content = json.dumps({"command": self._command, "files": sorted(results | names)}, indent=2) + "\n"
            write_whole(self.folder / FILES, content.encode())  # before the files: whoever is killed then owns them

    def _is_there(self, name: str) -> bool:
        return os.path.lexists(self.folder / name)

    def _results(self) -> tuple[set[str], str]:
        """The results that are there by the list in the folder, and the command that wrote them."""
        with suppress(OSError, ValueError, KeyError, TypeError):
            content = read_json(self.folder / FILES)
            files = {name for name in content["files"] if isinstance(name, str) and is_inside(name)}
            return files, str(content["command"])
        return set(), ""


def is_inside(name: str) -> bool:
    """Whether a name is that of a file in a folder, or in a folder of it."""
    path = Path(name)
    return not path.is_absolute() and ".." not in path.parts and len(path.parts) in (1, 2)


_claims = threading.local()


@contextmanager
def claim(
    folder: Path,
    *,
    replaces: bool = False,
    owns_all: bool = False,
    command: str = "",
    name: str = "out",
    seconds: float = SECONDS,
) -> Iterator[Claim]:
    """Claim a folder, which is made if need be; the thread that has claimed it may do so again, and shares its claim.

    The lock is the system's, which releases it however the process ends.

    Args:
        folder: where.
        replaces: the results of this run are to take the place of those of earlier ones, see `Claim.add`.
        owns_all: everything in the folder is the run's own.
        command: whose results these are; those of another command are not replaced.
        name: of the argument, for the message.
        seconds: for which to wait until another run has released the folder.

    Raises:
        ValueError: another run has claimed it.
        OSError: it cannot be written.
    """
    place, claims = os.path.realpath(folder), vars(_claims)
    if place in claims:
        yield claims[place]
        return
    new_folders = [one for one in (Path(place), *Path(place).parents) if not one.exists()]
    descriptor = _lock(Path(place), folder, name, seconds)
    claims[place] = Claim(folder, replaces, owns_all, command)
    try:
        clear(Path(place))
        yield claims[place]
    finally:
        del claims[place]
        with suppress(OSError):
            os.unlink(os.path.join(place, LOCK))  # still locked: who waits for it finds that it is another file
        os.close(descriptor)
        for one in new_folders:  # unless something was written there
            with suppress(OSError):
                one.rmdir()


def as_folder(name: str, value: object) -> Path:
    """Return the path of a folder.

    Args:
        name: of the argument, for the message.
        value: its value.

    Raises:
        ValueError: it names none; an empty name would be that of the present folder.
    """
    if not isinstance(value, str | os.PathLike) or not os.fspath(value).strip():
        got = repr(value) if isinstance(value, str) else type(value).__name__
        raise ValueError(f"`{name}` must be the name of a folder, got {got}")
    return Path(value)


def claim_out(function: F) -> F:
    """Let a function claim the folder that its argument `out` names while it runs, unless this is None.

    Its results take the place of those of earlier runs there.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def claiming(*positional: Any, **named: Any) -> Any:
        bound = signature.bind(*positional, **named)
        bound.apply_defaults()
        out = bound.arguments["out"]
        command = function.__name__
        with nullcontext() if out is None else claim(as_folder("out", out), replaces=True, command=command):
            return function(*positional, **named)

    return cast(F, claiming)


def _lock(place: Path, folder: Path, name: str, seconds: float) -> int:
    """A descriptor that holds the lock of a folder."""
    until = time.monotonic() + seconds
    while True:
        place.mkdir(parents=True, exist_ok=True)
        try:
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
            descriptor = os.open(place / LOCK, flags, 0o666)
        except FileNotFoundError:
            continue  # a run that failed has just removed its folder
        locked = lock(descriptor)
        if locked is None:
            message = f"{folder}: its file system has no locks; two runs that write there at a time are not told apart"
            warnings.warn(message, stacklevel=4)
            return descriptor
        if locked and is_at(descriptor, place / LOCK):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"process {os.getpid()} on {platform.node()}".encode())
            return descriptor
        owner = ""
        with suppress(OSError):  # Windows keeps others from reading what is locked
            owner = os.read(descriptor, 200).decode(errors="replace")
        os.close(descriptor)
        if not locked and time.monotonic() > until:
            raise ValueError(
                f"`{name}` must be a folder that no other run uses, got {folder}, in use by {owner or 'another run'}."
            )
        time.sleep(random.uniform(0.001, 0.01))
