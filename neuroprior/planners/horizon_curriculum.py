"""The horizon curriculum: plan with a prior, fit it to those plans, plan longer, fit it again."""

from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import torch

from neuroprior._checks import as_list
from neuroprior.planners.execution import collect
from neuroprior.planners.planner import Objective
from neuroprior.planners.sampling import SamplingPlanner
from neuroprior.planners.tuning import as_tried, best_sampling
from neuroprior.plans import Plans
from neuroprior.plans.plans import check_are_plans
from neuroprior.priors.prior import Prior, check_is_prior
from neuroprior.worlds.world import World

STARTS_TRIED = 128
"""Starts from which temperatures and shares of uniform plans are tried before a round."""


class HorizonRound(NamedTuple):
    """A round of `extend_horizon`.

    Attributes:
        length: number of actions in the plans that the prior was fitted to.
        plans: these plans.
    """

    length: int
    plans: Plans


def extend_horizon(
    prior: Prior,
    plans: Plans,
    world: World,
    lengths: Sequence[int],
    *,
    num_starts: int,
    num_plans: int = 256,
    objective: Literal["terminal", "return"] | None = None,
    discount: float | None = None,
    any_prefix: bool = False,
    min_score: float | None = None,
    num_rollouts: int = 1,
    temperatures: Sequence[float] = (1.0,),
    uniform_shares: Sequence[float] = (0.0,),
    generator: torch.Generator | None = None,
    **settings: Any,
) -> Iterator[HorizonRound]:
    """Fit a prior to short plans, find longer plans with it, fit it to those, and so on (a horizon curriculum).

    The number of plans grows exponentially with their length, so that an exhaustive search finds short plans only. A
    prior that was fitted to them proposes longer ones, and the best of these are what it is fitted to next.
    Count-based priors are fitted anew to the plans of each round; neural ones continue from their present weights.

    Args:
        prior: fitted in place.
        plans: what it is fitted to first, such as an `ExhaustivePlanner` collects. Longer plans are collected with the
            same kind of context: none, of the start, or per step.
        world: the world in which longer plans are searched for.
        lengths: numbers of actions in the plans of the further rounds.
        num_starts: number of starts that are planned from in each round.
        num_plans: candidates for each start.
        objective, discount, any_prefix: see `Planner`.
        min_score: the prior is fitted to plans with a higher score only, see `collect`.
        num_rollouts: see `SamplingPlanner`.
        temperatures, uniform_shares: candidates are drawn at one of these temperatures, with one of these shares of
            uniform plans: before each round, what finds most from some starts (`best_sampling`, which also chooses
            who proposes, see `proposers`). A prior fitted to few plans is often overconfident, and finds longer plans
            only at a temperature above 1.
        generator: draws starts and candidates, and is passed on to the prior's `fit`.
        **settings: passed on to the prior's `fit`, such as `max_steps=300` for neural priors.

    Yields:
        After each fit, the plans that the prior was fitted to.

    Raises:
        ValueError: an argument is out of range, or no plan of a round scored more than `min_score`.

    Example:
        >>> world, generator = gridworld(5, 5, seed=0), torch.Generator().manual_seed(0)
        >>> short = collect(ExhaustivePlanner(depth=2), world, 50, generator=generator)
        >>> rounds = extend_horizon(
        ...     MarkovPrior(4, 1), short, world, [3, 4], num_starts=20, num_plans=16, generator=generator
        ... )
        >>> [one.plans.max_length for one in rounds]
        [2, 3, 4]
    """
    lengths = as_list("lengths", lengths)
    if not all(isinstance(length, int) and length >= 1 for length in lengths):
        raise ValueError(f"`lengths` must be integers of at least 1, got {lengths}")
    temperatures, uniform_shares = as_tried(temperatures, uniform_shares)
    check_is_prior(prior)
    check_are_plans(plans)
    goal: Objective = {"objective": objective, "discount": discount, "any_prefix": any_prefix}
    prior.fit(plans, generator=generator, **settings)
    yield HorizonRound(plans.max_length, plans)
    for length in lengths:
        if len(temperatures) * len(uniform_shares) == 1:
            planner = SamplingPlanner(
                prior,
                length,
                num_plans,
                num_rollouts=num_rollouts,
                temperature=temperatures[0],
                uniform_share=uniform_shares[0],
                **goal,
            )
        else:
            state = world.reset(min(num_starts, STARTS_TRIED), generator)
            planner = best_sampling(
                prior,
                world,
                state,
                length,
                num_plans,
                temperatures=temperatures,
                uniform_shares=uniform_shares,
                num_rollouts=num_rollouts,
                generator=generator,
                **goal,
            ).planner
        plans = collect(planner, world, num_starts, context=prior.context_per, min_score=min_score, generator=generator)
        prior.fit(plans, generator=generator, **settings)
        yield HorizonRound(length, plans)
