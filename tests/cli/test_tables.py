"""Tables of a laboratory on the command line: the same options in every command."""

import json
from pathlib import Path

import pandas as pd
import pytest

from neuroprior import load
from neuroprior.__main__ import main

pytestmark = pytest.mark.usefixtures("undrawn")

COLUMNS = ["--columns.behaviour", "behaviour", "--columns.recording", "session", "--columns.subject", "animal"]
COLUMNS += ["--columns.start", "t", "--columns.factors", "drug"]


@pytest.fixture
def table(tmp_path, monkeypatch):
    """Eight animals, two sessions each, with a row without a label in each."""
    monkeypatch.chdir(tmp_path)
    rows = [
        (f"m{animal}", session, "saline" if animal % 2 else "drug", "?" if t == 9 else "abc"[(t * t + animal) % 3], t)
        for animal in range(8)
        for session in (1, 2)
        for t in range(20)
    ]
    pd.DataFrame(rows, columns=["animal", "session", "drug", "behaviour", "t"]).to_csv("lab.csv", index=False)


def test_report_fit_and_score_read_it_alike(table, capsys):
    quick = ["--models", "counts", "--folds", "2", "--processes", "1"]
    assert main(["report", "lab.csv", *COLUMNS, *quick, "--out", "report"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "16 of 320 rows have no label (first in lab.csv, line 11)" in said
    results = json.loads(Path("report/results.json").read_text())
    assert results["file"]["sequences"] == 32
    assert (results["file"]["subjects"], results["file"]["conditions"]) == (8, 2)
    assert results["unit"] == "subjects"
    fit = ["fit", "lab.csv", "--config", "markov", "--held_out", "0.25", "--out", "prior"]
    assert main([*fit, *COLUMNS]) == 0
    assert load("prior").action_names == ("a", "b", "c")
    assert main(["fit", "--resume", "prior"]) == 0
    assert main(["score", "prior", "lab.csv", *COLUMNS, "--out", "score"]) == 0
    assert len(pd.read_csv("score/groups.csv")) == 8
    plans = pd.read_csv("score/plans.csv")
    assert len(plans) == 32
    assert plans["recording"].tolist() == [1, 1, 2, 2] * 8  # the sessions as the file names them, in two parts each
    said = " ".join(capsys.readouterr().out.split())
    assert f"Training data: {plans['training_data'].sum()} of 32 plans" in said
    assert plans["training_data"].sum() >= 24  # all but the held-out ones, and those of these that are the same
    assert main(["report", "lab.csv", *COLUMNS, "--priors", "prior", "--out", "scored"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Held-out scores" not in said
    assert "(training data)" in said
    learned = plans["training_data"].sum()
    assert f"These are training data: prior has learned from {learned} of the 32 sequences." in said


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--missing", "error", *COLUMNS], "lab.csv, line 11"),
        (["--missing", "drop", *COLUMNS], "gap"),
        (["--columns.behaviour", "act"], "'act'"),
        (["--columns.act", "behaviour"], "act"),
        (["--rename", "rest"], "OLD=NEW"),
    ],
)
def test_bad_options_are_one_line(options, words, table, capsys):
    assert main(["report", "lab.csv", *options, "--out", "report"]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


def test_factors_are_compared_within_others(tmp_path, monkeypatch, capsys):
    """Days vary within animals; sexes, of which one is treated more often, are strata."""
    monkeypatch.chdir(tmp_path)
    rows = [
        (f"m{n}", day, ("drug", "saline", "vehicle")[n % 3], "fm"[n > 7], "abc"[(t * t + n * day) % 3], t)
        for n in range(15)
        for day in (1, 2)
        for t in range(30)
    ]
    pd.DataFrame(rows, columns=["animal", "day", "treatment", "sex", "behaviour", "t"]).to_csv("lab.csv", index=False)
    columns = ["--columns.behaviour", "behaviour", "--columns.start", "t", "--columns.recording", "day"]
    columns += ["--columns.factors", "treatment", "sex", "day"]
    quick = ["--models", "counts", "--folds", "2", "--processes", "1", "--out"]
    design = ["--compare", "treatment", "--reference", "vehicle"]
    assert main(["report", "lab.csv", *columns, *design, *quick, "report"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "'day' varies within a subject" in said
    assert "between the 3 conditions" in said
    assert pd.read_csv("report/condition_pairs.csv")["first"].unique().tolist() == ["vehicle", "drug"]
    assert {"difference, f", "difference, m"} <= {*pd.read_csv("report/condition_interaction.csv").columns}
    assert main(["report", "lab.csv", *columns, *design, "--strata", *quick, "without"]) == 0
    assert not Path("without/condition_interaction.csv").exists()
    assert main(["report", "lab.csv", *columns, "--compare", "dose", *quick, "wrong"]) == 2
    assert "`compare` must be a factor of the recordings, treatment, sex, day, got 'dose'" in capsys.readouterr().err


def test_the_large_example_is_read_and_checked(tmp_path, capsys):
    place = str(tmp_path / "large.csv")
    assert main(["example", place, "--study", "large"]) == 0
    assert f"neuroprior check {place} --columns.observer observer" in capsys.readouterr().out
    assert main(["check", place, "--columns.observer", "observer"]) == 0
    assert "24 recordings of 24 subjects" in capsys.readouterr().out
    assert main(["example", str(tmp_path / "other.csv"), "--study", "huge"]) == 2


def test_names_are_printed_as_they_are_written(tmp_path, monkeypatch, capsys):
    """What stands in brackets is no style of the terminal."""
    monkeypatch.chdir(tmp_path)
    rows = [("m1 [red]", ("walk [fast]", "rest")[t % 2], t) for t in range(9)]
    pd.DataFrame(rows, columns=["animal", "behaviour", "t"]).to_csv("lab [bold].csv", index=False)
    columns = ["--columns.behaviour", "behaviour", "--columns.start", "t"]
    assert main(["check", "lab [bold].csv", *columns]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "walk [fast]" in said
    assert "lab [bold].csv" in said
    Path("lab [bold].csv").write_text("animal,behaviour,t\nm1,walk,x\nm1,rest,2\n")
    assert main(["check", "lab [bold].csv", *columns]) == 2
    assert "lab [bold].csv" in capsys.readouterr().out
