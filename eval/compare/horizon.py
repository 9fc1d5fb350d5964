"""The horizon planner: how many actions a plan has, and so how many plans are tried, depends on their scores."""

import warnings
from typing import NamedTuple, Unpack

import torch
from torch import Tensor
from torch.nn.functional import pad

from neuroprior._checks import check_sizes, is_number
from neuroprior.planners.planner import Decision, Objective, decide, join_decisions
from neuroprior.planners.sampling import SamplingPlanner
from neuroprior.sampling.stepping import Steppable
from neuroprior.worlds.world import World

POOLED = 4.0
"""The scores from all starts together count as so many of each start's own."""

QUANTILES = 16
"""Quantiles over which the mean of the best of several scores is taken."""


class HorizonPlanner(SamplingPlanner):
    """Chooses a horizon for each start: few long plans, or many short ones, for as many simulator steps.

    Plans may end after any of their actions. First some plans of the greatest length are drawn; their prefixes give the
    scores at each shorter horizon. Then, round after round, the horizon with the greatest expected improvement for the
    remaining steps is chosen: where the scores of plans of d actions have a large variance, the best of many more is
    likely to beat the best so far (the value of information, Dearden et al. 1999; uncertainty as the arbiter of how far
    to plan, Daw et al. 2005). Scores at a horizon are modelled as normal, with the mean and variance of those from this
    start, pooled a little with those from the other starts of the batch. Where no improvement is expected, plans have
    the greatest length.

    Not for worlds in which actions only cost (a reward of -1 a step until the goal, say), with the objective "return":
    as a plan may end after any action, and ends where its return is highest, the best plan is then the one that stops
    at once. `plan` warns where it meets that. Give a `value` of the state in which a plan ends, such as minus the cost
    still to come; or add a constant to the rewards; or take a planner of a fixed length, such as `SamplingPlanner`.

    Args:
        prior: proposes the candidates.
        length: the longest horizon, at least 1.
        num_plans: the budget of each start is the steps of so many plans of `length` actions; a few may be left.
        pilot: the share of the plans that is drawn first, with `length` actions; above 0, at most 1.
        rounds: in which the rest of the budget is spent; at most as many as there are plans left.
        num_rollouts: see `SamplingPlanner`.
        temperature: divides the prior's logits.
        **goal: objective, discount, value: see `Planner`; `any_prefix` is True.

    Raises:
        ValueError: an argument is out of range.

    Warns:
        UserWarning: of `plan`, where each further action of all plans that were tried first only cost.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> HorizonPlanner(UniformPrior(4), length=8, num_plans=64).plan(world, torch.tensor([0, 12])).score.shape
        torch.Size([2])
    """

    def __init__(
        self,
        prior: Steppable,
        length: int,
        num_plans: int,
        *,
        pilot: float = 0.5,
        rounds: int = 3,
        num_rollouts: int = 1,
        temperature: float = 1.0,
        **goal: Unpack[Objective],
    ) -> None:
        if not goal.setdefault("any_prefix", True):
            raise ValueError("any_prefix: this planner chooses among all prefixes; leave it out")
        super().__init__(
            prior, length, num_plans, num_rollouts=num_rollouts, halving=False, temperature=temperature, **goal
        )
        check_sizes(rounds=rounds)
        if not is_number(pilot) or not 0 < pilot <= 1:
            raise ValueError(f"`pilot` must be a share above 0 and at most 1, got {pilot!r}")
        self.first = max(round(pilot * num_plans), 1)
        self.rounds = min(rounds, num_plans - self.first)

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        _, generator = self._prepare(world, state, generator)
        chunks = self.chunks(state, self.model_steps(world))
        return join_decisions((self._plan(world, chunk, generator) for chunk in chunks), len(state))

    def _plan(self, world: World, state: Tensor, generator: torch.Generator) -> Decision:
        outcome = self._try(world, state, self.length, self.first, generator)
        left = (self.num_plans - self.first) * self.length
        for k in range(self.rounds):
            share = left // (self.rounds - k)
            horizon = self._best_horizon(outcome, left)
            left -= share
            for depth in horizon.unique().tolist():
                rows = (horizon == depth).nonzero()[:, 0]
                more = self._try(world, state[rows], depth, share // depth, generator)
                outcome = outcome.join(rows, more, generator)
        return outcome.decision._replace(model_steps=int(outcome.steps.max()) if len(state) else 0)

    def _try(self, world: World, state: Tensor, depth: int, number: int, generator: torch.Generator) -> "_Outcome":
        """Try `number` plans of `depth` actions from each start."""
        rollouts, temperature = self.num_rollouts, self.temperature
        sampler = SamplingPlanner(
            self.prior, depth, number, num_rollouts=rollouts, temperature=temperature, **self.goal
        )
        plans, score, ends = sampler.candidates(world, state, generator)
        if depth == self.length:
            self._warn_of_costs(world, score)
        best = decide(plans, score, ends, 0, generator)
        # At each horizon the score of a plan is that of its best prefix so far.
        so_far = score.double().cummax(2).values
        moments = torch.stack([torch.full_like(so_far, 1.0), so_far, so_far**2], -1).sum(1)
        ties = (score == best.score[:, None, None]).sum((1, 2))
        longer = self.length - depth
        steps = torch.full_like(ties, sampler.model_steps(world))
        return _Outcome(best._replace(plan=pad(best.plan, (0, longer))), ties, pad(moments, (0, 0, 0, longer)), steps)

    def _warn_of_costs(self, world: World, score: Tensor) -> None:
        """Warn where the `score [B, P, L]` of all prefixes only ever falls, so that each plan stops at once."""
        if (
            self.for_world(world).objective != "return"
            or self.value is not None
            or self.length == 1
            or not score.numel()
        ):
            return
        if bool((score.diff(dim=2) <= 0).all()) and bool((score[..., -1] < score[..., 0]).any()):
            warnings.warn(
                "HorizonPlanner: each further action of all plans that were tried only costs, so that the best plan"
                " stops after the first; give a value of the state in which a plan ends, or take a planner of a fixed"
                " length",
                stacklevel=5,
            )

    def _best_horizon(self, outcome: "_Outcome", left: int) -> Tensor:
        """The horizon `[B]` with the greatest expected improvement for `left` more steps; of equals the longest."""
        moments = outcome.moments + POOLED * outcome.moments.sum(0) / outcome.moments.sum(0)[:, :1].clamp(min=1)
        number, total, squares = moments.unbind(-1)
        mean = total / number
        spread = (squares / number - mean**2).clamp(min=0).sqrt()
        depth = torch.arange(1, self.length + 1, device=mean.device)
        # There are not more different plans than this.
        tries = (left // depth).double().minimum(self.prior.num_actions ** depth.double())
        share = (torch.arange(QUANTILES, device=mean.device, dtype=torch.float64) + 0.5) / QUANTILES
        # The best of n scores is below x with probability q where each of them is with probability q ** (1 / n).
        above = -torch.expm1(share.log() / tries[:, None])
        best = mean[..., None] - spread[..., None] * torch.special.ndtri(above)
        gain = (best - outcome.decision.score.double()[:, None, None]).clamp(min=0).mean(-1).nan_to_num(0.0, 0.0)
        longest_first: Tensor = gain.flip(1).argmax(1)
        return self.length - longest_first


class _Outcome(NamedTuple):
    """The candidates from B starts so far.

    Attributes:
        decision: the best of them.
        ties: `[B]`: how many of them are as good as that one, itself included.
        moments: `[B, L, 3]`: of the scores at each horizon: their number, sum, and sum of squares.
        steps: `[B]`: simulator steps taken.
    """

    decision: Decision
    ties: Tensor
    moments: Tensor
    steps: Tensor

    def join(self, rows: Tensor, more: "_Outcome", generator: torch.Generator) -> "_Outcome":
        """Together with `more` from the starts `rows`; among equally good candidates the choice stays uniform."""
        old, new = self.decision, more.decision
        score = old.score[rows]
        ties = torch.where(new.score == score, self.ties[rows] + more.ties, self.ties[rows])
        draw = torch.rand(len(rows), generator=generator, device=rows.device)
        takes = (new.score > score) | ((new.score == score) & (draw * ties < more.ties))
        ties = torch.where(new.score > score, more.ties, ties)
        parts = []
        for one, other in zip((*old[:3], old.lengths), (*new[:3], new.lengths), strict=True):
            assert isinstance(one, Tensor)
            assert isinstance(other, Tensor)
            merged = one.clone()
            merged[rows[takes]] = other[takes].to(one.dtype)
            parts.append(merged)
        steps, moments = self.steps.clone(), self.moments.clone()
        steps[rows] += more.steps
        moments[rows] += more.moments
        decision = Decision(parts[0], parts[1], parts[2], 0, parts[3])
        return _Outcome(decision, self.ties.scatter(0, rows, ties), moments, steps)
