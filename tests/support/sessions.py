"""Programs that are interrupted or killed, with all processes that they started; for tests."""

import os
import signal
import subprocess
import time
from collections.abc import Callable


def wait_for(what: Callable[[], object], seconds: float = 120) -> None:
    """Wait until something is so."""
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
    """Stop a program that leads a session, once something is so, and wait until nobody is left behind.

    Args:
        running: the program.
        how: SIGINT, which all of the session get, as from a terminal; another signal is for the program alone.
        once: when.

    Returns:
        What it had printed, and told of errors.
    """
    try:
        wait_for(once)
        (os.killpg if how == signal.SIGINT else os.kill)(running.pid, how)
        told = running.communicate(timeout=60)
        wait_for(lambda: gone(running.pid), 60)
    finally:
        if not gone(running.pid):
            os.killpg(running.pid, signal.SIGKILL)
    return told
