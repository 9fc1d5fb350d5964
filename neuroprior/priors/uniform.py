"""The uniform prior: every action equally probable; sampling from it is random search."""

from typing import Any, Self

import torch
from torch import Tensor

from neuroprior.plans import Plans
from neuroprior.priors.learning import training_plans
from neuroprior.priors.prior import Prior


class UniformPrior(Prior):
    """Every plan of a length equally probable: the prior of a planner that has learned nothing.

    Args:
        num_actions: A.

    Raises:
        ValueError: `num_actions` is out of range.

    Example:
        >>> UniformPrior(4).log_prob(torch.zeros(1, 3, dtype=torch.long)).exp().item() == 4**-3
        True
    """

    def __init__(self, num_actions: int) -> None:
        super().__init__(num_actions)

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        self.check_start(batch_size, context)
        return torch.zeros(batch_size, self.num_actions, device=self.device), torch.empty(
            batch_size, 0, device=self.device
        )

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        self.check_step(action, context)
        return self.start(len(action), context)

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Check `plans`, of which there is nothing to learn; returns self.

        Raises:
            ValueError: plans of other actions, or any setting.
        """
        self.check_settings(settings)
        training_plans(self, self.as_plans(plans).without_context())
        return self
