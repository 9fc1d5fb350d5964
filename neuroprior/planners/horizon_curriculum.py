"""Growing the horizon: plan with a prior, learn from those plans, plan longer, learn again."""

from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import torch

from neuroprior.planners.collect import collect
from neuroprior.planners.sampling import SamplingPlanner
from neuroprior.plans import Plans
from neuroprior.priors.prior import Prior
from neuroprior.worlds.world import World

TRIED = 128
"""Starts at which temperatures are tried before a round."""


class HorizonRound(NamedTuple):
    """A round of `extend_horizon`.

    Attributes:
        length: number of actions in the plans that the prior has learned from last.
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
    objective: Literal["terminal", "return"] = "terminal",
    discount: float = 1.0,
    any_prefix: bool = False,
    min_score: float | None = None,
    num_rollouts: int = 1,
    temperatures: Sequence[float] = (1.0,),
    generator: torch.Generator | None = None,
    **settings: Any,
) -> Iterator[HorizonRound]:
    """Let a prior learn from short plans, plan longer with it, learn from those plans, and so on.

    All plans of a length are soon too many to be tried, so that only short plans can be had by trying them all. A prior
    that has learned from them proposes longer ones, the best of which are the next to learn from. Priors that count
    learn anew from the plans of each round alone; neural ones go on from the weights that they have.

    Args:
        prior: learns in place, by its `fit`, which takes a neural prior on from the weights that it has.
        plans: what it learns from first, such as an `ExhaustivePlanner` collects. The prior goes on seeing what
            these plans have as context: what is seen at the start, before each action, or nothing.
        world: where longer plans are looked for.
        lengths: numbers of actions of the further rounds, one after another.
        num_starts: from so many starts plans are looked for in each round.
        num_plans: candidate plans for each.
        objective, discount, any_prefix: see `Planner`.
        min_score: plans that scored no more than this are not learned from, see `collect`.
        num_rollouts: of each candidate where chance decides, see `SamplingPlanner`.
        temperatures: at which candidates may be drawn; before each round that one is chosen with which most is scored
            from a few starts. A prior that has learned from few plans is often so sure of itself that it finds no
            longer ones unless it is sampled at more than 1.
        generator: draws the starts and candidates, and is passed on to a prior's `fit` where there are settings.
        settings: passed on to the prior's `fit`, such as `max_steps=300` for neural priors.

    Yields:
        After the first plans, and after each length: what was learned from. The prior is as it is after that round.

    Raises:
        ValueError: an argument is out of range, or no plan of a round scored more than `min_score`.
    """
    if any(length < 1 for length in lengths):
        raise ValueError(f"lengths: at least 1 is expected each, not {list(lengths)}")
    if not temperatures:
        raise ValueError("temperatures: at least one is expected")
    if settings:
        settings |= {"generator": generator}
    how: dict[str, Any] = {"objective": objective, "discount": discount, "any_prefix": any_prefix}
    how |= {"num_rollouts": num_rollouts}
    prior.fit(plans, **settings)
    yield HorizonRound(plans.max_length, plans)
    for length in lengths:
        planners = [SamplingPlanner(prior, length, num_plans, temperature=heat, **how) for heat in temperatures]
        planner = _best(planners, world, min(num_starts, TRIED), generator)
        plans = collect(planner, world, num_starts, context=prior.context_per, min_score=min_score, generator=generator)
        prior.fit(plans, **settings)
        yield HorizonRound(length, plans)


def _best(
    planners: Sequence[SamplingPlanner], world: World, number: int, generator: torch.Generator | None
) -> SamplingPlanner:
    """The planner that scores most from so many starts, the same for all; the first of equals."""
    if len(planners) == 1:
        return planners[0]
    state = world.reset(number, generator)
    scores = [float(planner.plan(world, state, generator).score.double().mean()) for planner in planners]
    return planners[scores.index(max(scores))]
