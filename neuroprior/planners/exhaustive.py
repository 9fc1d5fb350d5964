"""The exhaustive planner: every plan up to a depth."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from neuroprior.planners.planner import Decision, Planner, in_chunks, random_best
from neuroprior.plans import action_dtype
from neuroprior.randomness import generator_on
from neuroprior.worlds.world import World

MOST_PLANS = 2**24


class ExhaustivePlanner(Planner):
    """Tries every plan of `depth` actions: Hyvärinen's deterministic planner.

    Plans that share a prefix share its steps, so a decision takes A + A**2 + ... + A**depth of them.

    Args:
        depth: number of actions in a plan, at least 1; A**depth may be at most 2**24.
        objective, discount, value: see `Planner`.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(
        self,
        depth: int,
        *,
        objective: Literal["terminal", "return"] = "terminal",
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__(objective, discount, value)
        if depth < 1:
            raise ValueError(f"depth: at least 1 is expected, not {depth}")
        self.depth = depth

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        actions = world.num_actions
        if actions**self.depth > MOST_PLANS:
            raise ValueError(f"depth: {actions}**{self.depth} plans are too many; at most {MOST_PLANS} can be tried")
        world.check_state(state)
        generator = generator_on(generator, state.device)
        steps = sum(actions**depth for depth in range(1, self.depth + 1))

        def some(state: Tensor) -> Decision:
            return self._plan(world, state, generator, steps)

        return in_chunks(some, state, steps)

    def _plan(self, world: World, state: Tensor, generator: torch.Generator, steps: int) -> Decision:
        batch, actions = len(state), world.num_actions
        every = torch.arange(actions, device=state.device)
        now, rewards = state, torch.zeros(batch, 0, device=state.device)
        legal = torch.ones(batch, dtype=torch.bool, device=state.device)
        for _ in range(self.depth):
            legal = (legal[:, None] & world.legal(now)).flatten()
            before = now.repeat_interleave(actions, 0)
            now, reward = world.step(before, every.repeat(len(before) // actions), generator)
            rewards = torch.cat([rewards.repeat_interleave(actions, 0), reward[:, None]], 1)
        score = self.score(rewards, now)
        plans = actions**self.depth
        best = random_best(score.view(batch, plans), generator, legal.view(batch, plans))
        row = best + torch.arange(batch, device=state.device) * plans
        # The number of a plan, written in base A, is the plan.
        base = actions ** torch.arange(self.depth - 1, -1, -1, device=state.device)
        plan = best[:, None].div(base, rounding_mode="floor") % actions
        return Decision(plan.to(action_dtype(actions)), score[row], now[row], steps)
