"""The priors of `eval compare`: sights by number, chains that see them, and networks."""

from dataclasses import replace

import pytest
import torch

from eval.compare import recipes as compare_priors
from eval.compare.context_markov import ContextMarkov, Sights
from eval.compare.recipes import chain, network, sizes_of
from eval.worlds.suite import TASKS
from neuroprior import ExhaustivePlanner, MarkovPrior, Plans, Prior, collect, gridworld
from neuroprior.worlds import local_view, maze
from tests.support.sources import seeded


def small(seed: int):
    """Small mazes, of which eight squares are seen."""
    return maze(5, 5, num_layouts=3, egocentric=True, view=1, seed=seed)


def test_sights_have_numbers():
    features = torch.randint(2, (500, 24), generator=seeded(0)).float()
    sights = Sights(features[:300])
    _, which = features[:300].unique(dim=0, return_inverse=True)
    number = sights(features)
    assert sights.number == int(which.max()) + 2
    same = which[:, None] == which
    assert torch.equal(number[:300, None] == number[:300], same)
    known = (features[300:, None] == features[:300]).all(-1).any(1)
    assert torch.equal(number[300:] == sights.number - 1, ~known)
    assert torch.equal(sights(features.view(5, 100, 24)), number.view(5, 100))


def test_counts_see_what_networks_see():
    """A chain over features is a chain over the numbers of these features."""
    world = small(0)
    plans = collect(ExhaustivePlanner(3), world, 60, context="step", generator=seeded(0))
    assert sizes_of(world, plans) == {"context_size": 8}
    prior = chain(2, world, plans, ()).fit(plans)
    _, number = plans.context.flatten(0, 1).unique(dim=0, return_inverse=True)
    counted = replace(plans, context=number.view(60, 3))
    plain = MarkovPrior(3, 2, num_contexts=int(number.max()) + 1).fit(counted)
    told = prior.log_prob(plans)
    assert torch.allclose(told, plain.log_prob(counted), atol=1e-5)
    assert torch.allclose(told, stepped(prior, plans), atol=1e-5)
    grid = gridworld(4, 4)
    plans = collect(ExhaustivePlanner(2), grid, 20, context="step")
    assert sizes_of(grid, plans) == {"num_contexts": 16}
    told = chain(1, grid, plans, ()).fit(plans).log_prob(plans)
    assert torch.allclose(told, MarkovPrior(4, 1, num_contexts=16).fit(plans).log_prob(plans))
    assert isinstance(chain(1, grid, replace(plans, context=None), ()), MarkovPrior)
    assert network("gru", grid, plans, 0).num_contexts == 16


@pytest.mark.parametrize("per", ["plan", "step"])
def test_at_sights_never_met_a_chain_goes_on_blind(per):
    """Actions alternate, whatever is seen; where nothing seen was met, all is known of them still."""
    actions = (torch.arange(6) + torch.arange(40)[:, None]) % 2
    seen = torch.rand(40, 6, 3, generator=seeded(0))
    seen = seen[:, 0] if per == "plan" else seen
    prior, blind = ContextMarkov(2, 2, context_size=3), MarkovPrior(2, 2).fit(actions)
    prior.fit(Plans(actions, 2, context=seen))
    other = seen + 5
    assert torch.allclose(prior.log_prob(Plans(actions, 2, context=other)), blind.log_prob(actions), atol=1e-6)
    if per == "step":
        half = torch.where(torch.arange(6)[:, None] < 3, seen, other)
        plans = Plans(actions, 2, context=half)
        assert torch.allclose(stepped(prior, plans), prior.log_prob(plans), atol=1e-5)


def stepped(prior: Prior, plans: Plans) -> torch.Tensor:
    """Log-probabilities of whole plans, step by step."""
    logits, state = prior.start(len(plans), plans.context[:, 0])
    told = torch.zeros(len(plans))
    for t in range(plans.max_length):
        action = plans.actions[:, t].long()
        told += logits.log_softmax(-1).gather(1, action[:, None])[:, 0]
        if t + 1 < plans.max_length:
            logits, state = prior.step(action, state, plans.context[:, t + 1])
    return told


def test_chains_may_see_what_is_near_alone():
    """The eight squares around; with few plans, in which large sights are new, chains do better to see no more."""
    task = TASKS["egocentric"]
    worlds = task.worlds(0)
    state = worlds.training.reset(200, seeded(0))
    nearest, beside = (worlds.training.observe(state)[:, list(near)] for near in task.near)
    assert torch.equal(nearest, local_view(worlds.training, 1)(state))
    assert torch.equal(beside, nearest[:, [1, 3, 4]])
    plans = collect(ExhaustivePlanner(4), worlds.training, 200, context="step", generator=seeded(0))
    known = {}
    for near in ((), task.near):
        prior = ContextMarkov(3, 1, near, context_size=24).fit(plans)
        known[near] = prior.sights.number
    assert known[task.near] < known[()] / 2
    # Where what is far tells the action and what is near does not, all is seen: four sights, and those never met.
    seen = torch.randint(2, (300, 4, 2), generator=seeded(2)).float()
    far = Plans(seen[..., 1].long(), 2, context=seen)
    assert ContextMarkov(2, 0, ((0,),), context_size=2).fit(far).sights.number == 5
    assert ContextMarkov(2, 0, ((1,),), context_size=2).fit(far).sights.number == 3


def test_networks_that_see_much_are_wide():
    plans = Plans(torch.zeros(5, 3, dtype=torch.long), 3, context=torch.rand(5, 3, compare_priors.MANY))
    few = replace(plans, context=plans.context[..., 1:])
    world = small(0)
    assert [network("gru", world, one, 0).hidden_size for one in (plans, few)] == [128, 64]
    assert [network("transformer", world, one, 0).width for one in (plans, few)] == [128, 64]


def test_a_gru_of_the_comparison_goes_on_with_its_memory():
    prior = compare_priors.UnlimitedGRU(3, 8).fit(
        torch.randint(3, (40, 4), generator=seeded(0)), max_steps=2, progress=False
    )
    assert prior.window is None
    _, state = prior.start(2)
    for _ in range(10):
        _, state = prior.step(torch.zeros(2, dtype=torch.long), state)
    assert state.dim() == 2
