"""Whether the difference between conditions is another in each stratum: the interaction of two factors."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import nan

import torch
from scipy.linalg import orth
from torch import Tensor
from torch.nn.functional import one_hot

from neuroprior._random import generator_on
from neuroprior._statistics import LEVEL, p_words
from neuroprior.behaviour.analysis.permutation_design import PermutationDesign, shuffle_within
from neuroprior.behaviour.analysis.permutation_tests import combine_tests, largest_statistics

MIN_FREEDOM = 4
"""Units that must be left after all means of strata and conditions are taken."""

ROUNDING = 1e-20
"""The share of a feature's squares below which its variance is a rounding error."""

LEAST_RESIDUAL = 1e-9
"""The least share of a feature's variance that counts as its residual."""


@dataclass(frozen=True, eq=False)
class InteractionFamily:
    """F features of one kind, with the difference between conditions in each of S strata.

    Attributes:
        name: of the family, as of `neuroprior.behaviour.ConditionFamily`.
        features: int64 `[F, n]`: the actions of each.
        differences: float64 `[S, F]`: the mean of the second of two conditions less that of the first, smoothed as in
            tests; NaN for more than two conditions.
        statistic: float64 `[F]`: the sum of squares of the interaction by that of the residuals.
        p_values, corrected: float64 `[F]`: by permutation, of each alone and corrected for the F features (maxT).
        p_value: the test of the family.
    """

    name: str
    features: Tensor
    differences: Tensor
    statistic: Tensor
    p_values: Tensor
    corrected: Tensor
    p_value: float


@dataclass(frozen=True, eq=False)
class ConditionInteraction:
    """Whether the difference between conditions depends on the stratum, such as the effect of a treatment on the sex.

    Attributes:
        stratum_names: S of them.
        families: the features of each kind.
        tests: by name of the family, its p-value, and the same corrected for their number (step-down minP).
        p_value: the smallest corrected one.
        verdict: one sentence.
    """

    stratum_names: list[str]
    families: list[InteractionFamily]
    tests: dict[str, tuple[float, float]]
    p_value: float
    verdict: str


def compare_strata(
    design: PermutationDesign,
    stratum_names: Sequence[str],
    families: Sequence[tuple[str, Tensor, Tensor]],
    permutations: int,
    generator: torch.Generator | None,
) -> ConditionInteraction | None:
    """Return the test of the interaction of conditions and strata; None where there are too few units or strata.

    Within units, the differences between the conditions of a unit are compared between strata; units are permuted.
    That is exact if, without an interaction, these differences have the same distribution in all strata. Between
    units, the residuals of an additive model of strata and conditions are permuted within strata (Freedman and Lane
    1983). That is approximate: it takes residuals of a stratum to be alike, but for chance, under all conditions.

    Args:
        design: with S strata.
        stratum_names: S names.
        families: name, features `[F, n]` and numbers of blocks `[B, F]` of each family.
        permutations: random ones of the units.
        generator: draws them.
    """
    num, units = len(design.conditions), len(design.units)
    by_stratum = one_hot(design.stratum, len(stratum_names)).double()
    by_condition = one_hot(design.label, num).double()
    if design.kind == "within":
        by_stratum = by_stratum[::num]
        main, full = torch.ones(units, 1, dtype=torch.double), by_stratum
    else:
        main = torch.cat([by_stratum, by_condition], 1)
        full = (by_stratum[:, :, None] * by_condition[:, None]).flatten(1)
    main, rank = torch.from_numpy(orth(main.numpy())), int(torch.linalg.matrix_rank(full))
    if rank == main.shape[1] or units - rank < MIN_FREEDOM or design.smallest_p(permutations) >= LEVEL:
        return None
    inter = torch.from_numpy(orth((full - main @ (main.T @ full)).numpy())[:, : rank - main.shape[1]])
    cell = torch.zeros(units, dtype=torch.long) if design.kind == "within" else design.stratum
    draws = shuffle_within(cell, permutations, generator_on(generator, "cpu"))
    orders = torch.cat([torch.arange(units)[None], draws]).T
    tested, statistics = [], {}
    for name, features, numbers in families:
        values = numbers.view(units, -1, numbers.shape[1])
        if design.kind == "within":
            values = values - values.mean(1, keepdim=True)
        residual = values.flatten(1) - main @ (main.T @ values.flatten(1))
        total = residual.square().sum(0)
        residual[:, total <= ROUNDING * values.square().sum((0, 1)).repeat(values.shape[1])] = 0
        ratio = partial(_ratios, residual, len(features), main, inter)
        test = largest_statistics(ratio, orders, len(features))
        statistics[name] = test.largest
        differences = _differences(numbers, design, len(stratum_names))
        p_value = float(test.corrected.min())
        tested.append(InteractionFamily(name, features, differences, *test[:3], p_value))
    tests, p_value = combine_tests(statistics)
    enough = ", ".join(name for name, (_, corrected) in tests.items() if corrected < LEVEL)
    where = f"the difference between conditions depends on the stratum ({', '.join(stratum_names)}; {p_words(p_value)})"
    if p_value >= LEVEL:
        verdict = f"It was not found that {where}."
    else:
        verdict = f"{where[0].upper()}{where[1:]}, by the tests of {enough} (corrected)."
    return ConditionInteraction(list(stratum_names), tested, tests, p_value, verdict)


def _ratios(residual: Tensor, features: int, main: Tensor, inter: Tensor, orders: Tensor) -> Tensor:
    """`[F, p]`: the squares of the interaction by those that remain, with units in each of `orders [units, p]`."""
    bases = torch.cat([main, inter], 1)[orders].flatten(1)  # rows of the design move, which is as if units did
    squares = (residual.T @ bases).view(-1, features, orders.shape[1], main.shape[1] + inter.shape[1]).square().sum(0)
    explained = squares[..., main.shape[1] :].sum(-1)
    total = residual.square().sum(0).view(-1, features).sum(0)[:, None]
    rest = (total - squares.sum(-1)).clamp(min=LEAST_RESIDUAL * total)
    return explained / torch.where(total > 0, rest, 1)


def _differences(numbers: Tensor, design: PermutationDesign, strata: int) -> Tensor:
    """`[S, F]`: in each stratum the mean of the second of two conditions less that of the first."""
    if len(design.conditions) != 2:
        return torch.full((strata, numbers.shape[1]), nan, dtype=torch.double)
    cell = 2 * design.stratum + design.label
    sums = torch.zeros(2 * strata, numbers.shape[1], dtype=torch.double).index_add_(0, cell, numbers)
    means = (sums / cell.bincount(minlength=2 * strata)[:, None]).view(strata, 2, -1)
    return means[:, 1] - means[:, 0]
