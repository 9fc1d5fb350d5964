"""`neuroprior score`: the scores of the library, by plan and by group, in files."""

import json
import math
import re
from dataclasses import replace

import pandas as pd
import pytest
import torch

from neuroprior import MarkovPrior, Plans, save
from neuroprior.__main__ import main
from neuroprior.behaviour import read
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.reporting import ReadOptions
from neuroprior.behaviour.reporting.plan_report import report
from neuroprior.cli import score as command
from neuroprior.plans import write_plans
from neuroprior.priors import AdaptivePrior
from neuroprior.priors.scoring import keep_learned, score
from tests.support.sources import refuses, seeded


def test_ends_are_scored_but_are_no_actions(tmp_path):
    lengths = torch.randint(1, 7, (30,), generator=seeded(1))
    plans = Plans(torch.randint(3, (30, 6), generator=seeded(0)), 3, lengths, group=torch.arange(30) % 4)
    prior = MarkovPrior(4, 1).fit(plans.with_end())
    save(prior, tmp_path / "prior")
    write_plans(plans, tmp_path / "plans.npz")
    out = tmp_path / "out"
    assert main(["score", str(tmp_path / "prior"), str(tmp_path / "plans.npz"), "--out", str(out)]) == 0
    scores, groups = (pd.read_csv(out / f"{name}.csv") for name in ("plans", "groups"))
    due = prior.log_prob(plans.with_end())
    assert scores["actions"].tolist() == lengths.tolist()
    assert scores["log_likelihood"].tolist() == pytest.approx(due.tolist(), abs=1e-4)
    assert groups["actions"].tolist() == [int(lengths[k::4].sum()) for k in range(4)]
    assert groups["log_likelihood"].tolist() == pytest.approx([float(due[k::4].sum()) for k in range(4)], abs=1e-4)


def test_subjects_go_on_from_their_earlier_files(tmp_path, capsys):
    parts = [
        Plans(torch.randint(3, (n, 6), generator=seeded(n)), 3, torch.arange(n) % 6 + 1, group=torch.arange(n) % 3)
        for n in (9, 7)
    ]
    prior = AdaptivePrior(MarkovPrior(3, 1).fit(parts[0]), [4.0, 2.0])
    folder, *files = (str(tmp_path / name) for name in ("prior", "before.npz", "now.npz"))
    save(prior, folder)
    for plans, file in zip(parts, files, strict=True):
        write_plans(plans, file)
    assert main(["score", folder, files[1], "--past", files[0], "--out", str(tmp_path / "out")]) == 0
    due = score(prior, parts[1], past=parts[0])["log_likelihood"]
    assert pd.read_csv(tmp_path / "out" / "plans.csv")["log_likelihood"].tolist() == pytest.approx(
        due.tolist(), abs=1e-4
    )
    # what is scored after itself, and by whom nothing is known, is said
    distinct = Plans(torch.randint(3, (7, 24), generator=seeded(1)), 3, group=torch.arange(7))
    write_plans(distinct, files[1])
    write_plans(distinct[:3], files[0])
    capsys.readouterr()
    assert main(["score", folder, files[1], "--past", files[0], "--out", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "3 of 7 scored plans are in it, too" in said
    assert "4 of 7 subjects are not in it, and scored alone: group 3, group 4, group 5" in said
    assert main(["score", folder, files[1], "--past", files[1], "--out", str(tmp_path / "out")]) == 2
    assert "`past` must hold other files" in capsys.readouterr().err


def scored(folder, plans, learned=(), **options):
    """The tables and the words of `score` for a chain of order 1 that has counted these plans."""
    prior = MarkovPrior(plans.num_actions, 1).fit(plans)
    save(prior, folder / "prior")
    if learned:
        keep_learned(folder / "prior", *learned)
    write_plans(plans, folder / "plans.npz")
    command.score(str(folder / "prior"), [str(folder / "plans.npz")], out=str(folder / "out"), **options)
    return prior, {path.stem: pd.read_csv(path) for path in (folder / "out").glob("*.csv")}


def test_tables_of_an_earlier_file_go_and_those_of_others_stay(tmp_path):
    """Nor are they written over, not even those that are scored: plans.csv is a good name for plans, too."""
    _, frames = scored(tmp_path, drawn(9, group=torch.arange(9) % 3, condition=torch.arange(9) % 3))
    assert set(frames) == {"plans", "groups", "conditions"}
    _, frames = scored(tmp_path, drawn(9))
    assert set(frames) == {"plans"}
    (tmp_path / "out" / "groups.csv").write_text("group,weight\na,1\n")
    with refuses("`out` must be a folder without groups.csv"):
        scored(tmp_path, drawn(9, group=torch.arange(9) % 3))
    plans = tmp_path / "data" / "plans.csv"
    plans.parent.mkdir()
    # A report's own table of that name has bits per action, too.
    for content in ("plan,action\n0,1\n0,2\n", "model,bits_per_action\nmine,1\n"):
        plans.write_text(content)
        with refuses("`out` must be a folder without plans.csv"):
            command.score(str(tmp_path / "prior"), [str(tmp_path / "plans.npz")], out=str(plans.parent))
        assert plans.read_text() == content
        assert list(plans.parent.iterdir()) == [plans]


def drawn(num, **more):
    return RecordedPlans(torch.randint(3, (num, 5), generator=seeded(0)), 3, **more)


def test_groups_and_conditions_have_tables_of_their_own(tmp_path, capsys):
    """Nine plans of three animals, two of which were treated; printed are the animals."""
    group, condition = torch.arange(9) % 3, (torch.arange(9) % 3 > 0).long()
    plans = drawn(9, group=group, condition=condition)
    prior, frames = scored(tmp_path, plans)
    assert set(frames) == {"plans", "groups", "conditions"}
    due = prior.log_prob(plans)
    for name, label in (("groups", group), ("conditions", condition)):
        sums = [float(due[label == one].sum()) for one in label.unique()]
        assert frames[name]["log_likelihood"].tolist() == pytest.approx(sums, abs=1e-4)
    words = " ".join(capsys.readouterr().out.split())
    assert "3 subjects are too few for a verdict" in words
    low, high = (float(word) for word in re.search(r"interval ([\d.]+) to ([\d.]+) over subjects", words).groups())
    mean = float(re.search(r"([\d.]+) bits per action, 95", words).group(1))
    assert low < mean < high
    assert mean == pytest.approx(-float(due.sum()) / 45 / math.log(2), abs=1e-4)
    assert all(name in words for name in ("plans.csv", "groups.csv", "conditions.csv"))


def test_no_more_than_twenty_plans_are_printed(tmp_path, capsys):
    scored(tmp_path, drawn(21))
    words = capsys.readouterr().out
    assert "the first 20 of 21" in words
    assert len(re.findall(r"^\W*\d+\W+5\W+-", words, re.MULTILINE)) == 20  # rows begin with the number of the plan
    assert "too few" not in words
    assert "Training data" not in words


def test_plans_that_were_learned_from_are_marked(tmp_path, capsys):
    plans = drawn(8)
    _, frames = scored(tmp_path, plans.with_end(), [plans[:3]])
    assert frames["plans"]["training_data"].tolist() == [True] * 3 + [False] * 5
    assert "3 of 8 plans are plans that it has learned from, at least in part" in " ".join(
        capsys.readouterr().out.split()
    )


@pytest.mark.parametrize(
    ("file", "given", "names"),
    [
        ("plans.CSV", None, ["a", "b", "c"]),
        ("plans.npz", None, None),
        ("plans.csv", ["b", "a", "c"], ["b", "a", "c"]),
    ],
)
def test_how_a_file_is_read_is_passed_on(file, given, names, tmp_path, monkeypatch, capsys):
    """The prior's names go with tables alone, unless others are given; notes are printed."""
    plans, asked = replace(drawn(8, action_names=("a", "b", "c")), notes=("something was odd",)), []
    save(MarkovPrior(3, 1).fit(plans), tmp_path / "prior")
    monkeypatch.setattr(ReadOptions, "read", lambda how, files: asked.append((files, how)) or plans)
    reading = ReadOptions(missing="label", merge_repeats=True, max_gap=3.5, num_actions=3, action_names=given)
    command.score(str(tmp_path / "prior"), [file], out=str(tmp_path / "out"), reading=reading)
    assert asked == [([file], replace(reading, action_names=names))]
    assert "note: something was odd" in capsys.readouterr().out


def test_a_prior_of_numbers_says_how_it_numbers_a_file_of_names(tmp_path, capsys):
    prior = MarkovPrior(2, 0).fit(torch.tensor([[0, 1, 0]]))
    save(prior, tmp_path / "prior")
    file = tmp_path / "plans.csv"
    file.write_text("plan,action\na,walk\na,rest\na,walk\n")
    how = ["score", str(tmp_path / "prior"), str(file), "--out", str(tmp_path / "out")]
    assert main(how) == 0
    assert "file's were numbered: rest = 0, walk = 1; --action_names" in " ".join(capsys.readouterr().out.split())
    assert main([*how, "--action_names", "walk", "rest"]) == 0
    assert "were numbered" not in " ".join(capsys.readouterr().out.split())
    found = pd.read_csv(tmp_path / "out" / "plans.csv")["log_likelihood"]
    assert found.item() == pytest.approx(float(prior.log_prob(torch.tensor([[0, 1, 0]]))), abs=1e-4)


@pytest.mark.parametrize("suffix", ["csv", "jsonl"])
def test_numbers_that_are_taken_for_names_are_said(suffix, tmp_path, capsys):
    plans = Plans(torch.tensor([[0, 1, 0]]), 2, action_names=("rest", "walk"))
    save(MarkovPrior(2, 0).fit(plans), tmp_path / "prior")
    for name, some in (("numbers", replace(plans, action_names=None)), ("names", plans)):
        write_plans(some, tmp_path / f"{name}.{suffix}")
        how = ["score", str(tmp_path / "prior"), str(tmp_path / f"{name}.{suffix}"), "--out", str(tmp_path / "out")]
        assert main(how) == 0
        said = "0 = rest, 1 = walk" in " ".join(capsys.readouterr().out.split())
        assert said == (name == "numbers")


@pytest.mark.parametrize("names", [("1", "2", "rest"), ("0.5", "1.5", "7")])
def test_names_that_look_like_numbers_are_names(names, tmp_path, capsys):
    prior = MarkovPrior(3, 0).fit(Plans(torch.tensor([[0, 1, 1, 2]]), 3, action_names=names))
    save(prior, tmp_path / "prior")
    (tmp_path / "f.csv").write_text("plan,action\n" + "".join(f"p,{names[i]}\n" for i in (1, 0, 2)))
    assert main(["score", str(tmp_path / "prior"), str(tmp_path / "f.csv"), "--out", str(tmp_path / "out")]) == 0
    assert "are numbers" not in capsys.readouterr().out
    found = pd.read_csv(tmp_path / "out" / "plans.csv")["log_likelihood"]
    assert found.item() == pytest.approx(float(prior.log_prob(torch.tensor([[1, 0, 2]]))), abs=1e-4)


def of_contexts(path, contexts):
    """A table of ten plans of three or four actions: "a" in one of two contexts, "b" in the other, now and then not."""
    rows = ["plan,action,context"]
    for plan in range(10):
        number = plan % 2
        rows += [f"{plan},{'ab'[number ^ (t == plan % 7)]},{contexts[number]}" for t in range(4 - plan % 3 // 2)]
    path.write_text("\n".join(rows) + "\n")
    return str(path)


NUMBERED = "knows contexts by number, so the file's were numbered: L = 0, R = 1"
TAKEN = "contexts are numbers, which are taken for those of the prior's names: 0 = {}, 1 = {}"


@pytest.mark.parametrize(
    ("learned", "names", "file", "said"),
    [
        (("L", "R"), ("L", "R"), ("L", "R"), None),
        ((0, 1), None, ("L", "R"), NUMBERED),
        (("L", "R"), ("L", "R"), (0, 1), TAKEN.format("L", "R")),
        ((1, 2), ("1", "2"), (1, 2), None),
        ((1, 2), ("1", "2"), (0, 1), TAKEN.format("1", "2")),
    ],
)
def test_contexts_are_matched_by_name_or_it_is_said_how_they_are_numbered(learned, names, file, said, tmp_path, capsys):
    plans = read(of_contexts(tmp_path / "learned.csv", learned)).plans()
    if learned == (1, 2):  # numbers in a table, which another file names
        plans = replace(plans, context=(plans.context - 1).clamp(min=0), context_names=names)
    prior = MarkovPrior(2, 0, num_contexts=2).fit(plans)
    folder = save(prior, tmp_path / "prior")
    assert main(["score", str(folder), of_contexts(tmp_path / "new.csv", file), "--out", str(tmp_path / "out")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert ("note: the" in shown) == (said is not None)
    assert said is None or said in shown
    found = pd.read_csv(tmp_path / "out" / "plans.csv")["log_likelihood"]
    assert found.tolist() == pytest.approx(prior.log_prob(plans).tolist(), rel=1e-5)
    report(tmp_path / "new.csv", out=tmp_path / "report", priors=[str(folder)], sections=["scores"])
    reported = json.loads((tmp_path / "report" / "results.json").read_text())
    bits = -float(prior.log_prob(plans).sum()) / math.log(2) / int(plans.mask().sum())
    assert reported["scores"][0]["bits_per_behaviour"] == pytest.approx(bits, rel=1e-5)
    notes = reported["file"]["notes"]
    assert said is None or f"{folder}: the" in notes[-1]
    assert said is None or said in notes[-1]
    assert (said is not None) == any("the contexts are" in note or "knows contexts" in note for note in notes)


def test_a_folder_that_cannot_be_made_is_said_before_the_table(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    save(MarkovPrior(2, 0).fit(torch.tensor([[0, 1, 0]])), tmp_path / "prior")
    write_plans(Plans(torch.tensor([[0, 1]]), 2), tmp_path / "plans.npz")
    how = ["score", str(tmp_path / "prior"), str(tmp_path / "plans.npz"), "--out", str(tmp_path / "file")]
    assert main(how) == 2
    assert capsys.readouterr().out == ""
