"""Independent jobs: on the cores of this machine or on a Dask cluster, each result kept in a file.

Needs joblib and rich (`neuroprior[report]`); a cluster needs dask.distributed (`neuroprior[dask]`).
"""

import hashlib
import json
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from neuroprior._files import clear, read_json, versions, write_json

Job = TypeVar("Job")
Result = TypeVar("Result")

QUIET_SECONDS = 9
"""After which progress says something, though no job was finished."""

SILENT_SECONDS = 1.5
"""After which a program says what it does."""

SCHEDULER_SECONDS = 10
"""In which a Dask scheduler has to answer."""


class JobRun(Generic[Job, Result]):
    """Jobs whose results are kept in a folder, so that an interrupted run can be resumed.

    A result is found again only if the same was asked of the same versions: the name of the folder is a digest of
    `asked` and of the versions of this package and of those that it depends on. Whoever changes the code without its
    version deletes the folder.

    Args:
        run: does a job and returns its result. It can be pickled, and is called in one thread.
        folder: the folder below which results are kept.
        asked: JSON values: all that decides a result beside the job.
        name: the name of a job's file (without its ending); it must be unique.
        save, load, suffix: how a result is written and read; JSON by default.
        packages: further packages whose version decides a result.
    """

    def __init__(
        self,
        run: Callable[[Job], Result],
        folder: Path,
        asked: dict[str, Any],
        *,
        name: Callable[[Job], str] = str,
        save: Callable[[Path, Any], None] = write_json,
        load: Callable[[Path], Any] = read_json,
        suffix: str = ".json",
        packages: Sequence[str] = (),
    ) -> None:
        self.run, self.name, self._save, self._load, self.suffix = run, name, save, load, suffix
        decides = {"asked": asked, "versions": versions(*packages)}
        digest = hashlib.sha256(json.dumps(decides, sort_keys=True, default=str).encode()).hexdigest()[:12]
        self.folder = folder / digest
        self._asked = asked

    def path(self, job: Job) -> Path:
        """The file that holds a job's result."""
        return self.folder / (self.name(job) + self.suffix)

    def finished(self, job: Job) -> bool:
        """Whether the result of a job is there."""
        return self.path(job).exists()

    def read(self, job: Job) -> Result:
        """The result of a finished job.

        Raises:
            ValueError: its file is damaged.
            OSError: its file cannot be read.
        """
        try:
            result: Result = self._load(self.path(job))
        except ValueError as error:
            raise ValueError(
                f"{self.path(job)}: damaged; delete it, and the same command does the job again"
            ) from error
        return result

    def do(
        self, jobs: Sequence[Job], *, processes: int | None = None, dask: str | None = None, title: str = "jobs"
    ) -> list[Result]:
        """Do the jobs that have no result yet, see `each`; returns the results of all, in the order of `jobs`."""
        for _ in self.each(jobs, processes=processes, dask=dask, title=title):
            pass
        return self.results(jobs)

    def results(self, jobs: Sequence[Job]) -> list[Result]:
        """The results of finished jobs, see `read`."""
        return [self.read(job) for job in jobs]

    def each(
        self,
        jobs: Sequence[Job],
        *,
        processes: int | None = None,
        dask: str | None = None,
        title: str = "jobs",
        cost: Callable[[Job], float] = lambda job: 1.0,
    ) -> Iterator[float]:
        """Do the jobs that have no result yet; yields the seconds that are left, about, whenever one is finished.

        Progress goes to standard error: a bar in a terminal, elsewhere lines.

        Args:
            jobs: the jobs.
            processes: how many run at a time; None: one for each core.
            dask: the address of a Dask scheduler, `tcp://host:port`, whose workers do the jobs; None: this machine.
            title: what the progress is called.
            cost: how long a job takes, compared with others.

        Raises:
            ValueError: a job failed (the message names it), or the cluster cannot be used.
            MemoryError: memory ran out or a process was killed.
            KeyboardInterrupt: the message says how to go on.
        """
        missing = [job for job in jobs if not self.finished(job)]
        if not missing:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        clear(self.folder)
        write_json(self.folder / "asked.json", self._asked)
        processes = min(processes or os.cpu_count() or 1, len(missing))
        costs = [cost(job) for job in missing]
        try:
            with Progress(title, len(jobs), len(missing), sum(costs), sum(costs[1:processes])) as progress:
                for job, result in each_result(self.run, missing, processes, dask, self.name):
                    self._save(self.path(job), result)
                    yield progress.advance(self.name(job), cost(job))
        except KeyboardInterrupt as interrupted:
            raise KeyboardInterrupt(
                f"interrupted; finished jobs are kept in {self.folder}, and the same command goes on"
            ) from interrupted


def each_result(
    run: Callable[[Job], Result],
    jobs: Sequence[Job],
    processes: int,
    dask: str | None = None,
    name: Callable[[Job], str] = str,
) -> Iterator[tuple[Job, Result]]:
    """The jobs with their results, each as soon as it is there; all are done in one thread.

    Args:
        run: does a job. It can be pickled, where there are several processes.
        jobs: the jobs.
        processes: how many are done at a time; 1: in this process.
        dask: see `JobRun.do`.
        name: of a job, for messages.

    Raises:
        ValueError: a job failed (the message names it), or the cluster cannot be used.
        MemoryError: memory ran out or a process was killed.
    """
    call = partial(_attempt, run, parent=os.getpid() if dask is None else None)
    for index, result in _unordered_results(call, jobs, processes, dask):
        if isinstance(result, Failure):
            raise result.error(name(jobs[index]))
        yield jobs[index], result


def sending_error(value: object) -> str | None:
    """Why a value cannot be sent to other processes on this machine, in a few words; None: it can."""
    try:
        from joblib.externals.loky.backend.reduction import dumps
    except ImportError:
        return "joblib is not installed; pip install 'neuroprior[report]'"
    try:
        dumps(value)
    except Exception as error:  # whatever an object of the user's raises
        return f"{type(error).__name__}: {error}"
    return None


class Failure:
    """An error of a job, in a form that every process can send."""

    def __init__(self, error: BaseException) -> None:
        # torch has no exception of its own for memory that it could not get
        out = isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "memory" in str(error))
        expected = isinstance(error, ValueError | OSError | ImportError | OverflowError)
        self.kind = MemoryError if out else ValueError if expected else RuntimeError
        self.message = "out of memory; a smaller run may fit" if out else str(error) or type(error).__name__
        if self.kind is RuntimeError:
            import traceback

            self.message = "".join(traceback.format_exception(error))

    def error(self, where: str) -> Exception:
        """The error that names the job."""
        return self.kind(f"{where}: {self.message}")


def _attempt(run: Callable[[Job], Result], job: Job, index: int, parent: int | None = None) -> tuple[int, Any]:
    """Do a job in one thread, since the number of threads changes the last digits."""
    if parent is not None and parent != os.getpid():
        _end_with(parent)
    from neuroprior._threads import one_thread  # torch takes seconds

    try:
        with one_thread():
            return index, run(job)
    except Exception as error:
        return index, Failure(error)


def _unordered_results(
    call: Callable[..., tuple[int, Any]], jobs: Sequence[Any], processes: int, dask: str | None
) -> Iterator[tuple[int, Any]]:
    """The results of all jobs, each as soon as it is there."""
    if dask is not None:
        yield from _on_cluster(call, jobs, dask)
        return
    if processes == 1 or len(jobs) <= 1:
        yield from (call(job, index) for index, job in enumerate(jobs))
        return
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    if threading.excepthook is threading.__excepthook__:
        threading.excepthook = _unless_given_up
    tasks = (delayed(call)(job, index) for index, job in enumerate(jobs))
    with parallel_config(backend="loky", inner_max_num_threads=1):
        number = min(processes, len(jobs))
        parallel = Parallel(n_jobs=number, batch_size=1, pre_dispatch="all", return_as="generator_unordered")
        results = parallel(tasks)
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", module="joblib")  # it remarks on jobs that are given up
                yield from results
        except TerminatedWorkerError as error:
            raise MemoryError("a process was killed, probably for want of memory; try --processes 1") from error
        finally:
            _stop_workers()


def _on_cluster(call: Callable[..., tuple[int, Any]], jobs: Sequence[Any], address: str) -> Iterator[tuple[int, Any]]:
    """The results of all jobs, done by the workers of a Dask cluster."""
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError as error:
        raise ImportError("dask: install it with pip install 'neuroprior[dask]'") from error
    try:
        client = Client(address, timeout=SCHEDULER_SECONDS)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"`dask` must be the address of a scheduler, such as tcp://host:8786; none answers at {address!r}"
        ) from error
    with client, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sending large graph")  # each job has what all need, in case workers go
        # Before there are workers: a cluster that grows with its tasks has none yet.
        tasks = as_completed(client.submit(call, job, index, pure=False) for index, job in enumerate(jobs))
        try:
            client.wait_for_workers(1, timeout=SCHEDULER_SECONDS)
        except TimeoutError as error:
            raise ValueError(f"dask: the scheduler at {address} has no workers; start some (dask worker)") from error
        for task in tasks:
            try:
                result = task.result()
            except KilledWorker as error:
                raise MemoryError(f"a worker was killed several times, perhaps for want of memory ({error})") from error
            except Exception as error:  # not of a job, which would be a result
                raise ValueError(
                    f"dask: the cluster at {address} failed ({type(error).__name__}: {error}); finished jobs are kept,"
                    " and the same command goes on"
                ) from error
            task.release()  # the workers keep results that somebody may ask for
            yield result


def _stop_workers() -> None:
    """End joblib's idle processes, which would otherwise wait for more work for minutes."""
    from joblib.externals.loky import get_reusable_executor

    get_reusable_executor().shutdown(wait=False, kill_workers=True)


def _unless_given_up(error: threading.ExceptHookArgs) -> None:
    """Print the error of a thread, but for that of joblib's own, which misses the jobs that were given up."""
    if error.thread is None or error.thread.name != "ExecutorManagerThread" or error.exc_type is not KeyError:
        threading.__excepthook__(error)


class Progress:
    """Progress on standard error: a bar in a terminal; elsewhere a line for each job, and at least every 10 seconds.

    Args:
        title: what is done.
        total: number of jobs.
        missing: how many of them are still to be done.
        cost: of these, in any unit; None: 1 each.
        beside: cost of the jobs that run beside the first.
    """

    def __init__(self, title: str, total: int, missing: int, cost: float | None = None, beside: float = 0.0) -> None:
        self.title, self.total, self.missing, self.done = title, total, missing, 0
        self._cost, self._spent, self._expected = float(missing if cost is None else cost), 0.0, 0.0
        self._begun_half = beside / 2  # when a job is finished, those beside it are half done on average
        self._bar: Any = None
        self._ended = threading.Event()
        if sys.stderr.isatty():
            from rich import progress as bars
            from rich.console import Console

            done = (bars.TextColumn("{task.description}"), bars.BarColumn(), bars.MofNCompleteColumn())
            times = (bars.TimeElapsedColumn(), bars.TextColumn("{task.fields[left]}"))
            self._bar = bars.Progress(*done, *times, transient=True, console=Console(stderr=True))
            self._task = self._bar.add_task(title, total=total, completed=total - missing, left="")

    def __enter__(self) -> "Progress":
        self._begun = self._said = time.monotonic()
        if self._bar is not None:
            self._bar.start()
            return self
        if self.missing < self.total:
            print(f"{self.title}: {self.total - self.missing}/{self.total} were finished before", file=sys.stderr)
        threading.Thread(target=self._watch, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._bar is not None:
            self._bar.stop()

    def advance(self, what: str, cost: float = 1.0) -> float:
        """Report a finished job of this cost; returns the seconds that are left, about, at the speed so far."""
        self.done += 1
        self._spent += cost
        gone = time.monotonic() - self._begun
        done = self._spent + min(self._begun_half, (self._cost - self._spent) / 2)
        self._expected = gone * self._cost / done
        self._say(what, gone)
        left = self._expected - gone
        if self._bar is not None:
            self._bar.update(self._task, advance=1, left=f"{_clock(left)} left")
        return left

    def _say(self, what: str, gone: float) -> None:
        """Print a line, unless there is a bar."""
        self._said = self._begun + gone
        if self._bar is None:
            count = f"{self.total - self.missing + self.done}/{self.total}"
            left = f", about {_clock(max(self._expected - gone, 0))} left" if self.done else ""
            print(f"{self.title}: {count} {what} ({_clock(gone)}{left})", file=sys.stderr, flush=True)

    def _watch(self) -> None:
        """Say something where no job was finished for a while."""
        while not self._ended.wait(1):
            if time.monotonic() - self._said >= QUIET_SECONDS:
                self._say("finished", time.monotonic() - self._begun)


@contextmanager
def saying(what: str) -> Iterator[None]:
    """Say what is done, on standard error, where it takes longer than `SILENT_SECONDS`."""
    timer = threading.Timer(SILENT_SECONDS, partial(print, what, file=sys.stderr, flush=True))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def in_words(seconds: float) -> str:
    """A time, such as "20 seconds" or "3 minutes"."""
    if seconds < 90:
        return f"{max(round(seconds, -1), 10):.0f} seconds"
    return f"{seconds / 60:.0f} minutes" if seconds < 90 * 60 else f"{seconds / 3600:.1f} hours"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


@lru_cache
def _end_with(parent: int) -> None:
    """In a process that joblib started: end when the main process is gone, also if it went before the first job."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
