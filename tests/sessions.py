"""Programs that are interrupted or killed, with all processes that they started; for tests."""

import os
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
