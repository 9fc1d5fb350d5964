"""The sections of a report on plans, and the report as a function."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.figure import Figure

from neuroprior.behaviour import RecordedPlans, rate_drift, read
from neuroprior.behaviour.reporting.document import Document
from neuroprior.behaviour.reporting.options import FitOptions, ReadOptions
from neuroprior.behaviour.reporting.page import FigureBox
from neuroprior.behaviour.reporting.plan_report import report
from neuroprior.behaviour.reporting.scores import evaluate_saved
from neuroprior.behaviour.reporting.sections import (
    SECTIONS,
    drift_section,
    lag_section,
)
from neuroprior.plans import Plans
from neuroprior.priors import UniformPrior
from tests.support.chains import markov_plans, markov_probs
from tests.support.reports import QUICK_IN_TWO
from tests.support.sources import refuses, seeded


def found_in(plans: Plans):
    return evaluate_saved({"uniform": UniformPrior(plans.num_actions)}, RecordedPlans.of(plans), 0)


def test_gains_of_one_fold_are_shown_and_not_starred():
    gains = pd.DataFrame([(1, 0.3, 0.1, 0.5, 9), (5, 0.1, 0.05, 0.2, 9), (6, 0.2, 0.1, 0.3, 9)])
    gains.columns = ["lag", "bits", "low", "high", "units"]
    plans = Plans(torch.randint(3, (12, 8), generator=seeded(0)), 3)
    part = lag_section(replace(found_in(plans), gains=gains.assign(what="gain", model="markov", input="behaviours")))
    assert part.section.tables[-1].rows == [["1", "0.3000"], ["6", "0.2000"]]  # lag 5 is in the file alone
    assert [figure.name for figure in part.section.figures] == ["lags"]
    assert not any(one.significant for one in part.findings)


@pytest.mark.parametrize(("animals", "starred"), [(6, ["run", "dig", "eat"]), (4, [])])
def test_drifts_are_starred_as_findings_where_there_are_enough_subjects(animals, starred):
    """Running fades in all animals, so that the shares of the others rise."""
    generator, rows = np.random.default_rng(0), []
    for animal in range(animals):
        start = np.sort(generator.random(200))
        run = generator.random(200) < 0.9 * np.exp(-3 * start)
        names = np.where(run, "run", generator.choice(["dig", "eat"], 200))
        times = {"start": start, "stop": np.append(start[1:], 1)}
        rows.append(pd.DataFrame({"animal": f"m{animal}", "behaviour": names} | times))
    recordings = read(pd.concat(rows))
    found = replace(found_in(recordings.plans()), recordings=recordings)
    part = drift_section(found)
    assert [one.feature for one in part.findings if one.significant] == [f"drift of {name}" for name in starred]
    assert [row[0] for row in part.section.tables[-1].rows if "*" in row[-2]] == starred
    frame = rate_drift(recordings).frame()
    assert [one.p_corrected for one in part.findings] == frame["p_corrected"].tolist()
    by_time = rate_drift(recordings, "time").frame().set_index("behaviour")["times"]
    assert part.frames["rate_drift"].set_index("behaviour")["by_time"].to_dict() == pytest.approx(by_time.to_dict())
    if starred:
        row = frame.iloc[0]
        assert part.findings[0].sentence == (
            f"From the beginning to the end of a recording the share of run falls to {row.times:.3g} times, 95 %"
            f" interval {row.low:.3g} to {row.high:.3g}; p < .0001."
        )


ASKED: dict[str, Any] = {"skip": 1, "fits": replace(QUICK_IN_TWO, seed=5)}


@pytest.fixture(scope="module")
def made() -> Document:
    plans = markov_plans(markov_probs(3, 1, 0, 1.5), 24, 8, 1, group=torch.arange(24) % 6)
    return report(plans, **ASKED)


def test_a_report_has_its_tables_and_figures(made):
    assert {*made.tables, "motifs"} == {
        *("scores", "behaviours", "how_far_back", "lags", "transitions", "transition_test"),
        *("motifs", "drift", "drift_tests", "rate_drift"),
        *("individuals", "individual_budget", "individual_types", "individuality", "individuality_by_behaviour"),
    }
    assert all(isinstance(frame, pd.DataFrame) for frame in made.tables.values())
    assert {"scores", "lags", "transitions", "transition_graph", "individual_strips", "drift"} <= set(made.figures)
    assert all(isinstance(figure, Figure) for figure in made.figures.values())
    boxes = [box for section in made.sections for box in section.figures]
    assert all(isinstance(box, FigureBox) and box.caption and box.alt and box.name for box in boxes)
    assert len(made.sections) >= len(SECTIONS) - 4  # motifs, conditions, durations and modes


def test_what_is_asked_for_is_done(made):
    asked = {"folds": 2, "skip": 1, "seed": 5, "max_steps": 3}
    assert made.settings | asked == made.settings


def test_the_lead_names_the_best_model(made):
    best = made.tables["scores"].sort_values("bits_per_behaviour").iloc[0]
    assert (
        f"The best model, {best.model}, takes {best.bits_per_behaviour:.3f} bits per behaviour"
        f" (95 % interval {best.low:.3f} to {best.high:.3f} over subjects)."
    ) in made.said


def test_plans_in_memory_and_in_a_file_have_the_same_report(tmp_path, made):
    from neuroprior.plans import write_plans

    plans = markov_plans(markov_probs(3, 1, 0, 1.5), 24, 8, 1, group=torch.arange(24) % 6)
    write_plans(plans, tmp_path / "plans.npz")
    again = report(tmp_path / "plans.npz", sections=["scores"], out=tmp_path / "out", **ASKED)
    pd.testing.assert_frame_equal(again.tables["scores"], made.tables["scores"])
    assert (made.title, again.title) == ("Report", "Report on plans.npz")
    assert {path.name for path in (tmp_path / "out").glob("[!.]*")} == {
        "report.html",
        "results.json",
        "scores.csv",
        "folds",
    }


PLANS = markov_plans(markov_probs(3, 1, 0), 8, 5, 1)


@pytest.mark.parametrize(
    ("options", "fits", "words"),
    [
        ({}, {"models": []}, "`models` must be a list of some of counts"),
        ({}, {"inputs": ["nodes"]}, "`inputs` must be a list of some of"),
        ({}, {"inputs": ["context"]}, "`inputs` must hold more"),
        ({}, {"effort": "quick"}, "effort"),
        ({}, {"effort": "full", "models": ["gru"]}, "`effort` must be left out"),
        ({}, {"seed": 2**50}, "`seed` must be from 0 to 1125899906842623"),
        ({"sections": ["weather"]}, {}, "`sections` must be a list of some of file"),
        ({"reading": ReadOptions()}, {}, "`reading` must be left out"),
        ({"priors": {}}, {}, "`priors` must be a dict"),
        ({"priors": {"a": UniformPrior(3)}}, {"folds": 2}, "`folds` must be left out"),
        ({"priors": {"a": UniformPrior(3)}, "test": PLANS}, {}, "`test` must be left out"),
        ({"test": PLANS}, {"folds": 2}, "`folds` must be left out"),
    ],
)
def test_what_cannot_be_reported_is_refused(options, fits, words):
    with refuses(words):
        report(PLANS, fits=FitOptions(**fits), **options)


def verdicts(document: Document) -> str:
    """All that a report says in words, and all cells of its tables."""
    texts = [" ".join(document.said)]
    for section in document.sections:
        texts += [*section.text, *(box.caption for box in section.figures)]
        for table in section.tables:
            texts += [table.caption, *table.headings, *(cell for row in table.rows for cell in row)]
    return "\n".join(texts)


def animals(number: int, sessions: int = 8) -> Plans:
    """Animals that differ: each half repeats its last action more often than the other half."""
    probs = [markov_probs(3, 1, seed, 3) for seed in (0, 1)]
    parts = [markov_plans(probs[animal % 2], sessions, 40, animal) for animal in range(number)]
    group = torch.arange(number).repeat_interleave(sessions)
    return Plans(torch.cat([part.actions for part in parts]), 3, group=group)


@pytest.mark.parametrize(("number", "enough"), [pytest.param(3, False, marks=pytest.mark.slow), (4, False), (5, True)])
def test_few_groups_bear_no_verdict(number, enough):
    """Below five animals nothing is starred, ringed, dotted or called best; the numbers stand."""
    whole = report(animals(number), fits=QUICK_IN_TWO)
    said, few = verdicts(whole), f"{number} subjects are too few for a verdict"
    assert (few in " ".join(whole.said)) != enough
    assert ("The best model" in " ".join(whole.said)) == enough
    assert ("*" in said) == enough
    assert ("significant" in said) == enough
    assert ("p" in said.split("\n")) == enough  # the heading of a column
    assert said.count(few) == (0 if enough else 7)  # the lead, and each section that would draw one
    assert whole.tables["scores"]["low"].notna().all()
    assert "over subjects" in " ".join(whole.said)


def test_parts_of_a_plan_are_not_plans():
    """A single long session is one: its parts have intervals, and bear no verdict."""
    (plan,) = markov_plans(markov_probs(3, 1, 0, 1.5), 1, 400, 1).actions
    found = report(Plans(plan[None], 3), fits=QUICK_IN_TWO)
    assert "over parts of the sequence" in " ".join(found.said)
    assert "1 sequence is too few for a verdict" in " ".join(found.said)
    assert "*" not in verdicts(found)


@pytest.mark.parametrize(
    ("names", "listed"),
    [
        (None, "0, 2, 4, 5 never occur"),
        (["run", "rest", "hide", "dig", "eat", "drink"], "Run, hide, eat, drink never occur"),
        (["rest", "dig"], ""),
    ],
)
def test_actions_that_never_occur_count_in_uniform_and_the_report_says_so(names, listed):
    """Bits of uniform are those of all names: the tables say which never occur, and what the others alone take."""
    actions, number = torch.randint(2, (30, 8), generator=seeded(0)), 6 if names is None else len(names)
    plans = Plans(actions * 2 + 1 if number == 6 else actions, number, action_names=names)
    made = report(plans, fits=QUICK_IN_TWO, sections=["file", "scores"])
    assert made.frames["scores"].set_index("model")["bits_per_behaviour"]["uniform"] == pytest.approx(math.log2(number))
    captions = [table.caption for section in made.sections for table in section.tables]
    assert sum("never" in caption for caption in captions) == 2 * bool(listed)
    if listed:
        assert listed in captions[1]
        small = f"{listed[:1].lower()}{listed[1:]}"
        assert f"of which {small}; without them it needs 1.0000 bits" in captions[2]
