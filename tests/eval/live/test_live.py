"""`python -m eval live`: a small comparison from end to end, and its tables from made-up cells."""

import json
import re

import numpy as np
import pytest

from eval.__main__ import main
from eval.live import report as live_report
from eval.live.run import lives
from neuroprior.analysis.statistics import paired_difference
from tests.support.reports import FROM_ELSEWHERE

SMALL = ["live", "--worlds", "forage_grid", "--kinds", "markov", "--seeds", "2", "--seasons", "2", "--period", "64"]
SMALL += ["--agents", "3", "--items", "2", "--num-plans", "4", "--processes", "1"]


def test_a_small_comparison(tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*SMALL, "--out", str(out)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "forage_grid: food eaten in 100 steps" in told
    results = json.loads((out / "results.json").read_text())
    rows = results["rows"]
    assert [(row["prior"], row["sees"], row["learns"], row["warm_start"]) for row in rows] == list(lives(("markov",)))
    for row in rows:
        assert row["seeds"] == 2
        assert row["low"] <= row["reward"] <= row["high"]
        assert row["prior"] == "oracle" or row["model_steps"] in (5 * 16 / 4, (4 * 16 * 32 + 16 * 31) / 32 / 4)
    assert rows[-1]["oracle_share"] == 1
    page = (out / "report.html").read_text()
    assert not re.search(FROM_ELSEWHERE, page)
    assert page.count("<svg") == 1


def test_finished_cells_are_not_done_again(tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*SMALL, "--seeds", "1", "--out", str(out)]) == 0
    (cell,) = (out / "cells").rglob("forage*.json")
    first = cell.stat().st_mtime_ns
    table = capsys.readouterr().out
    assert main([*SMALL, "--seeds", "1", "--out", str(out)]) == 0
    assert cell.stat().st_mtime_ns == first
    assert capsys.readouterr().out == table


def made_up(seeds=6):
    """Cells in which an agent that learns online is rewarded .2 more than random, from the second season on."""
    generator = np.random.default_rng(0)
    worth = {"oracle": 0.5, "uniform": 0.1, "markov": 0.1}
    cells = []
    for seed in range(seeds):
        entries = []
        for life in lives(("markov",)):
            rewards = worth[life.prior] + 0.01 * generator.random((2, live_report.PARTS))
            rewards[1] += 0.2 * (life.learns == "online")
            entry = life._asdict() | {"rewards": rewards.flatten().tolist(), "seconds": 1e-4, "model_steps": 128}
            entries.append(entry)
        cells.append({"world": "forage_grid", "seed": seed, "about": "a grid", "period": 64, "places": 9.0})
        cells[-1]["entries"] = entries
    return cells


def test_what_is_told():
    cells = made_up()
    rows, gaps = live_report.live_rows(cells), live_report.paired_rows(cells)
    online = next(row for row in rows if row["learns"] == "online" and row["sees"] == "nothing")
    assert online["reward"] == pytest.approx(100 * (0.1 + 0.1 + 0.005), abs=0.3)
    assert online["after"] == pytest.approx(30.5, abs=0.6)
    assert online["late"] == pytest.approx(30.5, abs=0.6)
    assert online["oracle_share"] == pytest.approx(0.205 / 0.505, abs=0.02)
    assert {(gap["prior"], gap["learns"], gap["against"]) for gap in gaps} == {
        ("markov", "online", "learned before"),
        ("markov", "online", "random"),
        ("markov", "before", "random"),
        ("markov", "online", "no warm start"),
        ("uniform", "never", "no warm start"),
    }
    gap = next(gap for gap in gaps if gap["against"] == "random" and gap["learns"] == "online")
    own, other = (
        [100 * np.mean(entry["rewards"]) for cell in cells for entry in cell["entries"] if pick(entry)]
        for pick in (
            lambda entry: entry["learns"] == "online" and entry["sees"] == "nothing",
            lambda entry: entry["prior"] == "uniform" and entry["warm"],
        )
    )
    due = paired_difference(own, other)
    assert (gap["difference"], gap["low"], gap["p_value"]) == pytest.approx((due.mean, due.low, due.p_value))
    said = live_report.words(gaps, "forage_grid")
    assert re.search(r"markov, sees nothing, learns online against random \+(9\.9|10\.)", said)
    assert "Not to be told apart in so many tests: random against no warm start" in said
    table = live_report.table(rows, gaps, "forage_grid")
    assert [row[3].endswith("*") for row in table.rows] == [False, False, False, True, False, True, False, False]


def test_a_single_seed_and_season():
    cells = made_up(1)
    for entry in cells[0]["entries"]:
        entry["rewards"] = entry["rewards"][: live_report.PARTS]
    rows, gaps = live_report.live_rows(cells), live_report.paired_rows(cells)
    assert gaps == []
    assert "several seeds" in live_report.words(gaps, "forage_grid")
    assert rows[0]["after"] is None
    assert live_report.table(rows, gaps, "forage_grid").rows[0][5] == ""
    live_report.live_figure(cells, "forage_grid")


@pytest.mark.parametrize(
    ("given", "word"),
    [
        (["--worlds", "nowhere"], "nowhere"),
        (["--kinds", "markov", "markov"], "kinds"),
        (["--seeds", "0"], "seeds"),
        (["--period", "100"], "period: a multiple of 64"),
        (["--length", "6"], "length"),
        (["--items", "20"], "items"),
        (["--agents", "0"], "agents"),
        (["--processes", "0"], "processes"),
        (["--seed", "-1"], "seed"),
    ],
)
def test_bad_options(given, word, tmp_path, capsys):
    assert main([*SMALL, *given, "--out", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert word in told
    assert not list(tmp_path.iterdir())
