"""Observed features as the numbers of contexts, for priors that count in each context apart."""

from collections.abc import Sequence

import torch
from torch import Tensor

SAME = 1e-9
"""Contexts whose hashes are nearer than this are the same."""


class ContextIndex:
    """Numbers contexts: each context that occurs in the training plans has a number, and all others share the last.

    Args:
        contexts: those that occur: floating point `[N, C]` (features), or integers `[N]`.
        features: the features that count; None: all.
    """

    def __init__(self, contexts: Tensor, features: Sequence[int] | None = None) -> None:
        self.columns = slice(None) if features is None else torch.tensor(features)
        self.weights = torch.ones(0, dtype=torch.float64)
        if contexts.is_floating_point():
            # A sum with random weights distinguishes features; one number is quicker to look up than many.
            generator = torch.Generator().manual_seed(0)
            self.weights = torch.rand(contexts[:, self.columns].shape[-1], generator=generator, dtype=torch.float64)
        hashes = self._hash(contexts).sort().values
        new = torch.ones_like(hashes, dtype=torch.bool)
        new[1:] = hashes.diff() > SAME
        self.hashes = hashes[new]

    @property
    def size(self) -> int:
        """How many numbers there are, with the last."""
        return len(self.hashes) + 1

    def __call__(self, contexts: Tensor) -> Tensor:
        """The numbers `[...]`, int64, of features `[..., C]` or integers `[...]`."""
        value = self._hash(contexts)
        place = torch.searchsorted(self.hashes, value - SAME / 2).clamp(max=len(self.hashes) - 1)
        return torch.where((self.hashes[place] - value).abs() < SAME, place, len(self.hashes))

    def _hash(self, contexts: Tensor) -> Tensor:
        if contexts.is_floating_point():
            return contexts[..., self.columns].double() @ self.weights
        return contexts.double()
