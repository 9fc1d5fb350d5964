"""Replay: the executed plans that an agent learns from, forgotten at random with time."""

import torch
from torch import Tensor

from neuroprior._checks import check_same_names, is_number
from neuroprior.plans import Plans


class Replay:
    """Executed plans that are forgotten at random.

    Each call of `forget` keeps each plan with probability `retention`, so that after n calls a plan is still there with
    probability `retention ** n`. Counts of these plans decay exponentially (in expectation; they stay integers, which
    smoothing methods need), and networks are trained mostly on recent plans; no prior needs to know of it.

    Args:
        retention: above 0, at most 1: nothing is forgotten.

    Attributes:
        plans: the stored plans; None: none yet.

    Raises:
        ValueError: `retention` is out of range.

    Example:
        >>> replay = Replay(retention=0.5)
    """

    def __init__(self, retention: float) -> None:
        if not is_number(retention) or not 0 < retention <= 1:
            raise ValueError(f"`retention` must be a probability above 0 and at most 1, got {retention!r}")
        self.retention = retention
        self.plans: Plans | None = None

    def __len__(self) -> int:
        return 0 if self.plans is None else len(self.plans)

    def forget(self, generator: torch.Generator) -> None:
        """Keep each plan with probability `retention`."""
        if self.plans is not None and self.retention < 1:
            draws = torch.rand(len(self.plans), generator=generator, device=generator.device)
            self.plans = self.plans[(draws < self.retention).to(self.plans.actions.device)]

    def add(self, plans: Plans) -> None:
        """Store more plans.

        Raises:
            ValueError: they do not have the actions of those before, or another kind of context.
        """
        if self.plans is None:
            self.plans = plans
            return
        before = self.plans
        if (before.num_actions, before.max_length) != (plans.num_actions, plans.max_length):
            raise ValueError(
                f"`plans` must have {before.max_length} steps of {before.num_actions} actions, as the stored"
                f" plans, got {plans.max_length} of {plans.num_actions}"
            )
        names = before.action_names, plans.action_names
        check_same_names("action_names", *names, "the plans", "the stored ones")
        kinds = [None if one.context is None else (one.context.dtype, one.context.shape[1:]) for one in (before, plans)]
        if kinds[0] != kinds[1]:
            raise ValueError("plans: their context is of another kind than that of the stored plans")
        lengths = None
        if before.lengths is not None or plans.lengths is not None:
            lengths = torch.cat([before.mask().sum(1), plans.mask().sum(1)])
        context = None
        if before.context is not None and plans.context is not None:
            context = torch.cat([before.context, plans.context])
        actions = torch.cat([before.actions, plans.actions])
        action_names = before.action_names if plans.action_names is None else plans.action_names
        self.plans = Plans(actions, plans.num_actions, lengths, action_names, context)

    def tensors(self) -> dict[str, Tensor]:
        """The stored plans as tensors by name, for files."""
        if self.plans is None:
            return {}
        tensors = {"actions": self.plans.actions, "lengths": self.plans.lengths, "context": self.plans.context}
        return {name: value for name, value in tensors.items() if value is not None}
