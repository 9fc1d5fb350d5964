"""The exhaustive planner: every plan up to a depth."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from neuroprior._random import generator_on
from neuroprior.planners.chance import check_rollouts, mean_scores
from neuroprior.planners.planner import Decision, Planner, decide, in_chunks, random_best
from neuroprior.plans import action_dtype, all_plans
from neuroprior.worlds.world import World

MOST_PLANS = 2**24


class ExhaustivePlanner(Planner):
    """Tries every plan of `depth` actions: Hyvärinen's deterministic planner.

    Plans that share a prefix share its steps, so a decision takes A + A**2 + ... + A**depth of them. In a world with
    chance each plan is tried by itself, which takes num_rollouts * depth * A**depth.

    Args:
        depth: number of actions in a plan, at least 1; A**depth may be at most 2**24.
        objective, discount, value, any_prefix: see `Planner`.
        num_rollouts: see `SamplingPlanner`.

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
        any_prefix: bool = False,
        num_rollouts: int = 1,
    ) -> None:
        super().__init__(objective, discount, value, any_prefix)
        if depth < 1:
            raise ValueError(f"depth: at least 1 is expected, not {depth}")
        check_rollouts(num_rollouts)
        self.depth, self.num_rollouts = depth, num_rollouts

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        actions = world.num_actions
        if actions**self.depth > MOST_PLANS:
            raise ValueError(f"depth: {actions}**{self.depth} plans are too many; at most {MOST_PLANS} can be tried")
        world.check_state(state)
        generator = generator_on(generator, state.device)
        steps = sum(actions**depth for depth in range(1, self.depth + 1))

        if world.stochastic:
            steps = self.num_rollouts * self.depth * actions**self.depth

        def some(state: Tensor) -> Decision:
            if world.stochastic:
                return self._plan_with_chance(world, state, generator, steps)
            return self._plan(world, state, generator, steps)

        return in_chunks(some, state, steps, cached=not world.stochastic)

    def _plan(self, world: World, state: Tensor, generator: torch.Generator, steps: int) -> Decision:
        batch, actions = len(state), world.num_actions
        every = torch.arange(actions, device=state.device)
        now, rewards = state, torch.zeros(batch, 0, device=state.device)
        legal = torch.ones(batch, dtype=torch.bool, device=state.device)
        found = []  # of each depth at which a plan may end: scores, states and, unless all are, legality, [B, A**depth]
        for depth in range(1, self.depth + 1):
            if not world.all_legal:
                legal = (legal[:, None] & world.legal_actions(now)).flatten()
            now, reward = world.step(_for_each(actions, now), every.repeat(len(now)), generator)
            # A terminal score looks at nothing before the last reward.
            before = _for_each(actions, rewards if self.objective == "return" else rewards[:, :0])
            rewards = torch.cat([before, reward[:, None]], 1)
            if self.any_prefix or depth == self.depth:
                ends = (self.score(rewards, now), now) if world.all_legal else (self.score(rewards, now), now, legal)
                found.append([values.view(batch, actions**depth, *values.shape[1:]) for values in ends])
        score, final_state, *allowed = (torch.cat(values, 1) for values in zip(*found, strict=True))
        best = random_best(score, generator, *allowed)
        row = torch.arange(batch, device=state.device)
        depths = torch.arange(self.depth - len(found) + 1, self.depth + 1, device=state.device)
        past = (actions**depths).cumsum(0)
        length = depths[torch.searchsorted(past, best, right=True)]
        # The number of a plan among those of its length, written in base A, is the plan; zeros fill it up.
        number = (best - past[length - depths[0]] + actions**length) * actions ** (self.depth - length)
        base = actions ** torch.arange(self.depth - 1, -1, -1, device=state.device)
        plan = number[:, None].div(base, rounding_mode="floor") % actions
        return Decision(
            plan.to(action_dtype(actions)),
            score[row, best],
            final_state[row, best],
            steps,
            length if self.any_prefix else None,
        )

    def _plan_with_chance(self, world: World, state: Tensor, generator: torch.Generator, steps: int) -> Decision:
        actions = world.num_actions
        plans = all_plans(actions, self.depth).to(state.device, action_dtype(actions))
        ending = None
        if self.any_prefix:
            # Of the plans that share a prefix, the one that goes on with zeros stands for it.
            rest = actions ** torch.arange(self.depth - 1, -1, -1, device=state.device)
            ending = torch.arange(len(plans), device=state.device)[:, None] % rest == 0
        plans = plans.expand(len(state), -1, -1)
        score, ends = mean_scores(self, world, state, plans, self.num_rollouts, generator)
        return decide(plans, score, ends, steps, generator, ending)


def _for_each(actions: int, values: Tensor) -> Tensor:
    """`values [N, ...]`, each so many times in a row: `[N * actions, ...]`."""
    return values[:, None].expand(-1, actions, *values.shape[1:]).flatten(0, 1)
