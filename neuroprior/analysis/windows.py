"""Plans laid end to end, so that all windows of so many actions can be counted at once, whatever the plans' lengths."""

from dataclasses import dataclass

import torch
from torch import Tensor

from neuroprior.plans import Plans


@dataclass(frozen=True, eq=False)
class Line:
    """The M actions of all plans, one plan after the other.

    Attributes:
        actions: int64 `[M]`.
        plan: int64 `[M]`, ascending: the plan of each action.
        place: int64 `[M]`: the number of each action in `plans.actions` laid flat, `plan * L + step`.
        num_actions: the number of actions, A.
    """

    actions: Tensor
    plan: Tensor
    place: Tensor
    num_actions: int

    @staticmethod
    def of(plans: Plans) -> "Line":
        """The actions of `plans`; an end symbol is an action like others."""
        place = plans.mask().flatten().nonzero()[:, 0]
        plan = place.div(max(plans.max_length, 1), rounding_mode="floor")
        return Line(plans.actions.flatten()[place].long(), plan, place, plans.num_actions)

    def without_repeats(self) -> "Line":
        """The same plans with each run of one action merged into a single action."""
        new = torch.ones_like(self.actions, dtype=torch.bool)
        new[1:] = (self.actions[1:] != self.actions[:-1]) | (self.plan[1:] != self.plan[:-1])
        return Line(self.actions[new], self.plan[new], self.place[new], self.num_actions)

    def starts(self, length: int) -> Tensor:
        """`[W]`: where on the line `length` >= 1 consecutive actions of one plan begin, ascending."""
        until = max(len(self.plan) - length + 1, 0)
        return (self.plan[:until] == self.plan[len(self.plan) - until :]).nonzero()[:, 0]


def ranks(codes: Tensor) -> Tensor:
    """The rank of each of `codes [n]` among the distinct ones, from 0: numbers that no further action makes too large.

    A code of k actions in base A overflows where A**k does; the rank among at most n codes never does.
    """
    found: Tensor = torch.unique(codes, return_inverse=True)[1]
    return found
