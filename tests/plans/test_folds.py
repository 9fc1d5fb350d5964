"""Plans divided so that each is held out once: folds over units, and a single plan in parts."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import Plans
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.plans.folds import BLOCKS, fair_split, folds, in_parts, pieces
from tests.support.sources import refuses, seeded


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.integers(-3, 6), min_size=2, max_size=30), st.booleans(), st.integers(0, 5), st.data())
def test_folds(numbers, grouped, seed, data):
    """Each plan is held out once, groups stay together, and folds differ by a unit at most."""
    group = torch.tensor(numbers)
    grouped = grouped and len(group.unique()) > 1
    plans = Plans(torch.zeros(len(group), 2).long(), 2, group=group if grouped else group * 0)
    unit = group if grouped else torch.arange(len(group))
    number = data.draw(st.integers(2, len(unit.unique())))
    found = folds(plans, number, seed)
    assert len(found) == number
    everyone = torch.arange(len(plans))
    assert torch.cat([held_out for _, held_out in found]).sort().values.equal(everyone)
    sizes = []
    for learned, held in found:
        assert torch.cat([learned, held]).sort().values.equal(everyone)
        assert learned.equal(learned.sort().values)
        assert held.equal(held.sort().values)
        assert not set(unit[learned].tolist()) & set(unit[held].tolist())
        sizes.append(len(unit[held].unique()))
    assert max(sizes) - min(sizes) <= 1
    again = folds(plans, number, seed)
    assert all(a.equal(c) and b.equal(d) for (a, b), (c, d) in zip(found, again, strict=True))


def test_the_seed_draws_the_folds():
    plans = Plans(torch.zeros(30, 2).long(), 2)
    drawn = {tuple(folds(plans, 5, seed)[0][1].tolist()) for seed in range(20)}
    assert len(drawn) > 15  # of 142,506; two equal ones among 20 have a probability of 0.001
    state = torch.get_rng_state()
    folds(plans, 5, 7)
    assert state.equal(torch.get_rng_state())


@pytest.mark.parametrize(
    ("group", "number", "words"),
    [
        (None, 1, ("plans, 4", "got 1")),
        (None, 0, ("got 0",)),
        (None, -1, ("got -1",)),
        (None, 5, ("plans, 4", "got 5")),
        ([0, 0, 1, 1], 3, ("groups, 2", "got 3")),
        ([7, 7, 7, 7], 5, ("plans, 4", "got 5")),
        ([], 2, ("0",)),
    ],
)
def test_bad_numbers_of_folds(group, number, words):
    plans = torch.zeros(4 if group is None else len(group), 2).long()
    with refuses("folds", *words):
        folds(Plans(plans, 2, group=None if group is None else torch.tensor(group).long()), number)


def in_steps(length: int, kind: str, pad: int = 0) -> RecordedPlans:
    """A single plan whose context is the place of each action, with `pad` columns beyond its end."""
    actions = torch.arange(length + pad) % 5
    place = torch.arange(length + pad)
    context = {
        "none": None,
        "index a plan": torch.tensor([3]),
        "features a plan": torch.tensor([[0.5, 2.0]]),
        "index a step": place[None],
        "features a step": torch.stack([place.double(), -place.double()], -1)[None],
    }[kind]
    lengths = torch.tensor([length]) if pad else None
    more = {"durations": place[None] / 4, "condition": torch.tensor([1]), "condition_names": ("wild", "tame")}
    return RecordedPlans(actions[None], 5, lengths, tuple("abcde"), context, torch.tensor([4]), **more)


@pytest.mark.parametrize("kind", ["none", "index a plan", "features a plan", "index a step", "features a step"])
@pytest.mark.parametrize(("length", "number", "pad"), [(10, 3, 0), (10, 3, 4), (40, 40, 1), (41, 40, 0), (7, 1, 2)])
def test_parts_make_the_plan_again(length, number, pad, kind):
    plan = in_steps(length, kind, pad)
    parts = in_parts(plan, number)
    sizes = parts.mask().sum(1)
    assert 1 <= len(parts) <= number
    assert len(sizes[:-1].unique()) <= 1  # equal but for the last
    assert 0 < int(sizes[-1]) <= int(sizes[0])
    mask = parts.mask()
    assert parts.actions[mask].tolist() == plan.actions[0, :length].tolist()
    assert parts.action_names == plan.action_names
    assert parts.group is None
    assert parts.durations[mask].tolist() == plan.durations[0, :length].tolist()
    assert parts.condition.tolist() == [1] * len(parts)
    assert parts.condition_names == plan.condition_names
    if kind != "none":
        assert parts.context[mask].equal(plan.context[0, :length])


def test_parts_by_default():
    assert len(in_parts(in_steps(1000, "none"))) == BLOCKS
    closed = in_parts(in_steps(10, "none").with_end(), 3)
    assert closed.end == 5
    assert closed.actions[closed.mask()].tolist() == [*(torch.arange(10) % 5).tolist(), 5]


@pytest.mark.parametrize("kind", ["none", "index a plan", "features a plan", "index a step", "features a step"])
def test_pieces_of_several_plans_make_them_again(kind):
    """Of 10, 0, 4 and 3 actions: pieces of at most 4."""
    lengths = torch.tensor([10, 0, 4, 3])
    one = in_steps(10, kind)
    context = None if one.context is None else one.context.repeat(4, *[1] * (one.context.dim() - 1))
    actions = torch.arange(40).view(4, 10) % 5
    names = ("a", "b", "c", "d")
    plans = RecordedPlans(actions, 5, lengths, None, context, torch.tensor([0, 0, 1, 1]), recording=names)
    cut = pieces(plans, 4)
    assert cut.mask().sum(1).tolist() == [4, 4, 2, 0, 4, 3]
    assert cut.recording == ("a", "a", "a", "b", "c", "d")
    assert cut.group is None
    assert cut.actions[cut.mask()].equal(plans.actions[plans.mask()])
    if kind != "none":
        assert cut.context[cut.mask()].equal(plans.context[plans.mask()])


def unequal(lengths: list[int], group: list[int] | None = None) -> Plans:
    """Plans of these lengths; each action has a context of its own."""
    sizes = torch.tensor(lengths)
    context = torch.arange(len(lengths) * max(lengths)).view(len(lengths), -1)
    actions = torch.zeros(len(lengths), max(lengths), dtype=torch.long)
    return Plans(actions, 2, sizes, None, context, None if group is None else torch.tensor(group))


def test_a_fair_share_of_equal_plans_is_drawn_as_by_split():
    plans = unequal([7] * 20)
    for found, drawn in zip(fair_split(plans, 0.2, seeded(3)), plans.split(0.2, seeded(3)), strict=True):
        assert found.context.equal(drawn.context)


def shares_of(plans: Plans, share: float, **how) -> list[float]:
    """What is held out with each of twenty seeds, as shares of all actions; and nothing is lost."""
    total, found = int(plans.mask().sum()), []
    for seed in range(20):
        learned, held_out = fair_split(plans, share, seeded(seed), **how)
        both = torch.cat([part.context[part.mask()] for part in (learned, held_out)])
        assert both.sort().values.equal(plans.context[plans.mask()].sort().values)
        found.append(int(held_out.mask().sum()) / total)
    return found


@pytest.mark.parametrize(
    "plans",
    [
        unequal([300] + [2] * 39),
        unequal([300, 30, 30]),
        unequal([300, 0, 0, 5]),
        unequal([50] * 10, [0] * 9 + [1]),
        unequal([2]),
    ],
    ids=["one long", "one much longer", "empty plans", "unequal groups", "two actions"],
)
def test_a_share_of_the_actions_is_held_out_of_unequal_plans(plans):
    """Whatever is drawn, between half of it and so much that most is learned from."""
    found = shares_of(plans, 0.1)
    assert min(found) >= 0.05
    assert max(found) <= 0.55


def test_groups_stay_together_unless_they_may_be_divided():
    """Of two groups, one with 59 of 60 plans, neither is a fair share: the nearest is the smaller one."""
    plans = unequal([5] * 60, [0] * 59 + [1])
    assert shares_of(plans, 0.1) == [1 / 60] * 20
    assert shares_of(plans, 0.1, divide_groups=True) == [0.1] * 20


def test_both_sides_have_actions_where_no_draw_is_fair():
    """A single plan of the three has any; of a share of .9 its end would be too little."""
    assert shares_of(unequal([0, 0, 5]), 0.9) == [0.4] * 20


@pytest.mark.parametrize(
    ("plans", "number", "words"),
    [
        (Plans(torch.zeros(2, 9).long(), 2), 3, ("single", "2 of 18")),
        (Plans(torch.zeros(0, 9).long(), 2), 1, ("single", "0 of 0")),
        (Plans(torch.zeros(1, 9).long(), 2, torch.tensor([4])), 5, ("single", "5", "1 of 4")),
        (Plans(torch.zeros(1, 9).long(), 2), 0, ("number", "0")),
        (Plans(torch.zeros(1, 9).long(), 2), -2, ("number", "-2")),
    ],
)
def test_what_cannot_be_cut(plans, number, words):
    with refuses(*words):
        in_parts(plans, number)
