"""The stacked prior: its network's inputs, that experts forecast plans new to them, and what it gains."""

import math

import pytest
import torch

from neuroprior import MarkovPrior, Plans, load, save
from neuroprior.behaviour.analysis.comparison import score
from neuroprior.priors import StackedPrior
from neuroprior.priors.ensembles.stacked import LONG_AGO
from neuroprior.testing import check_prior
from tests.support.sources import seeded

A, C = 3, 4


def some_plans(num: int = 30, length: int = 12, per: str = "step", seed: int = 0) -> Plans:
    shape = (num,) if per == "plan" else (num, length)
    actions = torch.randint(A, (num, length), generator=seeded(seed))
    lengths = torch.randint(2, length + 1, (num,), generator=seeded(seed + 1))
    return Plans(actions, A, lengths, context=torch.randint(C, shape, generator=seeded(seed + 2)))


def fitted(plans: Plans, takes: bool, **settings) -> StackedPrior:
    prior = StackedPrior(A, 8, orders=(1, 2), depth=3, num_contexts=C if takes else None)
    return prior.fit(plans, generator=seeded(0), **({"max_steps": 10, "progress": False} | settings))


@pytest.mark.parametrize("takes", [False, True])
@pytest.mark.parametrize("per", ["plan", "step"])
def test_it_is_a_prior(takes, per):
    check_prior(fitted(some_plans(per=per), takes), 3, 2000)


def test_fresh_it_forecasts_the_experts_geometric_mean():
    prior = StackedPrior(A, 8, orders=(1, 2), depth=3, num_contexts=C)
    plans = some_plans()
    for expert in prior.experts:
        expert.fit(plans)
    actions, context = plans.actions[:5], plans.context[:5]
    with torch.no_grad():
        forecasts = [e(actions, context if e.takes_context else None) for e in prior.experts]
        expected = torch.stack(forecasts).mean(0).log_softmax(-1)
        assert prior(actions, context).log_softmax(-1).allclose(expected, atol=1e-5)


def test_its_input_is_how_long_ago_an_action_was_taken_here():
    """Against a search backwards; and the inputs when stepping against those of whole plans."""
    prior = fitted(some_plans(), True)
    plans = some_plans(6, 20, seed=5)
    actions, context = plans.actions.long(), plans.context
    forecasts = torch.zeros(6, 20, len(prior.experts), A)
    ago = prior._all_features(forecasts, actions, context)[..., -A:]
    for n in range(6):
        for t in range(20):
            for a in range(A):
                before = [s for s in range(t) if context[n, s] == context[n, t] and actions[n, s] == a]
                steps = t - before[-1] if before else LONG_AGO
                assert ago[n, t, a].item() == pytest.approx(math.log(steps + 1) * 2 / 3, abs=1e-5)
    _, state = prior.start(6, context[:, 0])
    for t in range(19):
        _, state = prior.step(actions[:, t], state, context[:, t + 1])
        _, _, since, here = state
        assert here.equal(context[:, t + 1])
        code = here[:, None] * A + torch.arange(A)
        assert ((since.gather(1, code) + 1).log() * 2 / 3).allclose(ago[:, t + 1], atol=1e-5)


@pytest.mark.parametrize("grouped", [False, True])
def test_experts_forecast_plans_that_they_did_not_learn_from(grouped):
    """Each plan (group) always does one thing that no other does: an expert that learned from it would predict it."""
    group = torch.arange(12) // 3 if grouped else None
    own = torch.arange(12)[:, None] if group is None else group[:, None]
    plans = Plans(own.expand(12, 20).clone(), 12, group=group)
    prior = StackedPrior(12, 8, orders=(0, 1), depth=2)
    forecasts = prior._forecasts(plans, seeded(0))
    predicted = forecasts.exp().gather(-1, plans.actions.long()[:, :, None, None].expand(-1, -1, len(prior.experts), 1))
    assert float(predicted[:, 0].max()) < 1 / 12 + 1e-6
    for expert in prior.experts:
        expert.fit(plans)
    assert float(prior.experts[1](plans.actions[:1])[0, 5].exp()[0]) > 0.5


def test_in_the_end_the_experts_learn_from_all_plans():
    plans = some_plans()
    own = Plans(plans.actions, A, plans.lengths)
    chain, *_ = fitted(plans, False).experts
    again = MarkovPrior(A, 1, 4.0, backoff="witten-bell").fit(own)
    assert chain.log_prob(own).equal(again.log_prob(own))


def memories(num: int, seed: int) -> Plans:
    """In one of four rooms, visited at random, an action is never the one that was last taken in this room."""
    generator = seeded(seed)
    context = torch.randint(C, (num, 60), generator=generator)
    shift = torch.randint(1, A, (num, 60), generator=generator)
    last = torch.randint(A, (num, C), generator=generator)
    actions = torch.zeros(num, 60, dtype=torch.long)
    row = torch.arange(num)
    for t in range(60):
        actions[:, t] = (last[row, context[:, t]] + shift[:, t]) % A
        last[row, context[:, t]] = actions[:, t]
    return Plans(actions, A, context=context)


def test_it_learns_what_counts_cannot_hold():
    """One bit is what an action holds, two choices; a chain of any order knows little of it."""
    training, held_out = memories(200, 0), memories(100, 1)
    stacked = StackedPrior(A, 32, 0.1, (1, 2), 3, num_contexts=C)
    stacked.fit(training, generator=seeded(0), max_steps=100, learning_rate=0.02, progress=False)
    mine = score("stacked", stacked, held_out).bits_per_action().mean
    chains = [MarkovPrior(A, order, num_contexts=C).fit(training) for order in range(4)]
    best = min(score("chain", chain, held_out).bits_per_action().mean for chain in chains)
    assert 1 < mine < 1.3  # 1 and what first visits of a room cost beyond
    assert best > 1.4


@pytest.mark.parametrize(
    ("plans", "word"),
    [
        (Plans(torch.zeros(0, 5, dtype=torch.long), A), "at least two actions"),
        (Plans(torch.zeros(1, 1, dtype=torch.long), A), "at least two actions"),
        (Plans(torch.zeros(4, 5, dtype=torch.long), 5), "got 5"),
    ],
)
def test_plans_that_it_cannot_learn_from(plans, word):
    with pytest.raises(ValueError, match=word):
        StackedPrior(A, 8).fit(plans)
    with pytest.raises(ValueError, match="context"):
        StackedPrior(A, 8, num_contexts=2).fit(torch.zeros(4, 5, dtype=torch.long))


@pytest.mark.slow
def test_its_layers_follow_from_its_first_plans_and_are_saved(tmp_path):
    short, long = some_plans(), some_plans(8, 40)
    brief, blind = (plans.without_context() for plans in (short, long))
    cases = (brief, None, 1), (blind, None, 2), (blind, 1, 1), (short, None, 1), (long, None, 1), (long, 2, 2)
    for number, (plans, given, expected) in enumerate(cases):
        contexts = C if plans.context is not None else None
        prior = StackedPrior(A, 8, orders=(1, 2), depth=3, num_contexts=contexts, num_layers=given)
        prior.fit(plans, generator=seeded(0), max_steps=2, progress=False)
        assert prior.mixer.num_layers == expected
        again = load(save(prior, tmp_path / str(number)))
        assert again.log_prob(plans).equal(prior.log_prob(plans))
        for one in (prior, again):  # what has learned keeps its layers
            one.fit(blind if contexts is None else long, generator=seeded(1), max_steps=2, progress=False)
            assert one.mixer.num_layers == expected
        assert again.log_prob(plans).equal(prior.log_prob(plans))
    check_prior(
        StackedPrior(A, 8, orders=(1, 2), num_layers=2).fit(short.without_context(), max_steps=5, progress=False),
        3,
        2000,
    )
