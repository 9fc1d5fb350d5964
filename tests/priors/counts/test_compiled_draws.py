"""Plans of chains that are drawn at once: their distribution, exactly and by chi-square tests, and when they are."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from neuroprior import ContextTreePrior, MarkovPrior, Plans, Prior
from neuroprior.priors.counts import compiled_draws as draws
from neuroprior.priors.counts import history_prior
from tests.support.sources import every_plan, fits, plan_number, refuses, seeded


@pytest.fixture(autouse=True)
def always(monkeypatch):
    monkeypatch.setattr(history_prior, "COMPILE_FROM", 1)


def plans(actions: int, number: int = 60, length: int = 7, contexts: int | None = None) -> Plans:
    drawn = torch.randint(actions, (number, length), generator=seeded(0)) * torch.randint(2, (number, length))
    context = None if contexts is None else torch.randint(contexts, (number,), generator=seeded(1))
    return Plans(drawn, actions, context=context)


@pytest.mark.parametrize("seed", range(20))
def test_tables_have_the_probabilities(seed):
    """Summed over the columns of the tables; also of runs that are nearly or quite impossible."""
    rng = np.random.default_rng(seed)
    probs = rng.dirichlet(np.full(37, rng.choice([0.01, 0.1, 1.0])), 5)
    probs[0] = np.eye(37)[3]
    probs[1] = 1 / 37
    probs[2, ::2] = 0
    probs /= probs.sum(1, keepdims=True)
    made = draws.tables(probs, np.zeros(probs.shape, np.int64), np.arange(37, dtype=np.uint8)[:, None])
    share, other = (made.cut >> np.uint64(32)) / 2**32, (made.cut & np.uint64(2**32 - 1)).astype(int)
    found = share.copy()
    for state in range(5):
        np.add.at(found[state], other[state], 1 - share[state])
    np.testing.assert_allclose(found / 37, probs, atol=1e-8)
    assert (found[probs == 0] == 0).all()


PRIORS: dict[str, Callable[[], Prior]] = {
    "order 0": lambda: MarkovPrior(3, 0).fit(plans(3)),
    "order 2": lambda: MarkovPrior(3, 2).fit(plans(3)),
    "order 3, lower": lambda: MarkovPrior(2, 3, initial="lower").fit(plans(2)),
    "two actions": lambda: MarkovPrior(2, 1).fit(plans(2)),
    "one action": lambda: MarkovPrior(1, 1).fit(plans(1)),
    "tree": lambda: ContextTreePrior(3, 3).fit(plans(3)),
    "untrained": lambda: MarkovPrior(3, 1),
    "impossible actions": lambda: _without(MarkovPrior(3, 2).fit(plans(3))),
}


def _without(prior: MarkovPrior) -> MarkovPrior:
    prior.log_probs[:, 1] = -torch.inf
    return prior


@pytest.mark.parametrize("length", [1, 3, 5])
@pytest.mark.parametrize("name", PRIORS)
@pytest.mark.parametrize("temperature", [1.0, 0.5])
def test_plans_have_the_distribution_of_the_prior(name, length, temperature):
    """Chi-square tests, each with a false alarm of 1e-6."""
    prior = PRIORS[name]()
    if temperature != 1:
        prior.log_probs.copy_((prior.log_probs / temperature).log_softmax(-1))
    probs = prior.log_prob(every_plan(prior.num_actions, length)).double().exp()
    if temperature != 1:  # as from the prior at a temperature of 1
        prior.log_probs.mul_(temperature)
    drawn = prior.sample(20_000, length, temperature=temperature, generator=seeded(2))
    assert drawn.shape == (20_000, length)
    assert drawn.dtype == torch.uint8
    assert probs[plan_number(drawn, prior.num_actions)].min() > 0
    assert prior.num_actions == 1 or fits(drawn, probs / probs.sum(), prior.num_actions)


def test_each_plan_has_its_context_and_its_past():
    prior = MarkovPrior(2, 2, num_contexts=3).fit(plans(2, contexts=3))
    context = torch.randint(3, (30_000,), generator=seeded(3))
    drawn = prior.sample(len(context), 3, context, past=torch.tensor([1, 0]), generator=seeded(2)).long()
    begun = torch.cat([torch.tensor([[1, 0]]).expand(8, -1), every_plan(2, 3)], 1)
    for number in range(3):
        each = Plans(begun, 2, context=torch.full((8,), number))
        probs = prior.action_log_probs(each)[:, 2:].sum(1).double().exp()
        assert fits(drawn[context == number], probs, 2)


@pytest.mark.parametrize(("actions", "dtype"), [(57, torch.uint8), (256, torch.uint8), (300, torch.int64)])
def test_many_actions(actions, dtype, monkeypatch):
    """The frequencies of single actions differ from their probabilities by less than six standard errors."""
    monkeypatch.setattr(history_prior, "LARGEST", 2**20)
    prior = MarkovPrior(actions, 1).fit(plans(actions, 400, 20))
    drawn = prior.sample(200_000, 2, generator=seeded(2))
    assert drawn.dtype == dtype
    first = prior.start(1)[0][0].double().softmax(-1)
    share = drawn[:, 0].long().bincount(minlength=actions) / len(drawn)
    assert ((share - first).abs() < 6 * (first / len(drawn)).sqrt() + 1e-9).all()
    after = prior.transition_matrix()[int(first.argmax())].double()
    second = drawn[drawn[:, 0] == int(first.argmax()), 1].long()
    share = second.bincount(minlength=actions) / len(second)
    assert ((share - after).abs() < 6 * (after / len(second)).sqrt() + 1e-9).all()


def test_the_same_seed_gives_the_same_plans_on_any_number_of_threads():
    prior, threads = MarkovPrior(4, 2).fit(plans(4)), torch.get_num_threads()
    try:
        drawn = []
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            drawn.append(prior.sample(20_000, 6, generator=seeded(5)))
    finally:
        torch.set_num_threads(threads)
    assert drawn[0].equal(drawn[1])
    assert drawn[0].equal(drawn[2])
    assert not drawn[0].equal(prior.sample(20_000, 6, generator=seeded(6)))
    assert drawn[0][:5000].equal(prior.sample(20_000, 6, generator=seeded(5))[:5000])


def test_parts_of_plans_are_independent():
    """Of two successive parts, plans at the same place agree as often as independent ones (a z-score below 6)."""
    prior, each = MarkovPrior(4, 0), draws.PLANS
    drawn = prior.sample(40 * each, 1, generator=seeded(1)).view(40, each)
    agree = (drawn[1:] == drawn[:-1]).double()
    assert abs(float(agree.mean()) - 0.25) < 6 * (0.25 * 0.75 / agree.numel()) ** 0.5


@pytest.mark.parametrize("how", ["tree", "ancestral", "end", "steps", "large", "few", "subclass"])
def test_other_plans_are_drawn_as_before(how, monkeypatch):
    """The compiled loop is not called."""
    monkeypatch.setattr(draws, "draw", None)
    prior: Prior = MarkovPrior(3, 2).fit(plans(3))
    if how in ("tree", "ancestral"):
        assert prior.sample(5000, 4, method=how).shape == (5000, 4)
        return
    context = None
    if how == "end":
        prior.end = 2
    elif how == "steps":
        prior = MarkovPrior(3, 2, num_contexts=2).fit(
            Plans(plans(3).actions, 3, context=torch.randint(2, (60, 7), generator=seeded(1)))
        )
        context = torch.randint(2, (5000, 4), generator=seeded(1))
    elif how == "large":
        monkeypatch.setattr(history_prior, "LARGEST", 10)
    elif how == "few":
        monkeypatch.setattr(history_prior, "COMPILE_FROM", 2**16)
    elif how == "subclass":
        step = MarkovPrior.step
        prior.__class__ = type("Mine", (MarkovPrior,), {"step": lambda self, *given: step(self, *given)})
    assert prior.sample(5000, 4, context).shape == (5000, 4)
    if how == "few":
        with pytest.raises(TypeError):
            prior.sample(50_000, 4)


def test_tables_of_numbers_that_are_none_are_refused():
    prior = MarkovPrior(3, 2).fit(plans(3))
    prior.log_probs[:] = torch.nan
    with refuses("its logits are NaN"):
        prior.sample(20_000, 4)
