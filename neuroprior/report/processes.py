"""Jobs done in several processes of one thread each, which end with the program."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Job = TypeVar("Job")

LAUNCHED = ("RANK", "WORLD_SIZE", "LOCAL_", "GROUP_", "ROLE_", "MASTER_", "TORCHELASTIC_")
"""How the variables begin by which torchrun tells a process which of how many it is."""


def do_each(
    do: Callable[[Job], None],
    todo: Sequence[Job],
    processes: int,
    done: Callable[[Job], None],
    apart: bool = False,
) -> None:
    """Do jobs, `processes` at a time; the first that fails ends all.

    Args:
        do: does one; it can be pickled, and keeps what it finds in a file.
        todo: the jobs, each of which can be pickled.
        processes: at the same time.
        done: is told here, in the main process, of each job that is finished.
        apart: never in this process. Without it a single job, or one process, is not worth starting another.

    Raises:
        MemoryError: a process was killed, as happens where memory runs out.
        Exception: what `do` raised.
    """
    if not todo:
        return
    if not apart and (processes == 1 or len(todo) < 2):
        for job in todo:
            do(job)
            done(job)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(todo)), context, _in_process) as pool:
        try:
            with _no_interrupt(), _not_launched():
                running = {pool.submit(do, job): job for job in todo}
            for future in as_completed(running):
                future.result()
                done(running[future])
        except BrokenProcessPool as error:
            raise MemoryError("a process was killed, probably for want of memory; try --processes 1") from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def progress_bar(shown: bool = True) -> Progress:
    """A bar that counts jobs and tells the time that they will take; it is gone when all are done."""
    bar = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*bar, TimeRemainingColumn(), transient=True, disable=not shown)


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Ctrl-C is held back, and never reaches processes that are started here: the main one ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _not_launched() -> Iterator[None]:
    """Processes started here do not take themselves for one of torchrun's, as Lightning would in training."""
    before = {name: value for name, value in os.environ.items() if name.startswith(LAUNCHED)}
    for name in before:
        del os.environ[name]
    try:
        yield
    finally:
        os.environ.update(before)


def _in_process() -> None:
    # Where the main process is killed, nobody else would end this one.
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
