"""Warm starts: the rest of the last plan is a candidate when an agent plans anew."""

import torch
from torch import Tensor

from neuroprior._random import generator_on
from neuroprior.planners.chance import mean_scores
from neuroprior.planners.planner import Decision, Planner, decide, random_best
from neuroprior.sampling.ancestral import Steppable, advance, check_in_world, start_in_world
from neuroprior.sampling.draws import Draw
from neuroprior.worlds.world import Rollout, World, join_states


@torch.no_grad()
def continued(
    prior: Steppable, world: World, state: Tensor, rest: Tensor, left: Tensor, length: int, generator: torch.Generator
) -> tuple[Tensor, Rollout]:
    """Plans that begin with the rest of others and go on as a prior would.

    Args:
        prior: what goes on; it reads the rest first, as the beginning of a plan.
        world: where.
        state: `[B, ...]`.
        rest: `[B, R]`.
        left: `[B]`: how many actions of each are to be taken, at most R. One that does not exist where it would come is
            drawn from the prior instead.
        length: L.
        generator: draws actions, and what is random in the world.

    Returns:
        Plans `[B, 1, L]` and what came of them.

    Raises:
        ValueError: prior, world and states do not fit one another.
    """
    check_in_world(prior, world, state)
    logits, memory = start_in_world(prior, world, state)
    draw, now = Draw(prior.num_actions, 1.0, generator), state
    columns: tuple[list[Tensor], ...] = ([], [], [])  # actions, rewards and states
    for t in range(length):
        legal = None if world.all_legal else world.legal_actions(now)
        if legal is not None:
            logits = logits.masked_fill(~legal, -torch.inf)
        action = draw.actions(logits, draw.uniform((len(logits),), logits))
        if t < rest.shape[1]:
            due = rest[:, t].long()
            keep = t < left
            if legal is not None:
                keep = keep & legal.gather(1, due[:, None])[:, 0]
            action = torch.where(keep, due, action)
        now, reward = world.step(now, action, generator)
        for column, what in zip(columns, (action.to(draw.dtype), reward, now), strict=True):
            column.append(what)
        if t + 1 < length:
            logits, memory = advance(prior, action, memory, world.observe(now) if prior.context_per == "step" else None)
    actions, rewards = (torch.stack(column, 1)[:, None] for column in columns[:2])
    return actions, Rollout(now[:, None], rewards, join_states(columns[2], state, (len(state), 1, *state.shape[1:])))


def with_rest(
    planner: Planner,
    prior: Steppable,
    world: World,
    state: Tensor,
    decision: Decision,
    rest: Tensor,
    left: Tensor,
    num_rollouts: int,
    generator: torch.Generator | None = None,
) -> Decision:
    """What was decided, or the rest of the last plan, whichever scores more; of these two, if equal, a random one.

    The rest stands against the best of the planner's plans, not against each of them: where all are equally good, an
    agent keeps to its course every other time, however many plans there are. In a world with chance both are tried
    anew, meeting the same chance: the score of a winner among many flatters it.

    Args:
        planner: whose decision it was.
        prior, world, state, rest, left: see `continued`.
        decision: for these states.
        num_rollouts: of each in a world with chance; without it, the rest alone is tried, once.
        generator: draws how the rest goes on, what is random in the world, and the winner among equals.

    Returns:
        The better decision; its model steps are all that were taken.
    """
    generator = generator_on(generator, state.device)
    length = decision.plan.shape[1]
    plans, rollout = continued(prior, world, state, rest, left, length, generator)
    steps = decision.model_steps + length
    if world.stochastic:
        both = torch.cat([decision.plan[:, None].to(plans.dtype), plans], 1)
        score, ends = mean_scores(planner, world, state, both, num_rollouts, generator)
        allowed = torch.ones_like(score, dtype=torch.bool)
        if decision.lengths is not None:  # beyond them there are no actions
            allowed[:, 0] = torch.arange(length, device=state.device) < decision.lengths[:, None]
        return decide(both, score, ends, steps + 2 * num_rollouts * length, generator, allowed)
    score, ends = planner.scored(rollout if planner.any_prefix else rollout._replace(states=None))
    other = decide(plans, score, ends, steps, generator)
    return _better(decision, other, generator)._replace(model_steps=steps)


def _better(first: Decision, second: Decision, generator: torch.Generator) -> Decision:
    """Of two decisions for the same states, for each that which scores more; of equals a random one."""
    takes = random_best(torch.stack([first.score, second.score.to(first.score)], 1), generator) == 1
    parts = []
    for one, two in zip(first[:3], second[:3], strict=True):
        parts.append(torch.where(takes.view(-1, *[1] * (one.dim() - 1)), two.to(one.dtype), one))
    lengths = None
    if first.lengths is not None and second.lengths is not None:
        lengths = torch.where(takes, second.lengths, first.lengths)
    return Decision(parts[0], parts[1], parts[2], first.model_steps, lengths)
