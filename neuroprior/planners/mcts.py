"""Monte Carlo tree search: a tree of plans, extended where plans scored well and where the prior points."""

from typing import Any, Unpack

import torch
from torch import Tensor

from neuroprior._checks import is_number
from neuroprior.planners.planner import Decision, Objective, PriorPlanner, decide, join_decisions
from neuroprior.sampling.draws import Draw, check_possible
from neuroprior.sampling.states import State, StateStore, join_rows, numbers_in, select_rows
from neuroprior.sampling.stepping import Steppable, Stepper, legal_logits
from neuroprior.worlds.tabular import TabularWorld
from neuroprior.worlds.world import Rollout, World, allowed_actions, step_alive

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

    The trees are on the CPU. One compiled loop makes the whole search in a deterministic `TabularWorld` where all
    actions are legal, without `value`, if the prior is uniform, counts histories or is a GRU.

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
        **goal: Unpack[Objective],
    ) -> None:
        super().__init__(prior, length, num_plans, temperature=temperature, **goal)
        if not is_number(exploration) or not 0 <= exploration < float("inf"):
            raise ValueError(f"`exploration` must be a finite number of at least 0, got {exploration!r}")
        self.exploration = exploration

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        self._require_deterministic(world, "a node of the tree is one state")
        planner, generator = self._prepare(world, state, generator)
        from neuroprior.planners import compiled_mcts

        whole = compiled_mcts.can_search(planner, world, state)
        numbers = world.num_actions  # that each node has
        if not whole:
            numbers = max(numbers, self._state_size(world, state) // PER_ACTION)
        chunks = self.chunks(state, self.num_plans * self.length * numbers)
        return join_decisions((planner._plan(whole, world, chunk, generator) for chunk in chunks), len(state))

    @torch.no_grad()
    def _state_size(self, world: World, state: Tensor) -> int:
        """Numbers in the largest state of the prior in a tree: states may grow, by as much with each action."""
        stepper, now = Stepper(self.prior), state[:1]
        begun = stepper.start_in(world, now)[1]
        before = numbers_in(begun)
        if before == 0 or self.length == 1:
            return before
        after = stepper.step_in(world, torch.zeros(1, dtype=torch.long, device=state.device), begun, now)[1]
        return before + max(numbers_in(after) - before, 0) * (self.length - 1)

    @torch.no_grad()
    def _plan(self, whole: bool, world: World, state: Tensor, generator: torch.Generator) -> Decision:
        from neuroprior.planners.compiled_mcts import search_all

        if whole and isinstance(world, TabularWorld):
            plans, rewards, states, done, steps = search_all(self, world, state, generator)
        else:
            with self._threads_for(len(state)):
                plans, rewards, states, done, steps = _Trees(self, world, state, generator).search()
        rollout = Rollout(states[:, :, -1], rewards, states if self.any_prefix else None)
        score, ends = self.score_rollout(rollout)
        allowed = done[..., None] if self.any_prefix else done
        return decide(plans, score, ends, steps, generator, allowed, self.keep_candidates)


class _Trees:
    """The trees of B starts, and the simulations in them, in any world and with any prior.

    States and rewards are where the world computes, everything else is on the CPU.

    Attributes:
        child: `[B, M, A]`: the node that an action leads to; 0: none yet (the root, node 0, is no child).
        visits, total: `[B, M, A]`: tries of each action, and the sum of their scores.
        closed: `[B, M, A]`: actions that are not legal, or after which everything has been tried.
        probs: `[B, M, A]`: the prior's.
        reward: `[B, M]`: of the step into each node.
        state: `[B, M, ...]`: of the world at each node.
        place: `[B, M]`: where the prior's state at each node is, in `kept`.
        kept: the prior's states at the nodes of each depth.
        size: `[B]`: nodes so far.
        left: `[B]`: simulator steps that may still be taken.
        over: `[B]`: whether they are too few for the plan that was to be tried next.
        low, high: `[B]`: the lowest and the highest finite score.
    """

    def __init__(self, planner: MCTSPlanner, world: World, state: Tensor, generator: torch.Generator) -> None:
        self.planner, self.world, self.generator = planner, world, generator
        batch, actions = len(state), world.num_actions
        self.draw = Draw(actions, planner.temperature, generator)
        self.stepper = Stepper(planner.prior)
        self.logits, hidden = self.stepper.start_in(world, state)
        self.device = state.device
        self.child = torch.zeros(batch, 1, actions, dtype=torch.long)
        self.visits, self.closed = self.child.int(), self.child.bool()
        self.total, self.probs = self.child.double(), self.child.double()
        self.reward, self.state = torch.zeros(batch, 1, device=self.device), state[:, None]
        self.size = torch.ones(batch, dtype=torch.long)
        self.steps = planner.num_plans * planner.length
        self.left, self.over = torch.full_like(self.size, self.steps), torch.zeros_like(self.size, dtype=torch.bool)
        self.low, self.high = (self.total.new_full((batch,), sign * torch.inf) for sign in (1, -1))
        self.kept = StateStore()
        self.place = torch.zeros(batch, 1, dtype=torch.long)
        every = torch.arange(batch)
        self._keep(every, torch.zeros_like(every), 0, self._legal(state, self.logits), hidden)

    def search(self) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
        """Simulate until the budget is spent, or all has been tried.

        Returns:
            Of all simulations the plans `[B, N, L]`, the reward of each step and the state after it, and whether there
            is a plan, `[B, N]`; and the simulator steps of the start that took most. Unless any prefix may win, there
            are only the states at the end: `[B, N, 1, ...]`.
        """
        simulations = list[tuple[Tensor, ...]]()
        while len(rows := self.unfinished()) or not simulations:
            simulations.append(self.simulate(rows))
        plans, rewards, states, done = (torch.stack(parts, 1) for parts in zip(*simulations, strict=True))
        return plans, rewards, states, done, int((self.steps - self.left).max()) if len(self.left) else 0

    def unfinished(self) -> Tensor:
        """The starts whose trees may be extended."""
        return ((self.left > 0) & ~self.over & ~self.closed[:, 0].all(1)).nonzero()[:, 0]

    def simulate(self, rows: Tensor) -> tuple[Tensor, ...]:
        """One more plan from the starts `rows [K]`; for all B: plan, rewards, states, whether there is a plan."""
        from neuroprior.planners.compiled_mcts import back_up

        self._make_room()
        path, plan, depth, uniform = self._descend(rows)
        # A plan that the budget does not allow to the end is not begun.
        alive = self.left[rows] >= self.planner.length - depth
        self.over[rows[~alive]] = True
        rows, path, plan, depth, uniform = rows[alive], path[alive], plan[alive], depth[alive], uniform[alive]
        rewards, states = self._follow(rows, path, plan, depth, uniform)
        kept = states if self.planner.any_prefix else states[:, -1:]
        score, _ = self.planner.score_rollout(
            Rollout(states[:, -1], rewards, states if self.planner.any_prefix else None)
        )
        score = (score if score.dim() == 1 else score.amax(1)).double().cpu()
        back_up(self._nodes(), *(x.numpy() for x in (rows, path, plan, score)))
        rows = rows.to(self.device)
        simulation = (plan.to(self.device, self.draw.dtype), rewards, kept, torch.ones_like(rows, dtype=torch.bool))
        batch = len(self.size)
        # Where there is no plan, states are those of the starts: values are asked for all.
        empty = [values.new_zeros(batch, *values.shape[1:]) for values in simulation]
        empty[2] = self.state[:, :1].expand(empty[2].shape[:2] + self.state.shape[2:]).clone()
        return tuple(whole.index_copy_(0, rows, values) for whole, values in zip(empty, simulation, strict=True))

    def _descend(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Follow PUCT in the trees of `rows [K]` down to an action that was not tried yet.

        Returns:
            The nodes on the way, `[K, L]` (-1 beyond), the actions up to that one `[K, L]`, how many come before it
            `[K]`, and uniform numbers `[K, L]` to draw the rest of the plan with.
        """
        from neuroprior.planners.compiled_mcts import descend

        length, actions = self.planner.length, self.world.num_actions
        path, plan, depth = (rows.new_zeros(shape) for shape in ((len(rows), length),) * 2 + ((len(rows),),))
        first = rows.new_zeros(length)
        # As many numbers are drawn as are needed at most, and what is left is given back.
        before, device = self.generator.get_state(), self.generator.device
        draws = torch.rand(plan.numel() * (1 + actions), generator=self.generator, device=device)
        arrays = [x.numpy() for x in (draws.cpu(), path, plan, depth, first)]
        used = descend(self._nodes(), rows.numpy(), self.planner.exploration, *arrays)
        self.generator.set_state(before)
        torch.rand(used, generator=self.generator, device=device)
        return path, plan, depth, draws[(first + torch.arange(len(rows))[:, None]).to(device)]

    def _nodes(self) -> Any:
        """The trees for compiled loops."""
        from neuroprior.planners.compiled_mcts import Nodes

        return Nodes(*(getattr(self, name).numpy() for name in Nodes._fields))

    def _follow(
        self, rows: Tensor, path: Tensor, plan: Tensor, depth: Tensor, uniform: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Add the nodes after `depth [K]` actions, and draw and follow the rest of each `plan [K, L]`.

        Returns:
            The reward of each step, `[K, L]`, and the state after it, `[K, L, ...]`.
        """
        length, device = plan.shape[1], self.device
        inside, starts = path[:, 1:].clamp(min=0).to(device), rows.to(device)
        rewards = torch.nn.functional.pad(self.reward[starts[:, None], inside], (0, 1))
        states = self.state[starts[:, None], torch.nn.functional.pad(inside, (0, 1))]
        uniform, going, now = uniform.to(self.logits), rows[:0], self.state[:0, 0]
        logits, hidden = self.logits[:0], None
        for t in range(int(depth.min()) if len(rows) else length, length):
            # All of these plans have t actions behind them, so that the states of the prior have one shape.
            fresh = (depth == t).nonzero()[:, 0]
            tree, node = rows[fresh], path[fresh, t]
            if len(going):
                plan[going, t] = self.draw.actions(logits, uniform[going.to(device), t]).cpu()
            if len(fresh):
                kept = self.kept.take(t, self.place[tree, node])
                hidden = join_rows(hidden, kept) if len(going) else kept
            now = torch.cat([now, self.state[tree.to(device), node.to(device)]])
            going = torch.cat([going, fresh])
            action, place = plan[going, t].to(device), going.to(device)
            now, gained = step_alive(self.world, now, action, self.generator)
            self.reward, rewards = self.reward.to(gained.dtype), rewards.to(gained.dtype)
            rewards[place, t], states[place, t] = gained, now
            self.left[rows[going]] -= 1
            new, old = self.size[tree], len(going) - len(fresh)
            self.child[tree, node, plan[fresh, t]] = new
            at = tree.to(device), new.to(device)
            self.state[at], self.reward[at] = now[old:], gained[old:]
            self.size[tree] += 1
            if t + 1 < length:
                logits, hidden = self.stepper.step_in(self.world, action, hidden, now)
                logits = self._legal(now, logits)
                self._keep(tree, new, t + 1, logits[old:], select_rows(hidden, slice(old, None)))
        return rewards, states

    def _legal(self, state: Tensor, logits: Tensor) -> Tensor:
        """`logits [N, A]`, -inf for actions that are not legal in `state [N, ...]`."""
        return legal_logits(self.world, state, logits)

    def _keep(self, rows: Tensor, node: Tensor, depth: int, logits: Tensor, hidden: State) -> None:
        """Keep what the prior predicts at new nodes `[K]`, and its states."""
        if len(rows) == 0:
            return
        probs = (logits.double() / self.planner.temperature).softmax(-1).cpu()
        check_possible(~probs[:, 0].isnan().any())
        self.probs[rows, node] = probs
        if not self.world.all_legal:
            state = self.state[rows.to(self.device), node.to(self.device)]
            self.closed[rows, node] = ~allowed_actions(self.world, state).cpu()
        self.place[rows, node] = self.kept.keep(depth, hidden)

    def _make_room(self) -> None:
        """Double the number of nodes where one more might not fit."""
        if not len(self.size) or int(self.size.max()) < self.child.shape[1]:
            return
        for name in ("child", "visits", "total", "closed", "probs", "reward", "state", "place"):
            values = getattr(self, name)
            setattr(self, name, torch.cat([values, torch.zeros_like(values)], 1))
