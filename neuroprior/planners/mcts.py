"""Monte Carlo tree search: a tree of plans, extended where plans scored well and where the prior points."""

from typing import Unpack

import torch
from torch import Tensor

from neuroprior.planners.planner import Decision, Objective, PriorPlanner, decide, join_decisions, random_best
from neuroprior.sampling.draws import Draw
from neuroprior.sampling.stepping import Steppable, Stepper, legal_logits
from neuroprior.worlds.world import Rollout, World


class MCTSPlanner(PriorPlanner):
    """Monte Carlo tree search with PUCT, the prior as its policy; batched over starts.

    Each simulation follows a plan. In the tree it takes the action with the greatest Q + U. Q is the mean score of the
    plans that took this action, scaled to [0, 1] by the lowest and highest score from this start so far (of an untried
    action: that of its node); U = c p(a) sqrt(N) / (1 + n(a)), for n(a) tries among N and the prior's p(a)
    (Silver et al. 2017, Methods; Schrittwieser et al. 2020, Appendix B). The first untried action adds a node, and the
    prior draws the rest of the plan. The decision is the best of all simulated plans.

    Nodes keep their states, so that a simulation takes simulator steps only from its new node on; actions after which
    everything has been tried are closed. With a large enough budget it finds the optimum.

    Args:
        prior: the policy.
        length: number of actions in a plan, at least 1.
        num_plans: P, at least 1: simulations end when the next one would exceed P times `length` simulator steps.
        exploration: c >= 0.
        temperature: divides the prior's logits.
        **goal: objective, discount, value, any_prefix: see `Planner`. With `any_prefix` the score of a simulation is
            that of its best prefix.

    Raises:
        ValueError: an argument is out of range. `plan` raises it for a stochastic world.
    """

    def __init__(
        self,
        prior: Steppable,
        length: int,
        num_plans: int,
        *,
        exploration: float = 1.25,
        temperature: float = 1.0,
        **goal: Unpack[Objective],
    ) -> None:
        super().__init__(prior, length, num_plans, temperature=temperature, **goal)
        if not 0 <= exploration < float("inf"):
            raise ValueError(f"exploration: a finite number of at least 0 is expected, not {exploration}")
        self.exploration = exploration

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        if world.stochastic:
            raise ValueError("world: a deterministic one is expected: a node of the tree is one state")
        generator = self._check(world, state, generator)
        # Each node has numbers for each action.
        chunks = self.chunks(state, self.num_plans * self.length * world.num_actions)
        return join_decisions((self._plan(world, some, generator) for some in chunks), len(state))

    @torch.no_grad()
    def _plan(self, world: World, state: Tensor, generator: torch.Generator) -> Decision:
        search = _Search(self, world, state, generator)
        found = [search.simulate(search.unfinished())]
        while len(rows := search.unfinished()):
            found.append(search.simulate(rows))
        plans, score, ends, done = (torch.stack(parts, 1) for parts in zip(*found, strict=True))
        allowed = done[..., None] if self.any_prefix else done
        return decide(plans, score, ends, search.most_steps(), generator, allowed)


class _Search:
    """The trees of B starts, and the simulations in them.

    Attributes:
        child: `[B, M, A]`: the node that an action leads to; 0: none yet (the root, node 0, is no child).
        visits, total: `[B, M, A]`: tries of each action, and the sum of their scores.
        closed: `[B, M, A]`: actions that are not legal, or after which everything has been tried.
        reward: `[B, M]`: of the step into each node.
        state: `[B, M, ...]`: of the world at each node.
        size: `[B]`: nodes so far.
        left: `[B]`: simulator steps that may still be taken.
        over: `[B]`: whether they are too few for the plan that was to be tried next.
    """

    def __init__(self, planner: MCTSPlanner, world: World, state: Tensor, generator: torch.Generator) -> None:
        self.planner, self.world, self.generator = planner, world, generator
        batch, actions = len(state), world.num_actions
        self.draw = Draw(actions, planner.temperature, generator)
        self.stepper = Stepper(planner.prior)
        self.first = self.stepper.start_in(world, state)
        self.child = torch.zeros(batch, 1, actions, dtype=torch.long, device=state.device)
        self.visits = torch.zeros(batch, 1, actions, device=state.device)
        self.total, self.closed = self.visits.double(), self.visits.bool()
        self.reward, self.state = torch.zeros(batch, 1, device=state.device), state[:, None]
        self.size = torch.ones(batch, dtype=torch.long, device=state.device)
        self.steps = planner.num_plans * planner.length
        self.left, self.over = torch.full_like(self.size, self.steps), torch.zeros_like(self.size, dtype=torch.bool)
        self.low, self.high = (self.total.new_full((batch,), sign * torch.inf) for sign in (1, -1))

    def unfinished(self) -> Tensor:
        """The starts whose trees may be extended."""
        return ((self.left > 0) & ~self.over & ~self.closed[:, 0].all(1)).nonzero()[:, 0]

    def most_steps(self) -> int:
        """Simulator steps, of the start that took most."""
        return int((self.steps - self.left).max()) if len(self.left) else 0

    def simulate(self, rows: Tensor) -> tuple[Tensor, ...]:
        """One more plan from the starts `rows [K]`; for all B: plan, score, final state, whether there is a plan."""
        length = self.planner.length
        self._make_room()
        logits, hidden = (part.index_select(0, rows) for part in self.first)
        now, node = self.state[rows, 0], torch.zeros_like(rows)
        inside, alive = (torch.ones_like(rows, dtype=torch.bool) for _ in range(2))
        path: list[Tensor] = []
        columns: tuple[list[Tensor], ...] = ([], [], [])  # actions, rewards and states of each step
        for t in range(length):
            if not self.world.all_legal:
                logits = legal_logits(self.world, now, logits)
                if (logits == -torch.inf).all(1).any():
                    raise ValueError("prior: in some state, all legal actions have probability 0")
                self.closed[rows[inside], node[inside]] |= ~self.world.legal_actions(now)[inside]
            action = self.draw.actions(logits)
            chosen = self._select(rows[inside], node[inside], logits[inside])
            action = action.masked_scatter(inside, chosen)
            path.append(torch.where(inside, node, -1))
            known = inside & (self.child[rows, node, action] > 0)
            # A plan that the budget does not allow to the end is not begun.
            alive &= ~(inside & ~known & (self.left[rows] < length - t))
            now, reward, node = self._move(rows, now, node, action, known, inside & ~known & alive, alive)
            inside = known
            for column, values in zip(columns, (action, reward, now), strict=True):
                column.append(values)
            if t + 1 < length:
                logits, hidden = self.stepper.step_in(self.world, action, hidden, now, length - t - 2)
        self.over[rows[~alive]] = True
        plan, rewards, states = (torch.stack(column, 1) for column in columns)
        rollout = Rollout(states[:, -1], rewards, states if self.planner.any_prefix else None)
        score, ends = self.planner.score_rollout(rollout)
        self._back_up(rows[alive], torch.stack(path, 1)[alive], plan[alive], score[alive])
        found = (plan.to(self.draw.dtype), score, ends, alive)
        batch = len(self.size)
        return tuple(part.new_zeros(batch, *part.shape[1:]).index_copy_(0, rows, part) for part in found)

    def _select(self, rows: Tensor, node: Tensor, logits: Tensor) -> Tensor:
        """The actions that PUCT takes at nodes `[K]`, by the prior's `logits [K, A]`."""
        probs = (logits.double() / self.planner.temperature).softmax(-1)
        visits, total = self.visits[rows, node].double(), self.total[rows, node]
        low, span = self.low[rows, None], (self.high - self.low)[rows, None]
        tries = visits.sum(1, keepdim=True)
        mean = torch.where(visits > 0, total / visits, total.sum(1, keepdim=True) / tries)
        value = torch.where((tries > 0) & (span > 0), (mean - low) / span, 0.5)
        bonus = self.planner.exploration * probs * tries.clamp(min=1).sqrt() / (1 + visits)
        return random_best(value + bonus, self.generator, ~self.closed[rows, node])

    def _move(
        self, rows: Tensor, now: Tensor, node: Tensor, action: Tensor, known: Tensor, fresh: Tensor, alive: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The states, rewards and nodes after an action: those of the tree where `known`, else by a simulator step.

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

    def _back_up(self, rows: Tensor, path: Tensor, plan: Tensor, score: Tensor) -> None:
        """Count plans `[K, L]` and their scores at the nodes of their `path [K, L]` (-1: outside of the tree)."""
        score = (score if score.dim() == 1 else score.amax(1)).double()
        finite = score.isfinite()
        self.low[rows[finite]] = torch.minimum(self.low[rows[finite]], score[finite])
        self.high[rows[finite]] = torch.maximum(self.high[rows[finite]], score[finite])
        # An infinite score counts as the lowest, or highest, finite one so far.
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
        """Double the number of nodes where one more might not fit."""
        if not len(self.size) or int(self.size.max()) < self.child.shape[1]:
            return
        for name in ("child", "visits", "total", "closed", "reward", "state"):
            values = getattr(self, name)
            setattr(self, name, torch.cat([values, torch.zeros_like(values)], 1))
