"""Monte Carlo tree search: a tree of plans, extended where plans scored well and where the prior points."""

from typing import Any, Unpack

import torch
from torch import Tensor

from neuroprior._checks import is_number
from neuroprior._compiled import compiled
from neuroprior.planners.planner import Decision, Objective, PriorPlanner, decide, join_decisions, random_best
from neuroprior.sampling.draws import Draw
from neuroprior.sampling.stepping import Steppable, Stepper, legal_logits
from neuroprior.worlds.world import Rollout, World

PER_ACTION = 64
"""So many numbers of a prior's state count as one action where memory is planned: states are kept only at nodes that
are made, and few of the nodes that there is room for are.
"""


class MCTSPlanner(PriorPlanner):
    """Monte Carlo tree search with PUCT, the prior as its policy; batched over starts.

    Each simulation follows a plan. In the tree it takes the action with the greatest Q + U. Q is the mean score of the
    plans that took this action, scaled to [0, 1] by the lowest and highest score from this start so far (of an untried
    action: that of its node); U = c p(a) sqrt(N) / (1 + n(a)), for n(a) tries among N and the prior's p(a)
    (Silver et al. 2017, Methods; Schrittwieser et al. 2020, Appendix B). The first untried action adds a node, and the
    prior draws the rest of the plan. The decision is the best of all simulated plans.

    Nodes keep their states, those of the prior and its probabilities, so that a simulation steps the world and the
    prior only from its new node on; actions after which everything has been tried are closed. With a large enough
    budget it finds the optimum.

    Args:
        prior: the policy.
        length: number of actions in a plan, at least 1.
        num_plans: P, at least 1: simulations end when the next one would exceed P times `length` simulator steps.
        exploration: c >= 0.
        temperature: divides the prior's logits.
        compile: search by compiled loops where numba is installed, on the CPU: the whole search in a deterministic
            `TabularWorld` where all actions are legal, without `value`, with a prior that is uniform, counts histories
            or is a GRU; otherwise selection and backup alone. They find the same, but for rounding.
        **goal: objective, discount, value, any_prefix: see `Planner`. With `any_prefix` the score of a simulation is
            that of its best prefix.

    Raises:
        ValueError: an argument is out of range. `plan` raises it for a stochastic world.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> MCTSPlanner(UniformPrior(4), length=4, num_plans=32).plan(world, torch.tensor([0, 12])).plan.shape
        torch.Size([2, 4])
    """

    def __init__(
        self,
        prior: Steppable,
        length: int,
        num_plans: int,
        *,
        exploration: float = 1.25,
        temperature: float = 1.0,
        compile: bool = True,
        **goal: Unpack[Objective],
    ) -> None:
        super().__init__(prior, length, num_plans, temperature=temperature, **goal)
        if not is_number(exploration) or not 0 <= exploration < float("inf"):
            raise ValueError(f"exploration: a finite number of at least 0 is expected, not {exploration!r}")
        self.exploration, self.compile = exploration, compile

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        if world.stochastic:
            raise ValueError("world: a deterministic one is expected: a node of the tree is one state")
        generator = self._check(world, state, generator)
        able = self.compile and state.device.type == "cpu"
        module = compiled("neuroprior.planners.compiled_mcts") if able else None
        numbers = world.num_actions  # that each node has
        if module is None or not module.can_search(self, world, state):
            numbers = max(numbers, self._state_size(world, state) // PER_ACTION)
        chunks = self.chunks(state, self.num_plans * self.length * numbers)
        return join_decisions((self._plan(module, world, some, generator) for some in chunks), len(state))

    @torch.no_grad()
    def _state_size(self, world: World, state: Tensor) -> int:
        """Numbers in the largest state of the prior in a tree: states may grow, by as much with each action."""
        stepper, now = Stepper(self.prior, in_place=False), state[:1]
        before = stepper.start_in(world, now)[1]
        if before.numel() == 0 or self.length == 1:
            return before.numel()
        after = stepper.step_in(world, torch.zeros(1, dtype=torch.long, device=state.device), before, now)[1]
        return before.numel() + max(after.numel() - before.numel(), 0) * (self.length - 1)

    @torch.no_grad()
    def _plan(self, module: Any, world: World, state: Tensor, generator: torch.Generator) -> Decision:
        if module is not None and module.can_search(self, world, state):
            *found, steps = module.search_all(self, world, state, generator)
        else:
            with self._threads_for(len(state)):
                *found, steps = _Trees(self, module, world, state, generator).search()
        plans, rewards, states, done = found
        rollout = Rollout(states[:, :, -1], rewards, states if self.any_prefix else None)
        score, ends = self.score_rollout(rollout)
        return decide(plans, score, ends, steps, generator, done[..., None] if self.any_prefix else done)


class _Trees:
    """The trees of B starts, and the simulations in them, in any world and with any prior.

    Attributes:
        child: `[B, M, A]`: the node that an action leads to; 0: none yet (the root, node 0, is no child).
        visits, total: `[B, M, A]`: tries of each action, and the sum of their scores.
        closed: `[B, M, A]`: actions that are not legal, or after which everything has been tried.
        probs: `[B, M, A]`: the prior's.
        reward: `[B, M]`: of the step into each node.
        state: `[B, M, ...]`: of the world at each node.
        place: `[B, M]`: where the prior's state at each node is, in `kept`.
        kept: at each depth the prior's states at the nodes there, `[room, ...]`: the states of some priors grow.
        size: `[B]`: nodes so far.
        left: `[B]`: simulator steps that may still be taken.
        over: `[B]`: whether they are too few for the plan that was to be tried next.
        low, high: `[B]`: the lowest and the highest finite score.
    """

    def __init__(
        self, planner: MCTSPlanner, module: Any, world: World, state: Tensor, generator: torch.Generator
    ) -> None:
        self.planner, self.world, self.generator = planner, world, generator
        batch, actions = len(state), world.num_actions
        self.draw = Draw(actions, planner.temperature, generator)
        self.stepper = Stepper(planner.prior, in_place=False)
        self.logits, hidden = self.stepper.start_in(world, state)
        # The loop draws as many numbers as are needed at most: of one type, so that it can give back what is left.
        self.module: Any = module if self.logits.dtype == torch.float32 else None
        self.child = torch.zeros(batch, 1, actions, dtype=torch.long, device=state.device)
        self.visits, self.closed = self.child.int(), self.child.bool()
        self.total, self.probs = self.child.double(), self.child.double()
        self.reward, self.state = torch.zeros(batch, 1, device=state.device), state[:, None]
        self.size = torch.ones(batch, dtype=torch.long, device=state.device)
        self.steps = planner.num_plans * planner.length
        self.left, self.over = torch.full_like(self.size, self.steps), torch.zeros_like(self.size, dtype=torch.bool)
        self.low, self.high = (self.total.new_full((batch,), sign * torch.inf) for sign in (1, -1))
        self.kept, self.used = [hidden[:0]] * planner.length, [0] * planner.length
        self.place = torch.zeros(batch, 1, dtype=torch.long, device=state.device)
        every = torch.arange(batch, device=state.device)
        self._keep(every, torch.zeros_like(every), 0, self._legal(state, self.logits), hidden)

    def search(self) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
        """Simulate until the budget is spent, or all has been tried.

        Returns:
            Of all simulations the plans `[B, N, L]`, the reward of each step and the state after it, and whether there
            is a plan, `[B, N]`; and the simulator steps of the start that took most. Unless any prefix may win, there
            are only the states at the end: `[B, N, 1, ...]`.
        """
        found = list[tuple[Tensor, ...]]()
        while len(rows := self.unfinished()) or not found:
            found.append(self.simulate(rows))
        plans, rewards, states, done = (torch.stack(parts, 1) for parts in zip(*found, strict=True))
        return plans, rewards, states, done, int((self.steps - self.left).max()) if len(self.left) else 0

    def unfinished(self) -> Tensor:
        """The starts whose trees may be extended."""
        return ((self.left > 0) & ~self.over & ~self.closed[:, 0].all(1)).nonzero()[:, 0]

    def simulate(self, rows: Tensor) -> tuple[Tensor, ...]:
        """One more plan from the starts `rows [K]`; for all B: plan, rewards, states, whether there is a plan."""
        self._make_room()
        path, plan, depth, uniform = (self._descend if self.module is None else self._descend_compiled)(rows)
        # A plan that the budget does not allow to the end is not begun.
        alive = self.left[rows] >= self.planner.length - depth
        self.over[rows[~alive]] = True
        rows, path, plan, depth, uniform = rows[alive], path[alive], plan[alive], depth[alive], uniform[alive]
        rewards, states = self._follow(rows, path, plan, depth, uniform)
        kept = states if self.planner.any_prefix else states[:, -1:]
        score, _ = self.planner.score_rollout(
            Rollout(states[:, -1], rewards, states if self.planner.any_prefix else None)
        )
        self._back_up(rows, path, plan, (score if score.dim() == 1 else score.amax(1)).double())
        found = (plan.to(self.draw.dtype), rewards, kept, torch.ones_like(rows, dtype=torch.bool))
        batch = len(self.size)
        # Where there is no plan, states are those of the starts: values are asked for all.
        empty = [part.new_zeros(batch, *part.shape[1:]) for part in found]
        empty[2] = self.state[:, :1].expand(empty[2].shape[:2] + self.state.shape[2:]).clone()
        return tuple(whole.index_copy_(0, rows, part) for whole, part in zip(empty, found, strict=True))

    def _descend(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Follow PUCT in the trees of `rows [K]` down to an action that was not tried yet.

        Returns:
            The nodes on the way, `[K, L]` (-1 beyond), the actions up to that one `[K, L]`, how many come before it
            `[K]`, and uniform numbers `[K, L]` to draw the rest of the plan with.
        """
        length = self.planner.length
        node, depth = torch.zeros_like(rows), torch.full_like(rows, -1)
        path, plan = (rows.new_full((len(rows), length), fill) for fill in (-1, 0))
        uniform = []
        for t in range(length):
            uniform.append(self.draw.uniform((len(rows),), self.logits))
            inside = (depth < 0).nonzero()[:, 0]
            if len(inside) == 0:
                continue
            own, at = rows[inside], node[inside]
            action = self._select(own, at)
            path[inside, t], plan[inside, t] = at, action
            node[inside] = child = self.child[own, at, action]
            depth[inside[child == 0]] = t
        return path, plan, depth, torch.stack(uniform, 1)

    def _descend_compiled(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """As `_descend`."""
        length, actions = self.planner.length, self.world.num_actions
        path, plan, depth = (rows.new_zeros(shape) for shape in ((len(rows), length),) * 2 + ((len(rows),),))
        first = rows.new_zeros(length)
        before = self.generator.get_state()
        draws = torch.rand(plan.numel() * (1 + actions), generator=self.generator)
        given = [x.numpy() for x in (draws, path, plan, depth, first)]
        used = self.module.descend(self._nodes(), rows.numpy(), self.planner.exploration, *given)
        self.generator.set_state(before)
        torch.rand(used, generator=self.generator)
        return path, plan, depth, draws[first + torch.arange(len(rows))[:, None]]

    def _nodes(self) -> Any:
        """The trees for compiled loops."""
        return self.module.Nodes(*(getattr(self, name).numpy() for name in self.module.Nodes._fields))

    def _select(self, rows: Tensor, node: Tensor) -> Tensor:
        """The actions that PUCT takes at nodes `[K]`."""
        probs, visits, total = self.probs[rows, node], self.visits[rows, node].double(), self.total[rows, node]
        low, span = self.low[rows, None], (self.high - self.low)[rows, None]
        tries = visits.sum(1, keepdim=True)
        mean = torch.where(visits > 0, total / visits, total.cumsum(1)[:, -1:] / tries)
        value = torch.where((tries > 0) & (span > 0), (mean - low) / span, 0.5)
        bonus = self.planner.exploration * probs * tries.clamp(min=1).sqrt() / (1 + visits)
        return random_best(value + bonus, self.generator, ~self.closed[rows, node])

    def _follow(
        self, rows: Tensor, path: Tensor, plan: Tensor, depth: Tensor, uniform: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Add the nodes after `depth [K]` actions, and draw and follow the rest of each `plan [K, L]`.

        Returns:
            The reward of each step, `[K, L]`, and the state after it, `[K, L, ...]`.
        """
        length = plan.shape[1]
        inside = path[:, 1:].clamp(min=0)
        rewards = torch.nn.functional.pad(self.reward[rows[:, None], inside], (0, 1))
        states = self.state[rows[:, None], torch.nn.functional.pad(inside, (0, 1))]
        going, now = rows[:0], self.state[:0, 0]
        logits = hidden = self.logits[:0]
        for t in range(int(depth.min()) if len(rows) else length, length):
            # All of these plans have t actions behind them, so that the states of the prior have one shape.
            fresh = (depth == t).nonzero()[:, 0]
            own, node = rows[fresh], path[fresh, t]
            if len(going):
                plan[going, t] = self.draw.actions(logits, uniform[going, t])
            if len(fresh):
                kept = self.kept[t][self.place[own, node]]
                hidden = torch.cat([hidden, kept]) if len(going) else kept
            now, going = torch.cat([now, self.state[own, node]]), torch.cat([going, fresh])
            now, gained = self.world.step(now, plan[going, t], self.generator)
            self.reward, rewards = self.reward.to(gained.dtype), rewards.to(gained.dtype)
            rewards[going, t], states[going, t] = gained, now
            self.left[rows[going]] -= 1
            new, old = self.size[own], len(going) - len(fresh)
            self.child[own, node, plan[fresh, t]] = new
            self.state[own, new], self.reward[own, new] = now[old:], gained[old:]
            self.size[own] += 1
            if t + 1 < length:
                logits, hidden = self.stepper.step_in(self.world, plan[going, t], hidden, now)
                logits = self._legal(now, logits)
                self._keep(own, new, t + 1, logits[old:], hidden[old:])
        return rewards, states

    def _legal(self, state: Tensor, logits: Tensor) -> Tensor:
        """`logits [N, A]`, -inf for actions that are not legal in `state [N, ...]`."""
        logits = legal_logits(self.world, state, logits)
        if not self.world.all_legal and (logits == -torch.inf).all(1).any():
            raise ValueError("prior: in some state all legal actions have probability 0, or the world has none there")
        if logits.isnan().any():
            raise ValueError("prior: its logits are NaN")
        return logits

    def _keep(self, rows: Tensor, node: Tensor, depth: int, logits: Tensor, hidden: Tensor) -> None:
        """Keep what the prior predicts at new nodes `[K]`, and its states."""
        if len(rows) == 0:
            return
        self.probs[rows, node] = (logits.double() / self.planner.temperature).softmax(-1)
        if not self.world.all_legal:
            self.closed[rows, node] = ~self.world.legal_actions(self.state[rows, node])
        first, last = self.used[depth], self.used[depth] + len(rows)
        if last > len(self.kept[depth]):
            room = hidden.new_empty(2 * last, *hidden.shape[1:])
            if first:  # else the states that are kept have no shape yet
                room[:first] = self.kept[depth][:first]
            self.kept[depth] = room
        self.kept[depth][first:last] = hidden
        self.place[rows, node] = torch.arange(first, last, device=rows.device)
        self.used[depth] = last

    def _back_up(self, rows: Tensor, path: Tensor, plan: Tensor, score: Tensor) -> None:
        """Count plans `[K, L]` and their scores at the nodes of their `path [K, L]` (-1: outside of the tree)."""
        if self.module is not None:
            self.module.back_up(self._nodes(), *(x.numpy() for x in (rows, path, plan, score)))
            return
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
        for name in ("child", "visits", "total", "closed", "probs", "reward", "state", "place"):
            values = getattr(self, name)
            setattr(self, name, torch.cat([values, torch.zeros_like(values)], 1))
