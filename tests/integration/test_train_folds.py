"""`fit` on few groups: a cross-validation over them, against fits made by hand."""

import json
from pathlib import Path

import pytest
import torch

import neuroprior.cli.fit_folds
from neuroprior import GRUPrior, MarkovPrior, Plans, load
from neuroprior.behaviour.analysis.comparison import score
from neuroprior.plans import write_plans
from neuroprior.plans.folds import folds
from tests.integration.test_train import recipe, some_plans
from tests.integration.test_train_faults import metrics, one_line
from tests.support.sources import seeded
from train.__main__ import main

pytestmark = pytest.mark.usefixtures("undrawn")

GRU = ["--model.prior.hidden_size", "4", "--trainer.max_steps", "10", "--trainer.accelerator", "cpu"]


def grouped(groups: int, num: int = 60) -> Plans:
    return some_plans(num, group=torch.arange(num) % groups * 3)


def fitted(name: str, plans: Plans, out: Path, *more: str) -> list[str]:
    file = out.with_suffix(".npz")
    write_plans(plans, file)
    return [*recipe(name), "--data.file", str(file), "--out", str(out), *more]


@pytest.fixture(autouse=True)
def one_process(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 1)


def test_each_group_is_held_out_once(tmp_path, capsys):
    plans = grouped(6)
    assert main(fitted("markov", plans, tmp_path / "run")) == 0
    printed = capsys.readouterr().out
    assert "5 times more" in printed
    assert "--data.folds 1" in printed
    assert "60 held-out plans" in printed
    found = metrics(tmp_path / "run")
    assert (found["folds"], found["unit"]) == (5, "groups")
    assert found["plans"] == {"training": 50, "validation": 10, "held_out": 60}
    total = {"markov": 0.0, "uniform": 0.0}
    for training, held_out in folds(plans, 5, 0):
        prior = MarkovPrior(3, 3).fit(plans[training])
        total["markov"] += float(score("", prior, plans[held_out]).bits.sum())
    total["uniform"] = float(plans.mask().sum()) * torch.tensor(3.0).log2().item()
    rows = {row["model"]: row for row in found["rows"]}
    for name, bits in total.items():
        assert rows[name]["bits_per_action"] == pytest.approx(bits / int(plans.mask().sum()), rel=1e-5)
    assert rows["uniform"]["more_low"] < rows["uniform"]["more_than_trained"]
    assert all(row["validation_bits"] for row in found["rows"][:-1])
    # The prior that is saved has learned from all groups.
    whole = MarkovPrior(3, 3).fit(plans)
    torch.testing.assert_close(load(tmp_path / "run").log_prob(plans.actions), whole.log_prob(plans.actions))


def test_a_network_is_trained_with_the_same_settings_in_each_fold(tmp_path):
    plans = grouped(3)
    assert main(fitted("gru", plans, tmp_path / "run", *GRU)) == 0
    total = 0.0
    for fold, (training, held_out) in enumerate(folds(plans, 3, 0)):
        prior = GRUPrior(3, hidden_size=4)
        prior.fit(plans[training], generator=seeded(fold), max_steps=10, patience=400, progress=False)
        total += float(score("", prior, plans[held_out]).bits.sum())
    found = metrics(tmp_path / "run")
    assert found["folds"] == 3
    assert found["rows"][-1]["bits_per_action"] == pytest.approx(total / int(plans.mask().sum()), rel=1e-4)
    assert [row["step"] for row in found["curve"]] == [10]
    assert found["plans"]["training"] + found["plans"]["validation"] == 60


def test_an_interrupted_cross_validation_goes_on(tmp_path, capsys, monkeypatch):
    plans, right, calls = grouped(4), neuroprior.cli.fit_folds.baselines, []
    assert main(fitted("gru", plans, tmp_path / "whole", *GRU)) == 0

    def interrupted(*given):
        calls.append(given)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return right(*given)

    monkeypatch.setattr(neuroprior.cli.fit_folds, "baselines", interrupted)
    out = tmp_path / "run"
    capsys.readouterr()
    assert main(fitted("gru", plans, out, *GRU)) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert "the prior is saved" in said
    assert f"--resume {out}" in said
    assert load(out).num_actions == 3
    assert main(["fit", "--resume", str(out)]) == 0
    assert len(calls) == 5  # two folds before, the third again, and the fourth
    assert json.dumps(metrics(out)) == json.dumps(metrics(tmp_path / "whole"))


@pytest.mark.parametrize(
    ("groups", "options", "number"),
    [(14, [], 5), (15, [], 1), (6, ["--data.folds", "1"], 1), (20, ["--data.folds", "2"], 2)],
)
def test_how_many_folds(groups, options, number, tmp_path):
    assert main(fitted("markov", grouped(groups), tmp_path / "run", *options)) == 0
    found = metrics(tmp_path / "run")
    assert found["folds"] == number
    assert (found["plans"]["held_out"] == 60) == (number > 1)


def test_folds_that_cannot_be(tmp_path, capsys):
    for wrong in ("0", "7"):
        arguments = fitted("markov", grouped(6), tmp_path / "run", "--data.folds", wrong)
        one_line(capsys, arguments, "data.folds", "groups, 6", wrong)
    arguments = fitted("gru", grouped(6), tmp_path / "run", *GRU, "--trainer.accumulate_grad_batches", "2")
    one_line(capsys, arguments, "accumulate_grad_batches", "--data.folds 1")


def test_few_groups_bear_no_verdict(tmp_path, capsys):
    assert main(fitted("markov", grouped(4), tmp_path / "run")) == 0
    few = capsys.readouterr().out
    assert "4 groups are too few for a verdict" in " ".join(few.split())
    assert "*" not in few
    assert main(fitted("markov", grouped(6), tmp_path / "six")) == 0
    assert "*: best on the validation plans" in " ".join(capsys.readouterr().out.split())
