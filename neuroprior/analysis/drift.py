"""Drift: how costs and actions change within plans, from plan to plan of a group, and between groups."""

from dataclasses import dataclass, replace
from math import nan

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior.analysis.comparison import units
from neuroprior.analysis.ranks import FEWEST_RANKED, mean_correlation, rank_correlation
from neuroprior.analysis.statistics import Difference, Interval, holm, ratio_difference
from neuroprior.plans import Plans
from neuroprior.plans.folds import BLOCKS, FEWEST_UNITS


@dataclass(frozen=True, eq=False)
class PositionDrift:
    """Bits per action from the beginning to the end of plans.

    Attributes:
        parts: bits per action in each part, with the 95 % interval over units; NaN in a part without actions, and for
            the ends of one in which a single unit has any.
        actions: int64 `[parts]`: how many actions fall in each.
        trend: bits per action that a straight line gains over the length of a plan (below 0: plans get easier to
            predict), with its interval over units and the p-value of 0.
    """

    parts: list[Interval]
    actions: Tensor
    trend: Difference


@dataclass(frozen=True, eq=False)
class PlanDrift:
    """Bits per action of each plan, in the order of the file within its group; groups in the order of their first plan.

    A single plan is cut in `neuroprior.analysis.comparison.BLOCKS` parts, which stand for plans (`item` is "parts").

    Attributes:
        item: "plans" or "parts".
        index: int64 `[K]`: which plan of `plans` (or which part).
        group: int64 `[K]`: the group's number; 0 where there are none.
        bits, actions: float64 `[K]`: bits per action, and how many actions count.
        correlations: of each group with at least three plans, its number and Spearman's rank correlation of the plans'
            order and their bits per action (below 0: plans get easier to predict), with a 95 % interval (Fisher's; -1
            to 1 of three plans) and the p-value of 0.
        trend: their mean over groups, with Student's interval and p-value; that of the only group where there is one;
            None without any.
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
        groups: for each group's number, in ascending order, its bits per action with the 95 % interval over its plans;
            NaN for the ends where it has a single one. A single plan's interval is over its parts.
        p_value: of all groups being alike: Kruskal and Wallis's test (1952) of the plans' bits per action, of groups
            with two plans or more; None where there are no two of these.
    """

    groups: dict[int, Interval]
    p_value: float | None


@dataclass(frozen=True)
class ActionDrift:
    """How often an action is taken in the second half of plans, and in the first.

    Attributes:
        action: its number.
        first, second: its share of the actions of the halves.
        change: the second less the first, with its 95 % interval over units and the p-value of 0.
        corrected: that p-value, corrected for the number of actions (`neuroprior.analysis.statistics.holm`).
    """

    action: int
    first: float
    second: float
    change: Difference
    corrected: float


@dataclass(frozen=True, eq=False)
class _Counted:
    """The actions that count, `[M]` each, in the order of the file: bits, plan, step and length of the plan, unit."""

    bits: Tensor
    plan: Tensor
    step: Tensor
    length: Tensor
    unit: Tensor


def by_position(plans: Plans, bits: Tensor, mask: Tensor, parts: int = 10) -> PositionDrift:
    """How the cost of actions changes from the beginning to the end of plans.

    The trend is the common least-squares slope of bits on the place in the plan, from 0 to 1, each plan about its own
    means; its error is that of a ratio over units (`neuroprior.analysis.statistics.ratio_difference`), which units of the same
    length weigh alike. Units are those of `neuroprior.analysis.comparison.units`, so a single long plan has a trend too.

    Args:
        plans: the plans.
        bits: floating point `[N, L]`: what each action costs, such as `neuroprior.analysis.comparison.action_bits` of a prior
            that has not learned from these plans.
        mask: bool `[N, L]`: the actions that count (held out), none beyond a plan's end.
        parts: into how many parts of its length each plan is cut. Short plans have actions in some of them only.

    Raises:
        ValueError: a shape or dtype is wrong, bits that are no numbers, fewer than two units of actions, no plan with
            two actions that count, or no parts.
    """
    check_sizes(parts=parts)
    counted = _counted(plans, bits, mask)
    place = (counted.step + 0.5) / counted.length
    part = (place * parts).long().clamp(max=parts - 1)
    found = []
    for k in range(parts):
        here = part == k
        found.append(_interval(counted.bits[here], counted.unit[here]) if here.any() else Interval(nan, nan, nan))
    off, cost = _about_means(place, counted.plan), _about_means(counted.bits, counted.plan)
    if float(off.square().sum()) < 1e-12:
        raise ValueError("mask: no plan has two actions that count, so there is no trend within plans")
    trend = ratio_difference(_sums(off * cost, counted.unit), _sums(off.square(), counted.unit))
    return PositionDrift(found, part.bincount(minlength=parts).cpu(), trend)


def by_plan(plans: Plans, bits: Tensor, mask: Tensor) -> PlanDrift:
    """How the cost of actions changes from plan to plan of a group, in the order of the file.

    Args:
        plans, bits, mask: as for `by_position`.

    Raises:
        ValueError: as for `by_position`, but for trends within plans.
    """
    item, index, group, totals, actions = _items(plans, _counted(plans, bits, mask))
    numbers, inverse = group.unique(return_inverse=True)
    first = torch.full((len(numbers),), len(group)).scatter_reduce(0, inverse, torch.arange(len(group)), "amin")
    order = first[inverse].argsort(stable=True)
    costs, inverse = (totals / actions)[order], inverse[order]
    correlations: dict[int, Difference] = {}
    starts = first.sort().indices  # ranks of groups in the order of their first plan
    sizes = inverse.bincount(minlength=len(numbers))[starts].tolist()
    for number, part in zip(numbers[starts].tolist(), costs.split(sizes), strict=True):
        if len(part) >= FEWEST_RANKED:
            correlations[number] = rank_correlation(part.numpy())
    means = [one.mean for one in correlations.values()]
    trend = next(iter(correlations.values()), None)
    if len(means) >= FEWEST_UNITS:
        trend = mean_correlation(means)
    return PlanDrift(item, index[order], group[order], costs, actions[order], correlations, trend)


def by_group(plans: Plans, bits: Tensor, mask: Tensor) -> GroupDrift:
    """How the cost of actions differs between groups; where plans have none, all are of group 0.

    Args:
        plans, bits, mask: as for `by_position`.

    Raises:
        ValueError: as for `by_position`, but for trends within plans.
    """
    _, _, group, totals, actions = _items(plans, _counted(plans, bits, mask))
    order = group.argsort(stable=True)
    numbers, sizes = group.unique(return_counts=True)
    parts = list(zip(totals[order].split(sizes.tolist()), actions[order].split(sizes.tolist()), strict=True))
    found = {number: _ratio(*part) for number, part in zip(numbers.tolist(), parts, strict=True)}
    several = [(total / size).numpy() for total, size in parts if len(size) > 1]
    if len(several) < FEWEST_UNITS:
        return GroupDrift(found, None)
    together = np.concatenate(several)
    alike = bool((together == together[0]).all())
    return GroupDrift(found, 1.0 if alike else float(stats.kruskal(*several).pvalue))


def action_drift(plans: Plans) -> list[ActionDrift]:
    """How the share of each action changes from the first half of plans to the second.

    The middle action of a plan of odd length is left out, so that halves are alike in size; the difference is paired by
    unit. Units are the groups, or the plans where no two groups have any; of a single plan each half is cut into
    `BLOCKS` / 2 parts, and the first part of one half makes a pair with the first part of the other.

    Args:
        plans: the plans.

    Returns:
        One for each action, in ascending order.

    Raises:
        ValueError: fewer than two units: no two plans of at least two actions, and no single one of at least four.
    """
    length, step = plans.mask().sum(1)[:, None], torch.arange(plans.max_length, device=plans.actions.device)
    half = length // 2
    late = step >= length - half
    mask = (step < half) | (late & (step < length))
    whole = units(plans, mask)[mask]
    if int(mask.any(1).sum()) == 1:
        within = torch.where(late, step - (length - half), step)
        whole = (within * (BLOCKS // 2)).div(half.clamp(min=1), rounding_mode="floor")[mask]
    unit = whole.unique(return_inverse=True)[1]
    num = int(unit.max()) + 1 if len(unit) else 0
    if num < FEWEST_UNITS:
        raise ValueError("plans: two plans of at least two actions are needed, or a single one of at least four")
    actions, sign = plans.actions[mask], torch.where(late.expand(mask.shape)[mask], 1.0, -1.0).double()
    sizes = unit.bincount().double() / 2
    found = []
    for action in range(plans.num_actions):
        taken = actions == action
        change = _sums(sign[taken], unit[taken], num)
        second = float((sign[taken] > 0).sum()) / float(sizes.sum())
        difference = ratio_difference(change, sizes)
        found.append(ActionDrift(action, second - difference.mean, second, difference, difference.p_value))
    corrected = holm([one.change.p_value for one in found])
    return [replace(one, corrected=float(p)) for one, p in zip(found, corrected, strict=True)]


def _counted(plans: Plans, bits: Tensor, mask: Tensor) -> _Counted:
    """What counts, checked; on the device of `bits`."""
    shape = plans.actions.shape
    for name, values in (("bits", bits), ("mask", mask)):
        if values.shape != shape:
            raise ValueError(f"{name}: shape {list(shape)}, that of the actions, is expected, not {list(values.shape)}")
    if mask.dtype != torch.bool:
        raise ValueError(f"mask: bool is expected, not {str(mask.dtype).removeprefix('torch.')}")
    mask, within = mask.to(bits.device), plans.mask().to(bits.device)
    for wrong, what in ((mask & ~within, "mask"), (mask & ~bits.isfinite(), "bits")):
        if wrong.any():
            where = wrong.nonzero()[0].tolist()
            why = "the plan has ended there" if what == "mask" else f"{float(bits[tuple(where)])} is no finite number"
            raise ValueError(f"{what}{where}: {why}")
    unit = units(plans, mask)[mask]
    if len(unit) == 0 or bool((unit == unit[0]).all()):
        raise ValueError(f"mask: at least two actions that count are needed, not {len(unit)}")
    plan, step = mask.nonzero().unbind(1)
    return _Counted(bits[mask].double(), plan, step, within.sum(1)[plan], unit)


def _items(plans: Plans, counted: _Counted) -> tuple[str, Tensor, Tensor, Tensor, Tensor]:
    """Plans, or the parts of a single one: what they are, their numbers, groups, bits and actions `[K]`, on the CPU."""
    single = bool((counted.plan == counted.plan[0]).all())
    index, item = (counted.unit if single else counted.plan).unique(return_inverse=True)
    totals, actions = _sums(counted.bits, item).cpu(), item.bincount().double().cpu()
    group = torch.zeros(len(index), dtype=torch.long)
    if plans.group is not None:
        group = plans.group.cpu().long()[counted.plan[:1].expand(len(index)).cpu() if single else index.cpu()]
    return "parts" if single else "plans", index.cpu(), group, totals, actions


def _sums(values: Tensor, index: Tensor, num: int | None = None) -> Tensor:
    """The sums `[K]` of values `[M]` by their index."""
    size = int(index.max()) + 1 if num is None else num
    return values.new_zeros(size).index_add_(0, index, values)


def _about_means(values: Tensor, plan: Tensor) -> Tensor:
    """Values `[M]` less the mean of their plan."""
    means = _sums(values, plan) / plan.bincount().clamp(min=1)
    return values - means[plan]


def _interval(bits: Tensor, unit: Tensor) -> Interval:
    """Bits per action over the units that have any."""
    rank = unit.unique(return_inverse=True)[1]
    return _ratio(_sums(bits, rank), rank.bincount().double())


def _ratio(totals: Tensor, sizes: Tensor) -> Interval:
    """A ratio over units `[G]`, without an interval where there is but one."""
    if len(sizes) < FEWEST_UNITS:
        return Interval(float(totals.sum() / sizes.sum()), nan, nan)
    return Interval(*ratio_difference(totals, sizes)[:3])
