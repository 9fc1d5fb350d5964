"""Ctrl-C while the libraries of a command load, which takes seconds: no traceback, exit code 130."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

MODULES = ("neuroprior", "neuroprior.__main__", "eval", "train")
"""What `python -m` runs as a command of this project."""


@contextmanager
def ending_at_interrupts() -> Iterator[None]:
    """Within, Ctrl-C ends a process that was started as one of our commands; all others are left alone."""
    answers = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not (answers and is_command(sys.orig_argv) and threading.current_thread() is threading.main_thread()):
        yield
        return
    signal.signal(signal.SIGINT, _end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def is_command(line: list[str]) -> bool:
    """Whether a command line, with the interpreter first, is that of one of our commands."""
    words = [*line[1:], ""]
    if "-m" in words:
        return words[words.index("-m") + 1] in MODULES
    return Path(words[0]).name == "neuroprior"


def _end(*_: object) -> None:
    # An exception may be lost in libraries that are half loaded.
    os.write(2, b"interrupted\n")
    os._exit(130)
