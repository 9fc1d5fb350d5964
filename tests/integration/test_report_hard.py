"""`python -m eval plans FILE` on files that are hard to take: a report, or one line that says what is wrong."""

import json
import math
import re
from dataclasses import replace

import pytest
import torch

from eval.__main__ import main
from neuroprior import Plans
from neuroprior.plans import write_plans
from tests.support.chains import markov_plans, markov_probs
from tests.support.reports import FROM_ELSEWHERE, QUICKLY, bits, fails, report
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")


def chain(num: int, length: int, actions: int = 3, **more) -> Plans:
    return markov_plans(markov_probs(actions, 1, 0, 1.5), num, length, 1, **more)


def random_context(*shape: int, most: int = 3) -> torch.Tensor:
    return torch.randint(most, shape, generator=seeded(2))


HARD = {
    "two actions": chain(12, 5, 2),
    "one action": Plans(torch.zeros(12, 5).long(), 1),
    "an action that never occurs": replace(chain(12, 5), num_actions=5, action_names=tuple("abcde")),
    "always the same": Plans(torch.zeros(12, 5).long(), 3),
    "two plans": chain(2, 6),
    "a single plan": chain(1, 60),
    "a short single plan": chain(1, 12),
    "a single plan with a context": chain(1, 60, context=torch.tensor([7])),
    "a single plan with an end": chain(1, 60).with_end(),
    "plans of one action": chain(20, 1),
    "plans of two actions": chain(9, 2),
    "many empty": replace(chain(20, 5), lengths=torch.arange(20) % 4 * 5 // 3),
    "all but one empty": replace(chain(20, 40), lengths=40 * (torch.arange(20) == 3).long()),
    "an empty group": replace(chain(12, 5), lengths=5 * (torch.arange(12) % 3 > 0).long(), group=torch.arange(12) % 3),
    "one group": chain(12, 5, group=torch.full((12,), 5)),
    "a group for each": chain(12, 5, group=torch.arange(12).flip(0) - 4),
    "contexts far apart": chain(12, 5, context=random_context(12, 5) * 10**18),
    "a context a plan": chain(12, 5, context=random_context(12).to(torch.uint8)),
    "features": chain(12, 5, context=torch.randn(12, 5, 2, generator=seeded(2)).half()),
}


# Those that have all but one thing in common with another one, of which there is a report in every run.
ALIKE = ("a single plan", "plans of two actions", "always the same")


@pytest.mark.parametrize("what", [pytest.param(what, marks=pytest.mark.slow if what in ALIKE else []) for what in HARD])
def test_hard_files_have_a_report(what, tmp_path, recwarn):
    plans = HARD[what]
    closed = int(plans.end is not None)
    results = report(plans, tmp_path)
    found = bits(results)
    assert found["uniform"] == pytest.approx(math.log2(plans.num_actions - closed), abs=1e-6)
    assert len(found) == 9
    lengths = plans.mask().sum(1) - closed
    assert results["file"]["behaviours"] == int(lengths.sum())
    assert results["settings"].get("sequences without behaviours, left out", 0) == int((lengths == 0).sum())
    assert not [warning.message for warning in recwarn if "neuroprior" in str(warning.filename)]


def test_names_are_text(tmp_path, capsys, monkeypatch, undrawn):
    """With all figures, in the page, in the terminal and in the name of the folder."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", undrawn)
    names = ('<b>"x"</b>', "[bold]", "[/red]", "日本\u202eé & $x_1$")
    groups = ("</td>", "[/i]", "{{ 7 }}")
    plans = chain(12, 6, 4, action_names=names, group=torch.arange(12) % 3, group_names=groups)
    folder = tmp_path / "[/x] <b> $y$"
    folder.mkdir(parents=True)
    file, out = folder / "[red]plans <i>.csv", folder / "out"
    write_plans(plans, file)
    assert main(["plans", str(file), "--out", str(out), *QUICKLY, "--folds", "2"]) == 0
    assert str(out / "report.html") in capsys.readouterr().out
    results = json.loads((out / "results.json").read_text())
    assert {row["from"] for row in results["transitions"]} == set(names)
    page = (out / "report.html").read_text()
    assert not re.search(FROM_ELSEWHERE, page)
    for text in ('<b>"x"</b>', "<i>.csv", "</td>.</td>"):
        assert text not in page
    assert "&lt;b&gt;" in page
    assert "{{ 7 }}" in page


FEW = chain(20, 5)
BAD = {
    "no action at all": (Plans(torch.zeros(3, 4).long(), 3, torch.zeros(3).long()), [], ("no plan has an action",)),
    "a single action": (Plans(torch.zeros(1, 1).long(), 3), [], ("at least two plans", "new.npz")),
    "one fold": (FEW, ["--folds", "1"], ("`folds` must be from 2 to 20", "got 1")),
    "more folds than plans": (FEW, ["--folds", "21"], ("folds", "20", "got 21")),
    "more folds than groups": (replace(FEW, group=torch.arange(20) % 4), ["--folds", "5"], ("2 to 4", "got 5")),
    "nothing left to score": (FEW, ["--skip", "5"], ("skip", "got 5")),
    "a negative skip": (FEW, ["--skip=-1"], ("skip", "-1")),
    "no steps": (FEW, ["--max-steps", "0"], ("max_steps", "0")),
    "a large seed": (FEW, ["--seed", str(10**30)], ("seed", str(10**30))),
    "a model that is not known": (FEW, ["--models", "lstm"], ("models",)),
    "a negative context": (replace(FEW, context=-torch.arange(20)), [], ("context", "-19")),
    "a context of no features": (replace(FEW, context=torch.zeros(20, 0)), [], ("context",)),
    "too few names": (FEW, ["--action-names", "a", "b"], ("2",)),
}


@pytest.mark.parametrize("what", BAD)
def test_what_cannot_be_taken_is_one_line(what, tmp_path, capsys):
    plans, options, words = BAD[what]
    write_plans(plans, tmp_path / "new.npz")
    fails([str(tmp_path / "new.npz"), "--out", str(tmp_path / "out"), *QUICKLY, *options], capsys, *words)
    assert not (tmp_path / "out" / "results.json").exists()


@pytest.mark.parametrize("text", ["", "action_1,action_2\n", 'action_1\n"', "plan,action\n1,left\n1,\n", "\x00\x01"])
def test_damaged_files_are_one_line(text, tmp_path, capsys):
    (tmp_path / "new.csv").write_text(text)
    fails([str(tmp_path / "new.csv"), "--out", str(tmp_path / "out"), *QUICKLY], capsys, "new.csv")


def test_a_csv_file_of_names(tmp_path):
    """Names and groups of a CSV file, one plan a row, with empty cells after the ends."""
    rows = [f"{'left' if n % 2 else 'right'},on,{'' if n % 3 else 'left'},mouse {n % 4}" for n in range(24)]
    (tmp_path / "new.csv").write_text("action_1,action_2,action_3,group\n" + "\n".join(rows) + "\n")
    assert main(["plans", str(tmp_path / "new.csv"), "--out", str(tmp_path / "out"), *QUICKLY, "--folds", "2"]) == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["unit"] == "subjects"
    assert results["file"]["subjects"] == 4
    assert results["file"]["behaviours"] == 24 * 2 + 8
    assert {row["name"] for row in results["drift"] if row["what"] == "subject"} == {f"mouse {n}" for n in range(4)}
    on = [r for r in results["transitions"] if (r["subject"], r["from"]) == ("all", "on")]
    assert [(row["to"], row["count"], row["probability"]) for row in on] == [("left", 8, 1)]
