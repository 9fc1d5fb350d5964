"""Normalised scores against the number of candidate plans: what a planner reaches that samples from a prior."""

from collections.abc import Collection, Mapping, Sequence
from itertools import product
from time import perf_counter
from typing import NamedTuple

import torch
from torch import Tensor

from eval.worlds.starts import Starts, worth
from neuroprior import Prior, SamplingPlanner, UniformPrior
from neuroprior.planners import proposers
from neuroprior.planners.sampling import uniform_plans
from neuroprior.planners.tuning import TEMPERATURES, UNIFORM_SHARES, choices

ROLLOUTS = 16
"""Simulations of each candidate in a stochastic world."""

ROWS = 2**15
"""Candidates drawn together; with more the caches of a transformer are slower to move than to compute."""


class Sampling(NamedTuple):
    """How candidates are drawn: at a temperature, a share of them uniformly, the others by one of `proposers`."""

    temperature: float = 1.0
    uniform_share: float = 0.0
    proposer: int = 0


SETTINGS = tuple(Sampling(*both) for both in product(TEMPERATURES, UNIFORM_SHARES))
"""How priors may be sampled: an overconfident prior tries the same plans again and again."""


def settings_of(prior: Prior) -> list[Sampling]:
    """All ways of sampling a prior: with `SETTINGS`, and by each of its `proposers`."""
    return [one._replace(proposer=number) for number in range(len(proposers(prior))) for one in SETTINGS]


def planner_of(starts: Starts, prior: Prior, num_plans: int, sampling: Sampling) -> SamplingPlanner:
    """A planner that samples its candidates from a prior."""
    temperature, share, proposer = sampling
    how = starts.task.scoring | {"num_rollouts": ROLLOUTS, "temperature": temperature, "uniform_share": share}
    return SamplingPlanner(proposers(prior)[proposer], starts.length, num_plans, **how)


class Drawn(NamedTuple):
    """M candidates of each start.

    Attributes:
        plans: `[B, M, L]`.
        estimated: `[B, M]`: their scores as the planner finds them, which chooses by them.
    """

    plans: Tensor
    estimated: Tensor


def drawn(starts: Starts, prior: Prior, num_plans: int, sampling: Sampling, generator: torch.Generator) -> Drawn:
    """So many candidates of a prior for each start, none of them uniform."""
    planner, parts = planner_of(starts, prior, num_plans, sampling._replace(uniform_share=0.0)), []
    for state in starts.state.split(max(ROWS // num_plans, 1)):
        plans, score, _ = planner.candidates(starts.world, state, generator)
        parts.append((plans, score.amax(-1) if score.dim() == 3 else score))  # any prefix may win
    return Drawn(*map(torch.cat, zip(*parts, strict=True)))


def drawn_uniformly(starts: Starts, share: float, num_plans: int, generator: torch.Generator) -> Drawn | None:
    """As many uniform candidates for each start as are among so many candidates; None where there are none."""
    number = uniform_plans(share, num_plans)
    return drawn(starts, UniformPrior(starts.world.num_actions), number, Sampling(), generator) if number else None


def decided(
    starts: Starts, proposed: Drawn, uniform: Drawn | None, num_plans: int, share: float, generator: torch.Generator
) -> Tensor:
    """The scores `[B, D]` of D decisions of each start, each for the best of a block of candidates.

    What counts are exact scores, which differ from the planner's estimates in stochastic worlds.
    """
    whole = (
        proposed if uniform is None else Drawn(*(torch.cat(pair, 1) for pair in zip(proposed, uniform, strict=True)))
    )
    estimated, number = whole.estimated, proposed.estimated.shape[1]
    if not starts.world.stochastic:
        return estimated.gather(1, choices(estimated, number, num_plans, share))
    keys = torch.rand(estimated.shape, generator=generator, device=estimated.device)
    best = choices(estimated, number, num_plans, share, keys)
    row = torch.arange(len(best), device=best.device)[:, None]
    return worth(starts.task, starts.world, starts.state, whole.plans[row, best])


def tried(
    starts: Starts,
    prior: Prior,
    generator: torch.Generator,
    numbers: Sequence[int],
    settings: Sequence[Sampling] | None = None,
) -> dict[int, dict[Sampling, float]]:
    """For each number of candidates the normalised score of each way of sampling them, all from the same draws."""
    ways = settings_of(prior) if settings is None else settings
    most, scores = max(numbers), {number: dict.fromkeys(ways, 0.0) for number in numbers}
    uniform = drawn_uniformly(starts, max(one.uniform_share for one in ways), most, generator)
    for alike in dict.fromkeys(one._replace(uniform_share=0.0) for one in ways):
        candidates = drawn(starts, prior, most, alike, generator)
        for one in (one for one in ways if one._replace(uniform_share=0.0) == alike):
            for number in numbers:
                score = decided(starts, candidates, uniform, number, one.uniform_share, generator)
                scores[number][one] = starts.reached(score)["share"]
    return scores


def best(tables: Collection[Mapping[Sampling, float]]) -> Sampling:
    """The way of sampling with the highest mean score over tables, of equals the first."""
    return max(next(iter(tables)), key=lambda one: sum(table[one] for table in tables))


def curve(
    starts: Starts, prior: Prior, generator: torch.Generator, sampling: Sampling, budgets: Sequence[int]
) -> dict[str, list[float]]:
    """What a sampling planner reaches with each number of candidates.

    The largest number is drawn once from each start. Smaller numbers are blocks of it, each block a decision.

    Returns:
        See `Starts.reached`, a list for all numbers.
    """
    share = sampling.uniform_share
    uniform = drawn_uniformly(starts, share, max(budgets), generator)
    candidates = drawn(starts, prior, max(budgets), sampling, generator)
    reached = [starts.reached(decided(starts, candidates, uniform, number, share, generator)) for number in budgets]
    return {name: [one[name] for one in reached] for name in reached[0]}


def seconds_per_decision(
    starts: Starts, prior: Prior, generator: torch.Generator, sampling: Sampling, budgets: Sequence[int], number: int
) -> dict[int, tuple[float, int]]:
    """By number of candidates the seconds and model steps that a decision takes, at `number` starts together."""
    state, taken = starts.state[:number], {}
    planners = [planner_of(starts, prior, budget, sampling) for budget in budgets]
    # The first call is slower than those that follow, and the largest makes room for all.
    largest = max(planners, key=lambda planner: planner.num_plans)
    largest.plan(starts.world, state, torch.Generator(generator.device).manual_seed(0))
    for planner in planners:
        begin = perf_counter()
        decision = planner.plan(starts.world, state, generator)
        taken[planner.num_plans] = (perf_counter() - begin) / len(state), decision.model_steps
    return taken
