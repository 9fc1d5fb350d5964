"""Plans for validation that are given: they stop a training, and nothing is learned from them."""

import pytest
import torch

from neuroprior import GRUPrior, Plans
from neuroprior.priors import StackedPrior
from neuroprior.training import Settings, train
from tests.support.sources import refuses, seeded

A = 3
PRIORS = {
    "gru": lambda: GRUPrior(A, 8, lags=2, dropout=0.2),
    "stacked": lambda: StackedPrior(A, 8, orders=(1,), depth=2),
}
BOTH = pytest.mark.parametrize("name", PRIORS)


def some(seed: int, number: int = 30) -> Plans:
    return Plans(torch.randint(A, (number, 6), generator=seeded(seed)), A)


def constant(action: int) -> Plans:
    return Plans(torch.full((20, 6), action), A)


def fitted(name: str, plans: Plans, validation: Plans, **settings: int):
    how = {"max_steps": 12, "check_every": 12, "learning_rate": 0.02, "progress": False} | settings
    return PRIORS[name]().fit(plans, validation=validation, generator=seeded(0), **how)


@BOTH
def test_nothing_is_learned_from_them(name):
    """With one validation, at the end, they make no difference; each of the plans that are learned from does."""
    plans = some(0)
    probs = fitted(name, plans, some(1))(plans.actions)
    assert probs.equal(fitted(name, plans, some(2, 5))(plans.actions))
    other = plans.actions.long()
    other[-1] = (other[-1] + 1) % A
    assert not probs.equal(fitted(name, Plans(other, A), some(1))(plans.actions))


@BOTH
def test_training_stops_where_they_are_predicted_best(name):
    """Plans of another action are predicted worse with each step: the weights of the first validation are kept."""
    first, last = (
        fitted(name, constant(0), constant(action), check_every=2, max_steps=40).log_prob(constant(0)).mean()
        for action in (1, 0)
    )
    assert float((last - first).detach()) > 0.01


def test_the_names_kept_are_those_of_the_plans_learned_from():
    named = Plans(some(0).actions, A, action_names=("a", "b", "c"))
    for name in PRIORS:
        assert fitted(name, named, some(1)).action_names == ("a", "b", "c")


@BOTH
def test_plans_that_are_no_validation_are_refused(name):
    plans = Plans(some(0).actions, A, action_names=("a", "b", "c"))
    with refuses("got 7"):
        fitted(name, plans, Plans(torch.zeros(4, 3, dtype=torch.long), 7))
    with refuses("validation", "action_names"):
        fitted(name, plans, Plans(plans.actions, A, action_names=("b", "a", "c")))
    with refuses("no validation plan has an action"):
        fitted(name, plans, Plans(plans.actions, A, lengths=torch.zeros(30, dtype=torch.long)))


def test_other_plans_are_refused_by_the_trainer_itself():
    plans, other = some(0), Plans(torch.zeros(4, 3, dtype=torch.long), 2)
    with refuses("`validation` must have 3 actions, got 2"):
        train(GRUPrior(A, 8), plans, Settings(validation=other, progress=False), 0)
