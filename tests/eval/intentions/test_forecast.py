"""The forecast against exact enumeration."""

from itertools import product
from math import sqrt

import torch
from scipy import stats

from eval.intentions.forecast import forecast
from neuroprior.priors import MarkovPrior, UniformPrior
from neuroprior.worlds import TabularWorld
from tests.support.sources import FALSE_ALARM, seeded

LEFT, RIGHT = (MarkovPrior(2).fit(torch.tensor(rows)) for rows in ([[0, 0, 0, 1]], [[1, 1, 0, 1]]))
PRIORS = [LEFT, UniformPrior(2), RIGHT]
RING = TabularWorld(torch.tensor([[3, 1], [0, 2], [1, 3], [2, 0]]), torch.zeros(4, 2))


def test_forecast():
    """On a ring of four cells: each share is within its exact sampling error of that over all plans of 3 actions."""
    state, number = torch.tensor([0, 2]), 4000
    posterior = torch.tensor([[0.7, 0.1, 0.2], [0.1, 0.2, 0.7]]).double()
    plans = torch.tensor(list(product(range(2), repeat=3)))
    probs = torch.stack([prior.log_prob(plans).double().exp() for prior in PRIORS], -1)  # [8, K]
    final = RING.rollout(state, plans.expand(2, 8, 3)).final_state
    hit = (final[..., None] == torch.arange(4)).double()  # [2, 8, 4]
    share = torch.einsum("bps,pk->bsk", hit, probs)
    exact = (share * posterior[:, None]).sum(-1)
    found = forecast(PRIORS, RING, state, posterior, 3, number, torch.arange(4), seeded(0))
    error = ((share * (1 - share)).clamp(min=0) * posterior[:, None] ** 2).sum(-1).div(number).sqrt()
    # Normal limits, over the 8 shares: FALSE_ALARM in all.
    limit = stats.norm.isf(FALSE_ALARM / 16)
    assert ((found - exact).abs() <= limit * error + 1e-6).all()
    assert float(error.max()) < 1 / (2 * sqrt(number))
