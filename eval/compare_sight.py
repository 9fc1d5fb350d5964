"""What priors see in `python -m eval compare`: features for networks, and numbers for counts, of the same sights."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from eval.suite import Pair
from neuroprior import MarkovPrior, Plans, TabularWorld, World
from neuroprior.comparison import score
from neuroprior.randomness import draw_seed

VALIDATION = 0.2
"""Share of the plans on which it is chosen what a chain sees."""

SAME = 1e-6
"""Sights whose codes are nearer than this are the same."""


class Sights:
    """Numbers for features: each sight that occurs in the plans has one, and all others share the last.

    Args:
        features: floating point `[N, C]`, the sights that occur.
        near: the features that count; None: all.
    """

    def __init__(self, features: Tensor, near: Sequence[int] | None = None) -> None:
        # A sum with random weights tells features apart; one number is quicker to look up than many.
        generator = torch.Generator().manual_seed(0)
        self.weights = torch.rand(features.shape[-1], generator=generator, dtype=torch.float64)
        if near is not None:
            self.weights *= torch.zeros_like(self.weights).index_fill(0, torch.tensor(near), 1)
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


class Counted(NamedTuple):
    """Worlds and plans in which sights have numbers, for priors that count, and the arguments with which they see."""

    worlds: Pair
    plans: Plans
    sizes: dict[str, Any]


def numbered(worlds: Pair, plans: Plans, near: Sequence[int] | None = None) -> Counted:
    """Numbers for all that is seen, or for the features that are `near`."""
    if plans.context is None or not plans.context.is_floating_point():
        return Counted(worlds, plans, sizes_of(worlds, plans))
    sights = Sights(plans.context.reshape(-1, plans.context.shape[-1]), near)
    pair = Pair(_seen_as(worlds.training, sights), _seen_as(worlds.held_out, sights))
    return Counted(pair, replace(plans, context=sights(plans.context)), {"num_contexts": sights.number})


def best_counted(
    worlds: Pair, plans: Plans, near: Sequence[int] | None, order: int, generator: torch.Generator
) -> Counted:
    """What a chain sees: all, or only what is near, whichever lets it tell held-out plans better.

    Chains have to meet a sight to know it; of large sights most are new.
    """
    tried = [numbered(worlds, plans)]
    if near is not None and plans.context is not None:
        tried.append(numbered(worlds, plans, near))
    seed = draw_seed(generator)
    if len(tried) == 1:
        return tried[0]
    bits = []
    for one in tried:
        training, validation = one.plans.split(VALIDATION, torch.Generator().manual_seed(seed))
        chain = MarkovPrior(plans.num_actions, order, **one.sizes).fit(training)
        bits.append(score("", chain, validation).bits_per_action().mean)
    return tried[bits.index(min(bits))]


def _seen_as(world: World, sights: Sights) -> World:
    """The same world, in which sights are observed by their numbers."""
    twin, observe = copy(world), world.observe
    twin.observe = lambda state: sights(observe(state))  # type: ignore[method-assign]
    return twin
