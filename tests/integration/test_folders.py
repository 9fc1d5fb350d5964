"""A folder belongs to one run: one killed at any moment goes on; of two at once one is told; results are of one."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from eval.__main__ import main as evaluate
from neuroprior import MarkovPrior, UniformPrior, load, save
from neuroprior.__main__ import main
from neuroprior._files import clear, replacing, write_whole
from neuroprior._folders import claim
from neuroprior.behaviour import RecordedPlans, simulated_study
from neuroprior.plans import write_plans
from neuroprior.plans.io.npz import read_npz
from tests.integration.test_train import ROOT, some_plans
from tests.support.sources import refuses

NAMES = ("fit", "fit resumed", "report", "score", "paper", "save")


def python(*arguments: str) -> list[str]:
    return [sys.executable, *arguments]


def killed(folder: Path, parts: int) -> Path:
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    command = python("-m", "tests.support.killing", str(folder), str(parts))
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def once(tmp_path_factory) -> Path:
    """All commands, each killed once in the middle."""
    return killed(tmp_path_factory.mktemp("killed"), 1)


@pytest.fixture(scope="module")
def everywhere(tmp_path_factory) -> Path:
    """All commands, killed before each file takes its place, and before each goes."""
    return killed(tmp_path_factory.mktemp("killed"), 1000)


def results(folder: Path) -> dict[str, bytes]:
    """What runs are compared by."""
    files = (path for ending in ("csv", "json", "safetensors", "gv") for path in folder.glob(f"[!.]*.{ending}"))
    return {path.name: re.sub(rb'"out": "[^"]*"', b'"out": ""', path.read_bytes()) for path in files}


def is_part(found: dict[str, bytes], run: dict[str, bytes]) -> bool:
    """Whether files are all of one run, which may have had more to enter in `results.json`."""
    same = [name for name, content in found.items() if content == run.get(name)]
    entered = [json.loads(files.get("results.json", b"{}")).items() for files in (found, run)]
    return found.keys() <= {*same, "results.json"} and entered[0] <= entered[1]


def check_killed(place: Path) -> None:
    before, whole = results(place / "before"), results(place / "whole")
    assert before != whole or place.name == "fit resumed"
    codes = [*place.glob("*.code")]
    assert codes
    for code in codes:
        assert code.read_text() == "0", code
        left, after = place / f"{code.stem}-killed", place / code.stem
        assert results(after) == whole, after
        names = {path.name for path in after.iterdir()}
        assert names == {path.name for path in (place / "whole").iterdir()}, after  # nothing else is left
        if place.name != "fit" and place.name != "save":
            assert is_part(results(left), before) or is_part(results(left), whole), left
        if place.name in ("fit resumed", "save"):
            model = (left / "model.safetensors").read_bytes()
            assert model in (before["model.safetensors"], whole["model.safetensors"]), left
            load(left)


@pytest.mark.parametrize("name", NAMES)
def test_killed_in_the_middle(name, once):
    check_killed(once / name)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_killed_at_any_moment(name, everywhere):
    check_killed(everywhere / name)


HOLDER = """
import sys, time
from pathlib import Path
from neuroprior._files import replacing
from neuroprior._folders import claim
with claim(Path(sys.argv[1])), replacing(Path(sys.argv[1]) / "result.csv") as partial:
    partial.write_text("half")
    print("claimed", flush=True)
    time.sleep(60)
"""


@contextmanager
def another_run(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that has claimed a folder, and is writing a file there."""
    with subprocess.Popen(python("-c", HOLDER, str(folder)), cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "claimed\n"
        yield process
        process.kill()


def test_a_folder_that_another_run_uses_is_one_line_until_it_is_killed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("neuroprior.priors.serialization.SECONDS", 0.1)
    folder, plans = tmp_path / "run", tmp_path / "plans.npz"
    write_plans(some_plans(), plans)
    save(UniformPrior(3), tmp_path / "prior")
    lines = [
        [main, "fit", str(plans), "--config", "markov"],
        [main, "report", str(plans)],
        [main, "score", str(tmp_path / "prior"), str(plans)],
        [evaluate, "paper"],
    ]
    with another_run(folder) as process:
        for program, *line in lines:
            assert program([*line, "--out", str(folder)]) == 2
            said = capsys.readouterr().err.splitlines()[-1]
            assert said.startswith(f"error: `out` must be a folder that no other run uses, got {folder}, in use by")
            assert f"process {process.pid} on " in said
        with refuses(f"`folder` must be a folder that no other run uses, got {folder}, in use by process"):
            save(UniformPrior(3), folder)
        (partial,) = folder.glob("*.partial")
        clear(folder)  # which leaves what is being written
        assert partial.exists()
        assert {path.name for path in folder.iterdir()} == {partial.name, ".neuroprior.lock"}
    assert partial.exists()
    assert main([*lines[0][1:], "--out", str(folder)]) == 0
    assert not partial.exists()
    assert not (folder / ".neuroprior.lock").exists()


def test_two_fits_at_once_leave_the_run_of_one(tmp_path):
    """The other one is refused, and the options and the model are of the same run."""
    write_plans(some_plans(), tmp_path / "plans.npz")
    line = ["-m", "neuroprior", "fit", str(tmp_path / "plans.npz"), "--out", str(tmp_path / "run"), "--folds", "1"]
    line += ["--config", "markov", "--prior.order"]
    how = {"cwd": ROOT, "stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True}
    runs = [subprocess.Popen(python(*line, order), **how) for order in "12"]
    errors = [run.communicate()[1] for run in runs]
    codes = [run.returncode for run in runs]
    assert sorted(codes) == [0, 2], errors
    (error,) = errors[codes.index(2)].splitlines()
    assert "`out` must be" in error
    order = codes.index(0) + 1
    assert load(tmp_path / "run").order == order
    assert f"order: {order}" in (tmp_path / "run" / "run.yaml").read_text()


def test_nothing_is_written_through_a_link(tmp_path, monkeypatch):
    """Neither where a temporary file is to be, nor where the file itself is, nor at the lock."""
    target, folder = tmp_path / "target", tmp_path / "folder"
    folder.mkdir()
    target.write_text("mine")
    names = iter(["0" * 16, "1" * 16])
    monkeypatch.setattr("neuroprior._files.token_hex", lambda number: next(names))
    (folder / f".{'0' * 16}.partial").symlink_to(target)
    with pytest.raises(FileExistsError):
        write_whole(folder / "result.csv", b"new")
    (folder / "result.csv").symlink_to(target)
    write_whole(folder / "result.csv", b"new")
    assert not (folder / "result.csv").is_symlink()
    clear(folder)  # which leaves links alone
    (folder / ".neuroprior.lock").symlink_to(target)
    with pytest.raises(OSError, match=r"\.neuroprior\.lock"), claim(folder):
        pass
    assert target.read_text() == "mine"


def test_a_claim_leaves_nothing_behind(tmp_path):
    """Also where it was nested, or ended by an error; a folder that was made for it goes, unless something is there."""
    with refuses("an error"), claim(tmp_path / "new" / "folder") as first, claim(tmp_path / "new" / "folder") as second:
        assert first is second
        raise ValueError("an error")
    assert not (tmp_path / "new").exists()
    with claim(tmp_path / "new"), replacing(tmp_path / "new" / "file") as partial:
        partial.write_text("whole")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["file"]


def test_without_locks_a_folder_is_used_with_a_warning(tmp_path, monkeypatch):
    monkeypatch.setattr("neuroprior._folders.lock", lambda descriptor: None)
    with pytest.warns(UserWarning, match="its file system has no locks"), claim(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_model_that_was_saved_over_a_run_is_not_its_own(tmp_path):
    write_plans(some_plans(), tmp_path / "plans.npz")
    run = tmp_path / "run"
    line = ["fit", str(tmp_path / "plans.npz"), "--config", "markov", "--folds", "1", "--out", str(run)]
    assert main(line) == 0
    before = (run / "model.safetensors").read_bytes()
    save(MarkovPrior(3, 1).fit(torch.zeros(4, 5, dtype=torch.long)), run)
    assert main(["fit", "--resume", str(run)]) == 0
    assert (run / "model.safetensors").read_bytes() == before


def test_results_of_another_command_are_kept(tmp_path, monkeypatch, capsys):
    """And a folder has a name: without one, results would be written among the files of the present folder."""
    monkeypatch.chdir(tmp_path)
    plans = some_plans()
    write_plans(plans, "plans.npz")
    save(MarkovPrior(plans.num_actions, 1).fit(plans.without_context()), "model")
    quick = ["plans.npz", "--models", "counts", "--folds", "2", "--processes", "1"]
    assert main(["report", *quick, "--figures", "svg", "--out", "kept"]) == 0
    before = {path.name for path in Path("kept").iterdir()}
    capsys.readouterr()
    assert main(["score", "model", "plans.npz", "--out", "kept"]) == 2
    assert "without results of another command, got kept: report" in capsys.readouterr().err
    assert {path.name for path in Path("kept").iterdir()} == before
    Path("kept/report.html").unlink()  # one of them is enough
    assert main(["score", "model", "plans.npz", "--out", "kept"]) == 2
    assert list(Path("kept/figures").glob("*.svg"))
    assert main(["report", *quick, "--out", "kept"]) == 0
    assert not list(Path("kept/figures").glob("*.svg"))  # they were of the run before
    for command in (["score", "model", "plans.npz"], ["report", *quick], ["fit", "plans.npz"]):
        capsys.readouterr()
        assert main([*command, "--out", ""]) == 2
        assert "`out` must be the name of a folder, got ''" in capsys.readouterr().err


def test_a_config_of_something_else_is_not_replaced(tmp_path):
    (tmp_path / "config.json").write_text('{"my": "settings"}')
    with refuses("`folder`", "config.json of something else"):
        save(UniformPrior(3), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]


def test_a_run_on_recordings_with_times_goes_on(tmp_path, monkeypatch):
    """Plans with all that recordings have, marks of bouts that were cut off among them, are read back."""
    monkeypatch.chdir(tmp_path)
    simulated_study(0, animals=4, actions=40).to_csv("study.csv", index=False)
    assert main(["fit", "study.csv", "--prior", "markov", "--out", "run"]) == 0
    (Path("run") / "learned.json").unlink(missing_ok=True)
    assert main(["fit", "--resume", "run"]) == 0
    plans = read_npz(Path("run/plans.npz"), None, None, RecordedPlans)
    assert plans.cut_off.any()
    assert not plans.cut_off.all()
