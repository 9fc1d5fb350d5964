"""`python -m train` when things go wrong: bad options and files, too few plans, contexts that are new."""

import json
from pathlib import Path

import pytest
import torch

from neuroprior import Plans, load
from neuroprior.plans import read_plans, write_plans
from tests.integration.test_train import QUICK, SMALL, recipe, run, small, some_plans
from tests.support.sources import seeded
from train.__main__ import main

pytestmark = pytest.mark.usefixtures("undrawn")


def one_line(capsys, arguments: list[str], *words: str, code: int = 2) -> None:
    capsys.readouterr()
    assert main(arguments) == code
    said = capsys.readouterr().err
    assert said.count("\n") == 1, said
    assert said.startswith("error: ")
    assert len(said) < 600
    assert all(word in said for word in words), said


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


@pytest.mark.parametrize("name", ["gru", "markov"])
@pytest.mark.parametrize("per", ["plan", "step"])
def test_a_context_that_only_held_out_plans_have(per, name, tmp_path):
    """It is counted among the contexts, and what is paid there is a finite number."""
    _, held_out = some_plans(context=torch.arange(300)).split(0.1, seeded(0))
    plan = int(held_out.context[0])
    context = torch.randint(3, (300,) if per == "plan" else (300, 6), generator=seeded(4))
    context[plan if per == "plan" else (plan, 0)] = 7
    write_plans(some_plans(context=context), tmp_path / "plans.npz")
    assert main([*small(name, tmp_path / "run"), "--data.file", str(tmp_path / "plans.npz")]) == 0
    assert load(tmp_path / "run").num_contexts == 8
    rows = metrics(tmp_path / "run")["rows"]
    assert all(0 < row["bits_per_action"] < 10 for row in rows)


def test_a_mistyped_file_does_not_block_the_folder(tmp_path, capsys):
    write_plans(some_plans(), tmp_path / "plans.npz")
    (tmp_path / "bad.npz").write_bytes(b"no plans")
    arguments = small("markov", tmp_path / "run")
    for name in ("plan.npz", "bad.npz", "plans"):
        one_line(capsys, [*arguments, "--data.file", str(tmp_path / name)], name)
    assert main([*arguments, "--data.file", str(tmp_path / "plans.npz")]) == 0


def test_plans_that_are_there_without_a_run_are_not_replaced(tmp_path, capsys):
    """They are somebody's, or of a try that ended between the two files of a run: the next try is of its own."""
    write_plans(some_plans(), tmp_path / "plans.npz")
    (tmp_path / "run").mkdir()
    write_plans(some_plans(40), tmp_path / "run" / "plans.npz")
    arguments = [*small("markov", tmp_path / "run"), "--data.file", str(tmp_path / "plans.npz")]
    one_line(capsys, arguments, "plans.npz is there, and of no run that began; move it away")
    assert len(read_plans(tmp_path / "run" / "plans.npz")) == 40
    (tmp_path / "run" / "plans.npz").rename(tmp_path / "theirs.npz")
    assert main(arguments) == 0
    assert len(read_plans(tmp_path / "run" / "plans.npz")) == 300
    rows = metrics(tmp_path / "run")["rows"]
    assert main(["fit", "--resume", str(tmp_path / "run")]) == 0
    assert metrics(tmp_path / "run")["rows"] == rows


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--out", ""], ["out"]),
        (["--model.learning_rate", "-1"], ["learning_rate"]),
        (["--model.learning_rate", "nan"], ["learning_rate"]),
        (["--model.weight_decay", "-1"], ["weight_decay"]),
        (["--trainer.accumulate_grad_batches", "0"], ["accumulate_grad_batches"]),
        (["--trainer.patience", "0"], ["patience"]),
        (["--trainer.max_steps", "0"], ["max_steps"]),
        (["--data.check_every", "0"], ["check_every"]),
        (["--data.window", "0"], ["window"]),
        (["--data.batch_size", "-3"], ["batch_size"]),
        (["--data.validation", "0"], ["validation"]),
    ],
)
def test_bad_options_are_named_before_any_training(more, words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    one_line(capsys, [*small("gru", tmp_path / "run"), *more], *words)
    assert not list(tmp_path.rglob("*.*"))


FEW = {
    "two plans": (some_plans(2), ["2 plans", "3 plans"]),
    "two groups": (some_plans(9, group=torch.arange(9) // 5), ["2 groups", "3 groups"]),
    "two plans of one group": (some_plans(2, group=torch.zeros(2).long()), ["2 plans"]),
    "two actions": (Plans(torch.tensor([[0, 1]]), 2), ["2 actions", "3 actions"]),
    "no actions": (Plans(torch.zeros(9, 1).long(), 2, torch.zeros(9).long()), ["actions"]),
    "one action each": (Plans(torch.zeros(9, 1).long(), 2), ["actions are left", "validation"]),
}


@pytest.mark.parametrize("name", FEW)
def test_too_few_plans_are_named_before_any_training(name, tmp_path, capsys):
    plans, words = FEW[name]
    write_plans(plans, tmp_path / "plans.npz")
    one_line(capsys, [*small("gru", tmp_path / "run"), "--data.file", str(tmp_path / "plans.npz")], *words)
    assert not list((tmp_path / "run").rglob("*.*"))


def test_few_plans_are_enough(tmp_path, monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # processes take long to start
    write_plans(some_plans(6, group=torch.arange(6) // 2), tmp_path / "plans.npz")
    assert main([*small("gru", tmp_path / "run"), "--data.file", str(tmp_path / "plans.npz")]) == 0
    assert metrics(tmp_path / "run")["plans"] == {"training": 4, "validation": 2, "held_out": 6}


def test_half_precision(tmp_path):
    assert main([*small("gru", tmp_path / "run"), "--trainer.precision", "bf16-mixed"]) == 0
    prior = load(tmp_path / "run")
    assert all(weight.dtype == torch.float32 for weight in prior.parameters())
    assert metrics(tmp_path / "run")["rows"][-1]["bits_per_action"] < 1.99
    assert prior.log_prob(torch.tensor([[0, 1, 2]])).isfinite().all()


@pytest.mark.slow
def test_two_processes_learn_from_long_plans_what_one_does(tmp_path):
    """In windows, with the hidden state carried over, and as many pieces as two processes cannot share evenly."""
    actions = (torch.arange(9 * 300).view(9, 300) // 3 + torch.arange(9)[:, None]) % 4
    noise = torch.rand(9, 300, generator=seeded(0)) < 0.2
    actions = torch.where(noise, torch.randint(4, (9, 300), generator=seeded(1)), actions)
    write_plans(Plans(actions, 4, torch.randint(100, 301, (9,), generator=seeded(2))), tmp_path / "plans.npz")
    more = [*QUICK, *SMALL["gru"], "--data.file", str(tmp_path / "plans.npz"), "--data.window", "16"]
    # Each process draws what it drops by itself.
    more += ["--data.batch_size", "5", "--model.prior.dropout", "0"]
    two = run([*recipe("gru"), *more, "--out", str(tmp_path / "two"), "--trainer.devices=2", "--trainer.strategy=ddp"])
    assert two.returncode == 0, two.stderr
    assert main([*recipe("gru"), *more, "--out", str(tmp_path / "one")]) == 0
    one, other = (metrics(tmp_path / name)["curve"] for name in ("one", "two"))
    assert len(one) == len(other) == 3
    for here, there in zip(one, other, strict=True):
        assert here == pytest.approx(there, abs=1e-3)
