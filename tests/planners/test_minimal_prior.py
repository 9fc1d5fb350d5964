"""Three things are all that samplers and planners need of a prior: `num_actions`, `start` and `step`."""

import pytest
import torch

from neuroprior import MarkovPrior, MCTSPlanner, SamplingPlanner, UniformPrior
from neuroprior.planners import FrontierPlanner
from neuroprior.sampling import Steppable, sample, sample_in_world
from neuroprior.testing import check_planner
from tests.support.sources import random_world, refuses, seeded, stochastic_world


class Minimal:
    """A Markov chain that is no `Prior` and has nothing else."""

    def __init__(self, log_probs):
        self.num_actions = log_probs.shape[1]
        self.log_probs = log_probs  # [A + 1, A]: of the first action, and after each action

    def start(self, batch_size):
        return self.log_probs[:1].expand(batch_size, -1), torch.zeros(batch_size, 0)

    def step(self, action, state):
        return self.log_probs[action + 1], state


FITTED = MarkovPrior(3, 1).fit(torch.randint(3, (40, 6), generator=seeded(0)))
_first, _state = FITTED.start(1)
CHAIN: Steppable = Minimal(torch.cat([_first, FITTED.step(torch.arange(3), _state.expand(3, *_state.shape[1:]))[0]]))
WORLDS = {
    "all legal": random_world(0),
    "some legal": random_world(1, "WSA", legal=True),
    "stochastic": stochastic_world(0),
}


def same(first, second):
    """Whether two nested tuples have the same tensors and numbers."""
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(same, first, second))
    return first == second


@pytest.mark.parametrize("method", ["auto", "ancestral", "tree"])
def test_sampling(method):
    plans = [sample(prior, 500, 5, generator=seeded(1), method=method) for prior in (CHAIN, FITTED)]
    assert same(*plans)


@pytest.mark.parametrize("kind", WORLDS)
def test_sampling_in_a_world(kind):
    world = WORLDS[kind]
    state = world.reset(20, seeded(0))
    found = [sample_in_world(prior, world, state, 30, 4, generator=seeded(1)) for prior in (CHAIN, FITTED)]
    assert same(*found)


@pytest.mark.parametrize("kind", WORLDS)
@pytest.mark.parametrize(
    "kind_of_planner",
    [SamplingPlanner, FrontierPlanner, MCTSPlanner],
)
def test_planning(kind_of_planner, kind):
    world = WORLDS[kind]
    state = world.reset(20, seeded(0))
    if world.stochastic and kind_of_planner in (FrontierPlanner, MCTSPlanner):
        with refuses("deterministic"):
            kind_of_planner(CHAIN, 4, 12).plan(world, state)
        return
    planners = [kind_of_planner(prior, 4, 12, objective="return") for prior in (CHAIN, FITTED)]
    assert same(*(planner.plan(world, state, seeded(1)) for planner in planners))


@pytest.mark.parametrize("kind_of_planner", [SamplingPlanner, FrontierPlanner, MCTSPlanner])
def test_planners_conform_with_a_minimal_prior(kind_of_planner):
    def make(prior, length, num_plans):
        assert isinstance(prior, UniformPrior)
        return kind_of_planner(Minimal(torch.zeros(prior.num_actions + 1, prior.num_actions)), length, num_plans)

    check_planner(make)


def test_what_does_not_fit_is_refused():
    with refuses("context", "none"):
        sample(CHAIN, 10, 4, torch.zeros(10, dtype=torch.long))
    with refuses("must have 3 actions", "got 4"):
        SamplingPlanner(Minimal(torch.zeros(5, 4)), 3, 2).plan(random_world(0), torch.tensor([0]))


def test_a_prior_on_another_device_than_the_states_is_named():
    prior = Minimal(CHAIN.log_probs)
    prior.device = torch.device("cuda")
    world = WORLDS["all legal"]
    with refuses("it is on cuda", "the states on cpu"):
        SamplingPlanner(prior, 4, 8).plan(world, world.reset(3, seeded(0)))
