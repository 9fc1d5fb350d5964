"""`python -m eval compare --planners`: a small comparison from end to end, and its tables from made-up results."""

import csv
import json
import re

import pandas as pd
import pytest

from eval.__main__ import main
from eval.compare import planners
from eval.compare.planners import planner_document
from eval.worlds.aggregates import interquartile_mean
from neuroprior._statistics import paired_difference
from tests.support.reports import FROM_ELSEWHERE

pytestmark = pytest.mark.usefixtures("undrawn")

SMALL = ["compare", "--planners", *planners.PLANNERS, "--kinds", "markov", "--rounds", "1", "--processes", "1"]
SMALL += ["--worlds", "grid", "slippery", "--seeds", "2", "--starts", "2", "--training-starts", "30"]
SMALL += ["--num-plans", "4", "16"]


def test_a_small_comparison(tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    assert main([*SMALL, "--out", str(out)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "grid, 16 plans:" in text
    results = json.loads((out / "results.json").read_text())
    rows = results["rows"]
    names = {"world", "planner", "prior", "num_plans", "model_steps", "oracle_share", "low", "high"}
    assert names | {"seconds_per_decision"} <= set(rows[0])
    by_world = {world: {row["planner"] for row in rows if row["world"] == world} for world in ("grid", "slippery")}
    assert by_world == {
        "grid": set(planners.PLANNERS) - planners.ONLY_STOCHASTIC,
        "slippery": planners.STOCHASTIC,
    }
    assert {row["prior"] for row in rows} == {"uniform", "markov-3"}
    for row in rows:
        length = {"grid": 8, "slippery": 14 * 16}[row["world"]]
        noisy = row["world"] == "slippery"  # where the plan that was chosen is tried once more
        assert 0 < row["model_steps"] <= max(row["num_plans"] + noisy, 14 * noisy) * length
        others = row["planner"] in ("frontier", "mcts", "halving", "replanning")
        assert others or row["model_steps"] == (row["num_plans"] + noisy) * length
        assert row["oracle_share"] <= 1 + 1e-6 or row["world"] == "slippery"
    with (out / "paired.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(results["paired"]) == 2 * (2 * 2) + 2 * (2 * 2)
    page = (out / "report.html").read_text()
    assert not re.search(FROM_ELSEWHERE, page)
    assert "frontier" in page
    monkeypatch.setattr(planners, "Contest", None)  # finished runs are not done again
    assert main([*SMALL, "--out", str(out)]) == 0
    assert json.loads((out / "results.json").read_text())["rows"] == rows


def results(gap, seeds=4, worlds=("maze",)):
    """Samples that reach .5 to .53, and trees that reach `gap` more."""

    def entry(planner, number, share):
        label = {"planner": planner, "prior": "gru", "context": "initial", "num_plans": number, "share": share}
        return label | {"model_steps": 8 * number, "seconds": 0.01 * number}

    for world in worlds:
        for seed in range(seeds):
            low = 0.5 + 0.01 * seed
            trees = low + gap * (1 + seed % 2)
            entries = [entry("sampling", 4, low), entry("sampling", 16, low + 0.1)]
            entries += [entry("mcts", 4, trees), entry("mcts", 16, low + 0.1)]
            yield {"world": world, "seed": seed, "about": "a maze", "entries": entries}


def shares(made, planner, number, world="maze"):
    entries = [entry for one in made if one["world"] == world for entry in one["entries"]]
    return [entry["share"] for entry in entries if (entry["planner"], entry["num_plans"]) == (planner, number)]


def test_differences_are_paired_by_seed():
    made = list(results(0.2))
    first, second = planner_document(made, {}, "").frames["paired"].to_dict("records")
    gap = paired_difference(shares(made, "mcts", 4), shares(made, "sampling", 4))
    assert first["difference"] == pytest.approx(0.3)
    assert (first["low"], first["high"], first["p_value"]) == pytest.approx((gap.low, gap.high, gap.p_value))
    assert first["p_holm"] == pytest.approx(2 * gap.p_value)
    assert second["difference"] == 0
    assert second["p_holm"] == 1


def test_a_single_seed_has_no_interval():
    document = planner_document(list(results(0.2, seeds=1)), {}, "")
    assert document.frames["paired"].empty
    assert pd.isna(document.frames["rows"]["low"][0])
    assert "need at least two seeds" in document.lead
    assert document.sections[1].tables[0].rows[0][3] == "50.0"


def test_aggregates_over_worlds():
    made = list(results(0.2, worlds=("maze", "grid", "cube")))
    frames = planner_document(made, {}, "").frames
    # Corrected for the tests in the same world alone.
    assert (
        frames["paired"]["p_holm"].tolist()
        == planner_document(made[:4], {}, "").frames["paired"]["p_holm"].tolist() * 3
    )
    across = frames["across"]
    assert across["num_plans"].tolist() == [4, 16]
    assert across[["worlds", "seeds"]].to_numpy().tolist() == [[3, 4], [3, 4]]
    for planner, side in (("mcts", "first"), ("sampling", "second")):
        due = interquartile_mean([shares(made, planner, 4, world) for world in ("maze", "grid", "cube")])
        assert across.loc[0, [side, f"{side}_low", f"{side}_high"]].tolist() == pytest.approx(list(due))
    assert across["improvement"].tolist() == [1, 0.5]
    assert planner_document(list(results(0.2)), {}, "").frames["across"].empty
    # Seeds that one of the worlds lacks are left out.
    assert planner_document(made[:-1], {}, "").frames["across"]["seeds"].tolist() == [3, 3]
