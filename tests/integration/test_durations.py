"""Durations on the command line: a semi-Markov prior fitted and sampled, and networks that know the last durations."""

import json
import math
from pathlib import Path

import pandas as pd
import pytest
import torch

from neuroprior.__main__ import main
from neuroprior.behaviour import PastDurations, SemiMarkovPrior
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.reporting import ReadOptions
from neuroprior.plans import write_plans
from neuroprior.priors import GRUPrior, MarkovPrior, load, match_plans
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")

QUICK = ["--max_steps", "40", "--check_every", "10"]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Actions that follow from whether the last one took long."""
    durations = torch.empty(60, 20).exponential_(generator=seeded(0))
    actions = torch.randint(3, (60, 20), generator=seeded(1))
    actions[:, 1:] = torch.where(durations[:, :-1] > 0.7, 0, actions[:, 1:])
    place = tmp_path_factory.mktemp("plans") / "plans.npz"
    write_plans(RecordedPlans(actions, 3, durations=durations, action_names=("a", "b", "c")), place)
    return str(place)


def test_the_recipe_and_its_samples(file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = str(tmp_path / "run")
    assert main(["fit", "--config", "semi-markov", file, "--end", "true", "--out", out]) == 0
    prior = load(out)
    assert isinstance(prior, SemiMarkovPrior)
    assert isinstance(prior.actions, MarkovPrior)
    assert prior.actions.order == 2
    capsys.readouterr()
    for suffix in ("jsonl", "csv", "npz"):
        assert main(["sample", out, "--num-plans", "30", "--length", "9", "--out", f"{out}.{suffix}"]) == 0
        assert len(ReadOptions().read(f"{out}.{suffix}")) == 30
    sampled = ReadOptions().read(f"{out}.npz")
    assert bool((sampled.durations[sampled.mask()] > 0).all())
    capsys.readouterr()
    assert main(["sample", out, "--num-plans", "30", "--length", "9"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()[1:]]
    assert [len(row["actions"]) for row in rows] == sampled.mask().sum(1).tolist()


def test_a_network_as_its_action_prior(file: str, tmp_path: Path):
    actions = ["--prior.actions", "neuroprior.priors.GRUPrior", "--prior.actions.hidden_size", "8"]
    run = ["--config", "semi-markov", *actions, file, *QUICK, "--out", str(tmp_path / "run")]
    assert main(["fit", *run]) == 0
    assert load(tmp_path / "run").actions.hidden_size == 8


@pytest.mark.slow
def test_a_network_that_knows_the_last_durations(file: str, tmp_path: Path):
    """It is better than one that does not; score and report make the same context; a resumed run keeps it."""
    out, gru = str(tmp_path / "run"), ["--config", "gru", "--prior.hidden_size", "16"]
    assert main(["fit", *gru, file, "--past_durations", "1", *QUICK, "--out", out]) == 0
    prior = load(out)
    assert isinstance(prior, GRUPrior)
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["rows"]
    assert rows[-1]["bits_per_action"] < min(row["bits_per_action"] for row in rows[:-1]) - 0.1
    plans, past = ReadOptions().read(file), PastDurations.load(tmp_path / "run")
    nats = -prior.log_prob(past.added_to(match_plans(plans, prior))).detach().sum().item()
    expected = nats / math.log(2) / plans.actions.numel()
    assert main(["score", out, file, "--out", str(tmp_path / "score")]) == 0
    scored = pd.read_csv(tmp_path / "score" / "plans.csv")
    assert scored["log_likelihood"].sum() == pytest.approx(-nats, rel=1e-5)
    assert main(["report", file, "--priors", out, "--out", str(tmp_path / "report")]) == 0
    (row,) = json.loads((tmp_path / "report" / "results.json").read_text())["scores"]
    assert row["bits_per_behaviour"] == pytest.approx(expected, abs=1e-4)
    assert row["input"] == "behaviours and durations"
    assert main(["fit", "--resume", out]) == 0
    assert PastDurations.load(tmp_path / "run") == past


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["markov", "--past_durations", "1"], ["`prior`", "context_size"]),
        (["gru", "--past_durations", "-1"], ["`past_durations` must be at least 0"]),
        (["semi-markov", "--past_durations", "1"], ["`prior`", "context_size"]),
    ],
)
def test_faults_are_one_line(arguments, words, file, tmp_path, capsys):
    assert main(["fit", "--config", *arguments, file, "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert all(word in said for word in words), said
