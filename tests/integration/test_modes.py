"""`neuroprior fit --modes`: hidden modes from a file, and what is refused."""

from pathlib import Path

import pandas as pd
import pytest
import torch

from neuroprior import Plans, load, write_plans
from neuroprior.__main__ import main
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.reporting import FitOptions, report
from neuroprior.priors import SwitchingPrior
from tests.support.sources import seeded


def of_modes(plans, *numbers: int, **options):
    """The report's section on these numbers of modes."""
    fits = FitOptions(["counts"], modes=numbers, folds=2, processes=1)
    return report(plans, fits=fits, sections=["modes"], **options)


@pytest.fixture(autouse=True)
def two_folds(monkeypatch):
    """The number of modes is chosen on two folds: to fit the modes on five takes longer than all else."""
    monkeypatch.setattr("neuroprior.behaviour.analysis.modes.FOLDS", 2)


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
    assert (
        main(["fit", file, "--config", "switching", "--modes", "1", "2", "--prior.order", "0", "--out", str(out)]) == 0
    )
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
    assert main(["fit", "--config", "switching", file, "--out", str(tmp_path / "run")]) == 0
    assert load(tmp_path / "run").num_modes == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--modes", "0"], "modes"),
        (["--modes", "2", "--config", "markov"], "SwitchingPrior"),
        (["--config", "switching", "--prior.sharing", "2"], "sharing"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(file, tmp_path, capsys, arguments, message):
    assert main(["fit", file, *arguments, "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert message in said


def test_the_report_describes_the_modes(file, tmp_path):
    """The commonest takes action 0 or 1 alone, and comes back; the runs are the modes' own."""
    made = of_modes(file, 1, 2, out=tmp_path / "report")
    assert [section.title for section in made.sections] == ["Hidden modes"]
    frames = made.frames
    assert frames["modes"].loc[frames["modes"]["chosen"], "modes"].tolist() == [2]
    assert frames["mode_table"]["stable"].tolist() == ["yes", "yes"]
    assert sum(frames["mode_table"]["share"]) == pytest.approx(1)
    assert "mode 1, mode 2" in made.sections[0].text[1]
    occupancy = frames["mode_occupancy"]
    assert occupancy.groupby("part")["share"].sum().tolist() == pytest.approx([1.0] * 10)
    assert len(frames["mode_actions"]) == 30 * 60
    assert set(made.figures) == {"mode_ethogram", "mode_occupancy", "mode_transitions"}
    assert (tmp_path / "report" / "mode_table.csv").is_file()


@pytest.mark.slow
def test_the_report_compares_conditions_by_modes():
    """Six animals that are hardly ever in the second mode against six that often are."""
    often = (torch.arange(36) % 2)[:, None]
    mode = (torch.rand(36, 8, generator=seeded(3)) < 0.15 + 0.5 * often).long().repeat_interleave(10, 1)
    wild = torch.rand(36, 80, generator=seeded(1)) < 0.2
    actions = torch.where(wild, torch.randint(3, (36, 80), generator=seeded(2)), mode)
    group = torch.arange(36) % 12
    plans = RecordedPlans(actions, 3, group=group, condition=often[:, 0], condition_names=("control", "treated"))
    made = of_modes(plans, 2)
    tests = made.frames["mode_condition_tests"].set_index("test")
    assert tests.loc["behaviours", "p_value"] < 0.05
    assert "mode_conditions" in made.figures
    features = made.frames["mode_conditions"]
    assert any("mode 2" in str(name) for name in features["feature"])


def test_the_report_says_where_there_is_no_sign_of_modes():
    actions = torch.randint(3, (20, 40), generator=seeded(0))
    made = of_modes(Plans(actions, 3), 1, 2)
    assert "no sign" in made.sections[0].text[-1]
    assert list(made.frames) == ["modes"]


def test_the_report_refuses_modes_that_cannot_be():
    plans = Plans(torch.zeros(4, 4, dtype=torch.long), 3)
    with pytest.raises(ValueError, match="modes"):
        of_modes(plans, 0)
    with pytest.raises(ValueError, match="`models`, `modes`, `folds` must be left out"):
        of_modes(plans, 2, priors={"one": SwitchingPrior(3)})


@pytest.mark.slow
def test_the_modes_of_a_single_long_plan_are_described_over_its_course():
    """Parts serve to choose among numbers of modes; occupancy is over the plan, which begins in one mode alone."""
    mode = (torch.arange(500) // 20) % 2
    mode[:100] = 0
    wild = torch.rand(500, generator=seeded(1)) < 0.2
    actions = torch.where(wild, torch.randint(3, (500,), generator=seeded(2)), mode)
    made = of_modes(Plans(actions[None], 3), 2, skip=30)  # more than a part has
    assert len(made.frames["mode_actions"]) == 500
    assert made.frames["mode_actions"]["step"].max() == 499
    occupancy = made.frames["mode_occupancy"]
    first = occupancy[occupancy["part"] == 1].set_index("mode")["share"]
    assert first.max() > 0.9
