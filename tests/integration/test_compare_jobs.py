"""The runs of a comparison: kept, resumed after an interruption or a killed process, and shared out over processes."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import pytest
import torch

from eval.__main__ import main
from eval.compare import command
from eval.compare.run import Settings
from eval.worlds.runs import Run, runs_of
from neuroprior import MarkovPrior, save
from neuroprior._jobs import JobRun
from tests.support.made_up_runs import broken, killed, made_up
from tests.support.sessions import interrupted
from tests.support.sources import refuses

pytestmark = pytest.mark.usefixtures("undrawn")

SETTINGS = Settings((2, 4), ("markov",), ("none",), 1, 3, 4, 5, 0)
RUNS = runs_of(["maze", "grid"], 3)
OPTIONS = ("compare", "--worlds", "maze", "grid", "--seeds", "3", "--num-plans", "4", "--seed", "1")
OPTIONS += ("--training-starts", "9", "--steps", "5")  # what a command line gives goes to other processes


def jobs_in(folder: Path, run=made_up, **changes) -> JobRun:
    settings = replace(SETTINGS, **changes)
    return JobRun(partial(run, settings=settings), folder, settings.asked, name=attrgetter("name"))


def test_runs_are_worlds_times_seeds():
    assert [(*run,) for run in RUNS] == [(world, seed) for seed in range(3) for world in ("maze", "grid")]
    assert len({run.name for run in RUNS}) == 6


def test_results_are_those_of_the_runs_in_order(tmp_path):
    found = jobs_in(tmp_path).do(RUNS, processes=1)
    assert found == [made_up(run, SETTINGS) for run in RUNS]
    assert [(one["world"], one["seed"]) for one in found] == RUNS
    assert not list(tmp_path.rglob("*.partial"))


def test_numbers_of_a_command_line_are_plain_where_they_go_to_other_processes(monkeypatch, tmp_path):
    """Those of types that the command makes could not be read where its module is not imported."""
    given = []
    monkeypatch.setattr(command, "compare_run", lambda run, settings: given.append(settings) or made_up(run, settings))
    numbers = {"training-starts": 9, "steps": 5, "starts": 7, "rounds": 3, "seed": 2}
    options = [f"--{name}={number}" for name, number in numbers.items()]
    assert (
        main(["compare", "--worlds=maze", "--seeds=1", "--num-plans=4", *options, "--processes=1", f"--out={tmp_path}"])
        == 0
    )
    for name, number in numbers.items():
        kept = getattr(given[0], name.replace("-", "_"))
        assert (kept, type(kept)) == (number, int)
    assert [(number, type(number)) for number in given[0].num_plans] == [(4, int)]


def test_whatever_changes_results_makes_another_folder(tmp_path):
    base = jobs_in(tmp_path)
    assert jobs_in(tmp_path).folder == base.folder
    changes = [
        {"num_plans": (2, 8)},
        {"kinds": ("gru",)},
        {"context": ("initial",)},
        *({name: 9} for name in ("rounds", "steps", "starts", "training_starts", "seed")),
        {"lengths": (4,)},
    ]
    folders = [base.folder, *(jobs_in(tmp_path, **change).folder for change in changes)]
    prior = save(MarkovPrior(4, 1).fit(torch.zeros(3, 4, dtype=torch.long)), tmp_path / "prior")
    folders += [jobs_in(tmp_path, priors=(str(prior),)).folder]
    save(MarkovPrior(4, 1).fit(torch.ones(3, 4, dtype=torch.long)), prior)  # another model at the same place
    folders += [jobs_in(tmp_path, priors=(str(prior),)).folder]
    assert len(set(folders)) == len(folders)


# A process that is killed: in `test_jobs.py`, too.
KILLED = pytest.param(killed, MemoryError, marks=pytest.mark.slow)


@pytest.mark.parametrize(("run", "error"), [(broken, ValueError), KILLED])
def test_a_failed_run_is_named_and_finished_ones_are_kept(run, error, tmp_path):
    jobs = jobs_in(tmp_path, run)
    words = ("maze-1", "no plan scored more than 0") if run is broken else ("killed", "--processes 1")
    with refuses(*words, error=error):
        jobs.do(RUNS, processes=1 if run is broken else 2)
    assert not jobs.finished(Run("maze", 1))
    assert run is killed or jobs.finished(Run("maze", 0))


def finish(out: Path) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "compare_run", made_up)
        return main([*OPTIONS, "--processes", "1", "--out", str(out)])


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """What one process writes without a break."""
    out = tmp_path_factory.mktemp("alone")
    assert finish(out) == 0
    return out


def kept_in(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.rglob("*-*.json")}


@pytest.mark.parametrize("text", ['{"world": ', "[]", '{"world": "maze", "seed": 2}'])
def test_a_damaged_file_is_named(text, tmp_path, capsys):
    assert finish(tmp_path) == 0
    (path,) = tmp_path.rglob("maze-1.json")
    path.write_text(text)
    assert finish(tmp_path) == 2
    assert f"{path}: damaged" in capsys.readouterr().err


@pytest.mark.slow  # tests/test_jobs.py interrupts jobs of a function that takes no time to load
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_command_goes_on(how, alone, tmp_path):
    """Ctrl-C or a killed main process: no process is left, and another command gives the same files to the byte."""
    running = subprocess.Popen(
        [sys.executable, "-m", "tests.support.made_up_runs", *OPTIONS, "--processes", "2", "--out", str(tmp_path)],
        env=os.environ | {"OMP_NUM_THREADS": "1", "SLOW": "0.3"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # As in a terminal, also where the tests themselves run in the background and ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    output, errors = interrupted(running, how, lambda: kept_in(tmp_path))
    if how == signal.SIGINT:
        assert running.returncode == 130
        *progress, last = errors.splitlines()
        assert last.startswith("interrupted; finished jobs are kept in")
        assert progress
        assert all(line.startswith("compare: ") for line in progress)
    assert "Traceback" not in output + errors
    before = kept_in(tmp_path)
    assert 0 < len(before) < 6
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-*.json")}
    assert not (tmp_path / "results.json").exists()
    assert finish(tmp_path) == 0
    assert times.items() <= {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-*.json")}.items()
    assert kept_in(tmp_path) == kept_in(alone)
    assert (tmp_path / "results.json").read_bytes() == (alone / "results.json").read_bytes()
