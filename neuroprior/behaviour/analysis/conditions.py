"""Whether behaviour differs between conditions: in features of it, in bits, and for a classifier.

Everything is tested by permuting what is independent (see `neuroprior.behaviour.analysis.permutation_design`).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from math import lcm, nan

import numpy as np
import pandas as pd
import torch
from scipy.special import stdtrit
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._statistics import ENOUGH_UNITS, LEVEL, Difference, holm, p_words, ratio_difference
from neuroprior.behaviour.analysis.condition_chains import SMOOTHING, ConditionChains
from neuroprior.behaviour.analysis.flat import FlatPlans, ranks
from neuroprior.behaviour.analysis.interaction import ConditionInteraction, compare_strata
from neuroprior.behaviour.analysis.permutation_design import PermutationDesign
from neuroprior.behaviour.analysis.permutation_tests import TIE, combine_tests, largest_statistics, shares_reaching
from neuroprior.behaviour.recorded_plans import RecordedPlans, action_names, numbered_names
from neuroprior.behaviour.recordings import Recordings
from neuroprior.plans.columns import listed
from neuroprior.plans.plans import check_are_plans

FAMILIES = {
    "transitions": "{}",
    "durations": "duration of {}",
    "behaviours": "share of {} (by count)",
    "sequences": "{}",
}
"""How features of each family are called; families in the order in which they are listed.

Where a transition changes, so do the shares of its actions, and of the sequences that hold it: these come last.
"""

FEWEST_PERMUTATIONS = 999
"""Permutations that are made whatever they cost."""

ENOUGH_COUNTS = 100
"""A feature is tested if it occurred so often, or once for each block on average."""

MOST_FEATURES = {"behaviours": 1000, "transitions": 1000, "sequences": 100, "durations": 1000}
"""Of each family the commonest are tested, so many at most."""

LEAST_VARIANCE = 1e-6
"""Of all variance: the least that counts as that within conditions, as units may agree at random."""

ALIKE = 1e-12
"""The spread of shares, and of logarithms, that is a rounding error."""

MAX_WORK = 5 * 10**8
"""Numbers that permutations may compute, some ten seconds on one core; beyond, fewer are made."""


@dataclass(frozen=True, eq=False)
class ConditionFamily:
    """F features of behaviour of one kind, each with a number for each of B blocks, compared between C conditions.

    Attributes:
        name: "behaviours": the share of each action; "transitions": the probability of the second action after the
            first; "sequences": the share of each sequence of three actions among all; "durations": the mean natural
            logarithm of how long each action took.
        features: int64 `[F, n]`: the actions of each.
        values: float64 `[B, F]`: the number of each block; NaN where there is nothing to take it from.
        means: float64 `[C, F]`: the mean over the units of each condition, with `low` and `high`, its 95 % interval.
        low, high: float64 `[C, F]`; NaN where all units are alike, as how far others may be from them is unknown.
        difference: float64 `[3, F]`: the mean of the second of two conditions less that of the first, and the ends of
            its 95 % interval; NaN for more than two conditions, and the ends where all units of both are alike. With
            strata it is adjusted for them, by least squares.
        statistic: float64 `[F]`: between units Welch's t squared, or for more conditions Wald's standardised sum of
            squares; within units the F of repeated measures (for two conditions the paired t squared).
        p_values: float64 `[F]`: by permutation, of each feature alone.
        corrected: float64 `[F]`: corrected for the F features: compared with the largest statistic of all in each
            permutation (Westfall and Young 1993, single-step maxT).
        p_value: that of the largest statistic: the test of the family.
    """

    name: str
    features: Tensor
    values: Tensor
    means: Tensor
    low: Tensor
    high: Tensor
    difference: Tensor
    statistic: Tensor
    p_values: Tensor
    corrected: Tensor
    p_value: float


@dataclass(frozen=True, eq=False)
class ConditionPrediction:
    """Whether knowing the condition helps to predict the actions of a held-out unit, and the actions its condition.

    Attributes:
        gain: bits per action that the chain which knows the condition takes less than the one which does not (see
            `neuroprior.behaviour.analysis.condition_chains`), with its 95 % interval over units and its p-value by
            permutation.
        accuracy: the share of held-out blocks that have the highest likelihood under their own condition; the mean over
            conditions. A tie counts one half.
        expected: its mean over the permutations: less than 1 / C, as a unit that is held out is missing in its own
            condition.
        p_value: of the accuracy, by permutation; of equal accuracies that with the larger mean log odds is the better.
        log_odds: float64 `[B, C]`: the held-out log2-likelihood of each block under each condition, less the mean of
            those under the others.
    """

    gain: Difference
    accuracy: float
    expected: float
    p_value: float
    log_odds: Tensor


@dataclass(frozen=True, eq=False, repr=False)
class ConditionComparison:
    """Whether behaviour differs between conditions.

    Attributes:
        design: the units and blocks, and what was permuted.
        condition_names: C of them.
        families: the features of each kind; none if nothing could be tested.
        prediction: of actions from conditions and back; None if nothing could be tested.
        tests: by name, the p-value of each family, "bits" and "classifier", and the same corrected for the number of
            these tests (Westfall and Young 1993, step-down minP).
        p_value: of all tests together: the smallest corrected one; NaN if nothing could be tested. So behaviour differs
            just where one of the tests is significant.
        labellings: how many ways of giving blocks their conditions were compared, with the one observed.
        exact: whether these were all.
        smallest_p: the smallest p-value that is possible.
        conclusive: whether there are enough units for a verdict.
        verdict: one sentence or two.
        contrasts: of more than two conditions, the comparison of each two of them, with p-values that are corrected for
            the number of pairs; in their order, those that cannot be tested left out.
        interaction: whether the difference depends on the stratum; None without strata, or with too few units.
        action_names: A of them.
    """

    design: PermutationDesign
    condition_names: list[str]
    families: list[ConditionFamily]
    prediction: ConditionPrediction | None
    tests: dict[str, tuple[float, float]]
    p_value: float
    labellings: int
    exact: bool
    smallest_p: float
    conclusive: bool
    verdict: str
    contrasts: list["ConditionComparison"] = field(default_factory=list)
    interaction: ConditionInteraction | None = None
    action_names: Sequence[str] = ()

    def __repr__(self) -> str:
        """Return the verdict."""
        return f"ConditionComparison({self.verdict})"

    def frame(self) -> pd.DataFrame:
        """Return a row a feature, those that differ most first.

        The columns are `family`, `parts` (a feature's actions), `feature` (its name), `mean, low, high` of each
        condition (such as `mean, drug`), of two conditions `difference` with `low` and `high`, `p_value`, `p_corrected`
        (for the features of the family, and for the families), `significant` and `statistic`. Durations are geometric
        means and ratios.
        """
        if not self.families:
            return pd.DataFrame(columns=["family", "parts", "feature", "p_value", "p_corrected", "significant"])
        frame = pd.concat([self._rows(family) for family in self.families], ignore_index=True)
        rank = frame["family"].map({name: place for place, name in enumerate(FAMILIES)})
        keys = {"rank": rank.where(frame["significant"], len(FAMILIES)), "size": -frame["statistic"]}
        frame = frame.assign(**keys).sort_values(["rank", "p_corrected", "p_value", "size"], kind="stable")
        return frame.drop(columns=list(keys)).reset_index(drop=True)

    def _rows(self, family: ConditionFamily) -> pd.DataFrame:
        scaled = np.exp if family.name == "durations" else np.asarray
        rows = pd.DataFrame({"family": family.name, "place": range(len(family.features))})
        rows["parts"] = [[self.action_names[action] for action in feature] for feature in family.features.tolist()]
        rows["feature"] = feature_names(family.name, rows["parts"])
        for name, *values in zip(self.condition_names, family.means, family.low, family.high, strict=True):
            for what, numbers in zip(("mean", "low", "high"), values, strict=True):
                rows[f"{what}, {name}"] = scaled(numbers.numpy())
        if len(self.condition_names) == 2:
            for what, numbers in zip(("difference", "low", "high"), family.difference, strict=True):
                rows[what] = scaled(numbers.numpy())
        rows["p_value"], rows["p_corrected"] = family.p_values.numpy(), self.corrected(family).numpy()
        rows["significant"], rows["statistic"] = self.significant(family).numpy(), family.statistic.numpy()
        return rows

    def differs(self, name: str) -> bool:
        """Whether the test of this name is significant, corrected; never where there are too few units."""
        return self.conclusive and name in self.tests and self.tests[name][1] < LEVEL

    def corrected(self, family: ConditionFamily) -> Tensor:
        """`[F]`, float64: the p-value of each feature, corrected for its family, or that of the family if larger."""
        return family.corrected.clamp(min=self.tests[family.name][1] if family.name in self.tests else 1.0)

    def significant(self, family: ConditionFamily) -> Tensor:
        """`[F]` bool: the features that differ, in a family that does."""
        return (self.corrected(family) < LEVEL) & self.conclusive


def feature_names(family: str, features: Iterable[Sequence[str]]) -> list[str]:
    """Return what features of a family are called, from the names of their actions."""
    joint = " → " if family == "transitions" else " "
    return [FAMILIES[family].format(joint.join(actions)) for actions in features]


def compare_conditions(
    plans: RecordedPlans | Recordings, permutations: int = 9_999, generator: torch.Generator | None = None
) -> ConditionComparison:
    """Whether behaviour differs between the conditions of plans.

    Units are groups (plans, where there are no groups). If each is under one condition, the conditions are permuted
    among units; if units are under several, among the blocks of each unit. All labellings are compared where there
    are no more than `permutations` + 1. So the tests hold however alike the plans of a unit are. The null hypothesis is
    that units (blocks of a unit) under different conditions have the same distribution; statistics are studentised, so
    that for many units differences in mean matter alone (Janssen 1997).

    With a `stratum`, such as the sex of each unit, conditions are permuted among the units of each stratum, and what a
    stratum has in common is no difference between conditions; see `ConditionComparison.interaction` on differences
    that depend on it. Of more than two conditions each two are compared as well, on their plans alone. Such a test of
    a pair counts if that of all conditions does, too. Its p-value is corrected for the pairs (Holm), but not for the
    three of three conditions: if one pair differs, only one other may not (closed testing, Marcus et al. 1976).

    Each feature is one number for each block. As rare ones are noisy, a block's number is smoothed in tests, as if
    `SMOOTHING` observations more were as in all units (in designs within units: in the whole unit), and weighted in
    means by n / (n + `SMOOTHING`) for n observations. Neither depends on the conditions, nor does the choice of
    features: the commonest that occurred at least `ENOUGH_COUNTS` times, or once for each block on average. Durations
    of 0 and unknown ones do not count.

    Args:
        plans: with a `condition`, and perhaps a `stratum`. An end symbol is an action like others.
        permutations: at most so many random ones; fewer where they take more than `MAX_WORK`, but at least
            `FEWEST_PERMUTATIONS`.
        generator: draws them.

    Raises:
        ValueError: the plans have no condition, a group is in several strata, or `permutations` is below 1.

    Example:
        >>> first, second = torch.tensor([[0, 1] * 10]).repeat(8, 1), torch.tensor([[0, 0, 1, 1] * 5]).repeat(8, 1)
        >>> condition = torch.arange(16) // 8
        >>> plans = RecordedPlans(torch.cat([first, second]), 2, group=torch.arange(16), condition=condition)
        >>> comparison = compare_conditions(plans, permutations=199, generator=torch.Generator().manual_seed(0))
        >>> comparison.p_value < 0.05
        True
    """
    if isinstance(plans, Recordings):
        plans = plans.plans()
    check_are_plans(plans)
    plans = RecordedPlans.of(plans)
    check_sizes(permutations=permutations)
    comparison = _compare(plans, permutations, generator)
    if len(comparison.condition_names) < 3 or comparison.prediction is None:
        return comparison
    assert plans.condition is not None
    pairs = [
        _compare(plans[torch.isin(plans.condition, torch.stack(pair))], permutations, generator, with_strata=False)
        for pair in combinations(comparison.design.conditions.to(plans.actions.device), 2)
    ]
    contrasts = _correct_pairs(comparison, [pair for pair in pairs if pair.prediction is not None])
    differing = [" and ".join(pair.condition_names) for pair in contrasts if pair.conclusive and pair.p_value < LEVEL]
    said = f" Of two conditions, there differ {'; '.join(differing)} (corrected)." if differing else ""
    return replace(comparison, contrasts=contrasts, verdict=comparison.verdict + said)


def _compare(
    plans: RecordedPlans, permutations: int, generator: torch.Generator | None, with_strata: bool = True
) -> ConditionComparison:
    """The comparison of all conditions, without contrasts; on request with the interaction of conditions and strata."""
    design = PermutationDesign.of(plans)
    names = numbered_names(plans.condition_names, design.conditions, "condition")
    if design.untestable:
        verdict = " ".join(f"{text}." for text in (f"Not tested: {design.untestable}", design.odd) if text)
        return ConditionComparison(design, names, [], None, {}, nan, 0, False, nan, False, verdict)
    strata = numbered_names(plans.stratum_names, design.strata, "stratum")
    kept = (design.block >= 0).to(plans.actions.device)
    plans, of_plan = plans[kept], design.block[design.block >= 0]
    flat = _move_to_cpu(FlatPlans.of(plans))
    block = of_plan[flat.plan]
    family_numbers = [_Numbers(*family, design) for family in _count_families(plans, flat, block, len(design.label))]
    chains = ConditionChains.of(flat, block, design.unit, design.stratum)
    num = len(names)
    cost = num * (chains.cost + sum(numbers.smoothed.numel() for numbers in family_numbers) // 8)
    drawn = min(permutations, max(MAX_WORK // max(cost, 1), FEWEST_PERMUTATIONS))
    labellings = design.labellings(drawn, generator)
    families, statistics = [], {}
    for numbers in family_numbers:
        family, statistics[numbers.name] = _test_family(numbers, design, labellings)
        families.append(family)
    prediction, statistics["bits"], statistics["classifier"] = _predict(
        chains, design, labellings, block.bincount().double()
    )
    tests, p_value = combine_tests(statistics)
    smallest = design.smallest_p(drawn)
    conclusive = smallest < LEVEL and len(design.units) >= ENOUGH_UNITS
    verdict = _verdict(design, names, tests, p_value, smallest, conclusive) + f" {design.odd}." * bool(design.odd)
    exact = design.possible <= drawn + 1
    interaction = None
    if with_strata and len(strata) > 1:
        smoothed = [(numbers.name, numbers.features, numbers.smoothed) for numbers in family_numbers]
        interaction = compare_strata(design, strata, smoothed, drawn, generator)
    return ConditionComparison(
        design,
        names,
        families,
        prediction,
        tests,
        p_value,
        labellings.shape[1],
        exact,
        smallest,
        conclusive,
        verdict,
        interaction=interaction,
        action_names=action_names(plans),
    )


def _correct_pairs(whole: ConditionComparison, pairs: list[ConditionComparison]) -> list[ConditionComparison]:
    """Comparisons of two conditions with p-values that are corrected for their number, and for the test of all."""

    def correct(p_values: list[float], of_all: float) -> list[float]:
        corrected = p_values if len(whole.condition_names) == 3 else holm(p_values).tolist()
        return [max(p_value, of_all) for p_value in corrected]

    every = correct([pair.p_value for pair in pairs], whole.p_value)
    names = [name for name in whole.tests if all(name in pair.tests for pair in pairs)]
    of_tests = {name: correct([pair.tests[name][1] for pair in pairs], whole.tests[name][1]) for name in names}
    contrasts = []
    for place, (pair, p_value) in enumerate(zip(pairs, every, strict=True)):
        tests = {name: (pair.tests[name][0], of_tests[name][place]) for name in names}
        verdict = _verdict(pair.design, pair.condition_names, tests, p_value, pair.smallest_p, pair.conclusive)
        contrasts.append(replace(pair, tests=tests, p_value=p_value, verdict=verdict))
    return contrasts


class _Numbers:
    """The features of a family: `smoothed [B, F]` for tests, `values [B, F]` with `weights [B, F]` for means."""

    def __init__(self, name: str, features: Tensor, above: Tensor, below: Tensor, design: PermutationDesign) -> None:
        self.name, self.features = name, features
        self.values = above / below  # 0 / 0 is NaN
        self.weights = below / (below + SMOOTHING)
        usual = (self.weights * self.values.nan_to_num()).sum(0) / self.weights.sum(0)
        if design.kind == "within":
            shape = len(design.units), len(design.conditions), -1
            usual = (above.view(shape).sum(1) + SMOOTHING * usual) / (below.view(shape).sum(1) + SMOOTHING)
            usual = usual[design.unit]
        self.smoothed = (above + SMOOTHING * usual) / (below + SMOOTHING)


def _move_to_cpu(flat: FlatPlans) -> FlatPlans:
    return FlatPlans(flat.actions.cpu(), flat.plan.cpu(), flat.place.cpu(), flat.num_actions)


def _count_families(
    plans: RecordedPlans, flat: FlatPlans, block: Tensor, num: int
) -> Iterator[tuple[str, Tensor, Tensor, Tensor]]:
    """Name, features `[F, n]`, and the two sums `[B, F]` whose ratio is the number of a block, of each family."""
    ones = torch.ones(len(block), dtype=torch.double)
    for name, length in (("behaviours", 1), ("transitions", 2), ("sequences", 3)):
        at = flat.starts(length)
        features, _, counts = _sums(flat, at, length, block, num, name, ones)
        if not len(features):
            continue
        below = counts.new_zeros(num, 1).index_add_(0, block[at], ones[at][:, None]).expand_as(counts)
        if name == "transitions":
            first, rank = flat.actions[at].unique(return_inverse=True)
            rows = (block[at] * len(first) + rank).bincount(minlength=num * len(first)).view(num, -1).double()
            below = rows[:, torch.searchsorted(first, features[:, 0].contiguous())]
        yield name, features, counts, below
    if plans.durations is not None:
        times = plans.durations.flatten().cpu()[flat.place].double()
        at = (times > 0).nonzero()[:, 0]
        features, logs, counts = _sums(flat, at, 1, block, num, "durations", times.log())
        if len(features):
            yield "durations", features, logs, counts


def _sums(
    flat: FlatPlans, at: Tensor, length: int, block: Tensor, num: int, name: str, values: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Those of the sequences that begin `at` which are tested `[F, n]`; sums of `values`, and counts, in each block."""
    rank = torch.zeros_like(at)
    for step in range(length):
        rank = ranks(rank * flat.num_actions + flat.actions[at + step])
    total = rank.bincount()
    common = total.argsort(descending=True, stable=True)[: MOST_FEATURES[name]]
    chosen = common[total[common] >= min(num, ENOUGH_COUNTS)].sort().values
    somewhere, place = torch.zeros_like(total), torch.full_like(total, -1)
    somewhere[rank], place[chosen] = at, torch.arange(len(chosen))
    features = flat.actions[somewhere[chosen][:, None] + torch.arange(length)]
    taken = place[rank] >= 0
    cell = block[at[taken]] * len(chosen) + place[rank[taken]]
    counts = cell.bincount(minlength=num * len(chosen)).view(num, len(chosen)).double()
    sums = cell.bincount(values[at[taken]], minlength=num * len(chosen)).view(num, len(chosen))
    return features, sums, counts


def _test_family(numbers: _Numbers, design: PermutationDesign, labellings: Tensor) -> tuple[ConditionFamily, Tensor]:
    """The family, and its largest statistic under each labelling `[P]`."""
    compute = partial(_statistics, numbers.smoothed, design)
    test = largest_statistics(compute, labellings, len(numbers.features))
    means, low, high, difference = _estimates(numbers, design)
    family = ConditionFamily(
        numbers.name,
        numbers.features,
        numbers.values,
        means,
        low,
        high,
        difference,
        *test[:3],
        float(test.corrected.min()),
    )
    return family, test.largest


def _statistics(values: Tensor, design: PermutationDesign, labellings: Tensor) -> Tensor:
    """`[F, P]`: how unlike the conditions are, for `values [B, F]` under each of `labellings [B, P]`."""
    num, within = len(design.conditions), design.kind == "within"
    if within:
        # What a unit has in common is no difference between conditions.
        whole = values.view(len(design.units), num, -1)
        values = (whole - whole.mean(1, keepdim=True)).view_as(values)
    else:
        values = values - _stratum_means(values, torch.ones_like(values), design)
    spread = values.square().mean(0).sqrt()
    alike = spread <= ALIKE * values.abs().amax(0).clamp(min=1)
    values = (values / torch.where(alike, 1, spread)).masked_fill(alike, 0).T.contiguous()
    squares, units = values.square(), len(design.units)
    weights, means = [], []
    for condition, size in enumerate(design.sizes):
        taken = (labellings == condition).double()
        mean = values @ taken / size
        means.append(mean)
        if not within:
            variance = (squares @ taken / size - mean.square()).clamp(min=LEAST_VARIANCE) * size / (size - 1)
            weights.append(size / variance)
    if within:
        between = units * sum(mean.square() for mean in means)
        residual = (squares.sum(1, keepdim=True) - between).clamp(min=LEAST_VARIANCE * len(design.label))
        return between / residual * (units - 1)
    common = sum(w * mean for w, mean in zip(weights, means, strict=True)) / sum(weights)
    parts = [w * (mean - common).square() for w, mean in zip(weights, means, strict=True)]
    return torch.stack(parts).sum(0) / (num - 1)


def _estimates(numbers: _Numbers, design: PermutationDesign) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The mean of each condition with its interval, each `[C, F]`, and the difference of two with its own `[3, F]`."""
    values, weights = numbers.values.nan_to_num(), numbers.weights
    each = [_mean(values[design.label == k], weights[design.label == k]) for k in range(len(design.conditions))]
    mean, error, freedom = (torch.stack(parts) for parts in zip(*each, strict=True))
    half = _half(error, freedom)
    difference = torch.full((3, values.shape[1]), nan, dtype=torch.double)
    if len(mean) == 2:
        if design.kind == "within":
            pair, sizes = values.view(-1, 2, values.shape[1]), weights.view(-1, 2, values.shape[1])
            # n / (n + s) for half the harmonic mean, n, of the two numbers of observations.
            both = 1 / (1 / sizes - 1).sum(1).add(1)
            gap, gap_error, gap_freedom = _mean(pair[:, 1] - pair[:, 0], both)
        else:
            gap, gap_error, gap_freedom = _stratified_gap(values, weights, design)
        gap_half = _half(gap_error, gap_freedom)
        difference = torch.stack([gap, gap - gap_half, gap + gap_half])
    return mean, mean - half, mean + half, difference


def _stratified_gap(values: Tensor, weights: Tensor, design: PermutationDesign) -> tuple[Tensor, Tensor, Tensor]:
    """The second of two conditions less the first, within strata; its standard error, and degrees of freedom.

    By weighted least squares, errors from leaving out one unit at a time; without strata the difference of means. The
    degrees of freedom are Welch's and Satterthwaite's, of as many units as there would be of equal weights.
    """
    second = design.label.double()[:, None].expand_as(values)
    second = second - _stratum_means(second, weights, design)
    values = values - _stratum_means(values, weights, design)
    scale = (weights * second.square()).sum(0)
    gap = (weights * second * values).sum(0) / scale
    totals = torch.zeros(len(design.strata), weights.shape[1], dtype=torch.double)
    totals = totals.index_add_(0, design.stratum, weights)[design.stratum]
    leverage = weights / totals + weights * second.square() / scale
    squares = (weights * second * (values - gap * second) / scale / (1 - leverage)).square()
    by_condition = torch.stack([design.label == 0, design.label == 1]).double()
    lost = (len(design.strata) + 1) / 2
    units = by_condition @ (weights > 0).double()
    variance = by_condition @ squares * torch.where(units > lost, 1 - lost / units, nan)
    # Where all units are alike, as where none does a thing, others may differ as much as those of the other condition.
    reach = by_condition @ (weights * second / scale).square()
    variance = torch.where(variance <= ALIKE**2, variance.flip(0) * reach / reach.flip(0), variance)
    freedom = (_count_equal(by_condition, weights) - lost).clamp(min=1)
    return gap, variance.sum(0).sqrt(), variance.sum(0).square() / (variance.square() / freedom).sum(0)


def _stratum_means(values: Tensor, weights: Tensor, design: PermutationDesign) -> Tensor:
    """`[B, F]`: the weighted mean of `values [B, F]` over the stratum of each block; 0 without weight."""
    sums, total = torch.zeros(2, len(design.strata), values.shape[1], dtype=torch.double)
    sums.index_add_(0, design.stratum, weights * values)
    total.index_add_(0, design.stratum, weights)
    means: Tensor = (sums / total).nan_to_num()[design.stratum]
    return means


def _mean(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The weighted mean of `[U, F]` over units, its standard error (jackknife), and degrees of freedom."""
    units, total = (weights > 0).sum(0).double(), weights.sum(0)
    mean = (weights * values).sum(0) / total
    changes = weights * (values - mean) / (total - weights)
    error = (changes.square().sum(0) * torch.where(units > 1, 1 - 1 / units, nan)).sqrt()
    return mean, error, (_count_equal(torch.ones(len(weights), dtype=torch.double), weights) - 1).clamp(min=1)


def _count_equal(chosen: Tensor, weights: Tensor) -> Tensor:
    """`[..., F]`: as how many units of equal weights those count that are `chosen [..., U]` (Kish 1965, 11.7)."""
    return (chosen @ weights).square() / (chosen @ weights.square())


def _half(error: Tensor, freedom: Tensor) -> Tensor:
    """Half the width of Student's interval; NaN without spread."""
    student = torch.from_numpy(np.asarray(stdtrit(freedom.numpy(), 0.975)))
    return torch.where(error <= ALIKE, nan, student * error)


def _predict(
    chains: ConditionChains, design: PermutationDesign, labellings: Tensor, actions: Tensor
) -> tuple[ConditionPrediction, Tensor, Tensor]:
    """The prediction; the bits that knowing the condition saves, and the accuracy, under each labelling `[P]`."""
    num = len(design.conditions)
    gains = chains.gains(labellings, num)  # [C, B, P]
    right = gains.gather(0, labellings.long()[None])[0]
    bits = right.sum(0)
    others = gains.scatter(0, labellings.long()[None], -torch.inf).amax(0)
    near = TIE * (1 + right.abs())
    credit = (right > others + near).double() + ((right - others).abs() <= near) / 2
    share = torch.zeros_like(bits)
    for condition, size in enumerate(design.sizes):
        share += (credit * (labellings == condition)).sum(0) / (num * size)
    odds = (num * gains - gains.sum(0)) / (num - 1)
    right_odds = (num * right - gains.sum(0)) / (num - 1) / actions[:, None]
    # Accuracies differ by no less than this: of equal ones the larger log odds are the better.
    step = 1 / (2 * num * lcm(*design.sizes))
    order = share + step * torch.tanh(right_odds.mean(0)) / 2
    units = len(design.units)
    saved = torch.zeros(units, dtype=torch.double).index_add_(0, design.unit, right[:, 0])
    sizes = torch.zeros(units, dtype=torch.double).index_add_(0, design.unit, actions)
    mean, low, high, _ = ratio_difference(saved, sizes)
    gain = Difference(mean, low, high, float(shares_reaching(bits)[0]))
    p_value = float(shares_reaching(order)[0])
    return ConditionPrediction(gain, float(share[0]), float(share.mean()), p_value, odds[:, :, 0].T), bits, order


def _verdict(
    design: PermutationDesign,
    names: list[str],
    tests: dict[str, tuple[float, float]],
    p_value: float,
    smallest: float,
    conclusive: bool,
) -> str:
    sizes = " against ".join(map(str, design.sizes)) if design.kind == "between" else str(len(design.units))
    units = f"{sizes} {design.item}" + " under every condition" * (design.kind == "within")
    power = f"With {units} the smallest possible is {p_words(smallest)}"
    if smallest >= LEVEL:
        return f"{power}: no test can find a difference."
    if not conclusive:
        return f"{units[0].upper()}{units[1:]} are too few for a verdict."
    between = f"between {names[0]} and {names[1]}" if len(names) == 2 else f"between the {len(names)} conditions"
    if p_value >= LEVEL:
        return f"No difference {between} was found ({p_words(p_value)}, corrected). {power}."
    where = listed([name for name, (_, corrected) in tests.items() if corrected < LEVEL])
    return f"Behaviour differs {between} ({p_words(p_value)}), by the tests of {where} (corrected)."
