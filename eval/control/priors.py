"""The priors that propose candidates in `python -m eval control`, by name."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal, TypeAlias

import torch

from eval.control.synergies import StepSynergies
from neuroprior.control import (
    AutoregressivePrior,
    NoisePrior,
    StoredWindows,
    VectorGRU,
    VectorPlans,
    VectorPrior,
)

MATCH = 4
"""Vectors of the past by which stored windows are found."""

NONE = "none"
"""The plain planner."""

SIMPLE: dict[str, Callable[..., VectorPrior]] = {
    "noise": partial(NoisePrior, exponent=None),
    "autoregressive": AutoregressivePrior,
    "synergies": StepSynergies,
    "stored": StoredWindows,
}
"""Priors that are fitted in closed form, or store what they saw."""

SHUFFLED = "shuffled"
"""A control: the autoregression of plans whose vectors are in random order."""

NETWORK = "gru"
"""A network that sees past vectors alone."""

CLONING = "cloning"
"""The network that is given each state's observation, too."""

ScoredName: TypeAlias = Literal[(*SIMPLE, SHUFFLED, NETWORK, CLONING)]  # type: ignore[valid-type]
PriorName: TypeAlias = Literal[(NONE, *SIMPLE, SHUFFLED, NETWORK, CLONING)]  # type: ignore[valid-type]


def fit_prior(name: str, plans: VectorPlans, horizon: int, generator: torch.Generator) -> VectorPrior:
    """The prior of a name, fitted to executed plans.

    Args:
        name: a `ScoredName`.
        plans: with observations per step as context.
        horizon: vectors in a planner's plan.
        generator: source of randomness.
    """
    bounds = plans.action_low, plans.action_high
    blind = plans.without_context()
    if name == CLONING:
        assert plans.context is not None
        return VectorGRU(*bounds, plans.context.shape[-1]).fit(plans, generator=generator, progress=False)
    if name == NETWORK:
        return VectorGRU(*bounds).fit(blind, generator=generator, progress=False)
    if name == SHUFFLED:
        return AutoregressivePrior(*bounds).fit(shuffle_steps(blind, generator), generator=generator)
    if name == "stored":
        # Short runs have short segments.
        length = max(min(horizon, int(plans.mask().sum(1).max()) - MATCH), 1)
        return StoredWindows(*bounds, match=MATCH, horizon=length).fit(blind, generator=generator)
    return SIMPLE[name](*bounds).fit(blind, generator=generator)


def shuffle_steps(plans: VectorPlans, generator: torch.Generator) -> VectorPlans:
    """The same plans, the vectors of each in an order of its own."""
    draws = torch.rand(plans.actions.shape[:2], generator=generator).masked_fill(~plans.mask(), 2.0)
    order = draws.argsort(1)
    return replace(plans, actions=plans.actions.gather(1, order[..., None].expand_as(plans.actions)), context=None)
