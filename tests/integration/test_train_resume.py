"""Runs of `python -m train` that ended early or were damaged: killed at set moments, full disks, bad checkpoints."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

from neuroprior.plans import Plans, write_plans
from neuroprior.priors import CombinedPrior
from tests.integration.test_train import ROOT, Poison, small
from tests.integration.test_train_faults import metrics, one_line
from train.__main__ import main

pytestmark = pytest.mark.usefixtures("undrawn")

CUT = ["--data.check_every", "3", "--trainer.max_steps", "15"]

FAST = ["--effort", "fast", "--max-steps", "5", "--data.folds", "1"]
"""A combined prior, scored without cross-validation, which takes longer than all else."""

DRIVER = """
import os, resource, signal, sys
import neuroprior.cli.fit, neuroprior.cli.fit_report
from neuroprior.training.trainer import WholeCheckpoints
from train.__main__ import main

def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)

def after(owner, name, wanted, count=1):
    inner, met = getattr(owner, name), []
    def outer(*args, **more):
        out = inner(*args, **more)
        met.extend(arg for arg in args if str(arg).endswith(wanted))
        return die() if len(met) == count else out
    setattr(owner, name, outer)

def disk(size):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

MOMENTS = {
    "configured": lambda: after(neuroprior.cli.fit, "write_whole", "run.yaml"),
    "best": lambda: after(WholeCheckpoints, "save_checkpoint", "best.ckpt"),
    "better": lambda: after(WholeCheckpoints, "save_checkpoint", "best.ckpt", 3),
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


def left(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*.*") if path.is_file()}


LEFT = {
    "configured": {"run.yaml", "plans.npz"},
    "best": {"run.yaml", "plans.npz", "checkpoints/best.ckpt"},
    "better": {"run.yaml", "plans.npz", "checkpoints/best.ckpt", "checkpoints/last.ckpt"},
    "saved": {"model.safetensors", "config.json"},
    "compared": {"model.safetensors", "config.json", "metrics.json"},
}
NOT_YET = {"configured": "checkpoints/best.ckpt", "best": "checkpoints/last.ckpt", "better": "model.safetensors"}
NOT_YET |= {"saved": "metrics.json", "compared": "metrics.csv"}


@pytest.mark.parametrize("moment", LEFT)
def test_killed_at_any_moment_and_resumed(moment, cut):
    folder, unbroken = cut / moment, cut / "whole"
    assert f"{moment} -9" in (cut / "codes").read_text().splitlines()
    assert left(folder) >= LEFT[moment]
    assert NOT_YET[moment] not in left(folder)
    assert main(["fit", "--resume", str(folder)]) == 0
    for name in ("model.safetensors", "config.json", "plans.npz", "metrics.csv"):
        assert (folder / name).read_bytes() == (unbroken / name).read_bytes(), name
    assert metrics(folder) == metrics(unbroken)
    assert len(metrics(folder)["curve"]) == 5
    assert not [name for name in left(folder) if "partial" in name]


def test_a_disk_full_of_checkpoints_is_one_line(cut):
    """Plans and configuration are written, a checkpoint is not."""
    assert "full 2" in (cut / "codes").read_text().splitlines()
    said = (cut / "full.err").read_text()
    assert said.count("\n") == 1, said
    assert said.startswith("error: ")
    assert "best.ckpt" in said
    assert {"run.yaml", "plans.npz"} <= left(cut / "full")
    assert not [name for name in left(cut / "full") if "ckpt" in name]
    assert main(["fit", "--resume", str(cut / "full")]) == 0
    assert (cut / "full" / "model.safetensors").read_bytes() == (cut / "whole" / "model.safetensors").read_bytes()


def test_a_disk_too_full_for_the_plans_is_one_line(cut):
    assert "fuller 2" in (cut / "codes").read_text().splitlines()
    said = (cut / "fuller.err").read_text()
    assert said.count("\n") == 1, said
    assert said.startswith("error: ")


@pytest.mark.parametrize("kept", [0, 0.5, 0.999])
def test_a_truncated_checkpoint_is_named(kept, whole, capsys):
    last = whole / "checkpoints" / "last.ckpt"
    last.write_bytes(last.read_bytes()[: int(kept * last.stat().st_size)])
    one_line(capsys, ["fit", "--resume", str(whole)], str(last), f"without the folder {last.parent}")


def test_without_its_checkpoints_a_run_starts_over(whole):
    shutil.rmtree(whole / "checkpoints")
    before = (whole / "model.safetensors").read_bytes()
    assert main(["fit", "--resume", str(whole)]) == 0
    assert (whole / "model.safetensors").read_bytes() == before


@pytest.mark.parametrize("name", ["best.ckpt", "last.ckpt"])
def test_nothing_in_a_checkpoint_is_executed(name, whole, tmp_path, capsys):
    torch.save({"state_dict": Poison(tmp_path / "poisoned")}, whole / "checkpoints" / name)
    one_line(capsys, ["fit", "--resume", str(whole)], name)
    assert not (tmp_path / "poisoned").exists()


@pytest.mark.parametrize("content", ["weights alone", "no curve", "no weights", "a list"])
@pytest.mark.parametrize("name", ["best.ckpt", "last.ckpt"])
def test_a_checkpoint_of_another_program_is_named(name, content, whole, capsys):
    """`best.ckpt` serves for its weights alone."""
    place = whole / "checkpoints" / name
    saved = torch.load(place, weights_only=True)
    without = {key: value for key, value in saved.items() if key != "curve"}
    other = {"weights alone": {"state_dict": saved["state_dict"]}, "no curve": without}
    torch.save(other.get(content, [1] if content == "a list" else {"epoch": 1}), place)
    if name == "best.ckpt" and content in other:
        assert main(["fit", "--resume", str(whole)]) == 0
    else:
        one_line(capsys, ["fit", "--resume", str(whole)], name)


def test_a_missing_best_checkpoint_is_named(whole, capsys):
    (whole / "checkpoints" / "best.ckpt").unlink()
    one_line(capsys, ["fit", "--resume", str(whole)], "best.ckpt")


@pytest.mark.parametrize(("field", "value"), [("hidden_size", 9), ("num_layers", 2)])
def test_a_checkpoint_of_another_model_is_named(field, value, whole, capsys):
    config = yaml.safe_load((whole / "run.yaml").read_text())
    config["model"]["prior"]["init_args"][field] = value
    (whole / "run.yaml").write_text(yaml.safe_dump(config))
    one_line(capsys, ["fit", "--resume", str(whole)], "last.ckpt", "another model")


@pytest.mark.parametrize("name", ["run.yaml", "plans.npz"])
@pytest.mark.parametrize("content", [b"", b"{[", b"\xff\xfe\x00"])
def test_a_damaged_run_is_named(name, content, whole, capsys):
    (whole / name).write_bytes(content)
    one_line(capsys, ["fit", "--resume", str(whole)], name)


@pytest.mark.parametrize(
    "more",
    [
        ["--data.num_plans", "5"],
        ["--model.learning_rate=0.1"],
        ["--seed_everything", "3"],
        ["--seed-everything=3"],
        ["--config", str(ROOT / "train" / "transformer.yaml")],
        ["-c", str(ROOT / "train" / "transformer.yaml")],
        [f"-c{ROOT / 'train' / 'markov.yaml'}"],
        ["--out", "elsewhere"],
        ["--resume", "other"],
    ],
)
def test_a_resumed_run_keeps_its_data_and_model(more, whole, capsys):
    before = (whole / "run.yaml").read_bytes()
    one_line(capsys, ["fit", "--resume", str(whole), *more], more[0].partition("=")[0].replace("seed-", "seed_"))
    assert (whole / "run.yaml").read_bytes() == before


def test_a_resumed_run_may_go_on_for_longer(whole):
    assert main(["fit", "--resume", str(whole), "--trainer.max_steps", "24"]) == 0
    curve = metrics(whole)["curve"]
    assert [row["step"] for row in curve] == list(range(3, 25, 3))
    model = (whole / "model.safetensors").read_bytes()
    assert main(["fit", "--resume", str(whole)]) == 0
    assert metrics(whole)["curve"] == curve
    assert (whole / "model.safetensors").read_bytes() == model
    assert yaml.safe_load((whole / "run.yaml").read_text())["trainer"]["max_steps"] == 24


def test_a_resumed_run_cannot_be_made_shorter_than_it_is(whole, capsys):
    """What is refused is not kept either: it can still be resumed without it."""
    before = (whole / "run.yaml").read_bytes()
    one_line(capsys, ["fit", "--resume", str(whole), "--trainer.max_steps", "10"], "max_steps")
    assert (whole / "run.yaml").read_bytes() == before
    assert main(["fit", "--resume", str(whole)]) == 0
    assert len(metrics(whole)["curve"]) == 5


def test_a_resumed_run_does_not_learn_a_saved_combined_prior_again(tmp_path, monkeypatch):
    """But it does where steps are changed, or only a part of it was saved."""
    torch.manual_seed(0)
    plans = Plans(torch.randint(3, (40, 6)), 3)
    write_plans(plans, tmp_path / "plans.npz")
    run = tmp_path / "run"
    assert main(["fit", str(tmp_path / "plans.npz"), *FAST, "--out", str(run)]) == 0
    model, table = (run / "model.safetensors").read_bytes(), metrics(run)["rows"]
    (run / "metrics.json").unlink()
    fitted, fit = [], CombinedPrior.fit
    monkeypatch.setattr(
        CombinedPrior, "fit", lambda self, *given, **more: fitted.append(more) or fit(self, *given, **more)
    )
    assert main(["fit", "--resume", str(run)]) == 0
    assert not fitted
    assert metrics(run)["rows"] == table
    assert (run / "model.safetensors").read_bytes() == model
    assert main(["fit", "--resume", str(run), "--max-steps", "6"]) == 0
    assert [more["max_steps"] for more in fitted] == [6]
    model = (run / "model.safetensors").read_bytes()
    (run / "config.json").unlink()
    assert main(["fit", "--resume", str(run)]) == 0
    assert [more["max_steps"] for more in fitted] == [6, 6]
    assert (run / "model.safetensors").read_bytes() == model


def test_a_combined_prior_of_other_options_does_not_pass_for_the_one_that_was_interrupted(tmp_path, monkeypatch):
    write_plans(Plans(torch.randint(3, (40, 6), generator=torch.Generator().manual_seed(0)), 3), tmp_path / "plans.npz")
    run = tmp_path / "run"
    assert main(["fit", str(tmp_path / "plans.npz"), *FAST, "--out", str(run)]) == 0
    model, fit = (run / "model.safetensors").read_bytes(), CombinedPrior.fit

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(CombinedPrior, "fit", interrupted)
    assert main(["fit", "--resume", str(run), "--max-steps", "6"]) == 130
    # Prior and options still belong together.
    assert (run / "model.safetensors").read_bytes() == model
    assert yaml.safe_load((run / "run.yaml").read_text())["trainer"]["max_steps"] == 5
    fitted = []
    monkeypatch.setattr(
        CombinedPrior, "fit", lambda self, *given, **more: fitted.append(more) or fit(self, *given, **more)
    )
    assert main(["fit", "--resume", str(run), "--max-steps", "6"]) == 0
    assert [more["max_steps"] for more in fitted] == [6]
    assert yaml.safe_load((run / "run.yaml").read_text())["trainer"]["max_steps"] == 6


def test_a_resumed_run_has_the_patience_that_it_is_given(tmp_path):
    """Noise is learned by heart: held-out bits rise from the first steps on."""
    plans = Plans(torch.randint(3, (40, 8), generator=torch.Generator().manual_seed(0)), 3)
    write_plans(plans, tmp_path / "plans.npz")
    run = tmp_path / "run"
    line = ["fit", str(tmp_path / "plans.npz"), "--config", "gru", "--out", str(run), "--model.learning_rate", "0.02"]
    line += ["--trainer.max_steps", "60", "--data.check_every", "5", "--trainer.patience", "10", "--data.folds", "1"]
    assert main(line) == 0
    stopped = metrics(run)["curve"][-1]["step"]
    assert stopped < 60
    assert main(["fit", "--resume", str(run), "--trainer.patience", "1000"]) == 0
    assert metrics(run)["curve"][-1]["step"] == 60
