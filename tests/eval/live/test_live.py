"""`python -m eval live`: a small comparison from end to end, and its tables from made-up results."""

import json
import re

import numpy as np
import pytest
import torch

from eval.__main__ import main
from eval.live import run as live
from eval.live.report import live_document, live_frame, live_pairs
from eval.live.run import PARTS, RANDOM, Condition, LiveSettings, conditions
from eval.worlds.runs import Run
from neuroprior._statistics import paired_difference
from neuroprior.planners import Execution, SamplingPlanner
from tests.support.reports import FROM_ELSEWHERE

pytestmark = pytest.mark.usefixtures("undrawn")

SMALL = ["live", "--worlds", "forage_grid", "--kinds", "markov", "--seeds", "2", "--seasons", "2", "--period", "64"]
SMALL += ["--agents", "3", "--items", "2", "--num-plans", "4", "--length", "8", "--processes", "1"]


def test_a_small_comparison(tmp_path, capsys):
    out = tmp_path / "out"
    assert main([*SMALL, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "Food eaten in 100 steps" in " ".join(printed.split())
    results = json.loads((out / "results.json").read_text())
    rows = results["rows"]
    assert [(row["prior"], row["context"], row["learns"], row["warm_start"]) for row in rows] == list(
        conditions(("markov",))
    )
    for row in rows:
        assert row["seeds"] == 2
        assert row["low"] <= row["reward"] <= row["high"]
        assert row["prior"] == "oracle" or row["model_steps"] in (5 * 8 / 4, (4 * 8 * 32 + 8 * 31) / 32 / 4)
    assert rows[-1]["oracle_share"] == 1
    page = (out / "report.html").read_text()
    assert not re.search(FROM_ELSEWHERE, page)
    assert page.count("<svg") == 1
    assert (out / "forage_grid.png").stat().st_size > 0
    kept = sorted((out / "runs").rglob("forage*.json"))
    times = [path.stat().st_mtime_ns for path in kept]
    assert main([*SMALL, "--out", str(out)]) == 0  # finished runs are not done again
    assert [path.stat().st_mtime_ns for path in kept] == times
    assert len(times) == 2
    assert capsys.readouterr().out == printed


def test_half_of_what_was_done_is_forgotten_after_a_half_life(monkeypatch):
    """However often a prior learns; and without a warm start there is one candidate more."""
    made, settings = [], LiveSettings(("markov", "gru"), 64, 1, 2, 2, 4, 8, 0)

    class Idle:
        def __init__(self, world, planner, prior, state, **how):
            made.append((planner, how))
            self.state = state

        def run(self, steps):
            return Execution(*torch.ones(3, len(self.state), steps), 0)

    monkeypatch.setattr(live, "Agent", Idle)
    entries = live.run_live(Run("forage_grid", 0), settings)["entries"]
    assert all(entry["rewards"] == [1.0] * PARTS for entry in entries)  # a step
    assert {how["learn_every"] for _, how in made} == {None, 16, 64}
    for planner, how in made:
        if how["learn_every"]:
            assert how["retention"] ** (live.HALF_LIFE / how["learn_every"]) == pytest.approx(0.5)
        if isinstance(planner, SamplingPlanner):
            assert planner.num_plans == (4 if how["warm_start"] else 5)


def made_up(seeds=6, seasons=2, worlds=("forage_grid",)):
    """Results in which an agent that learns online is rewarded .2 more than random, from the second season on."""
    generator = np.random.default_rng(0)
    worth = {"oracle": 0.5, "uniform": 0.1, "markov": 0.1}
    results = []
    for world in worlds:
        for seed in range(seeds):
            entries = []
            for condition in conditions(("markov",)):
                rewards = worth[condition.prior] + 0.01 * generator.random((seasons, PARTS))
                rewards[1:] += 0.2 * (condition.learns == "online")
                entry = condition._asdict() | {"rewards": rewards.flatten().tolist()}
                entries.append(entry | {"seconds": 1e-4, "model_steps": 128})
            results.append({"world": world, "seed": seed, "about": "a grid", "period": 64, "places": 9.0})
            results[-1]["entries"] = entries
    return results


def test_what_is_reported():
    results = made_up()
    document = live_document(results, {}, "")
    rows, gaps = (document.frames[name].to_dict("records") for name in ("rows", "paired"))
    online = next(row for row in rows if row["learns"] == "online" and row["context"] == "none")
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
        [100 * np.mean(entry["rewards"]) for one in results for entry in one["entries"] if pick(entry)]
        for pick in (
            lambda entry: entry["learns"] == "online" and entry["context"] == "none",
            lambda entry: entry["prior"] == "uniform" and entry["warm"],
        )
    )
    due = paired_difference(own, other)
    assert (gap["difference"], gap["low"], gap["p_value"]) == pytest.approx((due.mean, due.low, due.p_value))
    eaten, _ = document.sections[1].tables
    assert [row[3].endswith("*") for row in eaten.rows] == [False, False, False, True, False, True, False, False]
    significant, tests = sum(gap["p_holm"] < 0.05 for gap in gaps), len(gaps)
    assert f"{significant} of {tests} differences are significant" in document.lead


def test_parts_of_seasons():
    """`after` and `late`: the first and the last quarter of all seasons but the first; in 100 steps."""
    (result, *_) = made_up(1, seasons=3)
    for number, entry in enumerate(result["entries"]):
        entry["rewards"] = [0.01 * (number + place) for place in range(3 * PARTS)]
    rows = live_document([result], {}, "").frames["rows"]
    second, third = range(PARTS, 2 * PARTS), range(2 * PARTS, 3 * PARTS)
    quarter = PARTS // 4
    for number, row in enumerate(rows.itertuples()):
        assert row.reward == pytest.approx(number + np.mean(range(3 * PARTS)))
        assert row.after == pytest.approx(number + np.mean([*second[:quarter], *third[:quarter]]))
        assert row.late == pytest.approx(number + np.mean([*second[-quarter:], *third[-quarter:]]))
    reward = dict(zip(conditions(("markov",)), rows["reward"], strict=True))
    other = {
        "learned before": lambda own: own._replace(learns="before"),
        "random": lambda own: RANDOM,
        "no warm start": lambda own: own._replace(warm=False),
    }
    pairs = live_pairs(live_frame([result]))
    assert pairs["against"].value_counts().to_dict() == {"learned before": 2, "random": 4, "no warm start": 2}
    for row in pairs.itertuples():
        own = Condition(row.prior, row.context, row.learns, row.warm_start)
        assert own.warm
        assert (row.first, row.second) == pytest.approx((reward[own], reward[other[row.against](own)]))


def test_a_single_seed_and_season():
    document = live_document(made_up(1, seasons=1), {}, "")
    assert document.frames["paired"].empty
    assert "need at least two seeds" in document.lead
    assert document.sections[1].tables[0].rows[0][5] == ""
    assert [box.name for box in document.sections[0].figures] == ["forage_grid"]


def test_aggregates_over_worlds_are_shares_of_the_oracle():
    across = live_document(made_up(worlds=("forage_grid", "forage_maze")), {}, "").frames["across"]
    online = across[(across["learns"] == "online") & (across["context"] == "none")].iloc[0]
    assert (online["worlds"], online["seeds"], online["improvement"]) == (2, 6, 1)
    assert online["first"] == pytest.approx(0.205 / 0.505, abs=0.02)
    assert online["second"] == pytest.approx(0.105 / 0.505, abs=0.02)
