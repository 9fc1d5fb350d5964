"""`neuroprior sample`: the samples of the library, with names."""

import pytest
import torch

from neuroprior import MarkovPrior, Plans, save
from neuroprior.__main__ import main
from neuroprior.behaviour import SemiMarkovPrior, read
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.reporting import ReadOptions
from neuroprior.plans import read_plans
from tests.support.sources import seeded

OPTIONS = ["--num-plans", "50", "--length", "4", "--temperature", "3", "--seed", "7"]


def learned(**more) -> MarkovPrior:
    plans = Plans(torch.randint(3, (40, 6), generator=seeded(0)).clamp(max=1), 3, action_names=("a", "b", "c"), **more)
    return MarkovPrior(3, 1, num_contexts=2 if more else None).fit(plans)


def test_samples_are_those_of_the_library(tmp_path, capsys):
    prior = learned()
    save(prior, tmp_path / "prior")
    assert main(["sample", str(tmp_path / "prior"), *OPTIONS]) == 0
    (tmp_path / "said.jsonl").write_text(capsys.readouterr().out)
    assert main(["sample", str(tmp_path / "prior"), *OPTIONS, "--out", str(tmp_path / "new.csv")]) == 0
    for name in ("said.jsonl", "new.csv"):
        plans = read_plans(tmp_path / name, action_names=("a", "b", "c"))
        assert torch.equal(plans.actions, prior.sample(50, 4, temperature=3.0, generator=seeded(7)))


def test_samples_with_durations_are_those_of_the_library(tmp_path):
    actions = torch.randint(3, (40, 6), generator=seeded(0))
    times = torch.rand(40, 6, generator=seeded(1)) + 0.5
    prior = SemiMarkovPrior(3).fit(RecordedPlans(actions, 3, action_names=("a", "b", "c"), durations=times))
    save(prior, tmp_path / "prior")
    assert main(["sample", str(tmp_path / "prior"), *OPTIONS, "--out", str(tmp_path / "new.npz")]) == 0
    plans = ReadOptions().read(str(tmp_path / "new.npz"))
    due = prior.sample_plans(50, 4, temperature=3.0, generator=seeded(7))
    assert plans.actions.equal(due.actions)
    assert plans.durations.equal(due.durations)
    assert plans.action_names == ("a", "b", "c")
    assert main(["sample", str(tmp_path / "prior"), *OPTIONS, "--out", str(tmp_path / "new.csv")]) == 0
    events = read(tmp_path / "new.csv").plans(action_names=("a", "b", "c"))
    assert events.actions.equal(due.actions)
    torch.testing.assert_close(events.durations, due.durations)


@pytest.mark.parametrize(("given", "index"), [("wet", 1), ("dry", 0)])
def test_a_context_is_given_by_name(given, index, tmp_path):
    prior = learned(context=torch.arange(40) % 2, context_names=("dry", "wet"))
    save(prior, tmp_path / "prior")
    out = tmp_path / "new.npz"
    assert main(["sample", str(tmp_path / "prior"), *OPTIONS, "--context", given, "--out", str(out)]) == 0
    due = prior.sample(50, 4, torch.full((50,), index), temperature=3.0, generator=seeded(7))
    assert torch.equal(read_plans(out).actions, due)


def test_a_file_that_is_there_is_left_alone(tmp_path, capsys):
    save(learned(), tmp_path / "prior")
    recorded = tmp_path / "recorded.csv"
    recorded.write_text("plan,action\n1,a\n")
    assert main(["sample", str(tmp_path / "prior"), "--out", str(recorded)]) == 2
    assert capsys.readouterr().err == f"error: {recorded}: is there already; give another name\n"
    assert recorded.read_text() == "plan,action\n1,a\n"
