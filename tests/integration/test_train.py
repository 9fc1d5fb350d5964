"""`python -m train` end to end: recipes, files, the table, faults, interruption and resuming."""

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neuroprior import CombinedPrior, GRUPrior, MarkovPrior, Plans, TransformerPrior, load
from neuroprior.behaviour import Baseline
from neuroprior.plans import read_plans, write_minari, write_plans
from neuroprior.priors import StackedPrior
from neuroprior.priors.scoring import learned_from
from neuroprior.training import PriorModule, Settings
from tests.support.sources import seeded
from train.__main__ import main

pytestmark = pytest.mark.usefixtures("undrawn")

ROOT = Path(__file__).parents[2]
SMALL = {
    "gru": ["--model.prior.hidden_size", "8"],
    "transformer": ["--model.prior.width", "16"],
    "markov": [],
    "combined": ["--model.prior.effort", "fast"],
}
QUICK = [
    "--data.num_plans",
    "400",
    "--data.world.num_worlds",
    "40",
    "--data.check_every",
    "10",
    "--data.batch_size",
    "64",
]
QUICK += ["--trainer.max_steps", "30", "--trainer.accelerator", "cpu"]


def recipe(name: str) -> list[str]:
    return ["fit", "--config", str(ROOT / "train" / f"{name}.yaml")]


def small(name: str, out: Path) -> list[str]:
    return [*recipe(name), *SMALL[name], *QUICK, "--out", str(out)]


def some_plans(num_plans: int = 300, **more) -> Plans:
    """Plans that mostly repeat their last action, of several lengths."""
    actions = torch.randint(3, (num_plans, 6), generator=seeded(1))
    again = torch.rand(num_plans, 6, generator=seeded(2)) < 0.7
    for t in range(1, 6):
        actions[:, t] = torch.where(again[:, t], actions[:, t - 1], actions[:, t])
    lengths = torch.randint(2, 7, (num_plans,), generator=seeded(3))
    return Plans(actions, 3, lengths=lengths, **more)


def run(arguments: list[str], **more) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "train", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=300, **more
    )


KINDS = {"gru": GRUPrior, "transformer": TransformerPrior, "markov": MarkovPrior, "combined": CombinedPrior}


@pytest.mark.parametrize("name", SMALL)
def test_each_recipe(name, tmp_path, capsys):
    assert main(small(name, tmp_path / "run")) == 0
    printed = capsys.readouterr().out
    prior = load(tmp_path / "run")
    assert isinstance(prior, KINDS[name])
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["rows"]
    models = [row["model"] for row in rows]
    assert models[0] == "uniform"
    assert models[-1] == name
    assert [model for model in models if model.startswith("markov-")] == [f"markov-{k}" for k in range(7)]
    assert "context tree" in models
    for row in rows:
        assert row["low"] <= row["bits_per_action"] <= row["high"]
        assert f"{row['bits_per_action']:.4f}" in printed
    assert rows[0]["bits_per_action"] == pytest.approx(2)
    assert rows[-1]["bits_per_action"] < 1.99
    assert (tmp_path / "run" / "learning_curve.png").exists() == (name in ("gru", "transformer"))


def test_the_table_is_of_the_held_out_plans(tmp_path, monkeypatch, capsys):
    """The trained prior's row is what the saved prior takes for the plans that the split holds out.

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
    assert main([*recipe("markov"), "--data.file", str(tmp_path / "plans.npz"), "--out", str(out)]) == 0
    report = json.loads((out / "metrics.json").read_text())
    generator = seeded(0)
    rest, held_out = some_plans().split(0.1, generator)
    assert report["plans"] == {"training": 240, "validation": 30, "held_out": 30}
    bits = -load(out).log_prob(held_out).sum() / torch.log(torch.tensor(2.0))
    assert report["rows"][-1]["bits_per_action"] == pytest.approx(float(bits / held_out.lengths.sum()), abs=1e-5)
    learned, chosen_on = rest.split(1 / 9, generator)
    assert [plans.actions.tolist() for plans in given] == [learned.actions.tolist(), chosen_on.actions.tolist()]
    assert report["rows"][0]["bits_per_action"] < report["rows"][1]["bits_per_action"]
    assert report["chosen"] == "markov-0"
    assert all(learned_from(out, learned))
    assert all(learned_from(out, chosen_on))
    assert not all(learned_from(out, held_out))
    assert "never" not in capsys.readouterr().out
    write_plans(replace(some_plans(), num_actions=5), tmp_path / "more.npz")
    assert main([*recipe("markov"), "--data.file", str(tmp_path / "more.npz"), "--out", str(tmp_path / "more")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "uniform counts all 5 actions, of which 3, 4 never occur; without them it needs 1.5850 bits" in printed
    again = MarkovPrior(3, 3).fit(learned)
    assert torch.equal(again.log_prob(held_out.actions), load(out).log_prob(held_out.actions))


def files() -> dict[str, tuple[Plans, str]]:
    groups = torch.arange(300) // 10
    steps = torch.randint(4, (300, 6), generator=seeded(4))
    return {
        "plain.npz": (some_plans(), "actions"),
        "names.jsonl": (some_plans(action_names=("left", "on", "right"), group=groups), "actions"),
        "context.jsonl": (some_plans(context=steps), "context"),
        "features.npz": (some_plans(context=torch.randn(300, 2, generator=seeded(5))), "context"),
        "rows.csv": (some_plans(group=groups), "actions"),
        "rows.tsv": (some_plans(action_names=("left", "on", "right")), "actions"),
        "steps.csv": (some_plans(context=steps, group=groups), "context"),
    }


@pytest.mark.parametrize("name", files())
def test_each_kind_of_file(name, tmp_path):
    plans, takes = files()[name]
    write_plans(plans, tmp_path / name)
    kind = "gru" if name == "features.npz" else "markov"  # features cannot be counted
    assert main([*small(kind, tmp_path / "run"), "--data.file", str(tmp_path / name)]) == 0
    report = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert report["unit"] == ("plans" if plans.group is None else "groups")
    assert ("context" in report["rows"][-1]["context"]) == (takes == "context")
    assert read_plans(tmp_path / "run" / "plans.npz").actions.shape == plans.actions.shape


def test_a_minari_dataset(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    write_minari(some_plans(60, context=torch.randint(4, (60, 6), generator=seeded(4))), "mice/train-v0")
    assert main([*small("markov", tmp_path / "run"), "--data.file", "minari:mice/train-v0"]) == 0
    assert load(tmp_path / "run").num_contexts == 4


def test_an_end_symbol(tmp_path):
    write_plans(some_plans(), tmp_path / "plans.npz")
    arguments = ["--data.file", str(tmp_path / "plans.npz"), "--data.end", "true", "--out", str(tmp_path / "run")]
    assert main([*recipe("markov"), "--model.prior.order", "6", *arguments]) == 0
    prior = load(tmp_path / "run")
    assert prior.end == 3
    lengths = Plans(prior.sample(4000, 9, generator=seeded(0)), 4, end=3).without_end().lengths
    drawn = lengths.bincount(minlength=10)
    assert drawn[2:7].min() > 400
    assert drawn[2:7].sum() > 3600


@pytest.mark.slow
def test_two_processes_learn_what_one_does(tmp_path):
    exactly = ["--model.prior.dropout", "0"]
    two = run([*small("gru", tmp_path / "two"), *exactly, "--trainer.devices", "2", "--trainer.strategy", "ddp"])
    assert two.returncode == 0, two.stderr
    assert main([*small("gru", tmp_path / "one"), *exactly]) == 0
    curves = [json.loads((tmp_path / name / "metrics.json").read_text())["curve"] for name in ("one", "two")]
    assert len(curves[0]) == len(curves[1]) == 3
    for one, other in zip(*curves, strict=True):
        assert one["step"] == other["step"]
        assert one["validation_bits"] == pytest.approx(other["validation_bits"], abs=1e-4)


@pytest.fixture(scope="module")
def plans_file(tmp_path_factory) -> str:
    place = tmp_path_factory.mktemp("plans") / "plans.npz"
    write_plans(some_plans(60), place)
    return str(place)


INSIDE = '[{"prior": "MarkovPrior", "config": {"num_actions": 3}}, {"prior": "GRUPrior", "config": {"num_actions": 3}}]'
INNER = '{"prior": "GRUPrior", "config": {"num_actions": 5, "hidden_size": 8}}'
MADE_OF_PRIORS = {
    "StackedPrior": ["--model.prior.hidden_size", "8", "--model.prior.depth", "2"],
    "MixturePrior": ["--model.prior.experts", INSIDE],
    "MacroPrior": ["--model.prior.inner", INNER],
}


@pytest.mark.parametrize("name", MADE_OF_PRIORS)
def test_the_settings_of_a_recipe_reach_the_networks_inside_other_priors(name, plans_file, tmp_path, monkeypatch):
    """All of them, and a seed that depends on that of the command."""
    trained = []
    monkeypatch.setattr("neuroprior.training.train", lambda prior, plans, how, seed: trained.append((how, seed)))
    asked = {"trainer": {"max_steps": 3, "patience": 7, "gradient_clip_val": 0.3, "enable_progress_bar": "false"}}
    asked |= {"data": {"batch_size": 16, "window": 5, "validation": 0.2, "check_every": 2}}
    asked |= {"model": {"learning_rate": 0.02, "weight_decay": 0.5}}
    options = [f"--{part}.{option}={value}" for part, own in asked.items() for option, value in own.items()]
    for seed in ("0", "1"):
        arguments = ["--model.prior", name, *MADE_OF_PRIORS[name], *options, "--data.file", plans_file]
        assert main(["fit", *arguments, "--seed_everything", seed, "--out", str(tmp_path / seed)]) == 0
    due = Settings(3, 16, 5, 0.02, 0.5, gradient_clip=0.3, validation=0.2, check_every=2, patience=7, progress=False)
    (first, seed), (second, other) = trained
    if name == "MixturePrior":  # its networks are stopped by the plans on which its weights are learned
        assert len(first.validation) == len(second.validation) == round(0.2 * 42)  # 42 are learned from
        first, second = (replace(how, validation=0.2) for how in (first, second))
    assert first == second == due
    assert seed != other


def test_a_file_alone_is_learned_by_the_combined_prior(plans_file, tmp_path):
    quick = ["--trainer.max_steps", "3", "--effort", "fast", "--out", str(tmp_path / "run")]
    assert main(["fit", plans_file, *quick]) == 0
    prior = load(tmp_path / "run")
    assert isinstance(prior, CombinedPrior)
    assert prior.effort == "fast"
    first = ["fit", "--effort=fast", *recipe("combined")[1:], "--data.file", plans_file]
    assert main([*first, "--trainer.max_steps", "3", "--out", str(tmp_path / "other")]) == 0
    assert load(tmp_path / "other").log_prob(some_plans(60)).equal(prior.log_prob(some_plans(60)))
    row = json.loads((tmp_path / "run" / "metrics.json").read_text())["rows"][-1]
    assert (row["model"], row["how"]) == ("combined", prior.summary())
    assert main(["fit", "--resume", str(tmp_path / "run")]) == 0
    assert load(tmp_path / "run").log_prob(some_plans(60)).equal(prior.log_prob(some_plans(60)))


def test_what_a_recipe_does_not_set_is_left_to_the_prior(plans_file, tmp_path, monkeypatch):
    trained = []
    monkeypatch.setattr("neuroprior.training.train", lambda prior, plans, how, seed: trained.append(how))
    arguments = ["--model.prior", "StackedPrior", *MADE_OF_PRIORS["StackedPrior"], "--data.file", plans_file]
    assert main(["fit", *arguments, "--out", str(tmp_path / "run")]) == 0
    StackedPrior(3, 8, depth=2).fit(some_plans(60))
    assert trained[0] == trained[1]


def test_folds_are_silent_also_with_default_settings(plans_file, tmp_path, monkeypatch):
    """Bars and lines of several processes would get mixed."""
    given = []
    monkeypatch.setattr("neuroprior.cli.fit.report", lambda *_: given.append(_[-1]))
    monkeypatch.setattr("neuroprior.training.train", lambda *_: 0.0)
    arguments = ["--model.prior", "StackedPrior", *MADE_OF_PRIORS["StackedPrior"], "--data.file", plans_file]
    assert main(["fit", *arguments, "--out", str(tmp_path / "run")]) == 0
    assert given == [{"progress": False}]


def test_options_that_networks_inside_other_priors_cannot_have_are_refused(plans_file, tmp_path, capsys):
    arguments = ["fit", "--model.prior", "StackedPrior", "--data.file", plans_file, "--out", str(tmp_path / "run")]
    assert main([*arguments, "--trainer.precision", "bf16-mixed"]) == 2
    said = capsys.readouterr().err
    assert "trainer.precision" in said
    assert said.count("\n") == 1
    assert not list((tmp_path / "run").rglob("*.*"))


@pytest.mark.parametrize("name", ["plans.npz", "config.json"])
def test_files_of_others_are_not_written_over(name, plans_file, tmp_path, capsys):
    (tmp_path / name).write_bytes(Path(plans_file).read_bytes())
    assert main(["fit", "--config", "markov", "--data.file", plans_file, "--out", str(tmp_path)]) == 2
    assert f"out: {tmp_path / name} is there, and of no run that began; move it away" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_the_number_of_contexts_of_a_recipe_may_be_more_than_occur(tmp_path):
    plans = Plans(torch.zeros(30, 4, dtype=torch.long), 2, context=torch.arange(120).view(30, 4) % 3)
    write_plans(plans, tmp_path / "plans.npz")
    options = ["--data.file", str(tmp_path / "plans.npz"), "--model.prior.num_contexts", "8"]
    assert main(["fit", "--config", "markov", *options, "--out", str(tmp_path / "run")]) == 0
    assert load(tmp_path / "run").num_contexts == 8


def test_a_recipe_by_name(plans_file, tmp_path, capsys, monkeypatch):
    """In any folder; where there is no such recipe the known ones are listed."""
    monkeypatch.chdir(tmp_path)
    assert main(["fit", "--config", "markov", "--data.file", plans_file, "--out", "run"]) == 0
    assert load("run").order == 3
    capsys.readouterr()
    for arguments in (["--config", "markof"], ["--config=markof"]):
        assert main(["fit", *arguments]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "'markof'" in said
        assert "gru, markov, semi-markov, switching, transformer" in said


LONG = ["--data.check_every", "5", "--trainer.max_steps", "100", "--trainer.patience", "100"]
LONG += ["--model.prior.dropout", "0.1"]


@pytest.mark.slow  # runs that are killed at set moments are resumed in test_train_resume.py
def test_killed_and_resumed_gives_the_same_prior_bit_for_bit(tmp_path):
    assert main([*small("gru", tmp_path / "whole"), *LONG]) == 0
    process = subprocess.Popen(
        [sys.executable, "-m", "train", *small("gru", tmp_path / "cut"), *LONG],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    last = tmp_path / "cut" / "checkpoints" / "last.ckpt"
    while not last.exists() and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "cut" / "model.safetensors").exists(), "killed too late to test anything"
    moved = tmp_path / "moved"
    os.rename(tmp_path / "cut", moved)
    assert main(["fit", "--resume", str(moved)]) == 0
    for name in ("model.safetensors",):
        assert (moved / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    first, second = (json.loads((f / "metrics.json").read_text()) for f in (tmp_path / "whole", moved))
    assert len(first["curve"]) == 20
    assert first["curve"] == second["curve"]
    assert first["rows"] == second["rows"]


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
    said = capsys.readouterr().err
    assert "saved up to step 10" in said
    assert f"--resume {out}" in said
    assert said.count("\n") == 1
    assert main(["fit", "--resume", str(out)]) == 0
    assert [row["step"] for row in json.loads((out / "metrics.json").read_text())["curve"]] == [10, 20, 30]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["fit"], "--config"),
        ([*recipe("gru"), "--data.file", "missing.npz"], "missing.npz"),
        ([*recipe("gru"), "--model.prior.hidden_size", "0"], "hidden_size"),
        ([*recipe("gru"), "--model.prior", "NoPrior"], "NoPrior"),
        ([*recipe("gru"), "--nonsense", "1"], "nonsense"),
        ([*recipe("gru"), "--trainer.devices", "0"], "devices"),
        ([*recipe("gru"), "--effort", "fast"], "error: model.prior: it has no option 'effort'"),
        (
            ["fit", "--config=gru", "--effort", "fast"],
            "error: effort: it is of the recipe combined, and the recipe gru",
        ),
        (
            [*recipe("combined"), "--effort", "quick"],
            "error: effort: one of fast, standard, full is expected, not quick",
        ),
        ([*recipe("combined"), "--effort", "a b"], "error: effort: one of fast, standard, full is expected, not a b\n"),
        ([*recipe("combined"), "--effort="], "error: effort: one of fast, standard, full is expected, not ''\n"),
        ([*recipe("combined"), "--effort", "--seed_everything", "1"], "error: effort: fast, standard or full"),
        ([*recipe("gru"), "--missing", "foo"], "error: data.missing: one of gap, label, error is expected, not foo\n"),
        (["fit", "--effort", "fast"], "--config"),
        (["fit", "--config", "missing.yaml"], "missing.yaml"),
        (["fit", "--resume", "missing"], "run.yaml"),
        ([*recipe("gru"), "--data.held_out", "0.95"], "held_out"),
        ([*recipe("gru"), "--data.world", "null"], "--data.file"),
        ([], "fit"),
    ],
)
def test_bad_input_is_one_line(arguments, says, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, *(["--out", "run"] if "--config" in arguments else [])]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1
    assert "Traceback" not in said


def test_a_run_is_never_overwritten(tmp_path, capsys):
    assert main(small("markov", tmp_path / "run")) == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").glob("*.*")}
    assert main(small("gru", tmp_path / "run")) == 2
    assert "--resume" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").glob("*.*")} == before


class Poison:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return (Path.touch, (self.target,))


def test_no_pickle_is_executed(tmp_path, capsys):
    out = tmp_path / "run"
    assert main(small("gru", out)) == 0
    for name in ("checkpoints/last.ckpt", "checkpoints/best.ckpt"):
        torch.save({"state_dict": Poison(tmp_path / "poisoned")}, out / name)
    capsys.readouterr()
    assert main(["fit", "--resume", str(out)]) == 2
    assert "last.ckpt" in capsys.readouterr().err
    (out / "plans.npz").write_bytes(pickle.dumps(Poison(tmp_path / "poisoned")))
    assert main(["fit", "--resume", str(out)]) == 2
    assert not (tmp_path / "poisoned").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_an_unwritable_folder_is_one_line(tmp_path, capsys):
    tmp_path.chmod(0o500)
    assert main(small("gru", tmp_path / "run")) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_long_sequence_trains_in_windows(tmp_path):
    actions = torch.arange(6000) // 3 % 4
    write_plans(Plans(actions[None], 4), tmp_path / "plans.npz")
    arguments = ["--data.file", str(tmp_path / "plans.npz"), "--data.window", "16", "--out", str(tmp_path / "run")]
    exactly = ["--model.prior.dropout", "0", "--model.prior.lags", "16", "--trainer.max_steps", "120"]
    assert main([*recipe("gru"), *SMALL["gru"], *QUICK, *arguments, *exactly]) == 0
    report = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert report["unit"] == "parts of the plan"
    assert report["rows"][-1]["bits_per_action"] < 0.5
