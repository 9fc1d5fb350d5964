"""The sampling planner: draws candidate plans from a prior and decides for the best of them."""

from typing import Unpack

import torch
from torch import Tensor

from neuroprior._checks import check_flags, check_share, check_sizes
from neuroprior.planners.planner import Decision, Objective, PriorPlanner, decide, join_decisions
from neuroprior.planners.rollouts import halved_scores, halving_rounds, mean_scores
from neuroprior.priors.uniform import UniformPrior
from neuroprior.sampling.ancestral import sample, sample_in_world
from neuroprior.sampling.stepping import Steppable, Stepper
from neuroprior.worlds.world import Rollout, World


class SamplingPlanner(PriorPlanner):
    """Tries `num_plans` plans drawn from a prior (Hyvärinen's random planner, with or without a behavioural prior).

    Plans of a prior without context are drawn blindly, and then rolled out. A prior with a context, and any prior where
    not all actions are legal everywhere, is stepped together with the world.

    In a stochastic world a plan is a sequence of actions that is executed whatever happens. A prior with a context
    draws each plan along one random trajectory; all plans are then scored by new rollouts.

    Args:
        prior: proposes the candidates; `UniformPrior(A)` makes the random planner.
        length: number of actions in a plan, at least 1.
        num_plans: number of candidates for each start, at least 1.
        num_rollouts: in a stochastic world, the score of a plan is its mean over so many rollouts, with common random
            numbers for all plans of a start where the world can (see `World.rollout`). A deterministic world takes one.
        halving: spend as many rollouts unequally: after each of several rounds the worse half of the plans is dropped,
            so that the better ones are tried more often (see `planners.rollouts.halved_scores`).
        temperature: divides the prior's logits.
        uniform_share: the share, from 0 to 1, of the candidates that are uniform plans instead, rounded to a whole
            number of them: what the prior holds to be impossible is tried, too (a defensive mixture: Hesterberg 1995).
        **goal: objective, discount, value, any_prefix: see `Planner`.

    Raises:
        ValueError: an argument is out of range. `plan` raises it for a prior that samples an end symbol, too.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> decision = SamplingPlanner(UniformPrior(4), length=4, num_plans=32).plan(world, torch.tensor([0, 12]))
        >>> decision.plan.shape, decision.model_steps
        (torch.Size([2, 4]), 128)
    """

    def __init__(
        self,
        prior: Steppable,
        length: int,
        num_plans: int,
        *,
        num_rollouts: int = 1,
        halving: bool = False,
        temperature: float = 1.0,
        uniform_share: float = 0.0,
        **goal: Unpack[Objective],
    ) -> None:
        super().__init__(prior, length, num_plans, temperature=temperature, **goal)
        check_sizes(num_rollouts=num_rollouts)
        check_flags(halving=halving)
        check_share("uniform_share", uniform_share)
        self.num_rollouts, self.halving, self.uniform_share = num_rollouts, halving, uniform_share

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        _, generator = self._prepare(world, state, generator)
        steps = self.model_steps(world)
        chunks = self.chunks(state, steps)
        decisions = (
            decide(*self.candidates(world, some, generator), steps, generator, keep=self.keep_candidates)
            for some in chunks
        )
        return join_decisions(decisions, len(state))

    def candidates(self, world: World, state: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Candidate plans `[B, P, L]` for the starts `state [B, ...]`, their scores and final states.

        Scores and final states are `[B, P]`, those of all prefixes `[B, P, L]` with `any_prefix`; final states have the
        state's own dimensions behind these. With halving, only the plans of the last round are returned.
        """
        uniform = uniform_plans(self.uniform_share, self.num_plans)
        drawn = []
        if uniform < self.num_plans:
            number = self.num_plans - uniform
            drawn.append(self._drawn(self.prior, number, self.temperature, world, state, generator))
        if uniform:
            even = UniformPrior(world.num_actions).to(Stepper(self.prior).device)
            drawn.append(self._drawn(even, uniform, 1.0, world, state, generator))
        if not world.stochastic:
            scored = [self._scored(plans, rollout, world, state, generator) for plans, rollout in drawn]
            plans, score, ends = (
                column[0] if len(column) == 1 else torch.cat(column, 1) for column in zip(*scored, strict=True)
            )
            return plans, score, ends
        # Together, so that all plans of a start meet the same random numbers.
        plans = drawn[0][0] if len(drawn) == 1 else torch.cat([plans for plans, _ in drawn], 1)
        if self.halving:
            return halved_scores(self, world, state, plans, self.num_rollouts, generator)
        return plans, *mean_scores(self, world, state, plans, self.num_rollouts, generator)

    def _drawn(
        self, prior: Steppable, number: int, temperature: float, world: World, state: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Rollout | None]:
        """Plans `[B, number, L]`, and their rollout where they were drawn together with the world."""
        if Stepper(prior).context_per is None and world.all_legal:
            plans = sample(prior, len(state) * number, self.length, temperature=temperature, generator=generator)
            return plans.view(len(state), number, self.length), None
        return sample_in_world(
            prior,
            world,
            state,
            number,
            self.length,
            temperature=temperature,
            generator=generator,
            keep_states=self.any_prefix and not world.stochastic,
        )

    def _scored(
        self, plans: Tensor, rollout: Rollout | None, world: World, state: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The plans, their scores and final states in a deterministic world."""
        if rollout is not None:
            return plans, *self.for_world(world).score_rollout(rollout)
        return plans, *mean_scores(self, world, state, plans, self.num_rollouts, generator)

    def model_steps(self, world: World) -> int:
        """Simulator steps for each start."""
        if not world.stochastic:
            return self.num_plans * self.length
        tries = self.num_plans * self.num_rollouts
        if self.halving:
            tries = sum(kept * times for kept, times in halving_rounds(self.num_plans, self.num_rollouts))
        drawn_in_world = Stepper(self.prior).context_per is not None
        own = self.num_plans - uniform_plans(self.uniform_share, self.num_plans)
        return (tries + own * drawn_in_world) * self.length


def uniform_plans(share: float, num_plans: int) -> int:
    """How many of so many candidates are uniform plans."""
    return round(share * num_plans)
