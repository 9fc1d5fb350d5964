"""Synergies: what lies near a plane, and what is kept with all components."""

import pytest
import torch

from eval.control.synergies import StepSynergies
from neuroprior.control import AutoregressivePrior, VectorPlans
from neuroprior.testing import check_prior
from tests.support.sources import seeded
from tests.support.vectors import walks


def test_it_is_a_prior():
    check_prior(StepSynergies([-1.0] * 2, [1.0] * 2, 1).fit(walks(12, 40, 2, 0)))


def test_beside_one_synergy_is_white_noise():
    """Three dimensions are driven by one signal."""
    phase = 6.28 * torch.rand(50, 1, generator=seeded(0)) + 0.5 * torch.arange(60)
    pattern = torch.tensor([0.5, -0.3, 0.4])
    values = torch.sin(phase)[..., None] * pattern + 0.01 * torch.randn(50, 60, 3, generator=seeded(1))
    plans = VectorPlans(values, -torch.ones(3), torch.ones(3))
    one = StepSynergies(plans.action_low, plans.action_high, 1).fit(plans)
    drawn = one.sample(2000, 2, generator=seeded(1))[0].flatten(0, 1)
    along = (drawn - drawn.mean(0)) @ (pattern / pattern.norm())
    assert float(drawn.var(0).sum() - along.var()) == pytest.approx(2 * 0.01**2, rel=0.1)


def test_all_synergies_are_the_autoregression():
    """With every component kept, both are the same regression on the same windows, but for a ridge."""
    plans = walks(30, 60, 2, 0)
    ends = plans.action_low, plans.action_high
    synergies, chain = StepSynergies(*ends, 2).fit(plans), AutoregressivePrior(*ends, 1).fit(plans, generator=seeded(0))
    nats = [each.action_log_probs(plans)[:, 1:].mean() for each in (synergies, chain)]
    assert abs(float(nats[0] - nats[1])) < 0.01


def test_plans_of_few_vectors_do_not_run_away():
    """By chance, the recursions of some of these would grow exponentially."""
    for seed in range(8):
        plans = walks(2, 25, 4, seed)
        prior = StepSynergies(plans.action_low, plans.action_high).fit(plans, generator=seeded(0))
        drawn = prior.sample(100, 50, generator=seeded(1))[0]
        assert (drawn[:, 30:].std((0, 1)) < 3 * plans.actions.std((0, 1))).all(), seed
        assert (drawn.abs() == 1).float().mean() < 0.01
