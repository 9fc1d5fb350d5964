"""The section on hidden modes: its numbers, counted anew from the modes of each action."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pandas as pd
import pytest
import torch

from neuroprior import Plans
from neuroprior.behaviour import RecordedPlans, choose_modes, mode_table, motifs
from neuroprior.behaviour.reporting.figures import group_transition_figure
from neuroprior.behaviour.reporting.fits import counted
from neuroprior.behaviour.reporting.modes import MOST_MOTIFS, mode_section
from neuroprior.behaviour.reporting.part import Part
from neuroprior.behaviour.reporting.scores import evaluate_saved
from neuroprior.priors import UniformPrior
from tests.support.sources import seeded

NAMES, SKIP, LENGTHS = ("rest", "left", "right", "dig", "eat"), 3, (40, 39, 33)


def two_modes() -> Plans:
    """Thirteen actions of one mode and thirteen of the other by turns, in plans of three lengths and in three groups.

    In the one, a rest is between any two of left and right, which mostly alternate; in the other actions are random.
    """
    rng, rows = np.random.default_rng(0), []
    for number in range(30):
        side, row = 1, []
        for t in range(max(LENGTHS)):
            if (t // 13 + number) % 2:
                row.append(rng.choice(5, p=[0.1, 0.1, 0.1, 0.35, 0.35]))
            elif t % 2:
                row.append(0)
            else:
                side = 3 - side if rng.random() < 0.8 else side
                row.append(side)
        rows.append(row)
    lengths = torch.tensor(LENGTHS).repeat(10)
    actions = torch.tensor(np.array(rows)).masked_fill(torch.arange(max(LENGTHS)) >= lengths[:, None], 4)
    return Plans(actions, 5, lengths, action_names=NAMES, group=torch.arange(30) // 10)


@pytest.fixture(scope="module")
def plans() -> Plans:
    return two_modes()


@pytest.fixture(scope="module")
def part(plans) -> Part:
    found = evaluate_saved({"uniform": UniformPrior(5)}, RecordedPlans.of(plans), SKIP)
    made = mode_section(replace(found, settings=found.settings | {"modes": [1, 2]}))
    assert made is not None
    return made


@pytest.fixture(scope="module")
def smoothed(part, plans) -> np.ndarray:
    """`[N, L, 2]`; NaN beyond the ends."""
    out = np.full((*plans.actions.shape, 2), np.nan)
    rows = part.frames["mode_actions"]
    out[rows["plan"], rows["step"]] = rows[["smoothed_1", "smoothed_2"]]
    return out


def test_modes_are_chosen_on_the_actions_that_count(part, plans, smoothed):
    choice = choose_modes(plans, [1, 2], mask=counted(plans, SKIP), generator=seeded(0))
    assert choice.chosen == 2
    pd.testing.assert_frame_equal(part.frames["modes"], choice.frame())
    pd.testing.assert_frame_equal(part.frames["mode_table"].drop(columns="stable"), mode_table(choice.prior, plans))
    assert part.frames["mode_table"]["share"].tolist() == pytest.approx(np.nanmean(smoothed, (0, 1)).tolist())
    assert part.frames["mode_table"]["stable"].tolist() == ["yes" if one else "no" for one in choice.stable()]


def test_sequences_are_those_of_the_runs_of_each_mode(part, plans):
    """A run ends where the mode does, and where the plan does; runs of one group are alike."""
    rows, want = part.frames["mode_actions"], []
    for mode in (1, 2):
        runs, group = [], []
        for plan, own in rows.groupby("plan", sort=False):
            steps = zip(own["mode"], own["action"], strict=True)
            for kind, run in groupby(steps, key=lambda step: step[0]):
                if kind == mode:
                    runs.append(torch.tensor([NAMES.index(action) for _, action in run]))
                    group.append(int(plans.group[plan]))
        sizes, padded = torch.tensor([*map(len, runs)]), torch.nn.utils.rnn.pad_sequence(runs, batch_first=True)
        found = motifs(Plans(padded, 5, sizes, group=torch.tensor(group)))
        over = [one for one in found if one.corrected < 0.05 and one.count > one.expected]
        want += [
            (mode, " ".join(NAMES[a] for a in one.actions), one.count, one.expected, one.ratio, one.corrected)
            for one in over[:MOST_MOTIFS]
        ]
        # Others are as clearly rarer than expected.
        assert len(over) == len([one for one in found if one.corrected < 0.05]) - len(over)
    frame = part.frames["mode_motifs"]
    assert frame["sequence"].tolist() == ["right rest left", "left rest right"]
    pd.testing.assert_frame_equal(frame, pd.DataFrame(want, columns=list(frame)))
    (table,) = (table for table in part.section.tables if "Over-represented" in table.title)
    assert [row[:3] for row in table.rows] == [[str(row[0]), row[1], f"{row[2]:,}"] for row in want]


def test_occupancy_is_the_share_of_each_mode_in_tenths_of_the_plans(part, plans, smoothed):
    steps = torch.arange(max(LENGTHS))
    tenth = ((steps + 0.5) * 10 / plans.lengths[:, None]).long().numpy()
    frame = part.frames["mode_occupancy"]
    for mode in (1, 2):
        want = [np.nanmean(smoothed[tenth == k][:, mode - 1]) for k in range(10)]
        own = frame[frame["mode"] == f"mode {mode}"]
        assert own["part"].tolist() == [*range(1, 11)]
        np.testing.assert_allclose(own["share"], want)
        assert (own["low"] < own["share"]).all()
        assert (own["share"] < own["high"]).all()


def test_the_figures_show_the_modes(part, plans, smoothed):
    """Transitions of each mode less those of all, weighted by the mode's probability where the second action is."""
    counts = np.zeros((2, 5, 5))
    for n, t in plans.mask()[:, 1:].nonzero().tolist():
        counts[:, plans.actions[n, t], plans.actions[n, t + 1]] += smoothed[n, t + 1]
    with np.errstate(invalid="ignore"):
        each, pooled = counts / counts.sum(2, keepdims=True), counts.sum(0) / counts.sum(0).sum(1, keepdims=True)
    modes = ["mode 1", "mode 2"]
    want = group_transition_figure(each, pooled, NAMES, modes, np.zeros(each.shape, dtype=bool))
    figures = {box.name: box.figure for box in part.section.figures}
    for drawn, expected in zip(figures["mode_transitions"].axes[:2], want.axes[:2], strict=True):
        assert drawn.get_title(loc="left") == expected.get_title(loc="left")
        np.testing.assert_allclose(drawn.images[0].get_array(), expected.images[0].get_array(), atol=1e-6)
    (axes,) = figures["mode_occupancy"].axes
    shares = part.frames["mode_occupancy"].groupby("mode")["share"].apply(list)
    assert {line.get_label(): line.get_ydata().tolist() for line in axes.lines} == shares.to_dict()
