"""How far back dependence reaches: the information of an action about later ones, by counts and by a prior."""

from dataclasses import dataclass
from math import log

import torch
from scipy import special
from torch import Tensor

from neuroprior._checks import check_count, check_sizes
from neuroprior._random import generator_on
from neuroprior.behaviour.analysis.comparison import unit_name, units
from neuroprior.plans import Plans
from neuroprior.plans.folds import BLOCKS
from neuroprior.plans.plans import check_are_plans

MOST_BLOCKS = 200
"""Blocks of the jackknife; more units are joined to so many."""

ENOUGH_PAIRS = 20
"""Pairs per degree of freedom, (A - 1)**2, below which the jackknife leaves a bias, which shuffled pairs estimate."""

SHUFFLES = 20
"""Shuffles that estimate it."""

MOST_CELLS = 2**24
"""Cells of a table of counts up to which it is made in full."""


@dataclass(frozen=True)
class LagInformation:
    """The mutual information of an action and the one `lag` steps later.

    Attributes:
        lag: k.
        bits: the mutual information, corrected for bias; where it is 0, the estimate is as often slightly negative as
            positive.
        low, high: its 95 % interval over units.
        critical_value: bits that the estimate stays below with a probability of 95 % if the two are independent.
        pairs: how many pairs of actions were counted.
    """

    lag: int
    bits: float
    low: float
    high: float
    critical_value: float
    pairs: int


def mutual_information(
    plans: Plans, max_lag: int = 20, skip: int = 0, generator: torch.Generator | None = None
) -> list[LagInformation]:
    """The mutual information I(a_t; a_{t-k}) of actions k = 1 to `max_lag` steps apart in the same plan, in bits.

    Counts are pooled over plans: if plans (or groups) differ in how often they take each action, there is information
    at every lag, namely about which plan it is.

    Bias is corrected, and the interval made, by a jackknife (for units of unequal size: Busing, Meijer and van der
    Leeden 1999, Delete-m jackknife for unequal m). That of the bias leaves out one plan at a time, or one of `BLOCKS`
    consecutive parts if there are fewer plans; unlike the correction of Miller and Madow it holds for successive pairs
    that depend on each other. That of the interval leaves out the units of `neuroprior.behaviour.units`,
    joined to at most `MOST_BLOCKS`. If the actions are independent, twice the number of pairs times the information (in
    nats) is chi-square distributed up to a factor, which the bias determines (Rao and Scott 1981): that gives
    `critical_value`. With fewer than `ENOUGH_PAIRS` pairs per degree of freedom, (A - 1)**2, some bias is left:
    `critical_value` is then at least what 95 % of shuffled pairs stay below. An interval extends at least by
    `critical_value` to both sides, as the jackknife's error vanishes if there is no information.

    Args:
        plans: the plans.
        max_lag: the longest lag.
        skip: number of first actions of each plan that only count as the earlier of a pair. With `max_lag` the later
            actions are the same for all lags.
        generator: draws the shuffles, if there are few pairs.

    Returns:
        One for each lag, up to the longest with two pairs. Intervals and critical values are not corrected for the
        number of lags.

    Raises:
        ValueError: a lag below 1, a negative `skip`, or plans without two pairs of successive actions.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1] * 20]).repeat(4, 1), 2)
        >>> [
        ...     round(found.bits, 2)
        ...     for found in mutual_information(plans, max_lag=2, generator=torch.Generator().manual_seed(0))
        ... ]
        [1.0, 1.0]
    """
    check_are_plans(plans)
    check_sizes(max_lag=max_lag)
    check_count("skip", skip, 0)
    found, generator = [], generator_on(generator, plans.actions.device)
    for lag in range(1, min(max_lag, plans.max_length - 1) + 1):
        later = plans.mask()
        later[:, : max(lag, skip)] = False
        if int(later.sum()) < 2:
            break
        found.append(_information(plans, lag, later, generator))
    if not found:
        raise ValueError(f"plans: two pairs of successive actions are needed after the first {skip}; there are fewer")
    return found


def _information(plans: Plans, lag: int, later: Tensor, generator: torch.Generator) -> LagInformation:
    """One lag; `later [N, L]` marks the later actions of the pairs."""
    then, past = plans.actions[later].long(), plans.actions[:, :-lag][later[:, lag:]].long()
    actions, pairs = plans.num_actions, len(then)
    plan = (later.any(1).cumsum(0) - 1)[:, None].expand(later.shape)[later]
    enough = int(plan[-1]) + 1 >= BLOCKS
    fine = plan % MOST_BLOCKS if enough else torch.arange(pairs, device=plan.device) * min(BLOCKS, pairs) // pairs
    nats, bias, _, _ = _jackknife(past, then, actions, fine)
    unit = units(plans, later)[later]
    unit = ((unit.bincount() > 0).cumsum(0) - 1)[unit]  # a group without pairs must not leave a block empty
    _, _, error, blocks = _jackknife(past, then, actions, unit % MOST_BLOCKS)
    freedom = (len(past.unique()) - 1) * (len(then.unique()) - 1)
    critical = max(bias, 0) * (float(special.chdtri(freedom, 0.05)) / freedom - 1) if freedom else 0.0
    if pairs < ENOUGH_PAIRS * freedom:
        order = [torch.randperm(pairs, generator=generator, device=past.device) for _ in range(SHUFFLES)]
        shuffled = [_jackknife(past, then[index], actions, fine)[:2] for index in order]
        left = torch.tensor([whole - part for whole, part in shuffled], dtype=torch.double)
        critical = max(critical, float(left.mean() + special.ndtri(0.95) * left.std()))
    half = max(float(special.stdtrit(blocks - 1, 0.975)) * error, critical)
    bits, half, critical = (nats - bias) / log(2), half / log(2), critical / log(2)
    return LagInformation(lag, bits, bits - half, bits + half, critical, pairs)


def _jackknife(past: Tensor, then: Tensor, num_actions: int, block: Tensor) -> tuple[float, float, float, int]:
    """The plug-in information (nats) of pairs `[M]` in blocks `[M]`, its bias, its error, and the number of blocks."""
    whole, without, size = _leave_one_out(past, then, num_actions, block)
    share = size / size.sum()
    bias = ((1 - share) * (without - whole)).sum()
    pseudo = (whole - (1 - share) * without) / share
    variance = (share / (1 - share) * (pseudo - (whole - bias)) ** 2).mean()
    return float(whole), float(bias), float(variance.sqrt()), len(size)


def _leave_one_out(past: Tensor, then: Tensor, num_actions: int, block: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The plug-in information of all pairs, that of all but each block's `[B]` (nats), and the blocks' sizes `[B]`."""
    cells, num = num_actions * num_actions, int(block.max()) + 1
    codes = block * cells + past * num_actions + then
    if num * cells <= MOST_CELLS:  # far faster than sorting
        counts = codes.bincount()
        codes = counts.nonzero()[:, 0]
        counts = counts[codes].double()
    else:
        codes, counts = codes.unique(return_counts=True)
        counts = counts.double()
    of = codes // cells

    def per(index: Tensor, length: int, values: Tensor) -> Tensor:
        return values.new_zeros(length).index_add_(0, index, values)

    kinds, kind = (codes % cells).unique(return_inverse=True)
    total = per(kind, len(kinds), counts)
    # Only the cells that a block has change when it is left out: the tables of the others are never made.
    change = torch.special.xlogy(total[kind] - counts, total[kind] - counts) - torch.special.xlogy(total, total)[kind]
    whole = torch.special.xlogy(total, total).sum()
    without = whole + per(of, num, change)
    for action in (codes % cells // num_actions, codes % num_actions):
        table = per(of * num_actions + action, num * num_actions, counts).view(num, num_actions)
        rest = table.sum(0) - table
        whole = whole - torch.special.xlogy(table.sum(0), table.sum(0)).sum()
        without = without - torch.special.xlogy(rest, rest).sum(1)
    size = per(of, num, counts)
    filled, pairs = size > 0, size.sum()
    left = (pairs - size)[filled]
    return whole / pairs + pairs.log(), without[filled] / left + left.log(), size[filled]


def pieces(plans: Plans, length: int, most: int, generator: torch.Generator | None = None) -> Plans:
    """Pieces of `length` consecutive actions, cut from plans at random places, as plans of their own.

    A prior that is fitted to them as to whole plans predicts the action j of a piece from exactly j past actions: one
    training gives the information in each past action. Pieces overlap: split plans between
    training and validation before they are cut.

    Args:
        plans: the plans.
        length: of each piece.
        most: how many are drawn, without replacement; all if there are fewer.
        generator: draws them.

    Returns:
        The pieces, in the order of the plans. A context per step is cut likewise. Their `group`
        is the independent unit (see `neuroprior.behaviour.units`): the group of the plan; or the number of the plan, if
        fewer than two groups have pieces; or one of `BLOCKS` consecutive parts, if only one plan has any.

    Raises:
        ValueError: no plan has that many actions, or `length` or `most` is below 1.
    """
    check_sizes(length=length, most=most)
    start_here = torch.zeros_like(plans.mask())
    if length <= plans.max_length:
        start_here[:, : plans.max_length - length + 1] = plans.mask()[:, length - 1 :]
    number = start_here.sum(1)
    last = number.cumsum(0)
    total = int(last[-1]) if len(plans) else 0
    if total == 0:
        longest = int(plans.mask().sum(1).max()) if len(plans) else 0
        raise ValueError(f"length: no plan has {length} actions; the longest has {longest}")
    device = number.device
    chosen = torch.arange(total, device=device)
    if total > most:
        chosen = torch.randperm(total, generator=generator_on(generator, device), device=device)[:most].sort().values
    plan = torch.searchsorted(last, chosen, right=True)
    start = chosen - (last - number)[plan]
    step = start[:, None] + torch.arange(length, device=device)
    context = plans.context
    if context is not None:
        context = context[plan[:, None], step]
    grouped = plans.group is not None and unit_name(plans, start_here) == "groups"
    return Plans(
        plans.actions[plan[:, None], step],
        plans.num_actions,
        action_names=plans.action_names,
        context=context,
        group=plans.group[plan] if plans.group is not None and grouped else units(plans, start_here)[plan, start],
        context_names=plans.context_names,
        group_names=plans.group_names if grouped else None,
        end=plans.end,
    )
