"""The end-of-plan symbol in the count-based priors beside the Markov chain: context trees and the uniform prior."""

import math

import pytest
import torch

from neuroprior import ContextTreePrior, Plans, Prior, SamplingPlanner, UniformPrior, gridworld, load, sample, save
from neuroprior.testing import check_prior
from tests.priors.test_end import closed
from tests.support.sources import FALSE_ALARM, every_plan, p_value, plan_number, refuses, seeded

PRIORS = {
    "tree": lambda: ContextTreePrior(3, 3),
    "papers": lambda: ContextTreePrior(3, 2, beta=0.5, alpha=0.5, base="uniform"),
    "uniform": lambda: UniformPrior(3),
}


def fitted(name: str) -> Prior:
    return PRIORS[name]().fit(closed())


def goes_on(plans: torch.Tensor) -> torch.Tensor:
    return ((plans[:, :-1] == 2) & (plans[:, 1:] != 2)).any(1)


@pytest.mark.parametrize("name", PRIORS)
def test_conforms_and_survives_saving(name, tmp_path):
    prior = fitted(name)
    assert prior.end == 2
    check_prior(prior, length=4)
    again = load(save(prior, tmp_path / "prior"))
    assert again.end == 2
    plans = every_plan(3, 4)
    assert torch.equal(again.log_prob(plans), prior.log_prob(plans))


@pytest.mark.parametrize("name", PRIORS)
def test_fitting_again_on_open_plans_forgets_the_end(name):
    prior = fitted(name).fit(Plans(torch.randint(3, (20, 4), generator=seeded(0)), 3))
    assert prior.end is None
    assert prior.log_prob(torch.tensor([[2, 0, 1]])).isfinite().all()


@pytest.mark.parametrize("name", PRIORS)
def test_probabilities_of_all_closed_plans_sum_to_one(name):
    plans = every_plan(3, 4)
    log_prob = fitted(name).log_prob(plans).double()
    assert float(log_prob.exp().sum()) == pytest.approx(1, abs=1e-5)
    assert log_prob[goes_on(plans)].isneginf().all()
    assert log_prob[~goes_on(plans)].isfinite().all()


@pytest.mark.parametrize("method", ["tree", "ancestral"])
@pytest.mark.parametrize("name", PRIORS)
def test_samples_end_for_good(name, method):
    prior = fitted(name)
    plans = sample(prior, 20_000, 4, generator=seeded(3), method=method)
    assert not goes_on(plans).any()
    assert p_value(plan_number(plans, 3), prior.log_prob(every_plan(3, 4)).exp()) > FALSE_ALARM


@pytest.mark.parametrize("name", PRIORS)
def test_what_comes_after_the_end_costs_nothing(name):
    prior = fitted(name)
    short = prior.log_prob(torch.tensor([[0, 1, 2]]))
    assert torch.equal(short, prior.log_prob(torch.tensor([[0, 1, 2, 2, 2]])))
    assert torch.equal(short, prior.log_prob(Plans(torch.tensor([[0, 1, 2, 0]]), 3, torch.tensor([3]))))


@pytest.mark.parametrize("name", PRIORS)
def test_a_planner_says_that_it_cannot_end_plans(name):
    world = gridworld(4, 4, edges="torus")
    make = {"tree": ContextTreePrior(5, 2), "papers": ContextTreePrior(5, 1, beta=0.5), "uniform": UniformPrior(5)}
    prior = make[name].fit(Plans(torch.randint(4, (50, 3), generator=seeded(0)), 4).with_end())
    with refuses("end symbol"):
        SamplingPlanner(prior, 3, 5).plan(world, world.reset(2))


def test_the_uniform_prior_takes_one_of_three_until_the_end():
    """An action, or the end, has probability 1 / 3 until the end; past it everything is certain."""
    prior = fitted("uniform")
    plans = every_plan(3, 4)
    ended = (plans == 2).int().cummax(1).values
    predicted = 4 - ended[:, :-1].sum(1)
    want = (-predicted * math.log(3)).masked_fill(goes_on(plans), -math.inf)
    torch.testing.assert_close(prior.log_prob(plans), want)


def test_a_context_tree_learns_how_long_plans_are():
    """Plans are 0 to 4 actions long, each as likely: after t actions one of 5 - t has ended, and 4 are never passed.

    The counts lean on few pseudo-counts: 0.01. What is left is the error of estimating a share from about 400 plans or
    more, a standard error of at most 0.026; of 5 such shares one is 5.3 of them off with a probability under 1e-6.
    """
    prior = ContextTreePrior(3, 4).fit(closed())
    every = every_plan(2, 4)
    ends = prior(torch.cat([every, every[:, :1]], 1)).softmax(-1)[..., 2]
    assert ends.shape == (16, 5)
    for t in range(5):
        assert float((ends[:, t].mean() - 1 / (5 - t)).abs()) < 5.3 * 0.026 + 0.01
    assert float(ends[:, 4].min()) > 0.9


def test_a_long_plan_ends_once():
    """The end is nothing that plans are read beyond, also where they are read in parts."""
    actions = torch.randint(2, (3, 1500), generator=seeded(4))
    prior = ContextTreePrior(3, 3).fit(Plans(actions, 2).with_end())
    padded = torch.cat([actions[:, :900], torch.full((3, 600), 2)], 1)
    short = torch.cat([actions[:, :900], torch.full((3, 1), 2)], 1)
    torch.testing.assert_close(prior.log_prob(padded), prior.log_prob(short))
    late = padded.clone()
    late[:, 1400] = 0
    assert prior.log_prob(late).isneginf().all()
    steps = prior.action_log_probs(Plans(padded, 3))
    assert float(steps[:, 901:].abs().max()) == 0


def test_the_end_with_contexts():
    """Plans of context 0 have one action, those of context 1 three."""
    context = torch.arange(400) % 2
    actions = torch.randint(2, (400, 3), generator=seeded(5))
    plans = Plans(actions, 2, lengths=1 + 2 * context, context=context).with_end()
    prior = ContextTreePrior(3, 4, num_contexts=2).fit(plans)
    assert prior.end == 2
    drawn = prior.sample(2000, 4, torch.arange(2000) % 2, generator=seeded(6))
    lengths = Plans(drawn, 3, end=2).without_end().lengths
    # each of 1,000 plans ends where it should with a probability of over 0.98; 940 is over 9 standard errors below
    for current, length in ((0, 1), (1, 3)):
        assert int((lengths[current::2] == length).sum()) > 940
    ends = prior(torch.tensor([[0, 1, 0, 1]] * 2), torch.arange(2)[:, None].expand(2, 4)).softmax(-1)[..., 2]
    assert float(ends[0, 1]) > 0.98
    assert float(ends[1, 3]) > 0.98
