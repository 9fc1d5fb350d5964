"""Best-first search for a goal, batched over problems: Levin tree search with a prior, A* and its relatives."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from math import inf
from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_memory, check_sizes, is_number
from neuroprior._hashing import row_hashes
from neuroprior.planners.planner import Decision, Planner, value_of
from neuroprior.plans import action_dtype
from neuroprior.priors.uniform import UniformPrior
from neuroprior.puzzles.compiled_search import ADDITIVE, LEVIN, can_search, compiled_tables, search_all
from neuroprior.puzzles.worlds.puzzle import PuzzleWorld
from neuroprior.sampling.draws import check_possible, check_temperature
from neuroprior.sampling.states import State, StateStore, tensors_in
from neuroprior.sampling.stepping import Steppable, Stepper, check_in_world
from neuroprior.worlds.world import World

Heuristic = Callable[[Tensor], Tensor]
"""The number of steps that are left, `[N]`, from states `[N, ...]`; such as `SokobanWorld.lower_bound`."""

FIRST_NODES = 256
"""Nodes for which there is room at first; the room doubles whenever it is full."""

BLOCK = 256
"""Edges in a block of the queue: the minimum of each block is kept, so that few numbers are read to find the least."""

PATH = "edge", "depth", "since", "log_prob", "peak", "least", "gain"
"""What is known of a path to a node before it is expanded."""


class Search(NamedTuple):
    """What a search found for B problems.

    Attributes:
        solved: bool `[B]`.
        plan: `[B, L]` actions that lead to the goal; 0 beyond `lengths`. Of an unsolved problem: to the best node.
        lengths: int64 `[B]`: actions of each plan.
        score: float64 `[B]`: the sum of the plan's rewards.
        final_state: `[B, ...]`: where the plan ends.
        expansions: int64 `[B]`: nodes that were expanded: those whose actions the prior was asked for.
        log_bound: float64 `[B]`: log(d / pi) of the solution, d its nodes (its actions and 1) and pi the probability of
            its actions; inf where there is none. Levin tree search expands at most d / pi nodes. With rerooting: the
            logarithm of the bound that holds then, see `LevinPlanner`.
        model_steps: int64 `[B]`: single simulator steps.
    """

    solved: Tensor
    plan: Tensor
    lengths: Tensor
    score: Tensor
    final_state: Tensor
    expansions: Tensor
    log_bound: Tensor
    model_steps: Tensor


class BestFirstPlanner(Planner):
    """Searches for a goal: expands the node with the lowest cost, until a goal is reached or the budget is spent.

    Each state is expanded once (state cuts): a path that reaches a state again is dropped. Children are made when their
    turn comes, so that those which never come cost nothing, unless a heuristic needs their states.

    Sokoban and sliding tiles on the CPU are searched by a compiled loop if the prior is a `LogLinearPrior` or uniform,
    and the heuristic, if any, the world's `lower_bound`. All other worlds with a goal, priors and heuristics are
    searched by a batched search in torch, which steps the world and the prior: the same order of expansion, but tens
    of times as slow.

    Args:
        prior: its probabilities are those of the actions at a node; None: uniform.
        max_nodes: nodes that are expanded for each problem, at most; bounds time and memory.
        heuristic: the number of steps left from each state; None: none is known.
        temperature: divides the prior's logits.

    Raises:
        ValueError: an argument is out of range. `plan` and `search` raise it for a stochastic world, a world without
            goals, a prior that cannot act in the world or gives NaN, and a heuristic that is below 0 or of a world with
            other states.
    """

    steps_at_once = 2**20

    order: tuple[int, float] | None = None
    """The kind of order and the weight of the heuristic in the compiled loop, or None where it does not know `cost`."""

    reroot = False
    """Whether nodes nearer to the goal than all before them on their path are new roots, see `LevinPlanner`."""

    def __init__(
        self,
        prior: Steppable | None = None,
        max_nodes: int = 10_000,
        *,
        heuristic: Heuristic | None = None,
        temperature: float = 1.0,
    ) -> None:
        super().__init__("return")
        check_sizes(max_nodes=max_nodes)
        check_memory(8 * max_nodes, max_nodes=max_nodes)
        check_temperature(temperature)
        if prior is not None and not isinstance(prior, Steppable):
            raise ValueError(f"`prior` must have num_actions, start and step, got {type(prior).__name__}.")
        self.prior, self.max_nodes, self.heuristic, self.temperature = prior, max_nodes, heuristic, temperature

    @abstractmethod
    def cost(self, depth: Tensor, log_prob: Tensor, left: Tensor) -> Tensor:
        """The cost of nodes, `[...]` float64, whose order is that of expansion.

        Args:
            depth: actions from the start, with rerooting from the last root; at least 1.
            log_prob: the log-probability of these actions.
            left: what the heuristic says is left; 0 without one.
        """

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        """Search from each of B starts; see `search`. Nothing is drawn.

        The plan of a start that is not solved leads to the node with the highest sum of rewards and, among these, the
        lowest heuristic: the first such. `model_steps` are the most of any start.
        """
        result = self.search(world, state)
        steps = int(result.model_steps.max()) if len(state) else 0
        return Decision(result.plan, result.score, result.final_state, steps, result.lengths)

    @torch.no_grad()
    def search(self, world: World, state: Tensor) -> Search:
        """Search from each of B starts.

        Args:
            world: deterministic, with goals (`World.solved`).
            state: `[B, ...]`.

        Raises:
            ValueError: see the class.
        """
        kind = type(world).__name__
        if world.stochastic:
            raise ValueError(f"`world` must be deterministic, got a stochastic {kind}.")
        if not world.has_goal:
            raise ValueError(f"`world` must have goals (has_goal, and `solved` says where), got {kind}.")
        if self.reroot and not hasattr(world, "lower_bound"):
            raise ValueError(f"`reroot` must be False where the world has no lower_bound(state), got {kind}.")
        prior = UniformPrior(world.num_actions).to(state.device) if self.prior is None else self.prior
        check_in_world(prior, world, state)
        if isinstance(of := getattr(self.heuristic, "__self__", None), World) and of is not world:
            try:
                of.check_state(state)
            except ValueError as error:
                raise ValueError(f"`heuristic` must know the states of this world: {error}") from None
        bounded = self.heuristic is None or self.heuristic == getattr(world, "lower_bound", None)
        if self.order is not None and bounded and can_search(world, prior):
            assert isinstance(world, PuzzleWorld)
            return self._search_compiled(world, prior, self.order, state)
        parts = [self._search(world, prior, chunk) for chunk in self.chunks(state, self.max_nodes)]
        longest = max(result.plan.shape[1] for result in parts)
        plans = [torch.nn.functional.pad(result.plan, (0, longest - result.plan.shape[1])) for result in parts]
        joined = [torch.cat(values) for values in zip(*parts, strict=True) if values[0] is not parts[0].plan]
        return Search(joined[0], torch.cat(plans), *joined[1:])

    def _search_compiled(self, world: PuzzleWorld, prior: Steppable, order: tuple[int, float], state: Tensor) -> Search:
        tables, informed = compiled_tables(prior, self.temperature), self.heuristic is not None
        solved, paths, *numbers = search_all(world, tables, state, order, informed, self.reroot, self.max_nodes)
        lengths = torch.tensor([len(path) for path in paths], dtype=torch.long)
        plan = pad_plans([torch.from_numpy(path) for path in paths], world.num_actions)
        final, score = follow_plans(world, state, plan, lengths)
        log_bound, expansions, steps = (torch.from_numpy(values) for values in numbers)
        return Search(torch.from_numpy(solved), plan, lengths, score, final, expansions, log_bound, steps)

    def _search(self, world: World, prior: Steppable, state: Tensor) -> Search:
        trees = _Trees(self, world, _PriorStates(prior, world, state), state)
        while len(trees.rows):
            trees.expand_best()
        return trees.result._replace(plan=pad_plans(trees.paths, world.num_actions))


class LevinPlanner(BestFirstPlanner):
    """Levin tree search: nodes in the order of d / pi, their depth over the probability of the actions that lead there.

    A goal at depth d whose actions have the probability pi is found after at most d / pi expansions (Orseau, Lelis,
    Lattimore and Weber, *Single-agent policy tree search with guarantees*, NeurIPS 2018, theorem 3); d counts
    the start. With a heuristic h the order is that of PHS*, (d + h) / pi ** (1 + h / d) (Orseau and Lelis,
    *Policy-guided heuristic search with guarantees*, AAAI 2021).

    With `reroot` it is the root-LTS of Orseau, Hutter and Lelis (*Exponential speedups by rerooting Levin tree search*,
    2024) with weights of 1: roots are the start and every node whose `world.lower_bound` is below those of all nodes
    before it on its path, and each is the start of a Levin tree search of its own. Their costs d / pi, counted from the
    root, share one queue: a node has the lowest that a root before it gives it, which is that of the last one. The cost
    falls at each new root, so that expansions are not bounded by the solution's d / pi. Of each root's search at most c
    nodes cost at most c; so a solution is found after at most r * c expansions, with r roots among the nodes expanded
    until then and c the highest cost on the way to it. With a heuristic as well, the order is that of PHS* with d and
    pi counted from the last root, and no bound is known.

    The prior's probabilities are not renormalised over legal actions.

    Args:
        reroot: whether there are such roots. The world needs `lower_bound(state)`, as `SokobanWorld` has it.
        prior, max_nodes, heuristic, temperature: see `BestFirstPlanner`.

    Raises:
        ValueError: see `BestFirstPlanner`; and `search` raises it where `reroot` finds no `world.lower_bound`.

    Example:
        >>> world = sliding_tiles(shape=(2, 2), scramble=6)
        >>> found = LevinPlanner(UniformPrior(4)).search(world, world.reset(5, torch.Generator().manual_seed(0)))
        >>> found.solved.all().item()
        True
    """

    order = (LEVIN, 1.0)

    def __init__(
        self,
        prior: Steppable,
        max_nodes: int = 10_000,
        *,
        heuristic: Heuristic | None = None,
        reroot: bool = False,
        temperature: float = 1.0,
    ) -> None:
        super().__init__(prior, max_nodes, heuristic=heuristic, temperature=temperature)
        self.reroot = reroot

    def cost(self, depth: Tensor, log_prob: Tensor, left: Tensor) -> Tensor:
        nodes = depth.double() + 1
        return (nodes + left).log() - (1 + left / nodes) * log_prob


class AStarPlanner(BestFirstPlanner):
    """A* and its relatives, which need no prior: nodes in the order of depth + weight * heuristic.

    Args:
        heuristic: the steps that are left; None: breadth-first search.
        weight: of the heuristic: 1: A*, whose plans are shortest where the heuristic is consistent; above 1: weighted
            A*; inf: greedy best-first search.
        max_nodes: see `BestFirstPlanner`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = sliding_tiles(shape=(2, 2), scramble=6)
        >>> found = AStarPlanner(world.lower_bound).search(world, world.reset(5, torch.Generator().manual_seed(0)))
        >>> found.solved.all().item()
        True
    """

    def __init__(self, heuristic: Heuristic | None = None, weight: float = 1.0, max_nodes: int = 10_000) -> None:
        super().__init__(None, max_nodes, heuristic=heuristic)
        if not is_number(weight) or not weight >= 0:
            raise ValueError(f"`weight` must be at least 0, got {weight!r}.")
        self.weight, self.order = weight, (ADDITIVE, float(weight))

    def cost(self, depth: Tensor, log_prob: Tensor, left: Tensor) -> Tensor:
        return left.double() if self.weight == inf else depth + self.weight * left.double()


class _Trees:
    """The search trees of B problems, searched together: R of them still, `rows` numbers them among the B.

    A node is numbered in the order of expansion, and its edge by action a is node * A + a. Of each node are kept the
    edge that led to it, its depth and the rewards of its path, its state, and the prior's; since the last root on its
    path, which without rerooting is the start, the actions (`since`) and their log-probability; and of all nodes on its
    path the highest log(d / pi) from the root before them (`peak`) and the lowest `World.lower_bound` (`least`).
    """

    def __init__(self, planner: BestFirstPlanner, world: World, prior: "_PriorStates", state: Tensor) -> None:
        self.planner, self.world, self.prior, self.actions = planner, world, prior, world.num_actions
        self.lower_bound: Heuristic | None = getattr(world, "lower_bound", None) if planner.reroot else None
        batch, device = len(state), state.device
        self.rows = torch.arange(batch, device=device)
        self.size, self.steps = torch.zeros_like(self.rows), torch.zeros_like(self.rows)
        self.capacity = min(FIRST_NODES, planner.max_nodes)
        self.paths: list[Tensor] = [self.rows[:0]] * batch
        self.seen = [{code} for code in row_hashes(state).tolist()]
        empty, nothing = torch.zeros_like(self.rows), torch.zeros(batch, dtype=torch.float64, device=device)
        self.result = Search(
            world.solved(state), empty[:, None], empty, nothing, state.clone(), empty.clone(), nothing + inf,
            empty.clone(),
        )  # fmt: skip
        self.result.log_bound[self.result.solved] = 0.0
        logits, place = self.prior.start(state)
        room = torch.zeros(batch, self.capacity, dtype=torch.float64, device=device)
        self.nodes = {
            **{name: torch.zeros_like(room, dtype=torch.long) for name in ("edge", "depth", "since")},
            **{name: torch.zeros_like(room) for name in ("log_prob", "peak", "least", "gain", "left")},
            "state": state.new_zeros(batch, self.capacity, *state.shape[1:]),
            "place": place.new_zeros(batch, self.capacity, 2),
            "action_log_prob": room.new_zeros(batch, self.capacity, self.actions),
        }
        self._make_queue(batch)
        path = {name: self.nodes[name][:, 0].clone() for name in PATH}
        path["edge"] -= 1
        path["least"] += inf
        self._add(self.rows, path, state, logits, place)
        self.size[self.result.solved] = 0
        self._drop(self.result.solved)

    def expand_best(self) -> None:
        """Expand the best node of each tree."""
        tree, node = torch.arange(len(self.rows), device=self.rows.device), self.nodes
        edge = self._pop_edges(tree)
        parent, action = edge.div(self.actions, rounding_mode="floor"), edge % self.actions
        state, reward = self.world.step(node["state"][tree, parent], action)
        self.steps += 1
        path = {name: node[name][tree, parent] for name in PATH} | {"edge": edge}
        path["depth"] += 1
        path["since"] += 1
        path["log_prob"] += node["action_log_prob"][tree, parent, action]
        path["peak"] = path["peak"].maximum((path["since"].double() + 1).log() - path["log_prob"])
        path["gain"] += reward.double()
        codes = row_hashes(state).tolist()
        new = torch.tensor([code not in seen for code, seen in zip(codes, self.seen, strict=True)], device=tree.device)
        for code, seen in zip(codes, self.seen, strict=True):
            seen.add(code)
        solved = new & self.world.solved(state)
        self._finish(tree[solved], {name: values[solved] for name, values in path.items()}, state[solved])
        wanted = new & ~solved
        if bool(wanted.any()):
            place = node["place"][tree, parent][wanted]
            logits, place = self.prior.step(action[wanted], place, state[wanted])
            path = {name: values[wanted] for name, values in path.items()}
            self._add(tree[wanted], path, state[wanted], logits, place)
        self._drop(solved)

    def _pop_edges(self, tree: Tensor) -> Tensor:
        """The edge of the lowest cost of each tree, int64 `[R]`, taken out of its queue."""
        blocks = self.queue.view(len(tree), -1, BLOCK)
        block = self.minima.argmin(1)
        within = blocks[tree, block].argmin(1)
        blocks[tree, block, within] = inf
        self.minima[tree, block] = blocks[tree, block].amin(1)
        return block * BLOCK + within

    def _add(self, tree: Tensor, path: dict[str, Tensor], state: Tensor, logits: Tensor, place: Tensor) -> None:
        """Expand a new node of each of the trees `[M]`, with what is known of its `path`, and queue its edges."""
        at = self.size[tree]
        self.size[tree] += 1
        if bool((self.size > self.capacity).any()):
            self._grow()
        log_probs = torch.log_softmax(logits.double() / self.planner.temperature, -1)
        check_possible(~log_probs[:, 0].isnan().any())
        legal = self.world.legal_actions(state) & ~self.world.terminated(state)[:, None]
        left, of_children = self._estimates(tree, state, legal)
        if self.lower_bound is not None:
            bound = value_of(self.lower_bound, state, "lower_bound").double()
            rooted = bound < path["least"]
            path |= {name: path[name].masked_fill(rooted, 0) for name in ("since", "log_prob")}
            path["least"] = path["least"].minimum(bound)
            left = bound if self.planner.heuristic is None else left
        named = {"left": left, "state": state, "place": place, "action_log_prob": log_probs}
        for name, values in (path | named).items():
            self.nodes[name][tree, at] = values
        depth = (path["since"] + 1)[:, None].expand_as(log_probs)
        cost = self.planner.cost(depth, path["log_prob"][:, None] + log_probs, of_children)
        cost = cost.masked_fill(~legal | cost.isnan(), inf)
        edges = at[:, None] * self.actions + torch.arange(self.actions, device=at.device)
        self.queue[tree[:, None], edges] = cost
        block = edges.div(BLOCK, rounding_mode="floor")
        flat = (tree[:, None] * self.minima.shape[1] + block).flatten()
        self.minima.view(-1).scatter_reduce_(0, flat, cost.flatten(), "amin")

    def _estimates(self, tree: Tensor, state: Tensor, legal: Tensor) -> tuple[Tensor, Tensor]:
        """What the heuristic says of nodes `[M]`, and of their children `[M, A]`; 0 without one."""
        heuristic, children = self.planner.heuristic, torch.zeros_like(legal, dtype=torch.float64)
        if heuristic is None:
            return children[:, 0], children
        where, action = legal.nonzero(as_tuple=True)
        reached, _ = self.world.step(state[where], action)
        self.steps[tree] += legal.sum(1)
        children[where, action] = value_of(heuristic, reached, "heuristic").double()
        if bool((children < 0).any()):
            raise ValueError(f"`heuristic` must be at least 0, got {float(children.min())}.")
        return value_of(heuristic, state, "heuristic").double(), children

    def _make_queue(self, trees: int) -> None:
        """A queue for the edges of `capacity` nodes a tree."""
        blocks = -(-self.capacity * self.actions // BLOCK)
        self.queue = torch.full((trees, blocks * BLOCK), inf, dtype=torch.float64, device=self.rows.device)
        self.minima = self.queue.new_full((trees, blocks), inf)

    def _grow(self) -> None:
        """Twice the room for nodes."""
        queue, minima, trees = self.queue, self.minima, len(self.rows)
        for name, values in self.nodes.items():
            self.nodes[name] = torch.cat([values, torch.zeros_like(values)], 1)
        self.capacity *= 2
        self._make_queue(trees)
        self.queue[:, : queue.shape[1]], self.minima[:, : minima.shape[1]] = queue, minima

    def _finish(self, tree: Tensor, path: dict[str, Tensor], state: Tensor) -> None:
        """Take the solutions of trees `[M]`."""
        row, result = self.rows[tree], self.result
        result.solved[row] = True
        entered = torch.arange(self.capacity, device=tree.device) < self.size[tree][:, None]
        roots = ((self.nodes["since"][tree] == 0) & entered).sum(1)
        result.log_bound[row] = roots.double().log() + path["peak"]
        self._take(tree, path["edge"], path["depth"], path["gain"], state)

    def _take(self, tree: Tensor, edge: Tensor, depth: Tensor, gain: Tensor, state: Tensor) -> None:
        """Write the paths `[M]` that end with `edge` to the results."""
        row, result = self.rows[tree], self.result
        result.lengths[row], result.score[row], result.final_state[row] = depth, gain, state
        longest = int(depth.max()) if len(depth) else 0
        plan, now = torch.zeros(len(tree), longest, dtype=torch.long, device=tree.device), edge
        for back in range(1, longest + 1):
            on_path = now >= 0
            plan[on_path, (depth - back)[on_path]] = now[on_path] % self.actions
            node = now.clamp(min=0).div(self.actions, rounding_mode="floor")
            now = torch.where(on_path, self.nodes["edge"][tree, node], now)
        for one, number, path in zip(row.tolist(), depth.tolist(), plan, strict=True):
            self.paths[one] = path[:number]

    def _drop(self, solved: Tensor) -> None:
        """Leave the trees that are `solved`, bool `[R]`, and, with their best nodes, those that end unsolved."""
        over = solved | (self.size >= self.planner.max_nodes) | (self.minima.amin(1) == inf)
        if not bool(over.any()):
            return
        ended, lost = over.nonzero()[:, 0], (over & ~solved).nonzero()[:, 0]
        row = self.rows[ended]
        self.result.expansions[row], self.result.model_steps[row] = self.size[ended], self.steps[ended]
        if len(lost):
            beyond = torch.arange(self.capacity, device=lost.device) >= self.size[lost][:, None]
            gain = self.nodes["gain"][lost].masked_fill(beyond, -inf)
            left = self.nodes["left"][lost].masked_fill(gain < gain.amax(1, keepdim=True), inf)
            best = left.argmin(1)
            self._take(lost, *(self.nodes[name][lost, best] for name in ("edge", "depth", "gain", "state")))
        kept = (~over).nonzero()[:, 0]
        self.rows, self.size, self.steps = self.rows[kept], self.size[kept], self.steps[kept]
        self.queue, self.minima = self.queue[kept], self.minima[kept]
        self.seen = [self.seen[k] for k in kept.tolist()]
        self.nodes = {name: values[kept] for name, values in self.nodes.items()}


class _PriorStates:
    """The prior's states at the nodes of a search, which are stepped by their places, int64 `[N, 2]`: depth and row.

    States of networks that read a window grow with the actions behind them: those are kept by depth, and rows are
    stepped together with as many actions behind them. All others are kept as of depth 0.
    """

    def __init__(self, prior: Steppable, world: World, state: Tensor) -> None:
        self.stepper, self.world, self.store = Stepper(prior), world, StateStore()
        _, before = self.stepper.start_in(world, state[:1])
        action = torch.zeros(len(state[:1]), dtype=torch.long, device=state.device)
        _, after = self.stepper.step_in(world, action, before, state[:1])
        sizes = [[values.shape[1:] for values in tensors_in(one)] for one in (before, after)]
        self.grows = len(state) > 0 and sizes[0] != sizes[1]

    def start(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Logits `[N, A]` at starts, and the places of the states."""
        logits, hidden = self.stepper.start_in(self.world, state)
        return logits, self._keep(0, hidden, state.device)

    def step(self, action: Tensor, place: Tensor, reached: Tensor) -> tuple[Tensor, Tensor]:
        """Logits `[N, A]` after actions that led to the world's states `reached`, and the places of the states."""
        parts, places = [], torch.empty_like(place)
        for depth in place[:, 0].unique().tolist():
            rows = (place[:, 0] == depth).nonzero()[:, 0]
            hidden = self.store.take(depth, place[rows, 1])
            logits, after = self.stepper.step_in(self.world, action[rows], hidden, reached[rows])
            places[rows] = self._keep(depth + self.grows, after, place.device)
            parts.append((rows, logits))
        order = torch.cat([rows for rows, _ in parts]).argsort()
        return torch.cat([logits for _, logits in parts])[order], places

    def _keep(self, depth: int, hidden: State, device: torch.device) -> Tensor:
        row = self.store.keep(depth, hidden).to(device)
        return torch.stack([torch.full_like(row, depth), row], 1)


def pad_plans(plans: Sequence[Tensor], num_actions: int) -> Tensor:
    """Plans of different lengths as one tensor `[N, L]`, with 0 beyond their ends."""
    if not plans:
        return torch.zeros(0, 0, dtype=action_dtype(num_actions))
    return torch.nn.utils.rnn.pad_sequence(list(plans), batch_first=True).to(action_dtype(num_actions))


def follow_plans(world: World, state: Tensor, plans: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Where plans `[B, L]` end, and the sum of their rewards, float64 `[B]`."""
    state, score = state.clone(), torch.zeros(len(state), dtype=torch.float64, device=state.device)
    for t in range(plans.shape[1]):
        on = lengths > t
        state[on], reward = world.step(state[on], plans[on, t].long())
        score[on] += reward.double()
    return state, score
