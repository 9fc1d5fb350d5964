"""The interface of a planner, what it optimises, and how ties are broken."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neuroprior.worlds.world import World

STEPS_AT_ONCE = 2**22
"""Simulator steps (starts x plans x length) that a planner takes together; bounds memory."""


class Decision(NamedTuple):
    """What a planner decided for B starts.

    Attributes:
        plan: `[B, L]`: the best plan that it found.
        score: `[B]`: what its objective gives for that plan.
        final_state: `[B, ...]`: where the plan ends.
        model_steps: single simulator steps that it took for each start.
    """

    plan: Tensor
    score: Tensor
    final_state: Tensor
    model_steps: int


class Planner(ABC):
    """Chooses, for each start, a plan with a high score.

    Args:
        objective: "terminal": a plan's score is the reward of its last step, where it ends (Hyvärinen, both
            simulations). "return": the sum of its rewards, step t (from 0) times `discount ** t`.
        discount: above 0, at most 1; for "return" alone.
        value: adds the value of the final state: a function from final states `[N, ...]` to `[N]`; with "return" times
            `discount ** L`.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(
        self,
        objective: Literal["terminal", "return"] = "terminal",
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        check_objective(objective, discount)
        self.objective, self.discount, self.value = objective, discount, value

    @abstractmethod
    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        """Plan from each of B starts.

        Args:
            world: where.
            state: `[B, ...]`.
            generator: draws candidates, what is random in the world, and the winner among equally good plans.

        Raises:
            ValueError: states that are not the world's, or a prior for another number of actions.
        """

    def score(self, rewards: Tensor, final_state: Tensor) -> Tensor:
        """The scores `[...]` of plans with `rewards [..., L]` that end in `final_state` (`[...]` and its own shape)."""
        length = rewards.shape[-1]
        if self.objective == "terminal":
            score = rewards[..., -1]
            weight = 1.0
        else:
            weights = self.discount ** torch.arange(length, device=rewards.device, dtype=rewards.dtype)
            score = (rewards * weights).sum(-1)
            weight = self.discount**length
        if self.value is None:
            return score
        value = self.value(final_state.reshape(-1, *final_state.shape[score.dim() :]))
        if value.numel() != score.numel() or value.isnan().any():
            raise ValueError(
                f"value: one number for each of {score.numel()} states is expected, none of them NaN,"
                f" not {list(value.shape)}" + (" with NaN" if value.isnan().any() else "")
            )
        return score + weight * value.view_as(score).to(score.dtype)


def check_objective(objective: str, discount: float) -> None:
    """Raise ValueError where `objective` is not known or `discount` is out of range or has no part in it."""
    if objective not in ("terminal", "return"):
        raise ValueError(f'objective: "terminal" or "return" is expected, not {objective!r}')
    if not 0 < discount <= 1:
        raise ValueError(f"discount: a number above 0 and at most 1 is expected, not {discount}")
    if objective == "terminal" and discount != 1:
        raise ValueError('discount: it has no part in objective="terminal"; use objective="return"')


def random_best(score: Tensor, generator: torch.Generator, legal: Tensor | None = None) -> Tensor:
    """The index `[B]` of a highest score in each row of `score [B, P]`, uniform among equals.

    Where `legal [B, P]` is given, only scores that it marks count; it marks at least one in each row.
    """
    if legal is not None:
        score = score.masked_fill(~legal, -torch.inf)
    best = score == score.amax(1, keepdim=True)
    if legal is not None:
        best = best & legal
    draws = torch.rand(score.shape, generator=generator, device=score.device)
    return torch.where(best, draws, -1.0).argmax(1)


def in_chunks(plan_some: Callable[[Tensor], Decision], state: Tensor, steps_per_start: int) -> Decision:
    """`plan_some` applied to as many starts at a time as memory allows, put together again."""
    size = max(STEPS_AT_ONCE // max(steps_per_start, 1), 1)
    parts = [plan_some(state[at : at + size]) for at in range(0, len(state), size)] or [plan_some(state)]
    if len(parts) == 1:
        return parts[0]
    plan, score, final_state = (torch.cat(column) for column in list(zip(*parts, strict=True))[:3])
    return Decision(plan, score, final_state, parts[0].model_steps)
