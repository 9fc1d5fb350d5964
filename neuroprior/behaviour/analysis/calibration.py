"""Calibration: whether actions are taken as often as a prior predicts, in bins of the predicted probability."""

from dataclasses import dataclass

import torch
from torch import Tensor

from neuroprior._checks import check_range, check_sizes, is_integer
from neuroprior.behaviour.analysis.statistics import Interval, ratio_difference, share_interval

UNITS = 997
"""Independent units that are distinguished: those whose numbers are equal modulo this prime are joined."""

TOLERANCE = 1e-3
"""How far the probabilities of all actions may sum from 1."""


@dataclass(frozen=True)
class Bin:
    """The forecasts whose probability lies between `low` and `high`.

    Attributes:
        low, high: the edges; a forecast on an edge belongs to the bin above it, and 1 to the last.
        forecast: their mean probability.
        taken: the share of them whose action was taken, with its 95 % interval over units; the ends are NaN if only one
            unit has any.
        number: of forecasts.
    """

    low: float
    high: float
    forecast: float
    taken: Interval
    number: int


@dataclass(frozen=True, eq=False)
class Reliability:
    """Forecasts against what happened; those of several folds are added by `+`.

    Attributes:
        sums: `[UNITS, bins, 3]`, float64, on the CPU: of each unit and bin the sum of the forecast probabilities, the
            number of actions taken, and the number of forecasts.
    """

    sums: Tensor

    def __add__(self, other: "Reliability") -> "Reliability":
        """The sum of both, such as two folds of one cross-validation.

        Raises:
            ValueError: different numbers of bins.
        """
        if self.sums.shape != other.sums.shape:
            raise ValueError(f"bins: {self.sums.shape[1]} and {other.sums.shape[1]} cannot be added")
        return Reliability(self.sums + other.sums)

    @property
    def bins(self) -> list[Bin]:
        """The bins that have forecasts, in ascending order."""
        forecast, taken, number = self.sums.unbind(-1)
        edges = torch.linspace(0, 1, self.sums.shape[1] + 1, dtype=torch.double).tolist()
        found = []
        for k in self.sums[..., 2].sum(0).nonzero()[:, 0].tolist():
            has = number[:, k] > 0
            total = float(number[:, k].sum())
            share = _share(taken[has, k], number[has, k])
            found.append(Bin(edges[k], edges[k + 1], float(forecast[:, k].sum()) / total, share, int(total)))
        return found

    @property
    def expected_calibration_error(self) -> float:
        """The absolute difference of forecast and share taken, averaged over forecasts (Naeini et al. 2015)."""
        forecast, taken, number = self.sums.sum(0).unbind(-1)
        return float((forecast - taken).abs().sum() / number.sum())


def reliability(
    log_probs: Tensor, actions: Tensor, unit: Tensor, bins: int = 10, *, chunk_size: int = 2**22
) -> Reliability:
    """How often actions were taken that had been predicted with a probability of about 0.05, 0.15, ... 0.95.

    The probability of each action at each place is one forecast; forecasts are sorted into `bins` bins of equal width
    (DeGroot and Fienberg 1983, reliability diagrams). The interval of a bin's share is that of a ratio over units
    (`neuroprior.behaviour.ratio_difference`); a share of 0 or 1, which has no spread, has Wilson's, with units as
    trials.

    Args:
        log_probs: floating point `[M, A]`, nats: the log-probabilities of all actions at M places, such as
            `prior(plans.actions).log_softmax(-1)[plans.mask()]`.
        actions: integers `[M]`: what was taken.
        unit: integers `[M]`: the independent unit of each place (see `neuroprior.behaviour.units`), best
            numbered from 0: units whose numbers are equal modulo `UNITS` are joined.
        bins: number of bins.
        chunk_size: forecasts that are in memory at a time.

    Raises:
        ValueError: no places, a wrong shape or dtype, or probabilities that do not sum to 1.

    Example:
        >>> plans = Plans(torch.randint(2, (20, 5), generator=torch.Generator().manual_seed(0)), 2)
        >>> log_probs = UniformPrior(2)(plans.actions).log_softmax(-1).flatten(0, 1)
        >>> found = reliability(log_probs, plans.actions.flatten(), unit=torch.arange(100) // 5)
    """
    check_sizes(bins=bins, chunk_size=chunk_size)
    if log_probs.dim() != 2 or not log_probs.is_floating_point() or log_probs.numel() == 0:
        raise ValueError(
            f"log_probs: floating point, shape [M, A], is expected, not {log_probs.dtype}, {list(log_probs.shape)}"
        )
    places, num_actions = log_probs.shape
    for name, values in (("actions", actions), ("unit", unit)):
        if values.shape != (places,) or not is_integer(values):
            raise ValueError(f"{name}: integers of shape [{places}] are expected, not {list(values.shape)}")
    check_range("actions", actions, num_actions, "actions")
    actions, unit = actions.to(log_probs.device).long(), unit.to(log_probs.device).long()
    sums = torch.zeros(UNITS * bins, 3, dtype=torch.double)
    size = max(chunk_size // num_actions, 1)
    for at in range(0, places, size):
        part = slice(at, at + size)
        probs = log_probs[part].double().exp()
        _check_probabilities(probs, at)
        place = (probs * bins).long().clamp(max=bins - 1) + (unit[part] % UNITS * bins)[:, None]
        hit = place.gather(1, actions[part][:, None])[:, 0]
        flat = place.flatten()
        counted = [flat.bincount(probs.flatten()), hit.bincount(), flat.bincount()]
        for column, values in enumerate(counted):
            sums[: len(values), column] += values.double().cpu()
    return Reliability(sums.view(UNITS, bins, 3))


def _check_probabilities(probs: Tensor, first: int) -> None:
    """Raise ValueError unless the rows, of which the first has the number `first`, sum to 1."""
    wrong = ~((probs.sum(1) - 1).abs() <= TOLERANCE)
    if wrong.any():
        row = int(wrong.nonzero()[0, 0])
        raise ValueError(
            f"log_probs[{first + row}]: the probabilities sum to {float(probs[row].sum()):.4g}, not 1;"
            " log_softmax makes log-probabilities of logits"
        )


def _share(taken: Tensor, number: Tensor) -> Interval:
    """The share taken over units `[G]` that all have some."""
    share = float(taken.sum() / number.sum())
    if share in (0, 1):
        return share_interval(round(share * len(taken)), len(taken))
    if len(taken) < 2:
        return Interval(share, float("nan"), float("nan"))
    _, low, high, _ = ratio_difference(taken, number)
    return Interval(share, max(low, 0.0), min(high, 1.0))
