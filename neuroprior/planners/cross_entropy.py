"""The cross-entropy planner: candidates in rounds, each drawn from the prior as refitted to the best plans so far."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior.planners.planner import Decision, decide, in_chunks, random_top
from neuroprior.planners.sampling import Proposer, SamplingPlanner
from neuroprior.priors.ensembles.packing import pack, unpack
from neuroprior.priors.prior import Prior
from neuroprior.sampling.ancestral import sample
from neuroprior.worlds.world import World

MOST_COUNTS = 2**22
"""Numbers in the counts of a start."""


class CrossEntropyPlanner(SamplingPlanner):
    """Draws candidates, refits the prior to the best of them, and draws again, all within one decision.

    The cross-entropy method (Rubinstein 1999; de Boer et al. 2005, section 2), started from a behavioural prior and
    held to it: where the elites, the best plans of a start so far, took action a n(a) times out of n, and the prior
    gives it probability p(a), the next candidate takes it with probability (n(a) + s p(a)) / (n + s). "Where" is the
    same step of the plan, or after the same last actions. The best of all candidates wins, not of the last round alone.

    Args:
        prior: what proposes.
        length: number of actions in a plan, at least 1.
        num_plans: candidates for each start in all rounds together.
        rounds: of about as many candidates each; no more are taken than there are candidates.
        elites: the share of the candidates so far that is refitted to, above 0 and at most 1; at least one plan.
        order: None: the elites' actions are counted step by step; k >= 1: after each k actions, wherever in a plan.
        strength: s > 0: so many observations is the prior worth.
        objective, discount, value, any_prefix: see `Planner`.
        temperature: divides the prior's logits.
        num_rollouts: see `SamplingPlanner`.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(
        self,
        prior: Prior,
        length: int,
        num_plans: int,
        *,
        rounds: int = 4,
        elites: float = 0.05,
        order: int | None = None,
        strength: float = 4.0,
        objective: Literal["terminal", "return"] = "terminal",
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
        any_prefix: bool = False,
        temperature: float = 1.0,
        num_rollouts: int = 1,
    ) -> None:
        super().__init__(
            prior,
            length,
            num_plans,
            objective=objective,
            discount=discount,
            value=value,
            any_prefix=any_prefix,
            temperature=temperature,
            num_rollouts=num_rollouts,
        )
        check_sizes(rounds=rounds, **({} if order is None else {"order": order}))
        if not 0 < elites <= 1:
            raise ValueError(f"elites: a share above 0 and at most 1 is expected, not {elites}")
        if not 0 < strength < float("inf"):
            raise ValueError(f"strength: a positive finite number is expected, not {strength}")
        self.rounds, self.elites, self.order, self.strength = min(rounds, num_plans), elites, order, strength

    def _plan(self, world: World, state: Tensor, generator: torch.Generator) -> Decision:
        histories = self.length if self.order is None else (world.num_actions + 1) ** self.order
        if histories * world.num_actions > MOST_COUNTS:
            what = "length" if self.order is None else "order"
            raise ValueError(
                f"{what}: {histories:,} places with {world.num_actions} actions each are too many to count in;"
                " give a smaller one"
            )

        def some(state: Tensor) -> Decision:
            return self._plan_some(world, state, histories, generator)

        return in_chunks(some, state, histories * world.num_actions)

    def _plan_some(self, world: World, state: Tensor, histories: int, generator: torch.Generator) -> Decision:
        counts = torch.zeros(len(state), histories, world.num_actions, device=state.device)
        found: list[tuple[Tensor, ...]] = []
        for k in range(self.rounds):
            proposer = _Refitted(self.prior, counts, self.order, self.strength, self.temperature)
            number = self.num_plans * (k + 1) // self.rounds - self.num_plans * k // self.rounds
            drawn = self.like(proposer, self.length, number)
            found.append(drawn.tried(world, state, generator))
            plans, score, ends = (torch.cat(parts, 1) for parts in zip(*found, strict=True))
            counts = self._counted(plans, score, counts, generator)
        return decide(plans, score, ends, self._steps(world), generator)

    def _counted(self, plans: Tensor, score: Tensor, counts: Tensor, generator: torch.Generator) -> Tensor:
        """How often the elites among `plans [B, P, L]` took each action where, as `counts [B, H, A]`."""
        score = score if score.dim() == 2 else score.amax(2)
        number = max(round(self.elites * plans.shape[1]), 1)
        best = random_top(score, number, generator)
        actions = plans.gather(1, best[:, :, None].expand(-1, -1, self.length)).long()
        where = _places(actions.flatten(0, 1), counts.shape[2], self.order).view_as(actions)
        row = torch.arange(len(plans), device=plans.device)[:, None, None]
        index = (row * counts.shape[1] + where) * counts.shape[2] + actions
        return index.flatten().bincount(minlength=counts.numel()).view_as(counts).to(counts.dtype)


class _Refitted:
    """A prior drawn towards the elites of each start; row i of the batch that is begun with belongs to start i."""

    def __init__(self, prior: Proposer, counts: Tensor, order: int | None, strength: float, temperature: float) -> None:
        self.prior, self.counts, self.order = prior, counts, order
        self.strength, self.temperature = strength, temperature
        self.num_actions, self.context_per, self.end = prior.num_actions, prior.context_per, prior.end
        self.device, self.takes_context = prior.device, prior.takes_context

    def check_context_of(self, plans: Tensor | None, num_plans: int = 0, length: int = 0) -> None:
        if self.takes_context:
            self.prior.check_context_of(plans, num_plans, length)

    def sample(self, num_plans: int, length: int, *, temperature: float, generator: torch.Generator | None) -> Tensor:
        """Plans of one start after another, `[num_plans, length]`; the number of the start stands in for a context."""
        starts = len(self.counts)
        start = torch.arange(starts, device=self.device).repeat_interleave(num_plans // max(starts, 1))
        return sample(self, num_plans, length, start, temperature=temperature, generator=generator)

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        logits, memory = self.prior.start(batch_size, context if self.takes_context else None)
        row = torch.arange(batch_size, device=logits.device)
        return self._at(logits, memory, row, torch.zeros_like(row))

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if len(state) == 0:  # of which nothing can be unpacked
            return torch.zeros(0, self.num_actions, device=self.device), state
        memory, row, place = unpack(state, 3)
        logits, memory = self.prior.step(action, memory, context)
        return self._at(logits, memory, row, _next_place(place, action, self.num_actions, self.order))

    def _at(self, logits: Tensor, memory: Tensor, row: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        probs = (logits / self.temperature).softmax(-1)
        # What follows the last action is asked for, too, and not counted.
        counted = self.counts[row, place.clamp(max=self.counts.shape[1] - 1)]
        return (counted + self.strength * probs).log(), pack([memory, row, place])


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
