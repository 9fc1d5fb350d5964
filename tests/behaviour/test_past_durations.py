"""Durations of past actions as a context: their values, what they never hold, and priors that take them."""

from math import exp, log, nan

import pytest
import torch

from neuroprior.behaviour import PastDurations
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.plans import Plans
from neuroprior.priors import GRUPrior, load, match_plans, save
from tests.support.sources import refuses, seeded

ACTIONS = torch.tensor([[0, 1, 2, 1], [1, 0, 0, 0]])
DURATIONS = torch.tensor([[1.0, exp(2), nan, 5.0], [0.0, 3.0, 9.0, 9.0]])
PLANS = RecordedPlans(ACTIONS, 3, torch.tensor([4, 2]), durations=DURATIONS)


def test_the_features_of_each_step():
    """The standardised logarithm of the last duration and whether it is unknown; then those of the one before."""
    found = PastDurations(2, center=1.0, spread=2.0).added_to(PLANS).context
    assert found[0].tolist() == [
        [0, 1, 0, 1],
        [-0.5, 0, 0, 1],
        pytest.approx([0.5, 0, -0.5, 0]),
        pytest.approx([0, 1, 0.5, 0]),
    ]
    assert found[1, :2].tolist() == [[0, 1, 0, 1], [-4, 0, 0, 1]]  # 0 takes as long as the least that is told apart


def test_the_end_takes_no_time():
    """Whatever stands there as the duration of an end symbol is none of an action."""
    actions, times = torch.tensor([[0, 1, 2], [1, 0, 2]]), torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    ended = RecordedPlans(actions, 3, end=2, durations=times)
    assert PastDurations.of(ended) == PastDurations.of(RecordedPlans(actions[:, :2], 3, durations=times[:, :2]))


@pytest.mark.parametrize("number", [1, 3])
def test_no_duration_is_known_before_its_action_is_chosen(number):
    """The context of step t is the same whatever the actions from t on take."""
    durations = torch.rand(5, 8, generator=seeded(0))
    plans = RecordedPlans(torch.zeros(5, 8, dtype=torch.long), 2, durations=durations)
    past = PastDurations.of(plans, number)
    for step in range(8):
        other = durations.clone()
        other[:, step:] = 100 * torch.rand(5, 8 - step, generator=seeded(step))
        changed = past.added_to(RecordedPlans(plans.actions, 2, durations=other)).context
        same = (changed == past.added_to(plans).context).all(2).all(0)
        assert same.tolist() == [t <= step for t in range(8)]


def test_the_constants_are_robust():
    times = torch.exp(torch.linspace(-1, 3, 401))
    times[-5:] = 1e9
    plans = RecordedPlans(torch.zeros(1, 401, dtype=torch.long), 1, durations=times[None])
    past = PastDurations.of(plans)
    assert (past.center, past.spread) == pytest.approx((1, 2 / 1.349), abs=1e-3)
    constant = RecordedPlans(ACTIONS, 3, durations=torch.full((2, 4), 7.0))
    assert PastDurations.of(constant).spread == 1
    assert PastDurations.of(constant.with_end()) == PastDurations.of(constant)


def test_the_constants_by_hand():
    """The quartiles of log 1, log 3, log 5 and 2 are the second and third: durations of 0 and unknown ones are none."""
    past = PastDurations.of(PLANS, 3)
    assert (past.number, past.center) == (3, pytest.approx(log(5)))
    assert past.spread == pytest.approx((log(5) - log(3)) / 1.349)


def test_they_stand_behind_other_features():
    past = PastDurations(1, 0.0, 1.0)
    features = torch.tensor([[5.0, 6.0], [7.0, 8.0]])
    once = past.added_to(RecordedPlans(ACTIONS, 3, durations=DURATIONS.nan_to_num(), context=features)).context
    assert once.shape == (2, 4, 4)
    assert once[:, :, :2].equal(features[:, None].expand(2, 4, 2))
    each = past.added_to(
        RecordedPlans(ACTIONS, 3, durations=DURATIONS.nan_to_num(), context=features[:, None].repeat(1, 4, 1))
    )
    assert each.context.equal(once)


def test_they_are_kept_beside_the_prior_that_was_trained_with_them(tmp_path):
    plans = RecordedPlans(ACTIONS.repeat(20, 1), 3, durations=DURATIONS.nan_to_num(1.0).repeat(20, 1))
    past = PastDurations.of(plans.with_end())
    prior = GRUPrior(4, 8, context_size=2)
    prior.fit(past.added_to(plans.with_end()), generator=seeded(0), max_steps=2, progress=False)
    again = load(save(prior, tmp_path))
    assert PastDurations.load(tmp_path) is None
    past.save(tmp_path)
    assert PastDurations.load(tmp_path) == past
    matched = past.added_to(match_plans(plans, again))
    assert again.log_prob(matched).equal(prior.log_prob(past.added_to(plans.with_end())))
    with refuses("durations: these plans have none"):
        past.added_to(match_plans(Plans(ACTIONS, 3), again))


@pytest.mark.parametrize("content", ["{", "[1]", '{"number": 1}', '{"number": 0, "center": 0.0, "spread": 1.0}'])
def test_a_damaged_file_is_named(content, tmp_path):
    (tmp_path / "past_durations.json").write_text(content)
    with refuses(f"{tmp_path / 'past_durations.json'}: damaged"):
        PastDurations.load(tmp_path)


def test_what_is_refused():
    with refuses("`number` must be an integer of at least 1"):
        PastDurations.of(PLANS, 0)
    with refuses("durations: these plans have none"):
        PastDurations.of(Plans(ACTIONS, 3))
    with refuses("at least one above 0"):
        PastDurations.of(RecordedPlans(ACTIONS, 3, durations=torch.zeros(2, 4)))
    index = RecordedPlans(ACTIONS, 3, durations=DURATIONS, context=torch.tensor([0, 1]))
    with refuses("an index cannot stand beside past durations"):
        PastDurations(1, 0.0, 1.0).added_to(index)
    with refuses("`center` must be between", "`spread` above 0"):
        PastDurations(1, nan, 1.0)
