"""The sampling planner: draws candidate plans from a prior and decides for the best of them."""

from collections.abc import Sequence
from math import isqrt
from typing import Unpack

import torch
from torch import Tensor

from neuroprior._checks import check_flags, check_share, check_sizes
from neuroprior.planners.planner import Decision, Objective, PriorPlanner, decide, join_decisions
from neuroprior.planners.rollouts import halved_scores, halving_rounds, mean_scores, score_anew
from neuroprior.planners.sources import Sources
from neuroprior.priors.uniform import UniformPrior
from neuroprior.sampling.ancestral import sample, sample_in_world
from neuroprior.sampling.stepping import Steppable, Stepper, check_in_world
from neuroprior.worlds.world import Rollout, World


class SamplingPlanner(PriorPlanner):
    """Tries `num_plans` plans drawn from a prior (Hyvärinen's random planner, with or without a behavioural prior).

    Plans of a prior without context are drawn blindly, and then rolled out. A prior with a context, and any prior where
    not all actions are legal everywhere, is stepped together with the world.

    In a stochastic world a plan is a sequence of actions that is executed whatever happens. A prior with a context
    draws each plan along one random trajectory; all plans are then scored by new rollouts. The best of many means is
    too high, so that the chosen plan is scored once more, by as many rollouts: that is the score of the decision.

    Several priors, given as a list, share the candidates of a decision with a uniform one, see `Sources`: those that
    had the best candidate more often draw more of the next. So a prior that was learned from few plans, or in a world
    that has changed since, costs little.

    Args:
        prior: proposes the candidates; `UniformPrior(A)` makes the random planner. Or a list of priors.
        length: number of actions in a plan, at least 1.
        num_plans: number of candidates for each start, at least 1.
        num_rollouts: in a stochastic world, plans are chosen by their means over so many rollouts, with common random
            numbers for all plans of a start where the world can (see `World.rollout`). A deterministic world takes one.
            None: the budget of `num_plans` rollouts is divided: about its root of plans are tried, each as often.
        halving: spend as many rollouts unequally: after each of several rounds the worse half of the plans is dropped,
            so that the better ones are tried more often (see `planners.rollouts.halved_scores`).
        temperature: divides the prior's logits.
        uniform_share: the share, from 0 to 1, of the candidates that are uniform plans instead, rounded to a whole
            number of them: what the prior holds to be impossible is tried, too (a defensive mixture: Hesterberg 1995).
            Not with several priors.
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
        prior: Steppable | Sequence[Steppable],
        length: int,
        num_plans: int,
        *,
        num_rollouts: int | None = None,
        halving: bool = False,
        temperature: float = 1.0,
        uniform_share: float = 0.0,
        **goal: Unpack[Objective],
    ) -> None:
        self.sources = Sources(prior) if isinstance(prior, Sequence) else None
        first = prior[0] if isinstance(prior, Sequence) else prior
        super().__init__(first, length, num_plans, temperature=temperature, **goal)
        if num_rollouts is not None:
            check_sizes(num_rollouts=num_rollouts)
        check_flags(halving=halving)
        check_share("uniform_share", uniform_share)
        if self.sources is not None and (halving or uniform_share):
            raise ValueError("`halving` and `uniform_share` must be left out where there are several priors")
        self.num_rollouts, self.halving, self.uniform_share = num_rollouts, halving, uniform_share

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        _, generator = self._prepare(world, state, generator)
        if self.sources is not None:
            for prior in self.sources.priors[1:]:
                check_in_world(prior, world, state)
        steps, (num_plans, num_rollouts), wins = self.model_steps(world), self.effort(world), list[Tensor]()

        def plan_chunk(chunk: Tensor) -> Decision:
            plans, score, ends = self.candidates(world, chunk, generator)
            if self.sources is not None:
                wins.append(wins_of(score, self.sources.counts(world, num_plans)))
            decision = decide(plans, score, ends, steps, generator, keep=self.keep_candidates)
            if not world.stochastic or plans.shape[1] == 1:
                return decision
            return score_anew(self, world, chunk, decision, num_rollouts, generator)

        decision = join_decisions(map(plan_chunk, self.chunks(state, steps)), len(state))
        if self.sources is not None:
            self.sources.learn(world, torch.stack(wins).sum(0))
        return decision

    def candidates(self, world: World, state: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Candidate plans `[B, P, L]` for the starts `state [B, ...]`, their scores and final states.

        Scores and final states are `[B, P]`, those of all prefixes `[B, P, L]` with `any_prefix`; final states have the
        state's own dimensions behind these. With halving, only the plans of the last round are returned.
        """
        drawn = [
            self._draw(prior, number, temperature, world, state, generator)
            for prior, number, temperature in self._proposals(world)
            if number
        ]
        if not world.stochastic:
            scored = [self._score(plans, rollout, world, state, generator) for plans, rollout in drawn]
            plans, score, ends = (
                column[0] if len(column) == 1 else torch.cat(column, 1) for column in zip(*scored, strict=True)
            )
            return plans, score, ends
        # Together, so that all plans of a start meet the same random numbers.
        plans = drawn[0][0] if len(drawn) == 1 else torch.cat([plans for plans, _ in drawn], 1)
        num_rollouts = self.effort(world)[1]
        if self.halving:
            return halved_scores(self, world, state, plans, num_rollouts, generator)
        return plans, *mean_scores(self, world, state, plans, num_rollouts, generator)

    def effort(self, world: World) -> tuple[int, int]:
        """How many plans are tried from each start, and how often each."""
        if not world.stochastic or self.num_rollouts is not None:
            return self.num_plans, self.num_rollouts or 1
        priors = [self.prior] if self.sources is None else self.sources.priors
        in_world = any(Stepper(prior).context_per is not None for prior in priors)
        times = max(isqrt(self.num_plans), 1 + in_world)
        num_rollouts = times - in_world
        return max((self.num_plans - num_rollouts) // times, 1), num_rollouts

    def _proposals(self, world: World) -> list[tuple[Steppable, int, float]]:
        """The priors that draw candidates, how many each draws, and at which temperature."""
        num_plans = self.effort(world)[0]
        if self.sources is not None:
            counts = self.sources.counts(world, num_plans)
            pairs = zip(self.sources.priors, counts, strict=True)
            return [(one, n, 1.0 if isinstance(one, UniformPrior) else self.temperature) for one, n in pairs]
        uniform = uniform_plans(self.uniform_share, num_plans)
        proposals: list[tuple[Steppable, int, float]] = [(self.prior, num_plans - uniform, self.temperature)]
        if uniform:
            proposals.append((UniformPrior(world.num_actions).to(Stepper(self.prior).device), uniform, 1.0))
        return proposals

    def _draw(
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

    def _score(
        self, plans: Tensor, rollout: Rollout | None, world: World, state: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The plans, their scores and final states in a deterministic world."""
        if rollout is not None:
            return plans, *self.for_world(world).score_rollout(rollout)
        return plans, *mean_scores(self, world, state, plans, 1, generator)

    def model_steps(self, world: World) -> int:
        """Simulator steps for each start."""
        if not world.stochastic:
            return self.num_plans * self.length
        num_plans, num_rollouts = self.effort(world)
        tries = num_plans * num_rollouts
        if self.halving:
            tries = sum(kept * times for kept, times in halving_rounds(num_plans, num_rollouts))
        tries += num_rollouts * (num_plans > 1)  # of the plan that was chosen
        proposals = self._proposals(world)
        in_world = sum(number for prior, number, _ in proposals if Stepper(prior).context_per is not None)
        return (tries + in_world) * self.length


def wins_of(score: Tensor, counts: list[int]) -> Tensor:
    """In how many decisions each source had the best candidate: float64 `[K]`; of equally good ones each has its part.

    Where all candidates are equally good, nothing is known of the sources, and all have the same part.

    Args:
        score: `[B, P]`, or `[B, P, L]` of all prefixes.
        counts: how many of the P candidates each source drew, one after the other.
    """
    score = score if score.dim() == 2 else score.amax(2)
    best = (score == score.amax(1, keepdim=True)).double()
    parts = torch.stack([source.sum(1) for source in best.split(counts, 1)], 1) / best.sum(1, keepdim=True)
    return parts.masked_fill(best.all(1, keepdim=True), 1 / len(counts)).sum(0)


def uniform_plans(share: float, num_plans: int) -> int:
    """How many of so many candidates are uniform plans."""
    return round(share * num_plans)
