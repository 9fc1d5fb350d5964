"""Monte Carlo tree search by compiled loops, for `neuroprior.planners.mcts`; importing this loads numba.

`descend` and `back_up` serve every world and prior; `search` also steps a table and evaluates a prior itself.
"""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from neuroprior._threads import one_thread
from neuroprior.planners.planner import PriorPlanner
from neuroprior.plans import action_dtype
from neuroprior.priors.counts.history_prior import HistoryPrior
from neuroprior.priors.neural.compiled_gru import BLOCK, Network, advance, on_one_thread
from neuroprior.priors.neural.gru import GRUPrior
from neuroprior.priors.uniform import UniformPrior
from neuroprior.sampling.draws import check_possible
from neuroprior.sampling.stepping import Steppable, Stepper
from neuroprior.worlds.tabular import TabularWorld
from neuroprior.worlds.world import World

Array = np.ndarray[Any, Any]

DRAWS = 2**18
"""Uniform numbers that are drawn at once."""

ROWS = 2**16
"""Rows of tables that are made for a decision, however few its steps: still quicker than one step after another."""

SHARED = 2**15
"""Hidden units of all starts' networks from which threads share the starts; tables are too fast for it."""

NO_NETWORK = tuple(np.empty((0,) * dims, np.float32) for dims in (2, 3, 2, 3, 2, 3, 2, 2, 1))
"""The parts of a `Network`, for a table."""


class Nodes(NamedTuple):
    """What selection and backup need of the trees; see `neuroprior.planners.mcts.Trees`."""

    child: Array
    visits: Array
    total: Array
    closed: Array
    probs: Array
    low: Array
    high: Array


class Trees(NamedTuple):
    """What is kept of each node beside `Nodes`, and of each start, where the loop steps the world and the prior.

    Attributes:
        state: int64 `[B, M]`.
        reward: float64 `[B, M]`, of the step into the node.
        code: int64 `[B, M]`: the history, for a prior that is a table.
        hidden: float32 `[B, M, K H]`: the hidden states of the K layers of a network.
        size, left, over: `[B]`: nodes so far, simulator steps left, and whether they are too few for the next plan.
    """

    state: Array
    reward: Array
    code: Array
    hidden: Array
    size: Array
    left: Array
    over: Array


class Moves(NamedTuple):
    """A deterministic table.

    Attributes:
        after: int64 `[S * A]`: the cell that each action leads to.
        reward: float64: `[W * S]` on arrival, `[W * S * A]` on acting.
        on_arrival: which of the two.
        cells: S.
    """

    after: Array
    reward: Array
    on_arrival: bool
    cells: int


class Policy(NamedTuple):
    """A prior: a table of histories, or a gated recurrent network.

    Attributes:
        context: int64 `[W * S]`: the context in each state; empty: there is none.
        each_step: whether the context is that of each state, not of the start alone.
        after: int64 `[F, A]`: the history after each history and action.
        row: int64 `[F, C]`: the row of the tables for each history and context.
        weights: float32 `[R, A]`: cumulative unnormalised probabilities.
        probs: float64 `[R, A]`.
        by_context: float32 `[C, 3 H]`: what each context adds to the gates of the first layer of a network.
        network: H is 0 for a table.
        temperature: divides logits.
    """

    context: Array
    each_step: bool
    after: Array
    row: Array
    weights: Array
    probs: Array
    by_context: Array
    network: Network
    temperature: float


@njit(cache=True, nogil=True, error_model="numpy")
def descend(
    nodes: Nodes, rows: Array, exploration: float, draws: Array, path: Array, plan: Array, depth: Array, first: Array
) -> int:
    """Follow PUCT in the trees of the starts `rows [K]` down to an action that was not tried yet.

    Args:
        nodes: the trees.
        rows: int64 `[K]`.
        exploration: c.
        draws: float32: uniform numbers, at least K * L * (1 + A). At each depth K numbers are left to draw actions
            with, and each tree that is still descended in takes A to break ties.
        path: int64 `[K, L]`: gets the nodes; -1 beyond.
        plan: int64 `[K, L]`: gets the actions up to the one that was not tried.
        depth: int64 `[K]`: gets how many actions come before it.
        first: int64 `[L]`: gets where in `draws` the K numbers of each depth begin.

    Returns:
        How many numbers were taken.
    """
    batch, length = path.shape
    actions = nodes.child.shape[2]
    path[:] = -1
    depth[:] = -1
    now = np.zeros(batch, dtype=np.int64)
    used = 0
    for t in range(length):
        first[t] = used
        used += batch
        for k in range(batch):
            if depth[k] >= 0:
                continue
            b, node = rows[k], now[k]
            tries, whole = 0, 0.0
            for a in range(actions):
                tries += nodes.visits[b, node, a]
                whole += nodes.total[b, node, a]
            low, span = nodes.low[b], nodes.high[b] - nodes.low[b]
            root = np.sqrt(float(max(tries, 1)))
            best, top, chosen = -np.inf, -1.0, -1
            for a in range(actions):
                if nodes.closed[b, node, a]:
                    continue
                n, value = nodes.visits[b, node, a], 0.5
                if tries > 0 and span > 0:
                    value = ((nodes.total[b, node, a] / n if n > 0 else whole / tries) - low) / span
                merit = value + exploration * nodes.probs[b, node, a] * root / (1 + n)
                draw = draws[used + a]
                if merit > best or chosen < 0 or (merit == best and draw > top):
                    best, top, chosen = merit, draw, a
            used += actions
            path[k, t], plan[k, t] = node, chosen
            now[k] = nodes.child[b, node, chosen]
            if now[k] == 0:
                depth[k] = t
    return used


@njit(cache=True, nogil=True, error_model="numpy")
def back_up(nodes: Nodes, rows: Array, path: Array, plan: Array, score: Array) -> None:
    """Count plans `[K, L]` and their scores (float64) at the nodes of their `path [K, L]` (-1: outside of the tree)."""
    actions = nodes.child.shape[2]
    for k in range(len(rows)):
        b, worth = rows[k], score[k]
        if np.isfinite(worth):
            nodes.low[b], nodes.high[b] = min(nodes.low[b], worth), max(nodes.high[b], worth)
        else:  # counts as the lowest, or highest, finite one so far
            worth = nodes.high[b] if worth > 0 else nodes.low[b]
            worth = worth if np.isfinite(worth) else 0.0
        finished = path[k, -1] >= 0  # after the last action there is nothing more to try
        for t in range(path.shape[1] - 1, -1, -1):
            node = path[k, t]
            if node < 0:
                continue
            nodes.visits[b, node, plan[k, t]] += 1
            nodes.total[b, node, plan[k, t]] += worth
            nodes.closed[b, node, plan[k, t]] |= finished
            finished = True
            for a in range(actions):
                finished &= nodes.closed[b, node, a]


@njit(cache=True, nogil=True, error_model="numpy")
def _evaluate(
    policy: Policy,
    which: Array,
    plans: Array,
    t: int,
    observed: Array,
    code: Array,
    hidden: Array,
    weights: Array,
    probs: Array,
    work: tuple[Array, Array, Array, Array],
) -> None:
    """Step the prior after the actions of step `t` of the plans `which [n]`, of all K.

    Args:
        policy: the prior.
        which: the plans that it is stepped for.
        plans: `[K, L]`.
        t: the step.
        observed: `[K]`: the states whose contexts the prior is given.
        code, hidden: `[K]` and `[K, layers * H]`: its state, which is overwritten.
        weights, probs: `[K, A]`: get its predictions: cumulative unnormalised probabilities, and probabilities.
        work: room for `BLOCK` rows of all layers' states, products, gates and logits.
    """
    (layers, size, _), actions = policy.network.recurrent.shape, weights.shape[1]
    if size == 0:
        for k in which:
            code[k] = policy.after[code[k], plans[k, t]]
            row = policy.row[code[k], policy.context[observed[k]] if len(policy.context) else 0]
            for a in range(actions):
                weights[k, a], probs[k, a] = policy.weights[row, a], policy.probs[row, a]
        return
    # Single numbers are indexed, not rows: numba counts references to each row, which takes as long as all else here.
    states, product, gates, logits = work
    action, past, beyond = policy.network.action, policy.network.past, policy.network.beyond
    for begin in range(0, len(which), BLOCK):
        number = min(BLOCK, len(which) - begin)
        for i in range(number):
            k = which[begin + i]
            last = plans[k, t]
            for j in range(3 * size):
                gates[i, j] = action[last, j]
            for lag in range(min(len(past), t + 2)):
                before = plans[k, t - lag] if lag <= t else len(action) - 1  # the start symbol
                for j in range(3 * size):
                    gates[i, j] += past[lag, before, j]
            if len(beyond) and t + 2 > len(past):
                for j in range(3 * size):
                    gates[i, j] += beyond[0, j]
            if len(policy.context):
                now = policy.context[observed[k]]
                for j in range(3 * size):
                    gates[i, j] += policy.by_context[now, j]
            for layer in range(layers):
                for j in range(size):
                    states[layer, i, j] = hidden[k, layer * size + j]
        advance(policy.network, number, states, gates, product, logits)
        for i in range(number):
            k = which[begin + i]
            for layer in range(layers):
                for j in range(size):
                    hidden[k, layer * size + j] = states[layer, i, j]
            top, total = np.float32(-np.inf), 0.0
            for a in range(actions):
                top = max(top, logits[i, a])
            for a in range(actions):
                probs[k, a] = np.exp((logits[i, a] - top) / policy.temperature)
                total += probs[k, a]
                weights[k, a] = total
            for a in range(actions):
                probs[k, a] /= total


class Descent(NamedTuple):
    """Room for what `descend` finds for B starts: the arguments of these names, and `rows [B]`."""

    rows: Array
    path: Array
    plan: Array
    depth: Array
    first: Array


class Room(NamedTuple):
    """Room for what `follow` needs of each of K plans, and `_evaluate` of a block of them.

    Attributes:
        alive: `[K]`: whether the budget allows the plan.
        score: float64 `[K]`.
        cell, observed: int64 `[K]`: where it is, and the state whose context the prior is given.
        code, hidden: `[K]` and `[K, layers * H]`: the prior's state.
        weights, probs: `[K, A]`: its predictions, see `_evaluate`.
        which: int64 `[K]`: the plans that are stepped.
        block: float32: `BLOCK` rows of all layers' states, products, gates and logits.
    """

    alive: Array
    score: Array
    cell: Array
    observed: Array
    code: Array
    hidden: Array
    weights: Array
    probs: Array
    which: Array
    block: Any


class Simulations(NamedTuple):
    """What comes of the simulations: `[N, B, L]` plans, the reward of each step (float64) and the state after it, and
    which plans there are: bool `[N, B]`."""

    plans: Array
    rewards: Array
    states: Array
    done: Array


@njit(cache=True, nogil=True, error_model="numpy")
def begin(nodes: Nodes, trees: Trees, exploration: float, draws: Array, descent: Descent) -> tuple[int, int]:
    """Descend in the trees of the starts that may be extended.

    Returns:
        How many these are, 0 where the `draws` might not suffice; and how many numbers were taken.
    """
    rows, path, plan, depth, first = descent
    number = 0
    for b in range(len(trees.left)):
        if trees.left[b] > 0 and not trees.over[b] and not nodes.closed[b, 0].all():
            rows[number] = b
            number += 1
    if len(draws) < number * path.shape[1] * (1 + nodes.child.shape[2]):
        number = 0
    if number == 0:
        return 0, 0
    descent_arguments = rows[:number], exploration, draws, path[:number], plan[:number], depth[:number], first
    return number, descend(nodes, *descent_arguments)


@njit(cache=True, nogil=True, error_model="numpy")
def follow(
    nodes: Nodes,
    trees: Trees,
    moves: Moves,
    policy: Policy,
    discounts: Array,
    any_prefix: bool,
    simulation: int,
    rows: Array,
    path: Array,
    plan: Array,
    depth: Array,
    draws: Array,
    first: Array,
    room: Room,
    simulations: Simulations,
) -> None:
    """Follow plans to their ends, one from each of the starts `rows [K]`, and count them in the trees.

    Args:
        nodes, trees: see the classes; extended.
        moves, policy: the world and the prior.
        discounts: float64 `[L]`: weights of rewards in a return; empty: the last reward counts.
        any_prefix: whether a plan is worth its best prefix.
        simulation: the number of the plans.
        rows, path, plan, depth: of `descend`; overwritten.
        draws: float32: uniform numbers; that of row k at step t is `first[t] + k`.
        first: int64 `[L]`.
        room: for K plans.
        simulations: gets the plans.
    """
    length, actions, size = path.shape[1], nodes.child.shape[2], trees.hidden.shape[2]
    alive, score, cell, observed, code, hidden, weights, probs, which, block = room
    for k in range(len(rows)):
        b = rows[k]
        # A plan that the budget does not allow to the end is not begun.
        alive[k] = trees.left[b] >= length - depth[k]
        trees.over[b] |= not alive[k]
        simulations.done[simulation, b] = alive[k]
        observed[k] = trees.state[b, 0]
        for t in range(depth[k]):
            child = path[k, t + 1]
            simulations.states[simulation, b, t] = trees.state[b, child]
            simulations.rewards[simulation, b, t] = trees.reward[b, child]
    for t in range(length):
        going = 0
        for k in range(len(rows)):
            if depth[k] > t or not alive[k]:
                continue
            b, action = rows[k], plan[k, t]
            if depth[k] == t:
                node = path[k, t]
                cell[k], code[k] = trees.state[b, node], trees.code[b, node]
                for j in range(size):
                    hidden[k, j] = trees.hidden[b, node, j]
            else:
                total, action = weights[k, actions - 1], 0
                mark = draws[first[t] + k] * total
                while weights[k, action] <= mark and weights[k, action] < total:
                    action += 1
                plan[k, t] = action
            at = cell[k] % moves.cells
            maps = cell[k] - at
            taken = at * actions + action
            cell[k] = moves.after[taken] + maps
            gained = moves.reward[cell[k] if moves.on_arrival else taken + maps * actions]
            simulations.states[simulation, b, t], simulations.rewards[simulation, b, t] = cell[k], gained
            trees.left[b] -= 1
            if policy.each_step:
                observed[k] = cell[k]
            which[going] = k
            going += 1
        if t + 1 < length:
            _evaluate(policy, which[:going], plan, t, observed, code, hidden, weights, probs, block)
        for i in range(going):
            k = which[i]
            if depth[k] != t:
                continue
            b = rows[k]
            new = trees.size[b]
            trees.size[b] += 1
            nodes.child[b, path[k, t], plan[k, t]] = new
            # Number by number: an assignment of rows takes numba longer to compile, since it words an error of shapes.
            for a in range(actions):
                nodes.child[b, new, a], nodes.visits[b, new, a], nodes.total[b, new, a] = 0, 0, 0.0
                nodes.closed[b, new, a], nodes.probs[b, new, a] = False, probs[k, a]
            trees.state[b, new], trees.reward[b, new] = cell[k], simulations.rewards[simulation, b, t]
            trees.code[b, new] = code[k]
            for j in range(size):
                trees.hidden[b, new, j] = hidden[k, j]
    going = 0
    for k in range(len(rows)):
        if not alive[k]:
            continue
        b = rows[k]
        total, best = 0.0, -np.inf
        for t in range(length):
            simulations.plans[simulation, b, t] = plan[k, t]
            gained = simulations.rewards[simulation, b, t]
            total = total + gained * discounts[t] if len(discounts) else gained
            best = max(best, total)
            path[going, t], plan[going, t] = path[k, t], plan[k, t]
        rows[going], score[going] = b, best if any_prefix else total
        going += 1
    back_up(nodes, rows[:going], path[:going], plan[:going], score[:going])


@njit(cache=True, nogil=True, error_model="numpy")
def search(
    nodes: Nodes,
    trees: Trees,
    moves: Moves,
    policy: Policy,
    discounts: Array,
    any_prefix: bool,
    exploration: float,
    draws: Array,
    descent: Descent,
    room: Room,
    simulations: Simulations,
) -> tuple[int, int]:
    """Simulate plans, one from each unfinished start at a time: all on one thread.

    Args:
        nodes, trees, moves, policy, discounts, any_prefix, room, simulations: see `follow`.
        exploration: c.
        draws: float32: uniform numbers.
        descent: room for all starts.

    Returns:
        Simulations that were made: fewer than N where all starts are finished, or where the `draws` do not suffice for
        another one for sure; and the draws that were taken.
    """
    rows, path, plan, depth, first = descent
    used = 0
    for simulation in range(len(simulations.plans)):
        unused = draws[used:]
        number, taken = begin(nodes, trees, exploration, unused, descent)
        if number == 0:
            return simulation, used
        used += taken
        simulations.done[simulation] = False
        follow(
            nodes, trees, moves, policy, discounts, any_prefix, simulation,
            rows[:number], path[:number], plan[:number], depth[:number], unused, first, room, simulations,
        )  # fmt: skip
    return len(simulations.plans), used


def search_all(
    planner: Any, world: TabularWorld, state: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
    """What `neuroprior.planners.mcts` looks for; see `_Trees.search` there."""
    threads = torch.get_num_threads()
    with one_thread():  # operations on a few numbers, in which threads would only wait for one another
        return _search_all(planner, world, state, generator, threads)


def _search_all(
    planner: Any, world: TabularWorld, state: Tensor, generator: torch.Generator, threads: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
    """As `search_all`, by so many threads."""
    batch, actions, length = len(state), world.num_actions, planner.length
    steps = planner.num_plans * length
    policy = policy_of(planner.prior, world, planner.temperature)
    parts = policy.probs, policy.by_context, *policy.network
    check_possible(not any(np.isnan(array).any() for array in parts))
    logits, hidden = Stepper(planner.prior).start_in(world, state)
    (layers, size, _), most = policy.network.recurrent.shape, batch * length * (1 + actions)
    room, number = max(min(DRAWS // most, 2 * planner.num_plans), 1), 0
    shape = (batch, min(room, steps) + 1, actions)
    nodes = Nodes(
        np.empty(shape, np.int64), np.empty(shape, np.int32), np.empty(shape), np.empty(shape, np.bool_),
        np.empty(shape), np.full(batch, np.inf), np.full(batch, -np.inf),
    )  # fmt: skip
    trees = Trees(
        np.empty(shape[:2], np.int64), np.empty(shape[:2]), np.empty(shape[:2], np.int64),
        np.empty((*shape[:2], layers * size), np.float32), np.ones(batch, np.int64), np.full(batch, steps),
        np.zeros(batch, np.bool_),
    )  # fmt: skip
    nodes.child[:, 0], nodes.visits[:, 0], nodes.total[:, 0], nodes.closed[:, 0] = 0, 0, 0, False
    nodes.probs[:, 0] = (logits.double() / planner.temperature).softmax(1).numpy()
    trees.state[:, 0] = state.numpy()
    trees.code[:, 0] = int(planner.prior.start_node) if isinstance(planner.prior, HistoryPrior) else 0
    if isinstance(planner.prior, GRUPrior):
        layers_state, _ = hidden[1] if planner.prior.takes_context else hidden
        trees.hidden[:, 0] = layers_state.flatten(1).numpy()
    moves = Moves(
        world.next_state.view(-1).numpy(), world.reward.reshape(-1).numpy(), world.reward.dim() == 2, world.num_states
    )
    discounts = np.empty(0)
    if planner.objective == "return":
        discounts = planner.discounts(torch.empty(length, dtype=torch.float64))[:-1].numpy()
    threads = threads if batch * layers * size >= SHARED and on_one_thread(size, actions) else 1
    each = -(-batch // threads)
    descent = Descent(
        np.empty(batch, np.int64), np.empty((batch, length), np.int64), np.empty((batch, length), np.int64),
        np.empty(batch, np.int64), np.empty(length, np.int64),
    )  # fmt: skip
    rooms = [_room(min(each, batch - begin), layers, size, actions) for begin in range(0, batch, each)]
    results = list[tuple[Tensor, ...]]()
    with ThreadPoolExecutor(threads) if threads > 1 else nullcontext() as pool:
        while not results or number == room:
            if trees.size.max() + room > nodes.child.shape[1]:  # each simulation adds a node
                nodes, trees = Nodes(*map(_widen, nodes)), Trees(*map(_widen, trees))
            kinds = action_dtype(actions), torch.float64, torch.int64
            out = *(torch.empty(room, batch, length, dtype=kind) for kind in kinds), torch.empty(room, batch) > 0
            before = generator.get_state()
            draws = torch.rand(room * most, generator=generator)
            simulations = Simulations(*(column.numpy() for column in out))
            if pool is None:
                number, used = search(
                    nodes, trees, moves, policy, discounts, planner.any_prefix, planner.exploration, draws.numpy(),
                    descent, rooms[0], simulations,
                )  # fmt: skip
            else:
                arguments = nodes, trees, moves, policy, discounts, planner.any_prefix
                number, used = _search_shared(
                    pool, arguments, planner.exploration, draws.numpy(), descent, rooms, simulations
                )
            generator.set_state(before)
            torch.rand(used, generator=generator)  # those that were not used are given back
            results.append(tuple(column[:number] for column in out))
    plans, rewards, states, done = (torch.cat(chunks).transpose(0, 1) for chunks in zip(*results, strict=True))
    taken = int(steps - trees.left.min())
    return plans, rewards.to(world.reward.dtype), states if planner.any_prefix else states[:, :, -1:], done, taken


def _search_shared(
    pool: ThreadPoolExecutor,
    arguments: tuple[Any, ...],
    exploration: float,
    draws: Array,
    descent: Descent,
    rooms: list[Room],
    simulations: Simulations,
) -> tuple[int, int]:
    """As `search`, where threads share what comes after each descent: the same plans, since one draws the numbers.

    Args:
        pool: the threads.
        arguments: the first six of `follow`.
        exploration, draws, descent, simulations: as for `search`.
        rooms: room for each part of the starts.
    """
    nodes, trees = arguments[:2]
    to_the_end: Any = follow
    used = 0
    for simulation in range(len(simulations.plans)):
        unused = draws[used:]
        number, taken = begin(nodes, trees, exploration, unused, descent)
        if number == 0:
            return simulation, used
        used += taken
        simulations.done[simulation] = False
        on_the_way, each = [x[:number] for x in descent[:4]], -(-number // len(rooms))

        def follow_chunk(at: int) -> None:
            chunk = [x[at : at + each] for x in on_the_way]  # noqa: B023
            to_the_end(*arguments, simulation, *chunk, unused[at:], descent.first, rooms[at // each], simulations)  # noqa: B023

        list(pool.map(follow_chunk, range(0, number, each)))
    return len(simulations.plans), used


def _room(number: int, layers: int, size: int, actions: int) -> Room:
    """Room for so many plans, layers, hidden units of each, and actions."""
    rows = BLOCK if size else 0
    return Room(
        np.empty(number, np.bool_), np.empty(number), np.empty(number, np.int64), np.empty(number, np.int64),
        np.empty(number, np.int64), np.empty((number, layers * size), np.float32),
        np.empty((number, actions), np.float32), np.empty((number, actions)), np.empty(number, np.int64),
        (
            np.empty((layers, rows, size), np.float32), np.empty((rows, 3 * size), np.float32),
            np.empty((rows, 3 * size), np.float32), np.empty((rows, actions), np.float32),
        ),
    )  # fmt: skip


def _widen(values: Array) -> Array:
    """Numbers of nodes, `[B, M, ...]`, with room for twice as many; those of starts, `[B]`, are left alone."""
    return values if values.ndim == 1 else np.concatenate([values, np.empty_like(values)], 1)


def can_search(planner: PriorPlanner, world: World, state: Tensor) -> bool:
    """Whether `search` knows the world and the prior, and its tables have at most `ROWS` rows, or one for each step."""
    prior = planner.prior
    if not isinstance(world, TabularWorld) or getattr(world.step, "__func__", None) is not TabularWorld.step:
        return False
    supported = world.all_legal and world.outcomes is None and planner.value is None
    supported = supported and world.reward.dtype in (torch.float32, torch.float64) and state.device.type == "cpu"
    if not supported or len(state) == 0 or not _knows(prior) or Stepper(prior).device != state.device:
        return False
    rows = len(prior.next_node) * (prior.num_contexts or 1) if isinstance(prior, HistoryPrior) else 0
    if getattr(prior, "context_per", None) is not None:
        rows += world.num_maps * world.num_states
    return rows <= max(len(state) * planner.num_plans * planner.length, ROWS)


def _knows(prior: Steppable) -> bool:
    """Whether `policy_of` can represent the prior."""
    if type(prior) is UniformPrior:
        return True
    if isinstance(prior, HistoryPrior):
        prior_class = type(prior)
        return (
            prior_class.start is HistoryPrior.start
            and prior_class.step is HistoryPrior.step
            and prior_class._outputs_at is HistoryPrior._outputs_at
        )
    return isinstance(prior, GRUPrior) and not prior.training and prior.is_plain


def policy_of(prior: Any, world: TabularWorld, temperature: float) -> Policy:
    """A prior for `search`."""
    context, each_step, actions = torch.empty(0, dtype=torch.long), True, world.num_actions
    observed = torch.empty(0)
    if isinstance(prior, HistoryPrior | GRUPrior) and prior.takes_context:
        each_step = prior.context_per == "step"
        observed = world.context(torch.arange(world.num_maps * world.num_states))
        context = torch.arange(len(observed))
    after, row, logits = torch.zeros(1, actions), torch.zeros(1, 1), torch.zeros(1, actions)
    network: Any = NO_NETWORK
    by_context = torch.empty(0, 0)
    if isinstance(prior, HistoryPrior):
        after, number = prior.next_node, prior.num_contexts or 1
        node = torch.arange(len(after)).repeat_interleave(number)
        row = prior._row(node, torch.arange(number).repeat(len(after))).view(len(after), number)
        logits, context = prior.log_probs, observed.long()
    elif isinstance(prior, GRUPrior):
        network = prior.arrays()
        if prior.takes_context:
            by_context = prior.context_gates(observed)
    weights = ((logits - logits.amax(1, keepdim=True)) / temperature).exp().T.cumsum(0).T
    probs = (logits.double() / temperature).softmax(1)
    kinds = (torch.int64, torch.int64, torch.float32, torch.float64, torch.float32)
    pairs = zip((after, row, weights, probs, by_context), kinds, strict=True)
    tables: Any = [x.detach().to(kind).contiguous().numpy() for x, kind in pairs]
    parts: Any = (context.numpy(), each_step, *tables, Network(*network), float(temperature))
    return Policy(*parts)
