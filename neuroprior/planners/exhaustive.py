"""The exhaustive planner: tries all plans up to a depth."""

from typing import Unpack

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.planners.planner import Decision, Objective, Planner, decide, join_decisions, random_best
from neuroprior.planners.rollouts import mean_scores, score_anew
from neuroprior.plans import action_dtype, all_plans
from neuroprior.worlds.world import World, allowed_actions, check_is_world, step_alive

MOST_PLANS = 2**24


class ExhaustivePlanner(Planner):
    """Tries all plans of `depth` actions: Hyvärinen's deterministic planner.

    Plans that share a prefix share its steps, so that a decision takes A + A**2 + ... + A**depth simulator steps. In a
    stochastic world each plan is tried by itself, which takes num_rollouts * depth * (A**depth + 1).

    Args:
        depth: number of actions in a plan, at least 1; A**depth may be at most 2**24.
        num_rollouts: see `SamplingPlanner`.
        **goal: objective, discount, value, any_prefix: see `Planner`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> decision = ExhaustivePlanner(depth=3).plan(world, torch.tensor([0, 12]))
        >>> decision.plan.shape, decision.model_steps
        (torch.Size([2, 3]), 84)
    """

    def __init__(self, depth: int, *, num_rollouts: int = 1, **goal: Unpack[Objective]) -> None:
        super().__init__(**goal)
        check_sizes(depth=depth, num_rollouts=num_rollouts)
        self.depth, self.num_rollouts = depth, num_rollouts

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        check_is_world(world)
        actions = world.num_actions
        if actions**self.depth > MOST_PLANS:
            raise ValueError(f"depth: {actions}**{self.depth} plans are too many; at most {MOST_PLANS} can be tried")
        world.check_state(state)
        planner, generator = self.for_world(world), generator_on(generator, state.device)
        if world.stochastic:
            plan_chunk, steps = planner._plan_apart, self.num_rollouts * self.depth * (actions**self.depth + 1)
        else:
            plan_chunk, steps = planner._plan_together, sum(actions**depth for depth in range(1, self.depth + 1))
        chunks = self.chunks(state, steps, cached=not world.stochastic)
        return join_decisions((plan_chunk(world, chunk, generator, steps) for chunk in chunks), len(state))

    def _plan_together(self, world: World, state: Tensor, generator: torch.Generator, steps: int) -> Decision:
        """In a deterministic world: all prefixes of a depth take their last step together."""
        batch, actions = len(state), world.num_actions
        all_actions = torch.arange(actions, device=state.device)
        now, rewards = state, torch.zeros(batch, 0, device=state.device)
        legal = torch.ones(batch, dtype=torch.bool, device=state.device)
        # For each depth at which a plan may end: scores, states and, unless all plans are legal, which ones are.
        ends_by_depth = []
        for depth in range(1, self.depth + 1):
            if not world.all_legal:
                legal = (legal[:, None] & allowed_actions(world, now)).flatten()
            now, reward = step_alive(world, _for_each(actions, now), all_actions.repeat(len(now)), generator)
            # A terminal score depends on the last reward only.
            before = _for_each(actions, rewards if self.objective == "return" else rewards[:, :0])
            rewards = torch.cat([before, reward[:, None]], 1)
            if self.any_prefix or depth == self.depth:
                ends = (self.score(rewards, now), now) if world.all_legal else (self.score(rewards, now), now, legal)
                ends_by_depth.append([values.view(batch, actions**depth, *values.shape[1:]) for values in ends])
        score, final_state, *allowed = (torch.cat(values, 1) for values in zip(*ends_by_depth, strict=True))
        best = random_best(score, generator, *allowed)
        row = torch.arange(batch, device=state.device)
        depths = torch.arange(self.depth - len(ends_by_depth) + 1, self.depth + 1, device=state.device)
        past = (actions**depths).cumsum(0)
        length = depths[torch.searchsorted(past, best, right=True)]
        # The digits in base A of a plan's number among those of its length are its actions; zeros fill it up.
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

    def _plan_apart(self, world: World, state: Tensor, generator: torch.Generator, steps: int) -> Decision:
        """In a stochastic world: each plan has rollouts of its own."""
        actions = world.num_actions
        plans = all_plans(actions, self.depth).to(state.device, action_dtype(actions))
        ending = None
        if self.any_prefix:
            # A prefix is scored once: in the plan that goes on with zeros.
            rest = actions ** torch.arange(self.depth - 1, -1, -1, device=state.device)
            ending = torch.arange(len(plans), device=state.device)[:, None] % rest == 0
        plans = plans.expand(len(state), -1, -1)
        score, ends = mean_scores(self, world, state, plans, self.num_rollouts, generator)
        decision = decide(plans, score, ends, steps, generator, ending)
        return score_anew(self, world, state, decision, self.num_rollouts, generator)


def _for_each(actions: int, values: Tensor) -> Tensor:
    """`values [N, ...]`, each repeated for all actions: `[N * actions, ...]`."""
    return values[:, None].expand(-1, actions, *values.shape[1:]).flatten(0, 1)
