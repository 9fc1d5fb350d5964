"""The horizon planner: how deep to plan, and so how many plans to try, is chosen by what the candidates score."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.planners.planner import Decision, decide, in_chunks
from neuroprior.planners.sampling import Proposer, SamplingPlanner
from neuroprior.sampling.ancestral import check_in_world
from neuroprior.worlds.world import World

POOLED = 4.0
"""The scores from all starts together count as so many of each start's own."""

QUANTILES = 16
"""Of the best of several scores, over which its mean is taken."""


class HorizonPlanner(SamplingPlanner):
    """Chooses for each start how many actions its plans have: few long ones, or many short ones, for as many steps.

    Plans may end after any of their actions. At first some of the longest are drawn, which tell what plans of each
    shorter horizon would have scored, too. Then, round after round, that horizon is chosen from which most is to be
    expected for the steps that are left: where the scores of plans of d actions spread widely, the best of many more
    will be better than the best so far (the value of information, Dearden et al. 1999; the uncertainty of values as the
    arbiter of how far to plan, Daw et al. 2005). Scores of a horizon are taken to be normal, with the mean and the
    spread of those seen from this start and, for a little, from the others that are planned from together. Where none
    promises anything, plans are as long as they may be.

    Args:
        prior: what proposes.
        length: the longest horizon, at least 1.
        num_plans: as many steps as this many plans of `length` actions take are spent on each start, or a few less.
        pilot: the share of the plans with which it begins, all of `length` actions; above 0, at most 1.
        rounds: in which the rest is spent; no more than there are plans left.
        objective, discount, value: see `Planner`; `any_prefix` is True.
        temperature, num_rollouts: see `SamplingPlanner`.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(
        self,
        prior: Proposer,
        length: int,
        num_plans: int,
        *,
        pilot: float = 0.5,
        rounds: int = 3,
        objective: Literal["terminal", "return"] = "terminal",
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
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
            any_prefix=True,
            temperature=temperature,
            num_rollouts=num_rollouts,
        )
        check_sizes(rounds=rounds)
        if not 0 < pilot <= 1:
            raise ValueError(f"pilot: a share above 0 and at most 1 is expected, not {pilot}")
        self.first = max(round(pilot * num_plans), 1)
        self.rounds = min(rounds, num_plans - self.first)

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        check_in_world(self.prior, world, state)
        generator = generator_on(generator, state.device)
        return in_chunks(lambda some: self._plan(world, some, generator), state, self._steps(world))

    def _plan(self, world: World, state: Tensor, generator: torch.Generator) -> Decision:
        found = self._found(world, state, self.length, self.first, generator)
        left = (self.num_plans - self.first) * self.length
        for k in range(self.rounds):
            share = left // (self.rounds - k)
            horizon = self._horizon(found, left)
            left -= share
            for depth in horizon.unique().tolist():
                here = (horizon == depth).nonzero()[:, 0]
                more = self._found(world, state[here], depth, share // depth, generator)
                found = found.joined(here, more, generator)
        return found.decision._replace(model_steps=int(found.steps.max()) if len(state) else 0)

    def _found(self, world: World, state: Tensor, depth: int, number: int, generator: torch.Generator) -> "_Found":
        """What `number` plans of `depth` actions find."""
        planner = self.like(self.prior, depth, number, self.temperature)
        plans, score, ends = planner.tried(world, state, generator)
        best = decide(plans, score, ends, 0, generator)
        # Up to each horizon a plan scores what its best beginning does.
        so_far = score.double().cummax(2).values
        moments = torch.stack([torch.full_like(so_far, 1.0), so_far, so_far**2], -1).sum(1)
        ties = (score == best.score[:, None, None]).sum((1, 2))
        longer = self.length - depth
        steps = torch.full_like(ties, planner._steps(world))
        return _Found(best._replace(plan=pad(best.plan, (0, longer))), ties, pad(moments, (0, 0, 0, longer)), steps)

    def _horizon(self, found: "_Found", left: int) -> Tensor:
        """The horizon `[B]` from which most is to be expected for so many steps; the longest of equals."""
        moments = found.moments + POOLED * found.moments.sum(0) / found.moments.sum(0)[:, :1].clamp(min=1)
        number, total, squares = moments.unbind(-1)
        mean = total / number
        spread = (squares / number - mean**2).clamp(min=0).sqrt()
        depth = torch.arange(1, self.length + 1, device=mean.device)
        # Of few actions there are few plans.
        tries = (left // depth).double().minimum(self.prior.num_actions ** depth.double())
        share = (torch.arange(QUANTILES, device=mean.device, dtype=torch.float64) + 0.5) / QUANTILES
        # The best of n scores is below its quantile q with probability q, so each of them with probability q ** (1/n).
        above = -torch.expm1(share.log() / tries[:, None])
        best = mean[..., None] - spread[..., None] * torch.special.ndtri(above)
        gain = (best - found.decision.score.double()[:, None, None]).clamp(min=0).mean(-1).nan_to_num(0.0, 0.0)
        longest_first: Tensor = gain.flip(1).argmax(1)
        return self.length - longest_first


class _Found(NamedTuple):
    """What was found from B starts.

    Attributes:
        decision: the best so far.
        ties: `[B]`: how many candidates are as good as that one, itself among them.
        moments: `[B, L, 3]`: of the scores up to each horizon, how many, their sum and that of their squares.
        steps: `[B]`: steps of the world that were taken.
    """

    decision: Decision
    ties: Tensor
    moments: Tensor
    steps: Tensor

    def joined(self, here: Tensor, more: "_Found", generator: torch.Generator) -> "_Found":
        """With what more was found from the starts `here`; of candidates that are equally good each is as likely."""
        own, new = self.decision, more.decision
        score = own.score[here]
        ties = torch.where(new.score == score, self.ties[here] + more.ties, self.ties[here])
        draw = torch.rand(len(here), generator=generator, device=here.device)
        takes = (new.score > score) | ((new.score == score) & (draw * ties < more.ties))
        ties = torch.where(new.score > score, more.ties, ties)
        parts = []
        for one, other in zip((*own[:3], own.lengths), (*new[:3], new.lengths), strict=True):
            assert isinstance(one, Tensor)
            assert isinstance(other, Tensor)
            part = one.clone()
            part[here[takes]] = other[takes].to(one.dtype)
            parts.append(part)
        steps, moments = self.steps.clone(), self.moments.clone()
        steps[here] += more.steps
        moments[here] += more.moments
        decision = Decision(parts[0], parts[1], parts[2], 0, parts[3])
        return _Found(decision, self.ties.scatter(0, here, ties), moments, steps)
