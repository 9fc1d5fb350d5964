"""Scoring plans in a world with chance: means over rollouts in which all plans of a start meet the same chance."""

from collections.abc import Iterator
from math import ceil, log2

import torch
from torch import Tensor

from neuroprior._random import draw_seed
from neuroprior.planners import planner as limits
from neuroprior.planners.planner import Planner, random_top
from neuroprior.worlds.world import World


def check_rollouts(num_rollouts: int) -> None:
    """Raise ValueError unless `num_rollouts` is at least 1."""
    if num_rollouts < 1:
        raise ValueError(f"num_rollouts: at least 1 is expected, not {num_rollouts}")


def mean_scores(
    planner: Planner, world: World, state: Tensor, plans: Tensor, num_rollouts: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """The scores of plans in a world with chance, each the mean over `num_rollouts` rollouts.

    Args:
        planner: what is optimised, and whether any prefix may win.
        world: where; every action must exist everywhere.
        state: `[B, ...]`.
        plans: `[B, P, L]`.
        num_rollouts: R. The plans of a start share each of its R rollouts' chance, as far as `world.rollout` lets them.
        generator: draws that chance.

    Returns:
        Scores `[B, P]` (of prefixes, `[B, P, L]`) and, of the same shape and the state's own, where the first rollout
        ends.

    Raises:
        ValueError: some actions do not exist everywhere, so that chance could make a plan impossible.
    """
    if not world.all_legal:
        raise ValueError("world: with chance, every action must exist in every state (all_legal)")
    batch, num_plans, length = plans.shape
    at_once = max(limits.STEPS_AT_ONCE // (max(batch, 1) * num_rollouts * length), 1)
    repeated = state.repeat_interleave(num_rollouts, 0)
    seed = draw_seed(generator)
    scores, ends = [], []
    for at in range(0, num_plans, at_once):
        some = plans[:, at : at + at_once]
        many = some[:, None].expand(-1, num_rollouts, -1, -1).reshape(-1, *some.shape[1:])
        # The same seed each time: plans that are tried later meet the same chance, too.
        again = torch.Generator(generator.device).manual_seed(seed)
        rollout = world.rollout(repeated, many, again, planner.any_prefix)
        score, end = planner.scored(rollout)
        # In float64, and rounded at the end: plans that fare alike must tie, in whichever order they were added up.
        mean = score.view(batch, num_rollouts, *score.shape[1:]).mean(1, dtype=torch.float64)
        scores.append(mean.to(score.dtype))
        ends.append(end[::num_rollouts])
    return torch.cat(scores, 1), torch.cat(ends, 1)


def halved_scores(
    planner: Planner, world: World, state: Tensor, plans: Tensor, num_rollouts: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """The better ones of some plans by successive halving: the longer a plan stays, the more often it is tried.

    As many rollouts as `num_rollouts` for each plan are shared out equally over rounds. In each round all plans that
    are left are tried equally often, and the half with the lower means so far is left out (Karnin et al. 2013).

    Args, raises: see `mean_scores`.

    Returns:
        The plans `[B, K, L]` that were left in the last round, and their scores and ends.
    """
    total, tried, row = torch.zeros((), dtype=torch.float64), 0, torch.arange(len(plans), device=plans.device)[:, None]
    for kept, times in halving(plans.shape[1], num_rollouts):
        if kept < plans.shape[1]:
            worth = total.flatten(2).amax(2) if total.dim() > 2 else total
            best = random_top(worth, kept, generator)
            plans, total = plans[row, best], total[row, best]
        score, ends = mean_scores(planner, world, state, plans, times, generator)
        total, tried = total + times * score.double(), tried + times
    return plans, (total / tried).to(score.dtype), ends


def halving(num_plans: int, num_rollouts: int) -> Iterator[tuple[int, int]]:
    """How many plans are left in each round of halving, and how often each is tried in it."""
    rounds = max(min(ceil(log2(num_plans)), num_rollouts), 1)
    kept = num_plans
    for _ in range(rounds):
        yield kept, num_plans * num_rollouts // rounds // kept
        kept = -(-kept // 2)
