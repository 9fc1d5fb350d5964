"""Jobs: on cores or on a cluster, kept in files, found again only for the same question and the same code."""

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from neuroprior import _files, _jobs
from neuroprior._jobs import Failure, JobRun, Progress
from tests.support import jobs

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("processes", [1, 2])
def test_results_come_in_the_order_of_the_jobs(processes: int, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    found = JobRun(jobs.square, tmp_path, {}).do([5, 2, 9, 4], processes=processes, title="squares")
    assert [result["square"] for result in found] == [25, 4, 81, 16]
    own = {result["process"] for result in found} == {os.getpid()}
    assert own == (processes == 1)
    lines = [line for line in capsys.readouterr().err.splitlines() if " finished " not in line]  # a slow machine's
    assert len(lines) == 4
    assert lines[-1].startswith("squares: 4/4 ")
    assert lines[-1].endswith(" 0:00:00 left)")


def test_where_there_is_nothing_to_do_no_process_is_started() -> None:
    assert list(_jobs.each_result(jobs.square, [], 2)) == []


def test_finished_jobs_are_not_done_again(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    traces = tmp_path / "traces"
    traces.mkdir()
    run = partial(jobs.counted, traces)
    first = JobRun(run, tmp_path, {"a": 1}).do([1, 2], processes=1)
    again = JobRun(run, tmp_path, {"a": 1}).do([2, 1, 3], processes=1, title="again")
    assert [first[1], first[0]] == again[:2]
    assert len(list(traces.iterdir())) == 3
    assert "again: 2/3 were finished before" in capsys.readouterr().err
    JobRun(run, tmp_path, {"a": 2}).do([1], processes=1)
    assert len(list(traces.iterdir())) == 4  # something else was asked


def test_what_was_asked_is_kept_in_any_order(tmp_path: Path) -> None:
    one, other = JobRun(jobs.square, tmp_path, {"a": 1, "b": 2}), JobRun(jobs.square, tmp_path, {"b": 2, "a": 1})
    assert one.folder == other.folder
    one.do([1])
    assert _files.read_json(one.folder / "asked.json") == {"a": 1, "b": 2}


@pytest.mark.parametrize(
    ("raised", "error", "message"),
    [
        (FileNotFoundError("x is not there"), ValueError, "job: x is not there"),
        (ImportError("no pandas"), ValueError, "job: no pandas"),
        (ValueError(), ValueError, "job: ValueError"),
        (MemoryError(), MemoryError, "job: out of memory; a smaller run may fit"),
        (RuntimeError("CUDA out of memory"), MemoryError, "job: out of memory; a smaller run may fit"),
        (KeyError("k"), RuntimeError, "job: KeyError: 'k'"),
    ],
)
def test_errors_of_jobs(raised: Exception, error: type[Exception], message: str) -> None:
    """Those that are expected are one line; of others the traceback is told."""
    found = pickle.loads(pickle.dumps(Failure(raised))).error("job")  # as it comes from another process
    assert type(found) is error
    assert str(found).strip() == message


def test_numbers_that_json_does_not_have_are_null(tmp_path: Path) -> None:
    content = {"a": (1.0, float("nan"), [float("inf"), {"b": -float("inf")}]), "c": None, "d": 2}
    _files.write_json(tmp_path / "x.json", content)
    assert _files.read_json(tmp_path / "x.json") == {"a": [1.0, None, [None, {"b": None}]], "c": None, "d": 2}


def test_versions_of_packages_decide_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def folders() -> list[Path]:
        return [JobRun(jobs.square, tmp_path, {}, packages=names).folder for names in ((), ("pytest",))]

    (plain, more), version = folders(), _files.version
    assert plain != more
    monkeypatch.setattr(_files, "version", lambda name: "0" if name == "pytest" else version(name))
    assert folders()[0] == plain
    assert folders()[1] not in (plain, more)


def test_progress_says_what_is_done_and_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    times = iter([100.0, 100.0 + 3661, 100.0 + 2 * 3661])
    monkeypatch.setattr("neuroprior._jobs.time", SimpleNamespace(monotonic=lambda: next(times)))
    with Progress("t", 10, 4) as progress:
        progress.advance("a")
        progress.advance("b")
    assert capsys.readouterr().err.splitlines() == [
        "t: 6/10 were finished before",
        "t: 7/10 a (1:01:01, about 3:03:03 left)",
        "t: 8/10 b (2:02:02, about 2:02:02 left)",
    ]


def test_a_job_that_fails_is_named_and_the_others_are_kept(tmp_path: Path) -> None:
    runs = JobRun(jobs.fails_at_three, tmp_path, {}, name=lambda job: f"number {job}")
    with pytest.raises(ValueError, match=r"number 3: three is\nno good"):
        runs.do([1, 2, 3], processes=1)
    assert runs.finished(1)
    assert not runs.finished(3)


def test_memory_that_runs_out_is_named(tmp_path: Path) -> None:
    with pytest.raises(MemoryError, match="1: out of memory"):
        JobRun(jobs.out_of_memory, tmp_path, {}).do([1])
    with pytest.raises(MemoryError, match="a process was killed"):
        JobRun(jobs.dies, tmp_path, {}).do([1, 2], processes=2)


def test_a_damaged_result_is_named(tmp_path: Path) -> None:
    runs = JobRun(jobs.square, tmp_path, {})
    runs.do([1])
    runs.path(1).write_text("{")
    with pytest.raises(ValueError, match=r"1\.json: damaged; delete it"):
        runs.do([1])


@pytest.mark.parametrize("interrupt", [pytest.param(os.kill, marks=pytest.mark.slow), os.killpg])
def test_an_interrupted_run_goes_on(tmp_path: Path, interrupt: Callable[[int, int], None]) -> None:
    """Whether the program alone is interrupted, or its workers, too, as a terminal does."""
    program = (
        "from tests.support.jobs import *; from neuroprior._jobs import JobRun; from pathlib import Path; import sys\n"
    )
    program += "try: JobRun(slow_square, Path(sys.argv[1]), {}).do(list(range(40)), processes=2)\n"
    program += "except KeyboardInterrupt as error: sys.exit(str(error))"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)],
        cwd=ROOT,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A program that was interrupted in this process, in another test, left Ctrl-C ignored here.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stderr is not None
    process.stderr.readline()
    interrupt(process.pid, signal.SIGINT)
    said = process.stderr.read()
    assert process.wait(60) == 1
    assert "finished jobs are kept in" in said
    assert "Traceback" not in said
    kept = list(tmp_path.glob("*/[0-9]*.json"))
    assert 1 <= len(kept) < 40


@pytest.fixture
def cluster():
    """A scheduler and two workers of Dask's, processes of their own: its address, and the workers."""
    pytest.importorskip("distributed")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    started = []

    def start(*words: str) -> subprocess.Popen:
        program = [sys.executable, "-m", *words, "--no-dashboard"]
        started.append(subprocess.Popen(program, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True))
        return started[-1]

    def wait_for(process: subprocess.Popen, word: str) -> str:
        assert process.stderr is not None
        for line in process.stderr:
            if word in line:
                return line
        raise AssertionError(f"{word!r} was not said")

    scheduler = start("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0")
    address = wait_for(scheduler, "Scheduler at").split()[-1]
    workers = [start("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny") for _ in range(2)]
    for worker in workers:
        wait_for(worker, "Registered to")
    yield address, workers
    for process in started:
        process.kill()
        process.wait()


def test_a_cluster_does_the_jobs_though_a_worker_is_killed(cluster, tmp_path: Path) -> None:
    address, workers = cluster
    first = JobRun(jobs.square, tmp_path, {}).do(list(range(4)), dask=address)
    assert os.getpid() not in {result["process"] for result in first}
    # One of the workers is killed while it works: after the first results it does its next job, for half a second.
    runs = JobRun(jobs.slow_square, tmp_path, {})

    def kill() -> None:
        while len(list(runs.folder.glob("[0-9]*.json"))) < 2:
            time.sleep(0.02)
        workers[0].kill()

    threading.Thread(target=kill, daemon=True).start()
    found = runs.do(list(range(8)), dask=address, title="squares")
    assert workers[0].wait(10) == -signal.SIGKILL
    assert [result["square"] for result in found] == [number**2 for number in range(8)]
    assert workers[1].pid in {result["process"] for result in found}


def test_a_worker_of_one_thread_does_the_jobs(tmp_path: Path) -> None:
    """Joblib's own way to use a cluster of one thread is to do without it."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as one:
        found = JobRun(jobs.square, tmp_path, {}).do(list(range(3)), dask=one.scheduler_address)
        assert [result["square"] for result in found] == [0, 1, 4]
        assert os.getpid() not in {result["process"] for result in found}
        # A single job is done there, too.
        assert (
            JobRun(jobs.square, tmp_path / "one", {}).do([5], dask=one.scheduler_address)[0]["process"] != os.getpid()
        )


def test_a_cluster_without_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(_jobs, "SCHEDULER_SECONDS", 1)
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=None) as empty,
        pytest.raises(ValueError, match="has no workers"),
    ):
        JobRun(jobs.square, tmp_path, {}).do([1, 2], dask=empty.scheduler_address)


def test_a_cluster_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(_jobs, "SCHEDULER_SECONDS", 1)
    began = time.monotonic()
    with pytest.raises(ValueError, match=r"none answers at 'tcp://127\.0\.0\.1:1'"):
        JobRun(jobs.square, tmp_path, {}).do([1, 2], dask="tcp://127.0.0.1:1")
    assert time.monotonic() - began < 60
