"""Chi-square tests of random draws, for the conformance suites."""

from itertools import pairwise

import torch
from torch import Tensor

BINS = 8
"""Bins a group at most, in the test of two samples."""


def chi_square(counts: Tensor, expected: Tensor) -> float:
    """The p-value of Pearson's test of `counts [K]` against `expected [K]`; the rarest cells are pooled."""
    order = expected.argsort()
    counts, expected = counts[order].double(), expected[order].double()
    # Cells with an expected count below 5 are pooled, as the test's approximation needs.
    pooled = int((expected < 5).sum())
    while 0 < pooled < len(expected) and float(expected[:pooled].sum()) < 5:
        pooled += 1
    groups = [slice(0, pooled), *(slice(a, b) for a, b in pairwise(range(pooled, len(expected) + 1)))]
    if pooled == 0:
        groups = groups[1:]
    observed, due = (torch.stack([v[g].sum() for g in groups]) for v in (counts, expected))
    if len(groups) < 2:
        return 1.0
    statistic = ((observed - due) ** 2 / due).sum()
    return float(torch.special.gammaincc(torch.tensor((len(groups) - 1) / 2).double(), statistic / 2))


def alike(first: Tensor, second: Tensor, group: Tensor) -> float:
    """The p-value of the chi-square test that two samples of numbers have the same distribution in each group.

    Numbers are compared by bins of about equal counts, so that they may be continuous as well as a few distinct ones.

    Args:
        first, second: numbers `[N]`; `first[i]` and `second[i]` belong to the group `group[i]`.
        group: int64 `[N]`.
    """
    distinct, value = torch.cat([first, second]).unique(return_inverse=True)
    pairs, which, counts = (group.repeat(2) * len(distinct) + value).unique(return_inverse=True, return_counts=True)
    owner = pairs.div(len(distinct), rounding_mode="floor")
    total = torch.zeros(int(group.max()) + 1, dtype=torch.long).index_add(0, owner, counts)
    # The number of smaller values in the same group, and half of the equal ones.
    rank = counts.cumsum(0) - counts / 2 - (total.cumsum(0) - total)[owner]
    bins = owner * BINS + (rank * BINS / total[owner]).long()
    table = torch.stack([bins[sample].bincount(minlength=len(total) * BINS) for sample in which.view(2, -1)]).double()
    both = table.sum(0)
    rare = both < 10
    free = int((~rare).sum())
    # Both samples have equally many numbers in a group, which takes one degree of freedom.
    free -= int((((both == 0) | ~rare).view(-1, BINS).all(1) & (both.view(-1, BINS).sum(1) > 0)).sum())
    if free < 1:
        return 1.0
    statistic = ((table[0] - table[1]) ** 2 / both)[~rare].sum()
    return float(torch.special.gammaincc(torch.tensor(free / 2).double(), statistic / 2))
