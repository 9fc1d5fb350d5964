"""What helps a planner that samples: who proposes, at which temperature, with how many uniform plans, and hard plans.

The likeliest plans are not the best candidates: those are likely and different. `best_sampling` chooses by what is
found in a world, and `search_weights` says which plans to learn from.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from math import inf, log
from typing import Any, NamedTuple, Unpack

import torch
from torch import Tensor

from neuroprior._checks import as_list, check_share, check_sizes
from neuroprior._random import generator_on
from neuroprior.planners.planner import Objective
from neuroprior.planners.rollouts import mean_scores
from neuroprior.planners.sampling import SamplingPlanner, uniform_plans
from neuroprior.priors.ensembles.mixture import MixturePrior
from neuroprior.priors.uniform import UniformPrior
from neuroprior.sampling.draws import check_temperature
from neuroprior.sampling.stepping import Steppable, check_in_world
from neuroprior.worlds.world import World

TEMPERATURES = (1.0, 1.5, 2.0)
"""Temperatures that are tried: an overconfident prior proposes the same plans again and again."""

UNIFORM_SHARES = (0.0, 0.1, 0.3)
"""Shares of uniform plans that are tried."""

SMALLEST = -600.0
"""The logarithm of a probability below which `num_plans` times it is as good as exact, and its `exp` may be 0."""

DIGITS = 9
"""Logarithms that agree to so many digits after the point are equal."""


class Tuned(NamedTuple):
    """What `best_sampling` chose.

    Attributes:
        planner: samples in this way.
        prior: who proposes: one of `proposers`.
        temperature: divides the logits of `prior`.
        uniform_share: the share of uniform plans.
        scores: of each (prior, temperature, uniform share) that was tried, the mean score of its decisions.
    """

    planner: SamplingPlanner
    prior: Steppable
    temperature: float
    uniform_share: float
    scores: Mapping[tuple[Steppable, float, float], float]


def proposers(prior: Steppable) -> tuple[Steppable, ...]:
    """Who may propose candidates: the prior, and where it is a mixture of several, each of its experts alone.

    The mixture that predicts plans best need not be the best to search with. An expert that is unsure of what it does
    not know proposes more plans that differ. And an expert that a combined prior left out, since the others predict
    plans of their own world better, may find better plans in other worlds: those in its `spare` may propose alone, too.

    Example:
        >>> len(proposers(MarkovPrior(4, 1)))
        1
    """
    alone = prior.alternatives if isinstance(prior, MixturePrior) else ()
    return (prior, *alone) if len(alone) > 1 else (prior,)


def best_sampling(
    prior: Steppable,
    world: World,
    state: Tensor,
    length: int,
    num_plans: int,
    *,
    temperatures: Sequence[float] = TEMPERATURES,
    uniform_shares: Sequence[float] = UNIFORM_SHARES,
    num_rollouts: int = 1,
    generator: torch.Generator | None = None,
    **goal: Unpack[Objective],
) -> Tuned:
    """Who proposes, the temperature and the share of uniform plans whose decisions score highest from some starts.

    Candidates are drawn once from each of `proposers(prior)` at each temperature, and uniform ones once: each setting
    decides among some of both. In a stochastic world what is chosen is scored by new rollouts, so that varied
    candidates do not win by luck.

    Args:
        prior, length, num_plans, num_rollouts: see `SamplingPlanner`.
        **goal: `objective` and `discount`, see `SamplingPlanner`.
        world: a world that the prior did not learn from: where it did, it is overconfident.
        state: starts `[B, ...]` in it, at least one; some hundreds suffice to find the best setting.
        temperatures, uniform_shares: what is tried; of settings with equal scores, the first.
        generator: draws the candidates and the steps of a stochastic world.

    Raises:
        ValueError: an argument is out of range, or there is nothing to try.

    Example:
        >>> world, generator = gridworld(5, 5, seed=0), torch.Generator().manual_seed(0)
        >>> best_sampling(
        ...     UniformPrior(4), world, world.reset(50, generator), length=3, num_plans=8, generator=generator
        ... ).temperature
        1.0
    """
    temperatures, uniform_shares = as_tried(temperatures, uniform_shares)
    check_in_world(prior, world, state)
    if len(state) == 0:
        raise ValueError("`state` must have at least one start; from none, no setting is better than another")
    generator = generator_on(generator, state.device)

    def planner(prior: Steppable, number: int, temperature: float = 1.0, share: float = 0.0) -> SamplingPlanner:
        how: dict[str, Any] = {"num_rollouts": num_rollouts, "temperature": temperature, "uniform_share": share}
        return SamplingPlanner(prior, length, number, **how, **goal)

    planners = {(who, heat): planner(who, num_plans, heat) for who, heat in product(proposers(prior), temperatures)}
    uniform = max(uniform_plans(share, num_plans) for share in uniform_shares)
    even = planner(UniformPrior(world.num_actions), uniform) if uniform else None
    totals = {(*which, share): 0.0 for which, share in product(planners, uniform_shares)}
    steps = next(iter(planners.values())).model_steps(world)
    for chunk in planner(prior, num_plans).chunks(state, steps):
        others = None if even is None else even.candidates(world, chunk, generator)[:2]
        for which, planning in planners.items():
            drawn = planning.candidates(world, chunk, generator)[:2]
            for share in uniform_shares:
                scores = _best_scores(planning, world, chunk, drawn, others, share, generator)
                totals[*which, share] += float(scores.double().sum())
    best = max(totals, key=lambda setting: totals[setting])
    means = {setting: total / len(state) for setting, total in totals.items()}
    return Tuned(planner(best[0], num_plans, *best[1:]), *best, means)


def _best_scores(
    planner: SamplingPlanner,
    world: World,
    state: Tensor,
    drawn: tuple[Tensor, Tensor],
    uniform: tuple[Tensor, Tensor] | None,
    share: float,
    generator: torch.Generator,
) -> Tensor:
    """The scores `[B]` of the best of some plans that were drawn and some uniform ones, each with their scores."""
    plans, estimates = drawn if uniform is None else (torch.cat(pair, 1) for pair in zip(drawn, uniform, strict=True))
    prefix, keys = None, None
    if world.stochastic:  # else plans with equal scores are as good
        keys = torch.rand(estimates.shape, generator=generator, device=estimates.device)
    if estimates.dim() == 3:  # any prefix may win
        if keys is not None:
            keys, prefix = keys.masked_fill(estimates < estimates.amax(-1, keepdim=True), -1).max(-1)
        estimates = estimates.amax(-1)
    best = choices(estimates, planner.num_plans, planner.num_plans, share, keys)
    if not world.stochastic:
        return estimates.gather(1, best)[:, 0]
    row = torch.arange(len(plans), device=plans.device)[:, None]
    scores, _ = mean_scores(planner, world, state, plans[row, best], planner.effort(world)[1], generator)
    return scores[:, 0] if prefix is None else scores[:, 0].gather(1, prefix.gather(1, best))[:, 0]


def choices(score: Tensor, drawn: int, num_plans: int, share: float, keys: Tensor | None = None) -> Tensor:
    """The best of each block of `num_plans` candidates, a share of which are uniform plans.

    Args:
        score: `[B, M + U]`: of M candidates of a prior, and of U uniform plans behind them.
        drawn: M.
        num_plans: P.
        share: of uniform plans among the P.
        keys: `[B, M + U]`, at least 0: of candidates with equal scores that with the greatest is taken; None: the
            first.

    Returns:
        The columns `[B, D]` of the best in each of the D blocks that there are enough candidates for.
    """
    uniform = uniform_plans(share, num_plans)
    sizes, numbers = (num_plans - uniform, uniform), (drawn, score.shape[1] - drawn)
    blocks = min(number // size for size, number in zip(sizes, numbers, strict=True) if size)
    parts = [
        first + torch.arange(blocks * size, device=score.device).view(blocks, size)
        for first, size in zip((0, drawn), sizes, strict=True)
    ]
    column = torch.cat(parts, 1)
    scores = score[:, column]
    if keys is not None:
        scores = keys[:, column].masked_fill(scores < scores.amax(-1, keepdim=True), -1)
    best = scores.argmax(-1)
    return column.expand(len(score), -1, -1).gather(2, best[..., None])[..., 0]


@torch.no_grad()
def search_weights(log_prob: Tensor, num_plans: int) -> Tensor:
    """How much each plan should count for a prior of which one of P samples is to be that plan.

    The loss -log(1 - (1 - p)^P) falls with log p by w = P p (1 - p)^(P - 1) / (1 - (1 - p)^P), as that of a plan of
    weight w does: 1 for plans that are hardly ever found, near 0 for those that P candidates contain anyway. With P = 1
    all weights are 1.

    Args:
        log_prob: `[N]`, of plans under a prior that did not learn from them, at most 0.
        num_plans: P.

    Returns:
        Weights from 0 to 1, float64 `[N]`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> search_weights(torch.tensor([-1.0, -8.0]), num_plans=16).shape
        torch.Size([2])
    """
    check_sizes(num_plans=num_plans)
    log_prob = torch.as_tensor(log_prob)
    if not bool((log_prob <= 0).all()):
        raise ValueError("`log_prob` must be logarithms of probabilities, at most 0")
    log_prob = log_prob.double()
    others = torch.special.xlog1py(torch.tensor(num_plans - 1.0), -log_prob.exp())
    # Where a plan is impossible, the limit.
    weight: Tensor = (log(num_plans) + log_prob + others - log_inclusion(log_prob, num_plans)).exp()
    return weight.masked_fill(log_prob == -inf, 1.0).clamp(0, 1)


def log_inclusion(log_prob: Tensor, num_plans: int) -> Tensor:
    """log(1 - (1 - q)^P), float64, of log q: that one of P samples is a plan of probability q, however small."""
    log_prob = log_prob.double().clamp(max=0)
    never = torch.special.xlog1py(torch.tensor(float(num_plans)), -log_prob.exp())
    return torch.where(log_prob < SMALLEST, log(num_plans) + log_prob, (-torch.expm1(never)).log())


def as_tried(temperatures: Sequence[float], uniform_shares: Sequence[float]) -> tuple[list[float], list[float]]:
    """The temperatures and shares to try, as lists; raises ValueError where there are none, or one is out of range."""
    temperatures, uniform_shares = as_list("temperatures", temperatures), as_list("uniform_shares", uniform_shares)
    for name, values in (("temperatures", temperatures), ("uniform_shares", uniform_shares)):
        if not values:
            raise ValueError(f"`{name}` must have at least one, got an empty list")
    for temperature in temperatures:
        check_temperature(temperature)
    for share in uniform_shares:
        check_share("uniform_share", share)
    return temperatures, uniform_shares
