"""Plans: shapes, dtypes, lengths, contexts, splits, and what is refused."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import Plans
from neuroprior.plans import expand_context
from tests.support.sources import FALSE_ALARM, p_value, refuses, seeded

ACTIONS = torch.tensor([[0, 1, 2], [2, 2, 0], [1, 0, 1], [0, 0, 0]])


@pytest.mark.parametrize(("num_actions", "dtype"), [(3, torch.uint8), (256, torch.uint8), (257, torch.int64)])
@pytest.mark.parametrize("given_as", [torch.uint8, torch.int32, torch.int64])
def test_actions_are_stored_small(num_actions, dtype, given_as):
    plans = Plans(ACTIONS.to(given_as), num_actions)
    assert plans.actions.dtype == dtype
    assert plans.actions.tolist() == ACTIONS.tolist()
    assert (len(plans), plans.max_length, plans.num_actions) == (4, 3, num_actions)


def test_lengths_mask_the_rest_away():
    padded = torch.tensor([[0, 1, 2], [2, -1, 99], [-7, -7, -7]])
    plans = Plans(padded, 3, lengths=torch.tensor([3, 1, 0]))
    assert plans.actions.tolist() == [[0, 1, 2], [2, 0, 0], [0, 0, 0]]
    assert plans.mask().tolist() == [[True] * 3, [True, False, False], [False] * 3]
    assert Plans(ACTIONS, 3).mask().all()
    assert Plans(torch.zeros(2, 0, dtype=torch.long), 3).mask().shape == (2, 0)


@pytest.mark.parametrize(
    "context",
    [torch.arange(4), torch.arange(12).view(4, 3), torch.rand(4, 5), torch.rand(4, 3, 5), None],
    ids=["index", "index a step", "features", "features a step", "none"],
)
@pytest.mark.parametrize(
    "index", [slice(1, 3), torch.tensor([3, 0, 0]), torch.tensor([True, False, False, True]), slice(0, 0)]
)
def test_indexing_takes_everything_along(context, index):
    group, lengths = torch.tensor([7, 7, 8, 9]), torch.tensor([3, 2, 1, 0])
    plans = Plans(ACTIONS, 3, lengths, ("a", "b", "c"), context, group)[index]
    assert torch.equal(plans.actions, Plans(ACTIONS, 3, lengths).actions[index])
    assert torch.equal(plans.lengths, lengths[index])
    assert torch.equal(plans.group, group[index])
    assert plans.action_names == ("a", "b", "c")
    assert (
        plans.context is None
        if context is None
        else torch.equal(plans.context[plans.mask()], expand_context(context, 3)[index][plans.mask()])
    )


GOOD = {"actions": ACTIONS, "num_actions": 3}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"num_actions": 0}, ["num_actions", "0"]),
        ({"num_actions": 2}, ["actions[0, 2]", "2"]),
        ({"actions": ACTIONS - 1}, ["actions[0, 0]", "-1"]),
        ({"actions": ACTIONS.float()}, ["actions", "float32"]),
        ({"actions": ACTIONS > 0}, ["actions", "bool"]),
        ({"actions": ACTIONS[0]}, ["actions", "[3]"]),
        ({"actions": ACTIONS[None]}, ["actions", "[1, 4, 3]"]),
        ({"lengths": torch.tensor([1, 2, 3])}, ["lengths", "[3]"]),
        ({"lengths": torch.tensor([1, 2, 3, 4])}, ["lengths[3]", "4"]),
        ({"lengths": torch.tensor([1, -1, 3, 3])}, ["lengths[1]", "-1"]),
        ({"lengths": torch.ones(4)}, ["lengths", "float32"]),
        ({"lengths": torch.ones(4).long(), "actions": ACTIONS + 2}, ["actions[1, 0]", "4"]),
        ({"lengths": torch.ones(4).long(), "actions": ACTIONS.float()}, ["actions", "float32"]),
        ({"action_names": ["a"]}, ["action_names", "3", "1"]),
        ({"group": torch.zeros(3).long()}, ["group", "[3]"]),
        ({"group": torch.zeros(4)}, ["group", "float32"]),
        ({"context": torch.zeros(3).long()}, ["context", "[3]"]),
        ({"context": torch.zeros(4, 2).long()}, ["context", "[4, 2]"]),
        ({"context": torch.zeros(4)}, ["context", "[4]"]),
        ({"context": torch.zeros(4, 2, 5)}, ["context", "[4, 2, 5]"]),
        ({"context": torch.zeros(3, 5)}, ["context", "[3, 5]"]),
        ({"context": torch.zeros(4).bool()}, ["context", "bool"]),
        ({"context": torch.tensor([[0.0], [1], [float("nan")], [1]])}, ["context[2, 0]", "nan"]),
        ({"context": torch.full((4, 3, 1), float("inf"))}, ["context[0, 0, 0]", "inf"]),
        ({"context_names": ("a",)}, ["context_names"]),
        ({"group": torch.tensor([0, 1, 2, 2]), "group_names": ("a", "b")}, ["group"]),
        ({"actions": torch.tensor([[2, 0]]), "lengths": torch.tensor([2]), "end": 2}, ["end symbol"]),
        ({"end": 3}, ["end"]),
    ],
)
def test_refuses(change, words):
    with refuses(*words):
        Plans(**(GOOD | change))


@settings(max_examples=60, deadline=None)
@given(
    group=st.lists(st.integers(-5, 5), min_size=2, max_size=40).filter(lambda g: len(set(g)) > 1),
    share=st.floats(0.01, 0.99),
    seed=st.integers(0, 1000),
)
def test_split_keeps_groups_together(group, share, seed):
    number = torch.arange(len(group))
    plans = Plans(number[:, None], len(group), context=number, group=torch.tensor(group))
    parts = plans.split(share, seeded(seed))
    again = plans.split(share, seeded(seed))
    for part, same in zip(parts, again, strict=True):
        assert torch.equal(part.actions, same.actions)
        assert len(part) > 0
        assert torch.equal(part.context, part.actions.long())
    training, validation = parts
    assert not set(training.group.tolist()) & set(validation.group.tolist())
    assert sorted(training.context[:, 0].tolist() + validation.context[:, 0].tolist()) == number.tolist()
    held_out = len(set(validation.group.tolist()))
    assert abs(held_out - share * len(set(group))) <= 1


@pytest.mark.parametrize(("units", "share", "held_out"), [(18, 0.1, 2), (14, 0.1, 1), (3, 0.01, 1), (3, 0.99, 2)])
def test_the_nearest_number_of_units_is_held_out(units, share, held_out):
    for group in (None, torch.arange(2 * units) % units):
        plans = Plans(torch.zeros(units if group is None else 2 * units, 3, dtype=torch.long), 2, group=group)
        training, validation = plans.split(share, seeded(0))
        number = len(validation) if group is None else len(validation.group.unique())
        assert number == held_out
        assert len(training) + len(validation) == len(plans)


def test_split_is_random():
    plans = Plans(torch.arange(5)[:, None], 5)
    generator = seeded(0)
    held_out = torch.cat([plans.split(0.2, generator)[1].actions[:, 0].long() for _ in range(2000)])
    assert len(held_out) == 2000
    assert p_value(held_out, torch.ones(5)) > FALSE_ALARM


def test_split_leaves_the_global_generator_alone():
    before = torch.get_rng_state()
    Plans(ACTIONS, 3).split()
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize("plans", [Plans(ACTIONS[:1, :1], 3), Plans(ACTIONS, 3, group=torch.ones(4).long())])
def test_split_refuses_one_of_a_kind(plans):
    with refuses("1"):
        plans.split()


def test_one_plan_is_cut_in_time():
    plan = Plans(torch.arange(10)[None], 10, lengths=torch.tensor([8]), context=torch.arange(10)[None])
    first, last = plan.split(0.25)
    assert first.actions.tolist() == [[0, 1, 2, 3, 4, 5]]
    assert last.actions.tolist() == last.context.tolist() == [[6, 7]]
    assert first.lengths.tolist() == [6]
    assert last.lengths.tolist() == [2]


def test_the_end_symbol_closes_every_plan_and_comes_off_again():
    plans = Plans(ACTIONS, 3, lengths=torch.tensor([0, 1, 2, 3])[: len(ACTIONS)], action_names=("a", "b", "c"))
    closed = plans.with_end()
    assert closed.num_actions == 4
    assert closed.end == 3
    assert closed.action_names == ("a", "b", "c", "end")
    assert closed.lengths.tolist() == [1, 2, 3, 4]
    assert (closed.actions == 3).sum(1).tolist() == [1, 1, 1, 1]
    opened = closed.without_end()
    assert opened.lengths.tolist() == [0, 1, 2, 3]
    assert opened.end is None
    assert opened.action_names == ("a", "b", "c")
    assert opened.actions.masked_fill(~opened.mask(), 9).tolist() == (
        plans.actions[:, :3].masked_fill(~plans.mask()[:, :3], 9).tolist()
    )


def test_the_end_symbol_has_the_context_of_the_last_action():
    context = torch.arange(1, 10).view(3, 3)
    closed = Plans(torch.zeros(3, 3, dtype=torch.long), 2, torch.tensor([1, 2, 3]), context=context).with_end()
    assert closed.context[closed.mask()].tolist() == [1, 1, 4, 5, 5, 7, 8, 9, 9]


def test_without_lengths_plans_end_at_the_first_end_symbol():
    sampled = torch.tensor([[0, 2, 2], [2, 2, 2], [0, 1, 0]])
    assert Plans(sampled, 3, end=2).lengths.tolist() == [2, 1, 3]
    assert Plans(sampled, 3, end=2).without_end().lengths.tolist() == [1, 0, 3]


def test_an_end_symbol_is_added_and_taken_off_once():
    with refuses("already"):
        Plans(torch.tensor([[0, 2]]), 3, end=2).with_end()
    with refuses("end"):
        Plans(torch.tensor([[0, 2]]), 3).without_end()


def test_steps_of_plans() -> None:
    plans = Plans(
        torch.tensor([[0, 1, 2, 3], [3, 2, 0, 0], [1, 0, 0, 0]]),
        4,
        torch.tensor([4, 2, 1]),
        context=torch.arange(12).view(3, 4),
        group=torch.tensor([0, 0, 1]),
    )
    cut = plans.steps(1, 3)
    assert cut.lengths.tolist() == [2, 1, 0]
    assert cut.actions.tolist() == [[1, 2], [2, 0], [0, 0]]
    assert cut.context.tolist() == [[1, 2], [5, 0], [0, 0]]
    assert cut.group.tolist() == [0, 0, 1]
    assert plans.steps(7).max_length == 0
    assert plans.steps(7).lengths.tolist() == [0, 0, 0]
    assert plans.steps().actions.equal(plans.actions)
    once = Plans(plans.actions, 4, context=torch.tensor([5, 6, 7])).steps(2)
    assert once.context.tolist() == [[5, 5], [6, 6], [7, 7]]
    with pytest.raises(ValueError, match="`first` must be an integer of at least 0"):
        plans.steps(-1)
    with pytest.raises(ValueError, match="`stop` must be at least 3"):
        plans.steps(3, 2)


def test_plans_that_need_not_move_are_themselves():
    plans = Plans(ACTIONS, 3, group=torch.arange(len(ACTIONS)))
    assert plans.to("cpu") is plans
