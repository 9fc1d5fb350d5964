"""iCEM: the cross-entropy method in few samples, with coloured noise and elites kept from one iteration to the next."""

from itertools import pairwise
from typing import Unpack

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
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
from neuroprior.planners.planner import random_top

MIN_POPULATION = 4
"""Candidates in an iteration, at least, where there are as many: two elites, and twice as many to choose them from."""

DECAY = 1.25
"""An iteration has so many times fewer candidates than the one before, as in the paper."""

KEPT_SHARE = 0.3
"""The share of the elites that goes on to the next iteration and decision, as in the paper; at least one does."""

MOMENTUM = 0.1
"""The share of the old mean and standard deviation in the refitted ones, as in the paper."""


class ICEMPlanner(VectorPlanner):
    """The improved cross-entropy method (Pinneri et al. 2020, "Sample-efficient Cross-Entropy Method for Real-time
    Planning", algorithm 1).

    Candidates are coloured noise around a mean, clipped to the bounds; the mean and the standard deviation of each
    entry are refitted to the best candidates, the elites, and the next iteration draws around them. A share of the
    elites goes on to the next iteration with their scores (they are not simulated again), and, shifted in time and
    filled up with noise, to the first iteration of the next decision. The last iteration tries the mean itself. The
    decision is the best candidate of all; the next one starts from the mean, without what was executed and its last
    vector repeated, and from the first standard deviation.

    All candidates that are simulated count: `num_plans` is their number over all iterations, of which each has 1.25
    times fewer than the one before (rounded; shifted elites and the mean are among them). There are fewer iterations
    where the last would otherwise have less than four candidates. There are at most half as many elites as the last
    iteration has candidates, and at least two. With 97 candidates the defaults are the reference's 40, 32 and 25 with
    ten elites.

    A prior's candidates are among those of the first iteration (`prior_iterations`), mixed with the planner's own: the
    elites are chosen from, and the distribution is refitted to, all of them; later iterations search around the best.
    As noise (`prior_as`), what it proposes in a later iteration is scaled as the standard deviation is.
    At `prior_share=1` the prior draws all of them but shifted elites.

    Args:
        length, num_plans: see `VectorPlanner`.
        iterations: at most so many.
        elites: K, at most so many.
        std: the first standard deviation, as a share of half the range of each dimension.
        noise_beta: exponent of the noise's spectrum, see `coloured_noise`. The paper chooses it task by task, from 0.25
            (running) to 4.
        prior_iterations: the prior proposes candidates in so many first iterations, `prior_share` of those drawn there;
            None: in all.
        **proposal: prior, prior_share, adapt_share, prior_as, discount, value: see `VectorPlanner`.

    Attributes:
        populations: how many candidates are simulated in each iteration; their sum is `num_plans`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = DoubleIntegrator()
        >>> decision = ICEMPlanner(length=5, num_plans=16).plan(world, world.reset(2, torch.Generator().manual_seed(0)))
        >>> decision.plan.shape
        torch.Size([2, 5, 2])
    """

    def __init__(
        self,
        length: int,
        num_plans: int,
        *,
        iterations: int = 3,
        elites: int = 10,
        std: float = 0.5,
        noise_beta: float = 3.0,
        prior_iterations: int | None = 1,
        **proposal: Unpack[Proposal],
    ) -> None:
        super().__init__(length, num_plans, **proposal)
        check_sizes(iterations=iterations, elites=elites)
        if prior_iterations is not None:
            check_sizes(prior_iterations=prior_iterations)
        check_noise(std, noise_beta)
        self.populations = populations(num_plans, iterations)
        self.num_elites = max(min(elites, self.populations[-1] // 2), 2)
        self.num_kept = max(int(KEPT_SHARE * self.num_elites + 1e-9), 1)
        self.std, self.noise_beta = std, noise_beta
        self.prior_iterations = len(self.populations) if prior_iterations is None else prior_iterations

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
        mean = fill_plan(memory.mean, len(state), self.length, middle, repeat=True)
        std = first = (self.std * half).expand_as(mean)
        shifted = self._extend_elites(memory.elites, mean, std, generator)
        # An iteration draws at least one candidate.
        again = [min(shifted.shape[1], self.populations[0] - 1)] + [0] * (len(self.populations) - 1)
        drawn = [size - old for size, old in zip(self.populations, again, strict=True)]
        with_mean = drawn[-1] > 1
        drawn[-1] -= with_mean
        shares = self.shares(drawn, memory, generator, self.prior_iterations)
        proposals = self.proposals(shares, world, state, memory, generator)
        elites, elite_score = shifted[:, :0], torch.zeros(len(state), 0, device=state.device)
        best, best_score = mean, torch.full((len(state),), -torch.inf, device=state.device)
        for i, number in enumerate(drawn):
            noise = coloured_noise((len(state), shares.most[i][0], *mean.shape[1:]), self.noise_beta, generator)
            proposed = self.around(mean, proposals[i], (std / first)[:, None])
            parts = [shares.mixed(i, mean[:, None] + std[:, None] * noise, proposed)]
            if i == len(drawn) - 1 and with_mean:
                parts.append(mean[:, None])
            if again[i]:
                parts.append(shifted[:, : again[i]])
            plans = torch.cat(parts, 1).clamp(low, high)
            score = self.scores(world, state, plans, generator)
            if i == 0:
                shares.observe(score[:, :number], score[:, number:])
            plans = torch.cat([plans, elites[:, : self.num_kept]], 1)
            score = torch.cat([score, elite_score[:, : self.num_kept]], 1)
            top = random_top(score, self.num_elites, generator)
            row = torch.arange(len(state), device=state.device)[:, None]
            elites, elite_score = plans[row, top], score[row, top]
            better = elite_score[:, 0] > best_score if i else torch.ones_like(row[:, 0], dtype=torch.bool)
            best = torch.where(better[:, None, None], elites[:, 0], best)
            best_score = torch.where(better, elite_score[:, 0], best_score)
            centre = elites.mean(1)
            spread = (elites - centre[:, None]).square().mean(1).sqrt()
            mean, std = torch.lerp(centre, mean, MOMENTUM), torch.lerp(spread, std, MOMENTUM)
        kept = memory._replace(mean=mean, elites=elites[:, : self.num_kept], wins=shares.wins)
        return VectorDecision(best, best_score, self.num_plans * self.length, kept)

    def _extend_elites(self, elites: Tensor | None, mean: Tensor, std: Tensor, generator: torch.Generator) -> Tensor:
        """The elites of the decision before, `[B, E, M, D]`, as candidates `[B, E, L, D]`: filled up with noise."""
        if elites is None or not elites.shape[1]:
            return mean[:, None][:, :0]
        kept = elites.shape[2]
        if kept >= self.length:
            return elites[:, :, : self.length]
        noise = coloured_noise((*elites.shape[:2], *mean.shape[1:]), self.noise_beta, generator)
        return torch.cat([elites, (mean[:, None] + std[:, None] * noise)[:, :, kept:]], 2)


def populations(num_plans: int, iterations: int) -> list[int]:
    """`num_plans` divided among at most so many iterations, each with `DECAY` times fewer than the one before.

    Fractions are rounded so that the sum is exact; iterations are left out at the end until each has at least
    `MIN_POPULATION`.
    """
    for number in range(min(iterations, num_plans), 0, -1):
        shares = [DECAY**-i for i in range(number)]
        up_to = [round(num_plans * sum(shares[: i + 1]) / sum(shares)) for i in range(number)]
        sizes = [after - before for before, after in pairwise([0, *up_to])]
        if number == 1 or min(sizes) >= MIN_POPULATION:
            break
    return sizes
