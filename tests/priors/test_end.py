"""The end-of-plan symbol: learned, scored and sampled by every prior as the end of a plan."""

from functools import cache

import pytest
import torch

from neuroprior import GRUPrior, MarkovPrior, Plans, SamplingPlanner, TransformerPrior, gridworld, load, sample, save
from neuroprior.testing import check_prior
from tests.support.sources import FALSE_ALARM, every_plan, p_value, plan_number, refuses, seeded

PRIORS = [lambda: MarkovPrior(3, 2), lambda: GRUPrior(3, 8), lambda: TransformerPrior(3, 16)]
QUICK = {"max_steps": 20, "progress": False}


def closed(num_plans: int = 2000) -> Plans:
    """Plans over two actions of 0 to 4 actions, all lengths as likely, closed by the end symbol 2."""
    actions = torch.randint(2, (num_plans, 4), generator=seeded(1))
    return Plans(actions, 2, lengths=torch.randint(5, (num_plans,), generator=seeded(2))).with_end()


@cache
def fitted(make):
    """The same one in all tests, which leave it as it is."""
    prior = make()
    return prior.fit(closed()) if isinstance(prior, MarkovPrior) else prior.fit(closed(), generator=seeded(0), **QUICK)


@pytest.mark.parametrize("make", PRIORS)
def test_conforms_and_survives_saving(make, tmp_path):
    prior = fitted(make)
    assert prior.end == 2
    check_prior(prior, length=4)
    assert load(save(prior, tmp_path / "prior")).end == 2


@pytest.mark.parametrize("make", PRIORS)
def test_probabilities_of_all_closed_plans_sum_to_one(make):
    prior = fitted(make)
    plans = every_plan(3, 4)
    log_prob = prior.log_prob(plans).detach().double()
    assert float(log_prob.exp().sum()) == pytest.approx(1, abs=1e-5)
    goes_on = ((plans[:, :-1] == 2) & (plans[:, 1:] != 2)).any(1)
    assert log_prob[goes_on].isneginf().all()
    assert log_prob[~goes_on].isfinite().all()


@pytest.mark.parametrize("method", ["tree", "ancestral"])
@pytest.mark.parametrize("make", PRIORS)
def test_samples_end_for_good(make, method):
    prior = fitted(make)
    plans = sample(prior, 20_000, 4, generator=seeded(3), method=method)
    assert not ((plans[:, :-1] == 2) & (plans[:, 1:] != 2)).any()
    probs = prior.log_prob(every_plan(3, 4)).detach().exp()
    assert p_value(plan_number(plans, 3), probs) > FALSE_ALARM


def test_what_comes_after_the_end_costs_nothing():
    prior = fitted(PRIORS[0])
    short = torch.tensor([[0, 1, 2]])
    padded = torch.tensor([[0, 1, 2, 2, 2]])
    assert torch.equal(prior.log_prob(short), prior.log_prob(padded))
    assert torch.equal(prior.log_prob(short), prior.log_prob(Plans(torch.tensor([[0, 1, 2, 0]]), 3, torch.tensor([3]))))


def test_a_planner_says_that_it_cannot_end_plans():
    world = gridworld(4, 4, edges="torus")
    prior = MarkovPrior(5, 1).fit(Plans(torch.randint(4, (50, 3), generator=seeded(0)), 4).with_end())
    with refuses("end symbol"):
        SamplingPlanner(prior, 3, 5).plan(world, world.reset(2))
