"""`neuroprior fit` end to end: recipes, files, the table, settings that reach networks, and what is refused."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch

from neuroprior import CombinedPrior, GRUPrior, MarkovPrior, Plans, TransformerPrior, load
from neuroprior.__main__ import main
from neuroprior.behaviour import Baseline
from neuroprior.cli.fit_data import divide
from neuroprior.plans import read_plans, write_minari, write_plans
from neuroprior.priors import StackedPrior
from neuroprior.priors.scoring import learned_from
from neuroprior.training import Settings
from tests.support.chains import markov_plans, markov_probs
from tests.support.events import write_events
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")

ROOT = Path(__file__).parents[2]
SMALL = {
    "gru": ["--prior.hidden_size", "8"],
    "transformer": ["--prior.width", "16"],
    "markov": [],
    "combined": ["--effort", "fast"],
}
KINDS = {"gru": GRUPrior, "transformer": TransformerPrior, "markov": MarkovPrior, "combined": CombinedPrior}
QUICK = ["--num_plans", "400", "--world.num_worlds", "40", "--check_every", "10", "--batch_size", "64"]
QUICK += ["--max-steps", "30"]


def small(name: str, out: Path) -> list[str]:
    return ["fit", "--config", name, *SMALL[name], *QUICK, "--out", str(out)]


def some_plans(num_plans: int = 300, **more) -> Plans:
    """Plans that mostly repeat their last action, of several lengths."""
    actions = torch.randint(3, (num_plans, 6), generator=seeded(1))
    again = torch.rand(num_plans, 6, generator=seeded(2)) < 0.7
    for t in range(1, 6):
        actions[:, t] = torch.where(again[:, t], actions[:, t - 1], actions[:, t])
    lengths = torch.randint(2, 7, (num_plans,), generator=seeded(3))
    return Plans(actions, 3, lengths=lengths, **more)


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def check_refusal(capsys, arguments: list[str], *words: str) -> None:
    """Exit code 2, and one line."""
    capsys.readouterr()
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert all(word in said for word in words), said


@pytest.fixture
def plans_file(tmp_path) -> str:
    write_plans(some_plans(60), tmp_path / "plans.npz")
    return str(tmp_path / "plans.npz")


@pytest.mark.parametrize("name", SMALL)
def test_each_recipe(name, tmp_path, capsys):
    assert main(small(name, tmp_path / "run")) == 0
    printed = capsys.readouterr().out
    assert isinstance(load(tmp_path / "run"), KINDS[name])
    rows = metrics(tmp_path / "run")["rows"]
    assert [row["model"] for row in rows] == ["uniform", *(f"markov-{k}" for k in range(7)), "context tree", name]
    for row in rows:
        assert row["low"] <= row["bits_per_action"] <= row["high"]
        assert f"{row['bits_per_action']:.4f}" in printed
    assert rows[0]["bits_per_action"] == pytest.approx(2)
    assert rows[-1]["bits_per_action"] < 1.99
    assert (tmp_path / "run" / "learning_curve.png").exists() == (name in ("gru", "transformer"))


@pytest.mark.slow
def test_python_m_train_is_the_same_program(tmp_path):
    arguments = [sys.executable, "-m", "train", *small("markov", tmp_path / "run")]
    done = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert load(tmp_path / "run").order == 3


def test_the_table_is_of_the_held_out_plans(tmp_path, monkeypatch, capsys):
    """The prior's row is what the saved prior takes for the plans that are held out.

    Baselines learn from the training plans and are chosen on the validation plans alone: here the worst is chosen.
    """
    given = []

    def baselines(training, validation, *_):
        given.extend([training, validation])
        for name, prior, bits in (("markov-1", MarkovPrior(3, 1), 9.0), ("markov-0", MarkovPrior(3, 0), 1.0)):
            yield Baseline(name, "as given", prior.fit(training) if training.num_actions == 3 else None, bits)

    monkeypatch.setattr("neuroprior.cli.fit_report.baselines", baselines)
    write_plans(some_plans(), tmp_path / "plans.npz")
    out = tmp_path / "run"
    assert main(["fit", str(tmp_path / "plans.npz"), "--config", "markov", "--out", str(out)]) == 0
    report, generator = metrics(out), seeded(0)
    rest, held_out = some_plans().split(0.1, generator)
    learned, chosen_on = rest.split(1 / 9, generator)
    assert report["plans"] == {"training": 240, "validation": 30, "held_out": 30}
    bits = -load(out).log_prob(held_out).sum() / torch.log(torch.tensor(2.0))
    assert report["rows"][-1]["bits_per_action"] == pytest.approx(float(bits / held_out.lengths.sum()), abs=1e-5)
    assert [plans.actions.tolist() for plans in given] == [learned.actions.tolist(), chosen_on.actions.tolist()]
    assert report["rows"][0]["bits_per_action"] < report["rows"][1]["bits_per_action"]
    assert report["chosen"] == "markov-0"
    assert all(learned_from(out, learned))
    assert all(learned_from(out, chosen_on))
    assert not all(learned_from(out, held_out))
    again = MarkovPrior(**load(out).config).fit(learned)
    assert torch.equal(again.log_prob(held_out.actions), load(out).log_prob(held_out.actions))
    assert "never" not in capsys.readouterr().out
    write_plans(replace(some_plans(), num_actions=5), tmp_path / "more.npz")
    assert main(["fit", str(tmp_path / "more.npz"), "--config=markov", "--out", str(tmp_path / "more")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "uniform counts all 5 actions, of which 3, 4 never occur; without them it needs 1.5850 bits" in printed


GROUPS, STEPS = torch.arange(300) // 10, torch.randint(4, (300, 6), generator=seeded(4))
NAMES = ("left", "on", "right")
FILES = {
    "plain.npz": some_plans(),
    "names.jsonl": some_plans(action_names=NAMES, group=GROUPS),
    "context.jsonl": some_plans(context=STEPS),
    "features.npz": some_plans(context=torch.randn(300, 2, generator=seeded(5))),
    "rows.csv": some_plans(group=GROUPS),
    "rows.tsv": some_plans(action_names=NAMES),
    "steps.csv": some_plans(context=STEPS, group=GROUPS),
    "minari:mice/train-v0": some_plans(context=STEPS),
}


@pytest.mark.parametrize("name", FILES)
def test_each_kind_of_file(name, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    plans, kind = FILES[name], "gru" if name == "features.npz" else "markov"  # features cannot be counted
    if name.startswith("minari:"):
        write_minari(plans, name.removeprefix("minari:"))
    else:
        (write_events if name == "steps.csv" else write_plans)(plans, tmp_path / name)
        name = str(tmp_path / name)
    assert main([*small(kind, tmp_path / "run"), name]) == 0
    report = metrics(tmp_path / "run")
    assert report["unit"] == ("sequences" if plans.group is None else "subjects")
    assert ("context" in report["rows"][-1]["context"]) == (plans.context is not None)
    assert load(tmp_path / "run").takes_context == (plans.context is not None)
    assert read_plans(tmp_path / "run" / "plans.npz").actions.shape == plans.actions.shape


def test_the_order_of_a_chain_is_chosen_on_held_out_plans(tmp_path):
    """Of a source of order 2; an order that is given is the only one that is tried."""
    plans = markov_plans(markov_probs(3, 2, 0, 3), 300, 12, 1)
    write_plans(plans, tmp_path / "plans.npz")
    for more, order, tried in ([], 2, 7), (["--prior.order", "3"], 3, 1):
        out = tmp_path / f"run{order}"
        assert main(["fit", str(tmp_path / "plans.npz"), "--config", "markov", *more, "--out", str(out)]) == 0
        assert load(out).order == order
        table = pd.read_csv(out / "orders.csv")
        assert len(table) == tried
        assert table.loc[table["bits"].idxmin(), "chosen"]


def test_an_end_symbol(tmp_path, plans_file):
    arguments = ["--config", "markov", "--prior.order", "6", "--end", "true", "--out", str(tmp_path / "run")]
    assert main(["fit", plans_file, *arguments]) == 0
    prior = load(tmp_path / "run")
    assert prior.end == 3
    lengths = Plans(prior.sample(400, 9, generator=seeded(0)), 4, end=3).without_end().lengths
    assert lengths.bincount(minlength=10)[2:7].sum() > 300


@pytest.mark.parametrize("per", [(300,), (300, 6)])
@pytest.mark.parametrize("name", ["gru", "markov"])
def test_a_context_that_only_held_out_plans_have(per, name, tmp_path):
    """It is counted among the contexts, and what is paid there is a finite number."""
    _, held_out = some_plans(group=torch.arange(300)).split(0.1, seeded(0))
    context = torch.randint(3, per, generator=seeded(4))
    context[int(held_out.group[0])] = 7
    write_plans(some_plans(context=context), tmp_path / "plans.npz")
    assert main([*small(name, tmp_path / "run"), str(tmp_path / "plans.npz")]) == 0
    assert load(tmp_path / "run").num_contexts == 8
    assert all(0 < row["bits_per_action"] < 10 for row in metrics(tmp_path / "run")["rows"])


def test_the_number_of_contexts_may_be_more_than_occur(tmp_path):
    write_plans(Plans(torch.zeros(30, 4).long(), 2, context=torch.arange(120).view(30, 4) % 3), tmp_path / "plans.npz")
    options = ["--config", "markov", "--prior.num_contexts", "8", "--out", str(tmp_path / "run")]
    assert main(["fit", str(tmp_path / "plans.npz"), *options]) == 0
    assert load(tmp_path / "run").num_contexts == 8


INSIDE = '[{"prior": "MarkovPrior", "config": {"num_actions": 3}}, {"prior": "GRUPrior", "config": {"num_actions": 3}}]'
MADE_OF_PRIORS = {
    "StackedPrior": ["--prior.hidden_size", "8", "--prior.depth", "2"],
    "MixturePrior": ["--prior.experts", INSIDE],
}


@pytest.mark.parametrize("name", MADE_OF_PRIORS)
def test_settings_reach_the_networks_inside_other_priors(name, plans_file, tmp_path, monkeypatch):
    """All of them, and a seed that depends on that of the command."""
    trained = []
    monkeypatch.setattr("neuroprior.training.train", lambda prior, plans, how, seed: trained.append((how, seed)))
    asked = {"max_steps": 3, "batch_size": 16, "window": 5, "learning_rate": 0.02, "weight_decay": 0.5, "patience": 7}
    asked |= {"gradient_clip": 0.3, "validation": 0.2, "check_every": 2}
    options = [f"--{option}={value}" for option, value in asked.items()]
    for seed in ("0", "1"):
        arguments = ["fit", plans_file, "--prior", name, *MADE_OF_PRIORS[name], *options, "--progress=false"]
        assert main([*arguments, "--seed", seed, "--out", str(tmp_path / seed)]) == 0
    (first, seed), (second, other) = trained
    if name == "MixturePrior":  # its networks are stopped by the plans on which its weights are learned
        assert len(first.validation) == len(second.validation) == round(0.2 * 42)  # 42 are learned from
        first, second = (replace(how, validation=0.2) for how in (first, second))
    assert first == second == Settings(**asked, progress=False)
    assert seed != other


def test_a_network_is_stopped_by_the_validation_plans(plans_file, tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr("neuroprior.cli.fit.train", lambda *arguments: given.extend(arguments) or [])
    quick = ["--config", "gru", "--max_steps", "7", "--seed", "3", "--out", str(tmp_path / "run")]
    assert main(["fit", plans_file, *quick]) == 0
    _, plans, how, seed, folder = given
    parts = divide(some_plans(60), seed=3)
    assert plans.actions.equal(parts.learned_from.actions)
    assert how.validation.actions.equal(parts.chosen_on.actions)
    assert (replace(how, validation=0.1), seed, folder) == (Settings(7), 3, tmp_path / "run")


def test_what_is_not_set_is_left_to_the_prior_and_folds_are_silent(plans_file, tmp_path, monkeypatch):
    trained, reported = [], []
    monkeypatch.setattr("neuroprior.training.train", lambda prior, plans, how, seed: trained.append(how))
    monkeypatch.setattr("neuroprior.cli.fit.report", lambda *given: reported.append(given[-1]))
    arguments = ["--prior", "StackedPrior", *MADE_OF_PRIORS["StackedPrior"], "--out", str(tmp_path / "run")]
    assert main(["fit", plans_file, *arguments]) == 0
    StackedPrior(3, 8, depth=2).fit(some_plans(60))
    assert trained[0] == trained[1]
    assert reported == [{"progress": False}]


def test_a_file_alone_is_learned_by_the_combined_prior(plans_file, tmp_path):
    quick = ["--max_steps", "3", "--effort", "fast"]
    assert main(["fit", plans_file, *quick, "--out", str(tmp_path / "run")]) == 0
    prior = load(tmp_path / "run")
    assert isinstance(prior, CombinedPrior)
    assert prior.effort == "fast"
    row = metrics(tmp_path / "run")["rows"][-1]
    assert (row["model"], row["how"]) == ("combined", prior.summary())
    assert main(["fit", *quick, "--config=combined", plans_file, "--out", str(tmp_path / "other")]) == 0
    assert load(tmp_path / "other").log_prob(some_plans(60)).equal(prior.log_prob(some_plans(60)))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", ["plans", "--config", "gru, markov, semi-markov"]),
        ("missing.npz", ["missing.npz"]),
        ("bad.npz", ["bad.npz"]),
        ("PLANS --config markof", ["`config`", "gru, markov, semi-markov", "markof"]),
        ("PLANS --config bad.npz", ["`config`", "bad.npz"]),
        ("PLANS --config words.yaml", ["`config`", "words.yaml"]),
        ("PLANS --prior NoPrior", ["NoPrior"]),
        ("PLANS --prior GRUPrior --prior.hidden 8", ["prior", "hidden"]),
        ("PLANS --prior GRUPrior --prior.hidden_size 0", ["hidden_size"]),
        ("PLANS --nonsense 1", ["nonsense"]),
        ("PLANS --config gru --effort fast", ["effort"]),
        ("PLANS --effort quick", ["effort", "standard", "quick"]),
        ("PLANS --modes 2", ["SwitchingPrior", "CombinedPrior"]),
        ("PLANS --validation 0.6 --held_out 0.5", ["must be above 0 and below 1, got 1.1"]),
        ("PLANS --folds 61", ["`folds` must be from 1 to 60, the number of plans"]),
        ("PLANS --max_steps 0", ["`max_steps` must be a whole number of at least 1, got 0."]),
        ("PLANS --learning_rate=-1", ["`learning_rate`"]),
        ("PLANS --out .", ["`out` must be a new or empty folder, got ."]),
        ("--config gru --world null", ["`plans`"]),
    ],
)
def test_bad_input_is_named_before_anything_is_written(arguments, words, plans_file, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("bad.npz").write_bytes(b"\xff\xfe\x00")
    Path("words.yaml").write_text("just words")
    before = set(tmp_path.rglob("*"))
    check_refusal(capsys, ["fit", *("plans.npz" if word == "PLANS" else word for word in arguments.split())], *words)
    assert {path for path in set(tmp_path.rglob("*")) - before if path.is_file()} == set()


FEW = {
    "two plans": (some_plans(2), ["3 plans", "got 2"]),
    "two groups": (some_plans(9, group=torch.arange(9) // 5), ["3 groups", "got 2"]),
    "two plans of one group": (some_plans(2, group=torch.zeros(2).long()), ["3 plans", "got 2"]),
    "two actions": (Plans(torch.tensor([[0, 1]]), 2), ["3 actions", "got 2"]),
    "no actions": (Plans(torch.zeros(9, 1).long(), 2, torch.zeros(9).long()), ["actions"]),
    "one action each": (Plans(torch.zeros(9, 1).long(), 2), ["`validation`", "at least 2 actions", "got 1"]),
}


@pytest.mark.parametrize("name", FEW)
def test_too_few_plans(name, tmp_path, capsys):
    plans, words = FEW[name]
    write_plans(plans, tmp_path / "plans.npz")
    check_refusal(capsys, [*small("gru", tmp_path / "run"), str(tmp_path / "plans.npz")], *words)
    assert not (tmp_path / "run").exists()
