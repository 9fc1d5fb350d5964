"""`python -m eval compare` and `curriculum`: their options, and what is done with them; runs are made up."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from eval.__main__ import main
from eval.compare import command, curriculum
from eval.compare.results import Results
from eval.worlds.suite import TASKS
from neuroprior import GRUPrior, MarkovPrior, Plans, save
from neuroprior.behaviour.reporting.document import Document
from tests.support.made_up_runs import made_up
from tests.support.reports import FROM_ELSEWHERE

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Made-up runs, and no figures, which take most of the time."""

    def bare(results: Results, settings: dict, line: str) -> Document:
        return Document("", "", [], {"rows": results.rows}, settings, line)

    monkeypatch.setattr(command, "compare_run", made_up)
    monkeypatch.setattr(command, "document", bare)
    monkeypatch.setattr(curriculum, "curriculum_run", made_up)


def results(out: Path) -> dict:
    return json.loads((out / "results.json").read_text())


def run(out: Path, *options: str) -> dict:
    assert main(["compare", "--seeds", "2", "--processes", "1", "--out", str(out), *options]) == 0
    return results(out)


def test_settings_go_into_runs_and_report(tmp_path):
    options = ["--worlds", "maze", "--num-plans", "2", "8", "--kinds", "gru", "markov"]
    options += ["--context", "initial", "per-step"]
    numbers = {"rounds": 1, "steps": 7, "starts": 5, "training_starts": 9, "seed": 4}
    found = run(tmp_path, *options, *(word for name, n in numbers.items() for word in (f"--{name}", str(n))))
    lists = {"num_plans": [2, 8], "kinds": ["gru", "markov"], "context": ["initial", "per-step"]}
    rest = {"worlds": ["maze"], "seeds": 2, "priors": [], "lengths": []}
    assert found["settings"] == lists | numbers | rest
    kept = [json.loads(path.read_text()) for path in sorted(tmp_path.glob("runs/*/maze-*.json"))]
    assert [(one["world"], one["seed"], one["num_starts"]) for one in kept] == [("maze", 0, 5), ("maze", 1, 5)]
    assert {row["num_plans"] for row in found["rows"]} == {2, 8}
    assert {row["seeds"] for row in found["rows"]} == {2}


def made_up_by_kind(asked, settings) -> dict:
    """A made-up run whose network has the name of the first kind, and whose random plans are always the same."""
    found = made_up(asked, replace(settings, kinds=(), context=()))
    for entry in [*found["entries"], *found["curriculum"]]:
        if entry["prior"] == "gru":
            entry["prior"] = settings.kinds[0]
    return found


def test_priors_of_a_finished_comparison_are_put_beside(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "compare_run", made_up_by_kind)
    options = ("--worlds", "maze", "--num-plans", "4")
    one = run(tmp_path / "one", *options, "--kinds", "gru", "--context", "initial")["rows"]
    both = run(tmp_path / "both", *options, "--kinds", "transformer", "--beside", str(tmp_path / "one"))["rows"]
    assert [row["prior"] for row in both] == ["uniform", "markov-1", "transformer", "gru"]
    assert both[-1] == next(row for row in one if row["prior"] == "gru")
    more = [*options, "--seeds", "2", "--processes", "1", "--kinds", "transformer", "--out", str(tmp_path / "more")]
    more += ["--beside", str(tmp_path / "one")]
    capsys.readouterr()
    for changed, said in [
        (["--seeds", "3"], "1 of 3 runs are not finished in"),
        (["--worlds", "maze", "grid"], "2 of 4 runs are not finished in"),
        (["--starts", "5"], "has no comparison of the same settings"),
        (["--planners", "sampling"], "beside: priors are compared"),
    ]:
        assert main(["compare", *more, *changed]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert error.count("\n") == 1
        assert said in error
    assert not (tmp_path / "more").exists()
    run(tmp_path / "one", *options, "--kinds", "markov", "--seeds", "1")  # not all of the runs
    assert main(["compare", *more]) == 0
    (first,) = (path.parent for path in (tmp_path / "one").glob("runs/*/maze-1.json"))
    run(tmp_path / "one", *options, "--kinds", "markov")
    capsys.readouterr()
    assert main(["compare", *more]) == 2
    assert "has 2 comparisons of these settings; give " in capsys.readouterr().err
    assert main(["compare", *more[:-1], str(first)]) == 0
    assert results(tmp_path / "more")["settings"]["beside"] == [str(first)]
    assert main(["compare", *more[:-1], str(tmp_path / "more")]) == 2
    assert "is the folder of this comparison" in capsys.readouterr().err


def test_runs_from_other_starts_are_not_put_beside(tmp_path, monkeypatch, capsys):
    options = ("--worlds", "maze", "--num-plans", "4")
    run(tmp_path / "one", *options, "--kinds", "gru")  # its random plans depend on the kinds
    assert main(["compare", *options, "--seeds", "2", "--kinds", "markov", "--beside", str(tmp_path / "one")]) == 2
    assert "beside: maze, seed 0: random plans do not reach the same" in capsys.readouterr().err


@pytest.mark.parametrize(("kinds", "fitted"), [([], []), (["--kinds", "gru"], ["gru"])])
def test_saved_priors_stand_alone_or_beside_fitted_ones(kinds, fitted, tmp_path):
    actions = TASKS["maze"].num_actions
    names = TASKS["maze"].action_names
    plans = Plans(torch.zeros(3, 4, dtype=torch.long), actions, action_names=names)
    folders = [str(save(MarkovPrior(actions, k).fit(plans), tmp_path / f"m{k}")) for k in range(2)]
    found = run(tmp_path / "out", "--worlds", "maze", "--num-plans", "4", "--priors", *folders, *kinds)
    assert found["settings"]["priors"] == folders
    assert found["settings"]["kinds"] == fitted


def test_contexts_that_do_not_fit_are_refused_before_anything_is_done(tmp_path, capsys):
    plans = Plans(torch.zeros(9, 4, dtype=torch.long), 4, context=torch.rand(9, 4, 7))
    folder = str(save(GRUPrior(4, 4, context_size=7).fit(plans, max_steps=1, progress=False), tmp_path / "seven"))
    assert main(["compare", "--worlds", "grid", "maze", "--priors", folder, "--out", str(tmp_path / "out")]) == 2
    assert f"{folder}: its context is not what the world grid offers" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    right = Plans(plans.actions, 4, context=torch.rand(9, 4, 24))
    folder = str(save(GRUPrior(4, 4, context_size=24).fit(right, max_steps=1, progress=False), tmp_path / "all"))
    run(tmp_path / "out", "--worlds", "maze", "--num-plans", "4", "--priors", folder)


def test_curriculum_writes_curves(tmp_path):
    options = ["--worlds", "maze", "grid", "--lengths", "6", "8", "--seeds", "3", "--num-plans", "64"]
    assert main(["curriculum", *options, "--processes", "1", "--out", str(tmp_path)]) == 0
    found = results(tmp_path)
    assert found["settings"]["rounds"] == 2
    assert found["settings"]["lengths"] == [6, 8]
    assert len(found["rows"]) == 2 * 2 * 3 * 2  # worlds, priors, rounds from 0, lengths
    with open(tmp_path / "curriculum.csv") as file:
        assert [float(row["oracle_share"]) for row in csv.DictReader(file)] == [
            r["oracle_share"] for r in found["rows"]
        ]
    html = (tmp_path / "report.html").read_text()
    assert not re.search(FROM_ELSEWHERE, html)
    assert html.count("<svg") >= 2
    # Without lengths the world has its own, of which there are no more than this.
    assert (
        main(["curriculum", "--worlds", "maze", "--seeds", "1", "--processes", "1", "--out", str(tmp_path / "own")])
        == 0
    )
    assert results(tmp_path / "own")["settings"]["rounds"] == curriculum.ROUNDS


@pytest.mark.parametrize("name", ["worlds", "num_plans", "kinds"])
def test_empty_lists_are_refused(name, tmp_path):
    with pytest.raises(ValueError, match=f"`{name}` must have at least one"):
        command.compare(out=str(tmp_path), **{name: []})
