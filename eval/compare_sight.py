"""What priors see in `python -m eval compare`: features for networks, and numbers for counts, of the same sights."""

from copy import copy
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from eval.suite import Pair
from neuroprior import Plans, TabularWorld, World

SAME = 1e-6
"""Sights whose codes are nearer than this are the same."""


class Sights:
    """Numbers for features: each sight that occurs in the plans has one, and all others share the last.

    Args:
        features: floating point `[N, C]`, the sights that occur.
    """

    def __init__(self, features: Tensor) -> None:
        # A sum with random weights tells features apart; one number is quicker to look up than many.
        generator = torch.Generator().manual_seed(0)
        self.weights = torch.rand(features.shape[-1], generator=generator, dtype=torch.float64)
        codes = (features.double() @ self.weights).sort().values
        new = torch.ones_like(codes, dtype=torch.bool)
        new[1:] = codes.diff() > SAME
        self.codes = codes[new]

    @property
    def number(self) -> int:
        """How many numbers there are, the last among them."""
        return len(self.codes) + 1

    def __call__(self, features: Tensor) -> Tensor:
        """The numbers `[...]` of features `[..., C]`."""
        code = features.double() @ self.weights
        place = torch.searchsorted(self.codes, code - SAME / 2).clamp(max=len(self.codes) - 1)
        return torch.where((self.codes[place] - code).abs() < SAME, place, len(self.codes))


def sizes_of(worlds: Pair, plans: Plans) -> dict[str, Any]:
    """The arguments that let a prior see the context of `plans`."""
    if plans.context is None:
        return {}
    if plans.context.is_floating_point():
        return {"context_size": plans.context.shape[-1]}
    assert isinstance(worlds.training, TabularWorld)
    return {"num_contexts": worlds.training.num_states}


def numbered(worlds: Pair, plans: Plans) -> tuple[Pair, Plans, dict[str, Any]]:
    """Worlds and plans in which sights have numbers, for priors that count, and the arguments with which they see."""
    if plans.context is None or not plans.context.is_floating_point():
        return worlds, plans, sizes_of(worlds, plans)
    sights = Sights(plans.context.reshape(-1, plans.context.shape[-1]))
    pair = Pair(_seen_as(worlds.training, sights), _seen_as(worlds.held_out, sights))
    return pair, replace(plans, context=sights(plans.context)), {"num_contexts": sights.number}


def _seen_as(world: World, sights: Sights) -> World:
    """The same world, in which sights are observed by their numbers."""
    twin, observe = copy(world), world.observe
    twin.observe = lambda state: sights(observe(state))  # type: ignore[method-assign]
    return twin
