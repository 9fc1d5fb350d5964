"""Runs of `neuroprior fit` that ended early or were damaged: interrupted, killed, full disks, bad checkpoints."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from neuroprior import CombinedPrior, UniformPrior, load, save
from neuroprior.__main__ import main
from neuroprior.plans import write_plans
from neuroprior.training import PriorModule
from tests.integration.test_train import ROOT, check_refusal, metrics, small, some_plans

pytestmark = pytest.mark.usefixtures("undrawn")

CUT = ["--folds", "1", "--check_every", "3", "--max_steps", "15", "--prior.dropout", "0.1"]

DRIVER = """
import os, resource, signal, sys
import neuroprior.cli.fit, neuroprior.cli.fit_report
from neuroprior.__main__ import main
from neuroprior.training.trainer import Keeper

def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)

def after(owner, name, wanted="", count=1):
    inner, met = getattr(owner, name), []
    def outer(*args, **more):
        out = inner(*args, **more)
        met.extend([name] if not wanted else [arg for arg in args if str(arg).endswith(wanted)])
        return die() if len(met) == count else out
    setattr(owner, name, outer)

def disk(size):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

MOMENTS = {
    "begun": lambda: after(neuroprior.cli.fit, "write_whole", "run.yaml"),
    "configured": lambda: after(neuroprior.cli.fit, "write_plans"),
    "trained": lambda: after(Keeper, "on_train_epoch_end", "", 3),
    "saved": lambda: setattr(neuroprior.cli.fit_report, "score", die),
    "compared": lambda: after(neuroprior.cli.fit_report, "write_json", "metrics.json"),
    "full": lambda: disk(7000),
    "fuller": lambda: disk(2000),
}
for moment, change in MOMENTS.items():
    if not (child := os.fork()):
        change()
        os.dup2(os.open(os.path.join(sys.argv[1], moment + ".err"), os.O_WRONLY | os.O_CREAT), 2)
        os._exit(main([*sys.argv[2:], "--out", os.path.join(sys.argv[1], moment)]))
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(moment, code, file=open(os.path.join(sys.argv[1], "codes"), "a"))
"""
"""Runs that end early, each in a process of its own that kills itself at a set moment or writes to a small disk."""


@pytest.fixture(scope="module")
def cut(tmp_path_factory) -> Path:
    """A folder of runs: one for each moment at which it was ended, and "whole"."""
    folder = tmp_path_factory.mktemp("cut")
    arguments = [*small("gru", folder / "whole"), *CUT]
    assert main(arguments) == 0
    at = arguments.index("--out")
    done = subprocess.run(
        [sys.executable, "-c", DRIVER, str(folder), *arguments[:at], *arguments[at + 2 :]],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def whole(cut, tmp_path) -> Path:
    """A run that can be damaged."""
    return Path(shutil.copytree(cut / "whole", tmp_path / "run"))


def files_of(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir() if path.is_file()}


LEFT = {
    "configured": ("run.yaml", "last.ckpt"),
    "trained": ("last.ckpt", "model.safetensors"),
    "saved": ("model.safetensors", "metrics.json"),
    "compared": ("metrics.json", "metrics.csv"),
}
"""What is there when a run is killed, and what is not."""


@pytest.mark.parametrize("moment", LEFT)
def test_killed_at_any_moment_and_resumed(moment, cut, tmp_path):
    """Also in a folder that was moved, the result is that of a run that was never killed."""
    folder, unbroken = cut / moment, cut / "whole"
    assert f"{moment} -9" in (cut / "codes").read_text().splitlines()
    there, missing = LEFT[moment]
    assert there in files_of(folder)
    assert missing not in files_of(folder)
    folder = folder.rename(tmp_path / "moved")
    assert main(["fit", "--resume", str(folder)]) == 0
    for name in ("model.safetensors", "config.json", "plans.npz", "metrics.csv"):
        assert (folder / name).read_bytes() == (unbroken / name).read_bytes(), name
    assert metrics(folder) == metrics(unbroken)
    assert len(metrics(folder)["curve"]) == 5
    assert not [name for name in files_of(folder) if "partial" in name]


def test_killed_before_its_plans_were_kept(cut, tmp_path, capsys):
    """Then the same command goes on, and the message says so; another command does not."""
    folder, whole = cut / "begun", cut / "whole"
    assert files_of(folder) == {"run.yaml", ".neuroprior.lock"}
    check_refusal(capsys, ["fit", "--resume", str(folder)], "give its command again")
    check_refusal(capsys, [*small("gru", folder), *CUT, "--seed", "4"], "`out` must be a new or empty folder")
    assert main([*small("gru", folder), *CUT]) == 0
    assert (folder / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()


@pytest.mark.parametrize("moment", ["full", "fuller"])
def test_a_full_disk_is_one_line(moment, cut):
    """One is full when the checkpoint is written, the other when the plans are."""
    assert f"{moment} 2" in (cut / "codes").read_text().splitlines()
    said = (cut / f"{moment}.err").read_text().splitlines()
    assert [line.split(":")[0] for line in said if not line.startswith("training: step")] == ["error"], said
    assert ("plans.npz" in files_of(cut / moment)) == (moment == "full")
    assert "last.ckpt" not in files_of(cut / moment)


def test_ctrl_c_says_how_to_resume(tmp_path, capsys, monkeypatch):
    step, calls = PriorModule.training_step, []

    def interrupted(self, *batch):
        calls.append(batch)
        if len(calls) == 15:
            raise KeyboardInterrupt
        return step(self, *batch)

    monkeypatch.setattr(PriorModule, "training_step", interrupted)
    out = tmp_path / "run"
    assert main(small("gru", out)) == 130
    assert capsys.readouterr().err.endswith(f"interrupted; go on with: neuroprior fit --resume {out}\n")
    assert torch.load(out / "last.ckpt", weights_only=True)["global_step"] == 10
    assert main(["fit", "--resume", str(out)]) == 0
    assert [row["step"] for row in metrics(out)["curve"]] == [10, 20, 30]
    assert len(calls) == 15 + 20  # from the checkpoint on


class Poison:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return (Path.touch, (self.target,))


@pytest.mark.parametrize("content", ["nothing", "half", "a list", "poison"])
def test_a_damaged_checkpoint_is_named(content, whole, tmp_path, capsys):
    """Nothing in it is executed, and without it the run starts over."""
    last, model = whole / "last.ckpt", (whole / "model.safetensors").read_bytes()
    if content in ("nothing", "half"):
        last.write_bytes(last.read_bytes()[: last.stat().st_size // 2 * (content == "half")])
    else:
        torch.save({"callbacks": Poison(tmp_path / "poisoned")} if content == "poison" else [1], last)
    check_refusal(capsys, ["fit", "--resume", str(whole)], str(last), "damaged")
    assert not (tmp_path / "poisoned").exists()
    last.unlink()
    assert main(["fit", "--resume", str(whole)]) == 0
    assert (whole / "model.safetensors").read_bytes() == model


@pytest.mark.parametrize("name", ["run.yaml", "plans.npz"])
@pytest.mark.parametrize("content", [b"", b"{[", b"\xff\xfe\x00"])
def test_a_damaged_run_is_named(name, content, whole, capsys):
    (whole / name).write_bytes(content)
    check_refusal(capsys, ["fit", "--resume", str(whole)], name)


def test_a_run_is_neither_changed_nor_overwritten(whole, capsys):
    before = {path: path.read_bytes() for path in whole.rglob("*") if path.is_file()}
    for more in (["--learning-rate=0.1"], ["--config", "transformer"], ["--out", "elsewhere"]):
        check_refusal(capsys, ["fit", "--resume", str(whole), *more], "`resume` must be given alone")
    check_refusal(capsys, small("markov", whole), f"--resume {whole}")
    check_refusal(capsys, ["fit", "--resume", str(whole.parent)], "`resume`", "run.yaml")
    assert {path: path.read_bytes() for path in whole.rglob("*") if path.is_file()} == before


def test_a_saved_combined_prior_is_not_learned_again(tmp_path, monkeypatch):
    """But it is where another one was saved in its place."""
    write_plans(some_plans(40), tmp_path / "plans.npz")
    run, fit, fitted = tmp_path / "run", CombinedPrior.fit, []
    monkeypatch.setattr(CombinedPrior, "fit", lambda self, *a, **more: fitted.append(more) or fit(self, *a, **more))
    arguments = ["--effort", "fast", "--max-steps", "5", "--folds", "1", "--out", str(run)]
    assert main(["fit", str(tmp_path / "plans.npz"), *arguments]) == 0
    model, rows = (run / "model.safetensors").read_bytes(), metrics(run)["rows"]
    assert [more["max_steps"] for more in fitted] == [5]
    for other, times in ((None, 1), (UniformPrior(3), 2)):
        (run / "metrics.json").unlink()
        if other is not None:
            save(other, run)
        assert main(["fit", "--resume", str(run)]) == 0
        assert len(fitted) == times
        assert metrics(run)["rows"] == rows
        assert (run / "model.safetensors").read_bytes() == model
    assert yaml.safe_load((run / "run.yaml").read_text())["effort"] == "fast"
    assert load(run).effort == "fast"


def test_a_run_that_was_stopped_early_is_not_trained_further(tmp_path):
    """Noise is learned by heart: held-out bits rise from the first steps on."""
    write_plans(some_plans(40), tmp_path / "plans.npz")
    run = tmp_path / "run"
    line = ["fit", str(tmp_path / "plans.npz"), "--config", "gru", "--out", str(run), "--learning_rate", "0.05"]
    assert main([*line, "--max_steps", "200", "--check_every", "5", "--patience", "10", "--folds", "1"]) == 0
    curve = metrics(run)["curve"]
    assert curve[-1]["step"] < 200
    assert main(["fit", "--resume", str(run)]) == 0
    assert metrics(run)["curve"] == curve
