"""Best-first search for a goal, batched over problems: Levin tree search with a prior, A* and its relatives."""

from abc import abstractmethod
from collections.abc import Callable
from math import inf
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_memory, check_sizes, is_number
from neuroprior._compiled import compiled
from neuroprior._hashing import row_hashes
from neuroprior.planners.planner import Decision, Planner, value_of
from neuroprior.plans import action_dtype
from neuroprior.priors.uniform import UniformPrior
from neuroprior.puzzles.worlds.puzzle import PuzzleWorld
from neuroprior.sampling.draws import check_temperature
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

TAKEN = "edge", "depth", "gain"
"""What of it is written to the results."""

EMPTY = -(2**63)
"""Marks a free place of a hash table."""


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
            its actions; inf where there is none. With one node at a time, Levin tree search expands at most d / pi.
            With rerooting: the logarithm of the bound that holds then, see `LevinPlanner`.
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

    Args:
        prior: its probabilities are those of the actions at a node; None: uniform.
        max_nodes: nodes that are expanded for each problem, at most; bounds time and memory.
        heuristic: the number of steps left from each state; None: none is known.
        nodes_at_once: nodes that are expanded together for each problem. Above 1 the world and the prior are asked
            for more at once, and up to so many times more nodes are expanded.
        temperature: divides the prior's logits.
        compile: search by a compiled loop where numba is installed and it knows the world, the prior and the heuristic
            (puzzles on the CPU, uniform priors and those of patterns, `lower_bound`): it finds the same, tens of
            times as fast.

    Raises:
        ValueError: an argument is out of range. `plan` and `search` raise it for a stochastic world, a world without
            goals, a prior that cannot act in the world or gives NaN, and a heuristic that is below 0 or of a world with
            other states.
    """

    steps_at_once = 2**20

    order: tuple[int, float] = (0, 1.0)
    """For the compiled loop, 0 for d / pi, 1 for depth + weight * heuristic; and the weight."""

    reroot = False
    """Whether nodes nearer to the goal than all before them on their path are new roots, see `LevinPlanner`."""

    def __init__(
        self,
        prior: Steppable | None = None,
        max_nodes: int = 10_000,
        *,
        heuristic: Heuristic | None = None,
        nodes_at_once: int = 1,
        temperature: float = 1.0,
        compile: bool = True,
    ) -> None:
        super().__init__("return")
        check_sizes(max_nodes=max_nodes, nodes_at_once=nodes_at_once)
        check_memory(8 * max_nodes, max_nodes=max_nodes)
        check_temperature(temperature)
        if prior is not None and not isinstance(prior, Steppable):
            raise ValueError(f"prior: a prior with num_actions, start and step is expected, not {type(prior).__name__}")
        if heuristic is not None and not callable(heuristic):
            raise ValueError(f"heuristic: a function of states is expected, not {heuristic!r}")
        self.prior, self.max_nodes, self.heuristic = prior, max_nodes, heuristic
        self.nodes_at_once, self.temperature, self.compile = nodes_at_once, temperature, compile

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
        found = self.search(world, state)
        steps = int(found.model_steps.max()) if len(state) else 0
        return Decision(found.plan, found.score, found.final_state, steps, found.lengths)

    @torch.no_grad()
    def search(self, world: World, state: Tensor) -> Search:
        """Search from each of B starts.

        Args:
            world: deterministic, with goals (`World.solved`).
            state: `[B, ...]`.

        Raises:
            ValueError: see the class.
        """
        if world.stochastic:
            raise ValueError("world: a deterministic one is expected: a search reaches each state by the same actions")
        if not world.has_goal:
            kind = type(world).__name__
            raise ValueError(
                f"world: one with goals (has_goal is True, and `solved` says where) is expected, not {kind}"
            )
        if self.reroot and not hasattr(world, "lower_bound"):
            kind = type(world).__name__
            raise ValueError(f"reroot: a world with lower_bound(state), the steps left, is expected, not {kind}")
        prior = UniformPrior(world.num_actions).to(state.device) if self.prior is None else self.prior
        check_in_world(prior, world, state)
        if isinstance(of := getattr(self.heuristic, "__self__", None), World) and of is not world:
            try:
                of.check_state(state)
            except ValueError as error:
                raise ValueError(f"heuristic: it is that of another world ({error})") from None
        if (module := self._compiled(world, prior)) is not None:
            assert isinstance(world, PuzzleWorld)
            return self._search_compiled(module, world, prior, state)
        parts = [self._search(world, prior, some) for some in self.chunks(state, self.max_nodes)]
        longest = max(part.plan.shape[1] for part in parts)
        plans = [torch.nn.functional.pad(part.plan, (0, longest - part.plan.shape[1])) for part in parts]
        joined = [torch.cat(values) for values in zip(*parts, strict=True) if values[0] is not parts[0].plan]
        return Search(joined[0], torch.cat(plans), *joined[1:])

    def _compiled(self, world: World, prior: Steppable) -> Any:
        """The module of the compiled loop where it can do this search in the same way, else None."""
        informed = self.heuristic is not None and self.heuristic != getattr(world, "lower_bound", None)
        if not self.compile or informed or self.nodes_at_once > 1 or self.temperature != 1:
            return None
        module = compiled("neuroprior.puzzles.compiled_search") if isinstance(world, PuzzleWorld) else None
        return module if module is not None and module.can_search(world, prior) else None

    def _search_compiled(self, module: Any, world: PuzzleWorld, prior: Steppable, state: Tensor) -> Search:
        informed = self.heuristic is not None
        found = module.search_all(world, prior, state, *self.order, informed, self.reroot, self.max_nodes)
        lengths = torch.tensor([len(plan) for plan in found.plans], dtype=torch.long)
        plans = [torch.from_numpy(plan) for plan in found.plans]
        padded = torch.nn.utils.rnn.pad_sequence(plans, batch_first=True) if plans else torch.zeros(0, 0)
        final, score = _followed(world, state, padded, lengths)
        numbers = (torch.from_numpy(x) for x in (found.expansions, found.log_bound, found.model_steps))
        plan = padded.to(action_dtype(world.num_actions))
        return Search(torch.from_numpy(found.solved), plan, lengths, score, final, *numbers)

    def _search(self, world: World, prior: Steppable, state: Tensor) -> Search:
        trees = _Trees(self, world, _stepper(prior, world, state), state)
        while trees.active:
            trees.expand_best()
        return trees.found()


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
        prior, max_nodes, heuristic, nodes_at_once, temperature, compile: see `BestFirstPlanner`.

    Raises:
        ValueError: see `BestFirstPlanner`; and `search` raises it where `reroot` finds no `world.lower_bound`.

    Example:
        >>> world = sliding_tiles(shape=(2, 2), scramble=6)
        >>> found = LevinPlanner(UniformPrior(4)).search(world, world.reset(5, torch.Generator().manual_seed(0)))
        >>> found.solved.all().item()
        True
    """

    def __init__(
        self,
        prior: Steppable,
        max_nodes: int = 10_000,
        *,
        heuristic: Heuristic | None = None,
        reroot: bool = False,
        nodes_at_once: int = 1,
        temperature: float = 1.0,
        compile: bool = True,
    ) -> None:
        how: dict[str, Any] = {"nodes_at_once": nodes_at_once, "temperature": temperature, "compile": compile}
        super().__init__(prior, max_nodes, heuristic=heuristic, **how)
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
        max_nodes, nodes_at_once, compile: see `BestFirstPlanner`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> world = sliding_tiles(shape=(2, 2), scramble=6)
        >>> found = AStarPlanner(world.lower_bound).search(world, world.reset(5, torch.Generator().manual_seed(0)))
        >>> found.solved.all().item()
        True
    """

    def __init__(
        self,
        heuristic: Heuristic | None = None,
        weight: float = 1.0,
        max_nodes: int = 10_000,
        *,
        nodes_at_once: int = 1,
        compile: bool = True,
    ) -> None:
        super().__init__(None, max_nodes, heuristic=heuristic, nodes_at_once=nodes_at_once, compile=compile)
        if not is_number(weight) or not weight >= 0:
            raise ValueError(f"weight: a number of at least 0 is expected, not {weight!r}")
        self.weight, self.order = weight, (1, float(weight))

    def cost(self, depth: Tensor, log_prob: Tensor, left: Tensor) -> Tensor:
        return left.double() if self.weight == inf else depth + self.weight * left.double()


class _Trees:
    """The search trees of B problems, searched together: R of them still, `rows` numbers them among the B.

    A node is numbered in the order of expansion, and its edge by action a is node * A + a. Of each node are kept the
    edge that led to it, its depth and the rewards of its path, its state, and the prior's; since the last root on its
    path, which without rerooting is the start, the actions (`since`) and their log-probability; and of all nodes on its
    path the highest log(d / pi) from the root before them (`peak`) and the lowest `World.lower_bound` (`least`).
    """

    def __init__(self, planner: BestFirstPlanner, world: World, stepper: Stepper, state: Tensor) -> None:
        self.planner, self.world, self.stepper, self.actions = planner, world, stepper, world.num_actions
        self.lower_bound: Heuristic | None = getattr(world, "lower_bound", None) if planner.reroot else None
        batch, device = len(state), state.device
        self.rows = torch.arange(batch, device=device)
        self.size = torch.zeros(batch, dtype=torch.long, device=device)
        self.capacity = min(FIRST_NODES, planner.max_nodes)
        self.steps = torch.zeros(batch, dtype=torch.long, device=device)
        self.paths: list[Tensor] = [torch.empty(0, dtype=torch.long, device=device)] * batch
        empty = torch.zeros(batch, dtype=torch.long, device=device)
        self.result = Search(
            world.solved(state), empty[:, None], empty, empty.double(), state.clone(), empty.clone(),
            torch.full((batch,), inf, dtype=torch.float64, device=device), empty.clone(),
        )  # fmt: skip
        self.result.log_bound[self.result.solved] = 0.0
        logits, hidden = stepper.start_in(world, state)
        self.queue = self.minima = torch.zeros(0, 0, dtype=torch.float64, device=device)
        self.seen = torch.zeros(0, 0, dtype=torch.long, device=device)
        self.nodes = {
            "edge": torch.full((batch, self.capacity), -1, device=device),
            **{name: torch.zeros(batch, self.capacity, dtype=torch.long, device=device) for name in ("depth", "since")},
            **{
                name: torch.zeros(batch, self.capacity, dtype=torch.float64, device=device)
                for name in ("log_prob", "peak", "least", "gain", "left")
            },
            "state": state.new_zeros(batch, self.capacity, *state.shape[1:]),
            "hidden": hidden.new_zeros(batch, self.capacity, *hidden.shape[1:]),
            "action_log_prob": torch.zeros(batch, self.capacity, self.actions, dtype=torch.float64, device=device),
        }
        self._make_room(batch)
        every = torch.arange(batch, device=device)
        self._insert(every, row_hashes(state))
        path = {name: self.nodes[name][:, 0].clone() for name in PATH}
        path |= {"edge": torch.full_like(every, -1), "least": torch.full_like(path["peak"], inf)}
        self._add(every, path, state, logits, hidden)
        self.size[self.result.solved] = 0
        self._drop(self.result.solved | (self.size >= planner.max_nodes) | (self.minima.amin(1) == inf))

    @property
    def active(self) -> bool:
        """Whether a problem is still searched for."""
        return len(self.rows) > 0

    def found(self) -> Search:
        """The results, once every search has ended."""
        plans = torch.nn.utils.rnn.pad_sequence(self.paths, batch_first=True) if self.paths else self.result.plan[:, :0]
        return self.result._replace(plan=plans.to(action_dtype(self.actions)))

    def expand_best(self) -> None:
        """Expand the best nodes of each tree."""
        tree, edge = self._popped()
        parent, action = edge.div(self.actions, rounding_mode="floor"), edge % self.actions
        node = self.nodes
        state, reward = self.world.step(node["state"][tree, parent], action)
        self.steps.index_add_(0, tree, torch.ones_like(tree))
        path = {name: node[name][tree, parent] for name in PATH} | {"edge": edge}
        path["depth"] += 1
        path["since"] += 1
        path["log_prob"] += node["action_log_prob"][tree, parent, action]
        path["peak"] = path["peak"].maximum((path["since"].double() + 1).log() - path["log_prob"])
        path["gain"] += reward.double()
        new = self._insert(tree, row_hashes(state))
        solved = new & self.world.solved(state)
        over = self._finish(tree[solved], {name: x[solved] for name, x in path.items()}, state[solved])
        # Of trees that reached their goal, and beyond the budget, nothing more is expanded.
        wanted = new & ~over[tree]
        rank = _rank(tree, wanted)
        wanted &= self.size[tree] + rank < self.planner.max_nodes
        tree, state, action, parent = (x[wanted] for x in (tree, state, action, parent))
        if len(tree):
            hidden = node["hidden"][tree, parent]
            logits, hidden = self.stepper.step_in(self.world, action, hidden, state)
            self._add(tree, {name: x[wanted] for name, x in path.items()}, state, logits, hidden)
        self._drop(over | (self.size >= self.planner.max_nodes) | (self.minima.amin(1) == inf))

    def _popped(self) -> tuple[Tensor, Tensor]:
        """The trees `[M]` and edges `[M]` of the lowest costs, taken out of the queue, the best of each tree first."""
        trees, edges = [], []
        every = torch.arange(len(self.rows), device=self.rows.device)
        blocks = self.queue.view(len(self.rows), -1, BLOCK)
        for _ in range(self.planner.nodes_at_once):
            block = self.minima.argmin(1)
            within = blocks[every, block].argmin(1)
            there = blocks[every, block, within] < inf
            trees.append(every[there])
            edges.append((block * BLOCK + within)[there])
            blocks[every, block, within] = inf
            self.minima[every, block] = blocks[every, block].amin(1)
        return torch.cat(trees), torch.cat(edges)

    def _add(self, tree: Tensor, path: dict[str, Tensor], state: Tensor, logits: Tensor, hidden: Tensor) -> None:
        """Expand new nodes `[M]` with what is known of their `path`: enter them, and their edges into the queue."""
        at = self.size[tree] + _rank(tree, torch.ones_like(tree, dtype=torch.bool))
        self.size.index_add_(0, tree, torch.ones_like(tree))
        while bool((self.size > self.capacity).any()):
            self._grow()
        own = torch.log_softmax(logits.double() / self.planner.temperature, -1)
        if bool(own.isnan().any()):
            raise ValueError("prior: its logits are NaN")
        legal = self.world.legal_actions(state) & ~self.world.terminated(state)[:, None]
        left, of_children = self._left(tree, state, legal)
        if self.lower_bound is not None:
            bound = value_of(self.lower_bound, state, "lower_bound").double()
            rooted = bound < path["least"]
            path |= {name: path[name].masked_fill(rooted, 0) for name in ("since", "log_prob")}
            path["least"] = path["least"].minimum(bound)
            left = bound if self.planner.heuristic is None else left
        named = {"left": left, "state": state, "hidden": hidden, "action_log_prob": own}
        for name, values in (path | named).items():
            self.nodes[name][tree, at] = values
        depth = (path["since"] + 1)[:, None].expand_as(own)
        cost = self.planner.cost(depth, path["log_prob"][:, None] + own, of_children)
        edges = at[:, None] * self.actions + torch.arange(self.actions, device=at.device)
        self.queue[tree[:, None], edges] = cost.masked_fill(~legal | cost.isnan(), inf)
        block = edges.div(BLOCK, rounding_mode="floor")
        shape = len(self.rows), self.minima.shape[1]
        flat = (tree[:, None] * shape[1] + block).flatten()
        least = self.queue[tree[:, None], edges].flatten()
        self.minima = self.minima.flatten().scatter_reduce(0, flat, least, "amin").view(shape)

    def _left(self, tree: Tensor, state: Tensor, legal: Tensor) -> tuple[Tensor, Tensor]:
        """What the heuristic says of nodes `[M]`, and of their children `[M, A]`."""
        heuristic = self.planner.heuristic
        if heuristic is None:
            return torch.zeros(len(state), dtype=torch.float64, device=state.device), torch.zeros(
                legal.shape, dtype=torch.float64, device=state.device
            )
        where, action = legal.nonzero(as_tuple=True)
        reached, _ = self.world.step(state[where], action)
        self.steps.index_add_(0, tree[where], torch.ones_like(where))
        children = torch.zeros(legal.shape, dtype=torch.float64, device=state.device)
        children[where, action] = value_of(heuristic, reached, "heuristic").double()
        if bool((children < 0).any()):
            raise ValueError("heuristic: numbers of at least 0, of steps that are left, are expected")
        return value_of(heuristic, state, "heuristic").double(), children

    def _insert(self, tree: Tensor, hashes: Tensor) -> Tensor:
        """Enter states, by their `hashes [M]`, into the hash tables: which of them are new, bool `[M]`.

        Of equal ones the first is new.
        """
        places = self.seen.shape[1]
        place, new = hashes & (places - 1), torch.zeros_like(hashes, dtype=torch.bool)
        left = torch.arange(len(hashes), device=hashes.device)
        table = self.seen.view(-1)
        while len(left):
            flat = tree[left] * places + place[left]
            there = table[flat]
            free = there == EMPTY
            claims = left[free]
            slots, which = flat[free].unique(return_inverse=True)
            first = torch.full_like(slots, len(hashes)).scatter_reduce(0, which, claims, "amin")
            table[slots] = hashes[first]
            new[first] = True
            place[left[~free]] += 1
            place &= places - 1
            left = left[~new[left] & (there != hashes[left])]
        return new

    def _make_room(self, trees: int) -> None:
        """A queue and hash tables for `capacity` nodes a tree."""
        device, edges = self.rows.device, self.capacity * self.actions
        blocks = -(-edges // BLOCK)
        self.queue = torch.full((trees, blocks * BLOCK), inf, dtype=torch.float64, device=device)
        self.minima = torch.full((trees, blocks), inf, dtype=torch.float64, device=device)
        places = 2 ** (4 * self.capacity + self.planner.nodes_at_once).bit_length()
        self.seen = torch.full((trees, places), EMPTY, device=device)

    def _grow(self) -> None:
        """Twice the room for nodes."""
        trees, old, queue, minima, seen = len(self.rows), self.capacity, self.queue, self.minima, self.seen
        self.capacity *= 2
        self._make_room(trees)
        self.queue[:, : queue.shape[1]], self.minima[:, : minima.shape[1]] = queue, minima
        tree, place = (seen != EMPTY).nonzero(as_tuple=True)
        self._insert(tree, seen[tree, place])
        for name, values in self.nodes.items():
            more = values.new_zeros(trees, self.capacity - old, *values.shape[2:])
            self.nodes[name] = torch.cat([values, more], 1)

    def _finish(self, tree: Tensor, path: dict[str, Tensor], state: Tensor) -> Tensor:
        """Take the first solution of each tree; which trees have one, bool `[R]`."""
        over = torch.zeros(len(self.rows), dtype=torch.bool, device=tree.device)
        first = _rank(tree, torch.ones_like(tree, dtype=torch.bool)) == 0
        tree, edge, depth, gain, state = (x[first] for x in (tree, *(path[name] for name in TAKEN), state))
        over[tree] = True
        row, found = self.rows[tree], self.result
        found.solved[row] = True
        entered = torch.arange(self.capacity, device=tree.device) < self.size[tree][:, None]
        roots = ((self.nodes["since"][tree] == 0) & entered).sum(1)
        found.log_bound[row] = roots.double().log() + path["peak"][first]
        self._take(tree, edge, depth, gain, state)
        return over

    def _take(self, tree: Tensor, edge: Tensor, depth: Tensor, gain: Tensor, state: Tensor) -> None:
        """Write the paths `[M]` that end with `edge` to the results."""
        row, found = self.rows[tree], self.result
        found.lengths[row], found.score[row], found.final_state[row] = depth, gain, state
        longest = int(depth.max()) if len(depth) else 0
        plan, now = torch.zeros(len(tree), longest, dtype=torch.long, device=tree.device), edge
        for back in range(1, longest + 1):
            on_path = now >= 0
            plan[on_path, (depth - back)[on_path]] = now[on_path] % self.actions
            node = now.clamp(min=0).div(self.actions, rounding_mode="floor")
            now = torch.where(on_path, self.nodes["edge"][tree, node], now)
        for one, number, path in zip(row.tolist(), depth.tolist(), plan, strict=True):
            self.paths[one] = path[:number]

    def _drop(self, over: Tensor) -> None:
        """Leave the trees that are `over`, bool `[R]`; those without a solution with their best node."""
        if not bool(over.any()):
            return
        ended = over.nonzero()[:, 0]
        row = self.rows[ended]
        self.result.expansions[row], self.result.model_steps[row] = self.size[ended], self.steps[ended]
        lost = ended[~self.result.solved[row]]
        if len(lost):
            beyond = torch.arange(self.capacity, device=lost.device) >= self.size[lost][:, None]
            gain = self.nodes["gain"][lost].masked_fill(beyond, -inf)
            left = self.nodes["left"][lost].masked_fill(gain < gain.amax(1, keepdim=True), inf)
            best = left.argmin(1)
            self._take(lost, *(self.nodes[name][lost, best] for name in (*TAKEN, "state")))
        kept = (~over).nonzero()[:, 0]
        self.rows, self.size, self.steps = self.rows[kept], self.size[kept], self.steps[kept]
        self.queue, self.minima, self.seen = self.queue[kept], self.minima[kept], self.seen[kept]
        self.nodes = {name: values[kept] for name, values in self.nodes.items()}


class _ByDepth(Stepper):
    """Steps a prior whose states change their size, as those of networks that read a window, along with the actions.

    Rows of its states can only be stepped together with as many actions behind them. States are kept here, by depth;
    what is given out in their place is their depth and their row there, int64 `[N, 2]`.
    """

    def __init__(self, prior: Steppable) -> None:
        super().__init__(prior, in_place=False)
        self._states, self._used = list[Tensor](), list[int]()

    def start_in(self, world: World, state: Tensor) -> tuple[Tensor, Tensor]:
        logits, own = super().start_in(world, state)
        return logits, self._keep(0, own)

    def step_in(
        self, world: World, action: Tensor, state: Tensor, reached: Tensor, room: int = 0
    ) -> tuple[Tensor, Tensor]:
        parts, places = [], torch.empty_like(state)
        for depth in state[:, 0].unique().tolist():
            rows = (state[:, 0] == depth).nonzero()[:, 0]
            own = self._states[depth][state[rows, 1]]
            logits, after = super().step_in(world, action[rows], own, reached[rows])
            places[rows] = self._keep(depth + 1, after)
            parts.append((rows, logits))
        order = torch.cat([rows for rows, _ in parts]).argsort()
        return torch.cat([logits for _, logits in parts])[order], places

    def _keep(self, depth: int, own: Tensor) -> Tensor:
        """Where states `[M, ...]` are kept: `[M, 2]`."""
        if depth == len(self._states):
            self._states.append(own[:0])
            self._used.append(0)
        first, last = self._used[depth], self._used[depth] + len(own)
        if last > len(self._states[depth]):
            room = own.new_empty(2 * last, *own.shape[1:])
            room[:first] = self._states[depth][:first]
            self._states[depth] = room
        self._states[depth][first:last] = own
        self._used[depth] = last
        row = torch.arange(first, last, device=own.device)
        return torch.stack([torch.full_like(row, depth), row], 1)


def _stepper(prior: Steppable, world: World, state: Tensor) -> Stepper:
    """How a search steps a prior from `state [B, ...]`, whose nodes have different depths."""
    stepper = Stepper(prior, in_place=False)
    _, before = stepper.start_in(world, state[:1])
    if len(before) == 0:
        return stepper
    _, after = stepper.step_in(world, torch.zeros(1, dtype=torch.long, device=state.device), before, state[:1])
    return stepper if after.shape == before.shape else _ByDepth(prior)


def _rank(tree: Tensor, counted: Tensor) -> Tensor:
    """How many earlier entries of each entry's tree are counted, `[M]`."""
    order = tree.argsort(stable=True)
    ones = counted[order].long()
    before = ones.cumsum(0) - ones
    sorted_tree = tree[order]
    starts = torch.ones_like(sorted_tree, dtype=torch.bool)
    starts[1:] = sorted_tree[1:] != sorted_tree[:-1]
    base = before[starts][starts.long().cumsum(0) - 1] if len(tree) else before
    rank = torch.empty_like(before)
    rank[order] = before - base
    return rank


def _followed(world: World, state: Tensor, plans: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
    """Where plans `[B, L]` end, and the sum of their rewards, float64 `[B]`."""
    score = torch.zeros(len(state), dtype=torch.float64, device=state.device)
    for t in range(plans.shape[1]):
        on = lengths > t
        state = state.clone()
        state[on], reward = world.step(state[on], plans[on, t].long())
        score[on] += reward.double()
    return state, score
