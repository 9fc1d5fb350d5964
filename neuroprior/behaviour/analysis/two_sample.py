"""Generated plans against real ones: permutation tests of n-grams, run lengths and return times."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import comb

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor

from neuroprior._checks import check_same_names, check_sizes
from neuroprior._random import generator_on
from neuroprior.behaviour.analysis.statistics import holm
from neuroprior.plans import Plans
from neuroprior.plans.folds import BLOCKS
from neuroprior.plans.plans import check_are_plans

ORDERS = range(1, 5)
"""Lengths of the n-grams that are compared."""

LONGEST = 50
"""Steps beyond which run lengths, and return times, form one class."""

MOST_SHOWN = 20
"""n-grams whose shares are returned: the most frequent ones."""

FEWEST_WAYS = 120
"""Ways of labelling the plans below which none of the six corrected p-values could reach 0.05: then plans are cut."""

FEWEST_PERMUTATIONS = 99
"""Permutations that are made whatever they cost."""


@dataclass(frozen=True, eq=False)
class TwoSampleTest:
    """How the distribution of one statistic differs between generated and real plans.

    Attributes:
        statistic: "1-grams" to "4-grams", "run lengths" or "return times".
        distance: the total variation between the two distributions, from 0 (equal) to 1 (disjoint).
        null_distance: the mean distance under the null hypothesis that both are samples of one distribution.
        p_value: of that hypothesis.
        corrected: the same, corrected for the number of statistics (`neuroprior.behaviour.holm`).
        permutations: how many were made.
        classes: for n-grams the actions of the `MOST_SHOWN` most frequent ones (in the mean of both distributions);
            else (1,), (2,), ... steps, the last of which, `LONGEST` + 1, stands for all longer ones.
        real, generated: `[K]`, float64: the share of each of the K classes.
    """

    statistic: str
    distance: float
    null_distance: float
    p_value: float
    corrected: float
    permutations: int
    classes: tuple[tuple[int, ...], ...]
    real: Tensor
    generated: Tensor


@dataclass(frozen=True, eq=False)
class _Sequences:
    """Actions of many plans end to end: `actions [M]`, the number of the plan of each `[M]`, ascending; N plans."""

    actions: Tensor
    plan: Tensor
    num_plans: int


def two_sample_tests(
    real: Plans,
    generated: Plans,
    permutations: int = 999,
    generator: torch.Generator | None = None,
    *,
    max_plans: int = 20_000,
    max_actions: int = 2**20,
    max_work: int = 10**9,
    chunk_size: int = 2**23,
) -> list[TwoSampleTest]:
    """Compare the distributions of n-grams, run lengths and return times in generated and in real plans.

    A run is a maximal sequence of the same action; a return time is the number of steps until the same action is taken
    again in the same plan. Counts are pooled over plans, the distance is the total variation, and the p-value that of a
    permutation test: under the null hypothesis whole plans may exchange their labels (Good 2005, Permutation,
    parametric and bootstrap tests). So the plans of either sample must be independent: the plans of a few subjects that
    behave differently are not, and differ from those of other subjects by more than the test allows for. Generate plans
    as long as the real ones, as return times depend on the length.

    If the plans can be labelled in fewer than `FEWEST_WAYS` ways (nine plans, say, or one against a hundred), all are
    cut into consecutive pieces of the same length, about `BLOCKS` of the smaller sample, and pieces take the place of
    plans. That assumes that pieces are nearly independent, also those of the same plan.

    Args:
        real: executed plans.
        generated: plans sampled from a prior.
        permutations: at most so many; see `max_work`.
        generator: draws the plans that are compared and the permutations.
        max_plans: of more plans than these in either sample, so many are drawn.
        max_actions: likewise; the last plan is cut where it exceeds them.
        max_work: additions that the permutations of a statistic may take, some seconds; fewer are made if need be, but
            at least `FEWEST_PERMUTATIONS`.
        chunk_size: counts that are in memory at a time.

    Returns:
        One for each statistic that occurs, in the order of `TwoSampleTest.statistic`.

    Raises:
        ValueError: different numbers of actions, plans without any action, or no permutations.

    Example:
        >>> plans = Plans(torch.randint(2, (30, 6), generator=torch.Generator().manual_seed(0)), 2)
        >>> found = two_sample_tests(
        ...     plans[:15], plans[15:], permutations=99, generator=torch.Generator().manual_seed(0)
        ... )
        >>> [one.statistic for one in found]
        ['1-grams', '2-grams', '3-grams', '4-grams', 'run lengths', 'return times']
    """
    check_sizes(
        permutations=permutations,
        max_plans=max_plans,
        max_actions=max_actions,
        max_work=max_work,
        chunk_size=chunk_size,
    )
    for plans in (real, generated):
        check_are_plans(plans)
    if real.num_actions != generated.num_actions:
        raise ValueError(
            f"generated: {real.num_actions} actions are expected, as in the real plans, not {generated.num_actions}"
        )
    names = real.action_names, generated.action_names
    check_same_names("action_names", *names, "the generated plans", "the real ones")
    draw = generator_on(generator, "cpu")
    kinds = [
        _drawn(name, plans, max_plans, max_actions, draw) for name, plans in (("real", real), ("generated", generated))
    ]
    if comb(sum(kind.num_plans for kind in kinds), kinds[0].num_plans) < FEWEST_WAYS:
        size = max(min(len(kind.actions) for kind in kinds) // BLOCKS, 1)
        kinds = [_cut(kind, size) for kind in kinds]
    first, second = kinds
    both = _Sequences(
        torch.cat([first.actions, second.actions]),
        torch.cat([first.plan, second.plan + first.num_plans]),
        first.num_plans + second.num_plans,
    )
    tested = [
        _test(name, counts, values, first.num_plans, permutations, max_work, chunk_size, draw)
        for name, counts, values in _statistics(both, real.num_actions)
    ]
    corrected = holm([one.p_value for one in tested])
    return [replace(one, corrected=float(p)) for one, p in zip(tested, corrected, strict=True)]


def _drawn(name: str, plans: Plans, max_plans: int, max_actions: int, generator: torch.Generator) -> _Sequences:
    """The plans that have actions, in random order, as many as are compared."""
    lengths = plans.mask().sum(1).cpu()
    taken = lengths.nonzero()[:, 0]
    if len(taken) == 0:
        raise ValueError(f"{name}: plans with at least one action are expected")
    taken = taken[torch.randperm(len(taken), generator=generator)][:max_plans]
    taken = taken[lengths[taken].cumsum(0) - lengths[taken] < max_actions]
    kept = plans[taken.to(plans.actions.device)]
    mask = kept.mask()
    plan = torch.arange(len(taken)).repeat_interleave(lengths[taken])
    return _Sequences(kept.actions[mask].long().cpu()[:max_actions], plan[:max_actions], len(taken))


def _cut(sequences: _Sequences, size: int) -> _Sequences:
    """Each plan cut into pieces of `size` actions; the last of a plan may be shorter."""
    plan = sequences.plan
    place = torch.arange(len(plan)) - torch.searchsorted(plan, plan)
    _, piece = (plan * len(plan) + place // size).unique_consecutive(return_inverse=True)
    return _Sequences(sequences.actions, piece, int(piece[-1]) + 1)


def _statistics(both: _Sequences, num_actions: int) -> Iterator[tuple[str, sparse.csr_matrix, Tensor]]:
    """Of each statistic that occurs the name, the counts `[K, N]` of its classes in the plans, the classes `[K, n]`."""
    actions, plan = both.actions, both.plan

    def counts(kind: Tensor, at: Tensor, kinds: int) -> sparse.csr_matrix:
        where = (kind.numpy(), plan[at].numpy())
        return sparse.coo_matrix((np.ones(len(at)), where), shape=(kinds, both.num_plans)).tocsr()

    at, gram = torch.arange(len(actions)), torch.zeros_like(actions)
    for n in ORDERS:
        whole = at + n - 1 < len(actions)
        whole &= plan[(at + n - 1).clamp(max=len(actions) - 1)] == plan[at]
        at, gram = at[whole], gram[whole]
        if len(at) == 0:
            break
        # From the rank of the first n - 1 actions, so that no code grows beyond what an integer holds.
        distinct, gram = (gram * num_actions + actions[at + n - 1]).unique(return_inverse=True)
        example = torch.zeros(len(distinct), dtype=torch.long).index_put_((gram,), at)
        yield f"{n}-grams", counts(gram, at, len(distinct)), actions[example[:, None] + torch.arange(n)]
    steps = torch.arange(1, LONGEST + 2)[:, None]
    begins = torch.ones_like(actions, dtype=torch.bool)
    begins[1:] = (actions[1:] != actions[:-1]) | (plan[1:] != plan[:-1])
    run = begins.nonzero()[:, 0]
    length = torch.diff(run, append=torch.tensor([len(actions)]))
    yield "run lengths", counts(length.clamp(max=LONGEST + 1) - 1, run, len(steps)), steps
    order = (plan * num_actions + actions).argsort(stable=True)
    same = (plan[order[1:]] == plan[order[:-1]]) & (actions[order[1:]] == actions[order[:-1]])
    if same.any():
        time = (order[1:] - order[:-1])[same]
        yield "return times", counts(time.clamp(max=LONGEST + 1) - 1, order[1:][same], len(steps)), steps


def _test(
    name: str,
    counts: sparse.csr_matrix,
    classes: Tensor,
    num_real: int,
    permutations: int,
    max_work: int,
    chunk_size: int,
    generator: torch.Generator,
) -> TwoSampleTest:
    """The permutation test of one statistic; the first `num_real` plans are real. `corrected` is not known yet."""
    kinds, num = counts.shape
    made = min(permutations, max(max_work // (counts.nnz + 4 * kinds), FEWEST_PERMUTATIONS))
    total = np.asarray(counts.sum(1))
    observed = np.zeros((num, 1))
    observed[:num_real] = 1
    is_real = counts @ observed
    distance = float(_distances(is_real, total)[0])
    null = []
    at_once = max(chunk_size // max(kinds, num), 1)
    for first in range(0, made, at_once):
        labels = np.zeros((num, min(at_once, made - first)))
        for column in labels.T:
            column[torch.randperm(num, generator=generator)[:num_real].numpy()] = 1
        null.append(_distances(counts @ labels, total))
    distances = np.concatenate(null)
    # Ties count, whatever their rounding.
    p_value = (1 + int((distances >= distance - 1e-9).sum())) / (1 + made)
    shares = [torch.from_numpy((part / max(part.sum(), 1))[:, 0]) for part in (is_real, total - is_real)]
    if classes.shape[1] > 1 or name == "1-grams":
        shown = (shares[0] + shares[1]).argsort(descending=True, stable=True)[:MOST_SHOWN]
        classes, shares = classes[shown], [share[shown] for share in shares]
    shown_classes = tuple(tuple(row) for row in classes.tolist())
    return TwoSampleTest(name, distance, float(distances.mean()), p_value, p_value, made, shown_classes, *shares)


def _distances(is_real: NDArray[np.float64], total: NDArray[np.float64]) -> NDArray[np.float64]:
    """The total variation `[P]` of counts `[K, P]` and of what is left to the totals `[K, 1]`."""
    first = is_real.sum(0)
    second = np.maximum(total.sum() - first, 1)
    gaps = is_real * (1 / np.maximum(first, 1) + 1 / second)
    gaps -= total / second
    distances: NDArray[np.float64] = np.abs(gaps, out=gaps).sum(0) / 2
    return distances
