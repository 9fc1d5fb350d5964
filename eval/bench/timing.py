"""How long work takes, in `python -m eval bench`."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

Run = Callable[[], Any]
Rows = list[dict[str, Any]]


def seconds(run: Run) -> float:
    """How long it takes once."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def median_seconds(run: Run, repetitions: int) -> float:
    """How long it takes, the median; the first run, which is slow, does not count."""
    run()
    return median(seconds(run) for _ in range(repetitions))


def compared(ours: list[float], theirs: list[float]) -> dict[str, float]:
    """How many times as long the second of each pair of times is: median, least and most."""
    ratios = [second / first for first, second in zip(ours, theirs, strict=True)]
    return {"ratio": median(ratios), "low": min(ratios), "high": max(ratios)}


def import_times(repetitions: int) -> Rows:
    """The row of the time to import all names of the library, each time in a process of its own, as a ratio to that of
    torch. (`import neuroprior` itself leaves torch and all rooms for when they are needed.)

    Both are compiled to bytecode beforehand, as pip does when it installs a package.
    """
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}

    def import_seconds(code: str) -> float:
        code = f"import time; begin = time.perf_counter(); {code}; print(time.perf_counter() - begin)"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
        return float(done.stdout)

    times = [
        [import_seconds(code) for code in ("import torch", "from neuroprior import *")] for _ in range(repetitions + 1)
    ]
    torchs, ours = map(list, zip(*times[1:], strict=True))  # the first ones read files and write bytecode
    row = {"seconds": median(ours), "torch_seconds": median(torchs), **compared(torchs, ours)}
    return [row | {"goal": 1.1}]
