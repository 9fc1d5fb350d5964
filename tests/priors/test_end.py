"""The end-of-plan symbol: learned, scored and sampled by every prior as the end of a plan."""

import math
from functools import cache

import pytest
import torch

from neuroprior import (
    ContextTreePrior,
    GRUPrior,
    MarkovPrior,
    Plans,
    Prior,
    SamplingPlanner,
    TransformerPrior,
    UniformPrior,
    gridworld,
    load,
    save,
)
from neuroprior.testing import check_prior
from tests.support.sources import every_plan, refuses, seeded

PRIORS = {
    "markov": lambda: MarkovPrior(3, 2),
    "gru": lambda: GRUPrior(3, 8),
    "transformer": lambda: TransformerPrior(3, 16),
    "tree": lambda: ContextTreePrior(3, 3),
    "papers": lambda: ContextTreePrior(3, 2, beta=0.5, alpha=0.5, base="uniform"),
    "uniform": lambda: UniformPrior(3),
}
QUICK = {"max_steps": 20, "progress": False}


@cache
def closed(num_plans: int = 2000) -> Plans:
    """Plans over two actions of 0 to 4 actions, all lengths as likely, closed by the end symbol 2."""
    actions = torch.randint(2, (num_plans, 4), generator=seeded(1))
    return Plans(actions, 2, lengths=torch.randint(5, (num_plans,), generator=seeded(2))).with_end()


def fitted(name: str) -> Prior:
    return PRIORS[name]().fit(closed(), generator=seeded(0), **(QUICK if name in ("gru", "transformer") else {}))


def goes_on(plans: torch.Tensor) -> torch.Tensor:
    return ((plans[:, :-1] == 2) & (plans[:, 1:] != 2)).any(1)


@pytest.mark.parametrize("name", PRIORS)
def test_nothing_comes_after_the_end_and_it_costs_nothing(name, tmp_path):
    """Of what can come, `check_prior` says that probabilities sum to one, and that samples are drawn from them."""
    prior = fitted(name)
    check_prior(prior, length=4)
    assert prior.end == load(save(prior, tmp_path / "prior")).end == 2
    plans = every_plan(3, 4)
    log_prob = prior.log_prob(plans)
    assert log_prob[goes_on(plans)].isneginf().all()
    assert log_prob[~goes_on(plans)].isfinite().all()
    short, rounding = prior.log_prob(torch.tensor([[0, 1, 2]])), 1e-6 if name in ("gru", "transformer") else 0
    for same in (torch.tensor([[0, 1, 2, 2, 2]]), Plans(torch.tensor([[0, 1, 2, 0]]), 3, torch.tensor([3]))):
        torch.testing.assert_close(prior.log_prob(same), short, atol=rounding, rtol=rounding)


@pytest.mark.parametrize("name", ["tree", "uniform"])
def test_fitting_again_on_open_plans_forgets_the_end(name):
    prior = fitted(name).fit(Plans(torch.randint(3, (20, 4), generator=seeded(0)), 3))
    assert prior.end is None
    assert prior.log_prob(torch.tensor([[2, 0, 1]])).isfinite().all()


def test_a_planner_says_that_it_cannot_end_plans():
    world = gridworld(4, 4, edges="torus")
    prior = MarkovPrior(5, 1).fit(Plans(torch.randint(4, (50, 3), generator=seeded(0)), 4).with_end())
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
