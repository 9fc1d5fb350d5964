"""Markov priors that see features, in `python -m eval compare`: a sight is a context that has to be met to be known."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import torch
from torch import Tensor

from neuroprior import MarkovPrior, Plans, Prior
from neuroprior.comparison import score

VALIDATION = 0.2
"""Share of the plans on which it is chosen what a prior sees."""

SAME = 1e-9
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
        self.columns = slice(None) if near is None else torch.tensor(near)
        self.weights = torch.rand(features[:, self.columns].shape[-1], generator=generator, dtype=torch.float64)
        codes = self._code(features).sort().values
        new = torch.ones_like(codes, dtype=torch.bool)
        new[1:] = codes.diff() > SAME
        self.codes = codes[new]

    @property
    def number(self) -> int:
        """How many numbers there are, the last among them."""
        return len(self.codes) + 1

    def __call__(self, features: Tensor) -> Tensor:
        """The numbers `[...]` of features `[..., C]`."""
        code = self._code(features)
        place = torch.searchsorted(self.codes, code - SAME / 2).clamp(max=len(self.codes) - 1)
        return torch.where((self.codes[place] - code).abs() < SAME, place, len(self.codes))

    def _code(self, features: Tensor) -> Tensor:
        return features[..., self.columns].double() @ self.weights


class SeeingMarkov(Prior):
    """A Markov prior that sees features: each sight that occurs in the plans it learns from is a context of its own.

    Chains have to meet a sight to know it, and of large sights most are new. So each time it learns, all features and
    each of the sets in `near` are tried, and those are taken with which it tells held-out plans best.

    Args:
        num_actions, order: see `MarkovPrior`.
        context_size: number of features, C.
        near: sets of features.
    """

    def __init__(self, num_actions: int, order: int, context_size: int, near: Sequence[tuple[int, ...]] = ()) -> None:
        super().__init__(num_actions, context_size=context_size)
        self.order, self.near = order, tuple(near)
        self.chain = MarkovPrior(num_actions, order, num_contexts=1)
        self.sights = Sights(torch.zeros(0, context_size))

    def fit(self, plans: Plans | Tensor) -> Self:
        """Choose what to see, number it and count; returns self.

        Raises:
            ValueError: plans that a Markov prior cannot learn from, or that do not show so many features.
        """
        plans = self.training_plans(plans)
        best: Sequence[int] | None = None
        if self.near:
            training, validation = plans.split(VALIDATION, torch.Generator().manual_seed(0))
            bits = {near: self._learn(training, near)._bits(validation) for near in (None, *self.near)}
            best = min(bits, key=lambda near: bits[near])
        return self._learn(plans, best)

    def _learn(self, plans: Plans, near: Sequence[int] | None) -> Self:
        assert plans.context is not None
        self.sights = Sights(plans.context.flatten(0, -2), near)
        self.chain = MarkovPrior(self.num_actions, self.order, num_contexts=self.sights.number)
        self.chain.fit(replace(plans, context=self.sights(plans.context)))
        return self

    def _bits(self, plans: Plans) -> float:
        return score("", self, plans).bits_per_action().mean

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return self.chain.start(batch_size, None if context is None else self.sights(context))

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return self.chain.step(action, state, None if context is None else self.sights(context))

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        logits = self.chain(plans, None if context is None else self.sights(context))
        assert isinstance(logits, Tensor)
        return logits
