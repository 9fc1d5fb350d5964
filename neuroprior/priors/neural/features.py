"""Features of contexts, brought to one scale before a network reads them."""

import torch
from torch import Tensor, nn

from neuroprior._checks import check_single_precision
from neuroprior.plans.sequences import Sequences

MOST = 10.0
"""Standard deviations beyond which a feature counts as so far away: a network knows nothing of what lies there."""

CODES = ((0.01, 5.0), (0.05, 10.0), (0.4, 50.0))
"""Shares of values, those furthest from the median, that are taken for codes such as -9999 if all values have so many
times the standard deviation of the rest: more than heavy tails make of it."""

VARIED = 0.1
"""The rest must have this share of values that are not the median: else the far values are what a feature says."""

CONSTANT = 1e-6
"""Of the largest value: a feature that varies less has one value, but for rounding."""

MOST_ROWS = 2**16
"""Of more values, so many are drawn, always the same ones: they say enough."""


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
        self.register_buffer("most", torch.tensor(torch.finfo(torch.float).max))

    def learn_from(self, plans: Sequences) -> None:
        """`learn` from the contexts of plans, those of each plan or of each step.

        Raises:
            ValueError: a feature whose variation single precision does not hold, though the context is float64.
        """
        if plans.context is not None and len(plans):
            features = plans.context[plans.mask()]
            check_single_precision("context", features)
            self.learn(features)

    @torch.no_grad()
    def learn(self, features: Tensor) -> None:
        """Take the means and standard deviations of `features [n, C]`, n > 0.

        Indicators, features that are 0, 1 or -1, stay as they are. Codes for missing numbers, a few values far from
        all others, do not count; see `CODES`.
        """
        indicator = ((features == 0) | (features.abs() == 1)).all(0)
        if len(features) > MOST_ROWS:
            drawn = torch.randint(len(features), (MOST_ROWS,), generator=torch.Generator().manual_seed(0))
            features = features[drawn.to(features.device)]
        values = features.double()
        mean, std, largest = values.mean(0), values.std(0, correction=0), values.abs().amax(0)
        away = (values - values.median(0).values).abs()
        ordered, kept = away.sort(0).values, torch.ones_like(away, dtype=torch.bool)
        for share, factor in CODES:
            near = away <= ordered[len(values) - int(share * len(values)) - 1]
            number = near.sum(0)
            middle = (values * near).sum(0) / number
            spread = (((values - middle) * near).square().sum(0) / number).sqrt()
            varied = (near & (away > 0)).double().mean(0) >= VARIED
            coded = varied & (std > factor * spread) & kept.all(0)
            mean, std = torch.where(coded, middle, mean), torch.where(coded, spread, std)
            kept = kept & (near | ~coded)
        largest = torch.where(kept.all(0), largest, (values.abs() * kept).amax(0))
        std = torch.where(std > CONSTANT * largest, std, largest.clamp(min=1))
        coded = ~kept.all(0)
        indicator = indicator | (coded & ((values == 0) | (values.abs() == 1) | ~kept).all(0))
        self.mean.copy_(mean.masked_fill(indicator, 0))
        self.std.copy_(std.masked_fill(indicator, 1))
        self.most.fill_(MOST)

    def forward(self, features: Tensor) -> Tensor:
        """`[..., C]`, standardised, and at most `MOST`."""
        away: Tensor = ((features - self.mean) / self.std).clamp(-self.most, self.most)
        return away
