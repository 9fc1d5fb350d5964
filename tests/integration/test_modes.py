"""`neuroprior fit --modes`: hidden modes from a file, and what is refused."""

from pathlib import Path

import pandas as pd
import pytest
import torch

from neuroprior import Plans, load, write_plans
from neuroprior.cli.__main__ import main
from neuroprior.priors import SwitchingPrior
from tests.support.sources import seeded


@pytest.fixture
def file(tmp_path: Path) -> str:
    """Plans of two modes: nearly always 0, or nearly always 1, for ten actions each."""
    mode = (torch.arange(60) // 10 + torch.randint(2, (30, 1), generator=seeded(0))) % 2
    wild = torch.rand(30, 60, generator=seeded(1)) < 0.2
    actions = torch.where(wild, torch.randint(3, (30, 60), generator=seeded(2)), mode)
    write_plans(Plans(actions, 3, action_names=("a", "b", "c")), tmp_path / "plans.jsonl")
    return str(tmp_path / "plans.jsonl")


def test_the_number_of_modes_is_chosen_and_the_prior_saved(file, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["fit", file, "--modes", "1", "2", "--model.prior.order", "0", "--out", str(out)]) == 0
    prior = load(out)
    assert isinstance(prior, SwitchingPrior)
    assert (prior.num_modes, prior.order) == (2, 0)
    table = pd.read_csv(out / "modes.csv")
    assert table["modes"].tolist() == [1, 2]
    assert table["chosen"].tolist() == [False, True]
    assert "Hidden modes" in capsys.readouterr().out
    rates = prior.log_probs[prior.cells(torch.tensor([[0, 0]]), None)[0][0, 1]].exp()
    assert sorted(rates[:, 0].tolist()) == pytest.approx([0.07, 0.87], abs=0.05)


def test_the_recipe_without_a_choice(file, tmp_path):
    assert main(["fit", "--config", "switching", "--data.file", file, "--out", str(tmp_path / "run")]) == 0
    assert load(tmp_path / "run").num_modes == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--modes", "0"], "modes"),
        (["--modes", "2", "--config", "markov"], "SwitchingPrior"),
        (["--config", "switching", "--model.prior.sharing", "2"], "sharing"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(file, tmp_path, capsys, arguments, message):
    assert main(["fit", "--data.file", file, *arguments, "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert message in said
