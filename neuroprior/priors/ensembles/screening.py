"""Screening: whether a network can pay is decided from a tenth of its training."""

from collections.abc import Mapping
from copy import deepcopy
from math import log2
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuroprior.plans import Plans
from neuroprior.priors.ensembles.pooling import NETWORK_GAIN_NATS, HeldOut, stack_forecasts
from neuroprior.priors.learning import plans_for
from neuroprior.priors.prior import Prior

PARTS, MIN_PART = 20, 50
"""A network is judged after one such part of the steps of its training, of at least so many steps, and after two."""


class Screening(NamedTuple):
    """What a network promises beyond other experts, in nats per held-out action.

    Attributes:
        early, late: its gains after one and after two parts of its training.
        needed: what it has to bring once it is trained, to be kept.
        doublings: how often the steps of two parts can be doubled until it is trained.
    """

    early: float
    late: float
    needed: float
    doublings: float = log2(PARTS / 2)

    @property
    def gain(self) -> float:
        """What it is expected to bring once it is trained.

        The gain is taken to grow with each doubling of the steps as it did with the last. Learning curves flatten, so
        that this is seldom too little.
        """
        return self.late + max(self.late - self.early, 0.0) * self.doublings

    @property
    def pays(self) -> bool:
        """Whether it is worth its training."""
        return self.gain >= self.needed


def screen(
    network: Prior,
    forecasts: Tensor,
    learned: Plans,
    held_out: Plans,
    settings: Mapping[str, Any],
) -> Screening | None:
    """Return what a network promises, from its gains in two short trainings; None where its training is as short.

    A gain is how much likelier held-out plans are when the network joins the mixture and the pool of other experts.

    Args:
        network: not trained yet; it stays so.
        forecasts: `[N, L, E, A]`, the log-probabilities of the other experts for the held-out plans.
        learned: plans to learn from.
        held_out: N plans of at most L actions.
        settings: of its training.
    """
    from neuroprior.training import Settings, planned_steps  # see `NeuralPrior.fit`

    plans, mask = plans_for(network, learned), held_out.mask()
    steps = planned_steps(plans, Settings(**{"validation": held_out, **settings}))
    trial_steps = max(steps // PARTS, MIN_PART)
    if steps < 4 * trial_steps:
        return None
    how = {"validation": held_out, **settings, "max_steps": trial_steps}
    losses, trial = [], deepcopy(network)
    generator = torch.Generator().manual_seed(0)
    for _ in range(2):  # the second training goes on from the weights of the first
        trial.fit(plans, generator=generator, **how)
        joined = torch.cat([forecasts, stack_forecasts([trial], held_out)], 2)
        losses.append(HeldOut(joined, held_out.actions, mask, joined.shape[2] + 2).combined()[1])
    without = HeldOut(forecasts, held_out.actions, mask, joined.shape[2] + 2)
    loss = without.combined()[1]
    return Screening(
        loss - losses[0], loss - losses[1], without.tolerance(NETWORK_GAIN_NATS), log2(steps / (2 * trial_steps))
    )
