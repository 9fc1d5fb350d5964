"""`eval search`: ways of sampling and of weighting plans, in a small world; weights that make hard plans count."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from eval.compare import search
from eval.compare.curves import SETTINGS, Sampling
from eval.compare.run import Contest, Settings
from eval.compare.search import BOTH, FIRST, LIMITED, WEIGHTS, Learner, search_document, search_run
from eval.worlds.runs import Run
from neuroprior import MarkovPrior
from tests.eval.compare.test_run import TINY

SMALL = Settings((4, 16), ("markov", "gru"), ("per-step",), 1, 3, 4, 40, 0)


def test_ways_of_sampling_differ_in_what_may_be_chosen():
    found = {name: [one for one in SETTINGS if allowed(one)] for name, allowed in LIMITED.items()}
    assert found["neither"] == [Sampling(1.0, 0.0)]
    assert found["temperature"] == [Sampling(heat) for heat in (1.0, 1.5, 2.0)]
    assert found["uniform share"] == [Sampling(1.0, share) for share in (0.0, 0.1, 0.3)]
    assert found[BOTH] == list(SETTINGS)


@pytest.mark.slow
def test_runs_hold_every_way(monkeypatch):
    # With more layouts than that: each half of them is divided again, for early stopping.
    worlds = partial(TINY.worlds, num_layouts=8)
    monkeypatch.setitem(search.TASKS, "tiny", replace(TINY, contexts=("per-step",), worlds=worlds))
    runs = [search_run(Run("tiny", seed), SMALL) for seed in (0, 1)]
    ways = ["neither", "temperature", "uniform share", BOTH, "both, at 16"]
    for run in runs:
        found = [(one["prior"], one["planner"], one["num_plans"]) for one in run["entries"]]
        assert found == [
            (prior + after, way, number)
            for prior in ("markov-3", "gru")
            for after, more in ((FIRST, ()), ("", WEIGHTS))
            for way in (*ways, *more)
            for number in (4, 16)
        ]
        same = {(one["prior"], one["num_plans"], one["temperature"], one["uniform_share"]) for one in run["entries"]}
        drawn = {one["share"] for one in run["entries"] if one["planner"] in ways}
        assert len(drawn) <= len(same)  # what is sampled alike is the same draw
        for one in run["entries"]:
            assert 0 < one["share"] <= 1 + 1e-9
            assert LIMITED.get(one["planner"], LIMITED[BOTH])(Sampling(one["temperature"], one["uniform_share"]))
    document = search_document(runs, {"num_plans": (4, 16)}, "search")
    gaps = document.frames["differences"]
    assert len(gaps) == 2 * (4 + 7) * 2
    values = [
        {(e["prior"], e["num_plans"]): e["share"] for e in run["entries"] if e["planner"] == way}["gru", 4]
        for run in runs
        for way in ("neither", BOTH)
    ]
    row = gaps[(gaps["prior"] == "gru") & (gaps["planner"] == "neither") & (gaps["num_plans"] == 4)].iloc[0]
    assert row["difference"] == pytest.approx((values[0] - values[1] + values[2] - values[3]) / 2)


def test_plans_are_weighed_by_what_others_taught(monkeypatch):
    """Nine plans in ten are the same: with weights the tenth becomes commoner, and more so if one of 64 is to be it."""
    monkeypatch.setitem(search.TASKS, "tiny", TINY)
    contest = Contest(Run("tiny", 0), TINY, replace(SMALL, context=("none",), kinds=("markov",)), (1,))
    one = next(one for one in contest.contestants() if one.plans is not None)
    actions = torch.zeros(400, 3, dtype=torch.long)
    actions[::10] = torch.tensor([1, 2, 1])
    plans = replace(one.plans[:1], actions=actions, lengths=None, context=None, group=None)
    learner = Learner(contest, one)
    plain, found = learner.fitted(plans), learner.reweighted(plans)
    rare = [float(prior.log_prob(plans[:1]).exp()) for prior in (plain, *found.values())]
    assert isinstance(plain, MarkovPrior)
    assert rare[0] == pytest.approx(0.1, abs=0.03)
    assert rare[1] == pytest.approx(0.1, abs=0.06)
    # Of weights -log p: 0.1 * 2.3 / (0.1 * 2.3 + 0.9 * 0.1) = 0.7; with the others nearly none.
    assert 0.5 < rare[2] < rare[3]
