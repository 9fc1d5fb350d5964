"""Uniform shares, and how temperature and share are chosen: by enumeration, and in worlds with one good plan."""

from itertools import product

import pytest
import torch

from neuroprior import CombinedPrior, MarkovPrior, Plans, SamplingPlanner, TabularWorld, UniformPrior
from neuroprior.planners import best_sampling, proposers, search_weights
from neuroprior.planners.tuning import choices
from neuroprior.priors import MixturePrior
from neuroprior.testing import check_planner
from neuroprior.worlds import gridworld
from tests.support.sources import refuses, seeded, stochastic_world


def bandit(probability: float | None = None) -> TabularWorld:
    """One step: action 0 is rewarded, always or with a probability."""
    if probability is None:
        return TabularWorld(torch.zeros(1, 2, dtype=torch.long), torch.tensor([[[1.0, 0.0]]]))
    outcomes = torch.tensor([[[[1.0, 0.0], [0.0, 0.0]]]])
    chances = torch.tensor([[[probability, 1 - probability], [1.0, 0.0]]])
    return TabularWorld(torch.zeros(1, 2, 2, dtype=torch.long), outcomes, probability=chances)


def sure_of(action: int, order: int = 0) -> MarkovPrior:
    """Nearly sure that all actions are this one of two."""
    return MarkovPrior(2, order).fit(torch.tensor([[action] * 4] * 500 + [[1 - action] * 4]))


def candidates(planner: SamplingPlanner, world: TabularWorld, starts: int = 20) -> torch.Tensor:
    return planner.candidates(world, torch.zeros(starts, dtype=torch.long), seeded(0))[0]


def test_without_a_share_nothing_changes():
    world, prior = gridworld(6, 6), MarkovPrior(4, 1).fit(torch.randint(4, (50, 3), generator=seeded(0)))
    state = torch.arange(36)
    one, two = (
        SamplingPlanner(prior, 5, 8, **how).plan(world, state, seeded(1)) for how in ({}, {"uniform_share": 0.0})
    )
    assert torch.equal(one.plan, two.plan)
    # What is drawn from the prior comes first, and with the same numbers.
    few = candidates(SamplingPlanner(prior, 5, 1), world)
    more = candidates(SamplingPlanner(prior, 5, 2, uniform_share=0.5), world)
    assert torch.equal(few[:, 0], more[:, 0])


def test_a_share_conforms():
    check_planner(lambda prior, length, number: SamplingPlanner(prior, length, number, uniform_share=0.3))


@pytest.mark.parametrize("halving", [False, True])
@pytest.mark.parametrize("contexts", [None, 5])
def test_a_share_in_a_stochastic_world(contexts, halving):
    """All plans of a start meet the same random numbers: equal plans have equal scores, whoever drew them."""
    world, prior = stochastic_world(1, "WS"), MarkovPrior(3, 0, num_contexts=contexts)
    planner = SamplingPlanner(prior, 2, 60, num_rollouts=8, halving=halving, uniform_share=0.5)
    plans, score, _ = planner.candidates(world, torch.arange(10), seeded(0))
    number = plans.long() @ torch.tensor([3, 1])
    same = number[:, :, None] == number[:, None]
    assert float(((score[:, :, None] - score[:, None]).abs() * same).max()) == 0
    assert int(same.sum()) > plans.shape[:2].numel()


def test_uniform_plans_are_legal():
    """Where not all actions are legal, uniform plans take those alone that are."""
    legal = torch.tensor([[False, True]])
    world = TabularWorld(torch.zeros(1, 2, dtype=torch.long), torch.zeros(1, 1), legal_actions=legal)
    plans = candidates(SamplingPlanner(sure_of(0), 4, 10, uniform_share=0.5), world)
    assert bool((plans == 1).all())


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan"), "0.1", True])
def test_shares_out_of_range(share):
    with refuses("`uniform_share` must be a number from 0 to 1"):
        SamplingPlanner(UniformPrior(2), 1, 1, uniform_share=share)


def test_a_prior_that_is_wrong_needs_heat_or_uniform_plans():
    """The one that is right needs neither; of equals the first wins."""
    world, state = bandit(), torch.zeros(200, dtype=torch.long)
    wrong = best_sampling(
        sure_of(1), world, state, 1, 4, uniform_shares=(0, 0.5), temperatures=(1,), generator=seeded(0)
    )
    assert (wrong.temperature, wrong.uniform_share) == (1, 0.5)
    assert wrong.planner.uniform_share == 0.5
    # Two uniform plans and two that fail, but for 2 in 1,000: 3/4; four draws from 200 starts, 5 errors.
    assert wrong.scores[wrong.prior, 1, 0.5] == pytest.approx(0.75, abs=5 * (0.75 * 0.25 / 200) ** 0.5)
    assert wrong.scores[wrong.prior, 1, 0] < 0.1
    hot = best_sampling(sure_of(1), world, state, 1, 4, uniform_shares=(0,), generator=seeded(0))
    assert (hot.temperature, hot.planner.temperature) == (2.0, 2.0)
    right = best_sampling(sure_of(0), world, state, 1, 4, uniform_shares=(0, 1.0), generator=seeded(0))
    assert (right.temperature, right.uniform_share) == (1.0, 0)
    assert set(right.scores) == set(product([right.prior], (1.0, 1.5, 2.0), (0, 1.0)))


def test_an_expert_proposes_alone_where_the_mixture_is_wrong():
    """The mixture gives the expert that is right a weight of 1/1,000; alone it always finds the reward."""
    wrong, right = sure_of(1), sure_of(0)
    mixture = MixturePrior(2, [wrong, right])
    mixture.first = torch.tensor([0.999, 0.001]).log()
    assert proposers(mixture) == (mixture, *mixture.experts)
    assert proposers(right) == (right,)
    world, state = bandit(), torch.zeros(200, dtype=torch.long)
    how = {"temperatures": (1.0,), "uniform_shares": (0.0,), "generator": seeded(0)}
    found = best_sampling(mixture, world, state, 1, 4, **how)
    assert found.prior is mixture.experts[1]
    assert found.planner.prior is found.prior
    assert [one for one, _, _ in found.scores] == [mixture, *mixture.experts]
    assert found.scores[found.prior, 1.0, 0.0] > 0.95
    # Of equals the mixture itself comes first.
    alike = MixturePrior(2, [sure_of(0), sure_of(0)])
    assert best_sampling(alike, world, state, 1, 64, **how).prior is alike


def test_an_expert_that_was_left_out_proposes_where_it_is_right():
    """All plans of this world take action 1; in another world action 0 is rewarded, which an even chain tries."""
    flips = MarkovPrior(2, 0).fit(torch.tensor([[0, 1] * 2] * 500))
    prior = CombinedPrior(2, [flips, sure_of(1)])
    prior.learn_weights(Plans(torch.ones(200, 4, dtype=torch.long), 2))
    sure, even = prior.alternatives
    assert (list(prior.experts), list(prior.spare)) == ([sure], [even])
    assert proposers(prior) == (prior, sure, even)
    how = {"temperatures": (1.0,), "uniform_shares": (0.0,), "generator": seeded(0)}
    found = best_sampling(prior, bandit(), torch.zeros(200, dtype=torch.long), 1, 4, **how)
    assert found.prior is even
    assert found.scores[even, 1.0, 0.0] == pytest.approx(15 / 16, abs=5 * (15 / 16 / 16 / 200) ** 0.5)


def test_luck_does_not_win_in_a_stochastic_world():
    """Action 0 is worth 0.3, 1 nothing. Of 64 tries of it one succeeds, whichever setting: by new rollouts 0.3."""
    world, state = bandit(0.3), torch.zeros(400, dtype=torch.long)
    found = best_sampling(sure_of(0), world, state, 1, 64, temperatures=(1.0,), generator=seeded(0), objective="return")
    # A mean over 400 starts of one rollout each: 5 errors.
    assert list(found.scores.values()) == pytest.approx([0.3] * 3, abs=5 * (0.21 / 400) ** 0.5)


@pytest.mark.parametrize("rewards", [None, "WS"])
def test_best_sampling_takes_prefixes_and_contexts(rewards):
    world = gridworld(3, 3) if rewards is None else stochastic_world(1, rewards, actions=4)
    prior = MarkovPrior(4, 1, num_contexts=world.num_states)
    state = world.reset(30, seeded(0))
    first, again = (best_sampling(prior, world, state, 4, 10, generator=seeded(0), any_prefix=True) for _ in range(2))
    assert first.scores == again.scores
    assert len(first.scores) == 9
    whole = best_sampling(prior, world, state, 4, 10, generator=seeded(0))
    assert sum(whole.scores.values()) < sum(first.scores.values())


@pytest.mark.parametrize("at_once", [1, 30, 2**22])
def test_all_starts_count_however_they_are_divided(at_once, monkeypatch):
    """Each start stays where it is, and has a reward of its own: the score of every setting is their mean."""
    monkeypatch.setattr(SamplingPlanner, "steps_at_once", at_once)
    rewards = torch.tensor([0.0, 1.0, 5.0, 3.0, 2.0])
    world = TabularWorld(torch.arange(5)[:, None].expand(5, 2), rewards[None])
    found = best_sampling(UniformPrior(2), world, torch.arange(5), 2, 5, generator=seeded(0))
    assert len(found.scores) == 9
    assert list(found.scores.values()) == pytest.approx([2.2] * 9)


def test_choices_are_the_best_of_blocks():
    score = torch.tensor([[0.0, 3, 1, 2, 9, 4, 8]])
    assert choices(score, 4, 2, 0.0).tolist() == [[1, 3]]
    assert choices(score, 4, 2, 0.5).tolist() == [[4, 5, 6]]
    assert choices(score, 4, 3, 1.0).tolist() == [[4]]
    assert choices(score, 4, 7, 3 / 7).tolist() == [[4]]


def test_of_equal_scores_the_greatest_key_wins():
    score, keys = torch.tensor([[1.0, 2, 2, 0, 2, 1]]), torch.tensor([[0.9, 0.2, 0.5, 0.8, 0.7, 0.9]])
    assert choices(score, 4, 6, 2 / 6, keys).tolist() == [[4]]
    assert choices(score, 4, 3, 1 / 3, keys).tolist() == [[4, 2]]
    assert choices(score, 4, 6, 2 / 6).tolist() == [[1]]


@pytest.mark.parametrize("any_prefix", [False, True])
def test_in_a_stochastic_world_what_is_tuned_is_what_is_found(any_prefix):
    """The prior always takes the better of two actions, which pay with chances of .9 and .5: with one rollout, luck
    decides among candidates that seem equal, and those of the prior have no right of way.

    The false-alarm probability is below 1e-5: five standard deviations of the difference of two means.
    """
    after, chance_of = torch.tensor([[[0, 1]] * 2] * 2), torch.tensor([[[0.1, 0.9], [0.5, 0.5]]] * 2)
    world = TabularWorld(after, torch.tensor([[0.0, 1.0]]), probability=chance_of)
    prior = MarkovPrior(2, 0).fit(torch.zeros(400, 50, dtype=torch.long))
    starts, how = torch.zeros(16_000, dtype=torch.long), {"temperatures": (1.0,), "uniform_shares": (0.5,)}
    tuned = best_sampling(prior, world, starts, 1, 8, generator=seeded(0), any_prefix=any_prefix, **how)
    decision = SamplingPlanner(prior, 1, 8, uniform_share=0.5, any_prefix=any_prefix).plan(world, starts, seeded(1))
    found = torch.where(decision.plan[:, 0] == 0, 0.9, 0.5).mean()
    assert tuned.scores[prior, 1.0, 0.5] == pytest.approx(float(found), abs=5 * (0.25 / 16_000) ** 0.5)


@pytest.mark.parametrize("number", [1, 2, 64, 4096])
def test_weights_are_the_gradient(number):
    """Of -log(1 - (1 - p) ** P), with respect to log p."""
    log_prob = torch.tensor([-1e-3, -0.1, -0.5, -3.0, -9.0, -25.0], dtype=torch.float64, requires_grad=True)
    loss = -(-torch.expm1(number * torch.log1p(-log_prob.exp()))).log()
    (slope,) = torch.autograd.grad(loss.sum(), log_prob)
    assert torch.allclose(search_weights(log_prob.detach(), number), -slope, rtol=1e-7, atol=1e-12)


def test_weights_at_the_ends():
    ends = torch.tensor([0.0, -1000.0, -float("inf")])
    assert search_weights(ends, 64).tolist() == pytest.approx([0.0, 1.0, 1.0])
    assert search_weights(ends, 1).tolist() == pytest.approx([1.0, 1.0, 1.0])
