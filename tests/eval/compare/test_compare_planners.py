"""`python -m eval compare --planners`: a small comparison from end to end, and its tables from made-up cells."""

import csv
import json
import re

import pytest

from eval.__main__ import main
from eval.compare import command as compare
from eval.compare import planner_report
from eval.compare import planners as compare_planners
from neuroprior.analysis.statistics import paired_difference
from tests.support.reports import FROM_ELSEWHERE

SMALL = [
    *(
        "compare",
        "--planners",
        "sampling",
        "distinct",
        "frontier",
        "mcts",
        "cross-entropy",
        "halving",
        "replanning",
        "--kinds",
        "markov",
        "--rounds",
        "1",
    ),
    *("--worlds", "grid", "slippery", "--seeds", "2", "--starts", "4", "--training-starts", "60"),
    *("--num-plans", "4", "16", "--processes", "1"),
]


def test_a_small_comparison(tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    assert main([*SMALL, "--out", str(out)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "grid, 16 plans:" in told
    results = json.loads((out / "results.json").read_text())
    rows = results["rows"]
    names = {"world", "planner", "prior", "num_plans", "model_steps", "oracle_share", "low", "high"}
    assert names | {"seconds_per_decision"} <= set(rows[0])
    by_world = {world: {row["planner"] for row in rows if row["world"] == world} for world in ("grid", "slippery")}
    assert by_world == {
        "grid": set(compare_planners.PLANNERS) - compare_planners.ONLY_CHANCE,
        "slippery": compare_planners.CHANCE,
    }
    assert {row["prior"] for row in rows} == {"uniform", "markov-3"}
    for row in rows:
        length = {"grid": 8, "slippery": 14 * 16}[row["world"]]
        assert 0 < row["model_steps"] <= max(row["num_plans"], 14 * (row["world"] == "slippery")) * length
        assert (
            row["planner"] in ("distinct", "frontier", "mcts", "halving", "replanning")
            or row["model_steps"] == row["num_plans"] * length
        )
        assert row["oracle_share"] <= 1 + 1e-6 or row["world"] == "slippery"
    with (out / "paired.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(results["paired"]) == 2 * (4 * 2) + 2 * (3 * 2)
    page = (out / "report.html").read_text()
    assert not re.search(FROM_ELSEWHERE, page)
    assert "cross-entropy" in page
    monkeypatch.setattr(compare, "PLANNERS", {})  # none is known
    assert main([*SMALL, "--out", str(out)]) == 2
    assert "planners" in capsys.readouterr().err
    monkeypatch.undo()
    monkeypatch.setattr(compare_planners, "_entry", None)
    assert main([*SMALL, "--out", str(out)]) == 0
    assert json.loads((out / "results.json").read_text())["rows"] == rows


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["best"], "planners: 'best' is not known"),
        (["mcts", "mcts"], "planners: each may be given"),
        (["mcts", "--worlds", "grid", "slippery"], "planners: none of mcts is for slippery"),
        (["halving", "--worlds", "grid"], "planners: none of halving is for grid"),
    ],
)
def test_bad_planners_are_one_line(given, says, tmp_path, capsys):
    assert main(["compare", "--planners", *given, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def cells(gap, seeds=4):
    """Samples that reach .5 to .53, and trees that reach `gap` more."""

    def entry(planner, shares):
        return {"planner": planner, "prior": "gru", "sees": "start", "rounds": 1, "share": shares} | {
            what: [8 * n for n in (4, 16)] for what in ("model_steps", "seconds")
        }

    for seed in range(seeds):
        low = 0.5 + 0.01 * seed
        entries = [entry("sampling", [low, low + 0.1]), entry("mcts", [low + gap * (1 + seed % 2), low + 0.1])]
        yield {"world": "maze", "seed": seed, "about": "a maze", "num_plans": [4, 16], "entries": entries}


def test_differences_are_paired_by_seed():
    made = list(cells(0.2))
    first, second = planner_report.paired_rows(made)
    shares = [[cell["entries"][k]["share"][0] for cell in made] for k in (1, 0)]
    gap = paired_difference(*shares)
    assert first["difference"] == pytest.approx(0.3)
    assert (first["low"], first["high"], first["p_value"]) == pytest.approx((gap.low, gap.high, gap.p_value))
    assert first["p_holm"] == pytest.approx(2 * gap.p_value)
    assert second["difference"] == 0
    assert second["p_holm"] == 1


def test_what_is_told():
    made = list(cells(0.2))
    rows, gaps = planner_report.planner_rows(made), planner_report.paired_rows(made)
    table = planner_report.table(rows, gaps, "maze")
    assert [row[:2] for row in table.rows] == [["gru", "sampling"], ["gru", "mcts"]]
    assert "Learned priors see start." in table.caption
    assert table.rows[1][2].startswith("81.5 ±")
    assert table.rows[1][2].endswith("*") == (gaps[0]["p_holm"] < 0.05)
    said = planner_report.words(rows, gaps, "maze")
    unclear = "maze, 16 plans: cannot be told apart from sampling in so many tests:"
    assert said == f"{unclear} mcts with gru, sees start +0.0 (+0.0 to +0.0)."
    alone = list(cells(0.2, seeds=1))
    rows = planner_report.planner_rows(alone)
    assert planner_report.paired_rows(alone) == []
    assert rows[0]["low"] is None
    assert "differences need several seeds" in planner_report.words(rows, [], "maze")
    assert planner_report.table(rows, [], "maze").rows[0][2] == "50.0"
