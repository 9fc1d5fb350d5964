"""Calibration: whether goals are as often true as an observer forecasts, in bins of the forecast probability."""

from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior._statistics import Interval, ratio_difference, share_interval


class Bin(NamedTuple):
    """The forecasts of a bin: their mean, and the share that came true with its 95 % interval over units."""

    forecast: float
    true: Interval


def count_forecasts(log_probs: Tensor, outcome: Tensor, bins: int = 10) -> Tensor:
    """Sorts forecasts into bins of equal width (DeGroot and Fienberg 1983, reliability diagrams).

    Args:
        log_probs: `[M, K]`, nats: each of K outcomes is a forecast at each of M places.
        outcome: `[M]`: what came true.
        bins: number of bins; a forecast on an edge belongs to the bin above it, and 1 to the last.

    Returns:
        `[bins, 3]`, float64: of each bin the sum of the forecast probabilities, how many came true, and their number.
    """
    probs = log_probs.double().exp()
    true = torch.nn.functional.one_hot(outcome.long(), probs.shape[1]).double()
    place = (probs * bins).long().clamp(max=bins - 1).flatten()
    values = torch.stack([probs, true, torch.ones_like(probs)], -1).view(-1, 3)
    return values.new_zeros(bins, 3).index_add_(0, place, values)


def calibration_error(sums: Tensor) -> float:
    """Averages the absolute difference of forecast and share that came true over forecasts (Naeini et al. 2015).

    Args:
        sums: `[G, bins, 3]`: those of `count_forecasts`, for each of G independent units.
    """
    forecast, true, number = sums.sum(0).unbind(-1)
    return float((forecast - true).abs().sum() / number.sum())


def filled_bins(sums: Tensor) -> list[Bin]:
    """Returns the bins that have forecasts, in ascending order.

    The interval is that of a ratio over units; a share of 0 or 1, which has no spread, has Wilson's, with units as
    trials. Its ends are NaN where a single unit has any.

    Args:
        sums: as in `calibration_error`.
    """
    bins = []
    for bin_sums in sums.unbind(1):
        forecast, true, number = bin_sums[bin_sums[:, 2] > 0].T
        if len(number):
            bins.append(Bin(float(forecast.sum() / number.sum()), _share(true, number)))
    return bins


def _share(true: Tensor, number: Tensor) -> Interval:
    share = float(true.sum() / number.sum())
    if share in (0, 1):
        return share_interval(round(share * len(true)), len(true))
    if len(true) < 2:
        return Interval(share, float("nan"), float("nan"))
    _, low, high, _ = ratio_difference(true, number)
    return Interval(share, max(low, 0.0), min(high, 1.0))
