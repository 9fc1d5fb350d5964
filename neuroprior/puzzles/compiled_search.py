"""Best-first search of Sokoban and sliding tiles by a compiled loop, for `neuroprior.puzzles.best_first`."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from torch import Tensor

from neuroprior._threads import share
from neuroprior.priors.uniform import UniformPrior
from neuroprior.puzzles.priors.compiled_fit import MIXER, hash_table, place
from neuroprior.puzzles.priors.log_linear import LogLinearPrior
from neuroprior.puzzles.worlds.puzzle import PuzzleWorld, flat_boards
from neuroprior.puzzles.worlds.rules import (
    ACTIONS,
    BOX,
    BOX_ON_GOAL,
    SOKOBAN,
    Array,
    Rules,
    can_move,
    count_misplaced,
    goal_distances,
    matching_room,
    move,
    pattern_room,
    read_board,
    steps_left,
    write_patterns,
)
from neuroprior.puzzles.worlds.sliding_tiles import SlidingTilesWorld
from neuroprior.puzzles.worlds.sokoban import SokobanWorld
from neuroprior.sampling.draws import check_possible
from neuroprior.worlds.world import World

LONGEST = 4096
"""Actions of a solution for which there is room at first."""

LEVIN, ADDITIVE = 0, 1
"""Orders of expansion: d / pi (with a heuristic that of PHS*), and depth + weight * heuristic."""


class Tables(NamedTuple):
    """The tables of a prior of patterns.

    Attributes:
        codes: int64 `[S]`, S a power of 2: a hash table of the codes that have weights; -1: free.
        weights: float32 `[S, A]`: what the code in the same place adds to the logits.
        after: float32 `[A + 1, A]`: what each last action adds to the logits; the last row: before the first.
    """

    codes: Array
    weights: Array
    after: Array


@njit(cache=True, nogil=True)
def _log_probs(tables: Tables, codes: Array, last: int, places: Array, there: Array, out: Array) -> None:
    """Write the log-probabilities of the actions at a position with these patterns to `out [A]` (float64).

    `places` and `there`, int64 `[F]`, are room for where the patterns should stand in the hash table, and what does.
    """
    for a in range(ACTIONS):
        out[a] = tables.after[last, a]
    # Loads that do not wait for one another: most of the time goes to waiting for memory.
    mask = np.uint64(len(tables.codes) - 1)
    for j in range(len(codes)):
        places[j] = ((np.uint64(codes[j]) * np.uint64(MIXER)) >> np.uint64(32)) & mask
    for j in range(len(codes)):
        there[j] = tables.codes[places[j]]
    for j in range(len(codes)):
        code, at = codes[j], places[j]
        if there[j] != code and there[j] != -1:
            at = place(tables.codes, code)
            there[j] = tables.codes[at]
        if there[j] == code:
            for a in range(ACTIONS):
                out[a] += tables.weights[at, a]
    top = out.max()
    total = 0.0
    for a in range(ACTIONS):
        total += np.exp(out[a] - top)
    out -= top + np.log(total)


@njit(cache=True, nogil=True)
def _push(costs: Array, edges: Array, size: int, cost: float, edge: int) -> None:
    """Enter an edge into a binary heap of `size`; of equal costs the lower edge comes first."""
    at = size
    while at > 0:
        above = (at - 1) >> 1
        if costs[above] < cost or (costs[above] == cost and edges[above] < edge):
            break
        costs[at], edges[at] = costs[above], edges[above]
        at = above
    costs[at], edges[at] = cost, edge


@njit(cache=True, nogil=True)
def _pop(costs: Array, edges: Array, size: int) -> None:
    """Take the first edge out of a heap that has `size` edges afterwards."""
    cost, edge, at = costs[size], edges[size], 0
    while True:
        below = 2 * at + 1
        if below >= size:
            break
        if below + 1 < size and (
            costs[below + 1] < costs[below] or (costs[below + 1] == costs[below] and edges[below + 1] < edges[below])
        ):
            below += 1
        if costs[below] > cost or (costs[below] == cost and edges[below] > edge):
            break
        costs[at], edges[at] = costs[below], edges[below]
        at = below
    costs[at], edges[at] = cost, edge


@njit(cache=True, nogil=True)
def _path(came: Array, edge: int, length: int, path: Array) -> int:
    """Write the actions that end with `edge` to `path`, as many as it holds; returns how many there are."""
    at = length
    while edge >= 0:
        at -= 1
        if at < len(path):
            path[at] = edge % ACTIONS
        edge = came[edge // ACTIONS]
    return length


@njit(cache=True, nogil=True)
def search(
    rules: Rules,
    tables: Tables,
    start: Array,
    order: int,
    weight: float,
    informed: bool,
    reroot: bool,
    max_nodes: int,
    path: Array,
) -> tuple[int, int, float, int]:
    """Search from one position.

    Args:
        rules, tables: see the classes.
        start: uint8 `[cells]`: a board.
        order: `LEVIN` or `ADDITIVE`.
        weight: of the heuristic where the order is additive; infinity: the heuristic alone.
        informed: whether the order has the heuristic.
        reroot: whether a node with a heuristic below those of all before it on its path is a new root.
        max_nodes: expansions at most.
        path: uint8 `[R]`: gets the actions, the first R of them.

    Returns:
        The expansions, the length of the solution or, where there is none, of the path to the node with the least
        heuristic (the first such), the solution's `Search.log_bound` (infinite without one), and the steps that were
        taken.
    """
    num, actions = len(start), ACTIONS
    patterned = order == LEVIN and (len(tables.codes) > 2 or np.any(tables.after != 0))  # else all are alike
    padded, rows = pattern_room(rules, num)
    codes = np.zeros(len(rules.windows), dtype=np.int64)
    places_of, there = np.zeros_like(codes), np.zeros_like(codes)
    cells, child = np.empty(num, dtype=np.uint8), np.empty(num, dtype=np.uint8)
    mover = read_board(rules, start, cells)
    misplaced = count_misplaced(rules, cells)
    distances = goal_distances(rules, cells)
    best = matching_room(rules, distances)
    room = max_nodes + 1
    boards, movers = np.empty((room, num), dtype=np.uint8), np.empty(room, dtype=np.int32)
    hashes, misplaced_in = np.empty(room, np.uint64), np.empty(room, dtype=np.int32)
    came, depths = np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int32)
    log_probs, action_log_probs = np.empty(room, dtype=np.float64), np.empty((room, actions), dtype=np.float64)
    sinces, peaks, leasts = np.empty(room, dtype=np.int32), np.empty(room), np.empty(room)  # see `best_first._Trees`
    places = 1
    while places < 2 * room:
        places *= 2
    mask, seen = np.uint64(places - 1), np.full(places, -1, dtype=np.int32)
    costs, edges, queued = np.empty(room * actions), np.empty(room * actions, dtype=np.int64), 0
    code = rules.keys[len(rules.keys) - 1, mover]
    for cell in range(num):
        code ^= rules.keys[cells[cell], cell]
    edge, depth, log_prob, nodes, steps = -1, 0, 0.0, 0, 0
    since, peak, lowest, roots = 0, 0.0, np.inf, 0
    nearest, least = 0, np.inf
    while True:
        if depth > 0 or nodes > 0:
            if queued == 0 or nodes >= max_nodes:
                return nodes, _path(came, came[nearest], depths[nearest], path), np.inf, steps
            edge = edges[0]
            queued -= 1
            _pop(costs, edges, queued)
            parent, action = edge // actions, edge % actions
            cells[:] = boards[parent]
            before = np.int64(movers[parent])
            mover, code = move(rules, cells, int(before), action, hashes[parent])
            steps += 1
            misplaced = misplaced_in[parent]
            if rules.puzzle == SOKOBAN:
                if boards[parent, mover] >= BOX:
                    behind = 2 * mover - before
                    misplaced += (boards[parent, mover] == BOX_ON_GOAL) - (cells[behind] == BOX_ON_GOAL)
            else:
                for changed in (before, mover):
                    misplaced += cells[changed] != rules.goal[changed]
                    misplaced -= boards[parent, changed] != rules.goal[changed]
            depth, log_prob = depths[parent] + 1, log_probs[parent] + action_log_probs[parent, action]
            since, lowest = sinces[parent] + 1, leasts[parent]
            peak = max(peaks[parent], np.log(since + 1.0) - log_prob)
        at = (code * np.uint64(MIXER) >> np.uint64(20)) & mask
        in_table = False
        while seen[at] >= 0:
            other = seen[at]
            if hashes[other] == code and movers[other] == mover:
                in_table = True
                for cell in range(num):
                    if boards[other, cell] != cells[cell]:
                        in_table = False
                        break
                if in_table:
                    break
            at = (at + np.uint64(1)) & mask
        if in_table:
            continue
        if misplaced == 0:
            return nodes, _path(came, edge, depth, path), np.log(max(roots, 1)) + peak, steps
        node = nodes
        nodes += 1
        seen[at] = node
        boards[node], movers[node], hashes[node], misplaced_in[node] = cells, mover, code, misplaced
        left = 0.0
        if informed or reroot:
            left = steps_left(rules, cells, distances, best)
            if left < least:
                nearest, least = node, left
        if reroot and left < lowest:
            since, log_prob, lowest, roots = 0, 0.0, left, roots + 1
        came[node], depths[node], log_probs[node] = edge, depth, log_prob
        sinces[node], peaks[node], leasts[node] = since, peak, lowest
        if patterned:
            write_patterns(rules, cells, mover, padded, rows, codes)
            last = edge % actions if edge >= 0 else actions
            _log_probs(tables, codes, last, places_of, there, action_log_probs[node])
        else:
            action_log_probs[node] = -np.log(float(actions))
        for action in range(actions):
            if not can_move(rules, cells, mover, action):
                continue
            left = 0.0
            if informed:
                child[:] = cells
                move(rules, child, mover, action, code)
                steps += 1
                left = steps_left(rules, child, distances, best)
            if order == LEVIN:
                d = since + 2.0
                cost = np.log(d + left) - (1 + left / d) * (log_prob + action_log_probs[node, action])
            elif weight == np.inf:
                cost = left
            else:
                cost = depth + 1 + weight * left
            _push(costs, edges, queued, cost, node * actions + action)
            queued += 1


def can_search(world: World, prior: Any) -> bool:
    """Whether the compiled loop knows the world and the prior, on the CPU."""
    if type(world) not in (SokobanWorld, SlidingTilesWorld) or not isinstance(world, PuzzleWorld):
        return False
    patterned = type(prior) is LogLinearPrior and prior.num_patterns == len(world.windows.windows)
    return world.device.type == "cpu" and (patterned or type(prior) is UniformPrior)


def compiled_tables(prior: Any, temperature: float) -> Tables:
    """The tables of a prior of patterns, or of the uniform prior, divided by a temperature."""
    if isinstance(prior, UniformPrior):
        codes, weights, after = np.zeros(0), np.zeros((0, ACTIONS)), np.zeros((ACTIONS + 1, ACTIONS))
    else:
        codes, weights, after = prior.patterns.numpy(), prior.weights[:-1].numpy(), prior.after.numpy()
    check_possible(not (np.isnan(weights).any() or np.isnan(after).any()))
    placed = hash_table(codes.astype(np.int64), (weights / temperature).astype(np.float32))
    return Tables(*placed, (after / temperature).astype(np.float32))


def search_all(
    world: PuzzleWorld,
    tables: Tables,
    state: Tensor,
    order: tuple[int, float],
    informed: bool,
    reroot: bool,
    max_nodes: int,
) -> tuple[Array, list[Array], Array, Array, Array]:
    """Search from each of `state [B, H, W]`; the cores share the problems.

    Returns:
        Of each problem whether it is solved, its plan, bound, expansions and steps; see `Search`.
    """
    boards, batch = flat_boards(state), len(state)
    solved, log_bound = np.zeros(batch, bool), np.full(batch, np.inf)
    expansions, steps = np.zeros(batch, np.int64), np.zeros(batch, np.int64)
    plans: list[Array] = [np.zeros(0, np.uint8)] * batch

    def one(number: int) -> None:
        length, path = LONGEST, np.zeros(0, np.uint8)
        while length > len(path):
            path = np.zeros(length, np.uint8)
            nodes, length, bound, taken = search(
                world.rules, tables, boards[number], *order, informed, reroot, max_nodes, path
            )
        solved[number], log_bound[number], expansions[number], steps[number] = np.isfinite(bound), bound, nodes, taken
        plans[number] = path[:length].copy()

    try:
        share(one, range(batch))
    except MemoryError:
        raise ValueError(f"`max_nodes` must be so few that there is memory for them, got {max_nodes:,}.") from None
    return solved, plans, log_bound, expansions, steps
