"""Jobs for tests of `neuroprior._jobs`; other processes import them from here."""

import os
import time
from pathlib import Path
from typing import Any


def square(job: int) -> dict[str, Any]:
    """The square of a number, and the process that found it."""
    return {"square": job * job, "process": os.getpid()}


def slow_square(job: int) -> dict[str, Any]:
    """The same, in half a second."""
    time.sleep(0.5)
    return square(job)


def fails_at_three(job: int) -> dict[str, Any]:
    """As `square`, but not for 3."""
    if job == 3:
        raise ValueError("three is\nno good")
    return square(job)


def counted(folder: Path, job: int) -> dict[str, Any]:
    """As `square`; leaves a trace in a folder each time it is called."""
    (folder / f"{job}-{time.monotonic_ns()}").touch()
    return square(job)


def dies(job: int) -> dict[str, Any]:
    """As if the system had killed the process."""
    os._exit(1)


def out_of_memory(job: int) -> dict[str, Any]:
    """What torch raises where memory runs out."""
    raise RuntimeError("DefaultCPUAllocator: not enough memory")
