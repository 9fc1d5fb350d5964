"""Drift of surprisal: how it changes within plans, from plan to plan of a group, and between groups.

The surprisal of an action is its negative log2-probability under a prior, in bits.
"""

from dataclasses import dataclass
from functools import cache
from itertools import permutations
from math import nan

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import special, stats
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._statistics import Difference, Interval, ratio_difference
from neuroprior.behaviour.analysis.comparison import units
from neuroprior.behaviour.recorded_plans import RecordedPlans, join_fragments
from neuroprior.plans import Plans
from neuroprior.plans.folds import FEWEST_UNITS
from neuroprior.plans.plans import check_are_plans

FEWEST_RANKED = 3
"""Plans without which there is no rank correlation to test."""

DIGITS = 7
"""To so many digits bits per action are compared: a prior's are in single precision."""

EXACT = 7
"""Plans up to which the p-value of a rank correlation is computed from all their orders."""


@dataclass(frozen=True, eq=False)
class PositionDrift:
    """Bits per action from the beginning to the end of plans.

    Attributes:
        parts: bits per action in each part, with the 95 % interval over units; NaN in a part without actions, and
            without an interval in one where only one unit has any.
        actions: int64 `[parts]`: the number of actions in each.
        trend: the change in bits per action from beginning to end of a plan, by a straight line (below 0: plans become
            easier to predict), with its interval over units and the p-value of 0.
    """

    parts: list[Interval]
    actions: Tensor
    trend: Difference


@dataclass(frozen=True, eq=False)
class PlanDrift:
    """Bits per action of each plan, in the order of the file within its group; groups in the order of their first plan.

    A single plan is cut into `BLOCKS` parts, which take the place of plans (`item` is "parts").

    Attributes:
        item: "sequences" or "parts".
        index: int64 `[K]`: the number of the plan (or part).
        group: int64 `[K]`: the number of its group; 0 without groups.
        bits, actions: float64 `[K]`: its bits per action, and how many actions count.
        correlations: by the number of each group with at least three plans, Spearman's rank correlation of the order of
            its plans and their bits per action (below 0: plans become easier to predict), with a 95 % interval
            (Fisher's; -1 to 1 for three plans) and the p-value of 0.
        trend: the mean of the correlations, with Student's interval and p-value over groups; of a single group its
            correlation; None without any.
    """

    item: str
    index: Tensor
    group: Tensor
    bits: Tensor
    actions: Tensor
    correlations: dict[int, Difference]
    trend: Difference | None


@dataclass(frozen=True, eq=False)
class GroupDrift:
    """Bits per action of each group.

    Attributes:
        groups: by the number of each group, ascending, its bits per action with the 95 % interval over its plans; the
            ends are NaN if it has only one. If there is only one plan in all, the interval is over its parts.
        p_value: of the hypothesis that groups do not differ: the test of Kruskal and Wallis (1952) on the plans' bits
            per action, for groups with two plans or more; None with fewer than two such groups.
    """

    groups: dict[int, Interval]
    p_value: float | None


@dataclass(frozen=True, eq=False)
class _Counted:
    """For the M actions that count, in the order of the file: bits, plan, place in it (0 to 1), unit; `[M]` each."""

    bits: Tensor
    plan: Tensor
    place: Tensor
    unit: Tensor


def by_position(plans: Plans, bits: Tensor, mask: Tensor, parts: int = 10) -> PositionDrift:
    """How surprisal changes from the beginning to the end of plans.

    The trend is the least-squares slope of bits on the relative position in the plan (0 to 1), common to all plans,
    after the means of each plan are subtracted. Its error is that of a ratio over units
    (`neuroprior.behaviour.ratio_difference`). The units are those of `neuroprior.behaviour.units`, so that a single
    long plan has a trend too.

    Args:
        plans: the plans.
        bits: floating point `[N, L]`: the surprisal of each action, such as `neuroprior.behaviour.action_bits` of a
            prior that was not fitted to these plans.
        mask: bool `[N, L]`: the actions that count (held out), none beyond a plan's end.
        parts: number of equal parts into which each plan is cut. Short plans have actions in some of them only.

    Raises:
        ValueError: a wrong shape or dtype, bits that are not finite, fewer than two units with actions, no plan with
            two actions that count, or no parts.

    Example:
        >>> plans = Plans(torch.randint(2, (6, 20), generator=torch.Generator().manual_seed(0)), 2)
        >>> len(by_position(plans, action_bits(UniformPrior(2), plans), plans.mask(), parts=4).parts)
        4
    """
    check_sizes(parts=parts)
    counted = _count_actions(*_join_plans(plans, bits, mask))
    place = counted.place
    part_index = (place * parts).long().clamp(max=parts - 1)
    intervals = []
    for k in range(parts):
        kept = part_index == k
        intervals.append(_interval(counted.bits[kept], counted.unit[kept]) if kept.any() else Interval(nan, nan, nan))
    off, excess = _deviations(place, counted.plan), _deviations(counted.bits, counted.plan)
    if float(off.square().sum()) < 1e-12:
        raise ValueError("`mask` must have two actions of one plan, for a trend within plans.")
    trend = ratio_difference(_sums(off * excess, counted.unit), _sums(off.square(), counted.unit))
    return PositionDrift(intervals, part_index.bincount(minlength=parts).cpu(), trend)


def by_plan(plans: Plans, bits: Tensor, mask: Tensor) -> PlanDrift:
    """How surprisal changes from plan to plan of a group, in the order of the file.

    Args:
        plans, bits, mask: as for `by_position`.

    Raises:
        ValueError: as for `by_position`, except that one action per plan is enough.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1], [0, 0], [1, 1], [1, 0]]), 2)
        >>> drift = by_plan(plans, action_bits(UniformPrior(2), plans), plans.mask())
    """
    plans, bits, mask = _join_plans(plans, bits, mask)
    item, index, group, totals, actions = _items(plans, _count_actions(plans, bits, mask))
    numbers, inverse = group.unique(return_inverse=True)
    first = torch.full((len(numbers),), len(group)).scatter_reduce(0, inverse, torch.arange(len(group)), "amin")
    order = first[inverse].argsort(stable=True)
    surprisal, inverse = (totals / actions)[order], inverse[order]
    correlations: dict[int, Difference] = {}
    starts = first.sort().indices  # ranks of groups in the order of their first plan
    sizes = inverse.bincount(minlength=len(numbers))[starts].tolist()
    for number, group_bits in zip(numbers[starts].tolist(), surprisal.split(sizes), strict=True):
        if len(group_bits) >= FEWEST_RANKED:
            correlations[number] = _rank_correlation(_round(group_bits.numpy()))
    means = [one.mean for one in correlations.values()]
    trend = next(iter(correlations.values()), None)
    if len(means) >= FEWEST_UNITS:
        trend = _mean_correlation(means)
    return PlanDrift(item, index[order], group[order], surprisal, actions[order], correlations, trend)


def by_group(plans: Plans, bits: Tensor, mask: Tensor) -> GroupDrift:
    """How surprisal differs between groups; without groups, all plans are of group 0.

    Args:
        plans, bits, mask: as for `by_position`.

    Raises:
        ValueError: as for `by_position`, except that one action per plan is enough.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1], [0, 0], [1, 1], [1, 0]]), 2, group=torch.tensor([0, 0, 1, 1]))
        >>> drift = by_group(plans, action_bits(UniformPrior(2), plans), plans.mask())
    """
    plans, bits, mask = _join_plans(plans, bits, mask)
    _, _, group, totals, actions = _items(plans, _count_actions(plans, bits, mask))
    order = group.argsort(stable=True)
    numbers, sizes = group.unique(return_counts=True)
    parts = list(zip(totals[order].split(sizes.tolist()), actions[order].split(sizes.tolist()), strict=True))
    means = {number: _ratio(*sums) for number, sums in zip(numbers.tolist(), parts, strict=True)}
    several = [(total / size).numpy() for total, size in parts if len(size) > 1]
    if len(several) < FEWEST_UNITS:
        return GroupDrift(means, None)
    together = _round(np.concatenate(several))
    if (together == together[0]).all():
        return GroupDrift(means, 1.0)
    ends = np.cumsum([len(values) for values in several])[:-1]
    return GroupDrift(means, float(stats.kruskal(*np.split(together, ends)).pvalue))


def _join_plans(plans: Plans, bits: Tensor, mask: Tensor) -> tuple[Plans, Tensor, Tensor]:
    """The plans, bits and mask with the fragments of each recording joined to one plan, after checks."""
    check_are_plans(plans)
    shape = plans.actions.shape
    if bits.shape != shape:
        raise ValueError(f"`bits` must have the shape {list(shape)} of the actions, got {list(bits.shape)}.")
    if mask.shape != shape or mask.dtype != torch.bool:
        raise ValueError(f"`mask` must be bool of shape {list(shape)}, got {mask.dtype} {list(mask.shape)}.")
    within = plans.mask().to(bits.device)
    if bool((mask.to(bits.device) & ~within).any()):
        where = (mask.to(bits.device) & ~within).nonzero()[0].tolist()
        raise ValueError(f"`mask{where}` must be False, where the plan has ended.")
    plans, bits, mask = join_fragments(plans, bits, mask)
    return plans, bits, mask


def _count_actions(plans: Plans, bits: Tensor, mask: Tensor) -> _Counted:
    """The actions that count, after checks; on the device of `bits`. The fragments of a recording are one plan."""
    mask = mask.to(bits.device)
    if not bool(bits[mask].isfinite().all()):
        where = (mask & ~bits.isfinite()).nonzero()[0].tolist()
        raise ValueError(f"`bits{where}` must be finite, got {float(bits[tuple(where)])}.")
    unit = units(plans, mask)[mask]
    if len(unit) == 0 or bool((unit == unit[0]).all()):
        raise ValueError(f"`mask` must have at least two actions that count, got {len(unit)}.")
    return _Counted(bits[mask].double(), mask.nonzero()[:, 0], _places(plans, mask), unit)


def _places(plans: Plans, mask: Tensor) -> Tensor:
    """Where in its plan each action that counts is, 0 to 1: in time, where all times are known, else by its number."""
    plan, step = mask.nonzero().unbind(1)
    within = plans.mask().to(mask.device)
    began = plans.began if isinstance(plans, RecordedPlans) else None
    if began is not None and bool(began[within].isfinite().all()):
        began = began.to(mask.device)
        low = began.masked_fill(~within, torch.inf).amin(1)
        span = began.masked_fill(~within, -torch.inf).amax(1) - low
        if bool((span > 0).all()):
            return (began[mask] - low[plan]) / span[plan]
    return (step + 0.5) / within.sum(1)[plan]


def _items(plans: Plans, counted: _Counted) -> tuple[str, Tensor, Tensor, Tensor, Tensor]:
    """Plans, or the parts of a single one: which of the two, and their numbers, groups, bits and actions `[K]`."""
    single = bool((counted.plan == counted.plan[0]).all())
    index, item = (counted.unit if single else counted.plan).unique(return_inverse=True)
    totals, actions = _sums(counted.bits, item).cpu(), item.bincount().double().cpu()
    group = torch.zeros(len(index), dtype=torch.long)
    if plans.group is not None:
        group = plans.group.cpu().long()[counted.plan[:1].expand(len(index)).cpu() if single else index.cpu()]
    return "parts" if single else "sequences", index.cpu(), group, totals, actions


def _sums(values: Tensor, index: Tensor, num: int | None = None) -> Tensor:
    """The sums `[K]` of values `[M]` by their index."""
    size = int(index.max()) + 1 if num is None else num
    return values.new_zeros(size).index_add_(0, index, values)


def _deviations(values: Tensor, plan: Tensor) -> Tensor:
    """Values `[M]` less the mean of their plan."""
    means = _sums(values, plan) / plan.bincount().clamp(min=1)
    return values - means[plan]


def _interval(bits: Tensor, unit: Tensor) -> Interval:
    """Bits per action over the units that have any."""
    rank = unit.unique(return_inverse=True)[1]
    return _ratio(_sums(bits, rank), rank.bincount().double())


def _ratio(totals: Tensor, sizes: Tensor) -> Interval:
    """A ratio over units `[G]`, without an interval if there is only one."""
    if len(sizes) < FEWEST_UNITS:
        return Interval(float(totals.sum() / sizes.sum()), nan, nan)
    return Interval(*ratio_difference(totals, sizes)[:3])


def _round(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values to be ranked, rounded to `DIGITS` digits of the largest: means of the same bits are equal then."""
    largest = float(np.abs(values).max())
    return np.round(values / largest, DIGITS) if largest > 0 else values


def _rank_correlation(values: NDArray[np.float64]) -> Difference:
    """Spearman's rank correlation of values `[K]` with their order, for K >= `FEWEST_RANKED`; 0 if all are equal.

    The interval is Fisher's (-1 to 1 where that is undefined), the p-value that of all orders for up to `EXACT` values,
    else Student's approximation.
    """
    num = len(values)
    if (values == values[0]).all():
        return Difference(0.0, -1.0, 1.0, 1.0)
    ranks = stats.rankdata(values)
    ranks = (ranks - ranks.mean()) / np.linalg.norm(ranks - ranks.mean())
    order = np.arange(num) - (num - 1) / 2
    order /= np.linalg.norm(order)
    correlation = round(float(order @ ranks), 12)  # so that a perfect one is 1
    if num <= EXACT:  # Student's approximation would be certain of three values in ascending order
        every = order[_orders(num)] @ ranks
        p_value = float((np.abs(every) >= abs(correlation) - 1e-9).mean())
    else:
        t = correlation * np.sqrt((num - 2) / max(1 - correlation**2, 1e-12))
        p_value = float(2 * special.stdtr(num - 2, -abs(t)))
    if num <= FEWEST_RANKED or abs(correlation) == 1:
        return Difference(correlation, -1.0, 1.0, p_value)
    # 1.06: the variance for ranks (Fieller, Hartley and Pearson 1957).
    centre, half = np.arctanh(correlation), special.ndtri(0.975) * np.sqrt(1.06 / (num - 3))
    return Difference(correlation, float(np.tanh(centre - half)), float(np.tanh(centre + half)), p_value)


def _mean_correlation(correlations: list[float]) -> Difference:
    """The mean of the correlations of two groups or more, with Student's interval, cut at -1 and 1."""
    mean, low, high, p_value = ratio_difference(correlations, np.ones(len(correlations)))
    if len(set(correlations)) == 1 and mean != 0:
        # Correlations of few plans are often equal at random, without any spread: a sign test instead.
        return Difference(mean, -1.0, 1.0, 2.0 ** (1 - len(correlations)))
    return Difference(mean, max(low, -1.0), min(high, 1.0), p_value)


@cache
def _orders(num: int) -> NDArray[np.int64]:
    """All orders of a few values, `[num!, num]`."""
    return np.array(list(permutations(range(num))))
