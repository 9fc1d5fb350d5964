"""The sections `data` and `model` of a recipe: how plans are read, split and passed on."""

import pytest
import torch

from neuroprior import ExhaustivePlanner, GRUPrior, MarkovPrior, Plans, gridworld
from neuroprior.cli import fit_recipe
from neuroprior.cli.fit_recipe import PlansData, PriorModel
from neuroprior.plans import PastDurations
from tests.support.sources import refuses, seeded


@pytest.fixture
def data_of(monkeypatch):
    """A function that makes the section `data` of plans in memory; `data_of.asked`: how they were to be read."""

    def made(plans, **options):
        monkeypatch.setattr(fit_recipe, "read_plans", lambda *_, **asked: setattr(made, "asked", asked) or plans)
        return PlansData("plans.csv", **options)

    return made


def drawn(num, **more):
    return Plans(torch.randint(3, (num, 5), generator=seeded(0)), 3, **more)


def test_how_a_file_is_read_is_passed_on(data_of):
    options = {"num_actions": 3, "action_names": ["a", "b", "c"], "columns": object(), "missing": "label"}
    options |= {"merge_repeats": True, "max_gap": 3.5}
    data_of(drawn(40), **options)
    assert data_of.asked == options


def test_shares_are_of_all_plans(data_of):
    """Of 100 plans 30 for validation and 40 held out: a share of the rest would be 18."""
    data = data_of(drawn(100), validation=0.3, held_out=0.4)
    assert [len(part) for part in (data.learned_from, data.chosen_on, data.held_out)] == [30, 30, 40]
    assert data.given.validation == 0.3
    with refuses("validation and held_out leave nothing"):
        data_of(drawn(100), validation=0.5, held_out=0.5)


def test_of_few_groups_nothing_is_held_out_for_good(data_of):
    plans = drawn(60, group=torch.arange(60) % 6)
    data = data_of(plans, validation=0.3, held_out=0.4)
    assert data.folds == 5
    assert [len(part) for part in (data.learned_from, data.chosen_on, data.held_out)] == [40, 20, 60]


@pytest.mark.parametrize(
    ("groups", "wanted", "folds"),
    [(3, None, 3), (14, None, 5), (15, None, 1), (None, None, 1), (6, 6, 6), (6, 1, 1), (None, 60, 60)],
)
def test_the_number_of_folds(groups, wanted, folds, data_of):
    group = None if groups is None else torch.arange(60) % groups
    assert data_of(drawn(60, group=group), folds=wanted).folds == folds


def test_few_plans_without_groups_are_not_folded(data_of):
    assert data_of(drawn(10), held_out=0.2, validation=0.2).folds == 1


def test_three_plans_or_groups_are_enough(data_of):
    shares = {"validation": 0.3, "held_out": 0.3}
    assert len(data_of(drawn(3), **shares).learned_from) == 1
    with refuses("2 plans cannot be split in three"):
        data_of(drawn(2), **shares)
    with refuses("2 groups cannot be split in three"):
        data_of(drawn(20, group=torch.arange(20) % 2), **shares)
    # Plans of one group are split as plans are.
    one = torch.zeros(20, dtype=torch.long)
    assert data_of(drawn(20, group=one)).plans.group is None
    with refuses("2 plans cannot be split in three"):
        data_of(drawn(2, group=one[:2]), **shares)


def test_a_part_has_two_actions_at_least(data_of):
    with refuses("data.validation: too few actions are left for it, 1"):
        data_of(Plans(torch.arange(10)[:, None] % 3, 3))
    assert data_of(Plans(torch.arange(20)[:, None] % 3, 3)).held_out.mask().sum() == 2


def test_indices_that_look_like_names(data_of):
    actions = torch.randint(3, (40, 5), generator=seeded(0))
    assert data_of(Plans(actions, 2**20)).plans.num_actions == 2**20
    with refuses("action indices go up to 1048576"):
        data_of(Plans(actions, 2**20 + 1))


def test_durations_are_standardised_by_what_is_learned_from(data_of):
    """All parts get as many features; their scale is that of the plans to learn from, not of all."""
    plans = drawn(40, durations=torch.rand(40, 5, generator=seeded(1)).add(0.1) ** 3)
    plain = data_of(plans)
    data = data_of(plans, past_durations=2)
    assert data.num_contexts is None
    past = PastDurations.of(plain.learned_from, 2)
    assert data.past_durations == past != PastDurations.of(plans, 2)
    for name in ("plans", "learned_from", "chosen_on", "held_out"):
        assert getattr(data, name).context.equal(past.added_to(getattr(plain, name)).context)
    model = PriorModel(lambda n, **size: GRUPrior(n, hidden_size=4, **size), data=data)
    assert model.prior.past_durations == past


def test_settings_of_training_are_passed_on(data_of):
    data = data_of(drawn(40), max_steps=70, batch_size=7, window=3, check_every=9, seed=5)
    given = data.settings
    assert (given.max_steps, given.batch_size, given.window, given.check_every) == (70, 7, 3, 9)
    assert data.seed == 5
    model = PriorModel(MarkovPrior, learning_rate=0.25, weight_decay=0.125, data=data)
    assert (model.learning_rate, model.weight_decay, model.seed) == (0.25, 0.125, 5)


def test_seeds_draw_other_parts(data_of):
    first, again, other = (data_of(drawn(40), seed=seed).held_out.actions for seed in (1, 1, 2))
    assert first.equal(again)
    assert not first.equal(other)


def test_a_prior_takes_the_context_unless_told_otherwise(data_of):
    data = data_of(drawn(40, context=torch.arange(40) % 2))
    assert PriorModel(lambda n, **size: MarkovPrior(n, 1, **size), data=data).prior.takes_context
    blind = PriorModel(lambda n, **size: MarkovPrior(n, 1, **size), use_context=False, data=data)
    assert not blind.prior.takes_context


def test_ends_are_added_once(data_of):
    plans = drawn(40)
    assert data_of(plans).plans.end is None
    assert data_of(plans, end=True).plans.end == 3
    closed = plans.with_end()
    assert data_of(closed, end=True).plans.num_actions == closed.num_actions


def test_collected_plans_have_the_context_that_was_asked_for():
    world = gridworld(3, 3, num_worlds=4)
    for context, shape in ((None, None), ("plan", (20,)), ("step", (20, 2))):
        data = PlansData(world=world, planner=ExhaustivePlanner(2), num_plans=20, context=context)
        own = data.source.context
        assert (None if own is None else tuple(own.shape)) == shape
    with refuses("either --data.file, or both"):
        PlansData(world=world)


def test_two_long_plans_are_folds_and_the_end_of_the_longer_is_for_validation(data_of):
    actions = torch.arange(2 * 300).view(2, 300) % 7
    data = data_of(Plans(actions, 7, torch.tensor([200, 300])))
    assert data.folds == 2
    assert data.held_out.mask().sum() == 500
    assert data.learned_from.mask().sum(1).tolist() == [200, 250]
    assert data.chosen_on.actions[0, :50].equal(data.plans.actions[1, 250:])
    assert data.chosen_on.mask().sum() == 50
    with refuses("2 plans cannot be split in three", "3 plans", "2 of at least 100 actions"):
        data_of(Plans(actions, 7, torch.tensor([99, 300])))


def test_of_two_groups_some_plans_are_for_validation(data_of):
    plans = Plans(torch.arange(40 * 10).view(40, 10) % 7, 7, group=torch.arange(40) % 2)
    data = data_of(plans)
    assert data.folds == 2
    assert [len(part) for part in (data.learned_from, data.chosen_on, data.held_out)] == [36, 4, 40]


def test_of_two_unequal_groups_a_share_of_the_actions_is_for_validation(data_of):
    actions = torch.arange(3 * 2000).view(3, 2000) % 7
    plans = Plans(actions, 7, torch.tensor([2000, 100, 3]), group=torch.tensor([0, 1, 1]))
    for seed in range(4):
        data = data_of(plans, seed=seed)
        assert 100 <= data.chosen_on.mask().sum() <= 211
        assert data.learned_from.mask().sum() + data.chosen_on.mask().sum() == 2103
