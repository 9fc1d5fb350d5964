"""The sampling planner: candidate plans from a prior, the best of them wins."""

from collections.abc import Callable
from typing import Literal, Protocol

import torch
from torch import Tensor

from neuroprior._random import generator_on
from neuroprior.planners.chance import check_rollouts, halved_scores, halving, mean_scores
from neuroprior.planners.planner import Decision, Planner, decide, in_chunks
from neuroprior.sampling.ancestral import Steppable, check_in_world, sample_in_world
from neuroprior.sampling.draws import check_temperature
from neuroprior.worlds.world import Rollout, World


class Proposer(Steppable, Protocol):
    """What a planner knows of a prior that it draws whole plans from."""

    @property
    def takes_context(self) -> bool: ...

    def sample(
        self, num_plans: int, length: int, *, temperature: float, generator: torch.Generator | None
    ) -> Tensor: ...


class SamplingPlanner(Planner):
    """Tries `num_plans` plans drawn from a prior (Hyvärinen's random planner, with or without a behavioural prior).

    A prior without context proposes plans blindly, and they are tried as a whole. A prior that sees the world, and any
    prior in a world where not every action exists everywhere, is stepped together with the world.

    In a world with chance a plan is a sequence of actions that is executed whatever comes of them. A prior that sees
    the world proposes each plan along one course of events; all plans are then scored by new rollouts.

    Args:
        prior: what proposes; `UniformPrior(A)` makes the random planner.
        length: number of actions in a plan, at least 1.
        num_plans: number of candidate plans for each start, at least 1.
        objective, discount, value, any_prefix: see `Planner`.
        temperature: of sampling.
        num_rollouts: a plan's score is its mean over so many rollouts, all plans of a start meeting the same chance
            where the world can (see `World.rollout`). Without chance (`World.stochastic`) one is all that is taken.
        halving: share as many rollouts out unequally: after each of several rounds the worse half of the plans is left
            out, so that the better ones are tried more often (see `planners.chance.halved_scores`).

    Raises:
        ValueError: an argument is out of range. `plan` raises it for a prior that samples an end symbol, too.
    """

    def __init__(
        self,
        prior: Proposer,
        length: int,
        num_plans: int,
        *,
        objective: Literal["terminal", "return"] = "terminal",
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
        any_prefix: bool = False,
        temperature: float = 1.0,
        num_rollouts: int = 1,
        halving: bool = False,
    ) -> None:
        super().__init__(objective, discount, value, any_prefix)
        if length < 1 or num_plans < 1:
            raise ValueError(f"length and num_plans must be at least 1, not {length} and {num_plans}")
        check_temperature(temperature)
        check_rollouts(num_rollouts)
        self.num_rollouts, self.halving = num_rollouts, halving
        self.prior, self.length, self.num_plans, self.temperature = prior, length, num_plans, temperature

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        check_in_world(self.prior, world, state)
        generator = generator_on(generator, state.device)

        def some(state: Tensor) -> Decision:
            return self._plan(world, state, generator)

        return in_chunks(some, state, self._steps(world))

    def like(self, prior: Proposer, length: int, num_plans: int, temperature: float = 1.0) -> "SamplingPlanner":
        """A plain sampler of other plans, which scores them as this planner does."""
        return SamplingPlanner(
            prior,
            length,
            num_plans,
            objective=self.objective,
            discount=self.discount,
            value=self.value,
            any_prefix=self.any_prefix,
            temperature=temperature,
            num_rollouts=self.num_rollouts,
        )

    def _steps(self, world: World) -> int:
        """Simulator steps for each start."""
        if not world.stochastic:
            return self.num_plans * self.length
        tried = self.num_plans * self.num_rollouts
        if self.halving:
            tried = sum(kept * times for kept, times in halving(self.num_plans, self.num_rollouts))
        return (tried + (self.num_plans if self.prior.takes_context else 0)) * self.length

    def _plan(self, world: World, state: Tensor, generator: torch.Generator) -> Decision:
        return decide(*self.tried(world, state, generator), self._steps(world), generator)

    def tried(self, world: World, state: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Candidate plans `[B, P, L]` for starts `[B, ...]`, and their scores and ends as `decide` takes them."""
        if world.stochastic:
            plans = self.proposals(world, state, generator)
            if self.halving:
                return halved_scores(self, world, state, plans, self.num_rollouts, generator)
            return plans, *mean_scores(self, world, state, plans, self.num_rollouts, generator)
        plans, rollout = self.candidates(world, state, generator)
        return plans, *self.scored(rollout)

    def proposals(self, world: World, state: Tensor, generator: torch.Generator) -> Tensor:
        """Candidate plans `[B, P, L]` for starts `[B, ...]`, before they are scored."""
        if self.prior.takes_context or not world.all_legal:
            return self._along(world, state, generator)[0]
        return self._blind(len(state), generator)

    def candidates(self, world: World, state: Tensor, generator: torch.Generator) -> tuple[Tensor, Rollout]:
        """The candidate plans `[B, P, L]` for starts `[B, ...]`, and what came of them."""
        if self.prior.takes_context or not world.all_legal:
            return self._along(world, state, generator)
        plans = self._blind(len(state), generator)
        return plans, world.rollout(state, plans, generator, self.any_prefix)

    def _along(self, world: World, state: Tensor, generator: torch.Generator) -> tuple[Tensor, Rollout]:
        """Plans that are drawn along with the world."""
        return sample_in_world(
            self.prior,
            world,
            state,
            self.num_plans,
            self.length,
            temperature=self.temperature,
            generator=generator,
            keep_states=self.any_prefix,
        )

    def _blind(self, batch: int, generator: torch.Generator) -> Tensor:
        """Plans that are drawn without a look at the world."""
        plans = self.prior.sample(
            batch * self.num_plans, self.length, temperature=self.temperature, generator=generator
        )
        return plans.view(batch, self.num_plans, self.length)
