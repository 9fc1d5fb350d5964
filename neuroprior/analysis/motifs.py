"""Sequences of actions that are more or less frequent than their parts explain: tests against Markov chains."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log
from typing import NamedTuple

import numpy as np
import torch
from scipy import stats
from scipy.special import xlogy
from torch import Tensor

from neuroprior.analysis.comparison import units
from neuroprior.analysis.hypergeometric import two_sided
from neuroprior.analysis.windows import Line
from neuroprior.analysis.words import Windows, Words, candidates, middles
from neuroprior.plans import Plans
from neuroprior.plans.folds import BLOCKS, FEWEST_UNITS

POISSON_ZERO = -log(0.025)
"""The mean up to which no event at all is in the 95 % interval of a Poisson count."""

LEVEL = 0.05
"""Corrected p-values up to this come first."""


@dataclass(frozen=True, slots=True)
class Motif:
    """A sequence of n actions, and how often it occurred against a Markov chain of order n - 2.

    Attributes:
        actions: the n actions.
        count: how often they occurred in a row; occurrences may overlap.
        expected: how often, given the counts of the first n - 1 and of the last n - 1 actions.
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
    plans: Plans, lengths: Sequence[int] = (3, 4, 5, 6), top: int | None = None, collapse_repeats: bool = False
) -> list[Motif]:
    """The most over- and under-represented sequences of actions.

    Under a Markov chain of order n - 2 the action after the n - 2 in the middle of a sequence does not depend on the
    one before them. Given how often the middle occurred, after which actions and before which, the count of the
    sequence is then hypergeometric: Fisher's exact test of the 2 x 2 table, two-sided by doubling the tail. For n = 2
    the middle is empty and successive actions are independent. Only windows that lie within a plan count, in all three.

    The test is exact where each plan has one such window. It is approximate where there are more, as the action after
    one middle is then part of the next, most of all in a sequence that overlaps itself, such as `a a a`. It takes
    one chain for all plans: where plans or groups differ, what is typical of some is over-represented in all. The
    intervals do tell, as they go over groups (plans where no two groups have any; `BLOCKS` parts of a single plan),
    joined in order to at most `BLOCKS` units: Student's interval of the logarithm of the ratio, by the delta method. Of
    a sequence that never occurred the upper end is that of a Poisson count of 0. Where its middle occurred in one
    unit alone the interval is 0 to infinity.

    Which sequences are tested depends on the counts of their parts alone: all whose first and last n - 1 actions
    occurred at least `words.FEWEST` times each, but not around every occurrence of the middle. To correct for no more
    than those that occurred would be wrong: of many rare ones some always do. Absent ones are listed where at least
    as many were expected.

    Args:
        plans: an end symbol is an action like others.
        lengths: numbers of actions, n.
        top: how many to return; None: all.
        collapse_repeats: merge runs of one action into a single one first, so that they do not fill the list.

    Returns:
        Those with a corrected p-value of up to `LEVEL` first: over-represented ones, then under-represented ones; then
        the others. Within each, by p-value: where a sequence is a motif, what contains part of it or strays from it is
        off the model too, often by a larger ratio but with fewer counts.

    Raises:
        ValueError: a length below 2, or of 2 with `collapse_repeats`, as successive actions are then never
            independent; a length twice or none; `top` below 1.
    """
    _check(lengths, top, collapse_repeats)
    line = Line.of(plans)
    line = line.without_repeats() if collapse_repeats else line
    found, tests = [], 0
    for length, middle in middles(line, sorted(lengths)):
        start = line.starts(length)
        windows = Windows.of(line, length, start, middle)
        words = candidates(windows, line.num_actions)
        tests += words.tests
        found.append(_test(line, length, windows, words, _units(plans, line.place[start])[windows.kept]))
    return _listed(found, tests, top)


def _check(lengths: Sequence[int], top: int | None, collapse_repeats: bool) -> None:
    least = 3 if collapse_repeats else 2
    for n in lengths:
        if n < least:
            why = " with collapse_repeats" if collapse_repeats else ""
            raise ValueError(f"lengths: integers of at least {least} are expected{why}, not {n}")
    if not lengths or len(set(lengths)) < len(lengths):
        raise ValueError(f"lengths: one or more different integers are expected, not {list(lengths)}")
    if top is not None and top < 1:
        raise ValueError(f"top: an integer of at least 1 or None is expected, not {top}")


class _Tested(NamedTuple):
    """K sequences of one length."""

    actions: Tensor  # int64 [K, n]
    counts: Tensor  # int64 [K]
    expected: Tensor  # float64 [K], and so are the others
    low: Tensor
    high: Tensor
    p_value: Tensor


def _test(line: Line, length: int, windows: Windows, words: Words, unit: Tensor) -> _Tested:
    """The sequences in `words` with their tests, and their intervals over the units `[W]` of the windows."""
    p_value = two_sided(words.counts, words.total, words.heads, words.tails)
    expected = words.heads.double() * words.tails / words.total
    ratio, half, absent = words.counts / expected, _half_width(windows, words, unit), words.counts == 0
    low, high = ratio * (-half).exp(), ratio * half.exp()
    low = low.masked_fill(absent, 0)
    high = torch.where(absent, torch.where(half < inf, POISSON_ZERO / expected, inf), high)
    somewhere = torch.zeros_like(windows.start)
    somewhere[windows.middle] = windows.start
    middle = line.actions[somewhere[words.middle][:, None] + torch.arange(1, length - 1, device=unit.device)]
    first, last = windows.head_code[words.head] % line.num_actions, windows.tail_code[words.tail] % line.num_actions
    actions = torch.cat([first[:, None], middle, last[:, None]], 1)
    return _Tested(actions, words.counts, expected, low, high, p_value)


def _half_width(windows: Windows, words: Words, unit: Tensor) -> Tensor:
    """`[K]`: half the width of the 95 % intervals of the logarithms of the ratios; infinite with a single unit.

    A ratio is a quotient of sums over units, count * total / (heads * tails). Each unit shifts its logarithm by the
    shares that it has in these sums (the delta method; Cochran 1977, section 6.3, for one quotient).
    """
    every = torch.arange(len(words.counts), device=unit.device)
    squares, seen = torch.zeros_like(words.total, dtype=torch.double), torch.zeros_like(words.total)
    for part in unit.argsort(stable=True).split(unit.bincount().tolist()):
        middle, word = _times(windows.middle, part, words.middle), _times(words.of_window, part, every)
        shift = middle / words.total.double() + word / words.counts.clamp(min=1).double()
        shift -= _times(windows.head, part, words.head) / words.heads.double()
        shift -= _times(windows.tail, part, words.tail) / words.tails.double()
        squares += shift**2
        seen += middle > 0
    student = torch.tensor([inf, inf, *stats.t.ppf(0.975, range(1, BLOCKS))], dtype=torch.double, device=unit.device)
    error = (squares * seen / (seen - 1).clamp(min=1)).sqrt()
    return torch.where(seen < FEWEST_UNITS, inf, student[seen] * error)


def _times(ranks: Tensor, part: Tensor, wanted: Tensor) -> Tensor:
    """How often each of `wanted [K]` is among `ranks[part]`."""
    highest = int(wanted.max()) + 1 if len(wanted) else 0
    return ranks[part].bincount(minlength=highest)[wanted]


def _units(plans: Plans, place: Tensor) -> Tensor:
    """`[W]`: the independent unit of the windows that begin at `place [W]` of the plans laid flat; at most `BLOCKS`."""
    mask = torch.zeros(plans.actions.numel(), dtype=torch.bool, device=place.device)
    mask[place] = True
    of_action = units(plans, mask.view(plans.actions.shape)).reshape(-1)
    distinct, unit = of_action[place].unique(return_inverse=True)
    joined: Tensor = (unit * min(BLOCKS, len(distinct))).div(max(len(distinct), 1), rounding_mode="floor")
    return joined


def _listed(found: list[_Tested], tests: int, top: int | None) -> list[Motif]:
    """The first `top` of all, in the order that `motifs` promises."""
    columns = list(zip(*found, strict=True))[1:]
    count, expected, low, high, p_value = (torch.cat(values).cpu().numpy() for values in columns)
    corrected = np.empty_like(p_value)
    order = np.argsort(p_value, kind="stable")
    # Holm's procedure; the tests that are not listed have the largest p-values.
    steps = p_value[order] * (tests - np.arange(len(order)))
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1)
    over, clear = count > expected, corrected <= LEVEL
    # In large data many p-values are 0; the deviance of a Poisson count orders them still.
    deviance = xlogy(count, count / expected) - (count - expected)
    chosen = np.lexsort((-deviance, p_value, np.where(clear, ~over, 2)))[:top]
    spelled = _spelled([tested.actions for tested in found], chosen)
    shown = (values[chosen].tolist() for values in (count, expected, count / expected, low, high, p_value, corrected))
    return [Motif(*values) for values in zip(spelled, *shown, strict=True)]


def _spelled(actions: list[Tensor], chosen: np.ndarray[tuple[int], np.dtype[np.int64]]) -> list[tuple[int, ...]]:
    """The actions of those `chosen` among all that are in the parts of `actions`, each part `[K, n]` of one length."""
    first, out = 0, dict[int, tuple[int, ...]]()
    for part in actions:
        here = chosen[(chosen >= first) & (chosen < first + len(part))]
        rows = part.cpu()[torch.from_numpy(here - first)].tolist()
        out.update(zip(here.tolist(), map(tuple, rows), strict=True))
        first += len(part)
    return [out[i] for i in chosen.tolist()]
