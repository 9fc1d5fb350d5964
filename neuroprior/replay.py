"""Replay: the executed plans that an agent learns from, the older the fewer."""

import torch
from torch import Tensor

from neuroprior.plans import Plans


class Replay:
    """Executed plans that are forgotten at random.

    Each time `forget` is called, each plan is kept with probability `keep`, so that one that has been there for n of
    these calls is still there with probability `keep ** n`. What counts on it are counts with exponential forgetting
    (in the mean; whole numbers, as every way to smooth them needs), and what trains on it is trained the more on what
    is new; neither needs to know.

    Args:
        keep: above 0, at most 1: nothing is forgotten.

    Attributes:
        plans: what is remembered; None: nothing yet.

    Raises:
        ValueError: `keep` is out of range.
    """

    def __init__(self, keep: float) -> None:
        if not 0 < keep <= 1:
            raise ValueError(f"keep: a probability above 0 and at most 1 is expected, not {keep}")
        self.keep = keep
        self.plans: Plans | None = None

    def __len__(self) -> int:
        return 0 if self.plans is None else len(self.plans)

    def forget(self, generator: torch.Generator) -> None:
        """Keep each plan with probability `keep`."""
        if self.plans is not None and self.keep < 1:
            draws = torch.rand(len(self.plans), generator=generator, device=generator.device)
            self.plans = self.plans[(draws < self.keep).to(self.plans.actions.device)]

    def add(self, plans: Plans) -> None:
        """Remember more plans, of as many actions and with the same kind of context as those before."""
        if self.plans is None:
            self.plans = plans
            return
        before = self.plans

        def both(one: Tensor | None, other: Tensor | None) -> Tensor | None:
            return None if one is None or other is None else torch.cat([one, other])

        self.plans = Plans(
            torch.cat([before.actions, plans.actions]),
            plans.num_actions,
            both(before.lengths, plans.lengths),
            plans.action_names,
            both(before.context, plans.context),
        )

    def tensors(self) -> dict[str, Tensor]:
        """What is remembered, by name; for files."""
        if self.plans is None:
            return {}
        found = {"actions": self.plans.actions, "lengths": self.plans.lengths, "context": self.plans.context}
        return {name: value for name, value in found.items() if value is not None}
