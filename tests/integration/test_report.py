"""`python -m eval plans`: actions and contexts by name, end symbols, and files of fewer actions than a prior knows."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from eval.__main__ import main
from neuroprior import ContextTreePrior, GRUPrior, MarkovPrior, Plans, Prior, UniformPrior, load, save
from neuroprior.behaviour import read
from neuroprior.behaviour.analysis.comparison import score
from neuroprior.behaviour.reporting.document import records
from neuroprior.behaviour.reporting.plan_report import report
from neuroprior.plans import write_plans
from tests.support.events import write_events
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")

NAMES = ("left", "on", "right")
CONTEXTS = ("cold", "mild", "warm")


def some_plans(num_plans: int = 60, seed: int = 0, **more) -> Plans:
    """Plans that mostly repeat their last action, the more the higher its number."""
    actions = torch.randint(3, (num_plans, 6), generator=seeded(seed))
    again = torch.rand(num_plans, 6, generator=seeded(seed + 1))
    for t in range(1, 6):
        last = actions[:, t - 1]
        actions[:, t] = torch.where(again[:, t] < 0.3 + 0.2 * last, last, actions[:, t])
    return Plans(actions, 3, torch.randint(2, 7, (num_plans,), generator=seeded(seed + 2)), **more)


def in_contexts(num_plans: int = 60, seed: int = 0, kind: str = "plan", contexts: int = 3) -> Plans:
    """Plans whose first actions, or all of them, say what the context is."""
    shape = (num_plans,) if kind == "plan" else (num_plans, 6)
    plans = some_plans(num_plans, seed, context=torch.randint(contexts, shape, generator=seeded(seed + 3)))
    actions = (plans.actions.long() // 2 + plans.context) % 3
    return replace(plans, actions=actions, context_names=CONTEXTS[:contexts])


def saved(prior: Prior, plans: Plans, folder: Path) -> str:
    return str(save(prior.fit(plans), folder))


def evaluate(file: Path, folders: list[str]) -> list[dict]:
    return records(report(file, priors=folders, sections=["scores"]).tables["scores"])


def cost(prior: Prior, plans: Plans) -> float:
    """Bits per action, without the program."""
    bits = -prior.log_prob(plans).detach().double().sum() / math.log(2)
    return float(bits / plans.mask().sum())


def fails(capsys, file: Path, folders: list[str], out: Path, *words: str) -> None:
    """The program must say in one line what is wrong, and exit with 2."""
    assert main(["plans", str(file), "--priors", *folders, "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert all(word in said for word in words), said
    assert not (out / "results.json").exists()


@pytest.mark.parametrize("suffix", ["npz", "jsonl", "csv"])
def test_scores_are_those_of_the_library(suffix, tmp_path):
    learned, new = some_plans(), some_plans(40, 9)
    write_plans(new, tmp_path / f"new.{suffix}")
    folders = [saved(MarkovPrior(3, 2), learned, tmp_path / "a"), saved(UniformPrior(3), learned, tmp_path / "b")]
    rows = evaluate(tmp_path / f"new.{suffix}", folders)
    for folder, row in zip(folders, rows, strict=True):
        assert row["bits_per_behaviour"] == pytest.approx(cost(load(folder), new), abs=1e-6)
        assert row["low"] < row["bits_per_behaviour"] < row["high"] or row["bits_per_behaviour"] == row["low"]
    assert rows[0]["more"] == 0
    gap = score("b", load(folders[1]), new).minus(score("a", load(folders[0]), new))
    assert (rows[1]["more"], rows[1]["more_low"], rows[1]["more_high"]) == pytest.approx(gap[:3])


def test_the_command_prints_and_writes_scores(tmp_path, capsys):
    learned = some_plans()
    write_plans(some_plans(40, 9), tmp_path / "new.npz")
    folders = [saved(MarkovPrior(3, 2), learned, tmp_path / "a"), saved(UniformPrior(3), learned, tmp_path / "b")]
    assert main(["plans", str(tmp_path / "new.npz"), "--priors", *folders, "--out", str(tmp_path / "out")]) == 0
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["scores"]
    assert rows == evaluate(tmp_path / "new.npz", folders)
    with open(tmp_path / "out" / "scores.csv") as table:
        assert [row["model"] for row in csv.DictReader(table)] == folders
    assert f"{rows[0]['bits_per_behaviour']:.4f}" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", ["npz", "jsonl", "csv"])
def test_actions_are_known_by_name(suffix, tmp_path):
    """A file that numbers the same names in another order scores as with the prior's numbers."""
    learned, new = (some_plans(seed=s, action_names=NAMES) for s in (0, 9))
    folder = saved(MarkovPrior(3, 2), learned, tmp_path / "prior")
    order = torch.tensor([2, 0, 1])  # right, left, on
    place = order.argsort()
    names = tuple(NAMES[n] for n in order.tolist())
    write_plans(replace(new, actions=place[new.actions.long()], action_names=names), tmp_path / f"new.{suffix}")
    rows = evaluate(tmp_path / f"new.{suffix}", [folder])
    assert rows[0]["bits_per_behaviour"] == pytest.approx(cost(load(folder), new), abs=1e-6)


def test_other_names_are_one_line(tmp_path, capsys):
    folder = saved(MarkovPrior(3, 2), some_plans(action_names=NAMES), tmp_path / "prior")
    write_plans(some_plans(action_names=("left", "on", "up")), tmp_path / "new.csv")
    fails(capsys, tmp_path / "new.csv", [folder], tmp_path / "out", "up", "left, on, right")


def test_priors_of_other_names_are_one_line(tmp_path, capsys):
    learned = some_plans(action_names=NAMES)
    folders = [saved(MarkovPrior(3, 2), learned, tmp_path / "a")]
    folders.append(saved(UniformPrior(3), replace(learned, action_names=("a", "b", "c")), tmp_path / "b"))
    write_plans(learned, tmp_path / "new.npz")
    fails(capsys, tmp_path / "new.npz", folders, tmp_path / "out", folders[1], "left")


@pytest.mark.parametrize("suffix", ["npz", "jsonl", "csv"])
@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("end", [False, True])
def test_fewer_actions_than_the_prior_knows(end, named, suffix, tmp_path):
    """Also where the prior knows the names of its actions, or a symbol for the end beside them."""
    learned = some_plans(action_names=NAMES if named else None)
    folder = saved(MarkovPrior(3 + end, 1), learned.with_end() if end else learned, tmp_path / "prior")
    new = some_plans(40, 9)
    new = Plans(new.actions.clamp(max=1), 2, new.lengths)
    write_plans(new, tmp_path / f"new.{suffix}")
    rows = evaluate(tmp_path / f"new.{suffix}", [folder])
    wide = replace(new, num_actions=3)
    assert rows[0]["bits_per_behaviour"] == pytest.approx(
        cost(load(folder), wide.with_end() if end else wide), abs=1e-6
    )


def test_more_actions_than_the_prior_knows_are_one_line(tmp_path, capsys):
    folder = saved(MarkovPrior(3, 1), some_plans(), tmp_path / "prior")
    write_plans(Plans(torch.tensor([[0, 3], [1, 2]]), 4), tmp_path / "new.npz")
    fails(
        capsys,
        tmp_path / "new.npz",
        [folder],
        tmp_path / "out",
        folder,
        "must know at least the 4 actions of the plans, got 3",
    )


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("named", ["neither", "prior", "both"])
@pytest.mark.parametrize("suffix", ["npz", "jsonl"])
def test_ends(suffix, named, closed, tmp_path):
    """Of a prior with an end symbol the ends count, of one without they do not: whether the file has one or not."""
    learned = some_plans(action_names=None if named == "neither" else NAMES)
    new = some_plans(seed=9, action_names=NAMES if named == "both" else None)
    folders = [saved(MarkovPrior(4, 2), learned.with_end(), tmp_path / "closed")]
    folders.append(saved(ContextTreePrior(3, 2), learned, tmp_path / "open"))
    write_plans(new.with_end() if closed else new, tmp_path / f"new.{suffix}")
    rows = evaluate(tmp_path / f"new.{suffix}", folders)
    assert rows[0]["bits_per_behaviour"] == pytest.approx(cost(load(folders[0]), new.with_end()), abs=1e-6)
    assert rows[1]["bits_per_behaviour"] == pytest.approx(cost(load(folders[1]), new), abs=1e-6)
    # per action with and without ends: nothing to subtract
    assert rows[1]["more"] is rows[1]["more_low"] is rows[1]["more_high"] is None
    again = evaluate(tmp_path / f"new.{suffix}", folders[::-1])
    assert [row["bits_per_behaviour"] for row in again] == [row["bits_per_behaviour"] for row in rows[::-1]]


@pytest.mark.parametrize("kind", ["plan", "step"])
@pytest.mark.parametrize("make", [lambda: MarkovPrior(3, 1, num_contexts=3), lambda: GRUPrior(3, 8, num_contexts=3)])
def test_contexts_are_known_by_name(make, kind, tmp_path):
    """A CSV file of "warm" and "cold" alone numbers them 1 and 0; the prior knows warm as 2."""
    learned, new = in_contexts(kind=kind), in_contexts(40, 9, kind, contexts=2)
    new = replace(new, context=2 * new.context, context_names=CONTEXTS)
    prior = make()
    prior = prior.fit(learned) if isinstance(prior, MarkovPrior) else prior.fit(learned, max_steps=30, progress=False)
    folder = str(save(prior, tmp_path / "prior"))
    (write_events if kind == "step" else write_plans)(new, tmp_path / "new.csv")
    assert read(tmp_path / "new.csv").plans().context_names == ("cold", "warm")
    rows = evaluate(tmp_path / "new.csv", [folder])
    assert rows[0]["input"] == "behaviours and context"
    assert rows[0]["bits_per_behaviour"] == pytest.approx(cost(load(folder), new), abs=1e-6)


def test_contexts_without_names_are_numbers(tmp_path):
    learned, new = in_contexts(), replace(in_contexts(40, 9), context_names=None)
    folder = saved(MarkovPrior(3, 1, num_contexts=3), learned, tmp_path / "prior")
    write_plans(new, tmp_path / "new.csv")
    rows = evaluate(tmp_path / "new.csv", [folder])
    assert rows[0]["bits_per_behaviour"] == pytest.approx(cost(load(folder), new), abs=1e-6)


def test_a_context_that_is_missing_is_one_line(tmp_path, capsys):
    folder = saved(MarkovPrior(3, 1, num_contexts=3), in_contexts(), tmp_path / "prior")
    write_plans(some_plans(), tmp_path / "new.npz")
    fails(capsys, tmp_path / "new.npz", [folder], tmp_path / "out", folder, "context")


@pytest.mark.parametrize("priors", [["missing"], ["."]])
def test_a_folder_without_a_prior_is_one_line(priors, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_plans(some_plans(), tmp_path / "new.npz")
    fails(capsys, tmp_path / "new.npz", priors, tmp_path / "out", "model.safetensors")
