"""Which action follows which: first-order transitions, overall and in each group, and whether the groups differ."""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from scipy import stats
from torch import Tensor

from neuroprior._random import generator_on
from neuroprior.analysis.statistics import holm
from neuroprior.analysis.windows import Line
from neuroprior.plans import Plans

FEWEST_PERMUTATIONS = 99
"""Permutations that are made whatever they cost."""

WORK = 10**9
"""Numbers that the permutations may touch in all: some ten seconds on one core."""

AT_ONCE = 2**21
"""Numbers that permutations made together may touch; memory is bounded by it."""

FEWEST_DIVISIONS = 20
"""Ways of dividing plans into groups below which no permutation could give a p-value of 0.05."""

ROUNDING = 1e-12
"""Statistics that differ less than this share of the terms they are sums of are tied: rounding depends on the order."""

Test = Literal["permutation", "chi-square", "none"]


@dataclass(frozen=True, eq=False)
class Transitions:
    """How often each action followed each other one, and whether groups differ in that.

    Attributes:
        counts: int64 `[A, A]`: how often each action (row) was followed by each (column) in one plan.
        group_counts: int64 `[G, A, A]`: the same in each group.
        groups: int64 `[G]`: the numbers of the groups, ascending; a single 0 where plans have no groups.
        statistic: the likelihood-ratio statistic G of "the groups do not differ" (Anderson and Goodman 1957).
        degrees_of_freedom: of its chi-square distribution.
        p_value: of that statistic; NaN without a test.
        cell_p_values: float64 `[G, A, A]`: for each group and transition, the p-value of "after the first action this
            group makes the transition as often as the others do", corrected for the number of cells. NaN where
            there is nothing to compare: this group or all others never went on from the first action, or nobody made
            the transition, or nobody any other from there.
        test: where the p-values come from: "permutation" of the groups of whole plans; "chi-square" where there are
            fewer than `FEWEST_DIVISIONS` ways of dividing the plans into such groups; "none" where no two groups can
            be compared.
        permutations: how many were made; 0 without any.
    """

    counts: Tensor
    group_counts: Tensor
    groups: Tensor
    statistic: float
    degrees_of_freedom: int
    p_value: float
    cell_p_values: Tensor
    test: Test
    permutations: int

    def probs(self) -> Tensor:
        """`[A, A]`, float64: the probability of each action (column) after each (row); NaN after one never followed."""
        return _row_probs(self.counts)

    def group_probs(self) -> Tensor:
        """`[G, A, A]`, float64: the same in each group."""
        return _row_probs(self.group_counts)


def transitions(plans: Plans, permutations: int = 999, generator: torch.Generator | None = None) -> Transitions:
    """The transitions between successive actions within plans, and a test of whether the groups differ in them.

    The null distribution is that of the same statistics after the groups of the plans were shuffled. Whole plans are
    shuffled, so that it does not matter how actions depend on each other within a plan; what is tested is that the
    plans of all groups, lengths included, come from one source. A p-value is (1 + shuffles that reach the statistic) /
    (1 + shuffles). A cell's statistic is the signed root of the likelihood ratio of its 2 x 2 table (this group or the
    others; this transition or others from there): a standardised difference, which keeps its scale where counts are
    small. It is held against the largest of all cells in each shuffle (Westfall and Young 1993: single-step maxT).

    With too few plans for that the chi-square distribution takes its place, under which an action depends on nothing
    but the one before (Anderson and Goodman 1957), and cells are corrected by Holm's procedure. That holds for many
    actions a group only: with few, or where the order is higher, it finds differences that are none.

    Args:
        plans: with a `group`; without, nothing is tested. An end symbol is an action like others.
        permutations: at most so many shuffles; fewer, but at least `FEWEST_PERMUTATIONS`, where so many would touch
            more than `WORK` numbers.
        generator: draws the shuffles.

    Raises:
        ValueError: `permutations` is below 1.
    """
    if permutations < 1:
        raise ValueError(f"permutations: an integer of at least 1 is expected, not {permutations}")
    line, size = Line.of(plans), plans.num_actions
    group = torch.zeros(len(plans), dtype=torch.long) if plans.group is None else plans.group.long()
    groups, group = group.to(line.actions.device).unique(return_inverse=True)
    at = line.starts(2)
    cell, plan = line.actions[at] * size + line.actions[at + 1], line.plan[at]
    group_counts = (group[plan] * size**2 + cell).bincount(minlength=len(groups) * size**2).view(-1, size, size)
    cells = torch.full((len(groups), size**2), float("nan"), dtype=torch.double, device=cell.device)
    made, p_value = 0, float("nan")
    table = _Table.of(group_counts)
    test = _which_test(table, group[plan.unique()].bincount())
    if test == "permutation":
        taken = _PlanCounts.of(plan, cell, group, table)
        made = min(permutations, max(WORK // _cost(table, taken), FEWEST_PERMUTATIONS))
        p_value, found = _permutation_test(table, taken, made, generator_on(generator, cell.device))
    elif test == "chi-square":
        p_value, found = _chi_square_test(table)
    if test != "none":
        cells[table.present[:, None], table.cell] = found
    statistic = float("nan") if test == "none" else float(table.overall(table.observed))
    return Transitions(
        group_counts.sum(0),
        group_counts,
        groups,
        statistic,
        table.degrees_of_freedom(),
        p_value,
        cells.view(-1, size, size),
        test,
        made,
    )


class _Table(NamedTuple):
    """The counts of the G groups that have transitions and the C transitions that somebody made, and what is fixed.

    Statistics take counts `[..., G, C]` with the same sums over groups.
    """

    present: Tensor  # int64 [G]: the groups
    cell: Tensor  # int64 [C], ascending: from * A + to
    row: Tensor  # int64 [C]: the rank of `from` among those that occurred
    observed: Tensor  # float64 [G, C]
    rows: int

    @staticmethod
    def of(group_counts: Tensor) -> "_Table":
        cell = group_counts.sum(0).flatten().nonzero()[:, 0]
        present = group_counts.sum((1, 2)).nonzero()[:, 0]
        observed = group_counts.flatten(1)[present[:, None], cell].double()
        start, row = cell.div(group_counts.shape[-1], rounding_mode="floor").unique(return_inverse=True)
        return _Table(present, cell, row, observed, len(start))

    def in_rows(self, values: Tensor) -> Tensor:
        """`[..., R]`: the sums of `values [..., C]` over each row of the transition matrix."""
        return values.new_zeros(*values.shape[:-1], self.rows).index_add_(-1, self.row, values)

    def degrees_of_freedom(self) -> int:
        groups, followers = (self.in_rows(self.observed) > 0).sum(0), self.row.bincount(minlength=self.rows)
        return int(((groups - 1) * (followers - 1)).sum())

    def comparable(self) -> Tensor:
        """`[G, C]` bool: where neither the group, the others, the transition nor its alternatives are empty."""
        ours, pooled = self.in_rows(self.observed)[:, self.row], self.observed.sum(0)
        every = self.in_rows(pooled)[self.row]
        return (ours > 0) & (ours < every) & (pooled < every)

    def overall(self, counts: Tensor) -> Tensor:
        """`[...]`: the likelihood-ratio statistic of homogeneity over groups, summed over rows."""
        pooled = self.observed.sum(0)
        fixed = _n_log_n(self.in_rows(pooled)).sum() - _n_log_n(pooled).sum()
        return 2 * (_n_log_n(counts).sum((-2, -1)) - _n_log_n(self.in_rows(counts)).sum((-2, -1)) + fixed)

    def cells(self, counts: Tensor) -> Tensor:
        """`[..., G, C]`: the likelihood-ratio statistic of each 2 x 2 table: its standardised difference squared."""
        pooled, in_rows = self.observed.sum(0), self.in_rows(counts)
        every = self.in_rows(pooled)
        ours = in_rows[..., self.row]
        found = _n_log_n(counts) + _n_log_n(ours - counts) + _n_log_n(pooled - counts)
        found += _n_log_n(every[self.row] - pooled - ours + counts)
        found -= (_n_log_n(in_rows) + _n_log_n(every - in_rows))[..., self.row]
        return 2 * (found + _n_log_n(every)[self.row] - _n_log_n(pooled) - _n_log_n(every[self.row] - pooled))

    def tie(self) -> float:
        return ROUNDING * float(_n_log_n(self.observed.sum()))


class _PlanCounts(NamedTuple):
    """The transitions of each of P plans that have any, as a sparse matrix, and the group of each plan."""

    plan: Tensor  # int64 [Z]
    column: Tensor  # int64 [Z]: of a `_Table`
    times: Tensor  # float64 [Z]
    label: Tensor  # int64 [P]: the row of the plan's group in a `_Table`

    @staticmethod
    def of(plan: Tensor, cell: Tensor, group: Tensor, table: _Table) -> "_PlanCounts":
        column = torch.searchsorted(table.cell, cell)
        which, rank = plan.unique_consecutive(return_inverse=True)
        codes, times = (rank * len(table.cell) + column).unique(return_counts=True)
        label = torch.searchsorted(table.present, group[which])
        row = codes.div(len(table.cell), rounding_mode="floor")
        return _PlanCounts(row, codes % len(table.cell), times.double(), label)

    def regroup(self, labels: Tensor, table: _Table) -> Tensor:
        """`[B, G, C]`: the counts under `labels [B, P]`."""
        width = len(table.cell)
        first = table.observed.numel() * torch.arange(len(labels), device=labels.device)[:, None]
        index = (labels * width + first).index_select(1, self.plan).add_(self.column)
        # Reshaping copies nothing where a single labelling of many plans is counted.
        weights = self.times.expand(index.shape).reshape(-1)
        counts = index.view(-1).bincount(weights, minlength=len(labels) * table.observed.numel())
        return counts.view(-1, *table.observed.shape)


def _which_test(table: _Table, plans: Tensor) -> Test:
    """The test for groups of `plans [G]` plans each, in whatever order."""
    if table.degrees_of_freedom() < 1:
        return "none"
    sizes = plans[plans > 0].double()
    alike = sizes.long().bincount().double()  # groups of one size may be exchanged without a new division
    divisions = torch.lgamma(sizes.sum() + 1) - torch.lgamma(sizes + 1).sum() - torch.lgamma(alike + 1).sum()
    return "permutation" if float(divisions) > math.log(FEWEST_DIVISIONS - 0.5) else "chi-square"


def _cost(table: _Table, taken: _PlanCounts) -> int:
    """Numbers that a permutation touches; shuffling a plan and comparing a cell take several."""
    return len(taken.times) + 6 * len(taken.label) + 8 * table.observed.numel()


def _permutation_test(
    table: _Table, taken: _PlanCounts, permutations: int, generator: torch.Generator
) -> tuple[float, Tensor]:
    """The p-value of all, and those `[G, C]` of the cells."""
    observed, tie = table.overall(table.observed), table.tie()
    greatest, reached = [], 1
    together = max(AT_ONCE // _cost(table, taken), 1)
    num, device = len(taken.label), taken.label.device
    for at in range(0, permutations, together):
        part = range(at, min(at + together, permutations))
        orders = [torch.randperm(num, generator=generator, device=device) for _ in part]
        counts = taken.regroup(taken.label[torch.stack(orders)], table)
        reached += int((table.overall(counts) >= observed - tie).sum())
        greatest.append(table.cells(counts).amax((1, 2)))
    ordered = torch.cat(greatest).sort().values
    cells = table.cells(table.observed)
    above = permutations - torch.searchsorted(ordered, cells - tie)
    corrected = (1 + above).double() / (1 + permutations)
    return reached / (1 + permutations), corrected.masked_fill(~table.comparable(), float("nan"))


def _chi_square_test(table: _Table) -> tuple[float, Tensor]:
    """The p-value of all, and those `[G, C]` of the cells."""
    p_value = float(stats.chi2.sf(float(table.overall(table.observed)), table.degrees_of_freedom()))
    comparable = table.comparable()
    cells = table.cells(table.observed)
    found = torch.full_like(cells, float("nan"))
    corrected = holm(stats.chi2.sf(cells[comparable].clamp(min=0).cpu().numpy(), 1))
    found[comparable] = torch.from_numpy(corrected).to(found)
    return p_value, found


def _n_log_n(counts: Tensor) -> Tensor:
    return torch.xlogy(counts, counts)


def _row_probs(counts: Tensor) -> Tensor:
    """0 / 0 is NaN: a row without counts has no probabilities."""
    return counts.double() / counts.sum(-1, keepdim=True)
