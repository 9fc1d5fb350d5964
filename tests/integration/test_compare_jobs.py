"""Cells of a comparison: kept, shared out over processes, gathered; runs that were interrupted or killed."""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from eval.__main__ import main
from eval.compare import jobs as compare_jobs
from eval.compare import run as compare_cell
from eval.compare.jobs import Cell, Study, cells_of, gather, run_cells
from eval.compare.settings import Settings
from neuroprior import MarkovPrior, save
from neuroprior.report.processes import do_each
from tests.support.made_up_cells import broken, environment, made_up, quick_report, torn
from tests.support.sessions import interrupted, wait_for
from tests.support.sources import refuses

SETTINGS = Settings((2, 4), ("markov",), ("nothing",), 1, 3, 4, 5, 0)
CELLS = cells_of(["maze", "grid"], 3)
OPTIONS = ("compare", "--worlds", "maze", "grid", "--seeds", "3", "--num-plans", "4")


def study_in(folder: Path, run=made_up, **changes) -> Study:
    return Study.prepare(folder, replace(SETTINGS, **changes), run)


def test_cells_are_worlds_times_seeds():
    assert [(*cell,) for cell in CELLS] == [(world, seed) for world in ("maze", "grid") for seed in range(3)]
    assert len({cell.file for cell in CELLS}) == 6


@pytest.mark.parametrize("processes", [1, 2])
def test_results_are_those_of_the_cells_in_order(processes, tmp_path):
    study = study_in(tmp_path)
    found = run_cells(study, CELLS, processes)
    assert found == [made_up(compare_jobs.TASKS[cell.world], cell.seed, SETTINGS) for cell in CELLS]
    assert [(cell["world"], cell["seed"]) for cell in found] == CELLS
    assert not multiprocessing.active_children()
    assert not list(tmp_path.rglob("*.partial"))
    kept = json.loads((study.folder / "settings.json").read_text())
    assert Settings(**{key: tuple(v) if isinstance(v, list) else v for key, v in kept.items()}) == SETTINGS


def test_finished_cells_are_not_done_again(tmp_path):
    study = study_in(tmp_path)
    whole = run_cells(study, CELLS, 1)
    gone = CELLS[2]
    (study.folder / gone.file).unlink()
    (study.folder / f".{gone.file}.1.partial").write_bytes(b"cut off")  # as after kill -9
    did = []

    def counted(task, seed, settings):
        did.append((task.name, seed))
        return made_up(task, seed, settings)

    assert run_cells(replace(study, run=counted), CELLS, 1) == whole
    assert did == [gone]
    # More seeds and worlds, or fewer, are other cells of the same study.
    assert len(run_cells(replace(study, run=counted), cells_of(["grid", "maze", "cube"], 4), 1)) == 12
    assert len(did) == 1 + 2 + 4


def test_whatever_changes_results_makes_another_study(tmp_path, monkeypatch):
    base = study_in(tmp_path)
    assert study_in(tmp_path) == base
    changes = [
        {"num_plans": (2, 8)},
        {"kinds": ("gru",)},
        {"sees": ("start",)},
        *({name: 9} for name in ("rounds", "steps", "starts", "training_starts", "seed")),
        {"lengths": (4,)},
    ]
    folders = [base.folder, study_in(tmp_path, broken).folder]
    folders += [study_in(tmp_path, **change).folder for change in changes]
    prior = save(MarkovPrior(4, 1).fit(torch.zeros(3, 4, dtype=torch.long)), tmp_path / "prior")
    folders += [study_in(tmp_path, priors=(str(prior),)).folder]
    save(MarkovPrior(4, 1).fit(torch.ones(3, 4, dtype=torch.long)), prior)  # another model at the same place
    folders += [study_in(tmp_path, priors=(str(prior),)).folder]
    monkeypatch.setattr(compare_cell, "recipe", lambda: "another")
    folders += [study_in(tmp_path).folder]
    monkeypatch.setattr(compare_jobs, "versions", lambda *more: dict.fromkeys(more, "0"))
    folders += [study_in(tmp_path).folder]
    assert len(set(folders)) == len(folders)


@pytest.mark.parametrize(("run", "error"), [(broken, ValueError), (torn, MemoryError)])
def test_a_failed_cell_is_named_and_finished_ones_are_kept(run, error, tmp_path):
    study = study_in(tmp_path, run)
    words = ("maze, seed 1", "no plan scored more than 0") if run is broken else ("killed", "--processes 1")
    with refuses(*words, error=error):
        run_cells(study, CELLS, 1 if run is broken else 2)
    assert not study.finished(Cell("maze", 1))
    assert run is torn or study.finished(Cell("maze", 0))
    assert not multiprocessing.active_children()


@pytest.mark.parametrize(
    ("raised", "seen", "says"),
    [
        (OSError("disk full"), ValueError, "grid, seed 0: disk full"),
        (ImportError("no gymnasium"), ValueError, "grid, seed 0: no gymnasium"),
        (RuntimeError("not enough memory: you tried"), MemoryError, "grid, seed 0: out of memory"),
        (MemoryError(), MemoryError, "grid, seed 0: out of memory"),
    ],
)
def test_errors_of_a_cell_name_it(raised, seen, says, tmp_path):
    def fails(task, seed, settings):
        raise raised

    study = study_in(tmp_path, fails)
    with pytest.raises(seen, match=says):
        compare_jobs.do(study, Cell("grid", 0))
    assert not list(study.folder.iterdir())


def test_a_fault_of_the_program_keeps_its_traceback_and_names_the_cell(tmp_path):
    def fails(task, seed, settings):
        raise AssertionError("shapes")

    with pytest.raises(AssertionError, match="shapes") as caught:
        compare_jobs.do(study_in(tmp_path, fails), Cell("grid", 4))
    assert caught.value.__notes__ == ["in grid, seed 4"]


def test_a_damaged_file_is_named(tmp_path):
    study = study_in(tmp_path)
    run_cells(study, CELLS, 1)
    (study.folder / CELLS[1].file).write_text('{"world": ')
    with refuses(f"{CELLS[1].file}: damaged"):
        run_cells(study, CELLS, 1)


def test_a_cell_takes_one_thread(tmp_path):
    def threads(task, seed, settings):
        return {"threads": torch.get_num_threads()}

    study, before = study_in(tmp_path, threads), torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        compare_jobs.do(study, CELLS[0])
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert study.read(CELLS[0]) == {"threads": 1}


def test_cells_do_not_take_part_in_torchrun(tmp_path, monkeypatch):
    """Lightning would take a prior's training for a part of one training by all processes that torchrun started."""
    given = {"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1", "MASTER_PORT": "1", "TORCHELASTIC_RUN_ID": "x"}
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    study = study_in(tmp_path, environment)
    do_each(partial(compare_jobs.do, study), CELLS[:1], 1, lambda cell: None, apart=True)
    found = study.read(CELLS[0])
    assert found["launched"] == []
    assert found["process"] != os.getpid()
    assert given.items() <= os.environ.items()


class Wire:
    """What Fabric does for `gather`, for processes that run one after another: the first hears what others would say.

    `sent` holds what each process says when its turn comes.
    """

    def __init__(self, rank: int, sent: list[dict]):
        self.global_rank, self.world_size, self.sent = rank, len(sent), sent
        self.is_global_zero = rank == 0
        self.asked: list[str] = []

    def barrier(self) -> None:
        pass

    def broadcast(self, what, src=None):
        if src is None:  # what the first process wants
            return what if self.is_global_zero else self.asked
        if src == self.global_rank:
            self.sent[src] = what
        return self.sent[src]


def test_machines_without_a_shared_folder_send_what_they_found(tmp_path):
    """The first has the cells of seed 0; the second those of 0 and 1, of which it sends the latter alone."""
    first, second = (study_in(tmp_path / name) for name in ("first", "second"))
    whole = run_cells(study_in(tmp_path / "alone"), CELLS, 1)
    run_cells(first, [cell for cell in CELLS if cell.seed == 0], 1)
    run_cells(second, [cell for cell in CELLS if cell.seed < 2], 1)
    (first.folder / CELLS[0].file).write_text("its own")
    sent: list[dict] = [{}, {}]
    wire = Wire(1, sent)
    wire.asked = [cell.file for cell in CELLS if not first.finished(cell)]
    gather(second, CELLS, wire)
    assert set(sent[1]) == {cell.file for cell in CELLS if cell.seed == 1}
    gather(first, CELLS, Wire(0, sent))
    assert (first.folder / CELLS[0].file).read_text() == "its own"
    assert [first.finished(cell) for cell in CELLS] == [cell.seed < 2 for cell in CELLS]
    assert [first.read(cell) for cell in CELLS if cell.seed == 1] == [cell for cell in whole if cell["seed"] == 1]


def test_machines_that_would_give_other_results_are_told(tmp_path, monkeypatch):
    """Another version of torch there, and the study has another name."""
    wire = Wire(1, [{}, {}])
    monkeypatch.setattr(wire, "broadcast", lambda what: "another")
    monkeypatch.setattr(compare_jobs, "launched", lambda: nullcontext(wire))
    with refuses("versions", "this machine"):
        run_cells(study_in(tmp_path), CELLS, 1)


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """What one process writes without a break."""
    out = tmp_path_factory.mktemp("alone")
    finish(out)
    return out


def finish(out: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare_cell, "run_cell", made_up)
        patch.setattr("eval.compare.command.write_report", quick_report)
        assert main([*OPTIONS, "--processes", "1", "--out", str(out)]) == 0


def started(*before: str, out: Path, **variables: str) -> subprocess.Popen[str]:
    """The command in a session of its own, as from a terminal, with made-up cells."""
    return subprocess.Popen(
        [sys.executable, "-m", *before, "tests.support.made_up_cells", *OPTIONS, "--out", str(out)],
        env=os.environ | {"OMP_NUM_THREADS": "1"} | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # As in a terminal, also where the tests themselves are run in the background, deaf to Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


TORCHRUN = ("torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m")


def cells_in(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.rglob("*-*.json")}


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_run_goes_on(how, alone, tmp_path):
    """Ctrl-C or a killed main process: nobody is left behind, and what another run finishes is the same to the byte."""
    running = started(out=tmp_path, SLOW="0.3")
    output, said = interrupted(running, how, lambda: cells_in(tmp_path))
    if how == signal.SIGINT:
        assert running.returncode == 130
        assert said.startswith("interrupted; finished cells are kept in")
        assert said.count("\n") == 1
    assert "Traceback" not in output + said
    before = cells_in(tmp_path)
    assert 0 < len(before) < 6
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-*.json")}
    assert not (tmp_path / "results.json").exists()
    finish(tmp_path)
    assert times.items() <= {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-*.json")}.items()
    assert cells_in(tmp_path) == cells_in(alone)
    assert (tmp_path / "results.json").read_bytes() == (alone / "results.json").read_bytes()


def test_processes_of_torchrun_share_the_cells(alone, tmp_path):
    """Two of six cells are there already; all results are those of one process."""
    (folder,) = (alone / "cells").iterdir()
    (tmp_path / "cells" / folder.name).mkdir(parents=True)
    for name in (CELLS[0].file, CELLS[-1].file):
        shutil.copy2(folder / name, tmp_path / "cells" / folder.name)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-*.json")}
    running = started(*TORCHRUN, out=tmp_path)
    output, said = running.communicate(timeout=120)
    assert running.returncode == 0
    assert "Traceback" not in output + said
    assert times.items() <= {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*-*.json")}.items()
    assert cells_in(tmp_path) == cells_in(alone)
    assert (tmp_path / "results.json").read_bytes() == (alone / "results.json").read_bytes()


@pytest.mark.slow
def test_nobody_is_left_where_torchrun_is_killed(alone, tmp_path):
    running = started(*TORCHRUN, out=tmp_path, SLOW="1")
    try:
        wait_for(lambda: cells_in(tmp_path))
    finally:
        os.killpg(running.pid, signal.SIGKILL)
    # Its processes hold the pipes until they end.
    running.communicate(timeout=60)
    some = cells_in(tmp_path)
    assert 0 < len(some) < 6
    started(*TORCHRUN, out=tmp_path).communicate(timeout=120)
    assert some.items() <= cells_in(tmp_path).items()
    assert cells_in(tmp_path) == cells_in(alone)
    assert (tmp_path / "results.json").read_bytes() == (alone / "results.json").read_bytes()
