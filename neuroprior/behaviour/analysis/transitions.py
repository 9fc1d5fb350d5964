"""Which action follows which: first-order transitions, overall and in each group, and whether the groups differ."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import networkx as nx
import numpy as np
import pandas as pd
import torch
from scipy.special import stdtrit
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.behaviour.analysis.flat import FlatPlans
from neuroprior.behaviour.recorded_plans import RecordedPlans, action_names, numbered_names
from neuroprior.behaviour.recordings import Recordings
from neuroprior.plans import Plans

FEWEST_PERMUTATIONS = 99
"""Permutations that are made whatever they cost."""

FEWEST_DIVISIONS = 20
"""Ways of dividing plans into groups below which no permutation could give a p-value of 0.05."""

ROUNDING = 1e-12
"""Statistics whose difference is below this share of their terms are tied, as rounding depends on the order of sums."""

MAX_WORK = 10**9
"""Numbers that the permutations may access, some ten seconds on one core; beyond, fewer are made."""

NUMBERS_AT_ONCE = 2**21
"""Numbers that are in memory at a time."""

Test = Literal["permutation", "none"]


@dataclass(frozen=True, eq=False, repr=False)
class Transitions:
    """How often each action was followed by each other one, and whether groups differ in that.

    Groups are those of the plans (subjects), or with `by` the levels of a factor.

    Attributes:
        counts: int64 `[A, A]`: how often each action (row) was followed by each action (column) within a plan.
        group_counts: int64 `[G, A, A]`: the same in each group.
        groups: int64 `[G]`: the numbers of the groups, ascending; a single 0 if plans have no groups.
        statistic: the likelihood-ratio statistic of the hypothesis that groups do not differ (Anderson and Goodman
            1957).
        p_value: of that statistic; NaN without a test.
        cell_p_values: float64 `[G, A, A]`: for each group and transition, the p-value of the hypothesis that the
            transition has the same probability in this group as in the others, corrected for the number of cells. NaN
            where there is nothing to compare: the first action is never followed by another in this group, or in all
            others; or it is never, or always, followed by the second.
        test: "permutation" of the groups of whole plans; "none" if there are fewer than `FEWEST_DIVISIONS` ways of
            dividing the plans into such groups, or if no two groups are comparable.
        permutations: how many were made; 0 without any.
        low, high: float64 `[1 + G, A, A]`: the 95 % interval of each probability, of all and then of each group: over
            plans within a group, else over groups (subjects); NaN where there is one only.
        action_names: A names.
        group_names: G names.
        by: what groups are.
    """

    counts: Tensor
    group_counts: Tensor
    groups: Tensor
    statistic: float
    p_value: float
    cell_p_values: Tensor
    test: Test
    permutations: int
    low: Tensor
    high: Tensor
    action_names: Sequence[str]
    group_names: Sequence[str]
    by: Literal["subject", "condition"] = "subject"

    def __repr__(self) -> str:
        """Return how many transitions there are of how many kinds, and the p-value."""
        kinds, total = int((self.counts > 0).sum()), int(self.counts.sum())
        tested = "" if self.test == "none" else f", p = {self.p_value:.2g}"
        return f"Transitions({total:,} of {kinds:,} kinds, {len(self.group_names)} groups{tested})"

    def frame(self) -> pd.DataFrame:
        """Return a row for each transition that occurs, of all and of each group.

        Columns: `subject` or `condition` (`name_of_all` for all), `from`, `to`, `count`, `probability`, `low`, `high`,
        `p_value` (corrected).
        """
        counts = torch.cat([self.counts[None], self.group_counts])
        which, a, b = counts.nonzero(as_tuple=True)
        probs = torch.cat([self.probs()[None], self.group_probs()])
        p_values = torch.cat([torch.full_like(self.cell_p_values[:1], float("nan")), self.cell_p_values])
        names = np.array(self.action_names, dtype=object)
        groups = np.array([self.name_of_all, *self.group_names], dtype=object)
        columns = {self.by: groups[which.cpu()], "from": names[a.cpu()], "to": names[b.cpu()]}
        numbers = (counts, probs, self.low, self.high, p_values)
        named = zip(("count", "probability", "low", "high", "p_value"), numbers, strict=True)
        return pd.DataFrame(columns | {name: values[which, a, b].cpu().numpy() for name, values in named})

    @property
    def name_of_all(self) -> str:
        """Return what all groups together are called, which is "all" unless a group is."""
        return "all groups" if "all" in self.group_names else "all"

    def graph(self, group: str | None = None) -> nx.DiGraph:
        """Return the transitions above chance as a networkx graph, for GraphML, Graphviz and other programs.

        An edge is a transition whose interval lies above the share of its second action among all that follow another
        action. Nodes have `count`; edges `weight` (the probability), `low`, `high` and `count`.

        Args:
            group: the name of a group; None: all of them.

        Raises:
            ValueError: there is no such group.
        """
        if group is not None and group not in self.group_names:
            raise ValueError(f"`group` must be one of {', '.join(self.group_names)}, got {group!r}.")
        number = 0 if group is None else 1 + list(self.group_names).index(group)
        counts = (self.counts if number == 0 else self.group_counts[number - 1]).double()
        probs, low, high = _row_probs(counts), self.low[number], self.high[number]
        apart = counts.clone().fill_diagonal_(0)
        chance = apart.sum(0) / apart.sum().clamp(min=1)
        graph = nx.DiGraph()
        for name, count in zip(self.action_names, counts.sum(1).tolist(), strict=True):
            graph.add_node(name, count=int(count))
        for a, b in (low > chance).nonzero().tolist():
            edge = {"weight": float(probs[a, b]), "low": float(low[a, b]), "high": float(high[a, b])}
            graph.add_edge(self.action_names[a], self.action_names[b], **edge, count=int(counts[a, b]))
        return graph

    def probs(self) -> Tensor:
        """`[A, A]`, float64: the probability of each action (column) after each (row); NaN in rows without counts."""
        return _row_probs(self.counts)

    def group_probs(self) -> Tensor:
        """`[G, A, A]`, float64: the same in each group."""
        return _row_probs(self.group_counts)


def transitions(
    plans: Plans | Recordings,
    permutations: int = 999,
    generator: torch.Generator | None = None,
    *,
    by: str | None = None,
) -> Transitions:
    """The transitions between successive actions within plans, and a test of whether the groups differ in them.

    The null distribution is that of the same statistics after the groups of the plans were permuted. Whole plans are
    permuted, so that the test holds for any dependence of actions within a plan; the null hypothesis is that the plans
    of all groups, lengths included, have the same distribution. A p-value is (1 + permutations that reach the
    statistic) / (1 + permutations). A cell's statistic is the signed root of the likelihood ratio of its 2 x 2 table
    (this group or the others; this transition or others from the same action): a standardised difference, whose scale
    does not depend on the counts. It is compared to the largest of all cells in each permutation (Westfall and Young
    1993: single-step maxT).

    Args:
        plans: with a `group`; without, nothing is tested. An end symbol is an action like others. Or recordings.
        permutations: at most so many; fewer where they take more than `MAX_WORK`, but at least `FEWEST_PERMUTATIONS`.
        generator: draws the permutations.
        by: None: groups are the subjects. Else levels of this factor of the recordings, or "condition" of plans: then
            whole subjects are permuted; nothing is tested where a subject is under several levels.

    Raises:
        ValueError: `permutations` is below 1, or there is no such factor.

    Example:
        >>> transitions(Plans(torch.tensor([[0, 1, 0, 1, 1]]), 2)).counts.tolist()
        [[0, 2], [1, 1]]
    """
    check_sizes(permutations=permutations)
    if isinstance(plans, Recordings):
        plans = plans.plans(compare=by)
    elif by not in (None, "condition"):
        raise ValueError(f'`by` must be "condition" for plans, got {by!r}; recordings have factors by name.')
    flat, size = FlatPlans.of(plans), plans.num_actions
    subject = torch.arange(len(plans)) if plans.group is None else plans.group.long()
    if by is None:
        group, names, unit = plans.group, plans.group_names, torch.arange(len(plans))
    else:
        plans = RecordedPlans.of(plans)
        group, names, unit = plans.condition, plans.condition_names, subject
        if group is None:
            raise ValueError("`by` must be left out for plans without a condition.")
    group = torch.zeros(len(plans), dtype=torch.long) if group is None else group.long()
    groups, group = group.to(flat.actions.device).unique(return_inverse=True)
    at = flat.starts(2)
    cell, plan = flat.actions[at] * size + flat.actions[at + 1], flat.plan[at]
    group_counts = (group[plan] * size**2 + cell).bincount(minlength=len(groups) * size**2).view(-1, size, size)
    cells = torch.full((len(groups), size**2), float("nan"), dtype=torch.double, device=cell.device)
    drawn, p_value = 0, float("nan")
    table, units = _Table.of(group_counts), unit.to(cell.device)[plan]
    under = torch.stack([units, group[plan]]).unique(dim=1)  # the groups that each unit is in
    test: Test = "none" if len(under[0].unique()) < under.shape[1] else _which_test(table, under[1].bincount())
    if test == "permutation":
        taken = _PlanCounts.of(units, cell, group[plan], table)
        drawn = min(permutations, max(MAX_WORK // _cost(table, taken), FEWEST_PERMUTATIONS))
        p_value, corrected = _permutation_test(table, taken, drawn, generator_on(generator, cell.device))
        cells[table.present[:, None], table.cell] = corrected
    statistic = float("nan") if test == "none" else float(table.overall(table.observed))
    subjects = subject.to(cell.device)[plan]
    whole = _interval(cell, subjects if len(subjects.unique()) > 1 else plan, size)
    each = [_interval(cell[inside], units[inside], size) for inside in (group[plan] == g for g in range(len(groups)))]
    low, high = (torch.stack(ends) for ends in zip(whole, *each, strict=True))
    return Transitions(
        group_counts.sum(0),
        group_counts,
        groups,
        statistic,
        p_value,
        cells.view(-1, size, size),
        test,
        drawn,
        low,
        high,
        action_names(plans),
        numbered_names(names, groups, "group" if by is None else "condition"),
        "subject" if by is None else "condition",
    )


def _interval(cell: Tensor, unit: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The 95 % interval `[A, A]` of each transition's probability, which leaves out one unit at a time (jackknife).

    It is Student's on the scale of log odds, with as many degrees of freedom as units would have of equal counts (Kish
    1965, section 11.7). Of a transition that no other replaced, P(only this one) is p to the number of units at most.

    Args:
        cell: int64 `[M]`: from * A + to of each transition.
        unit: int64 `[M]`: the independent unit that it is of.
        size: A.
    """
    rank = unit.unique(return_inverse=True)[1]
    number = int(rank.max()) + 1 if len(rank) else 0
    kinds, kind = cell.unique(return_inverse=True)  # only these have a probability other than 0
    first, row = kinds.div(size, rounding_mode="floor").unique(return_inverse=True)
    counts = (rank * len(kinds) + kind).bincount(minlength=number * len(kinds)).view(number, len(kinds)).double()
    of_row = counts.new_zeros(number, len(first)).index_add_(1, row, counts)[:, row]
    units, weight = (of_row > 0).sum(0), of_row / of_row.sum(0)
    prob = counts.sum(0) / of_row.sum(0)
    changes = (counts / of_row.sum(0) - prob * weight) / (1 - weight)  # 0 / 0 where there is one unit
    error = (changes.square().sum(0) * (units - 1) / units).sqrt()
    freedom = (1 / weight.square().sum(0) - 1).clamp(min=1)
    student = torch.from_numpy(np.asarray(stdtrit(freedom.cpu().numpy(), 0.975))).to(error.device)
    half, certain = student * error / (prob * (1 - prob)), (prob == 1) & (units > 1)
    low, high = (torch.full((size**2,), torch.nan, dtype=torch.double, device=cell.device) for _ in range(2))
    low[kinds] = torch.where(certain, 0.025 ** (1 / units), torch.sigmoid(torch.logit(prob) - half))
    high[kinds] = torch.where(certain, 1.0, torch.sigmoid(torch.logit(prob) + half))
    return low.view(size, size), high.view(size, size)


class _Table(NamedTuple):
    """The counts `[G, C]` of the G groups that have transitions and the C transitions that occurred, and fixed sums.

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
        half = _n_log_n(counts) + _n_log_n(ours - counts) + _n_log_n(pooled - counts)
        half += _n_log_n(every[self.row] - pooled - ours + counts)
        half -= (_n_log_n(in_rows) + _n_log_n(every - in_rows))[..., self.row]
        return 2 * (half + _n_log_n(every)[self.row] - _n_log_n(pooled) - _n_log_n(every[self.row] - pooled))

    def tie(self) -> float:
        return ROUNDING * float(_n_log_n(self.observed.sum()))


class _PlanCounts(NamedTuple):
    """The transitions of each of P units (plans, or subjects) that have any, as a sparse matrix, and their groups."""

    plan: Tensor  # int64 [Z]
    column: Tensor  # int64 [Z]: of a `_Table`
    times: Tensor  # float64 [Z]
    label: Tensor  # int64 [P]: the row of the plan's group in a `_Table`

    @staticmethod
    def of(unit: Tensor, cell: Tensor, group: Tensor, table: _Table) -> "_PlanCounts":
        column = torch.searchsorted(table.cell, cell)
        which, rank = unit.unique(return_inverse=True)
        codes, times = (rank * len(table.cell) + column).unique(return_counts=True)
        label = which.new_zeros(len(which)).scatter_(0, rank, torch.searchsorted(table.present, group))
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
    """The test for groups of `plans [G]` plans each."""
    if not bool(table.comparable().any()):
        return "none"
    sizes = plans[plans > 0].double()
    same_size = sizes.long().bincount().double()  # exchanging groups of one size gives no new division
    divisions = torch.lgamma(sizes.sum() + 1) - torch.lgamma(sizes + 1).sum() - torch.lgamma(same_size + 1).sum()
    return "permutation" if float(divisions) > math.log(FEWEST_DIVISIONS - 0.5) else "none"


def _cost(table: _Table, taken: _PlanCounts) -> int:
    """Numbers that a permutation accesses; shuffling a plan and comparing a cell take several."""
    return len(taken.times) + 6 * len(taken.label) + 8 * table.observed.numel()


def _permutation_test(
    table: _Table, taken: _PlanCounts, permutations: int, generator: torch.Generator
) -> tuple[float, Tensor]:
    """The p-value of the whole table, and those `[G, C]` of the cells."""
    observed, tie = table.overall(table.observed), table.tie()
    greatest, reached = [], 1
    together = max(NUMBERS_AT_ONCE // _cost(table, taken), 1)
    num, device = len(taken.label), taken.label.device
    for at in range(0, permutations, together):
        batch = range(at, min(at + together, permutations))
        orders = [torch.randperm(num, generator=generator, device=device) for _ in batch]
        counts = taken.regroup(taken.label[torch.stack(orders)], table)
        reached += int((table.overall(counts) >= observed - tie).sum())
        greatest.append(table.cells(counts).amax((1, 2)))
    ordered = torch.cat(greatest).sort().values
    cells = table.cells(table.observed)
    above = permutations - torch.searchsorted(ordered, cells - tie)
    corrected = (1 + above).double() / (1 + permutations)
    return reached / (1 + permutations), corrected.masked_fill(~table.comparable(), float("nan"))


def _n_log_n(counts: Tensor) -> Tensor:
    return torch.xlogy(counts, counts)


def _row_probs(counts: Tensor) -> Tensor:
    """0 / 0 is NaN: a row without counts has no probabilities."""
    return counts.double() / counts.sum(-1, keepdim=True)
