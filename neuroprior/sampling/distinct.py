"""Distinct plans from any prior: samples without replacement, and the most probable plans."""

from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.plans import is_per_step
from neuroprior.sampling.ancestral import Steppable, start_in_world
from neuroprior.sampling.beams import Beams, children, no_actions
from neuroprior.sampling.draws import after_end, check_temperature
from neuroprior.worlds.world import Rollout, World

MOST_PREFIXES = 2**22
"""That `most_probable` follows together."""

SLACK = 1e-9
"""Log-probabilities that differ by less count as the same: sums in another order differ by rounding."""


class Distinct(NamedTuple):
    """P different plans of each of B distributions.

    Attributes:
        plans: `[B, P, L]`, uint8 (int64 where there are more than 256 actions).
        log_prob: `[B, P]` float64: the logarithm of each plan's probability; -inf where there was no further plan: then
            the plan is not one of the distribution's.
        inclusion: `[B, P]` float64: the probability that a sample has this plan in it, given the threshold that the
            sample had; 0 where there was no further plan. The mean of any f(plan) is estimated without bias by the sum
            of f(plan) * exp(log_prob) / inclusion (Kool, van Hoof and Welling 2019, section 4.2).
    """

    plans: Tensor
    log_prob: Tensor
    inclusion: Tensor


@torch.no_grad()
def sample_distinct(
    prior: Steppable,
    num_plans: int,
    length: int,
    context: Tensor | None = None,
    *,
    num_sets: int | None = None,
    temperature: float = 1.0,
    generator: torch.Generator | None = None,
) -> Distinct:
    """Plans drawn without replacement: one after another, each from what the ones before have left.

    By stochastic beam search (Kool, van Hoof and Welling 2019, "Stochastic beams and where to find them"): beams grow
    step by step, and those are kept whose log-probabilities, with Gumbel noise, are highest. Of each distribution the
    first plan is a plain sample.

    Args:
        prior: any prior.
        num_plans: P.
        length: number of actions in a plan, L.
        context: one a distribution, `[B]` indices or `[B, C]` features, for a prior that sees one.
        num_sets: B, where there is no context; None: 1.
        temperature: divides the logits.
        generator: the source of randomness.

    Raises:
        ValueError: an argument is out of range, or there are not so many plans.
    """
    _check(prior, num_plans, length, temperature)
    logits, memory = _start(prior, context, num_sets)
    search = Beams(prior, logits, memory, temperature, generator_on(generator, prior.device))
    return _without_replacement(search, num_plans, length)


@torch.no_grad()
def sample_distinct_in_world(
    prior: Steppable,
    world: World,
    state: Tensor,
    num_plans: int,
    length: int,
    *,
    temperature: float = 1.0,
    generator: torch.Generator | None = None,
    keep_states: bool = False,
) -> tuple[Distinct, Rollout]:
    """The same for each of B starts, along with a world: see `sample_in_world`.

    Beginnings that plans have in common are tried once. Where not every action exists, a start may have fewer than P
    plans; those that are no plans are tried as if every action existed.

    Args:
        prior: any prior over the world's actions.
        world: one without chance.
        state: starts `[B, ...]`.
        num_plans, length, temperature, generator: see `sample_distinct`.
        keep_states: also return the state after each step, in the rollout.

    Raises:
        ValueError: an argument is out of range, prior and world differ in their number of actions, or chance has a part
            in the world.
    """
    _check(prior, num_plans, length, temperature)
    search = _search_in_world(prior, world, state, temperature, generator)
    found = _without_replacement(search, num_plans, length)
    return found, search.rollout(state, keep_states)


@torch.no_grad()
def try_distinct(
    prior: Steppable,
    world: World,
    state: Tensor,
    num_plans: int,
    length: int,
    *,
    temperature: float = 1.0,
    generator: torch.Generator | None = None,
    keep_states: bool = False,
) -> tuple[Tensor, Tensor, Rollout]:
    """As `sample_distinct_in_world`, for planners: without inclusion probabilities, which take one plan more.

    Returns:
        Plans `[B, P, L]`, the logarithms of their probabilities `[B, P]` (-inf: it is no plan), and their rollout; P is
        smaller where there are not so many plans.
    """
    search = _search_in_world(prior, world, state, temperature, generator)
    search.grow(num_plans, length)
    return search.plans.view(*search.log_prob.shape, length), search.log_prob, search.rollout(state, keep_states)


def _search_in_world(
    prior: Steppable, world: World, state: Tensor, temperature: float, generator: torch.Generator | None
) -> Beams:
    if world.stochastic:
        raise ValueError("world: one without chance is expected: plans that begin alike are tried together")
    logits, memory = start_in_world(prior, world, state)
    return Beams(prior, logits, memory, temperature, generator_on(generator, prior.device), world, state)


@torch.no_grad()
def most_probable(
    prior: Steppable, num_plans: int, length: int, context: Tensor | None = None, *, temperature: float = 1.0
) -> tuple[Tensor, Tensor]:
    """The most probable plans, exactly, the most probable first.

    A beam search finds plans of which the last is at most as probable as the last one that is sought; then every
    beginning of a plan that is at least as probable as that is followed. A distribution that is nearly flat has very
    many of them.

    Args:
        prior, length, temperature: see `sample_distinct`.
        num_plans: P.
        context: one a distribution, as in `sample_distinct`; None: B is 1.

    Returns:
        Plans `[B, P, L]` and the logarithms of their probabilities `[B, P]`, float64.

    Raises:
        ValueError: an argument is out of range, there are not so many plans, or more than `MOST_PREFIXES` beginnings
            of all distributions together would have to be followed.
    """
    _check(prior, num_plans, length, temperature)
    logits, memory = _start(prior, context, None)
    batch = len(logits)
    search = Beams(prior, logits, memory, temperature, None)
    search.grow(num_plans, length)
    bound = search.log_prob[:, num_plans - 1] - SLACK
    log_prob = torch.zeros(batch, dtype=torch.float64, device=logits.device)
    owner, plans = torch.arange(batch, device=logits.device), no_actions(prior, batch)
    for t in range(length):
        child = children(log_prob[:, None], logits, temperature)
        row, action = ((child >= bound[owner, None]) & (child > -torch.inf)).nonzero(as_tuple=True)
        if len(row) > MOST_PREFIXES:
            raise ValueError(
                f"num_plans: more than {MOST_PREFIXES} beginnings of {t + 1} actions are as probable as the least"
                f" probable of the {num_plans} plans that are sought; ask for fewer, or for fewer contexts at a time"
            )
        log_prob, owner = child[row, action], owner[row]
        plans = torch.cat([plans[row], action[:, None].to(plans.dtype)], 1)
        if t + 1 < length:
            logits, memory = prior.step(action, memory.index_select(0, row))
            logits = after_end(logits, action, prior.end)
    # By distribution, the most probable first.
    order = log_prob.argsort(descending=True, stable=True)
    order = order[owner[order].argsort(stable=True)]
    counts = owner.bincount(minlength=batch)
    if len(counts) and int(counts.min()) < num_plans:
        raise ValueError(f"num_plans: only {int(counts.min())} plans have a probability above 0, not {num_plans}")
    first = order[((counts.cumsum(0) - counts)[:, None] + torch.arange(num_plans, device=counts.device)).flatten()]
    return plans[first].view(batch, num_plans, length), log_prob[first].view(batch, num_plans)


def _without_replacement(search: Beams, num_plans: int, length: int) -> Distinct:
    """Grow beams of `length` actions; one more than is asked for, whose height is the threshold."""
    search.grow(num_plans + 1, length)
    # Where there are no more plans than are asked for, all of them are in every sample.
    threshold = search.height[:, num_plans:] if search.height.shape[1] > num_plans else -torch.inf
    row = torch.arange(search.height.numel(), device=search.height.device).view_as(search.height)
    search.keep(row[:, :num_plans].flatten())
    search.log_prob = search.log_prob[:, :num_plans]
    there = search.log_prob > -torch.inf
    inclusion = torch.where(there, -torch.expm1(-torch.exp(search.log_prob - threshold)), 0.0)
    return Distinct(search.plans.view(search.batch, num_plans, length), search.log_prob, inclusion)


def _start(prior: Steppable, context: Tensor | None, num_sets: int | None) -> tuple[Tensor, Tensor]:
    if context is None:
        number = 1 if num_sets is None else num_sets
        check_sizes(num_sets=number)
        prior.check_context_of(None)
        return prior.start(number)
    if num_sets is not None:
        raise ValueError("num_sets: there is one for each context; leave it out")
    context = torch.as_tensor(context, device=prior.device)
    if is_per_step(context):
        raise ValueError(f"context: one a plan is expected, [B] or [B, C], not {list(context.shape)}")
    prior.check_context_of(context, len(context))
    return prior.start(len(context), context)


def _check(prior: Steppable, num_plans: int, length: int, temperature: float) -> None:
    check_sizes(num_plans=num_plans, length=length)
    check_temperature(temperature)
    if prior.num_actions**length < num_plans:
        raise ValueError(
            f"num_plans: there are only {prior.num_actions**length} plans of {length} actions, not {num_plans}"
        )
