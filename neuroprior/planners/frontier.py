"""The frontier planner: plans grow step by step, and of those that lead to the same state one goes on."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._hashing import row_hashes
from neuroprior._random import generator_on, gumbel
from neuroprior.planners.planner import Decision, Planner, in_chunks, random_best
from neuroprior.plans import action_dtype
from neuroprior.priors.prior import Prior
from neuroprior.sampling.ancestral import advance, check_in_world, start_in_world
from neuroprior.sampling.beams import children, origins
from neuroprior.sampling.draws import check_temperature
from neuroprior.worlds.world import World


class FrontierPlanner(Planner):
    """Grows plans from a prior and keeps distinct states only.

    Plans that differ but pass through the same state at the same step go on alike, so that all but the best of them are
    wasted. At each step those continuations are tried that the prior holds most probable; of those that lead to the
    same state the one that has gained most goes on, with the probability of all of them together. A decision takes no
    more steps of the world than that of a `SamplingPlanner` with as many plans; what the first steps, where there is
    little to try, leave of them is for the later ones.

    Where it may try all actions in all states that can be reached, it finds what the oracle does, whatever the prior.
    Where not every action exists and fewer can be tried than it may, others are tried as if they existed, for nothing.

    Args:
        prior: what proposes.
        length: number of actions in a plan, at least 1.
        num_plans: P, at least 1: P times `length` steps of the world are taken for each start, or a few less.
        objective, discount, value, any_prefix: see `Planner`.
        temperature: divides the prior's logits.
        noise: continuations are chosen at random, one after another in proportion to their probability (by Gumbel
            noise on its logarithm); else the most probable ones are.

    Raises:
        ValueError: an argument is out of range. `plan` raises it for a world with chance.
    """

    def __init__(
        self,
        prior: Prior,
        length: int,
        num_plans: int,
        *,
        objective: Literal["terminal", "return"] = "terminal",
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
        any_prefix: bool = False,
        temperature: float = 1.0,
        noise: bool = True,
    ) -> None:
        super().__init__(objective, discount, value, any_prefix)
        check_sizes(length=length, num_plans=num_plans)
        check_temperature(temperature)
        self.prior, self.length, self.num_plans = prior, length, num_plans
        self.temperature, self.noise = temperature, noise

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        if world.stochastic:
            raise ValueError("world: one without chance is expected: plans that meet in a state are taken for one")
        check_in_world(self.prior, world, state)
        generator = generator_on(generator, state.device)
        steps = sum(self._widths(world.num_actions))
        return in_chunks(lambda some: self._plan(world, some, generator, steps), state, steps)

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
        batch = len(state)
        logits, memory = start_in_world(self.prior, world, state)
        front = _Front(
            torch.empty(batch, 1, 0, dtype=action_dtype(world.num_actions), device=state.device),
            torch.zeros(batch, 1, dtype=torch.float64, device=state.device),
            torch.empty(batch, 1, 0, device=state.device),
            state,
        )
        ends = []
        for t, width in enumerate(self._widths(world.num_actions)):
            front, row, action = self._tried(world, front, logits, width, generator)
            if self.any_prefix or t + 1 == self.length:
                score = self.score(front.rewards, front.state.view(*front.rewards.shape[:2], *state.shape[1:]))
                ends.append(_best(front, score, generator, self.length))
            if t + 1 < self.length:
                gained = front.rewards.double() @ self._weights(front.rewards).double()
                front = front.merged(gained if self.objective == "return" else None)
                seen = world.observe(front.state) if self.prior.context_per == "step" else None
                logits, memory = advance(self.prior, action, memory.index_select(0, row), seen)
        return self._decided(ends, generator, steps)

    def _tried(
        self, world: World, front: "_Front", logits: Tensor, width: int, generator: torch.Generator
    ) -> tuple["_Front", Tensor, Tensor]:
        """The continuations that are tried, and of each, in one line, which row it goes on from and by which action."""
        if not world.all_legal:
            logits = logits.masked_fill(~world.legal_actions(front.state), -torch.inf)
        log_prob = children(front.log_prob.view(-1, 1), logits, self.temperature)
        log_prob = log_prob.view(len(front.log_prob), front.log_prob.shape[1] * world.num_actions)
        height = gumbel(log_prob, generator) if self.noise else log_prob
        index = height.topk(width).indices
        row, action = origins(index, front.log_prob.shape[1], world.num_actions)
        state, reward = world.step(front.state.index_select(0, row), action, generator)
        return front.gone_on(row, action, log_prob.gather(1, index), state, reward), row, action

    def _decided(self, ends: list[Decision], generator: torch.Generator, steps: int) -> Decision:
        """The best of what was found at each length."""
        score = torch.stack([end.score for end in ends], 1)
        best = random_best(score, generator)
        row = torch.arange(len(best), device=best.device)
        plan, final = (
            torch.stack([getattr(end, what) for end in ends], 1)[row, best] for what in ("plan", "final_state")
        )
        lengths = best + 1 if self.any_prefix else None
        return Decision(plan, score[row, best], final, steps, lengths)


class _Front(NamedTuple):
    """The plans so far: B starts, K plans of each.

    Attributes:
        plans: `[B, K, t]`.
        log_prob: `[B, K]` float64; -inf: nothing stands here.
        rewards: `[B, K, t]`.
        state: `[B * K, ...]`.
    """

    plans: Tensor
    log_prob: Tensor
    rewards: Tensor
    state: Tensor

    def gone_on(self, row: Tensor, action: Tensor, log_prob: Tensor, state: Tensor, reward: Tensor) -> "_Front":
        """With one more action, of rows `row [B * K']` of the B * K."""
        shape = (*log_prob.shape, 1)
        plans = torch.cat([_rows(self.plans, row, shape), action.view(shape).to(self.plans.dtype)], -1)
        rewards = torch.cat([_rows(self.rewards, row, shape).to(reward.dtype), reward.view(shape)], -1)
        return _Front(plans, log_prob, rewards, state)

    def merged(self, gained: Tensor | None) -> "_Front":
        """Of plans in one state that which has `gained [B, K]` most, else the most probable, stands for all of them."""
        code = row_hashes(self.state).view_as(self.log_prob)
        # By state, then by what was gained, then by probability: the first of each state stands for it.
        order = self.log_prob.argsort(dim=1, descending=True, stable=True)
        if gained is not None:
            gained = gained.masked_fill(self.log_prob == -torch.inf, -torch.inf)
            order = order.gather(1, gained.gather(1, order).argsort(dim=1, descending=True, stable=True))
        order = order.gather(1, code.gather(1, order).argsort(dim=1, stable=True))
        sorted_code, prob = code.gather(1, order), self.log_prob.gather(1, order)
        new = torch.ones_like(sorted_code, dtype=torch.bool)
        new[:, 1:] = sorted_code[:, 1:] != sorted_code[:, :-1]
        group = new.cumsum(1) - 1
        # Sums of probabilities relative to the greatest of each state, of which none underflows.
        top = torch.full_like(prob, -torch.inf).scatter_reduce_(1, group, prob, "amax")
        rest = (prob - top.gather(1, group)).nan_to_num(-torch.inf, neginf=-torch.inf).exp()
        total = torch.zeros_like(prob).scatter_add_(1, group, rest).log() + top
        log_prob = torch.where(new, total.gather(1, group), -torch.inf)
        return self._replace(log_prob=torch.empty_like(log_prob).scatter_(1, order, log_prob))


def _best(front: _Front, score: Tensor, generator: torch.Generator, length: int) -> Decision:
    """The best plan of each start, filled up with zeros."""
    best = random_best(score, generator, front.log_prob > -torch.inf)
    row = torch.arange(len(best), device=best.device)
    plan = torch.nn.functional.pad(front.plans[row, best], (0, length - front.plans.shape[2]))
    return Decision(plan, score[row, best], front.state.view(*score.shape, *front.state.shape[1:])[row, best], 0)


def _rows(values: Tensor, row: Tensor, shape: tuple[int, ...]) -> Tensor:
    return values.flatten(0, 1).index_select(0, row).view(*shape[:2], values.shape[2])
