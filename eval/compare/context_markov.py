"""Markov priors that see, in `python -m eval compare`: a sight is a context that has to be met to be known."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor

from neuroprior import MarkovPrior, Plans, Prior
from neuroprior.analysis.comparison import score
from neuroprior.plans import is_per_step

VALIDATION = 0.2
"""Share of the plans on which it is chosen what a prior sees."""

SAME = 1e-9
"""Sights whose codes are nearer than this are the same."""


class Sights:
    """Numbers for what is seen: each sight that occurs in the plans has one, and all others share the last.

    Args:
        seen: the sights that occur: floating point `[N, C]` (features), or integers `[N]`.
        near: the features that count; None: all.
    """

    def __init__(self, seen: Tensor, near: Sequence[int] | None = None) -> None:
        self.columns = slice(None) if near is None else torch.tensor(near)
        self.weights = torch.ones(0, dtype=torch.float64)
        if seen.is_floating_point():
            # A sum with random weights tells features apart; one number is quicker to look up than many.
            generator = torch.Generator().manual_seed(0)
            self.weights = torch.rand(seen[:, self.columns].shape[-1], generator=generator, dtype=torch.float64)
        codes = self._code(seen).sort().values
        new = torch.ones_like(codes, dtype=torch.bool)
        new[1:] = codes.diff() > SAME
        self.codes = codes[new]

    @property
    def number(self) -> int:
        """How many numbers there are, the last among them."""
        return len(self.codes) + 1

    def __call__(self, seen: Tensor) -> Tensor:
        """The numbers `[...]` of features `[..., C]` or integers `[...]`."""
        code = self._code(seen)
        place = torch.searchsorted(self.codes, code - SAME / 2).clamp(max=len(self.codes) - 1)
        return torch.where((self.codes[place] - code).abs() < SAME, place, len(self.codes))

    def _code(self, seen: Tensor) -> Tensor:
        return seen[..., self.columns].double() @ self.weights if seen.is_floating_point() else seen.double()


class ContextMarkov(Prior):
    """A Markov prior that sees: each sight that occurs in the plans it learns from is a context of its own.

    Chains have to meet a sight to know it, and of large sights most are new. So each time it learns, all features and
    each of the sets in `near` are tried, and those are taken with which it tells held-out plans best. At a sight that
    it has not met it goes on as a chain of the same order that sees nothing.

    Args:
        num_actions, order: see `MarkovPrior`.
        near: sets of features.
        num_contexts, context_size: see `Prior`.
    """

    def __init__(self, num_actions: int, order: int, near: Sequence[tuple[int, ...]] = (), **sizes: int) -> None:
        super().__init__(num_actions, **sizes)
        self.order, self.near = order, tuple(near)
        self.blind, self.chain = MarkovPrior(num_actions, order), MarkovPrior(num_actions, order, num_contexts=1)
        self.sights = Sights(torch.zeros(1, dtype=torch.long))

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Choose what to see, number it and count; returns self.

        Raises:
            ValueError: plans that a Markov prior cannot learn from, or that do not show what this one sees.
        """
        self.check_settings(settings)
        plans = self.training_plans(plans)
        best: Sequence[int] | None = None
        if self.near:
            training, validation = plans.split(VALIDATION, torch.Generator().manual_seed(0))
            self.blind.fit(training)
            bits = {near: self._learn(training, near)._bits(validation) for near in (None, *self.near)}
            best = min(bits, key=lambda near: bits[near])
        self.blind.fit(plans)
        return self._learn(plans, best)

    def _learn(self, plans: Plans, near: Sequence[int] | None) -> Self:
        seen = plans.context
        assert seen is not None
        self.sights = Sights(seen.flatten(0, -2) if seen.is_floating_point() else seen.flatten(), near)
        self.chain = MarkovPrior(self.num_actions, self.order, num_contexts=self.sights.number)
        self.chain.fit(replace(plans, context=self.sights(seen), context_names=None))
        return self

    def _bits(self, plans: Plans) -> float:
        return score("", self, plans).bits_per_action().mean

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if context is None:
            raise ValueError("context: this prior sees a context, and none was given")
        seeing = self.chain.start(batch_size, self.sights(context))
        return self._either(seeing, self.blind.start(batch_size))

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        sight = None if context is None else self.sights(context)
        return self._either(self.chain.step(action, state[:, 0], sight), self.blind.step(action, state[:, 1]))

    def _either(self, seeing: tuple[Tensor, Tensor], blind: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """The logits of the one or the other, by what was seen last, and the states of both."""
        known = seeing[1] % self.sights.number < self.sights.number - 1
        return torch.where(known[:, None], seeing[0], blind[0]), torch.stack([seeing[1], blind[1]], -1)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        if context is None:
            raise ValueError("context: this prior sees a context, and none was given")
        sight = self.sights(context)
        known = (sight if is_per_step(context) else sight[:, None]) < self.sights.number - 1
        return torch.where(known[..., None], self.chain(plans, sight), self.blind(plans))
