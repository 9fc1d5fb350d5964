"""Scores of plans by rollouts: in stochastic worlds means, with common random numbers for all plans of a start."""

from collections.abc import Iterator
from math import ceil, log2

import torch
from torch import Tensor

from neuroprior._random import draw_seed
from neuroprior.planners.planner import Decision, Planner, random_top
from neuroprior.worlds.world import World


def mean_scores(
    planner: Planner, world: World, state: Tensor, plans: Tensor, num_rollouts: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """The scores of plans: in a stochastic world the mean over `num_rollouts` rollouts, else that of the only one.

    Args:
        planner: has the objective, and says whether any prefix may win.
        world: where it is stochastic, all its actions must be legal everywhere.
        state: `[B, ...]`.
        plans: `[B, P, L]`.
        num_rollouts: R. In each of the R rollouts the plans of a start have common random numbers, as far as
            `world.rollout` gives them.
        generator: draws the steps of the world.

    Returns:
        Scores `[B, P]` (of prefixes, `[B, P, L]`), and the final states of the first rollout: the same shape, and the
        state's own dimensions.

    Raises:
        ValueError: the world is stochastic and not all actions are legal everywhere, so that some outcomes could make a
            plan impossible.

    Example:
        >>> world, plans = gridworld(5, 5, seed=0), torch.tensor([[[0, 1], [2, 3]]])
        >>> scores, _ = mean_scores(
        ...     ExhaustivePlanner(2), world, torch.tensor([12]), plans, 3, torch.Generator().manual_seed(0)
        ... )
        >>> scores.shape
        torch.Size([1, 2])
    """
    planner = planner.for_world(world)
    if not world.stochastic:
        return planner.score_rollout(world.rollout(state, plans, generator, planner.any_prefix))
    if not world.all_legal:
        raise ValueError("world: where it is stochastic, every action must be legal in every state (all_legal)")
    batch, num_plans, length = plans.shape
    at_once = max(planner.steps_at_once // (max(batch, 1) * num_rollouts * length), 1)
    repeated = state.repeat_interleave(num_rollouts, 0)
    seed = draw_seed(generator)
    scores, ends = [], []
    for at in range(0, num_plans, at_once):
        chunk = plans[:, at : at + at_once]
        many = chunk[:, None].expand(-1, num_rollouts, -1, -1).reshape(-1, *chunk.shape[1:])
        # The same seed each time, so that all plans get the same random numbers.
        again = torch.Generator(generator.device).manual_seed(seed)
        score, end = planner.score_rollout(world.rollout(repeated, many, again, planner.any_prefix))
        # In float64, and rounded at the end: plans that do equally well must tie, whatever the order of the sum.
        mean = score.view(batch, num_rollouts, *score.shape[1:]).mean(1, dtype=torch.float64)
        scores.append(mean.to(score.dtype))
        ends.append(end[::num_rollouts])
    return torch.cat(scores, 1), torch.cat(ends, 1)


def score_anew(
    planner: Planner, world: World, state: Tensor, decision: Decision, num_rollouts: int, generator: torch.Generator
) -> Decision:
    """The decision with the mean score of new rollouts of its plan: that by which it was chosen is too high.

    The best of many noisy means is biased upwards (the winner's curse).

    Args:
        planner, world, state, num_rollouts, generator: see `mean_scores`.
        decision: for these states.
    """
    score, ends = mean_scores(planner, world, state, decision.plan[:, None], num_rollouts, generator)
    score, ends = score[:, 0], ends[:, 0]
    if decision.lengths is not None:
        row = torch.arange(len(score), device=score.device)
        score, ends = score[row, decision.lengths - 1], ends[row, decision.lengths - 1]
    return decision._replace(score=score, final_state=ends)


def halved_scores(
    planner: Planner, world: World, state: Tensor, plans: Tensor, num_rollouts: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Scores by successive halving: the better a plan, the more rollouts it gets.

    The budget is `num_rollouts` rollouts for each plan, shared equally among rounds. In each round all remaining plans
    get equally many rollouts, and the half with the lower means so far is dropped (Karnin et al. 2013).

    Args, raises: see `mean_scores`.

    Returns:
        The plans `[B, K, L]` of the last round, their scores and final states.
    """
    total, taken, row = torch.zeros((), dtype=torch.float64), 0, torch.arange(len(plans), device=plans.device)[:, None]
    for kept, times in halving_rounds(plans.shape[1], num_rollouts):
        if kept < plans.shape[1]:
            best = random_top(total.flatten(2).amax(2) if total.dim() > 2 else total, kept, generator)
            plans, total = plans[row, best], total[row, best]
        score, ends = mean_scores(planner, world, state, plans, times, generator)
        total, taken = total + times * score.double(), taken + times
    return plans, (total / taken).to(score.dtype), ends


def halving_rounds(num_plans: int, num_rollouts: int) -> Iterator[tuple[int, int]]:
    """The number of plans in each round of halving, and of rollouts for each of them."""
    rounds = max(min(ceil(log2(num_plans)), num_rollouts), 1)
    kept = num_plans
    for _ in range(rounds):
        yield kept, num_plans * num_rollouts // rounds // kept
        kept = -(-kept // 2)
