"""What the report makes of its arguments: which plans are learned from, scored and described, and in how many folds."""

import math
from dataclasses import replace
from typing import Any

import pandas as pd
import pytest
import torch

from neuroprior import Plans
from neuroprior.behaviour import read
from neuroprior.behaviour.reporting import plan_report
from neuroprior.behaviour.reporting.document import Document
from neuroprior.behaviour.reporting.options import FitOptions, ReadOptions
from neuroprior.behaviour.reporting.plan_report import report
from neuroprior.priors import MarkovPrior, UniformPrior, save
from neuroprior.priors.ensembles import candidates
from neuroprior.priors.ensembles.screening import Screening
from neuroprior.priors.scoring import keep_learned
from tests.support.chains import markov_plans, markov_probs
from tests.support.reports import QUICK, QUICK_IN_TWO
from tests.support.sources import seeded

SCORES: dict[str, Any] = {"fits": QUICK, "sections": ["scores"]}
IN_TWO: dict[str, Any] = {"fits": QUICK_IN_TWO, "sections": ["scores"]}


def chain(num: int = 12, length: int = 8, seed: int = 1, **more: Any) -> Plans:
    return markov_plans(markov_probs(3, 1, 0, 1.5), num, length, seed, **more)


def bits(document: Document, model: str, inputs: str = "behaviours") -> float:
    rows = document.frames["scores"]
    (found,) = rows["bits_per_behaviour"][(rows["model"] == model) & (rows["input"] == inputs)]
    return float(found)


@pytest.mark.parametrize(
    ("group", "folds"),
    [
        pytest.param(None, 5, marks=pytest.mark.slow),
        (torch.arange(12) % 3, 3),
        (torch.zeros(12, dtype=torch.long), 5),
        (torch.arange(12) % 6, 5),
    ],
)
def test_as_many_folds_as_there_are_units_but_five_at_most(group, folds):
    made = report(chain(group=group), **SCORES)
    assert made.settings["folds"] == folds
    assert not made.settings["cut"]


@pytest.mark.parametrize("num", [1, 12])
def test_test_plans_are_scored_and_nothing_is_held_out_of_the_others(num):
    """One test plan alone is cut; a chain of order 0 is that of all plans to learn from."""
    learned, other = chain(), chain(num, 60, seed=7)
    made = report(learned, test=other, **SCORES)
    costs = [
        -float(MarkovPrior(3, 0, s, backoff=b).fit(learned).log_prob(other).sum()) / math.log(2) / other.actions.numel()
        for b, s in (("kneser-ney", 1), ("kneser-ney", 0.5), ("witten-bell", 1), ("dirichlet", 1), ("dirichlet", 8))
    ]
    assert min(costs) - 1e-3 <= bits(made, "markov-0") <= max(costs) + 1e-3
    assert made.settings["folds"] == 1
    assert made.settings["cut"] == (num == 1)
    assert ("1 sequence is too few for a verdict" in " ".join(made.said)) == (num == 1)
    assert made.results["unit"] == ("parts of the sequence" if num == 1 else "sequences")


def test_contexts_of_plans_and_of_test_plans_are_numbered_together():
    """With gaps between them; the test plans have one, between the others, that those to learn from have not."""
    learned = chain(context=torch.arange(12) % 2 * 7 + 3)
    other = chain(8, seed=5, context=torch.arange(8) % 2 * 2 + 3)
    made = report(learned, test=other, **SCORES)
    same = report(
        replace(learned, context=torch.arange(12) % 2 * 2, context_names=("a", "b", "c")),
        test=replace(other, context=torch.arange(8) % 2, context_names=("a", "b", "c")),
        **SCORES,
    )
    for model in ("markov-0", "markov-1"):
        assert bits(made, model, "behaviours and context") == bits(same, model, "behaviours and context")


def test_what_has_no_actions_is_left_out_and_counted():
    plans = chain(length=4)
    empty = replace(plans, lengths=torch.tensor([0, 4, 4, 0, 4, 0, 4, 4, 4, 4, 4, 4]))
    others = replace(plans[empty.mask().any(1)], lengths=None)
    made, whole = (report(some, **IN_TWO) for some in (empty, others))
    assert made.settings["sequences without behaviours, left out"] == 3
    assert "sequences without behaviours, left out" not in whole.settings
    assert made.frames["scores"]["bits_per_behaviour"].tolist() == whole.frames["scores"]["bits_per_behaviour"].tolist()


def test_a_single_plan_is_cut_for_scores_and_described_whole():
    """What does not count is at the beginning of the plan, not of each part."""
    plans = chain(1, 300)
    made = report(plans, skip=10, fits=QUICK_IN_TWO, sections=["file", "scores"])
    assert made.results["file"]["sequences"] == 1
    assert made.results["file"]["longest"] == 300
    assert made.settings["cut"]
    rows = [row[-1] for row in made.sections[0].tables[1].rows]
    assert rows == ["1"] * 3
    assert bits(made, "uniform") == pytest.approx(math.log2(3), abs=1e-5)


@pytest.mark.parametrize(
    ("more", "sections", "kinds"),
    [
        ({"models": ["counts"]}, ["lags"], "counts, lags"),
        ({"models": ["gru"]}, ["lags"], "gru, lags, gru-lags"),
        ({}, ["scores"], "counts, combined, gru, stacked"),
        ({"effort": "full"}, ["scores"], "counts, combined, gru, transformer, stacked"),
        ({"effort": "fast"}, ["scores"], "counts, combined, gru"),
        ({"effort": "fast", "models": ["stacked", "combined"]}, ["scores"], "stacked, combined"),
    ],
)
def test_models_and_effort_decide_what_is_fitted(more, sections, kinds, monkeypatch):
    asked: dict[str, Any] = {}

    def stop(design, kinds, inputs):
        asked.update(design=design, kinds=", ".join(kinds))
        raise KeyboardInterrupt

    monkeypatch.setattr(plan_report, "jobs", stop)
    with pytest.raises(KeyboardInterrupt):
        report(chain(), sections=sections, fits=FitOptions(**more))
    assert asked["kinds"] == kinds
    assert asked["design"].effort == more.get("effort", "standard")


@pytest.mark.parametrize("skip", [0, 3])
def test_saved_priors_are_scored_on_the_actions_that_count_and_known_plans_are_marked(skip, tmp_path):
    """Two priors: the one has learned from four of the twelve plans, the other from none of them."""
    plans, others = (Plans(torch.randint(3, (num, 24), generator=seeded(num)), 3) for num in (12, 9))
    for name, some in (("one", torch.cat([plans.actions[:4], others.actions])), ("two", others.actions)):
        save(MarkovPrior(3, 1).fit(some), tmp_path / name)
        keep_learned(tmp_path / name, Plans(some, 3))
    folders = [str(tmp_path / name) for name in ("one", "two")]
    made = report(plans, priors=folders, skip=skip, sections=["scores"])
    assert made.settings["training data"] == {folders[0]: 4}
    assert f"{folders[0]} has learned from 4 of the 12 sequences" in " ".join(made.said)
    marked = [row[0].endswith("(training data)") for row in made.sections[0].tables[0].rows]
    assert marked == [True, False]
    prior = MarkovPrior(3, 1).fit(others.actions)
    expected = -prior.action_log_probs(plans)[:, skip:].mean() / math.log(2)
    assert made.frames["scores"]["bits_per_behaviour"][1] == pytest.approx(float(expected), abs=1e-5)


def test_options_of_files_reach_the_reader(tmp_path):
    """Rows that follow a pause end the plan, labels that are the same are merged, and a missing one counts."""
    rows = ["session,behaviour,begin,end"]
    for plan in range(8):
        acts = torch.randint(3, (12,), generator=seeded(plan)).tolist()
        for t, action in enumerate(acts):
            at = t + (100 if t >= 6 else 0)
            rows.append(f"s{plan},{'' if (plan, t) == (0, 2) else 'abc'[action]},{at},{at + 1}")
    (tmp_path / "plans.csv").write_text("\n".join(rows) + "\n")
    columns = {"recording": "session", "behaviour": "behaviour", "start": "begin", "stop": "end"}

    def facts(num_actions: int = 3, **options: Any) -> dict[str, Any]:
        reading, priors = ReadOptions(columns, ends="exclusive", **options), {"none": UniformPrior(num_actions)}
        return report(tmp_path / "plans.csv", priors=priors, reading=reading, sections=["file"]).results["file"]

    plain, gap, merged = facts(), facts(max_gap=5), facts(merge_repeats=True)
    assert (plain["sequences"], gap["sequences"]) == (9, 17)
    assert merged["behaviours"] < plain["behaviours"] == gap["behaviours"] == 95
    labelled = facts(4, missing="label")
    assert (labelled["behaviours"], labelled["kinds"]) == (96, 4)


def test_recordings_have_a_time_budget_and_a_reference(tmp_path):
    rows = [
        (f"m{a}", "drug" if a % 2 else "saline", "abc"[(t + a) % 3], 2 * t, 2 * t + (2 if (t + a) % 3 else 1))
        for a in range(6)
        for t in range(12)
    ]
    frame = pd.DataFrame(rows, columns=["animal", "treatment", "behaviour", "start", "stop"])
    fits = FitOptions(models=["counts"], folds=2, processes=1)
    found = report(
        read(frame), fits=fits, sections=["recordings", "conditions"], reading=ReadOptions(reference="saline")
    )
    budget = found.tables["time_budget"].set_index(["condition", "behaviour"])
    watched = [23 if (11 + a) % 3 == 0 else 24 for a in range(6)]
    due = sum(4 / watched[a] for a in (1, 3, 5)) / 3  # "a" takes 1 of every 2, four times
    assert budget.loc[("drug", "a"), "share"] == pytest.approx(due)
    assert budget.loc[("drug", "a"), "subjects"] == 3
    assert [name for name in found.tables["conditions"].columns if name.startswith("mean")] == [
        "mean, saline",
        "mean, drug",
    ]


@pytest.mark.parametrize(("pays", "named"), [(False, False), (True, False), (False, True)])
def test_networks_are_trained_where_they_pay_or_are_named(pays, named, monkeypatch):
    """Screened, they are tried in the first fold alone; what they promised is said."""
    asked = list[int]()

    def screened(*args: Any) -> Screening:
        asked.append(len(args[2]))
        return Screening(0.0, 0.0, -1.0 if pays else 1.0)

    monkeypatch.setattr(candidates, "screen", screened)
    models = ["counts", "gru", "combined"] if named else None
    made = report(chain(20), sections=["scores"], fits=FitOptions(models=models, folds=3, max_steps=1, processes=1))
    found, text = set(made.frames["scores"]["model"]), " ".join(made.sections[0].text)
    assert ("gru" in found) == (pays or named)
    assert ("promised at most: gru (0.0000)." in text) == (not pays and not named)
    assert len(asked) == (0 if named else 1 + pays)


def test_test_plans_that_are_learned_from_are_marked():
    """But for short ones, which may be equal by chance."""
    learned, other = (Plans(torch.randint(3, (size, 30), generator=seeded(size)), 3) for size in (9, 6))
    parts = Plans(torch.cat([learned.actions[:3], other.actions])[:, :25], 3)
    assert "training data" not in report(learned, test=parts, **SCORES).settings
    again = Plans(torch.cat([learned.actions[:4], other.actions]), 3)
    assert report(learned, test=again, **SCORES).settings["training data"] == {"each model": 4}
    short = learned.actions[:, :9]
    assert "training data" not in report(Plans(short, 3), test=Plans(short[:4].clone(), 3), **SCORES).settings


def test_an_error_leaves_a_page_that_says_so(tmp_path, monkeypatch):
    def fail(*args: Any) -> None:
        raise ValueError("no more")

    monkeypatch.setattr(plan_report, "evaluate", fail_after(1, plan_report.evaluate, fail))
    with pytest.raises(ValueError, match="no more"):
        report(chain(), out=tmp_path, fits=QUICK_IN_TWO, sections=["file", "scores"])
    assert "Stopped by an error (no more): models or modes are missing." in (tmp_path / "report.html").read_text()


def fail_after(number: int, function: Any, fail: Any) -> Any:
    """The function, which fails from the call after so many on."""
    calls = []

    def called(*args: Any) -> Any:
        calls.append(args)
        return function(*args) if len(calls) <= number else fail()

    return called


def test_too_few_actions_are_refused_at_once(tmp_path):
    plans = Plans(torch.tensor([[0, 1], [1, 0]]), 2, torch.tensor([2, 1]), group=torch.tensor([0, 1]))
    with pytest.raises(ValueError, match="at least 4 actions to learn from are needed in each fold, got 1"):
        report(plans, out=tmp_path, sections=["scores"], fits=FitOptions(models=["counts"], processes=1))
    assert not (tmp_path / "report.html").exists()
