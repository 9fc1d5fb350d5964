"""The distinct planner: different candidate plans from a prior, the best of them wins."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.planners.planner import Decision, Planner, decide, in_chunks
from neuroprior.priors.prior import Prior
from neuroprior.sampling.ancestral import check_in_world
from neuroprior.sampling.distinct import try_distinct
from neuroprior.sampling.draws import check_temperature
from neuroprior.worlds.world import World


class DistinctPlanner(Planner):
    """Tries `num_plans` plans drawn from a prior without replacement (stochastic beam search, see `sample_distinct`).

    What a sharp prior is sure of is tried once instead of again and again. Beginnings that plans share are tried once,
    so that a decision takes fewer steps of the world than that of a `SamplingPlanner` with as many plans.

    Args:
        prior: what proposes.
        length: number of actions in a plan, at least 1.
        num_plans: P, at least 1; where there are fewer plans of this length, all of them are tried.
        objective, discount, value, any_prefix: see `Planner`.
        temperature: divides the prior's logits.

    Raises:
        ValueError: an argument is out of range. `plan` raises it for a world with chance.
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
        check_sizes(length=length, num_plans=num_plans)
        check_temperature(temperature)
        self.prior, self.length, self.num_plans, self.temperature = prior, length, num_plans, temperature

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        check_in_world(self.prior, world, state)
        generator = generator_on(generator, state.device)
        steps = sum(min(self.num_plans, world.num_actions**depth) for depth in range(1, self.length + 1))

        def some(state: Tensor) -> Decision:
            plans, log_prob, rollout = try_distinct(
                self.prior,
                world,
                state,
                self.num_plans,
                self.length,
                temperature=self.temperature,
                generator=generator,
                keep_states=self.any_prefix,
            )
            score, ends = self.scored(rollout)
            there = log_prob > -torch.inf
            if not there.any(1).all():
                raise ValueError("prior: it gives no plan that exists from some start a probability above 0")
            return decide(plans, score, ends, steps, generator, there[..., None] if self.any_prefix else there)

        return in_chunks(some, state, steps)
