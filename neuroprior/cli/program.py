"""What the programs share: bad input is one line and exit code 2, Ctrl-C one line and 130."""

import signal
import sys
import threading
from collections.abc import Callable, Sequence


def run_program(run: Callable[[Sequence[str]], None], arguments: Sequence[str] | None = None) -> int:
    """Run a program with arguments.

    Args:
        run: does the work; raises ValueError or OSError on bad input.
        arguments: of the command line; None: those of the process. Dashes and underscores in option names are the same.

    Returns:
        The exit code.
    """
    given = sys.argv[1:] if arguments is None else arguments
    try:
        run([_with_underscores(argument) for argument in given])
    except KeyboardInterrupt as interrupted:
        # An impatient second Ctrl-C should not spoil the message.
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        return _fail(str(interrupted) or "interrupted; what was not yet written is lost", 130)
    except (ValueError, OSError, MemoryError, OverflowError, ImportError) as error:
        return _fail(f"error: {error}", 2)
    except RuntimeError as error:
        # torch has no exception of its own for memory that it could not get.
        if "memory" not in str(error):
            raise
        return _fail(f"error: out of memory; a smaller run may fit ({str(error).splitlines()[0]})", 2)
    return 0


def _with_underscores(argument: str) -> str:
    if not argument.startswith("--"):
        return argument
    name, equals, value = argument.partition("=")
    return "--" + name[2:].replace("-", "_") + equals + value


def _fail(message: str, code: int) -> int:
    print(" ".join(message.split()), file=sys.stderr)
    return code
