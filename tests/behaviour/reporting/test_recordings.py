"""Time budgets and behaviours over time, against what is counted by hand; gaps are not watched."""

import numpy as np
import pandas as pd
import pytest

from neuroprior.behaviour import read
from neuroprior.behaviour.reporting.recordings import (
    budget_figure,
    course_figure,
    subject_budget,
    time_budget,
    time_course,
)

TABLE = pd.DataFrame(
    [
        ("s1", "m1", "rest", 10.0, 14.0, "drug"),
        ("s1", "m1", "walk", 14.0, 15.0, "drug"),
        ("s1", "m1", None, 15.0, 18.0, "drug"),
        ("s1", "m1", "walk", 18.0, 20.0, "drug"),
        ("s1", "m2", "eat", 1.0, 3.0, "saline"),
        ("s1", "m2", "walk", 3.0, 6.0, "saline"),
        ("s2", "m2", "walk", 0.0, 4.0, "saline"),
        ("s1", "m3", "walk", 0.0, 5.0, "saline"),
    ],
    columns=["session", "animal", "behaviour", "start", "stop", "treatment"],
)


def test_what_nobody_watched_does_not_count():
    each = subject_budget(read(TABLE)).set_index(["subject", "behaviour"])["share"]
    assert each["m1", "rest"] == pytest.approx(4 / 7)
    assert each["m1", "walk"] == pytest.approx(3 / 7)
    assert each["m2", "walk"] == pytest.approx(7 / 9)
    budget = time_budget(subject_budget(read(TABLE))).set_index(["condition", "behaviour"])["share"]
    assert budget["saline", "walk"] == pytest.approx((7 / 9 + 1) / 2)


def test_behaviours_over_time_are_shares_of_what_was_watched_then():
    """In two halves of 5 s: m1 rests 4 of 5 s, and walks 2 of the 2 s that were watched later."""
    course = time_course(read(TABLE), bins=2).set_index(["condition", "behaviour", "time"])
    assert course.index.get_level_values("time").unique().tolist() == [2.5, 7.5]
    assert course.share["drug", "rest", 2.5] == pytest.approx(0.8)
    assert course.share["drug", "walk", 7.5] == pytest.approx(1)
    assert course.subjects["drug", "walk", 7.5] == 1
    assert np.isnan(course.low["drug", "walk", 7.5])
    assert course.share["saline", "eat", 2.5] == pytest.approx((2 / 9 + 0) / 2)
    assert ("saline", "eat", 7.5) not in course.index or course.subjects["saline", "eat", 7.5] == 0
    shares = course.share.groupby(level=[0, 2]).sum()
    assert shares.to_numpy() == pytest.approx(1)


def test_figures_show_each_subject_and_level():
    recordings = read(TABLE)
    figure = budget_figure(time_budget(subject_budget(recordings)), subject_budget(recordings))
    assert sum(len(line.get_xdata()) for line in figure.axes[0].lines if line.get_marker() == "o") >= 5
    assert len([axes for axes in course_figure(time_course(recordings)).axes if axes.get_visible()]) == 3


@pytest.mark.parametrize("treated", [False, True])
def test_who_was_watched_and_did_nothing_counts(treated):
    """m1 grooms in 2 of 5 and in none of 3 frames; m2, in 1 of 4; m3, in none of 2: of its treatment no event tells."""
    groomed = {("m1", 1): "01100", ("m1", 2): "000", ("m2", 1): "0001", ("m3", 1): "00"}
    rows = [
        (animal, session, frame, "groom" if done == "1" else "")
        for (animal, session), cells in groomed.items()
        for frame, done in enumerate(cells)
    ]
    frames = pd.DataFrame(rows, columns=["animal", "session", "frame", "behaviour"])
    if treated:
        frames["treatment"] = frames["animal"].map({"m1": "drug", "m2": "saline", "m3": "saline"})
    recordings = read(frames)
    each = subject_budget(recordings).set_index("subject")["share"].to_dict()
    nothing = {} if treated else {"m3": 0.0}
    assert each == pytest.approx({"m1": 2 / 8, "m2": 1 / 4} | nothing)
    course = time_course(recordings, bins=1).set_index("condition")
    if treated:
        assert course["share"].to_dict() == pytest.approx({"drug": 2 / 8, "saline": 1 / 4})
    else:
        assert course["share"].tolist() == pytest.approx([(2 / 8 + 1 / 4 + 0) / 3])
