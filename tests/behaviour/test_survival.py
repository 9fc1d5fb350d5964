"""Survival of bouts against scipy and plain loops, the log-rank test by enumeration, laws of censored durations."""

from dataclasses import replace
from math import log

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from neuroprior.behaviour import DurationModel, RecordedPlans, Recordings, duration_survival
from neuroprior.behaviour.durations.laws import LAWS, Sets, fit_laws
from neuroprior.behaviour.durations.survival import survival_curve
from neuroprior.behaviour.reporting.durations import duration_section
from neuroprior.behaviour.reporting.scores import evaluate_saved
from neuroprior.priors import UniformPrior
from tests.support.sources import refuses, seeded


def censored(seed, subjects=8, ratio=1.0, strata=False, spread=0.4):
    """Bouts of rest and walk of subjects that differ, cut off at random; treated ones rest `ratio` times as long."""
    random = np.random.default_rng(seed)
    treated = random.permutation(subjects) < subjects // 2
    stratum = np.arange(subjects) % 2
    if strata:  # one of two in each
        treated = (np.arange(subjects) // 2) % 2 == stratum * (random.random() < 0.5)
    level = np.exp(spread * random.standard_normal(subjects)) * np.where(treated, ratio, 1) * (1 + 4 * strata * stratum)
    shape = (subjects, 30)
    lengths = random.integers(15, 31, subjects)
    actions = np.tile(np.arange(30) % 2, (subjects, 1))
    times = random.weibull(1.5, shape) * np.where(actions == 0, level[:, None], 1.0)
    ends = random.exponential(4, shape)
    return RecordedPlans(
        torch.from_numpy(actions), 2, torch.from_numpy(lengths), ("rest", "walk"),
        group=torch.arange(subjects), durations=torch.from_numpy(np.minimum(times, ends)).float(),
        cut_off=torch.from_numpy(times > ends), condition=torch.from_numpy(treated.astype(int)),
        condition_names=("saline", "drug"), **({"stratum": torch.from_numpy(stratum)} if strata else {}),
    )  # fmt: skip


def known(plans):
    """Duration, whether it ended, action, subject and condition of each bout."""
    mask = plans.mask()
    columns = (plans.durations.double(), ~plans.cut_off, plans.actions, plans.group[:, None].expand(mask.shape))
    return [one[mask].numpy() for one in (*columns, plans.condition[:, None].expand(mask.shape))]


def test_survival_is_that_of_scipy_and_its_interval_leaves_out_a_subject():
    plans = censored(0)
    result = duration_survival(plans, 99, seeded(0))
    time, ended, action, unit, condition = known(plans)
    for number, name in enumerate(plans.action_names):
        for level, words in enumerate(plans.condition_names):
            own = (action == number) & (condition == level)
            curve = result.curves[name, words]
            want = stats.ecdf(stats.CensoredData.right_censored(time[own], ~ended[own])).sf
            np.testing.assert_allclose(curve.survival, want.evaluate(curve.time), atol=1e-12)
            assert curve.at_risk.tolist() == [(time[own] >= at).sum() for at in curve.time]
            one, at = np.unique(unit[own]), len(curve.time) // 2
            left = []
            for subject in one:
                rest = own & (unit != subject)
                sf = stats.ecdf(stats.CensoredData.right_censored(time[rest], ~ended[rest])).sf
                left.append(log(-log(float(sf.evaluate(curve.time[at])))))
            half = stats.t.ppf(0.975, len(one) - 1) * np.sqrt((len(one) - 1) * np.var(left))
            bounds = [curve.survival[at] ** np.exp(sign * half) for sign in (1, -1)]
            assert (curve.low[at], curve.high[at]) == pytest.approx(bounds)
            assert curve.median == curve.time[np.argmax(curve.survival <= 0.5)]
    frame = result.frame()
    assert len(frame) == sum(len(curve.time) for curve in result.curves.values())
    assert list(frame.columns) == ["behaviour", "condition", "time", "survival", "low", "high", "at_risk"]


def area(time, ended, weight, limit):
    """The area below the weighted survival of bouts, in plain loops."""
    total, share, last = 0.0, 1.0, 0.0
    for at in sorted({*time[ended]}):
        if at < limit:
            total, last = total + share * (at - last), at
            share *= 1 - weight[ended & (time == at)].sum() / weight[time >= at].sum()
    return total + share * (limit - last)


def test_the_ratio_of_bouts_that_all_ended_is_that_of_their_means():
    plans = replace(censored(3, 7, 2.0), cut_off=None)
    rest, drug = (plans.actions == 0) & plans.mask(), plans.condition.bool()
    means = [plans.durations[rest & under[:, None]].double().mean() for under in (~drug, drug)]
    ratio, low, high = duration_survival(plans, 99, seeded(0)).ratios["rest"]
    assert ratio == pytest.approx(float(means[1] / means[0]))
    assert low < ratio < high


@pytest.mark.parametrize("kind", ["between", "strata", "within"])
def test_ratios_of_restricted_means_leave_out_a_subject(kind):
    """In strata of unequal sizes, and in pairs, in plain loops: each subject counts once more where others are few."""
    plans = censored(2, 9, 2.0, kind == "strata")
    if kind == "within":
        pair = torch.arange(9) // 2
        plans = replace(plans, group=pair, condition=(torch.arange(9) % 2 == pair % 2).long())
    result = duration_survival(plans, 99, seeded(0))
    time, ended, action, unit, condition = known(plans)
    rest = action == 0
    subjects = 4 if kind == "within" else 9
    cell = [number % 2 if kind == "strata" else 0 for number in range(subjects)]
    treated = [int(condition[unit == number][0]) for number in range(subjects)]
    inside = rest & (unit < subjects)
    longest = [max(np.flatnonzero(inside & (condition == c)), key=lambda row: time[row]) for c in (0, 1)]
    limit = min([time[row] for row in longest if not ended[row]], default=time[longest].max())

    def change(out):
        logs = []
        for c in (0, 1):
            weight = np.zeros(len(time))
            for number in set(range(subjects)) - {out}:
                alike = [k for k in range(subjects) if cell[k] == cell[number]]
                there = [k for k in alike if treated[k] == c and k != out]
                weight[unit == number] = 1 if kind == "within" else len(alike) / max(len(there), 1)
            own = inside & (condition == c) & (weight > 0)
            logs.append(log(area(time[own], ended[own], weight[own], limit)))
        return logs[1] - logs[0]

    group = [0 if kind == "within" else (cell[k], treated[k]) for k in range(subjects)]
    variances = []
    for one in {*group}:
        numbers = [k for k in range(subjects) if group[k] == one]
        squares = sum((change(k) - change(None)) ** 2 for k in numbers)
        bouts = np.array([(inside & (unit == k)).sum() for k in numbers], float)
        variances.append((squares * (len(numbers) - 1) / len(numbers), bouts.sum() ** 2 / (bouts**2).sum() - 1))
    total = sum(variance for variance, _ in variances)
    freedom = total**2 / sum(variance**2 / max(number, 1) for variance, number in variances)
    half = stats.t.ppf(0.975, freedom) * total**0.5
    want = np.exp([change(None), change(None) - half, change(None) + half])
    assert list(result.ratios["rest"]) == pytest.approx(want.tolist())


def test_a_curve_by_hand():
    """Of five bouts one is cut off at 2: three are left of four, then one of two; the last never ends."""
    curve = survival_curve(np.array([1.0, 2, 3, 3, 4]), np.array([1, 0, 1, 0, 0], bool), np.array([0, 0, 1, 1, 1]))
    assert curve.time.tolist() == [1, 3]
    assert curve.survival == pytest.approx([4 / 5, 4 / 5 * 2 / 3])
    assert curve.at_risk.tolist() == [5, 3]
    assert curve.median == np.inf


@pytest.mark.parametrize("strata", [False, True])
def test_the_log_rank_test_by_enumeration(strata):
    """Observed less expected ends of each labelling, in plain loops, within strata."""
    plans = censored(4, 8, 2.0, strata)
    result = duration_survival(plans, 9999)
    time, ended, action, unit, _ = known(plans)
    cell = np.zeros(8, int) if plans.stratum is None else plans.stratum.numpy()
    labels, observed = result.design.labellings(9999).numpy(), {}
    for number, name in enumerate(plans.action_names):
        excess, due = np.zeros(8), np.zeros(8)
        for place in np.flatnonzero(action == number):
            own = (action == number) & (cell[unit] == cell[unit[place]])
            hazard = 0.0
            for at in np.unique(time[own & ended]):
                if at <= time[place]:
                    hazard += (ended & own & (time == at)).sum() / (own & (time >= at)).sum()
            due[unit[place]] += hazard
            excess[unit[place]] += ended[place] - hazard
        statistic = sum((excess @ (labels == c)) ** 2 / (due @ (labels == c)) for c in (0, 1))
        observed[name] = (statistic >= statistic[0] - 1e-9).mean()
    assert {name: p for name, (p, _) in result.tests.items()} == pytest.approx(observed)
    assert all(corrected >= p for p, corrected in result.tests.values())
    name, (_, corrected) = min(result.tests.items(), key=lambda one: one[1])
    assert f"{name}: p = {corrected:.2g}" in repr(result)


def test_without_conditions_there_are_curves_alone():
    plans = censored(1)
    alone = RecordedPlans(plans.actions, 2, plans.lengths, durations=plans.durations, cut_off=plans.cut_off)
    result = duration_survival(alone)
    assert (set(result.curves), result.tests, result.design) == ({("0", ""), ("1", "")}, {}, None)
    assert result.medians()["p_value"].isna().all()
    with refuses("`plans` must have durations above 0"):
        duration_survival(RecordedPlans(torch.zeros(2, 2, dtype=torch.long), 1, durations=torch.zeros(2, 2)))


def cut(law, number=1500, seed=0, until=4.0):
    random = np.random.default_rng(seed)
    times, ends = law.rvs(number, random_state=random), random.uniform(0.5, until, number)
    shape = (30, number // 30)
    durations, longer = (torch.from_numpy(one).view(shape) for one in (np.minimum(times, ends), times > ends))
    return RecordedPlans(torch.zeros(shape, dtype=torch.long), 1, durations=durations, cut_off=longer)


def test_an_exponential_law_is_ends_over_all_time():
    plans = cut(stats.expon(scale=2.0))
    model = DurationModel(1, ["exponential"]).fit(plans)
    ended = ~plans.cut_off
    assert 0.3 < float(plans.cut_off.double().mean()) < 0.6
    scale = model.table()[0].parameters["scale"]
    assert scale == pytest.approx(float(plans.durations.double().sum() / ended.sum()), rel=1e-5)
    assert model.table()[0].number == int(ended.sum())
    likely = -plans.durations.double() / scale - torch.where(ended, log(scale), 0.0)
    torch.testing.assert_close(model.log_prob(plans), likely)


@pytest.mark.parametrize(
    ("name", "law", "family"),
    [
        ("weibull", stats.weibull_min(2.0, scale=3.0), stats.weibull_min),
        ("lognormal", stats.lognorm(0.8, scale=1.6), stats.lognorm),
        ("gamma", stats.gamma(2.5, scale=1.3), stats.gamma),
    ],
)
def test_laws_of_durations_that_were_cut_off_are_those_of_scipy(name, law, family):
    """The maximum of the same likelihood by another method."""
    plans = cut(law)
    data = stats.CensoredData.right_censored(
        plans.durations.double().flatten().numpy(), plans.cut_off.flatten().numpy()
    )
    shape, _, scale = family.fit(data, floc=0)
    found = DurationModel(1, [name]).fit(plans).table()[0].parameters
    want = [log(scale), shape] if name == "lognormal" else [shape, scale]
    assert list(found.values()) == pytest.approx(want, rel=2e-4, abs=2e-4)
    # Beside an action of which none is cut off, so that its law is there at once.
    twice = torch.cat([plans.durations, plans.durations])
    longer = torch.cat([plans.cut_off, torch.zeros_like(plans.cut_off)])
    beside = RecordedPlans(
        torch.arange(2).repeat_interleave(30)[:, None].expand(60, 50), 2, durations=twice, cut_off=longer
    )
    assert DurationModel(2, [name]).fit(beside).table()[0].parameters == pytest.approx(found, rel=1e-4)


def test_a_mixture_is_found_behind_what_was_cut_off():
    random = np.random.default_rng(0)
    first, shape = random.random(12_000) < 0.3, (40, 300)
    times = np.where(first, random.lognormal(0, 0.3, 12_000), random.lognormal(2, 0.8, 12_000))
    ends = random.exponential(15, 12_000)
    durations, longer = (torch.from_numpy(one).view(shape) for one in (np.minimum(times, ends), times > ends))
    plans = RecordedPlans(torch.zeros(shape, dtype=torch.long), 1, durations=durations, cut_off=longer)
    (law,) = DurationModel(1).fit(plans).table()
    expected = {"share": 0.3, "log_mean": 0, "log_sd": 0.3, "log_mean_2": 2, "log_sd_2": 0.8}
    assert law.law == "two-lognormal"
    assert law.parameters == pytest.approx(expected, abs=0.05)


TABLE = pd.DataFrame(
    [
        ("s1", "m1", "rest", 0.0, 4.0),
        ("s1", "m1", "walk", 4.0, 5.0),
        ("s1", "m1", "walk", 8.0, 9.5),
        ("s1", "m1", "rest", 9.5, np.nan),
        ("s1", "m2", "walk", 1.0, 6.0),
        ("s1", "m2", "rest", 2.0, 6.0),
        ("s1", "m2", "poke", 6.0, 6.0),
    ],
    columns=["recording", "subject", "behaviour", "start", "stop"],
)


def test_bouts_are_cut_off_where_watching_ends():
    fragment = np.array([0, 0, 1, 1, 2, 2, 2])
    recordings = Recordings(TABLE, fragment)
    assert recordings.cut_off.tolist() == [False, True, True, False, True, True, False]
    spans = pd.DataFrame(
        [("s1", "m1", 0.0, 5.0), ("s1", "m1", 7.0, 20.0), ("s1", "m2", 0.0, 6.0)],
        columns=["recording", "subject", "start", "stop"],
    )
    watched = Recordings(TABLE, fragment, spans=spans)
    assert watched.cut_off.tolist() == [False, True, False, False, True, True, False]
    plans = watched.plans()
    assert plans.cut_off[plans.mask()].tolist() == watched.cut_off.tolist()
    assert watched.window(stop=3.0).cut_off.tolist() == [True, True, True]


@pytest.mark.parametrize(("subjects", "starred"), [(16, ["survival of rest"]), (4, [])])
def test_the_report_stars_survival_as_findings(subjects, starred):
    plans = censored(0, subjects, 4.0)
    part = duration_section(evaluate_saved({"uniform": UniformPrior(2)}, plans, 0))
    result = duration_survival(plans, generator=seeded(0))
    assert [one.feature for one in part.findings if one.significant] == starred
    assert {one.id: one.p_corrected for one in part.findings if one.family == "survival"} == {
        f"survival: {name}": corrected for name, (_, corrected) in result.tests.items()
    }
    table = next(one for one in part.section.tables if one.title == "Survival of bouts")
    assert [row[0] for row in table.rows if row[-1].endswith("*")] == [name.split()[-1] for name in starred]
    medians = [result.curves["rest", level].median for level in ("saline", "drug")]
    assert next(row for row in table.rows if row[0] == "rest")[1:3] == [f"{one:.3g}" for one in medians]
    pd.testing.assert_frame_equal(part.frames["survival"], result.frame())
    (box,) = (one for one in part.section.figures if one.name == "survival")
    lines = [line.get_ydata().tolist() for axes in box.figure.axes for line in axes.lines]
    assert result.curves["rest", "drug"].survival.tolist() in lines
    finding = next(one for one in part.findings if one.id == "survival: rest")
    assert (finding.effect, finding.low, finding.high) == result.ratios["rest"]
    sentence = f"Bouts of rest last {finding.effect:.3g} times as long under drug as under saline, 95 % interval "
    assert finding.sentence.startswith(f"{sentence}{finding.low:.3g} to {finding.high:.3g}; log-rank test, p ")
    assert result.medians().loc[0, ["ratio", "low", "high"]].tolist() == list(result.ratios["rest"])


def test_of_three_conditions_there_are_medians():
    plans = censored(0, 18, 4.0)
    third = torch.arange(18) % 3 == 0
    three = replace(plans, condition=torch.where(third, 2, plans.condition), condition_names=("saline", "drug", "old"))
    assert duration_survival(three, 99, seeded(0)).ratios == {}
    part = duration_section(evaluate_saved({"uniform": UniformPrior(2)}, three, 0))
    finding = next(one for one in part.findings if one.id == "survival: rest")
    assert finding.effect is None
    assert finding.sentence.startswith("How long a bout of rest lasts differs between conditions: medians")


def test_what_was_cut_off_in_one_set_changes_no_other():
    """Of three sets one has durations that were cut off; all laws of the others are those without it, and finite."""
    generator = seeded(11)
    time = torch.cat([torch.rand(number, generator=generator).double() + 0.1 for number in (30, 45, 60)])
    cell = torch.arange(3).repeat_interleave(torch.tensor([30, 45, 60]))
    cut_off = (cell == 1) & (torch.rand(135, generator=generator) < 0.1)
    assert 0 < cut_off.sum() < 9
    names = list(LAWS)
    fits = fit_laws(Sets(time.log(), cell, 3, 0.0, cut_off), names)
    plain = fit_laws(Sets(time.log(), cell, 3, 0.0, torch.zeros_like(cut_off)), names)
    assert fits.isfinite().all()
    closed = [number for number, name in enumerate(names) if name != "two-lognormal"]  # of which it takes more steps
    assert fits[closed][:, [0, 2]].allclose(plain[closed][:, [0, 2]], rtol=1e-4)
    assert (fits[0, 1, 0] > plain[0, 1, 0]).item()  # the mean of an exponential law


def test_laws_of_actions_that_are_seldom_cut_off_are_finite():
    """The last bout of each plan is cut off, of some actions none is; each has the law that it was drawn from."""
    generator = seeded(12)
    actions = torch.randint(4, (40, 70), generator=generator)
    actions[:, -1] = torch.arange(40) % 2
    times = (0.6 * torch.randn(40, 70, generator=generator).double() + actions).exp()
    cut_off = torch.zeros(40, 70, dtype=torch.bool)
    cut_off[:, -1] = True
    times[:, -1] *= torch.rand(40, generator=generator)
    plans = RecordedPlans(actions, 4, group=torch.arange(40) % 9, durations=times, cut_off=cut_off)
    model = DurationModel(4).fit(plans)
    assert model.values.isfinite().all()
    assert [model.laws[law] for law in model.law.tolist()] == ["lognormal"] * 4
    assert model.values[:, 0].tolist() == pytest.approx([0, 1, 2, 3], abs=0.12)
