"""Plans laid end to end, so that sequences of actions are counted in all plans at once, whatever their lengths."""

from dataclasses import dataclass

import torch
from torch import Tensor

from neuroprior.plans import Plans
from neuroprior.plans.plans import check_are_plans


@dataclass(frozen=True, eq=False)
class FlatPlans:
    """The M actions of all plans in one row, plan after plan.

    Attributes:
        actions: int64 `[M]`.
        plan: int64 `[M]`, ascending: the plan of each action.
        place: int64 `[M]`: the index of each action in the flattened `plans.actions`, `plan * L + step`.
        num_actions: the number of actions, A.
    """

    actions: Tensor
    plan: Tensor
    place: Tensor
    num_actions: int

    @staticmethod
    def of(plans: Plans) -> "FlatPlans":
        """The actions of `plans`; an end symbol is an action like others."""
        check_are_plans(plans)
        place = plans.mask().flatten().nonzero()[:, 0]
        plan = place.div(max(plans.max_length, 1), rounding_mode="floor")
        return FlatPlans(plans.actions.flatten()[place].long(), plan, place, plans.num_actions)

    def starts(self, length: int) -> Tensor:
        """`[W]`: where `length` >= 1 consecutive actions of one plan begin, ascending."""
        until = max(len(self.plan) - length + 1, 0)
        return (self.plan[:until] == self.plan[len(self.plan) - until :]).nonzero()[:, 0]


def ranks(codes: Tensor) -> Tensor:
    """The rank, from 0, of each of `codes [n]` among the distinct ones.

    A sequence of k actions has the code of its first k - 1 times A plus the last. Codes of long sequences would
    overflow; ranks, which take their place before the next action is added, do not.
    """
    inverse: Tensor = torch.unique(codes, return_inverse=True)[1]
    return inverse
