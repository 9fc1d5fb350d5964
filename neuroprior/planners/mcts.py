"""Monte Carlo tree search: a tree of plans that grows where plans scored well and where the prior points."""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.planners.planner import Decision, Planner, decide, in_chunks, random_best
from neuroprior.priors.prior import Prior
from neuroprior.sampling.ancestral import advance, check_in_world, start_in_world
from neuroprior.sampling.draws import Draw, check_temperature
from neuroprior.worlds.world import Rollout, World


class MCTSPlanner(Planner):
    """Monte Carlo tree search with PUCT, the prior as its policy; batched over starts.

    Each simulation follows a plan. In the tree it takes the action with the greatest Q + U: Q is the mean score of the
    plans that went on so, between 0 and 1 by the least and greatest score that this start has seen (of an action not
    tried yet: that of its node), and U = c p(a) sqrt(N) / (1 + n(a)), of n(a) tries among N and the prior's p(a)
    (Silver et al. 2017, Methods; Schrittwieser et al. 2020, Appendix B). At the first action that was not tried yet a
    node is added, and the prior draws the rest of the plan. The best of all plans that were followed is decided for.

    States in the tree are remembered, so that a simulation takes steps of the world only from its new node on; and what
    has been tried completely is not entered again. With enough steps it finds what the oracle does.

    Args:
        prior: the policy.
        length: number of actions in a plan, at least 1.
        num_plans: P, at least 1: simulations go on until they would take more than P times `length` steps of the world.
        exploration: c >= 0.
        objective, discount, value, any_prefix: see `Planner`. With `any_prefix` a simulation counts as its best prefix.
        temperature: divides the prior's logits.

    Raises:
        ValueError: an argument is out of range. `plan` raises it for a world with chance.
    """

    def __init__(
        self,
        prior: Prior,
        length: int,
        num_plans: int,
        *,
        exploration: float = 1.25,
        objective: Literal["terminal", "return"] = "terminal",
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
        any_prefix: bool = False,
        temperature: float = 1.0,
    ) -> None:
        super().__init__(objective, discount, value, any_prefix)
        check_sizes(length=length, num_plans=num_plans)
        check_temperature(temperature)
        if not 0 <= exploration < float("inf"):
            raise ValueError(f"exploration: a finite number of at least 0 is expected, not {exploration}")
        self.prior, self.length, self.num_plans = prior, length, num_plans
        self.exploration, self.temperature = exploration, temperature

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        if world.stochastic:
            raise ValueError("world: one without chance is expected: a node of the tree is one state")
        check_in_world(self.prior, world, state)
        generator = generator_on(generator, state.device)
        # Each node has numbers for each action.
        size = self.num_plans * self.length * world.num_actions
        return in_chunks(lambda some: self._plan(world, some, generator), state, size)

    @torch.no_grad()
    def _plan(self, world: World, state: Tensor, generator: torch.Generator) -> Decision:
        search = _Search(self, world, state, generator)
        found = [search.simulate(search.unfinished())]
        while len(rows := search.unfinished()):
            found.append(search.simulate(rows))
        plans, score, ends, there = (torch.stack(parts, 1) for parts in zip(*found, strict=True))
        return decide(
            plans, score, ends, search.most_steps(), generator, there[..., None] if self.any_prefix else there
        )


class _Search:
    """The trees of B starts, and the simulations in them.

    Attributes:
        child: `[B, M, A]`: the node that an action leads to; 0: none yet (the root, node 0, is nobody's child).
        visits, total: `[B, M, A]`: tries of each action, and the sum of their scores.
        closed: `[B, M, A]`: actions that do not exist, or after which everything has been tried.
        reward: `[B, M]`: on the way into each node.
        state: `[B, M, ...]`: of the world at each node.
        size: `[B]`: nodes so far.
        left: `[B]`: steps of the world that may be taken.
    """

    def __init__(self, planner: MCTSPlanner, world: World, state: Tensor, generator: torch.Generator) -> None:
        self.planner, self.world, self.generator = planner, world, generator
        batch, actions = len(state), world.num_actions
        self.draw = Draw(actions, planner.temperature, generator)
        self.first = start_in_world(planner.prior, world, state)
        self.child = torch.zeros(batch, 1, actions, dtype=torch.long, device=state.device)
        self.visits = torch.zeros(batch, 1, actions, device=state.device)
        self.total, self.closed = self.visits.double(), self.visits.bool()
        self.reward, self.state = torch.zeros(batch, 1, device=state.device), state[:, None]
        self.size = torch.ones(batch, dtype=torch.long, device=state.device)
        self.steps = planner.num_plans * planner.length
        self.left = torch.full_like(self.size, self.steps)
        self.low, self.high = (self.total.new_full((batch,), sign * torch.inf) for sign in (1, -1))

    def unfinished(self) -> Tensor:
        """The starts whose trees may grow."""
        return ((self.left > 0) & ~self.closed[:, 0].all(1)).nonzero()[:, 0]

    def most_steps(self) -> int:
        """The steps that were taken for the start that took most."""
        return int((self.steps - self.left).max()) if len(self.left) else 0

    def simulate(self, rows: Tensor) -> tuple[Tensor, ...]:
        """One more plan of the starts `rows [K]`: for all B plan, score and end, and where there is one."""
        length, prior = self.planner.length, self.planner.prior
        self._make_room()
        logits, memory = (part.index_select(0, rows) for part in self.first)
        now, node = self.state[rows, 0], torch.zeros_like(rows)
        inside, alive = (torch.ones_like(rows, dtype=torch.bool) for _ in range(2))
        path: list[Tensor] = []
        columns: tuple[list[Tensor], ...] = ([], [], [])  # actions, rewards and states after each step
        for t in range(length):
            if not self.world.all_legal:
                legal = self.world.legal_actions(now)
                logits = logits.masked_fill(~legal, -torch.inf)
                if (logits == -torch.inf).all(1).any():
                    raise ValueError("prior: it gives none of the actions that exist somewhere a probability above 0")
                self.closed[rows[inside], node[inside]] |= ~legal[inside]
            action = self.draw.actions(logits, self.draw.uniform((len(rows),), logits))
            chosen = self._selected(rows[inside], node[inside], logits[inside])
            action = action.masked_scatter(inside, chosen)
            path.append(torch.where(inside, node, -1))
            known = inside & (self.child[rows, node, action] > 0)
            # A plan that could not be followed to its end is not begun.
            alive &= ~(inside & ~known & (self.left[rows] < length - t))
            now, reward, node = self._moved(rows, now, node, action, known, inside & ~known & alive, alive)
            inside = known
            for column, what in zip(columns, (action, reward, now), strict=True):
                column.append(what)
            if t + 1 < length:
                seen = self.world.observe(now) if prior.context_per == "step" else None
                logits, memory = advance(prior, action, memory, seen, length - t - 2)
        self.left[rows[~alive]] = 0
        plan, gained, course = (torch.stack(column, 1) for column in columns)
        score, ends = self.planner.scored(Rollout(course[:, -1], gained, course if self.planner.any_prefix else None))
        self._learn(rows[alive], torch.stack(path, 1)[alive], plan[alive], score[alive])
        found = (plan.to(self.draw.dtype), score, ends, alive)
        batch = len(self.size)
        return tuple(part.new_zeros(batch, *part.shape[1:]).index_copy_(0, rows, part) for part in found)

    def _selected(self, rows: Tensor, node: Tensor, logits: Tensor) -> Tensor:
        """The actions that PUCT takes at nodes `[K]` where the prior gives `logits [K, A]`."""
        probs = (logits.double() / self.planner.temperature).softmax(-1)
        visits, total = self.visits[rows, node].double(), self.total[rows, node]
        low, span = self.low[rows, None], (self.high - self.low)[rows, None]
        tries = visits.sum(1, keepdim=True)
        mean = torch.where(visits > 0, total / visits, total.sum(1, keepdim=True) / tries)
        value = torch.where((tries > 0) & (span > 0), (mean - low) / span, 0.5)
        urge = self.planner.exploration * probs * tries.clamp(min=1).sqrt() / (1 + visits)
        return random_best(value + urge, self.generator, ~self.closed[rows, node])

    def _moved(
        self, rows: Tensor, now: Tensor, node: Tensor, action: Tensor, known: Tensor, fresh: Tensor, alive: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The states, rewards and nodes after an action: remembered where `known`, else a step of the world away.

        Where `fresh`, a node is added. Rows that are not `alive` stay where they are.
        """
        go = alive & ~known
        after, node = now.clone(), torch.where(known, self.child[rows, node, action], node)
        reward = torch.where(known, self.reward[rows, node], 0)
        after[known] = self.state[rows[known], node[known]]
        if go.any():
            after[go], gained = self.world.step(now[go], action[go], self.generator)
            self.reward = self.reward.to(gained.dtype)
            reward = reward.to(gained.dtype).masked_scatter(go, gained)
            self.left[rows[go]] -= 1
        at, old = rows[fresh], node[fresh]
        new = self.size[at]
        self.child[at, old, action[fresh]] = new
        self.state[at, new], self.reward[at, new] = after[fresh], reward[fresh]
        self.size[at] += 1
        return after, reward, node.masked_scatter(fresh, new)

    def _learn(self, rows: Tensor, path: Tensor, plan: Tensor, score: Tensor) -> None:
        """Count plans `[K, L]` and their scores at the nodes `path [K, L]` (-1: outside of the tree) they went by."""
        score = (score if score.dim() == 1 else score.amax(1)).double()
        finite = score.isfinite()
        self.low[rows[finite]] = torch.minimum(self.low[rows[finite]], score[finite])
        self.high[rows[finite]] = torch.maximum(self.high[rows[finite]], score[finite])
        # An infinite score counts as the worst, or best, of all others so far.
        extreme = torch.where(score > 0, self.high[rows], self.low[rows])
        score = torch.where(finite, score, extreme.nan_to_num(0, 0, 0))
        finished = torch.ones_like(rows, dtype=torch.bool)
        for t in reversed(range(plan.shape[1])):
            inside = path[:, t] >= 0
            at = rows[inside], path[inside, t], plan[inside, t]
            self.visits[at] += 1
            self.total[at] += score[inside]
            self.closed[at] |= finished[inside]
            finished = torch.zeros_like(finished).masked_scatter(inside, self.closed[at[:2]].all(1))

    def _make_room(self) -> None:
        """Twice as many nodes, where one more might not fit."""
        if not len(self.size) or int(self.size.max()) < self.child.shape[1]:
            return
        for name in ("child", "visits", "total", "closed", "reward", "state"):
            values = getattr(self, name)
            setattr(self, name, torch.cat([values, torch.zeros_like(values)], 1))
