"""Macro-actions: sequences that executed plans repeat, learned by recoding pairs of actions as new actions."""

from dataclasses import dataclass
from math import log, log2
from typing import Literal

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior.plans import Plans
from neuroprior.plans.plans import check_are_plans

Criterion = Literal["count", "information", "compression"]

CRITERIA = ("count", "information", "compression")


@dataclass(frozen=True)
class Macro:
    """A sequence of actions that is taken as one.

    Attributes:
        actions: of the plans, two or more.
        count: how often it replaced its two halves when it was learned.
        gain: bits by which it shortened the plans then, each symbol coded by its frequency, less the bits that its
            definition costs; it may be negative where macros are not chosen by their gain.
    """

    actions: tuple[int, ...]
    count: int
    gain: float


def learn_macros(plans: Plans, num_macros: int, by: Criterion = "count") -> tuple[list[Macro], Plans]:
    """Find the macro-actions of executed plans, and recode the plans with them.

    Again and again the best pair of consecutive symbols is replaced, wherever it occurs, from left to right, by a new
    symbol: byte-pair encoding (Gage 1994; of actions: Iba 1989, McGovern 1998). The best pair is

    - "count": the pair that occurs most often;
    - "information": the pair with the greatest n log2(p(xy) / (p(x) p(y))), n being how often it occurs: its
      contribution to the mutual information of consecutive symbols;
    - "compression": the pair whose replacement shortens the plans most; see `Macro.gain`.

    The search ends when no pair occurs twice or, by "information" and "compression", no pair has a positive value.

    Args:
        plans: of A actions; their context is ignored.
        num_macros: M, the most macros to find.
        by: how pairs are chosen.

    Returns:
        At most M macros, in the order in which they were found, and the plans with A + M actions, of which A + i is
        macro i. A macro may be made of earlier ones; its `actions` are always those of the plans.

    Raises:
        ValueError: an argument is out of range, or the plans have an end symbol.

    Example:
        >>> macros, shorter = learn_macros(Plans(torch.tensor([[0, 1, 2, 0, 1, 2, 0, 1, 2]]).repeat(5, 1), 3), 2)
        >>> [macro.actions for macro in macros], shorter.max_length
        ([(0, 1), (0, 1, 2)], 3)
    """
    macros, (recoded,) = macros_of(plans, num_macros, by)
    return macros, recoded


def macros_of(plans: Plans, num_macros: int, by: Criterion, *others: Plans) -> tuple[list[Macro], list[Plans]]:
    """As `learn_macros`; other plans, from which no macros are learned, are recoded as well."""
    check_sizes(num_macros=num_macros)
    for some in (plans, *others):
        check_are_plans(some)
    if by not in CRITERIA:
        raise ValueError(f"`by` must be one of {', '.join(map(repr, CRITERIA))}, got {by!r}")
    if any(some.end is not None for some in (plans, *others)):
        raise ValueError("plans: an end symbol cannot be part of a macro; learn from plans without one")
    symbols = [some.actions.long().masked_fill(~some.mask(), -1) for some in (plans, *others)]
    meaning: list[tuple[int, ...]] = [(action,) for action in range(plans.num_actions)]
    macros: list[Macro] = []
    while len(macros) < num_macros and (best := _best_pair(symbols[0], len(meaning), by)) is not None:
        first, second, gain = best
        starts = [_occurrences(some, first, second) for some in symbols]
        symbols = [_replaced(some, begin, len(meaning)) for some, begin in zip(symbols, starts, strict=True)]
        meaning.append(meaning[first] + meaning[second])
        macros.append(Macro(meaning[-1], int(starts[0].sum()), gain))
    recoded = []
    for some, found in zip((plans, *others), symbols, strict=True):
        lengths = (found >= 0).sum(1)
        longest = int(lengths.max()) if len(lengths) else 0
        actions = found[:, :longest].clamp(min=0)
        recoded.append(Plans(actions, plans.num_actions + num_macros, lengths, group=some.group))
    return macros, recoded


def _occurrences(symbols: Tensor, one: int | None = None, two: int | None = None) -> Tensor:
    """Where pairs, or the pair (one, two), begin: `[N, L - 1]`; of overlapping pairs of equals, every other one."""
    first, second = symbols[:, :-1], symbols[:, 1:]
    same = first == second
    place = torch.arange(first.shape[1], device=symbols.device).expand_as(first)
    run = torch.where(same, -1, place).cummax(1).values if first.shape[1] else place
    begins: Tensor = (second >= 0) & (~same | ((place - run) % 2 == 1))
    return begins if one is None else begins & (first == one) & (second == two)


def _best_pair(symbols: Tensor, kinds: int, by: Criterion) -> tuple[int, int, float] | None:
    """The best pair, and the bits that it saves; of equally good pairs the first. None where there is none."""
    starts = _occurrences(symbols)
    code, count = (symbols[:, :-1] * kinds + symbols[:, 1:])[starts].unique(return_counts=True)
    code, count = code[count > 1], count[count > 1].double()
    if len(code) == 0:
        return None
    single = symbols[symbols >= 0].bincount(minlength=kinds).double()
    first, second = code.div(kinds, rounding_mode="floor"), code % kinds
    total = single.sum()
    gain = _gain(single, first, second, count, kinds)
    merit = {
        "count": lambda: count,
        "information": lambda: count * (count * total / (single[first] * single[second])).log2(),
        "compression": lambda: gain,
    }[by]()
    best = int(merit.argmax())
    if merit[best] <= 0:
        return None
    return int(first[best]), int(second[best]), float(gain[best])


def _gain(single: Tensor, first: Tensor, second: Tensor, count: Tensor, kinds: int) -> Tensor:
    """The bits that each pair saves, `[K]`: symbols that occur n of N times take log2(N / n) each."""
    total, same = single.sum(), first == second

    def weight(number: Tensor) -> Tensor:
        weights: Tensor = torch.special.xlogy(number, number)
        return weights

    left = torch.where(same, single[first] - 2 * count, single[first] - count)
    change = weight(left) - weight(single[first]) + weight(count)
    change += torch.where(same, 0.0, weight(single[second] - count) - weight(single[second]))
    saved: Tensor = weight(total) - weight(total - count) + change
    return saved / log(2) - 2 * log2(kinds)


def _replaced(symbols: Tensor, starts: Tensor, new: int) -> Tensor:
    """The symbols with the pairs that begin at `starts [N, L - 1]` replaced by `new`; rows are filled up with -1."""
    symbols = symbols.clone()
    symbols[:, :-1][starts] = new
    symbols[:, 1:][starts] = -1
    return symbols.gather(1, (symbols < 0).int().argsort(dim=1, stable=True))
