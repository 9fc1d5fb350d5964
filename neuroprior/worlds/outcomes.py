"""Random outcomes in tables: drawing one of the outcomes of each action in each cell."""

from typing import Self

import torch
from torch import Tensor

from neuroprior.worlds.world import moved

SUM_TOLERANCE = 1e-6


class Outcomes:
    """Draws one of K outcomes of each action in each cell, by the inverse of their distribution function.

    Args:
        probability: floating point `[S, A, K]`, each row of which sums to 1 within 1e-6.
        device: where the tables are.

    Attributes:
        probability: the same in float64, each row divided by its sum.
        num_outcomes: K.

    Raises:
        ValueError: a probability is negative or not a number, or a row does not sum to 1.
    """

    def __init__(self, probability: Tensor, device: torch.device) -> None:
        _check_probability(probability)
        probability = probability.to(device).double()
        self.probability = probability / probability.sum(-1, keepdim=True)
        self.num_outcomes = probability.shape[-1]
        # Summed in float64 and then rounded, the last possible outcome ends at exactly 1, and all numbers drawn are
        # below.
        upper = self.probability.cumsum(-1).float()
        # The binary search needs a power of two; what fills it up is never reached.
        width = 1 << (self.num_outcomes - 1).bit_length()
        self._steps = [width >> n for n in range(1, width.bit_length())]
        self._width = width
        self._upper = torch.nn.functional.pad(upper, (0, width - self.num_outcomes), value=1.0).view(-1)

    def to(self, device: torch.device | str) -> Self:
        """Move the tables to `device`; returns self."""
        return moved(self, device)

    @property
    def table_size(self) -> int:
        """Numbers in the table that is searched."""
        return len(self._upper)

    def draw(self, taken: Tensor, uniform: Tensor) -> Tensor:
        """The outcome, `taken * K + k`, of each `cell * A + action` in `taken`.

        Args:
            taken: int32 or int64 `[N]`.
            uniform: float32 `[N]`: uniform in [0, 1). The same number draws the same quantile of every action.

        Returns:
            `[N]` of the dtype of `taken`. Outcomes of probability 0 are never drawn.
        """
        first = taken * self._width
        at = first.clone()
        for step in self._steps:
            at.add_(self._upper.index_select(0, at + (step - 1)) <= uniform, alpha=step)
        return at.sub_(first).add_(taken, alpha=self.num_outcomes)


def _check_probability(probability: Tensor) -> None:
    wrong = ~((probability >= 0) & (probability < torch.inf))
    if wrong.any():
        where = wrong.nonzero()[0].tolist()
        raise ValueError(f"`probability{where}` must be a number from 0 to 1, got {float(probability[tuple(where)]):g}")
    total = probability.double().sum(-1)
    wrong = (total - 1).abs() > SUM_TOLERANCE
    if wrong.any():
        where = wrong.nonzero()[0].tolist()
        raise ValueError(f"probability{where}: the outcomes of an action must sum to 1, not {float(total[*where]):g}")
