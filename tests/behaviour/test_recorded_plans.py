"""Plans that are parts of recordings: times, conditions and names stay with their plans, in memory and in files."""

import math
import warnings

import pytest
import torch

from neuroprior import Plans
from neuroprior.behaviour import RecordedPlans
from neuroprior.behaviour.recorded_plans import durations_of
from neuroprior.behaviour.reporting import ReadOptions
from neuroprior.plans import in_parts, read_plans, write_minari, write_plans
from neuroprior.plans.sequences import plans_digest
from tests.support.sources import refuses

NAN = math.nan
FIELDS = {
    "recording": ("s1", "s1", "s2"),
    "began": torch.tensor([[0.0, 2.5, 4.0], [9.5, NAN, 0.0], [1e9 + 0.125, 0.0, 0.0]], dtype=torch.float64),
    "durations": torch.tensor([[2.5, 1.5, NAN], [0.0, 3.0, 0.0], [7.0, 0.0, 0.0]]),
    "condition": torch.tensor([1, 1, 0]),
    "condition_names": ("drug", "saline"),
    "stratum": torch.tensor([1, 0, 1]),
    "stratum_names": ("female", "male"),
    "notes": ("2 rows have no label",),
}
PLANS = RecordedPlans(
    torch.tensor([[0, 1, 2], [2, 1, 0], [1, 0, 0]]), 3, torch.tensor([3, 2, 1]), group=torch.tensor([4, 4, 7]), **FIELDS
)


def to_lists(values):
    """Numbers in lists, None for those that are not known."""
    return [[None if math.isnan(one) else one for one in row] for row in values.tolist()]


def test_times_are_stored_where_there_are_actions():
    assert (PLANS.began.dtype, PLANS.durations.dtype) == (torch.float64, torch.float32)
    assert to_lists(PLANS.began) == [[0, 2.5, 4], [9.5, None, 0], [1e9 + 0.125, 0, 0]]
    assert to_lists(PLANS.durations) == [[2.5, 1.5, None], [0, 3, 0], [7, 0, 0]]
    shown = RecordedPlans(PLANS.actions, 3, PLANS.lengths, began=torch.ones(3, 3), durations=torch.ones(3, 3))
    assert shown.began.tolist() == shown.durations.tolist() == [[1, 1, 1], [1, 1, 0], [1, 0, 0]]
    ones = torch.ones(1, 3)
    ended = RecordedPlans(torch.tensor([[0, 1, 2]]), 3, end=2, began=ones, durations=ones)
    assert (to_lists(ended.began), to_lists(ended.durations)) == ([[1, 1, None]], [[1, 1, 0]])


@pytest.mark.parametrize("index", [slice(1, 3), torch.tensor([2, 0]), torch.tensor([True, False, True])])
def test_indexing_takes_everything_along(index):
    rows = torch.arange(3)[index].tolist()
    some = PLANS[index]
    assert isinstance(some, RecordedPlans)
    assert some.recording == tuple(FIELDS["recording"][row] for row in rows)
    assert to_lists(some.began) == [to_lists(PLANS.began)[row] for row in rows]
    assert to_lists(some.durations) == [to_lists(PLANS.durations)[row] for row in rows]
    assert some.condition.tolist() == [FIELDS["condition"].tolist()[row] for row in rows]
    assert (some.condition_names, some.notes) == (FIELDS["condition_names"], FIELDS["notes"])


def test_steps_and_parts_have_the_times_of_their_actions():
    cut = PLANS.steps(1, 3)
    assert to_lists(cut.began) == [[2.5, 4], [None, 0], [0, 0]]
    assert to_lists(cut.durations) == [[1.5, None], [3, 0], [0, 0]]
    parts = in_parts(PLANS[:1], 2)
    assert to_lists(parts.began) == [[0, 2.5], [4, 0]]
    assert parts.recording == ("s1", "s1")
    assert parts.condition.tolist() == [1, 1]


def test_an_end_symbol_takes_no_time_and_comes_off_again():
    closed = PLANS.with_end()
    assert to_lists(closed.durations) == [[2.5, 1.5, None, 0], [0, 3, 0, 0], [7, 0, 0, 0]]
    assert to_lists(closed.began) == [[0, 2.5, 4, None], [9.5, None, None, 0], [1e9 + 0.125, None, 0, 0]]
    opened = closed.without_end()
    assert to_lists(opened.durations) == to_lists(PLANS.durations)
    assert to_lists(opened.began) == to_lists(PLANS.began)
    assert closed.recording == opened.recording == PLANS.recording


def test_plain_plans_are_recorded_plans_without_times():
    plain = Plans(PLANS.actions, 3, PLANS.lengths, ("a", "b", "c"), torch.tensor([5, 6, 7]))
    recorded = RecordedPlans.of(plain)
    assert recorded.action_names == plain.action_names
    assert all(getattr(recorded, name).equal(getattr(plain, name)) for name in ("actions", "lengths", "context"))
    assert all(getattr(recorded, name) in (None, ()) for name in FIELDS)
    assert RecordedPlans.of(PLANS) is PLANS
    for plans in (plain, recorded):
        with refuses("durations: these plans have none; give RecordedPlans(durations=)"):
            durations_of(plans)


def test_npz_files_hold_everything_and_others_refuse_it(tmp_path):
    write_plans(PLANS, tmp_path / "a.npz")
    back = ReadOptions().read(str(tmp_path / "a.npz"))
    for name in ("actions", "lengths", "group", "condition", "stratum"):
        assert getattr(back, name).equal(getattr(PLANS, name)), name
    for name in ("began", "durations"):
        assert getattr(back, name).dtype == getattr(PLANS, name).dtype
        assert to_lists(getattr(back, name)) == to_lists(getattr(PLANS, name))
    assert (back.recording, back.condition_names, back.notes) == (
        PLANS.recording,
        PLANS.condition_names,
        PLANS.notes,
    )
    assert plans_digest(back) == plans_digest(PLANS)
    with pytest.warns(UserWarning, match="arrays that are not used: recording, began, durations, condition, condition"):
        assert type(read_plans(tmp_path / "a.npz")) is Plans
    write_plans(RecordedPlans.of(Plans(PLANS.actions, 3)), tmp_path / "plain.npz")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_plans(tmp_path / "plain.npz").actions.equal(PLANS.actions)
    for name in ("a.jsonl", "a.csv"):
        with refuses(
            name, "recording, condition, stratum, began, durations of RecordedPlans are written to .npz files only"
        ):
            write_plans(PLANS, tmp_path / name)
    with refuses("mice/a-v0: recording, condition, stratum, began, durations of RecordedPlans"):
        write_minari(PLANS, "mice/a-v0")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"began": torch.full((3, 3), math.inf)}, "`began[0, 0]` must be finite times, got inf"),
        ({"began": torch.ones(3)}, "`began` must have shape [3, 3], got [3]"),
        ({"condition": torch.tensor([0, 1])}, "`condition` must have shape [3], got [2]"),
        ({"condition_names": ("a",)}, "`condition_names` must come with the integers in condition"),
        ({"condition": torch.tensor([0, 2, 0]), "condition_names": ("a", "b")}, "condition[1]: 2"),
        ({"condition": torch.tensor([0.5, 1, 1])}, "condition"),
        ({"notes": "x"}, "`notes` must be a list of texts"),
        ({"recording": ["a", "b"]}, "`recording` must be 3 names, one a plan, got 2"),
        ({"recording": "abc"}, "`recording` must be a list of texts"),
        ({"recording": ["a", "b", "\ud83d"]}, "surrogate"),
        ({"cut_off": torch.zeros(3, 3, dtype=torch.bool)}, "`cut_off` must be bool, of plans with durations"),
    ],
)
def test_what_is_refused(fields, words):
    with refuses(words):
        RecordedPlans(PLANS.actions, 3, **fields)


@pytest.mark.parametrize("wrong", [-0.5, math.inf, -math.inf])
def test_durations_are_times_where_there_are_actions(wrong):
    """Those that are not known are NaN; whatever stands beyond the ends of plans is 0."""
    durations, lengths = torch.tensor([[1.5, 0.0, wrong], [math.nan, 2.0, wrong]]), torch.tensor([2, 2])
    actions = torch.zeros(2, 3, dtype=torch.long)
    kept = RecordedPlans(actions, 1, lengths, durations=durations).durations
    assert kept.nan_to_num(-1).tolist() == [[1.5, 0, 0], [-1, 2, 0]]
    with refuses(f"`durations[1, 2]` must be finite times from 0, got {wrong}"):
        RecordedPlans(actions, 1, torch.tensor([2, 3]), durations=durations)


def test_parts_of_a_split_have_what_belongs_to_them():
    plans = RecordedPlans(torch.arange(6).view(3, 2), 6, recording=["a", "b", "a"], durations=torch.ones(3, 2))
    for part in plans.split(0.4, torch.Generator().manual_seed(0)):
        assert [("a", "b", "a")[int(first) // 2] for first in part.actions[:, 0]] == list(part.recording)
    first, last = PLANS[:1].split(0.34)
    assert (to_lists(first.durations), to_lists(last.durations)) == ([[2.5, 1.5]], [[None]])
    assert (to_lists(first.began), to_lists(last.began)) == ([[0, 2.5]], [[4]])
