"""Random shooting: draw candidate plans, simulate them, take the best."""

from typing import Unpack

import torch
from torch import Tensor

from neuroprior.control.planners.coloured_noise import check_noise, coloured_noise
from neuroprior.control.planners.vector_planner import (
    Memory,
    Proposal,
    VectorDecision,
    VectorPlanner,
    fill_plan,
    middle_and_half,
)
from neuroprior.control.worlds.continuous_world import ContinuousWorld
from neuroprior.planners.planner import random_best


class ShootingPlanner(VectorPlanner):
    """Draws `num_plans` candidates and decides for the best; of equally good ones for a random one.

    Its own candidates are Gaussian noise, clipped to the bounds: around the middle of the range, or around what is left
    of the last plan, its last vector repeated. That plan itself is then a candidate, too, so that in a deterministic
    world the new plan is at least as good.

    Args:
        length, num_plans: see `VectorPlanner`.
        std: standard deviation of the noise, as a share of half the range of each dimension.
        noise_beta: exponent of its spectrum, see `coloured_noise`; 0: white noise.
        **proposal: prior, prior_share, adapt_share, prior_as, discount, value: see `VectorPlanner`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = DoubleIntegrator()
        >>> ShootingPlanner(length=5, num_plans=16).plan(
        ...     world, world.reset(2, torch.Generator().manual_seed(0))
        ... ).plan.shape
        torch.Size([2, 5, 2])
    """

    def __init__(
        self,
        length: int,
        num_plans: int,
        *,
        std: float = 0.5,
        noise_beta: float = 0.0,
        **proposal: Unpack[Proposal],
    ) -> None:
        super().__init__(length, num_plans, **proposal)
        check_noise(std, noise_beta)
        self.std, self.noise_beta = std, noise_beta

    def plan(
        self,
        world: ContinuousWorld,
        state: Tensor,
        generator: torch.Generator | None = None,
        memory: Memory | None = None,
    ) -> VectorDecision:
        generator, memory = self.begin(world, state, generator, memory)
        middle, half = middle_and_half(world, state.device)
        mean = fill_plan(memory.mean, len(state), self.length, middle, repeat=True)
        # A single candidate is drawn: else the plan would never change.
        again = memory.mean is not None and self.num_plans > 1
        drawn = self.num_plans - again
        shares = self.shares([drawn], memory, generator)
        (proposed,) = self.proposals(shares, world, state, memory, generator)
        noise = coloured_noise((len(state), shares.most[0][0], *mean.shape[1:]), self.noise_beta, generator)
        plans = shares.mixed(0, mean[:, None] + self.std * half * noise, self.around(mean, proposed))
        plans = torch.cat([mean[:, None], plans], 1) if again else plans
        plans = plans.clamp(world.action_low.to(plans), world.action_high.to(plans))
        score = self.scores(world, state, plans, generator)
        shares.observe(score[:, again:], score[:, :again])
        best, row = random_best(score, generator), torch.arange(len(state), device=state.device)
        plan = plans[row, best]
        steps = self.num_plans * self.length
        kept = memory._replace(mean=plan, elites=None, wins=shares.wins)
        return VectorDecision(plan, score[row, best], steps, kept)
