"""How `fit` reads plans, and divides them."""

from dataclasses import replace

import pytest
import torch

from neuroprior import ExhaustivePlanner, MarkovPrior, Plans, gridworld
from neuroprior.behaviour import PastDurations, RecordedPlans
from neuroprior.behaviour.reporting import ReadOptions
from neuroprior.cli import fit as command
from neuroprior.cli.fit_data import divide
from tests.support.sources import refuses, seeded


def drawn(num, **more):
    return Plans(torch.randint(3, (num, 5), generator=seeded(0)), 3, **more)


def sizes(parts) -> list[int]:
    return [len(part) for part in (parts.learned_from, parts.chosen_on, parts.held_out)]


@pytest.fixture
def fitted(monkeypatch, tmp_path):
    """A function that fits a chain, and returns it and the parts that the report was given."""

    def fit(**options):
        given = []
        monkeypatch.setattr(command, "report", lambda folder, prior, *more: given.extend([prior, more[1]]))
        command.fit(prior=lambda n, **size: MarkovPrior(n, 1, **size), out=str(tmp_path / "run"), **options)
        return given

    return fit


def test_how_a_file_is_read_is_passed_on(monkeypatch, fitted):
    reading = ReadOptions(num_actions=3, missing="label", merge_repeats=True, max_gap=3.5)
    asked = []

    def read(options, files):
        asked.append((files, options))
        return RecordedPlans.of(drawn(40))

    monkeypatch.setattr(ReadOptions, "read", read)
    fitted(plans=["a.csv", "b.csv"], reading=reading)
    assert asked == [(["a.csv", "b.csv"], reading)]


@pytest.mark.parametrize(("context", "shape"), [(None, None), ("plan", (20, 2)), ("step", (20, 2))])
def test_collected_plans_have_the_context_that_was_asked_for(context, shape, fitted):
    world = gridworld(3, 3, num_worlds=4)
    prior, parts = fitted(world=world, planner=ExhaustivePlanner(2), num_plans=20, context=context, folds=1)
    assert (parts.plans.context is None) == (shape is None)
    assert shape is None or parts.plans.context.shape == shape
    assert prior.takes_context == (shape is not None)


@pytest.mark.parametrize(("use_context", "end"), [(True, False), (False, True)])
def test_contexts_may_be_left_out_and_ends_are_added_once(use_context, end, monkeypatch, fitted):
    plans = drawn(40, context=torch.arange(40) % 2)
    for read in (plans, plans.with_end() if end else plans):
        monkeypatch.setattr(command, "read_npz", lambda *_, read=read: RecordedPlans.of(read))
        monkeypatch.setattr(command, "write_plans", lambda *_: None)
        prior, parts = fitted(plans="plans.csv", use_context=use_context, end=end, resume="none")
        assert prior.takes_context == use_context
        assert (parts.plans.num_actions, parts.plans.end) == ((4, 3) if end else (3, None))


@pytest.mark.parametrize(
    ("plans", "shares", "due"),
    [
        (drawn(100), (0.3, 0.4), [30, 30, 40]),  # shares are of all plans: one of the rest would be 18
        (drawn(60, group=torch.arange(60) % 6), (0.3, 0.4), [40, 20, 60]),  # nothing is held out for good
        (drawn(3), (0.3, 0.3), [1, 1, 1]),
        (drawn(20, group=torch.zeros(20).long()), (0.1, 0.1), [16, 2, 2]),  # of one group: split as plans are
        (drawn(40, group=torch.arange(40) % 2), (0.1, 0.1), [36, 4, 40]),  # of two groups some plans
    ],
)
def test_the_sizes_of_parts(plans, shares, due):
    assert sizes(divide(plans, *shares)) == due


@pytest.mark.parametrize(
    ("groups", "wanted", "folds"),
    [(3, None, 3), (49, None, 5), (50, None, 1), (None, None, 1), (6, 6, 6), (6, 1, 1), (None, 60, 60)],
)
def test_the_number_of_folds(groups, wanted, folds):
    group = None if groups is None else torch.arange(60) % groups
    assert divide(drawn(60, group=group), num_folds=wanted).folds == folds


def test_of_two_long_plans_the_end_of_the_longer_is_for_validation():
    actions = torch.arange(2 * 300).view(2, 300) % 7
    parts = divide(Plans(actions, 7, torch.tensor([200, 300])))
    assert parts.folds == 2
    assert parts.held_out.mask().sum() == 500
    assert parts.learned_from.mask().sum(1).tolist() == [200, 250]
    assert parts.chosen_on.actions[0, :50].equal(actions[1, 250:])
    assert parts.chosen_on.mask().sum() == 50
    with refuses("`plans` must have at least 3 plans", "got 2"):
        divide(Plans(actions, 7, torch.tensor([99, 300])))


def test_of_two_unequal_groups_a_share_of_the_actions_is_for_validation():
    actions = torch.arange(3 * 2000).view(3, 2000) % 7
    plans = Plans(actions, 7, torch.tensor([2000, 100, 3]), group=torch.tensor([0, 1, 1]))
    for seed in range(4):
        parts = divide(plans, seed=seed)
        assert 100 <= parts.chosen_on.mask().sum() <= 211
        assert parts.learned_from.mask().sum() + parts.chosen_on.mask().sum() == 2103


def test_durations_are_standardised_by_what_is_learned_from():
    """All parts get as many features; their scale is that of the plans to learn from, not of all."""
    plans = replace(RecordedPlans.of(drawn(40)), durations=torch.rand(40, 5, generator=seeded(1)).add(0.1) ** 3)
    plain, parts = divide(plans), divide(plans, past_durations=2)
    past = PastDurations.of(plain.learned_from, 2)
    assert parts.past_durations == past != PastDurations.of(plans, 2)
    assert parts.num_contexts is None
    for name in ("plans", "learned_from", "chosen_on", "held_out"):
        assert getattr(parts, name).context.equal(past.added_to(getattr(plain, name)).context)


def test_seeds_draw_other_parts():
    first, again, other = (divide(drawn(40), seed=seed).held_out.actions for seed in (1, 1, 2))
    assert first.equal(again)
    assert not first.equal(other)
