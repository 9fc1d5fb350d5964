"""Programs that are interrupted or killed, with all processes that they started; for tests."""

import os
import signal
import subprocess
import time
from collections.abc import Callable


def wait_for(what: Callable[[], object], seconds: float = 120) -> None:
    """Wait until a condition holds."""
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until, "it takes too long"
        time.sleep(0.02)


def gone(leader: int) -> bool:
    """Whether no process of a session is left."""
    try:
        os.killpg(leader, 0)
    except ProcessLookupError:
        return True
    return False


def interrupted(running: subprocess.Popen[str], how: signal.Signals, once: Callable[[], object]) -> tuple[str, str]:
    """Stop a program that leads a session, once a condition holds, and wait until no process is left.

    Args:
        running: the program.
        how: SIGINT goes to the whole session, as from a terminal; another signal to the program alone.
        once: the condition.

    Returns:
        What it printed, and its errors.
    """
    try:
        wait_for(once)
        (os.killpg if how == signal.SIGINT else os.kill)(running.pid, how)
        output = running.communicate(timeout=60)
        wait_for(lambda: gone(running.pid), 60)
    finally:
        if not gone(running.pid):
            os.killpg(running.pid, signal.SIGKILL)
    return output
