"""Warm starts: when an agent replans, the rest of its last plan is a candidate."""

import torch
from torch import Tensor

from neuroprior._random import generator_on
from neuroprior.planners.planner import Decision, Planner, decide, random_best
from neuroprior.planners.rollouts import mean_scores
from neuroprior.sampling.draws import Draw
from neuroprior.sampling.stepping import Steppable, Stepper, legal_logits
from neuroprior.worlds.world import Rollout, World, allowed_actions, join_states, step_alive


@torch.no_grad()
def continue_plans(
    prior: Steppable, world: World, state: Tensor, rest: Tensor, left: Tensor, length: int, generator: torch.Generator
) -> tuple[Tensor, Rollout]:
    """Plans that begin with given actions and go on with actions drawn from a prior.

    Args:
        prior: draws the further actions; the given ones are the beginning of its plan.
        world: the world.
        state: `[B, ...]`.
        rest: `[B, R]`: actions.
        left: `[B]`: how many of these are to be taken, at most R. A prior's action stands in for one that is not legal.
        length: L.
        generator: draws actions, and the steps of a stochastic world.

    Returns:
        Plans `[B, 1, L]` and their rollout.

    Raises:
        ValueError: prior, world and states do not fit one another.
    """
    stepper = Stepper(prior)
    logits, hidden = stepper.start_in(world, state)
    draw, now = Draw(prior.num_actions, 1.0, generator), state
    columns: tuple[list[Tensor], ...] = ([], [], [])  # actions, rewards and states of each step
    for t in range(length):
        logits = legal_logits(world, now, logits)
        action = draw.actions(logits)
        if t < rest.shape[1]:
            planned = rest[:, t].long()
            may = (t < left) & allowed_actions(world, now).gather(1, planned[:, None])[:, 0]
            action = torch.where(may, planned, action)
        now, reward = step_alive(world, now, action, generator)
        for column, values in zip(columns, (action.to(draw.dtype), reward, now), strict=True):
            column.append(values)
        if t + 1 < length:
            logits, hidden = stepper.step_in(world, action, hidden, now)
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
    """A decision, or the rest of the last plan, whichever scores more; if they are equal, a random one of the two.

    The rest competes with the best of the planner's plans, not with each of them: where all are equally good, an agent
    keeps to its last plan every other time, however many plans there are. In a stochastic world both are scored by new
    rollouts with common random numbers, because the score of the best of many plans is biased upwards. Where the
    planner's plans end by themselves, as those of a best-first search do, its decision stands.

    Args:
        planner: the planner that decided.
        prior, world, state, rest, left: see `continue_plans`.
        decision: for these states.
        num_rollouts: of each of the two in a stochastic world; in a deterministic one, the rest is tried once.
        generator: draws how the rest goes on, the steps of a stochastic world, and the winner among equals.

    Returns:
        The better decision; its model steps are those of both.
    """
    if decision.lengths is not None and not planner.any_prefix:
        return decision
    planner, generator = planner.for_world(world), generator_on(generator, state.device)
    length = decision.plan.shape[1]
    plans, rollout = continue_plans(prior, world, state, rest, left, length, generator)
    steps = decision.model_steps + length
    if world.stochastic:
        both = torch.cat([decision.plan[:, None].to(plans.dtype), plans], 1)
        score, ends = mean_scores(planner, world, state, both, num_rollouts, generator)
        allowed = torch.ones_like(score, dtype=torch.bool)
        if decision.lengths is not None:  # there are no actions beyond them
            allowed[:, 0] = torch.arange(length, device=state.device) < decision.lengths[:, None]
        return decide(both, score, ends, steps + 2 * num_rollouts * length, generator, allowed)
    score, ends = planner.score_rollout(rollout if planner.any_prefix else rollout._replace(states=None))
    other = decide(plans, score, ends, steps, generator)
    return _better(decision, other, generator)._replace(model_steps=steps)


def _better(first: Decision, second: Decision, generator: torch.Generator) -> Decision:
    """The one of two decisions that scores more, for each start; of equals a random one."""
    takes = random_best(torch.stack([first.score, second.score.to(first.score)], 1), generator) == 1
    parts = []
    for one, two in zip(first[:3], second[:3], strict=True):
        parts.append(torch.where(takes.view(-1, *[1] * (one.dim() - 1)), two.to(one.dtype), one))
    lengths = None
    if first.lengths is not None and second.lengths is not None:
        lengths = torch.where(takes, second.lengths, first.lengths)
    return Decision(parts[0], parts[1], parts[2], first.model_steps, lengths)
