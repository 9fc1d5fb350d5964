"""Features of contexts, brought to one scale before a network reads them."""

import torch
from torch import Tensor, nn

MOST = 10.0
"""Standard deviations beyond which a feature counts as so far away: a network knows nothing of what lies there."""

GROSS = 20.0
"""How many times as large as the robust one a standard deviation is that is due to a few values far away."""

QUARTILES_APART = 1.349
"""Distance of the quartiles of a Gaussian, in standard deviations."""

CONSTANT = 1e-6
"""Of the largest value: a feature that varies less has one value, but for rounding."""

UNSCALED = {"mean": 0.0, "std": 1.0, "most": torch.inf}
"""What changes nothing."""


class Standardise(nn.Module):
    """Subtracts means and divides by standard deviations, those of the first plans that a network learned from.

    Without it a network learns nothing, or slowly, from features in units that make them small, large or far from 0.
    Before `learn` nothing is changed.

    Args:
        size: C, number of features.
    """

    mean: Tensor
    std: Tensor
    most: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))
        self.register_buffer("most", torch.tensor(torch.inf))

    @torch.no_grad()
    def learn(self, features: Tensor) -> None:
        """Take the means and standard deviations of `features [n, C]`, n > 0.

        Indicators, features that are 0, 1 or -1, stay as they are. Where a few values are so far away that they make
        most of the standard deviation, such as codes for missing numbers, median and quartiles are taken.
        """
        values = features.double()
        mean, std, largest = values.mean(0), values.std(0, correction=0), values.abs().amax(0)
        low, middle, high = values.sort(0).values[[len(values) * k // 4 for k in (1, 2, 3)]]
        robust = (high - low) / QUARTILES_APART
        gross = (robust > CONSTANT * torch.maximum(low.abs(), high.abs())) & (std > GROSS * robust)
        mean, std = torch.where(gross, middle, mean), torch.where(gross, robust, std)
        std = torch.where(gross | (std > CONSTANT * largest), std, largest.clamp(min=1))
        indicator = ((values == 0) | (values.abs() == 1)).all(0)
        self.mean.copy_(mean.masked_fill(indicator, 0))
        self.std.copy_(std.masked_fill(indicator, 1))
        self.most.fill_(MOST)

    def forward(self, features: Tensor) -> Tensor:
        """`[..., C]`, standardised, and at most `MOST`."""
        away: Tensor = ((features - self.mean) / self.std).clamp(-self.most, self.most)
        return away
