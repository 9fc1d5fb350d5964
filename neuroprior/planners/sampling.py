"""The sampling planner: candidate plans from a prior, the best of them wins."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from neuroprior.planners.planner import Decision, Planner, in_chunks, random_best
from neuroprior.priors.prior import Prior
from neuroprior.randomness import generator_on
from neuroprior.sampling import sample_in_world
from neuroprior.worlds.world import Rollout, World


class SamplingPlanner(Planner):
    """Tries `num_plans` plans drawn from a prior (Hyvärinen's random planner, with or without a behavioural prior).

    A prior without context proposes plans blindly, and they are tried as a whole. A prior that sees the world, and any
    prior in a world where not every action exists everywhere, is stepped together with the world.

    Args:
        prior: what proposes; `UniformPrior(A)` makes the random planner.
        length: number of actions in a plan, at least 1.
        num_plans: number of candidate plans for each start, at least 1.
        objective, discount, value, any_prefix: see `Planner`.
        temperature: of sampling.

    Raises:
        ValueError: an argument is out of range. `plan` raises it for a prior that samples an end symbol, too.
    """

    def __init__(
        self,
        prior: Prior,
        length: int,
        num_plans: int,
        *,
        objective: Literal["terminal", "return"] = "terminal",
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
        any_prefix: bool = False,
        temperature: float = 1.0,
    ) -> None:
        super().__init__(objective, discount, value, any_prefix)
        if length < 1 or num_plans < 1:
            raise ValueError(f"length and num_plans must be at least 1, not {length} and {num_plans}")
        if not 0 < temperature < float("inf"):
            raise ValueError(f"temperature: a positive finite number is expected, not {temperature}")
        self.prior, self.length, self.num_plans, self.temperature = prior, length, num_plans, temperature

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        world.check_state(state)
        if self.prior.end is not None:
            raise ValueError(
                "prior: it samples an end symbol, which is no action of the world; learn from plans without one"
            )
        if self.prior.num_actions != world.num_actions:
            raise ValueError(f"prior has {self.prior.num_actions} actions, the world {world.num_actions}")
        generator = generator_on(generator, state.device)

        def some(state: Tensor) -> Decision:
            return self._plan(world, state, generator)

        return in_chunks(some, state, self.num_plans * self.length)

    def _plan(self, world: World, state: Tensor, generator: torch.Generator) -> Decision:
        plans, rollout = self.candidates(world, state, generator)
        row = torch.arange(len(state), device=state.device)
        steps = self.num_plans * self.length
        if rollout.states is None:
            score = self.score(rollout.rewards, rollout.final_state)
            best = random_best(score, generator)
            return Decision(plans[row, best], score[row, best], rollout.final_state[row, best], steps)
        score = self.prefix_scores(rollout.rewards, rollout.states).flatten(1)
        chosen = random_best(score, generator)
        best, last = chosen.div(self.length, rounding_mode="floor"), chosen % self.length
        beyond = torch.arange(self.length, device=state.device) > last[:, None]
        plan = plans[row, best].masked_fill(beyond, 0)
        return Decision(plan, score[row, chosen], rollout.states[row, best, last], steps, last + 1)

    def candidates(self, world: World, state: Tensor, generator: torch.Generator) -> tuple[Tensor, Rollout]:
        """The candidate plans `[B, P, L]` for starts `[B, ...]`, and what comes of them."""
        if self.prior.takes_context or not world.all_legal:
            return sample_in_world(
                self.prior,
                world,
                state,
                self.num_plans,
                self.length,
                temperature=self.temperature,
                generator=generator,
                keep_states=self.any_prefix,
            )
        batch = len(state)
        plans = self.prior.sample(
            batch * self.num_plans, self.length, temperature=self.temperature, generator=generator
        ).view(batch, self.num_plans, self.length)
        return plans, world.rollout(state, plans, generator, self.any_prefix)
