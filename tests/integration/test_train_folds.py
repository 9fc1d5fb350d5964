"""`fit` on few groups: a cross-validation over them, against fits made by hand."""

import json

import pytest
import torch

import neuroprior.cli.fit_folds
from neuroprior import GRUPrior, MarkovPrior, Plans, load
from neuroprior.__main__ import main
from neuroprior.behaviour.analysis.comparison import score
from neuroprior.plans import write_plans
from neuroprior.plans.folds import folds
from tests.integration.test_train import metrics, some_plans
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")

GRU = ["--config", "gru", "--prior.hidden_size", "4", "--max_steps", "10"]


def grouped(groups: int, num: int = 60) -> Plans:
    return some_plans(num, group=torch.arange(num) % groups * 3)


def arguments_of(plans: Plans, out, *more: str) -> list[str]:
    file = out.with_suffix(".npz")
    write_plans(plans, file)
    return ["fit", str(file), "--out", str(out), *more]


@pytest.fixture(autouse=True)
def one_process(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 1)


def bits_of_folds(plans: Plans, number: int, fit) -> float:
    """Bits per action of priors that are fitted without each fold, on it."""
    parts = enumerate(folds(plans, number, 0))
    total = sum(float(score("", fit(k, plans[some]), plans[rest]).bits.sum()) for k, (some, rest) in parts)
    return total / int(plans.mask().sum())


def test_each_group_is_held_out_once(tmp_path, capsys):
    plans = grouped(6)
    assert main(arguments_of(plans, tmp_path / "run", "--config", "markov", "--prior.order", "3")) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert all(words in printed for words in ("5 times more", "--folds 1", "60 held-out plans", "5 folds"))
    assert "*: best on the validation plans" in printed
    found = metrics(tmp_path / "run")
    assert (found["folds"], found["unit"]) == (5, "subjects")
    assert found["plans"] == {"training": 50, "validation": 10, "held_out": 60}
    rows = {row["model"]: row for row in found["rows"]}
    chosen = load(tmp_path / "run").config
    assert chosen["order"] == 3
    due = bits_of_folds(plans, 5, lambda fold, training: MarkovPrior(**chosen).fit(training))
    assert rows["markov"]["bits_per_action"] == pytest.approx(due, rel=1e-5)
    assert rows["uniform"]["bits_per_action"] == pytest.approx(torch.tensor(3.0).log2().item(), rel=1e-5)
    assert rows["uniform"]["more_low"] < rows["uniform"]["more_than_trained"]
    assert all(row["validation_bits"] for row in found["rows"][:-1])
    # The prior that is saved has learned from all groups.
    whole = MarkovPrior(**chosen).fit(plans)
    torch.testing.assert_close(load(tmp_path / "run").log_prob(plans.actions), whole.log_prob(plans.actions))


def test_a_network_is_trained_with_the_same_settings_in_each_fold(tmp_path, capsys):
    plans = grouped(3)
    assert main(arguments_of(plans, tmp_path / "run", *GRU)) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "3 subjects are too few for a verdict" in printed
    assert "*" not in printed

    def fit(fold, training):
        return GRUPrior(3, hidden_size=4).fit(training, generator=seeded(fold), max_steps=10, progress=False)

    found = metrics(tmp_path / "run")
    assert found["rows"][-1]["bits_per_action"] == pytest.approx(bits_of_folds(plans, 3, fit), rel=1e-4)
    assert [row["step"] for row in found["curve"]] == [10]
    assert found["plans"]["training"] + found["plans"]["validation"] == 60


def test_an_interrupted_cross_validation_goes_on(tmp_path, capsys, monkeypatch):
    plans, right, calls = grouped(4), neuroprior.cli.fit_folds.baselines, []
    assert main(arguments_of(plans, tmp_path / "whole", *GRU)) == 0

    def interrupted(*given):
        calls.append(given)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return right(*given)

    monkeypatch.setattr(neuroprior.cli.fit_folds, "baselines", interrupted)
    out = tmp_path / "run"
    assert main(arguments_of(plans, out, *GRU)) == 130
    assert f"neuroprior fit --resume {out}" in capsys.readouterr().err.splitlines()[-1]
    assert load(out).num_actions == 3
    assert main(["fit", "--resume", str(out)]) == 0
    assert len(calls) == 5  # two folds before, the third again, and the fourth
    assert json.dumps(metrics(out)) == json.dumps(metrics(tmp_path / "whole"))
