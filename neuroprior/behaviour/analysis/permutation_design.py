"""What a test of conditions may permute: whole units, or the conditions within each unit, never its single plans."""

from collections import Counter
from dataclasses import dataclass
from itertools import permutations
from math import factorial, prod
from typing import Literal

import torch
from torch import Tensor

from neuroprior._random import generator_on
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.plans.columns import listed

Kind = Literal["between", "within"]

DRAWN_AT_ONCE = 2**21
"""Labels that are drawn at a time."""


@dataclass(frozen=True, eq=False)
class PermutationDesign:
    """The G units of plans under C conditions, and how their conditions may be permuted.

    A unit is a group; a plan, where there are no groups. All plans of a unit under one condition are a block. Where
    each unit is under one condition ("between"), permutations exchange the conditions of units. Where units are under
    several ("within", a paired or repeated design), they exchange the conditions of the blocks of each unit; units that
    are not under every condition are then left out. Plans of one unit under one condition are never separated.

    Attributes:
        kind: "between" or "within".
        item: what the units are, "groups" or "plans".
        conditions: int64 `[C]`: the numbers of the conditions, ascending.
        units: int64 `[G]`: the numbers of the groups, or of the plans, ascending.
        left_out: int64: the numbers of the units that are left out.
        block: int64 `[N]`: the block of each plan; -1 where its unit is left out, or it has no actions.
        unit: int64 `[B]`, ascending: the rank of the unit of each block.
        label: int64 `[B]`: the rank of the condition of each block.
        untestable: why nothing can be tested; empty where it can.
        odd: which units are under several conditions, where most are under one, and what to do; else empty.
    """

    kind: Kind
    item: str
    conditions: Tensor
    units: Tensor
    left_out: Tensor
    block: Tensor
    unit: Tensor
    label: Tensor
    untestable: str
    odd: str = ""

    @staticmethod
    def of(plans: RecordedPlans) -> "PermutationDesign":
        """The design of `plans`.

        Raises:
            ValueError: the plans have no condition.
        """
        if plans.condition is None:
            raise ValueError("condition: these plans have none; give them one, such as the treatment of each group")
        some = plans.mask().any(1).cpu()
        number = torch.arange(len(plans)) if plans.group is None else plans.group.cpu().long()
        conditions, label = plans.condition.cpu().long()[some].unique(return_inverse=True)
        numbers, unit = number[some].unique(return_inverse=True)
        under = torch.zeros(len(numbers), len(conditions), dtype=torch.bool)
        under[unit, label] = True
        kind: Kind = "within" if bool((under.sum(1) > 1).any()) else "between"
        kept = under.all(1) if kind == "within" else torch.ones(len(numbers), dtype=torch.bool)
        of_block, rank = under[kept].nonzero(), torch.full(under.shape, -1)
        rank[kept] = (under[kept].flatten().cumsum(0) - 1).view(-1, len(conditions)) if len(of_block) else -1
        block = torch.full((len(plans),), -1)
        block[some] = rank[unit, label]
        item = "plans" if plans.group is None else "groups"
        left = numbers[~kept]
        names = plans.condition_names
        named = [names[c] if names else f"condition {c}" for c in conditions.tolist()]
        reason = _reason(kind, item, under[kept], named)
        single = under.sum(1) == 1
        odd = ""
        if kind == "within" and single.sum() > (~single).sum() and not _reason("between", item, under[single], named):
            several = numbers[~single].tolist()
            groups = item == "groups" and plans.group_names
            odd = (
                f"Under several conditions: {listed([groups[n] for n in several] if groups else several)}; the other"
                f" {int(single.sum())} {item} are under one each. If that is a slip, mend the condition of their plans;"
                f" if not, leave these {item} out, and the others are compared with one another"
            )
        return PermutationDesign(
            kind, item, conditions, numbers[kept], left, block, of_block[:, 0], of_block[:, 1], reason, odd
        )

    @property
    def sizes(self) -> list[int]:
        """How many units are under each condition."""
        return self.label.bincount(minlength=len(self.conditions)).tolist()

    @property
    def possible(self) -> int:
        """The number of labellings, of ways to give the blocks their conditions."""
        if self.kind == "within":
            every: int = factorial(len(self.conditions)) ** len(self.units)
            return every
        same: int = prod(map(factorial, self.sizes))
        return factorial(len(self.label)) // same

    @property
    def equivalent(self) -> int:
        """How many labellings are one and the same division, with conditions renamed; their statistics are equal."""
        return prod(map(factorial, Counter(self.sizes).values()))

    def smallest_p(self, drawn: int) -> float:
        """The smallest p-value that a test with at most `drawn` random permutations can give."""
        return self.equivalent / self.possible if self.possible <= drawn + 1 else 1 / (drawn + 1)

    def labellings(self, drawn: int, generator: torch.Generator | None = None) -> Tensor:
        """`[B, P]`, int16: all labellings if at most `drawn` + 1, else random ones; the first is the observed.

        As the observed labelling is among them, the p-value of a statistic is the share of labellings that reach it.
        """
        if self.possible <= drawn + 1:
            found = self._every()
        else:
            draws, size = generator_on(generator, "cpu"), max(DRAWN_AT_ONCE // len(self.label), 1)
            parts = [self._random(min(size, drawn - at), draws) for at in range(0, drawn, size)]
            found = torch.cat([self.label[None].short(), *parts])
        return found.T.contiguous()

    def _random(self, number: int, generator: torch.Generator) -> Tensor:
        if self.kind == "within":
            return torch.rand(number, *self._shape, generator=generator).argsort(-1).flatten(1).short()
        return self.label.short()[torch.rand(number, len(self.label), generator=generator).argsort(1)]

    def _every(self) -> Tensor:
        num = len(self.conditions)
        if self.kind == "within":
            orders = torch.tensor(list(permutations(range(num))))
            place = len(orders) ** torch.arange(len(self.units))
            which = torch.arange(self.possible)[:, None].div(place, rounding_mode="floor") % len(orders)
            return orders[which].flatten(1).short()
        found, left = torch.zeros(1, 0, dtype=torch.int16), torch.tensor([self.sizes])
        for _ in self.label:  # each step gives one unit more each of the conditions that are left over
            row, label = (left > 0).nonzero().unbind(1)
            found = torch.cat([found[row], label[:, None].short()], 1)
            left = left[row] - torch.nn.functional.one_hot(label, num)
        observed = int((found == self.label).all(1).nonzero()[0, 0])
        return found.roll(-observed, 0)

    @property
    def _shape(self) -> tuple[int, int]:
        return len(self.units), len(self.conditions)


def _reason(kind: Kind, item: str, under: Tensor, names: list[str]) -> str:
    """Why the units, under the conditions `[G, C]`, cannot be tested; empty where they can."""
    if len(names) < 2:
        return "all plans are under one condition"
    if kind == "within":
        number = "none" if not len(under) else "only one"
        return "" if len(under) > 1 else f"of the {item}, {number} is under every condition; at least two are needed"
    few = [name for name, units in zip(names, under.sum(0).tolist(), strict=True) if units < 2]
    return f"{few[0]} has one of the {item} only; at least two are needed for each condition" if few else ""
