"""Modes to start EM from: found where the average policy hides them, and the same in other plans."""

import pytest
import torch
from torch import Tensor

from neuroprior import Plans
from neuroprior.behaviour.analysis.modes import agreements
from neuroprior.priors import SwitchingPrior
from neuroprior.priors.switching.spectral_start import spectral_modes


def source(number: int, seed: int, length: int = 100) -> tuple[Plans, Tensor]:
    """Two modes that persist for 25 actions; at each of 12 places one takes action 0 and the other action 1.

    Which of them does is drawn anew for each place, so that neither takes either action oftener: all together take
    both equally often at each place, and nothing but their going together tells the modes apart.
    """
    generator = torch.Generator().manual_seed(seed)
    places = torch.randint(2, (12,), generator=torch.Generator().manual_seed(99))
    switched = torch.rand(number, length, generator=generator) < 1 / 25
    switched[:, 0] = torch.rand(number, generator=generator) < 0.5
    mode = switched.long().cumsum(1) % 2
    context = torch.randint(12, (number, length), generator=generator)
    wild = torch.rand(number, length, generator=generator) < 0.2
    actions = torch.where(wild, torch.randint(2, mode.shape, generator=generator), mode ^ places[context])
    return Plans(actions, 2, context=context), mode


def test_plans_may_be_of_unequal_lengths() -> None:
    plans, truth = source(60, 0)
    lengths = torch.randint(40, 101, (60,), generator=torch.Generator().manual_seed(1))
    found = spectral_modes(Plans(plans.actions, 2, lengths, context=plans.context), 2, 10.0, torch.Generator())
    assert found is not None
    mask = torch.arange(100) < lengths[:, None]
    same = float((found == truth)[mask].double().mean())
    assert max(same, 1 - same) > 0.85
    assert bool((found[~mask] == 0).all())


@pytest.mark.parametrize("order", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_priors_of_different_plans_learn_the_same_modes(order: int) -> None:
    """So that modes can be matched: three priors, each of plans of its own, agree about those of others."""
    plans, truth = source(40, 7)
    posteriors = []
    for seed in range(3):
        prior = SwitchingPrior(2, 2, order, 12, restarts=1).fit(source(40, seed)[0], generator=torch.Generator())
        posteriors.append(prior.posterior(plans).smoothed)
    known = torch.nn.functional.one_hot(truth, 2).double()
    for one in posteriors:
        assert float(agreements(posteriors[0], one, plans.mask()).min()) > 0.95
        assert float(agreements(known, one, plans.mask()).min()) > 0.8


@pytest.mark.parametrize("actions", [[[0, 0, 0]], [[0, 1, 0, 1]], [[1]]])
def test_no_modes_where_nothing_deviates(actions: list[list[int]]) -> None:
    plans = Plans(torch.tensor(actions), 2)
    assert spectral_modes(plans, 2, 10.0, torch.Generator()) is None
    SwitchingPrior(2, 2, 1).fit(plans, generator=torch.Generator().manual_seed(0))  # and the fit goes on without


def test_more_modes_than_deviations_can_tell() -> None:
    plans = Plans(torch.tensor([[0, 1, 1, 0, 0, 1]]), 2)
    assert spectral_modes(plans, 50, 10.0, torch.Generator()) is None
