"""P-values from statistics under permutations, of which the first is what was observed."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

TIE = 1e-8
"""Statistics that differ by less than this, or by less than this share, are tied: rounding depends on sums' order."""

NUMBERS_AT_ONCE = 2**20
"""Statistics that are in memory at a time."""

ROUNDING = 1e-12
"""P-values that differ by less are equal."""


class LargestStatistics(NamedTuple):
    """The test of F features by their largest statistic (Westfall and Young 1993, single-step maxT).

    Attributes:
        observed: float64 `[F]`: the statistic of each feature.
        p_values: float64 `[F]`: of each feature alone.
        corrected: float64 `[F]`: corrected for the F features.
        largest: float64 `[P]`: the largest statistic of all features in each permutation.
    """

    observed: Tensor
    p_values: Tensor
    corrected: Tensor
    largest: Tensor


def largest_statistics(
    statistics: Callable[[Tensor], Tensor], permutations: Tensor, features: int
) -> LargestStatistics:
    """Return the test of features by their largest statistic.

    Args:
        statistics: of permutations `[B, p]`, float64 `[F, p]`.
        permutations: `[B, P]`; the first is what was observed.
        features: F.
    """
    observed = statistics(permutations[:, :1])
    parts, reached = [], torch.zeros(features, dtype=torch.double)
    for batch in permutations.split(max(NUMBERS_AT_ONCE // features, 1), 1):
        values = statistics(batch)
        parts.append(values.amax(0))
        reached += (values >= _least(observed)).sum(1)
    largest = torch.cat(parts)
    above = len(largest) - torch.searchsorted(largest.sort().values, _least(observed[:, 0]))
    return LargestStatistics(observed[:, 0], reached / len(largest), above.double() / len(largest), largest)


def combine_tests(statistics: Mapping[str, Tensor]) -> tuple[dict[str, tuple[float, float]], float]:
    """Return the p-value of each test with that corrected for their number, and the smallest corrected one.

    They are corrected by the smallest p-value of all tests in each permutation, step by step (Westfall and Young 1993,
    step-down minP): never less powerful than Holm's correction, since it knows how the tests depend on one another.

    Args:
        statistics: by name, `[P]` in the same permutations; large ones speak against the hypothesis.
    """
    ranked = torch.stack([shares_reaching(values) for values in statistics.values()])
    p_values, order = ranked[:, 0], ranked[:, 0].argsort(stable=True)
    # the smallest p-value of each test and those after it, in each permutation
    smallest = ranked[order].flip(0).cummin(0).values.flip(0)
    reached = (smallest <= p_values[order][:, None] + ROUNDING).double().mean(1).cummax(0).values
    corrected = torch.empty_like(reached)
    corrected[order] = reached
    tests = dict(zip(statistics, zip(p_values.tolist(), corrected.tolist(), strict=True), strict=True))
    return tests, float(reached[0])


def shares_reaching(statistics: Tensor) -> Tensor:
    """`[P]`: for each permutation the share of all whose statistic is at least as large: its p-value."""
    ordered, tie = statistics.sort().values, TIE * (statistics.abs() + 0.1)
    return (len(ordered) - torch.searchsorted(ordered, statistics - tie)).double() / len(ordered)


def _least(statistic: Tensor) -> Tensor:
    """What counts as at least this statistic."""
    return statistic - TIE * (1 + statistic)
