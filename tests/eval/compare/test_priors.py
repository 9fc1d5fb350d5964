"""The priors of `eval compare`: chains with large contexts, networks, and saved priors whose actions have names."""

from dataclasses import replace
from itertools import permutations

import pytest
import torch

from eval.compare.priors import (
    MANY,
    ContextMarkov,
    Renumbered,
    chain,
    combined,
    context_sizes,
    digests,
    load_for,
    network,
)
from eval.worlds.contexts import ContextIndex
from eval.worlds.suite import TASKS
from neuroprior import ExhaustivePlanner, GRUPrior, MarkovPrior, Plans, Prior, collect, gridworld, save
from neuroprior.sampling import sample_in_world
from neuroprior.worlds import local_view, maze
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import every_plan, refuses, seeded

NAMES = ("up", "right", "down")


def small(seed: int):
    """Small mazes, of which eight squares are observed."""
    return maze(5, 5, num_layouts=3, egocentric=True, view=1, seed=seed)


def test_contexts_have_numbers():
    features = torch.randint(2, (500, 24), generator=seeded(0)).float()
    index = ContextIndex(features[:300])
    _, which = features[:300].unique(dim=0, return_inverse=True)
    number = index(features)
    assert index.size == int(which.max()) + 2
    same = which[:, None] == which
    assert torch.equal(number[:300, None] == number[:300], same)
    known = (features[300:, None] == features[:300]).all(-1).any(1)
    assert torch.equal(number[300:] == index.size - 1, ~known)
    assert torch.equal(index(features.view(5, 100, 24)), number.view(5, 100))


def test_chains_have_the_context_of_networks():
    """A chain over features is a chain over the numbers of these features."""
    world = small(0)
    plans = collect(ExhaustivePlanner(3), world, 60, context="step", generator=seeded(0))
    assert context_sizes(world, plans) == {"context_size": 8}
    prior = chain(2, world, plans, ()).fit(plans)
    _, number = plans.context.flatten(0, 1).unique(dim=0, return_inverse=True)
    counted = replace(plans, context=number.view(60, 3))
    plain = MarkovPrior(3, 2, num_contexts=int(number.max()) + 1).fit(counted)
    predicted = prior.log_prob(Plans(plans.actions, prior.num_actions, context=plans.context))
    assert torch.allclose(
        predicted, plain.log_prob(Plans(counted.actions, plain.num_actions, context=counted.context)), atol=1e-5
    )
    assert torch.allclose(predicted, stepped(prior, plans), atol=1e-5)
    grid = gridworld(4, 4)
    plans = collect(ExhaustivePlanner(2), grid, 20, context="step")
    assert context_sizes(grid, plans) == {"num_contexts": 16}
    predicted = chain(1, grid, plans, ()).fit(plans).log_prob(plans)
    assert torch.allclose(predicted, MarkovPrior(4, 1, num_contexts=16).fit(plans).log_prob(plans))
    assert isinstance(chain(1, grid, replace(plans, context=None), ()), MarkovPrior)
    assert network("gru", grid, plans, 0).num_contexts == 16


@pytest.mark.parametrize("per", ["plan", "step"])
def test_in_new_contexts_a_chain_predicts_as_without_context(per):
    """Actions alternate in all contexts: they are predicted in contexts that never came, too."""
    actions = (torch.arange(6) + torch.arange(40)[:, None]) % 2
    context = torch.rand(40, 6, 3, generator=seeded(0))
    context = context[:, 0] if per == "plan" else context
    prior, plain = ContextMarkov(2, 2, context_size=3), MarkovPrior(2, 2).fit(actions)
    prior.fit(Plans(actions, 2, context=context))
    other = context + 5
    assert torch.allclose(
        prior.log_prob(Plans(actions, prior.num_actions, context=other)), plain.log_prob(actions), atol=1e-6
    )
    if per == "step":
        half = torch.where(torch.arange(6)[:, None] < 3, context, other)
        plans = Plans(actions, 2, context=half)
        assert torch.allclose(
            stepped(prior, plans), prior.log_prob(Plans(actions, prior.num_actions, context=half)), atol=1e-5
        )


def stepped(prior: Prior, plans: Plans) -> torch.Tensor:
    """Log-probabilities of whole plans, step by step."""
    logits, state = prior.start(len(plans), plans.context[:, 0])
    log_prob = torch.zeros(len(plans))
    for t in range(plans.max_length):
        action = plans.actions[:, t].long()
        log_prob += logits.log_softmax(-1).gather(1, action[:, None])[:, 0]
        if t + 1 < plans.max_length:
            logits, state = prior.step(action, state, plans.context[:, t + 1])
    return log_prob


def test_the_combined_prior_is_made_of_what_it_is_compared_with():
    """With a context that is new in each world: chains with it and without, and the network of the comparison."""
    world = small(0)
    plans = collect(ExhaustivePlanner(3), world, 60, context="step", generator=seeded(0))
    prior = combined(world, plans, (), 5)
    names = [type(expert).__name__ for expert in prior.experts]
    assert names == ["ContextMarkov"] * 5 + ["MarkovPrior"] * 5 + ["GRUPrior"]
    for _ in range(2):  # experts that were left out are fitted again
        prior.fit(plans, generator=seeded(0), max_steps=3, progress=False)
        assert prior.tried == len(names) + 2
    sampled, _ = sample_in_world(prior, world, world.reset(4, seeded(1)), 8, 3, generator=seeded(2))
    assert sampled.shape == (4, 8, 3)
    alone = combined(world, plans.without_context(), (), 5)
    assert [type(expert).__name__ for expert in alone.experts] == ["MarkovPrior"] * 5 + ["GRUPrior"]


def test_chains_choose_among_sets_of_features():
    """The eight squares around; with few plans, in which most large contexts are new, chains do better with no more."""
    task = TASKS["egocentric"]
    worlds = task.worlds(0)
    state = worlds.training.reset(200, seeded(0))
    nearest, beside = (worlds.training.observe(state)[:, list(features)] for features in task.feature_sets)
    assert torch.equal(nearest, local_view(worlds.training, 1)(state))
    assert torch.equal(beside, nearest[:, [1, 3, 4]])
    plans = collect(ExhaustivePlanner(4), worlds.training, 200, context="step", generator=seeded(0))
    known = {}
    for sets in ((), task.feature_sets):
        prior = ContextMarkov(3, 1, sets, context_size=24).fit(plans)
        known[sets] = prior.index.size
    assert known[task.feature_sets] < known[()] / 2
    # Where the second feature decides the action and the first does not, both are taken: four contexts, and new ones.
    context = torch.randint(2, (300, 4, 2), generator=seeded(2)).float()
    plans = Plans(context[..., 1].long(), 2, context=context)
    assert ContextMarkov(2, 0, ((0,),), context_size=2).fit(plans).index.size == 5
    assert ContextMarkov(2, 0, ((1,),), context_size=2).fit(plans).index.size == 3


def test_networks_with_many_features_are_wide():
    plans = Plans(torch.zeros(5, 3, dtype=torch.long), 3, context=torch.rand(5, 3, MANY))
    few = replace(plans, context=plans.context[..., 1:])
    world = small(0)
    assert [network("gru", world, one, 0).hidden_size for one in (plans, few)] == [128, 64]
    assert [network("transformer", world, one, 0).width for one in (plans, few)] == [128, 64]


def learned(names=NAMES, **more) -> Plans:
    plans = markov_plans(markov_probs(3, 1, 0), 40, 6, 1)
    return Plans(plans.actions, 3, action_names=names, **more)


def saved(tmp_path, prior, plans: Plans) -> str:
    how = {} if isinstance(prior, MarkovPrior) else {"max_steps": 5, "progress": False}
    return str(save(prior.fit(plans, **how), tmp_path / "prior"))


@pytest.mark.parametrize("order", list(permutations(range(3))))
@pytest.mark.parametrize("make", [lambda: MarkovPrior(3, 2), lambda: GRUPrior(3, 8)])
def test_actions_are_matched_by_their_names(make, order, tmp_path):
    prior = make()
    folder = saved(tmp_path, prior, learned())
    names = [NAMES[known] for known in order]
    found = load_for(folder, "maze", 3, names)
    assert isinstance(found, Renumbered) == (order != (0, 1, 2))
    assert found.action_names == tuple(names)
    plans = every_plan(3, 5)
    with torch.no_grad():
        want = prior.eval().log_prob(torch.tensor(order)[plans])
        torch.testing.assert_close(found.log_prob(plans), want)
        # the same by `start` and `step`
        torch.testing.assert_close(Prior.forward(found, plans), found(plans))


@pytest.mark.parametrize("per", ["plan", "step"])
def test_context_goes_to_the_prior(per, tmp_path):
    shape = (40,) if per == "plan" else (40, 6)
    plans = learned(context=torch.randint(25, shape, generator=seeded(2)))
    prior = MarkovPrior(3, 1, num_contexts=25)
    found = load_for(saved(tmp_path, prior, plans), "maze", 3, ("down", "up", "right"))
    assert (found.context_per, found.num_contexts) == (per, 25)
    some, contexts = every_plan(3, 3), torch.randint(25, (27,) if per == "plan" else (27, 3), generator=seeded(3))
    torch.testing.assert_close(
        found.log_prob(Plans(some, found.num_actions, context=contexts)),
        prior.log_prob(Plans(torch.tensor([2, 0, 1])[some], prior.num_actions, context=contexts)),
    )


def test_without_names_actions_are_matched_by_number(tmp_path):
    for names, of_world in ((None, ("a", "b", "c")), (NAMES, None)):
        prior = MarkovPrior(3, 1)
        found = load_for(saved(tmp_path, prior, learned(names)), "maze", 3, of_world)
        torch.testing.assert_close(found.log_prob(every_plan(3, 3)), prior.log_prob(every_plan(3, 3)))


def test_a_prior_that_does_not_fit_is_refused(tmp_path):
    folder = saved(tmp_path, MarkovPrior(3, 1), learned())
    with refuses(folder, "6 actions", "world taxi", "not 3"):
        load_for(folder, "taxi", 6, None)
    with refuses(folder, "'on'", "world maze", "up, right, down"):
        load_for(folder, "maze", 3, ("up", "on", "down"))
    with refuses("nowhere", "folders of saved priors", "--kinds"):
        load_for(str(tmp_path / "nowhere"), "maze", 3, None)
    ends = save(MarkovPrior(4, 1).fit(learned().with_end()), tmp_path / "ends")
    with refuses("ends", "end symbol", "--end"):
        load_for(str(ends), "maze", 4, None)
    with pytest.raises(NotImplementedError):
        load_for(folder, "maze", 3, NAMES[::-1]).fit(learned())


def test_another_model_in_the_same_folder_has_another_digest(tmp_path):
    folder = saved(tmp_path, MarkovPrior(3, 1), learned())
    before = digests([folder])
    assert before == digests([folder])
    saved(tmp_path, MarkovPrior(3, 2), learned())
    assert digests([folder]) != before
