"""The distinct planner: different candidate plans from a prior, the best of them wins."""

import torch
from torch import Tensor

from neuroprior.planners.planner import Decision, PriorPlanner, decide, join_decisions
from neuroprior.sampling.distinct import start_beams_in_world
from neuroprior.worlds.world import World


class DistinctPlanner(PriorPlanner):
    """Tries `num_plans` plans drawn from a prior without replacement (stochastic beam search, see `sample_distinct`).

    A plan that the prior is nearly certain of is tried once instead of again and again. Prefixes that plans share are
    stepped once, so that a decision takes fewer simulator steps than that of a `SamplingPlanner` with as many plans.

    Args:
        prior: proposes the candidates.
        length: number of actions in a plan, at least 1.
        num_plans: P, at least 1; where there are fewer plans of this length, all of them are tried.
        temperature: divides the prior's logits.
        **goal: objective, discount, value, any_prefix: see `Planner`.

    Raises:
        ValueError: an argument is out of range. `plan` raises it for a stochastic world.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> decision = DistinctPlanner(UniformPrior(4), length=3, num_plans=64).plan(world, torch.tensor([0, 12]))
        >>> torch.equal(decision.score, oracle(world, torch.tensor([0, 12]), 3))  # 64 distinct plans are all of them
        True
    """

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        generator = self._check(world, state, generator)
        steps = sum(min(self.num_plans, world.num_actions**depth) for depth in range(1, self.length + 1))
        chunks = self.chunks(state, steps)
        return join_decisions((self._plan(world, some, steps, generator) for some in chunks), len(state))

    @torch.no_grad()
    def _plan(self, world: World, state: Tensor, steps: int, generator: torch.Generator) -> Decision:
        beams = start_beams_in_world(self.prior, world, state, self.temperature, generator)
        beams.extend(self.num_plans, self.length)
        score, ends = self.score_rollout(beams.rollout(state, keep_states=self.any_prefix))
        possible = beams.log_prob > -torch.inf
        plans = beams.plans.view(*possible.shape, self.length)
        return decide(plans, score, ends, steps, generator, possible[..., None] if self.any_prefix else possible)
