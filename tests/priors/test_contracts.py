"""What holds for every prior: settings of `fit`, `repr`, plans or actions alone, and fitting in one call."""

from dataclasses import fields, replace
from functools import partial
from inspect import isabstract

import pytest
import torch
from torch.nn.functional import pad

from neuroprior import behaviour, priors
from neuroprior.behaviour import SemiMarkovPrior
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.plans import Plans
from neuroprior.priors import (
    AdaptivePrior,
    CombinedPrior,
    ContextTreePrior,
    GRUPrior,
    MarkovPrior,
    MixturePrior,
    Prior,
    StackedPrior,
    SwitchingPrior,
    TransformerPrior,
    UniformPrior,
    fit,
)
from neuroprior.priors.serialization import load, save
from neuroprior.training import Settings
from tests.support.sources import refuses, seeded

A, C = 3, 4
QUICK = {"max_steps": 2, "progress": False}
SETTINGS = {field.name for field in fields(Settings)}
COUNTS = {
    "uniform": lambda: UniformPrior(A),
    "markov": lambda: MarkovPrior(A, 2, smoothing=0.3, initial="lower", backoff="dirichlet"),
    "markov context": lambda: MarkovPrior(A, 1, num_contexts=C),
    "tree": lambda: ContextTreePrior(A, 3, beta=0.25, alpha=0.5, base="uniform"),
    "adaptive": lambda: AdaptivePrior(MarkovPrior(A, 1), [float("inf"), 2.0], 0.9),
    "adaptive context": lambda: AdaptivePrior(ContextTreePrior(A, 2, num_contexts=C), [1.5]),
    "semi-markov": lambda: SemiMarkovPrior(A, MarkovPrior(A, 2), laws=["gamma", "weibull"], transitions=False),
    "semi-markov context": lambda: SemiMarkovPrior(A, num_contexts=C),
}
NETWORKS = {
    "gru": lambda: GRUPrior(A, 8, num_layers=2, window=3, lags=2, dropout=0.1),
    "gru context": lambda: GRUPrior(A, 8, num_contexts=C),
    "transformer": lambda: TransformerPrior(A, 16, num_heads=2, context_size=2),
    "stacked": lambda: StackedPrior(A, 8, orders=(1, 2), depth=3, num_contexts=C),
    "mixture": lambda: MixturePrior(A, [MarkovPrior(A, 1), GRUPrior(A, 8)]),
    "nested mixture": lambda: MixturePrior(A, [MixturePrior(A, [StackedPrior(A, 8, depth=2)]), UniformPrior(A)]),
    "adaptive gru": lambda: AdaptivePrior(GRUPrior(A, 8, context_size=2), [4.0, 3.0]),
    "semi-markov gru": lambda: SemiMarkovPrior(A, GRUPrior(A, 8, context_size=2)),
    "combined": lambda: CombinedPrior(A, [MarkovPrior(A, 1), GRUPrior(A, 8)]),
}
SWITCHING = {
    "switching": lambda: SwitchingPrior(A, 2),
    "switching context": lambda: SwitchingPrior(A, 3, num_contexts=C),
}
ALL = COUNTS | NETWORKS | SWITCHING


def plans_for(prior: Prior, num: int = 40) -> RecordedPlans:
    """Plans of 0 to 7 actions, the last action commonest, in four groups of unlike sizes."""
    draws = seeded(0)
    actions = torch.multinomial(torch.tensor([0.2, 0.3, 0.5]), num * 7, replacement=True, generator=draws).view(num, 7)
    context = None
    if prior.num_contexts is not None:
        context = torch.randint(C, (num, 7), generator=draws)
    elif prior.context_size is not None:
        context = torch.randn(num, 7, 2, generator=draws)
    return RecordedPlans(
        actions,
        A,
        lengths=torch.randint(8, (num,), generator=draws),
        context=context,
        group=torch.tensor([1, 1, 4, 2, 4, 4, 9, 4]).repeat(-(-num // 8))[:num],
        durations=torch.rand(num, 7, generator=draws) + 0.1,
    )


def fitted(name: str, plans: RecordedPlans | None = None, seed: int = 0) -> Prior:
    """The prior of this name, after learning from plans."""
    prior = ALL[name]()
    quick = QUICK if name in NETWORKS else {}
    return prior.fit(plans_for(prior) if plans is None else plans, generator=seeded(seed), **quick)


def log_probs(prior: Prior, plans: Plans) -> torch.Tensor:
    """`[N, L]`: of each action of plans, and 0 behind their end."""
    with torch.no_grad():
        return prior.action_log_probs(plans).masked_fill(~plans.mask(), 0)


def widened(plans: RecordedPlans) -> RecordedPlans:
    """The same plans with three more columns of padding."""
    wider = {name: pad(getattr(plans, name), (0, 3)) for name in ("actions", "durations")}
    if plans.context is not None:
        one = plans.context.dim() == 3
        wider["context"] = pad(plans.context, (0, 0, 0, 3) if one else (0, 3))
    return replace(plans, **wider)


def test_no_prior_is_left_out():
    """A new class stands in the table, or in that of the tests of its wing."""
    exported = {getattr(room, name) for room in (priors, behaviour) for name in room.__all__}
    kinds = {kind for kind in exported if isinstance(kind, type) and issubclass(kind, Prior) and not isabstract(kind)}
    assert kinds == {type(make()) for make in ALL.values()}


@pytest.mark.parametrize("name", ALL)
def test_rows_do_not_depend_on_one_another_nor_on_padding(name):
    prior = fitted(name)
    plans = plans_for(prior)
    found = log_probs(prior, plans)
    assert bool((found.exp() <= 1 + 1e-6).all())
    assert found.std() > 0
    order = torch.randperm(len(plans), generator=seeded(3))
    torch.testing.assert_close(log_probs(prior, plans[order]), found[order])
    for row in (0, 7, 39):
        torch.testing.assert_close(log_probs(prior, plans[row : row + 1])[0], found[row], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(log_probs(prior, widened(plans))[:, :7], found)
    torch.testing.assert_close(log_probs(prior, replace(plans, group=plans.group * 3 + 5)), found)


@pytest.mark.parametrize("name", ALL)
def test_the_same_is_learned_whatever_groups_are_called_and_how_wide_the_padding_is(name):
    plans = plans_for(ALL[name]())
    first = log_probs(fitted(name), plans)
    torch.testing.assert_close(log_probs(fitted(name, plans), plans), first, rtol=0, atol=0)
    renamed = replace(plans, group=plans.group * 3 + 5)
    torch.testing.assert_close(log_probs(fitted(name, renamed), plans), first, rtol=0, atol=0)
    torch.testing.assert_close(log_probs(fitted(name, widened(plans)), plans), first)
    if name in COUNTS:
        order = torch.randperm(len(plans), generator=seeded(3))
        torch.testing.assert_close(log_probs(fitted(name, plans[order]), plans), first, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", ALL)
def test_a_saved_prior_predicts_the_same(name, tmp_path):
    prior = fitted(name)
    plans = plans_for(prior)
    again = load(save(prior, tmp_path))
    torch.testing.assert_close(log_probs(again, plans), log_probs(prior, plans), rtol=0, atol=0)


@pytest.mark.parametrize("name", ALL)
def test_repr_makes_a_prior_of_the_same_configuration(name):
    prior = ALL[name]()
    text = repr(prior)
    assert "\n" not in text
    assert (
        text.startswith(f"{type(prior).__name__}(num_actions={A}, ") or isinstance(prior, AdaptivePrior)
        if name != "uniform"
        else text == "UniformPrior(num_actions=3)"
    )
    again = eval(text, vars(priors) | vars(behaviour))
    assert type(again) is type(prior)
    assert again.config == prior.config
    assert repr(again) == text


def test_repr_by_hand():
    assert repr(MarkovPrior(4, 2, num_contexts=3)) == (
        "MarkovPrior(num_actions=4, order=2, smoothing=1.0, initial='joint', num_contexts=3, backoff='kneser-ney')"
    )
    mixture = MixturePrior(2, [UniformPrior(2), UniformPrior(2)])
    assert (
        repr(mixture)
        == "MixturePrior(num_actions=2, experts=[UniformPrior(num_actions=2), UniformPrior(num_actions=2)])"
    )


@pytest.mark.parametrize("name", COUNTS | NETWORKS)
def test_settings_of_fit(name):
    """All take a generator; networks take the settings of training, and priors that count take none."""
    prior = ALL[name]()
    plans = plans_for(prior)
    assert set(prior.fit_settings) == (SETTINGS if name in NETWORKS else set())
    with refuses("max_step", type(prior).__name__):
        prior.fit(plans, generator=seeded(0), max_step=3)
    if name in COUNTS:
        with refuses("max_steps", "takes none"):
            prior.fit(plans, max_steps=3)
        assert prior.fit(plans, generator=seeded(0)) is prior
    else:
        with refuses("learning_rate"):
            prior.fit(plans, learning_rate=-1.0)
        assert prior.fit(plans, generator=seeded(0), **QUICK) is prior


def test_a_mixture_that_counts_takes_the_share_for_its_weights_alone():
    prior = MixturePrior(A, [MarkovPrior(A, 1), UniformPrior(A)])
    assert prior.fit_settings == ("validation",)
    prior.fit(plans_for(prior), generator=seeded(0), validation=0.3)
    with refuses("max_steps"):
        prior.fit(plans_for(prior), max_steps=3)


@pytest.mark.parametrize("name", ["stacked", "mixture"])
def test_settings_reach_the_networks_inside(name):
    """The seed, the number of steps and the learning rate all change what is learned; the same ones give the same."""

    def weights(seed: int = 0, **settings: float) -> torch.Tensor:
        prior = ALL[name]()
        prior.fit(plans_for(prior), generator=seeded(seed), **(QUICK | settings))
        return torch.cat([weight.detach().flatten() for weight in prior.parameters()])

    first = weights()
    assert torch.equal(first, weights())
    assert not torch.equal(first, weights(seed=1))
    assert not torch.equal(first, weights(max_steps=4))
    assert not torch.equal(first, weights(learning_rate=1e-4))


@pytest.mark.parametrize("name", ["markov", "gru", "tree"])
def test_actions_alone_are_plans_without_context(name):
    prior = fitted(name)
    actions = plans_for(prior).actions
    for method in (prior.log_prob, prior.action_log_probs):
        assert torch.equal(method(actions.long()), method(Plans(actions, A)))
    with refuses("context"):
        MarkovPrior(A, 1, num_contexts=C).log_prob(actions)


def test_fit_makes_a_prior_for_the_plans():
    features = plans_for(NETWORKS["transformer"]())
    made = fit(features, partial(GRUPrior, hidden_size=8), generator=seeded(0), **QUICK)
    assert (made.hidden_size, made.context_size, made.num_contexts) == (8, 2, None)
    assert not fit(features, MarkovPrior).takes_context  # features cannot be counted
    named = Plans(features.actions, A, context=torch.zeros(40).long(), context_names=("a", "b"))
    assert (
        fit(named, lambda num_actions, num_contexts: MarkovPrior(num_actions, 2, num_contexts=num_contexts)).order == 2
    )
    assert fit(named, MarkovPrior).num_contexts == 2
    assert fit([[0, 1, 4]], MarkovPrior).num_actions == 5
    assert isinstance(fit(features.actions, generator=seeded(0), **QUICK), CombinedPrior)
    with refuses("markof", "context-tree"):
        fit(features, "markof")
    with refuses("max_steps", "MarkovPrior"):
        fit(features, "markov", max_steps=3)


@pytest.mark.parametrize(
    ("kind", "wrong", "word"),
    [
        (UniformPrior, {"num_actions": 0}, "num_actions"),
        (MarkovPrior, {"initial": "both"}, "initial"),
        (MarkovPrior, {"backoff": "good-turing"}, "backoff"),
        (ContextTreePrior, {"base": "prior"}, "base"),
        (ContextTreePrior, {"beta": 0}, "beta"),
        (ContextTreePrior, {"depth": 10**9}, "depth"),
        (GRUPrior, {"window": -1}, "window"),
        (TransformerPrior, {"window": 1.5}, "window"),
        (GRUPrior, {"context_size": 0}, "context_size"),
        (TransformerPrior, {"num_layers": 0}, "num_layers"),
        (GRUPrior, {"num_contexts": 2, "context_size": 2}, "not both"),
        (TransformerPrior, {"width": 10, "num_heads": 4}, "num_heads"),
        (TransformerPrior, {"width": 12, "num_heads": 4}, "num_heads"),
        (TransformerPrior, {"num_heads": 0}, "num_heads"),
        (SwitchingPrior, {"num_modes": 0}, "num_modes"),
        (SwitchingPrior, {"num_modes": 10**6}, "num_modes"),
        (SwitchingPrior, {"switching": "never"}, "switching"),
        (SwitchingPrior, {"phases": 0}, "phases"),
        (SwitchingPrior, {"folds": 0}, "folds"),
        (SwitchingPrior, {"restarts": 0}, "restarts"),
        (SwitchingPrior, {"max_iterations": 2.5}, "max_iterations"),
        (SwitchingPrior, {"tolerance": float("inf")}, "tolerance"),
    ],
)
def test_wrong_arguments_are_named(kind, wrong, word):
    """Of other numbers `tests/test_bad_numbers.py` says so."""
    with refuses(word):
        kind(**({"num_actions": 3} | wrong))
