"""Successive halving: no more rollouts than without it, and more of them for the better plans."""

import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neuroprior import SamplingPlanner, TabularWorld, UniformPrior
from neuroprior.planners import expected_score
from neuroprior.planners.rollouts import halved_scores, halving_rounds, mean_scores
from neuroprior.worlds.world import Rollout, World
from tests.support.sources import FALSE_ALARM, every_plan, p_value, seeded, stochastic_world


@given(num_plans=st.integers(1, 500), num_rollouts=st.integers(1, 50))
def test_rounds_share_the_rollouts_out(num_plans, num_rollouts):
    rounds = list(halving_rounds(num_plans, num_rollouts))
    assert rounds[0][0] == num_plans
    assert all(times >= 1 for _, times in rounds)
    assert sum(kept * times for kept, times in rounds) <= num_plans * num_rollouts
    assert all(after == -(-before // 2) for (before, _), (after, _) in itertools.pairwise(rounds))
    if num_rollouts > 10:
        assert rounds[-1][0] <= 2


@pytest.mark.parametrize("prefix", [False, True])
def test_scores_are_means_over_all_rollouts_of_the_plans_that_are_left(prefix):
    """Rewards are in [0, 1]: by Hoeffding a mean of 4,000 misses by 0.055 with probability 2 exp(-24)."""
    world, plans = stochastic_world(4, "WS"), every_plan(3, 3)
    state = torch.arange(10)
    planner = SamplingPlanner(UniformPrior(3), 3, 27, any_prefix=prefix)
    left, score, ends = halved_scores(planner, world, state, plans.expand(10, -1, -1), 4000, seeded(0))
    assert left.shape == (10, 2, 3)
    assert score.shape == ends.shape == ((10, 2, 3) if prefix else (10, 2))
    want = expected_score(world, state, left)
    found = score[..., -1] if prefix else score
    assert float((found - want).abs().max()) < 0.055
    if not prefix:
        everything = expected_score(world, state, plans.expand(10, -1, -1))
        assert (want.amax(1) > everything.amax(1) - 0.11).all()


class Turns(World):
    """Pays plans by a table with a row for each call of `rollout`: what they get in each round of halving."""

    num_actions, stochastic = 4, True

    def __init__(self, paid):
        self.paid = iter(paid)

    def reset(self, batch_size, generator=None):
        return torch.zeros(batch_size, dtype=torch.long)

    def step(self, state, action, generator=None):
        raise NotImplementedError

    def rollout(self, state, plans, generator=None, keep_states=False):
        return Rollout(state[:, None].expand(plans.shape[:2]), torch.tensor(next(self.paid))[plans.long()])


def test_all_rounds_count_by_their_rollouts():
    """Four plans of one action with four rollouts each: two rollouts of each, and four more of the better two."""
    world = Turns([[0.0, 9.0, 3.0, 0.0], [0.0, 0.0, 6.0, 0.0]])
    planner = SamplingPlanner(UniformPrior(4), 1, 4)
    left, score, _ = halved_scores(planner, world, world.reset(1), torch.arange(4).view(1, 4, 1), 4, seeded(0))
    found = dict(zip(left.flatten().tolist(), score.flatten().tolist(), strict=True))
    assert found == {1: pytest.approx(2 * 9 / 6), 2: pytest.approx((2 * 3 + 4 * 6) / 6)}


def test_of_equals_any_is_kept():
    """Which of four equal plans comes first among those that are left: chi-square over 4,000 starts."""
    world = Turns([[0.0] * 4] * 2)
    planner, plans = SamplingPlanner(UniformPrior(4), 1, 4), torch.arange(4).view(1, 4, 1).expand(4000, -1, -1)
    left, _, _ = halved_scores(planner, world, world.reset(4000), plans, 2, seeded(0))
    assert left.shape == (4000, 2, 1)
    assert p_value(left[:, 0], torch.ones(4)) > FALSE_ALARM


def test_steps_are_counted_and_in_a_deterministic_world_there_is_nothing_to_halve():
    world = stochastic_world(5, "WSAK")
    planner = SamplingPlanner(UniformPrior(3), 3, 20, num_rollouts=7, halving=True)
    taken, rollout = [], world.rollout
    world.rollout = lambda state, plans, *rest: taken.append(plans.numel()) or rollout(state, plans, *rest)
    assert planner.plan(world, torch.arange(1), seeded(0)).model_steps == sum(taken)
    certain = TabularWorld(torch.zeros(2, 3, dtype=torch.long), torch.ones(2))
    assert planner.plan(certain, torch.zeros(1, dtype=torch.long), seeded(0)).model_steps == 60


def test_a_single_round_is_the_plain_mean():
    world, state, plans = stochastic_world(6, "WS"), torch.arange(10), every_plan(3, 2).expand(10, -1, -1)
    planner = SamplingPlanner(UniformPrior(3), 2, 9)
    plain = mean_scores(planner, world, state, plans, 1, seeded(0))
    _, *halved = halved_scores(planner, world, state, plans, 1, seeded(0))
    for first, second in zip(plain, halved, strict=True):
        assert torch.equal(first, second)
