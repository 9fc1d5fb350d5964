"""MPPI: the plan is an average of candidates, weighted by the exponentials of their scores."""

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
from neuroprior.sampling.draws import check_temperature


class MPPIPlanner(VectorPlanner):
    """Information-theoretic model predictive path integral control (Williams et al. 2017, "Information theoretic MPC
    for model-based reinforcement learning", algorithm 2).

    Candidates are the plan so far plus Gaussian noise, clipped to the bounds; the new plan is their average, weighted
    by `softmax(score / temperature)`. It is an average, and not simulated: the score of a decision is that of the best
    candidate. The next decision starts from this plan, without what was executed, and from the middle of the range in
    its last step.

    A candidate that the prior proposes is weighted by its score as any other is, although it is no perturbation of the
    plan so far: the average then moves towards it. The control cost leaves it out. Which candidate is the best
    (`adapt_share`) is judged by the scores alone.

    Args:
        length, num_plans: see `VectorPlanner`.
        std: standard deviation of the noise, as a share of half the range of each dimension.
        temperature: above 0: the lower, the more the best candidate counts.
        normalise: divide the differences of scores by the standard deviation of the scores of the start's candidates,
            so that one temperature suits rewards of any scale; False: as in the paper.
        control_cost: of each own candidate, the sum over its entries of `u * e / std ** 2` is taken from the logarithm
            of its weight, where u is the plan so far, from the middle of the range, and e the clipped noise (the
            paper's cost of control with base distribution at the middle of the range, and gamma = temperature).
        noise_beta: exponent of the noise's spectrum, see `coloured_noise`; 0, as in the paper: white noise.
        **proposal: prior, prior_share, adapt_share, prior_as, discount, value: see `VectorPlanner`.

    Raises:
        ValueError: an argument is out of range, or `control_cost` is given with a `noise_beta` above 0.

    Example:
        >>> world = DoubleIntegrator()
        >>> MPPIPlanner(length=5, num_plans=16).plan(world, world.reset(2, torch.Generator().manual_seed(0))).plan.shape
        torch.Size([2, 5, 2])
    """

    averages = True

    def __init__(
        self,
        length: int,
        num_plans: int,
        *,
        std: float = 0.5,
        temperature: float = 0.1,
        normalise: bool = True,
        control_cost: bool = False,
        noise_beta: float = 0.0,
        **proposal: Unpack[Proposal],
    ) -> None:
        super().__init__(length, num_plans, **proposal)
        check_noise(std, noise_beta)
        check_temperature(temperature)
        if control_cost and noise_beta:
            raise ValueError(
                f"`noise_beta` must be 0 with a `control_cost`, which is defined for white noise, got {noise_beta}"
            )
        self.std, self.temperature, self.normalise, self.control_cost = std, temperature, normalise, control_cost
        self.noise_beta = noise_beta

    def plan(
        self,
        world: ContinuousWorld,
        state: Tensor,
        generator: torch.Generator | None = None,
        memory: Memory | None = None,
    ) -> VectorDecision:
        generator, memory = self.begin(world, state, generator, memory)
        low, high = world.action_low.to(state.device), world.action_high.to(state.device)
        middle, half = middle_and_half(world, state.device)
        mean = fill_plan(memory.mean, len(state), self.length, middle, repeat=False)
        shares = self.shares([self.num_plans], memory, generator)
        (proposed,) = self.proposals(shares, world, state, memory, generator)
        noise = coloured_noise((len(state), shares.most[0][0], *mean.shape[1:]), self.noise_beta, generator)
        candidates = mean[:, None] + self.std * half * noise
        plans = shares.mixed(0, candidates, self.around(mean, proposed)).clamp(low, high)
        score = self.scores(world, state, plans, generator)
        shares.observe(score)
        logits = self._logits(score)
        if self.control_cost:
            control = (mean - middle)[:, None] / (self.std * half).square()
            cost = (control * (plans - mean[:, None])).sum((-2, -1))
            logits = logits - torch.where(shares.is_prior(0), 0, cost)
        weights = logits.softmax(1).to(plans.dtype)
        mean = (weights[:, None] @ plans.flatten(2)).view_as(mean).clamp(low, high)
        kept = memory._replace(mean=mean, elites=None, wins=shares.wins)
        return VectorDecision(mean, score.amax(1), self.num_plans * self.length, kept)

    def _logits(self, score: Tensor) -> Tensor:
        """The logarithms of the weights `[B, P]`, up to a constant in each row."""
        if not score.isfinite().all():
            raise ValueError("`score` must be finite, of which MPPI makes weights, got an infinite one")
        score = score.double()  # differences of scores near the limits of float32 would be infinite
        less = score - score.amax(1, keepdim=True)
        if self.normalise:
            # Equally good candidates have equal weights; squares of what is far from 1 would be infinite, or 0.
            widest = less.abs().amax(1, keepdim=True)
            less = less / torch.where(widest > 0, widest, 1)
            spread = (less - less.mean(1, keepdim=True)).square().mean(1, keepdim=True).sqrt()
            less = less / torch.where(spread > 0, spread, 1)
        return less / self.temperature
