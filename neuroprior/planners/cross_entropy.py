"""The cross-entropy planner: candidates in rounds, each drawn from the prior refitted to the best plans so far."""

from typing import Unpack

import torch
from torch import Tensor

from neuroprior._checks import check_sizes, is_number
from neuroprior.planners.planner import Decision, Objective, decide, join_decisions, random_top
from neuroprior.planners.rollouts import mean_scores
from neuroprior.planners.sampling import SamplingPlanner
from neuroprior.priors.ensembles.packing import pack, unpack
from neuroprior.sampling.ancestral import sample
from neuroprior.sampling.stepping import Steppable, Stepper
from neuroprior.worlds.world import World

MOST_COUNTS = 2**22
"""Counts that are kept for one start."""


class CrossEntropyPlanner(SamplingPlanner):
    """Draws candidates, refits the prior to the best of them, and draws again, all within one decision.

    The cross-entropy method (Rubinstein 1999; de Boer et al. 2005, section 2), with a behavioural prior as the first
    distribution and as regulariser: where the elites, the best plans of a start so far, took action a n(a) times out of
    n, and the prior gives it probability p(a), the next candidate takes it with probability
    (n(a) + s p(a)) / (n + s). Actions are counted for each step of a plan, or after each sequence of the last actions.
    The decision is the best of the candidates of all rounds.

    Args:
        prior: the first distribution.
        length: number of actions in a plan, at least 1.
        num_plans: candidates for each start in all rounds together.
        rounds: number of rounds, of about as many candidates each; at most as many as there are candidates.
        elites: the share of the candidates so far that is refitted to, above 0 and at most 1; at least one plan.
        order: None: the actions of the elites are counted step by step; k >= 1: after each k actions, at any step.
        strength: s > 0: the prior counts as much as so many observations.
        num_rollouts: see `SamplingPlanner`.
        temperature: divides the prior's logits.
        **goal: objective, discount, value, any_prefix: see `Planner`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> CrossEntropyPlanner(UniformPrior(4), length=4, num_plans=64).plan(world, torch.tensor([0, 12])).plan.shape
        torch.Size([2, 4])
    """

    def __init__(
        self,
        prior: Steppable,
        length: int,
        num_plans: int,
        *,
        rounds: int = 4,
        elites: float = 0.05,
        order: int | None = None,
        strength: float = 4.0,
        num_rollouts: int = 1,
        temperature: float = 1.0,
        **goal: Unpack[Objective],
    ) -> None:
        super().__init__(
            prior, length, num_plans, num_rollouts=num_rollouts, halving=False, temperature=temperature, **goal
        )
        check_sizes(rounds=rounds, **({} if order is None else {"order": order}))
        if not is_number(elites) or not 0 < elites <= 1:
            raise ValueError(f"elites: a share above 0 and at most 1 is expected, not {elites!r}")
        if not is_number(strength) or not 0 < strength < float("inf"):
            raise ValueError(f"strength: a positive finite number is expected, not {strength!r}")
        self.rounds, self.elites, self.order, self.strength = min(rounds, num_plans), elites, order, strength

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        generator = self._check(world, state, generator)
        histories = self.length if self.order is None else (world.num_actions + 1) ** self.order
        if histories * world.num_actions > MOST_COUNTS:
            what = "length" if self.order is None else "order"
            raise ValueError(
                f"{what}: counts of {world.num_actions} actions in {histories:,} places need too much memory; give a"
                " smaller one"
            )
        counted = histories * world.num_actions
        chunks = [part for some in self.chunks(state, self.model_steps(world)) for part in self.chunks(some, counted)]
        return join_decisions((self._plan(world, some, histories, generator) for some in chunks), len(state))

    def _plan(self, world: World, state: Tensor, histories: int, generator: torch.Generator) -> Decision:
        counts = torch.zeros(len(state), histories, world.num_actions, device=state.device)
        found: list[tuple[Tensor, ...]] = []
        for k in range(self.rounds):
            refitted = RefittedPrior(self.prior, counts, self.order, self.strength, self.temperature)
            number = self.num_plans * (k + 1) // self.rounds - self.num_plans * k // self.rounds
            found.append(self._candidates_of(refitted, number, world, state, generator))
            plans, score, ends = (torch.cat(parts, 1) for parts in zip(*found, strict=True))
            counts = self._elite_counts(plans, score, counts, generator)
        return decide(plans, score, ends, self.model_steps(world), generator)

    def _candidates_of(
        self, prior: "RefittedPrior", number: int, world: World, state: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """So many candidates for each start, their scores and final states; see `SamplingPlanner.candidates`."""
        if prior.context_per is not None or not world.all_legal:
            sampler = SamplingPlanner(prior, self.length, number, num_rollouts=self.num_rollouts, **self.goal)
            return sampler.candidates(world, state, generator)
        plans = prior.sample(number, self.length, generator)
        return plans, *mean_scores(self, world, state, plans, self.num_rollouts, generator)

    def _elite_counts(self, plans: Tensor, score: Tensor, counts: Tensor, generator: torch.Generator) -> Tensor:
        """How often the elites among `plans [B, P, L]` took each action in each place, in the shape of `counts`."""
        score = score if score.dim() == 2 else score.amax(2)
        number = max(round(self.elites * plans.shape[1]), 1)
        best = random_top(score, number, generator)
        actions = plans.gather(1, best[:, :, None].expand(-1, -1, self.length)).long()
        where = _places(actions.flatten(0, 1), counts.shape[2], self.order).view_as(actions)
        row = torch.arange(len(plans), device=plans.device)[:, None, None]
        index = (row * counts.shape[1] + where) * counts.shape[2] + actions
        return index.flatten().bincount(minlength=counts.numel()).view_as(counts).to(counts.dtype)


class RefittedPrior:
    """A prior with counts of what the elites of each start did; see `CrossEntropyPlanner`.

    Row b of the batch that it is started with belongs to start b.

    Args:
        prior: the prior.
        counts: `[B, H, A]`: how often the elites of start b took each action in each of H places.
        order: what a place is: None: a step of the plan; k: the last k actions.
        strength, temperature: see `CrossEntropyPlanner`.
    """

    def __init__(
        self, prior: Steppable, counts: Tensor, order: int | None, strength: float, temperature: float
    ) -> None:
        self._stepper, self.counts, self.order = Stepper(prior, in_place=False), counts, order
        self.strength, self.temperature = strength, temperature
        self.num_actions, self.context_per = prior.num_actions, self._stepper.context_per
        self.device = counts.device

    def check_context_of(self, context: Tensor | None, num_plans: int = 0, length: int = 0) -> None:
        if self.context_per is not None:
            self._stepper.check_context(context, num_plans, length)

    def sample(self, num_plans: int, length: int, generator: torch.Generator) -> Tensor:
        """`num_plans` plans for each start, `[B, num_plans, length]`, of a prior without context."""
        # The number of the start stands in for a context, so that plans are grouped by it.
        start = torch.arange(len(self.counts), device=self.device).repeat_interleave(num_plans)
        return sample(self, len(start), length, start, generator=generator).view(-1, num_plans, length)

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        logits, hidden = self._stepper.start(batch_size, None if self.context_per is None else context)
        row = torch.arange(batch_size, device=logits.device)
        return self._refit(logits, hidden, row, torch.zeros_like(row))

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if len(state) == 0:  # nothing can be unpacked
            return torch.zeros(0, self.num_actions, device=self.device), state
        hidden, row, place = unpack(state, 3)
        logits, hidden = self._stepper.step(action, hidden, context)
        return self._refit(logits, hidden, row, _next_place(place, action, self.num_actions, self.order))

    def _refit(self, logits: Tensor, hidden: Tensor, row: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        probs = (logits / self.temperature).softmax(-1)
        # Logits after the last action are asked for, too; there are no counts for it.
        counted = self.counts[row, place.clamp(max=self.counts.shape[1] - 1)]
        return (counted + self.strength * probs).log(), pack([hidden, row, place])


def _next_place(place: Tensor, action: Tensor, num_actions: int, order: int | None) -> Tensor:
    """Where the action after `action [N]` is counted: the number of its step, or of the `order` actions before it."""
    if order is None:
        return place + 1
    base: int = num_actions + 1
    return (place * base + action + 1).remainder(base**order)


def _places(actions: Tensor, num_actions: int, order: int | None) -> Tensor:
    """Where each action of `actions [N, L]` is counted, `[N, L]`."""
    place, places = torch.zeros_like(actions[:, 0]), []
    for t in range(actions.shape[1]):
        places.append(place)
        place = _next_place(place, actions[:, t], num_actions, order)
    return torch.stack(places, 1)
