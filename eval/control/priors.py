"""The priors that propose candidates in `python -m eval control`, by name."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from neuroprior.control import (
    AutoregressivePrior,
    DiscretisedPrior,
    NoisePrior,
    StepSynergies,
    StoredWindows,
    VectorGRU,
    VectorPlans,
    VectorPrior,
    VectorTransformer,
    WindowSynergies,
)

MATCH = 4
"""Vectors of the past by which stored windows are found."""

NONE = "none"
"""The plain planner."""

SIMPLE: dict[str, Callable[..., VectorPrior]] = {
    "noise": partial(NoisePrior, exponent=None),
    "autoregressive": AutoregressivePrior,
    "synergies": WindowSynergies,
    "step-synergies": StepSynergies,
    "stored": StoredWindows,
    "discretised": DiscretisedPrior,
}
"""Priors that are fitted in closed form, or store what they saw."""

WITH_NUMBER = ("synergies", "step-synergies")
"""Priors whose number of components may be given, as in synergies-4."""

SHUFFLED = "shuffled"
"""A control: the autoregression of plans whose vectors are in random order."""

NETWORKS: dict[str, Callable[..., VectorPrior]] = {"gru": VectorGRU, "transformer": VectorTransformer}
"""Networks that see past vectors alone."""

CLONING = "cloning"
"""A network that is given each state's observation, as a proposal; it is also executed alone."""


def check_prior_name(name: str) -> None:
    """Raise ValueError for what is no name of a prior."""
    base, number = parted(name)
    known = (NONE, *SIMPLE, SHUFFLED, *NETWORKS, CLONING)
    if base not in known or (number is not None and base not in WITH_NUMBER):
        raise ValueError(f"priors: one of {', '.join(known)} is expected, or synergies-4, not {name!r}")


def parted(name: str) -> tuple[str, int | None]:
    """A name's parts: what is before and behind a hyphen, if a number is behind it."""
    base, _, number = name.rpartition("-")
    return (base, int(number)) if base and number.isdecimal() and int(number) else (name, None)


def fitted(name: str, plans: VectorPlans, horizon: int, generator: torch.Generator) -> VectorPrior:
    """The prior of a name, fitted to executed plans.

    Args:
        name: see `check_prior_name`; not `NONE`.
        plans: with observations per step as context.
        horizon: vectors in a planner's plan.
        generator: source of randomness.
    """
    base, number = parted(name)
    bounds = plans.action_low, plans.action_high
    blind = plans.without_context()
    if base == SHUFFLED:
        return AutoregressivePrior(*bounds).fit(shuffled(blind, generator), generator=generator)
    if base in SIMPLE:
        settings: dict[str, Any] = {} if number is None else {"num_components": number}
        if base == "synergies":
            settings["window"] = horizon
        if base == "stored":
            # Short runs have short segments.
            longest = int(plans.mask().sum(1).max())
            settings["horizon"] = max(min(horizon, longest - MATCH), 1)
            settings["match"] = MATCH
        return SIMPLE[base](*bounds, **settings).fit(blind, generator=generator)
    if base == CLONING:
        assert plans.context is not None
        return VectorGRU(*bounds, plans.context.shape[-1]).fit(plans, generator=generator, progress=False)
    return NETWORKS[base](*bounds).fit(blind, generator=generator, progress=False)


def shuffled(plans: VectorPlans, generator: torch.Generator) -> VectorPlans:
    """The same plans, the vectors of each in an order of its own."""
    draws = torch.rand(plans.actions.shape[:2], generator=generator).masked_fill(~plans.mask(), 2.0)
    order = draws.argsort(1)
    return replace(plans, actions=plans.actions.gather(1, order[..., None].expand_as(plans.actions)), context=None)
