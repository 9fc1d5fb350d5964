"""Sequences of actions that are more or less frequent than their parts explain: tests against Markov chains."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf, log
from typing import NamedTuple

import numpy as np
import torch
from scipy import stats
from scipy.special import ndtri, stdtrit, xlogy
from torch import Tensor

from neuroprior._checks import as_list, check_sizes, is_whole
from neuroprior._statistics import holm
from neuroprior.behaviour.analysis.comparison import units
from neuroprior.behaviour.analysis.flat import FlatPlans, ranks
from neuroprior.plans import Plans
from neuroprior.plans.folds import BLOCKS, FEWEST_UNITS

FEWEST = 5
"""A sequence is tested if both its parts occurred so often; an absent one is listed if so many were expected."""

POISSON_ZERO = -log(0.025)
"""The largest mean of a Poisson count whose 95 % interval holds 0."""

LEVEL = 0.05
"""Sequences with a corrected p-value up to this come first."""

CANDIDATES_AT_ONCE = 2**20
"""Candidate sequences that are in memory at a time."""

COUNTS_AT_ONCE = 2**20
"""Counts of windows by unit that are in memory at a time."""


@dataclass(frozen=True, slots=True)
class Motif:
    """A sequence of n actions, and how often it occurred compared to a Markov chain of order n - 2.

    Attributes:
        actions: the n actions.
        count: number of occurrences, which may overlap.
        expected: the number expected from the counts of its first n - 1 and of its last n - 1 actions.
        ratio: `count / expected`; above 1: over-represented.
        low: the lower end of the ratio's 95 % interval.
        high: the upper end.
        p_value: two-sided.
        corrected: p-value corrected for all sequences of all lengths that were tested (Holm 1979).
    """

    actions: tuple[int, ...]
    count: int
    expected: float
    ratio: float
    low: float
    high: float
    p_value: float
    corrected: float


def motifs(
    plans: Plans,
    lengths: Sequence[int] = (3, 4, 5, 6),
    top: int | None = None,
) -> list[Motif]:
    """The most over- and under-represented sequences of actions.

    Under a Markov chain of order n - 2 the last action of a sequence depends on the n - 2 in its middle but not on the
    first. Given how often the middle occurred, after which actions and before which, the count of the sequence is then
    hypergeometric: Fisher's exact test of the 2 x 2 table, two-sided by doubling the tail. For n = 2 the middle is
    empty, and successive actions are independent. All counts are of sequences within one plan.

    The test is exact if each plan contains the middle only once. It is approximate otherwise, as occurrences overlap,
    most of all those of sequences such as `a a a`. It assumes one chain for all plans: if plans or groups differ, what
    is typical of some is over-represented in all. The intervals account for such differences, as they are over groups
    (or plans, if fewer than two groups have any; or `BLOCKS` parts of a single plan), joined to at most `BLOCKS` units:
    Student's interval of the logarithm of the ratio, by the delta method. For a sequence that never occurred the upper
    end is that of a Poisson count of 0. If its middle occurred in only one unit, the interval is 0 to infinity.

    Which sequences are tested depends on the counts of their parts only: all whose first and last n - 1 actions
    occurred at least `FEWEST` times each, but not around every occurrence of the middle. Correcting only for those that
    occurred would be wrong: of many rare sequences some always occur. Absent ones are listed if at least as many were
    expected.

    Args:
        plans: an end symbol is an action like others.
        lengths: numbers of actions, n.
        top: how many to return; None for all.

    Returns:
        Those with a corrected p-value of up to `LEVEL` first: over-represented ones, then under-represented ones; then
        the others. Each of these is sorted by p-value rather than by ratio: sequences that overlap a motif deviate too,
        often with a larger ratio but fewer counts.

    Raises:
        ValueError: a length below 2; a repeated length or none; `top` below 1.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2, 3, 1, 0, 3, 2, 0, 1, 2, 1]]).repeat(5, 1), 4)
        >>> [motif.actions for motif in motifs(plans, lengths=[3], top=1)]
        [(3, 1, 0)]
    """
    lengths = as_list("lengths", lengths)
    for n in lengths:
        if not is_whole(n) or n < 2:
            raise ValueError(f"`lengths` must be at least 2, got {n!r}.")
    if not lengths or len(set(lengths)) < len(lengths):
        raise ValueError(f"`lengths` must be different integers, one or more, got {list(lengths)}.")
    if top is not None:
        check_sizes(top=top)
    flat = FlatPlans.of(plans)
    by_length, tests = [], 0
    for length, middle in _middles(flat, sorted(lengths)):
        start = flat.starts(length)
        windows = _Windows.of(flat, length, start, middle)
        sequences = _candidates(windows, flat.num_actions)
        tests += sequences.tests
        by_length.append(_test(flat, length, windows, sequences, _units(plans, flat.place[start])[windows.kept]))
    return _list_motifs(by_length, tests, top)


def _middles(flat: FlatPlans, lengths: list[int]) -> Iterator[tuple[int, Tensor]]:
    """For each n the rank of the n - 2 actions that begin at each place, for places with so many behind them."""
    rank = torch.zeros_like(flat.actions)
    for size in range(lengths[-1] - 1):
        if size:
            rest = flat.actions[size - 1 :]
            rank = ranks(rank[: len(rest)] * flat.num_actions + rest)
        if size + 2 in lengths:
            yield size + 2, rank


class _Windows(NamedTuple):
    """The W windows of n actions of one plan whose middle occurred often enough for a test."""

    kept: Tensor  # int64 [W]: which of all windows of n actions these are
    start: Tensor  # int64 [W]: in the flat plans
    middle: Tensor  # int64 [W]: a rank
    head: Tensor  # int64 [W]: the rank of the first n - 1 actions among those of all windows
    tail: Tensor  # int64 [W]: of the last n - 1
    head_code: Tensor  # int64, ascending: middle * A + first action of each head
    tail_code: Tensor  # int64, ascending: middle * A + last action of each tail

    @staticmethod
    def of(flat: FlatPlans, length: int, start: Tensor, middle: Tensor) -> "_Windows":
        """Those that begin at `start`; `middle [M]` is the rank of the n - 2 actions that begin at each place."""
        rank = middle[start + 1]
        kept = (rank.bincount()[rank] > FEWEST).nonzero()[:, 0] if len(rank) else rank
        start, rank = start[kept], ranks(rank[kept])
        head_code, head = (rank * flat.num_actions + flat.actions[start]).unique(return_inverse=True)
        tail_code, tail = (rank * flat.num_actions + flat.actions[start + length - 1]).unique(return_inverse=True)
        return _Windows(kept, start, rank, head, tail, head_code, tail_code)


class _Sequences(NamedTuple):
    """The K sequences of n actions that are listed; `tests` were tested."""

    middle: Tensor  # int64 [K]; this and the next three are numbers in `_Windows`
    head: Tensor
    tail: Tensor
    of_window: Tensor  # int64 [W]: the sequence of each window; K where it was not tested
    counts: Tensor  # int64 [K]
    total: Tensor  # int64 [K]: of the middle
    heads: Tensor  # int64 [K]: of the first n - 1 actions
    tails: Tensor  # int64 [K]: of the last n - 1
    tests: int


def _candidates(windows: _Windows, num_actions: int) -> _Sequences:
    """The sequences that are tested: every head with every tail of the same middle."""
    total, heads, tails = (rank.bincount() for rank in (windows.middle, windows.head, windows.tail))
    codes, rank, counts = (windows.head * len(tails) + windows.tail).unique(return_inverse=True, return_counts=True)
    parts, tests = [], 0
    for head, tail in _pairs(windows, heads, tails, total, num_actions):
        tests += len(head)
        at = torch.searchsorted(codes, head * len(tails) + tail).clamp(max=max(len(codes) - 1, 0))
        count = torch.where(codes[at] == head * len(tails) + tail, counts[at], 0)
        middle = windows.head_code[head].div(num_actions, rounding_mode="floor")
        listed = (count > 0) | (heads[head].double() * tails[tail] >= FEWEST * total[middle])
        at = torch.where(count > 0, at, len(codes))
        parts.append([values[listed] for values in (middle, head, tail, count, at)])
    none = windows.middle[:0]
    middle, head, tail, count, at = (torch.cat(values) for values in zip([none] * 5, *parts, strict=True))
    number = codes.new_full((len(codes) + 1,), len(head))
    number[at[count > 0]] = torch.arange(len(head), device=head.device)[count > 0]
    return _Sequences(middle, head, tail, number[rank], count, total[middle], heads[head], tails[tail], tests)


def _pairs(
    windows: _Windows, heads: Tensor, tails: Tensor, total: Tensor, num_actions: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """The heads and tails that share a middle, frequent enough but not around all of it; heads ascending."""
    of_head = windows.head_code.div(num_actions, rounding_mode="floor")
    of_tail = windows.tail_code.div(num_actions, rounding_mode="floor")
    head = ((heads >= FEWEST) & (heads < total[of_head])).nonzero()[:, 0]
    tail = ((tails >= FEWEST) & (tails < total[of_tail])).nonzero()[:, 0]
    partners = of_tail[tail].bincount(minlength=len(total))
    first = (partners.cumsum(0) - partners)[of_head[head]]
    partners = partners[of_head[head]]
    block = partners.cumsum(0).div(CANDIDATES_AT_ONCE, rounding_mode="floor")
    sizes = block.unique_consecutive(return_counts=True)[1].tolist()
    for head_batch, number, at in zip(*(values.split(sizes) for values in (head, partners, first)), strict=True):
        which = torch.arange(len(head_batch), device=head_batch.device).repeat_interleave(number)
        place = torch.arange(len(which), device=head_batch.device) - (number.cumsum(0) - number)[which]
        yield head_batch[which], tail[at[which] + place]


class _Tested(NamedTuple):
    """K sequences of one length."""

    actions: Tensor  # int64 [K, n]
    counts: Tensor  # int64 [K]
    expected: Tensor  # float64 [K], and so are the others
    low: Tensor
    high: Tensor
    p_value: Tensor


def _test(flat: FlatPlans, length: int, windows: _Windows, sequences: _Sequences, unit: Tensor) -> _Tested:
    """The sequences with their tests, and their intervals over the units `[W]` of the windows."""
    p_value = fisher_two_sided(sequences.counts, sequences.total, sequences.heads, sequences.tails)
    expected = sequences.heads.double() * sequences.tails / sequences.total
    ratio, half, absent = sequences.counts / expected, _half_width(windows, sequences, unit), sequences.counts == 0
    low, high = ratio * (-half).exp(), ratio * half.exp()
    low = low.masked_fill(absent, 0)
    high = torch.where(absent, torch.where(half < inf, POISSON_ZERO / expected, inf), high)
    somewhere = torch.zeros_like(windows.start)
    somewhere[windows.middle] = windows.start
    middle = flat.actions[somewhere[sequences.middle][:, None] + torch.arange(1, length - 1, device=unit.device)]
    first, last = (
        windows.head_code[sequences.head] % flat.num_actions,
        windows.tail_code[sequences.tail] % flat.num_actions,
    )
    actions = torch.cat([first[:, None], middle, last[:, None]], 1)
    return _Tested(actions, sequences.counts, expected, low, high, p_value)


def _half_width(windows: _Windows, sequences: _Sequences, unit: Tensor) -> Tensor:
    """`[K]`: half the width of the 95 % intervals of the logarithms of the ratios; infinite with only one unit.

    A ratio is a quotient of sums over units, count * total / (heads * tails). Each unit shifts its logarithm by the
    shares that it has in these sums (the delta method; Cochran 1977, section 6.3, for one quotient). Where a sequence
    is rare, or all its heads go on alike, units seem to agree: the error is at least that of a hypergeometric count.
    """
    every = torch.arange(len(sequences.counts), device=unit.device)
    squares, num_units = torch.zeros_like(sequences.total, dtype=torch.double), torch.zeros_like(sequences.total)
    sizes = unit.bincount().tolist()
    together = max(COUNTS_AT_ONCE // max(len(unit), len(every), 1), 1)
    parts = unit.argsort(stable=True).split([sum(sizes[k : k + together]) for k in range(0, len(sizes), together)])
    for k, chunk in enumerate(parts):
        row = unit[chunk] - k * together

        def times(rank: Tensor, wanted: Tensor, chunk: Tensor = chunk, row: Tensor = row) -> Tensor:
            """`[U, K]`: how often each of `wanted [K]` is among the ranks of the windows of each of some units."""
            width = max(int(rank.max()), int(wanted.max())) + 1
            counts = (row * width + rank[chunk]).bincount(minlength=(int(row.max()) + 1) * width)
            return counts.view(-1, width)[:, wanted]

        if len(every):
            middle, whole = times(windows.middle, sequences.middle), times(sequences.of_window, every)
            shift = middle / sequences.total.double() + whole / sequences.counts.clamp(min=1).double()
            shift -= times(windows.head, sequences.head) / sequences.heads.double()
            shift -= times(windows.tail, sequences.tail) / sequences.tails.double()
            squares += shift.square().sum(0)
            num_units += (middle > 0).sum(0)
    student = torch.tensor([inf, inf, *stdtrit(range(1, BLOCKS), 0.975)], dtype=torch.double, device=unit.device)
    error = (squares * num_units / (num_units - 1).clamp(min=1)).sqrt()
    other_heads, other_tails = (1 - counts.double() / sequences.total for counts in (sequences.heads, sequences.tails))
    least = ndtri(0.975) * (other_heads * other_tails / sequences.counts.clamp(min=1)).sqrt()
    return torch.where(num_units < FEWEST_UNITS, inf, (student[num_units] * error).maximum(least))


def _units(plans: Plans, place: Tensor) -> Tensor:
    """`[W]`: the independent unit of the windows that begin at `place [W]` of the plans laid flat; at most `BLOCKS`."""
    mask = torch.zeros(plans.actions.numel(), dtype=torch.bool, device=place.device)
    mask[place] = True
    of_action = units(plans, mask.view(plans.actions.shape)).reshape(-1)
    distinct, unit = of_action[place].unique(return_inverse=True)
    joined: Tensor = (unit * min(BLOCKS, len(distinct))).div(max(len(distinct), 1), rounding_mode="floor")
    return joined


def _list_motifs(by_length: list[_Tested], tests: int, top: int | None) -> list[Motif]:
    """The first `top` of all, in the order that `motifs` promises."""
    columns = list(zip(*by_length, strict=True))[1:]
    count, expected, low, high, p_value = (torch.cat(values).cpu().numpy() for values in columns)
    corrected = holm(p_value, tests)
    over, clear = count > expected, corrected <= LEVEL
    # In large data many p-values are 0; the deviance of a Poisson count orders them still.
    deviance = xlogy(count, count / expected) - (count - expected)
    chosen = np.lexsort((-deviance, p_value, np.where(clear, ~over, 2)))[:top]
    spelled = _spell([tested.actions for tested in by_length], chosen)
    shown = (values[chosen].tolist() for values in (count, expected, count / expected, low, high, p_value, corrected))
    return [Motif(*values) for values in zip(spelled, *shown, strict=True)]


def _spell(actions: list[Tensor], chosen: np.ndarray[tuple[int], np.dtype[np.int64]]) -> list[tuple[int, ...]]:
    """The actions of those `chosen` among all that are in the parts of `actions`, each part `[K, n]` of one length."""
    first, out = 0, dict[int, tuple[int, ...]]()
    for batch in actions:
        places = chosen[(chosen >= first) & (chosen < first + len(batch))]
        rows = batch.cpu()[torch.from_numpy(places - first)].tolist()
        out.update(zip(places.tolist(), map(tuple, rows), strict=True))
        first += len(batch)
    return [out[i] for i in chosen.tolist()]


def fisher_two_sided(count: Tensor, total: Tensor, successes: Tensor, draws: Tensor) -> Tensor:
    """The p-values of Fisher's exact test for many 2 x 2 tables, two-sided by doubling the one-sided tail (at most 1).

    Args:
        count: integers `[K]`: successes among the draws; possible ones.
        total: `[K]`: what is drawn from, without replacement.
        successes: `[K]`: successes among those.
        draws: `[K]`: how many are drawn.

    Returns:
        float64 `[K]`.
    """
    x, n, s, d = (values.cpu().numpy() for values in (count, total, successes, draws))
    tail = np.where(x * n > s * d, stats.hypergeom.sf(x - 1, n, s, d), stats.hypergeom.cdf(x, n, s, d))
    return torch.from_numpy(np.minimum(2 * tail, 1)).to(count.device)
