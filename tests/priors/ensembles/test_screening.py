"""Screening: networks are trained where they promise to bring something, and only there."""

from math import log2

import pytest
import torch

from neuroprior import Plans
from neuroprior.priors import GRUPrior
from neuroprior.priors.ensembles.candidates import counted, fitted_experts
from neuroprior.priors.ensembles.pooling import stack_forecasts
from neuroprior.priors.ensembles.screening import Screening, screen
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import seeded

SILENT = {"progress": False, "max_steps": 400}


def repeating(number: int, seed: int) -> Plans:
    """Plans of unequal lengths in which the ninth last action comes again: too long ago to be counted."""
    actions = torch.randint(3, (number, 9), generator=seeded(seed)).repeat(1, 4)
    changed = torch.rand(actions.shape, generator=seeded(seed + 1)) < 0.03
    actions = torch.where(changed, torch.randint(3, actions.shape, generator=seeded(seed + 2)), actions)
    return Plans(actions, 3, 30 + torch.arange(number) % 7)


@pytest.mark.parametrize(
    ("early", "late", "gain"), [(0.1, 0.3, 0.3 + 0.2 * log2(10)), (0.3, 0.1, 0.1), (-0.2, -0.1, -0.1 + 0.1 * log2(10))]
)
def test_gains_are_extrapolated_by_doublings(early, late, gain):
    assert Screening(early, late, 0.0).gain == pytest.approx(gain)
    assert Screening(early, late, gain - 1e-9).pays
    assert not Screening(early, late, gain + 1e-9).pays


def test_a_network_promises_what_counts_cannot_see():
    learned, held_out = repeating(200, 0), repeating(60, 3)
    forecasts = stack_forecasts(list(counted(learned, held_out, {})), held_out)
    network = GRUPrior(3)
    before = {name: values.clone() for name, values in network.state_dict().items()}
    promise = screen(network, forecasts, learned, held_out, SILENT)
    assert promise.pays
    assert promise.late > 0.01
    assert promise.doublings == 2  # two trainings of 50 steps, of 400 in all
    assert not network.sized
    assert all(torch.equal(values, network.state_dict()[name]) for name, values in before.items())


def test_a_network_that_pays_learns_as_without_screening():
    learned, held_out = repeating(200, 0), repeating(60, 3)
    made = [fitted_experts(learned, held_out, {}, "fast", seeded(5), SILENT, names) for names in (None, ["gru"])]
    first, second = (one.fitted[-1] for one in made)
    assert type(first) is GRUPrior
    assert not made[0].left_out
    assert torch.equal(first.log_prob(held_out), second.log_prob(held_out))


def test_no_network_is_trained_on_a_chain():
    probs = markov_probs(3, 1, seed=1)
    learned, held_out = (markov_plans(probs, number, 30, seed=number) for number in (300, 70))
    made = fitted_experts(learned, held_out, {}, "standard", seeded(0), SILENT)
    assert not any(isinstance(e, GRUPrior) for e in made.fitted)
    assert (list(made.networks), list(made.left_out)) == ([], ["gru"])
    assert all(promise.gain < promise.needed for promise in made.left_out.values())
    trained = fitted_experts(learned, held_out, {}, "standard", seeded(0), SILENT | {"max_steps": 9}, ["stacked"])
    assert tuple(trained.networks) == ("stacked",)
    assert len(trained.fitted) == len(made.fitted) + 1
