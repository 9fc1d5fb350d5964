"""`python -m eval sources`: two small runs from end to end, their tables, and what is left out."""

import json

import pandas as pd
import pytest
import torch

from eval.__main__ import main
from eval.sources import run as sources
from eval.sources.report import sources_document
from eval.sources.run import PARTS, SOURCES, SourceSettings, run_sources
from eval.worlds.runs import Run
from neuroprior._statistics import mean_interval
from neuroprior.comparison.contestants import fit_prior
from neuroprior.planners import SamplingPlanner
from neuroprior.priors import MarkovPrior, UniformPrior

SMALL = ["sources", "--worlds", "grid", "--plans", "20", "30", "--seeds", "2", "--calls", "3", "--starts", "4"]
SMALL += ["--num-plans", "8", "--processes", "1"]


def test_two_small_runs(tmp_path, capsys, monkeypatch):
    """The other priors are chains, too: networks take their time."""

    def fitted(name, plans, number, generator):
        if name == "markov":
            return fit_prior(name, plans, number, generator)
        return MarkovPrior(number, {"gru": 0, "combined": 3}[name]).fit(plans.without_context())

    monkeypatch.setattr(sources, "fit_prior", fitted)
    assert main([*SMALL, "--out", str(tmp_path)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Candidates by source: second half of the calls" in printed
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert [(row["part"], row["plans"]) for row in rows] == [(part, plans) for plans in (20, 30) for part in PARTS]
    scores = pd.read_csv(tmp_path / "scores.csv")
    for row in rows:
        best = max(SOURCES, key=row.get)
        assert row["over_best"] == pytest.approx(row["shared"] - row[best])
        assert row["over_uniform"] == pytest.approx(row["shared"] - row["uniform"])
        assert row["learned"] == row["plans"]
        own = scores[(scores["part"] == row["part"]) & (scores["plans"] == row["plans"])]
        assert list(own["seed"]) == [0, 1]
        due = mean_interval(own["shared"] - own[best])
        assert (row["over_best_low"], row["over_best_high"]) == pytest.approx((due.low, due.high))
        assert f"{100 * row['shared']:.1f} {100 * row['over_best']:+.1f} ±" in printed
    assert len({row["shared"] for row in rows}) == len(rows)
    assert (tmp_path / "report.html").stat().st_size > 0


def planned(monkeypatch, best):
    """Entries of two starts in each of three calls: decision k scores k + 1, and random plans score 1."""
    monkeypatch.setattr(sources, "fit_prior", lambda name, plans, number, generator: UniformPrior(number))
    monkeypatch.setattr(sources.trial, "random_scores", lambda *given: torch.ones(6, dtype=torch.float64))
    monkeypatch.setattr(sources.trial, "true_scores", lambda *given: 1.0 + torch.arange(6).double()[:, None])
    monkeypatch.setattr(sources.trial, "training_plans", lambda *given: range(25))
    monkeypatch.setattr(sources.trial, "optimum", lambda *given: best)
    return run_sources(Run("grid", 0), SourceSettings((20, 30), 3, 2, 8, 0))


def test_scores_of_parts(monkeypatch):
    """With an optimum of 1 + 10; the second half of three calls of two starts are the last four decisions."""
    result = planned(monkeypatch, torch.full((6,), 11.0))
    assert [(one["plans"], one["learned"]) for one in result["entries"]] == [(20, 20)] * 2 + [(30, 25)] * 2
    for entry in result["entries"]:
        due = (0 + 1 + 2 + 3 + 4 + 5) / 60 if entry["part"] == PARTS[0] else (2 + 3 + 4 + 5) / 40
        assert [entry[name] for name in (*SOURCES, "shared")] == pytest.approx([due] * 5)
    cells = [row[1] for row in sources_document([result], {}, "").sections[0].tables[0].rows]
    assert cells == ["20", "30 (25)"]


def test_without_an_optimum_the_best_that_any_reached_is_one(monkeypatch):
    assert {entry["shared"] for entry in planned(monkeypatch, None)["entries"]} == {1.0}


def test_which_planners_decide(monkeypatch):
    """Each source alone, then the three that learned together; each in three calls of two starts."""
    calls = []

    class Recorded(SamplingPlanner):
        def plan(self, world, state, generator=None):
            number = 1 if self.sources is None else len(self.sources.priors)
            calls.append((number, self.num_plans, len(state)))
            return super().plan(world, state, generator)

    monkeypatch.setattr(sources, "SamplingPlanner", Recorded)
    planned(monkeypatch, None)
    alone, together = [(1, 8, 2)] * 3, [(3, 8, 2)] * 3  # the fitted ones are uniform here: none is added
    assert calls == alone + 2 * (3 * alone + together)


def test_what_is_left_out(monkeypatch):
    nothing = planned(monkeypatch, torch.ones(6))
    monkeypatch.setattr(sources.trial, "training_plans", lambda *given: None)
    few = run_sources(Run("maze", 1), SourceSettings((20,), 2, 2, 8, 0))
    document = sources_document([nothing, few], {}, "")
    assert document.frames == {}
    assert document.lead == (
        "grid, seed 0: left out, no plan is better than random ones."
        " maze, seed 1: left out, too few plans were better than random ones."
    )
