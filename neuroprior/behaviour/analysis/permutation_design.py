"""What a test of conditions may permute: whole units, or the conditions within each unit, never its single plans."""

from collections import Counter
from dataclasses import dataclass
from math import factorial, prod
from typing import Literal

import torch
from torch import Tensor

from neuroprior._random import generator_on
from neuroprior.behaviour.recorded_plans import RecordedPlans, numbered_names
from neuroprior.plans.columns import listed

Kind = Literal["between", "within"]

DRAWN_AT_ONCE = 2**21
"""Labels that are drawn at a time."""

MAX_UNEVEN = 3.0
"""How many times as many behaviours a unit may have under one condition as under another without a note."""

MIN_UNITS = 2
"""Units that a condition must have at least; of more than two conditions a rarer one is left out."""


@dataclass(frozen=True, eq=False)
class PermutationDesign:
    """The G units of plans under C conditions in S strata, and how their conditions may be permuted.

    A unit is a group; a plan, where there are no groups. All plans of a unit under one condition are a block. Where
    each unit is under one condition ("between"), permutations exchange the conditions of units of the same stratum.
    Where units are under several ("within", a paired or repeated design), they exchange the conditions of the blocks of
    each unit. Plans of one unit under one condition are never separated.

    Left out are conditions with fewer than `MIN_UNITS` units, where two conditions remain; then, within units, units
    that are not under every condition, and between them, units of strata that are under one condition only.

    Attributes:
        kind: "between" or "within".
        item: what the units are, "subjects" or "sequences".
        conditions: int64 `[C]`: the numbers of the conditions, ascending.
        strata: int64 `[S]`: the numbers of the strata, ascending; 0 alone without strata.
        units: int64 `[G]`: the numbers of the groups, or of the plans, ascending.
        left_out: int64: the numbers of the units that are left out.
        block: int64 `[N]`: the block of each plan; -1 where it is left out, or it has no actions.
        unit: int64 `[B]`, ascending: the rank of the unit of each block.
        label: int64 `[B]`: the rank of the condition of each block.
        stratum: int64 `[B]`: the rank of the stratum of each block, the same for all blocks of a unit.
        untestable: why nothing can be tested; empty where it can.
        odd: which units are under several conditions, where most are under one, and what to do; else empty.
        notes: what was left out, a sentence each.
    """

    kind: Kind
    item: str
    conditions: Tensor
    strata: Tensor
    units: Tensor
    left_out: Tensor
    block: Tensor
    unit: Tensor
    label: Tensor
    stratum: Tensor
    untestable: str
    odd: str = ""
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(plans: RecordedPlans) -> "PermutationDesign":
        """Return the design of `plans`.

        Raises:
            ValueError: the plans have no condition, or a group is in several strata.
        """
        if plans.condition is None:
            raise ValueError("condition: these plans have none; give them one, such as the treatment of each group")
        acted = plans.mask().any(1).cpu()
        number = torch.arange(len(plans)) if plans.group is None else plans.group.cpu().long()
        conditions, label = plans.condition.cpu().long()[acted].unique(return_inverse=True)
        numbers, unit = number[acted].unique(return_inverse=True)
        strata, stratum = _strata(plans)[acted].unique(return_inverse=True)
        of_unit = torch.zeros_like(numbers)
        of_unit[unit] = stratum
        if (of_unit[unit] != stratum).any():
            raise ValueError("`stratum` must be the same for all plans of a group, got several for one group")
        under = torch.zeros(len(numbers), len(conditions), dtype=torch.bool)
        under[unit, label] = True
        item, notes = "sequences" if plans.group is None else "subjects", []
        names = numbered_names(plans.condition_names, conditions, "condition")

        rare = under.sum(0) < MIN_UNITS
        if rare.any() and (~rare).sum() > 1:
            left = [name for name, is_rare in zip(names, rare.tolist(), strict=True) if is_rare]
            notes.append(f"Left out, with fewer than {MIN_UNITS} {item}: {listed(left)}.")
            under, conditions = under[:, ~rare], conditions[~rare]
            names = [name for name in names if name not in left]
            label = torch.where(rare[label], -1, (~rare).cumsum(0)[label] - 1)
        kind: Kind = "within" if bool((under.sum(1) > 1).any()) else "between"
        single = under.sum(1) == 1
        if kind == "within":
            kept = under.all(1)
            if lost := int((~kept).sum()):
                notes.append(f"{lost} {item} that are not under every condition were left out.")
        else:
            sizes = torch.zeros(len(strata), len(conditions), dtype=torch.long).index_add_(0, of_unit, under.long())
            kept = under.any(1) & ((sizes > 0).sum(1) > min(len(strata) - 1, 1))[of_unit]
            if lost := int((under.any(1) & ~kept).sum()):
                notes.append(f"{lost} {item} of strata that are under one condition only were left out.")

        of_block, rank = under[kept].nonzero(), torch.full(under.shape, -1)
        rank[kept] = torch.where(under[kept], (under[kept].flatten().cumsum(0) - 1).view(-1, len(conditions)), -1)
        block = torch.full((len(plans),), -1)
        block[acted] = torch.where(label >= 0, rank[unit, label], -1)
        if kind == "between" and (note := _uneven(plans.mask().sum(1).cpu(), block, of_block[:, 1], names, item)):
            notes.append(note)
        odd = ""
        if kind == "within" and single.sum() > (~single).sum() and not _reason("between", item, under[single], names):
            several = numbers[~single].tolist()
            groups = item == "subjects" and plans.group_names
            odd = (
                f"Under several conditions: {listed([groups[n] for n in several] if groups else several)}; the other"
                f" {int(single.sum())} {item} are under one each. If that is a slip, mend the condition of their"
                f" sequences; if not, leave these {item} out, and the others are compared with one another"
            )
        remaining, stratum = of_unit[kept].unique(return_inverse=True)
        return PermutationDesign(
            kind,
            item,
            conditions,
            strata[remaining],
            numbers[kept],
            numbers[~kept],
            block,
            of_block[:, 0],
            of_block[:, 1],
            stratum[of_block[:, 0]],
            _reason(kind, item, under[kept], names),
            odd,
            tuple(notes),
        )

    @property
    def sizes(self) -> list[int]:
        """How many units are under each condition."""
        return self.label.bincount(minlength=len(self.conditions)).tolist()

    @property
    def cell(self) -> Tensor:
        """`[B]`: the cell of each block: its unit, or between units its stratum. Blocks of a cell exchange labels."""
        return self.unit if self.kind == "within" else self.stratum

    @property
    def cell_sizes(self) -> Tensor:
        """`[cells, C]`: how many blocks of each cell are under each condition."""
        num = len(self.conditions)
        return (self.cell * num + self.label).bincount(minlength=(int(self.cell.max()) + 1) * num).view(-1, num)

    @property
    def possible(self) -> int:
        """The number of labellings, of ways to give the blocks their conditions."""
        ways: int = prod(factorial(sum(sizes)) // prod(map(factorial, sizes)) for sizes in self.cell_sizes.tolist())
        return ways

    @property
    def equivalent(self) -> int:
        """How many labellings are one and the same division, with conditions renamed; their statistics are equal."""
        return prod(map(factorial, Counter(map(tuple, self.cell_sizes.T.tolist())).values()))

    def smallest_p(self, drawn: int) -> float:
        """The smallest p-value that a test with at most `drawn` random permutations can give."""
        return self.equivalent / self.possible if self.possible <= drawn + 1 else 1 / (drawn + 1)

    def labellings(self, drawn: int, generator: torch.Generator | None = None) -> Tensor:
        """`[B, P]`, int16: all labellings if at most `drawn` + 1, else random ones; the first is the observed.

        As the observed labelling is among them, the p-value of a statistic is the share of labellings that reach it.
        """
        if self.possible <= drawn + 1:
            labellings = self._every()
        else:
            draws, size = generator_on(generator, "cpu"), max(DRAWN_AT_ONCE // len(self.label), 1)
            parts = [self._random(min(size, drawn - at), draws) for at in range(0, drawn, size)]
            labellings = torch.cat([self.label[None].short(), *parts])
        return labellings.T.contiguous()

    def _random(self, number: int, generator: torch.Generator) -> Tensor:
        return self.label.short()[shuffle_within(self.cell, number, generator)]

    def _every(self) -> Tensor:
        sizes, order = self.cell_sizes, self.cell.argsort(stable=True)
        labellings, left, last = torch.zeros(1, 0, dtype=torch.int16), sizes[:1], 0
        for cell in self.cell[order].tolist():  # each step gives one block more each of the conditions that are left
            if cell != last:
                left, last = sizes[cell].expand(len(labellings), -1), cell
            row, label = (left > 0).nonzero().unbind(1)
            labellings = torch.cat([labellings[row], label[:, None].short()], 1)
            left = left[row] - torch.nn.functional.one_hot(label, sizes.shape[1])
        labellings = labellings[:, order.argsort()]
        observed = int((labellings == self.label).all(1).nonzero()[0, 0])
        return labellings.roll(-observed, 0)


def shuffle_within(cell: Tensor, number: int, generator: torch.Generator) -> Tensor:
    """Return random orders `[number, B]`, int64, that move nothing out of its `cell [B]`, integers from 0."""
    shuffled = (torch.rand(number, len(cell), generator=generator).double() + cell).argsort(1)
    return shuffled[:, cell.argsort(stable=True).argsort()]


def _strata(plans: RecordedPlans) -> Tensor:
    """The stratum of each plan `[N]`, 0 where there are none."""
    return torch.zeros(len(plans), dtype=torch.long) if plans.stratum is None else plans.stratum.cpu().long()


def _uneven(number: Tensor, block: Tensor, label: Tensor, names: list[str], item: str) -> str:
    """A note where units have far more behaviours under one condition than under another; "" where they do not.

    Args:
        number: `[N]`: the behaviours of each plan.
        block: `[N]`: its block; -1: it is left out.
        label: `[B]`: the condition of each block.
        names: of the conditions.
        item: "subjects" or "sequences".
    """
    kept, sizes = block >= 0, label.bincount(minlength=len(names))
    if int((sizes > 0).sum()) < 2:
        return ""
    means = label[block[kept]].bincount(number[kept].double(), minlength=len(names)) / sizes
    least, most = (int(place) for place in (means.argmin(), means.argmax()))
    if means[most] <= MAX_UNEVEN * means[least]:
        return ""
    return (
        f"Under {names[most]} there are {float(means[most] / means[least]):.2g} times as many behaviours per"
        f" {item.removesuffix('s')} as under {names[least]}: where groups differ so much in size and in noise, one test"
        " in ten may find a difference that is none."
    )


def _reason(kind: Kind, item: str, under: Tensor, names: list[str]) -> str:
    """Why the units, under the conditions `[G, C]`, cannot be tested; empty where they can."""
    if len(names) < 2:
        return "all sequences are under one condition"
    if kind == "within":
        number = "none" if not len(under) else "only one"
        return "" if len(under) > 1 else f"of the {item}, {number} is under every condition; at least two are needed"
    if not len(under):
        return "in each stratum all sequences are under one condition"
    few = [name for name, units in zip(names, under.sum(0).tolist(), strict=True) if units < MIN_UNITS]
    return f"{few[0]} has one of the {item} only; at least two are needed for each condition" if few else ""
