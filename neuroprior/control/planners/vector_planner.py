"""The interface of a planner of vectors, and what it carries from one decision to the next."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypedDict

import torch
from torch import Tensor

from neuroprior._checks import check_flags, check_same_names, check_share, check_sizes, kind_of
from neuroprior._random import generator_on
from neuroprior.control.planners.shares import Shares
from neuroprior.control.priors.vector_prior import VectorPrior
from neuroprior.control.worlds.continuous_world import ContinuousWorld, check_is_continuous
from neuroprior.planners.planner import value_of
from neuroprior.worlds.world import check_objective


class Memory(NamedTuple):
    """What a planner knows of the decisions before, for B runs; `control` moves it on.

    Attributes:
        past: `[B, T, D]`: the vectors that were executed, T >= 0, the last one last.
        observations: `[B, T, C]`: what was observed before each of them.
        mean: `[B, M, D]`: the plan around which the next decision searches, without what was executed of it, M <= L;
            the planner fills up the rest. None: there is none yet.
        elites: `[B, E, M, D]`: kept candidates, shortened in the same way; None where a planner keeps none.
        wins: `[B, 2, 2]`: how often a candidate of the prior, and one of the planner's own, was the best, and how many
            there were, see `Shares`; None: nothing is known. It belongs to a prior and its `prior_as`: a planner with
            another one is given None.
    """

    past: Tensor
    observations: Tensor
    mean: Tensor | None = None
    elites: Tensor | None = None
    wins: Tensor | None = None

    def moved_on(self, actions: Tensor, observations: Tensor, keep: int | None = None) -> "Memory":
        """After `actions [B, T, D]` were executed, with `observations [B, T, C]` before each.

        Args:
            actions, observations: what happened since.
            keep: how many of the last vectors are remembered; None: all.
        """
        steps = actions.shape[1]
        past, seen = (
            torch.cat([before, after], 1)[:, max(before.shape[1] + steps - keep, 0) if keep is not None else 0 :]
            for before, after in ((self.past, actions), (self.observations, observations))
        )
        mean = None if self.mean is None else self.mean[:, steps:]
        elites = None if self.elites is None else self.elites[:, :, steps:]
        return self._replace(past=past, observations=seen, mean=mean, elites=elites)

    def rows(self, index: Tensor) -> "Memory":
        """That of the runs at `index` (integers, or a bool mask)."""
        return Memory._make(None if values is None else values[index] for values in self)


class VectorDecision(NamedTuple):
    """What a planner decided for B starts.

    Attributes:
        plan: `[B, L, D]`: the plan to execute the beginning of.
        score: `[B]`: the score of the best candidate that was simulated: that of the plan, unless the planner says that
            its plan is an average.
        model_steps: single simulator steps taken for each start.
        memory: for the next decision, not moved on yet: `past` as given; `mean`, `elites` and `wins` after this one.
    """

    plan: Tensor
    score: Tensor
    model_steps: int
    memory: Memory


class Proposal(TypedDict, total=False):
    """What all planners of vectors take, as keyword arguments; see `VectorPlanner`."""

    prior: VectorPrior | None
    prior_share: float | None
    adapt_share: bool
    prior_as: Literal["plans", "noise"]
    discount: float
    value: Callable[[Tensor], Tensor] | None


class VectorPlanner(ABC):
    """Chooses, for each start, a sequence of vectors with a high return: the discounted sum of its rewards.

    A subclass writes `plan`. In a stochastic world each candidate is simulated once.

    Args:
        length: L, vectors in a plan.
        num_plans: P, candidates that a decision simulates, over all its iterations.
        prior: proposes candidates; None: all are the planner's own.
        prior_share: the share, from 0 to 1, of the candidates that are drawn which the prior proposes, rounded to a
            whole number; between 0 and 1 at least one candidate is the prior's and one the planner's own, if two are
            drawn. At 0 the plain algorithm, number for number. None: one half with a prior.
        adapt_share: a share between 0 and 1 falls where, in the last decisions of a run, a candidate of the prior was
            less often the best than one of the planner's own: the odds fall by the ratio of the two frequencies, to a
            twentieth at the least (see `Shares`). So a prior that does not help costs few candidates; some decisions
            may then have none of the prior's. False: the share stays.
        prior_as: "plans": a candidate is what the prior draws, given what was executed. "noise": it is the mean around
            which the planner searches plus the difference of two such draws, divided by the square root of two: noise
            with the prior's covariance over time and dimensions, wherever the plan is.
        discount: of the reward of each further step, above 0 and at most 1.
        value: its value of the final state, times `discount ** L`, is added to a plan's score.

    Attributes:
        averages: True where the plan of a decision is an average of candidates, not the best of them.

    Raises:
        ValueError: an argument is out of range, or a share without a prior.
    """

    averages: bool = False

    def __init__(
        self,
        length: int,
        num_plans: int,
        *,
        prior: VectorPrior | None = None,
        prior_share: float | None = None,
        adapt_share: bool = True,
        prior_as: Literal["plans", "noise"] = "plans",
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        check_sizes(length=length, num_plans=num_plans)
        check_objective("return", discount)
        if prior is not None and not isinstance(prior, VectorPrior):
            raise ValueError(f"`prior` must be a VectorPrior, got {kind_of(prior)}")
        share = prior_share if prior_share is not None else 0.0 if prior is None else 0.5
        check_share("prior_share", share)
        if share and prior is None:
            raise ValueError(f"`prior_share` must be 0 without a prior, got {share}")
        check_flags(adapt_share=adapt_share)
        if prior_as not in ("plans", "noise"):
            raise ValueError(f'`prior_as` must be "plans" or "noise", got {prior_as!r}')
        self.length, self.num_plans, self.discount, self.value = length, num_plans, discount, value
        self.prior, self.prior_share, self.adapt_share, self.prior_as = prior, share, adapt_share, prior_as

    @property
    def keep(self) -> int | None:
        """How many of the last executed vectors the planner reads; None if all."""
        return self.prior.memory if self.prior is not None and self.prior_share else 0

    @abstractmethod
    def plan(
        self,
        world: ContinuousWorld,
        state: Tensor,
        generator: torch.Generator | None = None,
        memory: Memory | None = None,
    ) -> VectorDecision:
        """Plan from each of B starts.

        Args:
            world: the world, in which the planner tries candidates.
            state: `[B, ...]`.
            generator: draws candidates and the steps of a stochastic world.
            memory: of the decisions before; None: runs begin.

        Raises:
            ValueError: these are no states of the world, its bounds are none, the prior has other bounds, the memory is
                of other runs, a step returns something else than a state and rewards, or a reward is NaN.
        """

    def begin(
        self, world: ContinuousWorld, state: Tensor, generator: torch.Generator | None, memory: Memory | None
    ) -> tuple[torch.Generator, Memory]:
        """Check the arguments of `plan`; the generator to draw with, and the memory, empty where runs begin."""
        check_is_continuous(world)
        world.check_state(state)
        size = world.action_size
        if self.prior is not None:
            self.prior.check_same_bounds(world, "the world")
            check_same_names("action_names", self.prior.action_names, world.action_names, "the world", "the prior")
        if memory is None:
            observed = world.observe(state)
            past = torch.zeros(len(state), 0, size, device=state.device)
            memory = Memory(past, observed.new_zeros(len(state), 0, *observed.shape[1:]))
        if not isinstance(memory, Memory):
            raise ValueError(f"`memory` must be that of a decision (decision.memory), got {kind_of(memory)}")
        for name, values in memory._asdict().items():
            last = {"observations": None, "wins": 2}.get(name, size)
            if values is not None and (len(values) != len(state) or last not in (None, values.shape[-1])):
                raise ValueError(
                    f"`memory.{name}` must have shape [{len(state)}, ..., {last or 'C'}], got {list(values.shape)}"
                )
        return generator_on(generator, state.device), memory

    def shares(
        self, drawn: Sequence[int], memory: Memory, generator: torch.Generator, iterations: int | None = None
    ) -> Shares:
        """Which of the candidates `drawn` in each iteration the prior proposes, in so many iterations (None: all).

        Of iteration i a planner draws `shares.most[i][0]` candidates itself, and tries those of `shares.mixed`. It then
        calls `shares.observe` with the scores of the first iteration, and keeps `shares.wins` in its memory.
        """
        adapt, wins = self.adapt_share, memory.wins
        share, starts = self.prior_share, len(memory.past)
        return Shares(drawn, share, starts, generator, iterations=iterations, adapt=adapt, wins=wins)

    def proposals(
        self, shares: Shares, world: ContinuousWorld, state: Tensor, memory: Memory, generator: torch.Generator
    ) -> Sequence[Tensor]:
        """For each iteration the prior's candidates, or its noise, `[B, P, L, D]`, P as `shares.most`; see `around`."""
        counts = [from_prior for _, from_prior in shares.most]
        number = sum(counts)
        if self.prior is None or not number:
            none = torch.zeros(len(state), 0, self.length, world.action_size, device=state.device)
            return torch.split(none, counts, 1)
        context = None
        if self.prior.takes_context:
            observed = world.observe(state)
            if observed.shape[1:] != (self.prior.context_size,):
                raise ValueError(
                    f"`prior` must take the features of the world, {list(observed.shape[1:])}, got one that takes"
                    f" {self.prior.context_size}"
                )
            context = torch.cat([memory.observations, observed[:, None]], 1)
        noise = self.prior_as == "noise"
        drawn = self.prior.sample(number * (1 + noise), self.length, context, past=memory.past, generator=generator)
        drawn = drawn.to(state.device)
        return torch.split((drawn[:, :number] - drawn[:, number:]) / 2**0.5 if noise else drawn, counts, 1)

    def around(self, mean: Tensor, proposals: Tensor, scale: Tensor | float = 1.0) -> Tensor:
        """The prior's candidates `[B, number, L, D]`: its proposals, or `mean [B, L, D]` plus `scale` times them."""
        return mean[:, None] + scale * proposals if self.prior_as == "noise" else proposals

    def scores(self, world: ContinuousWorld, state: Tensor, plans: Tensor, generator: torch.Generator) -> Tensor:
        """The scores `[B, P]` of the candidates `plans [B, P, L, D]`, each simulated once.

        Raises:
            ValueError: a score is NaN.
        """
        final_state, rewards, _ = world.rollout(state, plans, generator)
        if self.discount != 1:
            rewards = rewards * self.discount ** torch.arange(self.length, device=rewards.device, dtype=rewards.dtype)
        score = rewards.sum(-1)
        if self.value is not None:
            value = value_of(self.value, final_state.flatten(0, 1)).view_as(score)
            score = score + self.discount**self.length * value.to(score.dtype)
        if score.isnan().any():
            raise ValueError("`score` must be a number, got NaN: a reward of the world, or its value, is none")
        return score


def middle_and_half(world: ContinuousWorld, device: torch.device) -> tuple[Tensor, Tensor]:
    """The middle of the range of each dimension, and half its width: `[D]` each."""
    low, high = world.action_low.to(device), world.action_high.to(device)
    return (low + high) / 2, (high - low) / 2


def fill_plan(mean: Tensor | None, batch_size: int, length: int, middle: Tensor, repeat: bool) -> Tensor:
    """The plan `[B, L, D]` to search around, of what is left of the last one.

    Args:
        mean: `[B, M, D]`, of which at most L vectors are taken; None: nothing is left.
        batch_size: B.
        length: L.
        middle: `[D]`: what a plan begins with everywhere.
        repeat: fill up with the last vector that is left; else with `middle`.
    """
    if mean is None or not mean.shape[1]:
        return middle.expand(batch_size, length, -1)
    missing = length - mean.shape[1]
    if missing <= 0:
        return mean[:, :length]
    last = mean[:, -1:] if repeat else middle.expand(batch_size, 1, -1)
    return torch.cat([mean, last.expand(-1, missing, -1)], 1)
