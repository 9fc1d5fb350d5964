"""Distinct plans from any prior: samples without replacement, and the most probable plans, by beam search."""

from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_memory, check_sizes
from neuroprior._random import generator_on, gumbel
from neuroprior.plans import action_dtype, is_per_step
from neuroprior.sampling.draws import check_temperature
from neuroprior.sampling.stepping import Steppable, Stepper, legal_logits
from neuroprior.worlds.world import Rollout, World, join_states

SLACK = 1e-9
"""Log-probabilities that differ by less count as equal: sums in another order differ by rounding."""


class Distinct(NamedTuple):
    """P different plans from each of B distributions.

    Attributes:
        plans: `[B, P, L]`, uint8 (int64 for more than 256 actions).
        log_prob: `[B, P]` float64, nats: the log-probability of each plan; -inf where there are fewer than P plans, and
            `plans` holds no plan there.
        inclusion: `[B, P]` float64: the probability that a sample contains this plan, given the sample's threshold; 0
            where there is no plan. An unbiased estimate of the mean of any f(plan) is the sum of f(plan) *
            exp(log_prob) / inclusion (Kool, van Hoof and Welling 2019, section 4.2).
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
    """Plans drawn without replacement.

    By stochastic beam search (Kool, van Hoof and Welling 2019, "Stochastic beams and where to find them"): a beam
    search keeps the prefixes whose log-probabilities, perturbed by Gumbel noise, are highest. The first plan of each
    set is a sample from the prior.

    Args:
        prior: any prior.
        num_plans: number of plans in a set, P.
        length: number of actions in a plan, L.
        context: one per set, `[B]` indices or `[B, C]` features, for a prior that takes a context.
        num_sets: number of sets, B, where there is no context; None: 1.
        temperature: divides the logits.
        generator: the source of randomness.

    Raises:
        ValueError: an argument is out of range, or there are fewer than `num_plans` plans.

    Example:
        >>> found = sample_distinct(UniformPrior(2), num_plans=8, length=3, generator=torch.Generator().manual_seed(0))
        >>> len(found.plans.view(-1, 3).unique(dim=0))
        8
    """
    _check(prior, num_plans, length, temperature)
    beams = _start(prior, context, num_sets, temperature)
    beams.add_noise(generator_on(generator, beams.logits.device))
    return _without_replacement(beams, num_plans, length)


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
    """As `sample_distinct`, a set of plans for each of B starts, stepping the world along (see `sample_in_world`).

    Prefixes that plans share are stepped once. Where not every action is legal, a start may have fewer than P plans;
    the others (`log_prob` -inf) are stepped as if every action were legal.

    Args:
        prior: any prior over the world's actions.
        world: a deterministic world.
        state: starts `[B, ...]`.
        num_plans, length, temperature, generator: see `sample_distinct`.
        keep_states: also return the state after each step, in the rollout.

    Raises:
        ValueError: an argument is out of range, prior and world differ in their number of actions, or the world is
            stochastic.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> found, rollout = sample_distinct_in_world(
        ...     UniformPrior(4), world, torch.tensor([0, 12]), num_plans=6, length=3
        ... )
        >>> found.plans.shape, rollout.rewards.shape
        (torch.Size([2, 6, 3]), torch.Size([2, 6, 3]))
    """
    _check(prior, num_plans, length, temperature)
    beams = start_beams_in_world(prior, world, state, temperature, generator)
    found = _without_replacement(beams, num_plans, length)
    return found, beams.rollout(state, keep_states)


@torch.no_grad()
def most_probable(
    prior: Steppable,
    num_plans: int,
    length: int,
    context: Tensor | None = None,
    *,
    temperature: float = 1.0,
    max_prefixes: int = 2**22,
) -> tuple[Tensor, Tensor]:
    """The most probable plans, exactly, the most probable first.

    A beam search gives a lower bound on the probability of the P-th plan; then all prefixes at least as probable as
    this bound are extended. A nearly uniform distribution has very many of them.

    Args:
        prior, length, temperature: see `sample_distinct`.
        num_plans: P.
        context: one per distribution, as in `sample_distinct`; None: B is 1.
        max_prefixes: the most prefixes, of all distributions together, that may be extended; bounds memory.

    Returns:
        Plans `[B, P, L]`, uint8 (int64 for more than 256 actions), and their log-probabilities `[B, P]`, float64, nats.

    Raises:
        ValueError: an argument is out of range, there are fewer than `num_plans` plans, or more than `max_prefixes`
            prefixes would have to be extended.

    Example:
        >>> prior = MarkovPrior(3, order=1).fit(torch.tensor([[0, 1, 2, 0, 1, 2]]))
        >>> plans, log_prob = most_probable(prior, num_plans=2, length=3)
        >>> plans.tolist()
        [[[0, 1, 2], [0, 0, 1]]]
    """
    _check(prior, num_plans, length, temperature)
    beams = _start(prior, context, None, temperature)
    batch, stepper, logits, hidden = beams.batch, beams.stepper, beams.logits, beams.hidden
    beams.extend(num_plans, length)
    bound = beams.log_prob[:, num_plans - 1] - SLACK
    log_prob = torch.zeros(batch, dtype=torch.float64, device=logits.device)
    owner, plans = torch.arange(batch, device=logits.device), beams.plans.new_empty(batch, 0)
    for t in range(length):
        child = child_log_probs(log_prob[:, None], logits, temperature)
        row, action = ((child >= bound[owner, None]) & (child > -torch.inf)).nonzero(as_tuple=True)
        if len(row) > max_prefixes:
            raise ValueError(
                f"num_plans: more than max_prefixes = {max_prefixes} prefixes of {t + 1} actions are as probable as the"
                f" last of the {num_plans} plans; ask for fewer plans, or for fewer contexts at a time"
            )
        log_prob, owner = child[row, action], owner[row]
        plans = torch.cat([plans[row], action[:, None].to(plans.dtype)], 1)
        if t + 1 < length:
            logits, hidden = stepper.step(action, hidden.index_select(0, row))
    # By distribution, the most probable first.
    order = log_prob.argsort(descending=True, stable=True)
    order = order[owner[order].argsort(stable=True)]
    counts = owner.bincount(minlength=batch)
    if len(counts) and int(counts.min()) < num_plans:
        raise ValueError(f"num_plans: only {int(counts.min())} plans have a probability above 0, not {num_plans}")
    first = order[((counts.cumsum(0) - counts)[:, None] + torch.arange(num_plans, device=counts.device)).flatten()]
    return plans[first].view(batch, num_plans, length), log_prob[first].view(batch, num_plans)


class Beams:
    """A beam search over the plans of B distributions, with K beams each.

    Args:
        stepper: the prior.
        logits, hidden: as its `start` returned them, for B rows.
        temperature: divides the logits.
        world, state: the world that is stepped along, and starts `[B, ...]` in it; None: no world.

    Attributes:
        plans: `[B * K, t]`.
        log_prob: `[B, K]` float64; -inf: there is no such plan.
        height: `[B, K]` float64: the beams of the greatest height are kept; the log-probability, after `add_noise`
            perturbed.
    """

    def __init__(
        self,
        stepper: Stepper,
        logits: Tensor,
        hidden: Tensor,
        temperature: float,
        world: World | None = None,
        state: Tensor | None = None,
    ) -> None:
        self.stepper, self.logits, self.hidden, self.temperature = stepper, logits, hidden, temperature
        self.generator: torch.Generator | None = None
        self.world, self.now, self.batch = world, state, len(logits)
        self.plans = torch.empty(self.batch, 0, dtype=action_dtype(stepper.num_actions), device=logits.device)
        self.steps: list[list[Tensor]] = [[], []]  # rewards and states of each step
        self.height = self.log_prob = torch.zeros(self.batch, 1, dtype=torch.float64, device=logits.device)

    def add_noise(self, generator: torch.Generator) -> None:
        """Before the first step: perturb by Gumbel noise, so that the beams are samples without replacement."""
        self.generator, self.height = generator, gumbel(self.log_prob, generator)

    def extend(self, most: int, length: int) -> None:
        """Extend to at most `most` beams of `length` actions."""
        for t in range(length):
            self._extend(most, last=t + 1 == length)

    def rollout(self, start: Tensor, keep_states: bool) -> Rollout:
        """What the world did on the plans."""
        assert self.now is not None
        shape, (rewards, states) = self.log_prob.shape, self.steps
        kept = join_states(states, start, (*shape, *start.shape[1:])) if keep_states else None
        stacked = torch.stack(rewards, 1).view(*shape, len(rewards))
        return Rollout(self.now.view(*shape, *start.shape[1:]), stacked, kept)

    def keep(self, row: Tensor) -> None:
        """Keep the beams `row`."""
        self.plans, self.hidden = self.plans.index_select(0, row), self.hidden.index_select(0, row)
        if self.now is not None:
            self.now = self.now.index_select(0, row)
        self.steps = [[values.index_select(0, row) for values in column] for column in self.steps]

    def _extend(self, most: int, last: bool) -> None:
        """One more action: of all children of the beams, those of the greatest height are the new beams."""
        logits, actions = self.logits, self.stepper.num_actions
        if self.world is not None and self.now is not None:
            logits = legal_logits(self.world, self.now, logits)
        child = child_log_probs(self.log_prob.view(-1, 1), logits, self.temperature)
        height = child if self.generator is None else self._child_heights(child, self.generator)
        beams = self.log_prob.shape[1]
        self.height, index = height.view(self.batch, beams * actions).topk(min(most, beams * actions))
        self.log_prob = child.view(self.batch, beams * actions).gather(1, index)
        row, action = parents(index, beams, actions)
        self.keep(row)
        self.plans = torch.cat([self.plans, action[:, None].to(self.plans.dtype)], 1)
        if self.world is None or self.now is None:
            if not last:
                self.logits, self.hidden = self.stepper.step(action, self.hidden)
            return
        self.now, reward = self.world.step(self.now, action, None)
        for column, values in zip(self.steps, (reward, self.now), strict=True):
            column.append(values)
        if not last:
            self.logits, self.hidden = self.stepper.step_in(self.world, action, self.hidden, self.now)

    def _child_heights(self, child: Tensor, generator: torch.Generator) -> Tensor:
        """Gumbel variables located at `child [M, A]`, given that the maximum of each row is the height of its parent.

        Kool, van Hoof and Welling 2019, appendix B.3.
        """
        free = gumbel(child, generator)
        parent = self.height.view(-1, 1)
        below = parent - free + torch.log1p(-torch.exp(free - free.amax(-1, keepdim=True)))
        height = parent - below.clamp(min=0) - torch.log1p(torch.exp(-below.abs()))
        # Impossible children stay so; where the parent is impossible, the line above gives NaN.
        return torch.where(child > -torch.inf, height, -torch.inf)


def start_beams_in_world(
    prior: Steppable, world: World, state: Tensor, temperature: float, generator: torch.Generator | None
) -> Beams:
    """Beams that step a world along, with Gumbel noise; ValueError where the world is stochastic."""
    if world.stochastic:
        raise ValueError("world: a deterministic one is expected: the plans that share a prefix share its steps")
    stepper = Stepper(prior)
    beams = Beams(stepper, *stepper.start_in(world, state), temperature, world, state)
    beams.add_noise(generator_on(generator, beams.logits.device))
    return beams


def child_log_probs(log_prob: Tensor, logits: Tensor, temperature: float) -> Tensor:
    """The log-probabilities `[M, A]` of plans of `log_prob [M, 1]` after one more action, by its `logits [M, A]`."""
    if (logits.isnan() & (log_prob > -torch.inf)).any():
        raise ValueError("prior: its logits are NaN")
    child = log_prob + (logits.double() / temperature).log_softmax(-1)
    # After an impossible prefix a prior may give NaN.
    return torch.where(log_prob > -torch.inf, child, -torch.inf)


def parents(index: Tensor, beams: int, actions: int) -> tuple[Tensor, Tensor]:
    """The parents of children that were picked by `index [B, K]` from B rows of `beams * actions` children.

    Returns:
        The rows `[B * K]` of the parents among all B * `beams`, and the actions `[B * K]` that lead to the children.
    """
    first = torch.arange(len(index), device=index.device)[:, None] * beams
    return (first + index.div(actions, rounding_mode="floor")).flatten(), (index % actions).flatten()


def _without_replacement(beams: Beams, num_plans: int, length: int) -> Distinct:
    """Search for one more plan than is asked for; its height is the threshold."""
    beams.extend(num_plans + 1, length)
    # Where there are no more plans than are asked for, every sample contains all of them.
    threshold = beams.height[:, num_plans:] if beams.height.shape[1] > num_plans else -torch.inf
    row = torch.arange(beams.height.numel(), device=beams.height.device).view_as(beams.height)
    beams.keep(row[:, :num_plans].flatten())
    beams.log_prob = beams.log_prob[:, :num_plans]
    possible = beams.log_prob > -torch.inf
    inclusion = torch.where(possible, -torch.expm1(-torch.exp(beams.log_prob - threshold)), 0.0)
    return Distinct(beams.plans.view(beams.batch, num_plans, length), beams.log_prob, inclusion)


def _start(prior: Steppable, context: Tensor | None, num_sets: int | None, temperature: float) -> Beams:
    stepper = Stepper(prior)
    if context is None:
        number = 1 if num_sets is None else num_sets
        check_sizes(num_sets=number)
        check_memory(8 * number, num_sets=number)
        stepper.check_context(None)
        return Beams(stepper, *stepper.start(number), temperature)
    if num_sets is not None:
        raise ValueError("num_sets: there is one for each context; leave it out")
    context = torch.as_tensor(context, device=stepper.device)
    if is_per_step(context):
        raise ValueError(f"context: one per set is expected, [B] or [B, C], not {list(context.shape)}")
    stepper.check_context(context, len(context))
    return Beams(stepper, *stepper.start(len(context), context), temperature)


def _check(prior: Steppable, num_plans: int, length: int, temperature: float) -> None:
    check_sizes(num_plans=num_plans, length=length)
    check_memory(num_plans * length, num_plans=num_plans, length=length)
    check_temperature(temperature)
    if prior.num_actions**length < num_plans:
        raise ValueError(
            f"num_plans: there are only {prior.num_actions**length} plans of {length} actions, not {num_plans}"
        )
