"""How long work takes, in `python -m eval bench`."""

import subprocess
import sys
import time
from statistics import median

from eval.bench.packages import Run


def seconds(run: Run) -> float:
    """How long it takes."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def seconds_again(run: Run, repetitions: int) -> float:
    """How long it takes, the median; what is first is slow, and does not count."""
    run()
    return median(seconds(run) for _ in range(repetitions))


def import_seconds(package: str) -> float:
    """How long it takes to import a package, in a process of its own."""
    code = f"import time; begin = time.perf_counter(); import {package}; print(time.perf_counter() - begin)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout)
