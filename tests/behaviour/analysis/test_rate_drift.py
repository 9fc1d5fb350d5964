"""Drift of rates against maximum likelihood by another way, closed forms, and simulations with known slopes."""

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import optimize, stats

from neuroprior import Plans
from neuroprior._statistics import mean_interval
from neuroprior.behaviour import RecordedPlans, Recordings, holm, rate_drift
from neuroprior.behaviour.analysis.rate_drift import BINS, _change
from tests.support.sources import FALSE_ALARM, refuses, seeded


def recordings_of(frame, fragment=None, spans=None):
    """Recordings from `recording, subject, behaviour, start`; each bout takes a thousandth of a second."""
    frame = frame.assign(stop=frame["start"] + 1e-3)
    whole = frame.groupby(["recording", "subject"], sort=False).ngroup().to_numpy() if fragment is None else fragment
    return Recordings(frame.reset_index(drop=True), np.unique(whole, return_inverse=True)[1], "s", spans=spans)


def simulated(seed, slope=0.0, subjects=12, gaps=False, shares=False):
    """Sessions of unlike lengths in which "run" changes by `slope`; two a subject for every third, with own levels.

    As shares of all bouts, whose times are uniform; or as rates by time. Gaps are early for some and late for others.
    """
    random = np.random.default_rng(seed)
    subject = np.array([s for s in range(subjects) for _ in range(2 - (s % 3 > 0))])
    session, span = np.arange(len(subject)), random.uniform(200, 900, len(subject))
    number = random.poisson(random.uniform(60, 150, len(subject)))
    of, place = np.repeat(session, number), random.random(number.sum())
    ends = [np.array([end(place[of == one]) for one in session])[of] for end in (np.min, np.max)]
    place = (place - ends[0]) / (ends[1] - ends[0])  # sessions are what lies between the first and the last bout
    level = random.uniform(0.2, 0.5, subjects)[subject]
    chance = level[of] * np.exp(slope * place)
    run, other = random.random(len(of)) < chance, random.choice(["dig", "eat"], len(of), p=[0.3, 0.7])
    kept = np.ones(len(of), bool) if shares else run | (random.random(len(of)) < 0.5) | (place % 1 == 0)
    fragment = of * 2
    if gaps:
        begin = random.uniform(0.05, 0.35, len(subject)) + 0.4 * (subject % 2)
        fragment = fragment + (place > begin[of])
        kept &= (place < begin[of]) | (place > begin[of] + 0.15)
    names = np.where(run, "run", other)
    frame = pd.DataFrame(
        {"recording": session[of] % 2, "subject": subject[of], "behaviour": names, "start": 5 + place * span[of]}
    ).astype({"recording": str, "subject": str})
    order = np.lexsort((place, of))
    order = order[kept[order]]
    return recordings_of(frame.iloc[order], fragment[order])


@pytest.mark.parametrize("per", ["bouts", "time"])
def test_slopes_are_the_maximum_of_the_likelihood(per):
    """Against a Poisson likelihood with a level for each session, maximised by another method on the same bins."""
    recordings = simulated(3, -1.5, 5, gaps=True)
    events = recordings.events.assign(fragment=recordings.fragment)
    sessions = events.groupby(["subject", "recording"], sort=True)
    low, high = sessions["start"].min(), sessions["stop"].max()
    if per == "time":
        ends = events.groupby("fragment")["start"]
        events = events[(events["start"] > ends.transform("min")) & (events["start"] < ends.transform("max"))]
    counts, exposure = [], []
    for key, own in events.groupby(["subject", "recording"], sort=True):
        part = np.floor((own["start"] - low[key]) / (high[key] - low[key]) * BINS).astype(int)
        counts.append(np.bincount(part[own["behaviour"] == "run"], minlength=BINS))
        watched = np.zeros(BINS)
        if per == "bouts":
            watched = np.bincount(part, minlength=BINS)
        else:
            mine = (recordings.events[["subject", "recording"]] == list(key)).all(axis=1).to_numpy()
            for number in np.unique(recordings.fragment[mine]):
                times = recordings.events["start"][recordings.fragment == number]
                edges = low[key] + np.arange(BINS + 1) / BINS * (high[key] - low[key])
                watched = watched + np.diff(np.clip(edges, times.min(), times.max()))
        exposure.append(watched)
    counts, exposure, middle = np.array(counts), np.array(exposure), (np.arange(BINS) + 0.5) / BINS

    def loss(slope):
        expected = exposure * np.exp(slope * middle)
        shares = expected / expected.sum(1, keepdims=True)
        return -(counts * np.log(np.where(counts > 0, shares, 1))).sum()

    found = rate_drift(recordings, per)
    at = found.behaviours.index("run")
    want = optimize.minimize_scalar(loss, bounds=(-9, 9), method="bounded", options={"xatol": 1e-10}).x
    assert found.changes[at].mean == pytest.approx(want, abs=1e-5)
    assert found.bouts[at] == counts.sum()
    assert found.corrected == pytest.approx(holm([one.p_value for one in found.changes]))
    assert (found.unit, found.num_units) == ("subjects", 5)
    assert str(found.frame()["behaviour"].iloc[0]) in repr(found)


def test_the_frame_has_factors_and_the_clearest_change_first():
    found = rate_drift(simulated(0, -2.0))
    frame, by_name = found.frame(), dict(zip(found.behaviours, found.changes, strict=True))
    assert frame["behaviour"].iloc[0] == "run"
    assert frame["p_value"].is_monotonic_increasing
    for row in frame.itertuples():
        assert (row.times, row.low, row.high) == pytest.approx(tuple(np.exp(by_name[row.behaviour][:3])))


@pytest.mark.parametrize(("gaps", "per"), [(False, "bouts"), (True, "bouts"), (False, "time"), (True, "time")])
def test_intervals_cover_a_fall_by_e_squared_with_gaps_and_without(gaps, per):
    hits = np.zeros(60)
    for seed in range(60):
        found = rate_drift(simulated(seed, -2.0, 20, gaps, per == "bouts"), per)
        change = found.changes[found.behaviours.index("run")]
        hits[seed] = change.low <= -2 <= change.high
        assert change.p_value < 1e-4
    assert hits.sum() >= stats.binom.ppf(FALSE_ALARM, 60, 0.93)


def test_of_equally_informed_units_the_interval_is_that_of_student():
    values = np.array([-1.2, 0.3, -0.4, -2.1, 0.9, -0.6])
    change = _change(values.mean(), 40 * (values - values.mean()), np.full(6, 40.0))
    assert change[:3] == pytest.approx(mean_interval(values))
    assert change.p_value == pytest.approx(stats.ttest_1samp(values, 0).pvalue)


def test_spans_of_files_are_when_bouts_could_begin():
    """All bouts are early: nothing is known of later unless it was watched."""
    rows = [("1", s, "run", t) for s in "abc" for t in (1.0, 2.0 + ord(s) / 100, 4.0)]
    frame = pd.DataFrame(rows, columns=["recording", "subject", "behaviour", "start"])
    spans = pd.DataFrame({"recording": "1", "subject": list("abc"), "start": 0.0, "stop": 40.0})
    watched, alone = rate_drift(recordings_of(frame, spans=spans), "time"), rate_drift(recordings_of(frame), "time")
    assert watched.bouts.tolist() == [9]
    assert alone.bouts.tolist() == [3]
    assert watched.changes[0].high < -5
    assert alone.changes[0].high > -5


def test_plans_are_by_order_whatever_their_fragments():
    actions = torch.randint(3, (8, 30), generator=seeded(0))
    whole = Plans(actions, 3, group=torch.arange(8) // 2)
    cut = RecordedPlans(
        actions.view(8, 2, 15).flatten(0, 1), 3, group=(torch.arange(8) // 2).repeat_interleave(2),
        recording=[f"day {day}" for day in range(8) for _ in range(2)],
    )  # fmt: skip
    assert rate_drift(cut).changes == rate_drift(whole).changes
    padded = Plans(torch.nn.functional.pad(actions, (0, 20)), 3, torch.full((8,), 30), group=torch.arange(8) // 2)
    assert rate_drift(padded).changes == rate_drift(whole).changes
    mixed = rate_drift(whole[torch.tensor([5, 0, 7, 2, 4, 1, 3, 6])])
    np.testing.assert_allclose(mixed.changes, rate_drift(whole).changes)
    assert (rate_drift(whole).unit, rate_drift(whole).num_units) == ("subjects", 4)
    assert rate_drift(whole).bouts.tolist() == actions.flatten().bincount().tolist()
    late = torch.arange(40) >= 20
    falls = (torch.rand(200, 40, generator=seeded(0)) >= torch.where(late, 0.3, 0.5)).long()
    found = rate_drift(Plans(falls, 3))
    assert found.corrected[0] < 1e-6
    assert found.changes[0].mean < 0 < found.changes[1].mean
    assert found.changes[2].p_value == 1


def test_what_has_no_rates_is_refused():
    with refuses("`source` must have at least 2 subjects, recordings or plans, got 1"):
        rate_drift(Plans(torch.zeros(1, 9, dtype=torch.long), 2))
    with refuses("`per` must be bouts, or time for recordings, got 'time'"):
        rate_drift(Plans(torch.zeros(4, 9, dtype=torch.long), 2), "time")
    frame = pd.DataFrame({"recording": "1", "subject": ["a", "b"], "behaviour": "run", "start": np.nan})
    with refuses("`source` must have recordings whose times are known"):
        rate_drift(recordings_of(frame))
