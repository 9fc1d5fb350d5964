"""The numbers of each section of a report, worked out anew from plans that are unlike in all that matters.

Plans of unlike lengths, in groups that are not sorted, with a context and durations; models are made by hand.
"""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import torch

from neuroprior import Plans
from neuroprior.behaviour import (
    by_group,
    by_plan,
    by_position,
    how_far_back,
    motifs,
)
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.reporting.conditions import condition_section
from neuroprior.behaviour.reporting.fits import ACTIONS, CONTEXT
from neuroprior.behaviour.reporting.scores import Evaluation, evaluate_saved
from neuroprior.behaviour.reporting.sections import (
    behaviour_frame,
    drift_section,
    file_section,
    lag_section,
    motif_section,
    score_section,
    transition_section,
)
from neuroprior.priors import MarkovPrior, UniformPrior
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import seeded

LENGTHS = torch.tensor([20, 5, 5, 6, 5, 5, 20, 4, 5, 5, 20, 5])
GROUP = torch.tensor([4, 1, 4, 0, 1, 0, 2, 2, 3, 3, 1, 4])
NAMES = ("walk", "rest", "dig")


@pytest.fixture(scope="module")
def plans() -> Plans:
    """Twelve plans in five groups; what comes next depends on the context of the plan."""
    parts = [markov_plans(markov_probs(3, 1, seed, 2), 12, 20, seed + 5).actions for seed in (0, 1)]
    context = torch.tensor([0, 1, 1, 0, 1, 0, 1, 0, 0, 1, 1, 0])
    actions = torch.where(context[:, None] == 0, parts[0], parts[1])
    durations = torch.rand(12, 20, generator=seeded(3)) ** 3 * 10
    named = {"action_names": NAMES, "group_names": ("ada", "ben", "cleo", "dora", "eve")}
    return RecordedPlans(actions, 3, LENGTHS, context=context, group=GROUP, durations=durations, **named)


@pytest.fixture(scope="module")
def found(plans) -> Evaluation:
    """Chains that learned from these plans, with and without the context; the best takes it."""
    plain = plans.without_context()
    chains = {f"markov-{k}": MarkovPrior(3, k).fit(plain) for k in (0, 1)}
    more = {name: MarkovPrior(3, k, num_contexts=2).fit(plans) for name, k in (("one", 2), ("two", 1))}
    return evaluate_saved({"uniform": UniformPrior(3), **chains, **more}, plans, 1)


def cells(part, number: int = 0) -> list[list[str]]:
    return [[cell.strip() for cell in row] for row in part.section.tables[number].rows]


def flat(plans: Plans) -> list[list[int]]:
    return [row[:length] for row, length in zip(plans.actions.tolist(), plans.lengths.tolist(), strict=True)]


def test_what_is_in_the_file(plans, found):
    part, rows = file_section(found), []
    taken, times = plans.actions[plans.mask()], plans.durations[plans.mask()].double()
    counts = taken.bincount()
    for action in counts.argsort(descending=True).tolist():
        held = sum(action in row for row in flat(plans))
        share, middle = 100 * counts[action] / len(taken), np.median(times[taken == action].numpy())
        assert abs(middle - float(times[taken == action].mean())) > 0.1
        rows.append([NAMES[action], str(int(counts[action])), f"{share:.1f}", str(held), f"{middle:.3g}"])
    assert cells(part, 1) == rows
    assert cells(part) == [["12", "105", "4", "20", "3", "5", "2 contexts, once a sequence"]]
    assert behaviour_frame(plans)["median_duration"].tolist() == pytest.approx(
        [float(row[4]) for row in rows], rel=5e-3
    )


@pytest.mark.parametrize("section", [file_section, transition_section, condition_section])
def test_all_plans_are_described_whichever_were_scored(section, plans, found):
    described = replace(plans, condition=GROUP % 2)
    parts = []
    for scored, first_fold in ((plans, plans), (plans[:4], plans[5:7])):
        some = replace(found, plans=described, scored=scored, mask=scored.mask(), first_fold=first_fold)
        parts.append(section(some))
    first, second = parts
    assert [table.rows for table in first.section.tables] == [table.rows for table in second.section.tables]
    assert first.section.tables
    assert first.frames.keys() == second.frames.keys()
    for name, frame in first.frames.items():
        pd.testing.assert_frame_equal(frame, second.frames[name])


@pytest.mark.parametrize(
    ("context", "words"),
    [
        (None, "none"),
        (torch.tensor([[0, 4], [1, 1]]), "5 contexts, at each step"),
        (torch.zeros(2, 3), "features, once a sequence"),
        (torch.eye(2)[torch.tensor([[0, 1], [1, 0]])], "features, at each step"),
    ],
)
def test_what_the_context_is(context, words):
    plans = RecordedPlans(torch.tensor([[0, 1], [2, 1]]), 3, context=context, condition=torch.tensor([0, 1]))
    assert cells(file_section(evaluate_saved({"uniform": UniformPrior(3)}, plans, 0)))[0][5:] == ["0", words, "2"]


def test_scores_with_their_intervals(found):
    """Bits are those of the actions that count, by group; the reference is the first prior."""
    rows = found.table()
    want = []
    for row in rows.itertuples():
        name = {ACTIONS: "behaviours", CONTEXT: "+ context"}[row.input]
        bits = f"{row.bits_per_behaviour:.4f}±{row.high - row.bits_per_behaviour:.4f}"
        more = f"{row.more:+.4f}±{row.more_high - row.more:.4f}"
        want.append([row.model, name, f"{row.nats_per_behaviour:.4f}", bits, f"{row.perplexity:.3f}", more])
    assert cells(score_section(found)) == want
    assert rows["more"].tolist() == pytest.approx((rows["bits_per_behaviour"] - math.log2(3)).tolist(), abs=1e-6)
    assert (rows["more_low"] <= rows["more"]).all()
    assert (rows["more"] <= rows["more_high"]).all()


@pytest.mark.parametrize("skip", [0, 2])
def test_how_far_back_is_of_what_counts(plans, skip):
    part = lag_section(evaluate_saved({"uniform": UniformPrior(3)}, plans, skip))
    result = how_far_back(plans, skip=skip)
    pd.testing.assert_frame_equal(part.frames["how_far_back"], result.frame())
    assert part.verdicts == [result.verdict]
    assert [one.significant for one in part.findings] == result.frame()["significant"].tolist()
    assert [row[-1].endswith("*") for row in cells(part)] == result.frame()["significant"].tolist()
    assert [one.p_corrected for one in part.findings] == result.corrected.tolist()


def test_few_groups_bear_no_verdict_on_how_far_back(plans):
    few = plans[plans.group < 3]
    part = lag_section(evaluate_saved({"uniform": UniformPrior(3)}, few, 0))
    assert part.verdicts == []
    assert not any(one.significant or "How far back" in one.sentence for one in part.findings)
    assert any(how_far_back(few).few in sentence for sentence in part.section.text)


def test_where_no_pair_of_actions_counts_there_is_no_section():
    plans = RecordedPlans.of(markov_plans(markov_probs(3, 1, 0), 8, 6, 1))
    assert lag_section(evaluate_saved({"uniform": UniformPrior(3)}, replace(plans, group=None), 5)) is not None
    evaluation = replace(evaluate_saved({"uniform": UniformPrior(3)}, plans, 0), settings={"skip": 6})
    assert lag_section(evaluation) is None


def test_transitions_are_counted_in_each_group(plans, found):
    """Pairs of all groups and of each, by hand; a probability is of those that follow the same action."""
    counts: dict[tuple[str, str, str], int] = {}
    for row, number in zip(flat(plans), GROUP.tolist(), strict=True):
        for a, b in pairwise(row):
            for name in ("all", plans.group_names[number]):
                counts[name, NAMES[a], NAMES[b]] = counts.get((name, NAMES[a], NAMES[b]), 0) + 1
    frame = transition_section(found).frames["transitions"]
    keys = [*zip(frame["subject"], frame["from"], frame["to"], strict=True)]
    assert dict(zip(keys, frame["count"], strict=True)) == counts
    assert len(keys) == len(counts)
    for (name, a, b), prob in zip(keys, frame["probability"], strict=True):
        whole = sum(n for key, n in counts.items() if key[:2] == (name, a))
        assert prob == pytest.approx(counts[name, a, b] / whole)


@pytest.fixture(scope="module")
def worded() -> Plans:
    """Words among noise."""
    words = torch.tensor([[0, 0, 0, 1, 1, 2], [3, 3, 1, 1, 1, 0], [2, 2, 3, 0, 0, 3]])
    plans = words[torch.randint(3, (34, 4), generator=seeded(0))].flatten(1)
    wild = torch.rand(plans.shape, generator=seeded(1)) < 0.25
    actions = torch.where(wild, torch.randint(4, plans.shape, generator=seeded(2)), plans)
    return RecordedPlans(actions, 4, action_names=list("abcd"), group=torch.arange(34) % 6)


def test_over_represented_sequences(worded):
    part = motif_section(evaluate_saved({"uniform": UniformPrior(4)}, worded, 0))
    frame, every = part.frames["motifs"], motifs(worded, top=12)
    want = [one for one in every if one.corrected < 0.05]
    assert len([one for one in every if one.p_value < 0.05]) > len(want) > 0
    assert frame["sequence"].tolist() == [" ".join("abcd"[a] for a in one.actions) for one in want]
    for name in ("count", "expected", "ratio", "low", "high", "p_value"):
        assert frame[name].tolist() == [getattr(one, name) for one in want]
    assert frame["p_corrected"].tolist() == [one.corrected for one in want]
    first = frame.iloc[0]
    assert cells(part)[0][:3] == [first["sequence"], f"{first['count']:,}", f"{first['expected']:,.1f}"]


def test_drift_within_plans_between_them_and_between_groups(plans, found):
    part, best = drift_section(found), found.best
    given = plans, best.bits, found.mask
    frame = part.frames["drift"]
    places, groups = (frame[frame["what"] == what] for what in ("place", "subject"))
    want = by_position(*given).parts
    assert places[["bits", "low", "high"]].to_numpy() == pytest.approx(np.array(want), nan_ok=True)
    assert places["name"].tolist() == [f"part {n} of 10" for n in range(1, 11)]
    by_name = by_group(*given).groups
    assert groups["name"].tolist() == [plans.group_names[number] for number in by_name]
    assert groups[["bits", "low", "high"]].to_numpy() == pytest.approx(np.array([*by_name.values()]), nan_ok=True)
    own = by_plan(*given)
    (box,) = part.section.figures
    (cloud,) = (axes for axes in box.figure.axes if "sequence to sequence" in axes.get_title(loc="left"))
    group = own.group.tolist()
    index = [group[: at + 1].count(number) for at, number in enumerate(group)]
    assert cloud.lines[0].get_xdata().tolist() == index
    assert cloud.lines[0].get_ydata().tolist() == own.bits.tolist()
    assert max(index) == 3


@pytest.mark.parametrize(
    ("length", "words"), [(20, "first 5 behaviours of each sequence"), (8, "too short to leave out")]
)
def test_the_beginnings_of_plans_are_no_drift(length, words):
    """Actions repeat at probability .9 throughout; only the first, which nothing stands before, costs more."""
    repeats = torch.rand(200, length, generator=seeded(0)) < 0.9
    repeats[:, 0] = torch.rand(200, generator=seeded(1)) < 0.5
    plans = RecordedPlans((~repeats).long().cumsum(1) % 2, 2)
    part = drift_section(evaluate_saved({"chain": MarkovPrior(2, 1).fit(plans)}, plans, 0))
    change = part.frames["drift_tests"].set_index("test").loc["change over a sequence, bits"]
    assert (change["low"] < 0 < change["high"]) == (length == 20)
    assert any(words in line for line in part.section.text)
