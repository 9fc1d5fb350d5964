"""The interface of a planner, what it optimises, and how ties are broken."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neuroprior.worlds.world import Rollout, World

STEPS_AT_ONCE = 2**22
"""Simulator steps (starts x plans x length) that a planner takes together; bounds memory."""

STEPS_CACHED = 2**19
"""The same where the results of the steps should stay in a CPU's cache: new memory costs more than the steps do."""


class Decision(NamedTuple):
    """What a planner decided for B starts.

    Attributes:
        plan: `[B, L]`: the best plan that it found; 0 beyond `lengths`.
        score: `[B]`: what its objective gives for that plan; in a world with chance the mean over the planner's own
            rollouts, which flatters the winner (`expected_score` does not).
        final_state: `[B, ...]`: where the plan ends (its executed part, where there are `lengths`); in a world with
            chance, in the first of the planner's rollouts.
        model_steps: single simulator steps that it took for each start.
        lengths: `[B]`: how many actions of each plan are to be executed; None: all.
    """

    plan: Tensor
    score: Tensor
    final_state: Tensor
    model_steps: int
    lengths: Tensor | None = None


class Planner(ABC):
    """Chooses, for each start, a plan with a high score.

    Args:
        objective: "terminal": a plan's score is the reward of its last step, where it ends (Hyvärinen, both
            simulations). "return": the sum of its rewards, step t (from 0) times `discount ** t`.
        discount: above 0, at most 1; for "return" alone.
        value: adds the value of the final state: a function from final states `[N, ...]` to `[N]`; with "return" times
            `discount ** L`.
        any_prefix: the agent may end a plan after any of its actions (at least one), so that a plan counts as its best
            prefix, and a shorter prefix with the same score as a longer one is as good.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(
        self,
        objective: Literal["terminal", "return"] = "terminal",
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
        any_prefix: bool = False,
    ) -> None:
        check_objective(objective, discount)
        self.objective, self.discount, self.value, self.any_prefix = objective, discount, value, any_prefix

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
            return self._add_value(rewards[..., -1], final_state)
        return self._add_value((rewards * self._weights(rewards)).sum(-1), final_state, self.discount**length)

    def prefix_scores(self, rewards: Tensor, states: Tensor) -> Tensor:
        """The scores `[..., L]` of all prefixes of plans that have `rewards [..., L]` and lead to `states [..., L]`."""
        if self.objective == "terminal":
            return self._add_value(rewards, states)
        weights = self._weights(rewards)
        return self._add_value((rewards * weights).cumsum(-1), states, self.discount * weights)

    def scored(self, rollout: Rollout) -> tuple[Tensor, Tensor]:
        """Scores and ends as `decide` takes them: of all prefixes where the rollout kept its states, else of plans."""
        if rollout.states is None:
            return self.score(rollout.rewards, rollout.final_state), rollout.final_state
        return self.prefix_scores(rollout.rewards, rollout.states), rollout.states

    def _weights(self, rewards: Tensor) -> Tensor:
        return self.discount ** torch.arange(rewards.shape[-1], device=rewards.device, dtype=rewards.dtype)

    def _add_value(self, score: Tensor, state: Tensor, weight: Tensor | float = 1.0) -> Tensor:
        """`score [...]` plus the weighted value of `state` (`[...]` and its own shape)."""
        if self.value is None:
            return score
        value = value_of(self.value, state.reshape(-1, *state.shape[score.dim() :]))
        return score + weight * value.view_as(score).to(score.dtype)


def value_of(value: Callable[[Tensor], Tensor], state: Tensor) -> Tensor:
    """The values `[N]` of `state [N, ...]`; raises ValueError where there are more, fewer, or a NaN among them."""
    values = value(state)
    if values.numel() != len(state) or values.isnan().any():
        raise ValueError(
            f"value: one number for each of {len(state)} states is expected, none NaN; got {values.numel()}"
        )
    return values.view(-1)


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
    # Scores are often one column of many, which is slow to read more than once.
    score = score.contiguous() if legal is None else score.masked_fill(~legal, -torch.inf)
    highest = score.amax(1, keepdim=True)
    if highest.isnan().any():
        raise ValueError("score: NaN; a reward of the world, or its value, is not a number")
    best = score == highest
    if legal is not None:
        best = best & legal
    draws = torch.rand(score.shape, generator=generator, device=score.device)
    return torch.where(best, draws, -1.0).argmax(1)


def random_top(score: Tensor, number: int, generator: torch.Generator) -> Tensor:
    """The indices `[B, number]` of the highest scores in each row of `score [B, P]`; of equals a random choice."""
    mixed = torch.rand(score.shape, generator=generator, device=score.device).argsort(1)
    order = score.gather(1, mixed).argsort(dim=1, descending=True, stable=True)
    return mixed.gather(1, order[:, :number])


def decide(
    plans: Tensor,
    score: Tensor,
    ends: Tensor,
    model_steps: int,
    generator: torch.Generator,
    allowed: Tensor | None = None,
) -> Decision:
    """The best of some candidates, or of their prefixes.

    Args:
        plans: `[B, P, L]`.
        score: `[B, P]`, or `[B, P, L]` where any prefix may win.
        ends: where they end, or their prefixes: as `score`, and the state's own dimensions.
        model_steps: what that took for each start.
        generator: breaks ties.
        allowed: bool, of a shape that `score` has or can be spread to: what may win; None: all. Something may.
    """
    row = torch.arange(len(plans), device=plans.device)
    if allowed is not None:
        allowed = allowed.expand(score.shape).flatten(1)
    if score.dim() == 2:
        best = random_best(score, generator, allowed)
        return Decision(plans[row, best], score[row, best], ends[row, best], model_steps)
    length = plans.shape[2]
    score = score.flatten(1)
    chosen = random_best(score, generator, allowed)
    best, last = chosen.div(length, rounding_mode="floor"), chosen % length
    beyond = torch.arange(length, device=plans.device) > last[:, None]
    plan = plans[row, best].masked_fill(beyond, 0)
    return Decision(plan, score[row, chosen], ends[row, best, last], model_steps, last + 1)


def in_chunks(
    plan_some: Callable[[Tensor], Decision], state: Tensor, steps_per_start: int, cached: bool = False
) -> Decision:
    """`plan_some` applied to as many starts at a time as memory allows, put together again.

    Where steps need little but memory, only so many are `cached` together on a CPU that they find room in its cache.
    """
    at_once = min(STEPS_AT_ONCE, STEPS_CACHED) if cached and state.device.type == "cpu" else STEPS_AT_ONCE
    size = max(at_once // max(steps_per_start, 1), 1)
    first = plan_some(state[:size])
    if len(state) <= size:
        return first
    # Room for all is made once: small results between large blocks that come and go would keep memory from being freed.
    plan, score, final_state = (part.new_empty(len(state), *part.shape[1:]) for part in first[:3])
    whole = Decision(
        plan,
        score,
        final_state,
        first.model_steps,
        None if first.lengths is None else first.lengths.new_empty(len(state)),
    )
    steps = first.model_steps
    for at in range(0, len(state), size):
        part = plan_some(state[at : at + size]) if at else first
        steps = max(steps, part.model_steps)
        for result, some in ((whole.plan, part.plan), (whole.score, part.score), (whole.final_state, part.final_state)):
            result[at : at + size] = some
        if whole.lengths is not None and part.lengths is not None:
            whole.lengths[at : at + size] = part.lengths
    return whole._replace(model_steps=steps)
