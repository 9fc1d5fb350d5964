"""Samples without replacement have the distribution that enumeration gives; the most probable plans are exact."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import GRUPrior, MarkovPrior, Plans, TransformerPrior, UniformPrior
from neuroprior.sampling import most_probable, sample_distinct, sample_distinct_in_world
from tests.support.sources import (
    FALSE_ALARM,
    TablePrior,
    distribution,
    fits,
    in_world_distribution,
    p_value,
    plan_number,
    random_world,
    refuses,
    seeded,
    stochastic_world,
)

MANY = 20_000


def one_after_another(probs: torch.Tensor, number: int) -> torch.Tensor:
    """`[M**number]`: the probability of each sequence of draws without replacement from `probs [M]`."""
    found = []
    for drawn in itertools.product(range(len(probs)), repeat=number):
        p, left = 1.0, 1.0
        for one in drawn:
            p, left = p * float(probs[one]) / left if left > 1e-15 else 0.0, left - float(probs[one])
        found.append(p if len(set(drawn)) == number else 0.0)
    return torch.tensor(found, dtype=torch.double)


@pytest.mark.parametrize("temperature", [1.0, 2.0])
def test_plans_are_drawn_one_after_another(temperature):
    prior = TablePrior.random(2, 4)
    probs = distribution(prior, 4, temperature=temperature)
    # Three beams, of which some are dropped from the second step on.
    found = sample_distinct(prior, 2, 4, num_sets=MANY, temperature=temperature, generator=seeded(0))
    number = plan_number(found.plans, 2)
    assert p_value((number * torch.tensor([16, 1])).sum(-1), one_after_another(probs, 2)) > FALSE_ALARM
    assert torch.allclose(found.log_prob, probs[number].log())


def test_each_distribution_has_its_context():
    prior = TablePrior.random(3, 2, num_contexts=2)
    context = torch.arange(2).repeat_interleave(MANY)
    found = sample_distinct(prior, 2, 2, context, generator=seeded(0))
    for number, plans in enumerate(found.plans.split(MANY)):
        probs = distribution(prior, 2, torch.tensor(number))
        pair = (plan_number(plans, 3) * torch.tensor([9, 1])).sum(-1)
        assert p_value(pair, one_after_another(probs, 2)) > FALSE_ALARM


@pytest.mark.parametrize("num_plans", [1, 5])
def test_inclusion_gives_means_without_bias(num_plans):
    """Six standard errors: a false alarm in five hundred million."""
    prior = TablePrior.random(3, 4)
    probs = distribution(prior, 4)
    value = torch.rand(81, generator=seeded(1), dtype=torch.double)
    found = sample_distinct(prior, num_plans, 4, num_sets=MANY, generator=seeded(0))
    estimate = (value[plan_number(found.plans, 3)] * found.log_prob.exp() / found.inclusion).sum(1)
    assert abs(float(estimate.mean() - (value * probs).sum())) < 6 * float(estimate.std()) / MANY**0.5
    assert float(estimate.std()) > 0


@pytest.mark.parametrize("kind", [UniformPrior, MarkovPrior, GRUPrior, TransformerPrior])
def test_all_plans_are_all_there_is(kind):
    prior = kind(3)
    found = sample_distinct(prior, 27, 3, num_sets=4, generator=seeded(0))
    assert found.plans.dtype == torch.uint8
    for plans in found.plans:
        assert plan_number(plans, 3).unique().tolist() == list(range(27))
    assert torch.allclose(found.log_prob.exp().sum(1), torch.ones(4, dtype=torch.double), atol=1e-5)
    assert (found.inclusion == 1).all()
    few = sample_distinct(prior, 5, 3, num_sets=4, generator=seeded(0))
    assert ((few.inclusion > 0) & (few.inclusion < 1)).all()
    again = sample_distinct(prior, 5, 3, num_sets=4, generator=seeded(0))
    assert all(torch.equal(one, other) for one, other in zip(few, again, strict=True))


def test_what_is_impossible_is_told():
    """Of 27 plans 8 never have the first action; no other is a sample."""
    prior = TablePrior.random(3, 3)
    for logits in prior.logits:
        logits[..., 0] = -torch.inf
    found = sample_distinct(prior, 10, 3, num_sets=50, generator=seeded(0))
    there = found.log_prob > -torch.inf
    assert (there.sum(1) == 8).all()
    assert (there[:, :8]).all()
    assert (found.plans[there] > 0).all()
    assert (found.inclusion == there.double()).all()
    with refuses("num_plans", "only 8 plans"):
        most_probable(prior, 9, 3)
    assert len(most_probable(prior, 8, 3)[0][0].unique(dim=0)) == 8


@pytest.mark.parametrize("legal", [False, True])
@pytest.mark.parametrize(("per", "temperature"), [(None, 1.0), ("plan", 1.0), ("step", 2.0)])
def test_along_with_a_world(legal, per, temperature):
    world = random_world(3, "WSA", legal)
    prior = MarkovPrior(3, 1, num_contexts=None if per is None else 6)
    plans = torch.randint(3, (200, 4), generator=seeded(2))
    context = {None: None, "plan": plans[:, 0] + 3 * (plans[:, 1] > 0), "step": plans + 3 * (plans.roll(1, 1) > 0)}[per]
    prior.fit(Plans(plans, 3, context=context))
    start = 7
    state = torch.full((MANY // 4,), start)
    settings = {"temperature": temperature, "generator": seeded(0)}
    found, rollout = sample_distinct_in_world(prior, world, state, 3, 3, keep_states=True, **settings)
    probs = in_world_distribution(prior, world, start, 3, temperature)
    there = found.log_prob > -torch.inf
    assert fits(found.plans[:, 0], probs, 3)
    number = plan_number(found.plans, 3)
    assert torch.allclose(found.log_prob[there].exp(), probs[number[there]], atol=1e-6)
    want = world.rollout(state, found.plans, keep_states=True)
    for one, other in zip(rollout, want, strict=True):
        assert torch.equal(one[there], other[there])
    second = probs.clone()
    first = probs.argmax()
    second[first] = 0
    chosen = number[:, 0] == first
    assert p_value(number[chosen, 1], second / second.sum()) > FALSE_ALARM


@settings(deadline=None, max_examples=30)
@given(
    actions=st.integers(1, 3),
    length=st.integers(1, 4),
    batch=st.integers(1, 3),
    seed=st.integers(0, 99),
    share=st.floats(0, 1),
)
def test_the_most_probable_plans(actions, length, batch, seed, share):
    prior = TablePrior.random(actions, length, batch, seed)
    number = max(int(actions**length * share), 1)
    temperature = (0.5, 1.0, 2.0)[seed % 3]
    plans, log_prob = most_probable(prior, number, length, torch.arange(batch), temperature=temperature)
    for own, (mine, log_probs) in enumerate(zip(plans, log_prob, strict=True)):
        probs = distribution(prior, length, torch.tensor(own), temperature)
        assert len(mine.unique(dim=0)) == number
        assert torch.allclose(probs[plan_number(mine, actions)], log_probs.exp())
        assert torch.allclose(log_probs.exp(), probs.sort(descending=True).values[:number])


def test_the_greedy_plan_need_not_be_the_most_probable():
    """.6 goes on to 1/3 each, .4 to one plan."""
    first = torch.tensor([[[0.6, 0.4, 0.0]]]).log()
    second = torch.tensor([[[1 / 3, 1 / 3, 1 / 3], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]).log()
    plans, log_prob = most_probable(TablePrior([first, second]), 1, 2)
    assert plans.tolist() == [[[1, 0]]]
    assert float(log_prob.exp()) == pytest.approx(0.4)


def test_flat_distributions_have_too_many_plans_of_one_probability():
    with refuses("num_plans", "more than max_prefixes = 100 prefixes of 4 actions"):
        most_probable(UniformPrior(4), 3, 5, max_prefixes=100)


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"num_plans": 0}, "num_plans"),
        ({"num_plans": 10, "length": 2}, "only 9"),
        ({"length": 0}, "length"),
        ({"temperature": 0.0}, "temperature"),
        ({"num_sets": 0}, "num_sets"),
        ({"context": torch.zeros(2, dtype=torch.long)}, "context"),
    ],
)
def test_refuses(given, word):
    with refuses(word):
        sample_distinct(UniformPrior(3), **({"num_plans": 2, "length": 3} | given))


def test_refuses_contexts_a_step_and_sets_beside_contexts():
    prior = TablePrior.random(3, 2, num_contexts=2)
    for call in (sample_distinct, most_probable):
        with refuses("context", "one per set"):
            call(prior, 2, 2, torch.zeros(4, 2, dtype=torch.long))
    with refuses("num_sets"):
        sample_distinct(prior, 2, 2, torch.zeros(4, dtype=torch.long), num_sets=4)


def test_no_distributions():
    prior = TablePrior.random(3, 2, num_contexts=2)
    none = torch.zeros(0, dtype=torch.long)
    assert sample_distinct(prior, 4, 2, none).plans.shape == (0, 4, 2)
    assert most_probable(prior, 4, 2, none)[0].shape == (0, 4, 2)
    found, rollout = sample_distinct_in_world(UniformPrior(3), random_world(0), none, 4, 2, keep_states=True)
    assert found.plans.shape == rollout.rewards.shape == rollout.states.shape == (0, 4, 2)


def test_what_a_prior_says_after_the_impossible_does_not_count():
    """No number: as of a distribution whose logits are all minus infinity."""
    prior = TablePrior.random(3, 3)
    for logits in prior.logits:
        logits[..., 0] = -torch.inf
    prior.logits[1][:, 0], prior.logits[2][:, :3] = torch.nan, torch.nan
    found = sample_distinct(prior, 10, 3, num_sets=50, generator=seeded(0))
    assert ((found.log_prob > -torch.inf).sum(1) == 8).all()
    assert (found.log_prob[:, 8:] == -torch.inf).all()
    assert len(most_probable(prior, 8, 3)[0][0].unique(dim=0)) == 8


def test_refuses_in_worlds():
    world, state = random_world(0), torch.zeros(2, dtype=torch.long)
    with refuses("prior", "2 actions", "3"):
        sample_distinct_in_world(UniformPrior(2), world, state, 2, 3)
    with refuses("deterministic"):
        sample_distinct_in_world(UniformPrior(3), stochastic_world(0), state, 2, 3)
    with refuses("state"):
        sample_distinct_in_world(UniformPrior(3), world, state + 99, 2, 3)


def test_logits_that_are_no_numbers_are_refused():
    prior = TablePrior.random(3, 3)
    prior.logits[1][:, 0] = torch.nan
    for draw in (lambda: sample_distinct(prior, 5, 3, generator=seeded(0)), lambda: most_probable(prior, 5, 3)):
        with refuses("prior", "NaN"):
            draw()
