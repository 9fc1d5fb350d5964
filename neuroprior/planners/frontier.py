"""The frontier planner: plans are extended step by step, and of those that reach the same state one is kept."""

from typing import NamedTuple, Unpack

import torch
from torch import Tensor

from neuroprior._checks import check_flags
from neuroprior._hashing import row_hashes
from neuroprior._random import gumbel
from neuroprior.planners.planner import (
    Candidates,
    Decision,
    Objective,
    PriorPlanner,
    as_floats,
    join_decisions,
    random_best,
)
from neuroprior.plans import action_dtype
from neuroprior.sampling.draws import check_possible
from neuroprior.sampling.states import select_rows
from neuroprior.sampling.stepping import Steppable, Stepper, legal_logits
from neuroprior.worlds.world import World, step_alive


class FrontierPlanner(PriorPlanner):
    """Extends plans by a prior and keeps one plan for each distinct state.

    Plans that reach the same state at the same step have the same continuations, so that all but the best of them are
    wasted. At each step the continuations that the prior holds most probable are tried; of those that reach the same
    state, the one with the highest return so far is kept, with the summed probability of all of them. A decision takes
    no more simulator steps than that of a `SamplingPlanner` with as many plans; the first steps have few continuations,
    and what they leave of the budget is spent on the later ones.

    Where the budget allows all actions in all reachable states, it finds the optimum, whatever the prior. Where not
    every action is legal, and there are fewer legal continuations than the budget allows, the rest of it is spent on
    illegal ones, to no effect.

    Args:
        prior: proposes the continuations.
        length: number of actions in a plan, at least 1.
        num_plans: P, at least 1: P times `length` simulator steps are taken for each start, or a few less.
        noise: draw the continuations without replacement, in proportion to their probability (by Gumbel noise on the
            log-probabilities); else take the most probable ones.
        temperature: divides the prior's logits.
        **goal: objective, discount, value, any_prefix: see `Planner`.

    Raises:
        ValueError: an argument is out of range. `plan` raises it for a stochastic world.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> FrontierPlanner(UniformPrior(4), length=4, num_plans=32).plan(world, torch.tensor([0, 12])).plan.shape
        torch.Size([2, 4])
    """

    def __init__(
        self,
        prior: Steppable,
        length: int,
        num_plans: int,
        *,
        noise: bool = True,
        temperature: float = 1.0,
        **goal: Unpack[Objective],
    ) -> None:
        super().__init__(prior, length, num_plans, temperature=temperature, **goal)
        check_flags(noise=noise)
        self.noise = noise

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        self._require_deterministic(world, "plans that reach the same state are merged")
        planner, generator = self._prepare(world, state, generator)
        widths = self._widths(world.num_actions)
        steps = sum(widths)
        chunks = self.chunks(state, steps)
        if world.max_snapshots is not None:  # of a chunk, those of three steps are used in turn
            chunks = state.split(min(len(chunks[0]) or 1, max(world.max_snapshots // (3 * max(widths)), 1)))
        with self._threads_for(max(map(len, chunks)) * max(widths)):
            return join_decisions((planner._plan(world, chunk, generator, steps) for chunk in chunks), len(state))

    def _widths(self, actions: int) -> list[int]:
        """How many continuations are tried at each step."""
        widths, width, left = [], 1, self.num_plans * self.length
        for t in range(self.length):
            width = min(width * actions, left // (self.length - t))
            widths.append(width)
            left -= width
        return widths

    @torch.no_grad()
    def _plan(self, world: World, state: Tensor, generator: torch.Generator, steps: int) -> Decision:
        batch, stepper = len(state), Stepper(self.prior)
        logits, hidden = stepper.start_in(world, state)
        front = _Front(
            torch.empty(batch, 1, 0, dtype=action_dtype(world.num_actions), device=state.device),
            torch.zeros(batch, 1, dtype=torch.float64, device=state.device),
            torch.empty(batch, 1, 0, device=state.device),
            state,
        )
        decisions = []  # the best plan of each length that a plan may have
        for t, width in enumerate(self._widths(world.num_actions)):
            front, row, action = self._extend(world, front, logits, width, generator)
            if self.any_prefix or t + 1 == self.length:
                decisions.append(self._best(front, generator))
            if t + 1 < self.length:
                rewards = as_floats(front.rewards)
                gained = rewards.double() @ self.discounts(rewards)[:-1].double()
                front = front.merge(gained if self.objective == "return" else None)
                logits, hidden = stepper.step_in(world, action, select_rows(hidden, row), front.state)
        score = torch.stack([decision.score for decision in decisions], 1)
        best = random_best(score, generator)
        row = torch.arange(batch, device=state.device)
        plan, final = (
            torch.stack([getattr(decision, name) for decision in decisions], 1)[row, best]
            for name in ("plan", "final_state")
        )
        candidates = None
        if self.keep_candidates:
            states = front.state.view(*front.log_prob.shape, *front.state.shape[1:])
            kept = self.score(front.rewards, states).masked_fill(front.log_prob == -torch.inf, -torch.inf)
            candidates = Candidates(front.plans, kept)
        return Decision(plan, score[row, best], final, steps, best + 1 if self.any_prefix else None, candidates)

    def _extend(
        self, world: World, front: "_Front", logits: Tensor, width: int, generator: torch.Generator
    ) -> tuple["_Front", Tensor, Tensor]:
        """Try `width` continuations; also the row of the plan that each extends, and its action: `[B * width]`."""
        logits = legal_logits(world, front.state, logits)
        log_prob = _child_log_probs(front.log_prob.view(-1, 1), logits, self.temperature)
        log_prob = log_prob.view(len(front.log_prob), front.log_prob.shape[1] * world.num_actions)
        height = gumbel(log_prob, generator) if self.noise else log_prob
        index = height.topk(width).indices
        row, action = _parents(index, front.log_prob.shape[1], world.num_actions)
        state, reward = step_alive(world, front.state.index_select(0, row), action, generator)
        return front.extend(row, action, log_prob.gather(1, index), state, reward), row, action

    def _best(self, front: "_Front", generator: torch.Generator) -> Decision:
        """The best plan of each start, filled up with zeros."""
        shape = front.log_prob.shape
        states = front.state.view(*shape, *front.state.shape[1:])
        score = self.score(front.rewards, states)
        best = random_best(score, generator, front.log_prob > -torch.inf)
        row = torch.arange(len(best), device=best.device)
        plan = torch.nn.functional.pad(front.plans[row, best], (0, self.length - front.plans.shape[2]))
        return Decision(plan, score[row, best], states[row, best], 0)


class _Front(NamedTuple):
    """The plans so far: K for each of B starts.

    Attributes:
        plans: `[B, K, t]`.
        log_prob: `[B, K]` float64; -inf: there is no such plan.
        rewards: `[B, K, t]`.
        state: `[B * K, ...]`.
    """

    plans: Tensor
    log_prob: Tensor
    rewards: Tensor
    state: Tensor

    def extend(self, row: Tensor, action: Tensor, log_prob: Tensor, state: Tensor, reward: Tensor) -> "_Front":
        """The plans `row [B * K']`, of all B * K, with one more action."""
        shape = (*log_prob.shape, 1)

        def extended(values: Tensor, last: Tensor) -> Tensor:
            before = values.flatten(0, 1).index_select(0, row).view(*log_prob.shape, values.shape[2])
            return torch.cat([before.to(last.dtype), last.view(shape)], -1)

        return _Front(
            extended(self.plans, action.to(self.plans.dtype)), log_prob, extended(self.rewards, reward), state
        )

    def merge(self, gained: Tensor | None) -> "_Front":
        """Of the plans in one state, keep the one with the highest `gained [B, K]`; of equals the most probable one."""
        code = row_hashes(self.state).view_as(self.log_prob)
        # Sorted by state, then by what was gained, then by probability: the first plan of each state stays.
        order = self.log_prob.argsort(dim=1, descending=True, stable=True)
        if gained is not None:
            gained = gained.masked_fill(self.log_prob == -torch.inf, -torch.inf)
            order = order.gather(1, gained.gather(1, order).argsort(dim=1, descending=True, stable=True))
        order = order.gather(1, code.gather(1, order).argsort(dim=1, stable=True))
        sorted_code, prob = code.gather(1, order), self.log_prob.gather(1, order)
        new = torch.ones_like(sorted_code, dtype=torch.bool)
        new[:, 1:] = sorted_code[:, 1:] != sorted_code[:, :-1]
        group = new.cumsum(1) - 1
        # Sums of probabilities relative to the greatest one of each state: none underflows.
        top = torch.full_like(prob, -torch.inf).scatter_reduce_(1, group, prob, "amax")
        rest = (prob - top.gather(1, group)).nan_to_num(-torch.inf, neginf=-torch.inf).exp()
        total = torch.zeros_like(prob).scatter_add_(1, group, rest).log() + top
        log_prob = torch.where(new, total.gather(1, group), -torch.inf)
        return self._replace(log_prob=torch.empty_like(log_prob).scatter_(1, order, log_prob))


def _child_log_probs(log_prob: Tensor, logits: Tensor, temperature: float) -> Tensor:
    """The log-probabilities `[M, A]` of plans of `log_prob [M, 1]` after one more action, by its `logits [M, A]`."""
    child = log_prob + (logits.double() / temperature).log_softmax(-1)
    check_possible(~(child[:, :1].isnan() & (log_prob > -torch.inf)).any())
    # After an impossible prefix a prior may give NaN.
    return torch.where(log_prob > -torch.inf, child, -torch.inf)


def _parents(index: Tensor, beams: int, actions: int) -> tuple[Tensor, Tensor]:
    """The parents of children that were picked by `index [B, K]` from B rows of `beams * actions` children.

    Returns:
        The rows `[B * K]` of the parents among all B * `beams`, and the actions `[B * K]` that lead to the children.
    """
    first = torch.arange(len(index), device=index.device)[:, None] * beams
    return (first + index.div(actions, rounding_mode="floor")).flatten(), (index % actions).flatten()
