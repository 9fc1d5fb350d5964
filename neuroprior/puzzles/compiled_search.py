"""Best-first search in puzzles by a compiled loop, for `neuroprior.puzzles.best_first`; importing this loads numba.

A position is held as cells and the place of the mover: in Sokoban the player, in a sliding puzzle the blank.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from neuroprior._threads import share
from neuroprior.priors.uniform import UniformPrior
from neuroprior.puzzles.priors.compiled_fit import MIXER, hash_table, place
from neuroprior.puzzles.priors.counts import PatternCounts
from neuroprior.puzzles.priors.log_linear import LogLinearPrior, PatternNetwork
from neuroprior.puzzles.worlds.puzzle import PuzzleWorld
from neuroprior.puzzles.worlds.sliding_tiles import SlidingTilesWorld
from neuroprior.puzzles.worlds.sokoban import MATCHED
from neuroprior.worlds.world import World

Array = np.ndarray[Any, Any]

SOKOBAN, TILES = 0, 1
WALL, GOAL, BOX, BOX_ON_GOAL = 1, 2, 3, 4

ACTIONS = 4
"""A constant lets the compiler unroll loops over actions."""

LONGEST = 4096
"""Actions of a solution for which there is room at first."""

LEVIN, ADDITIVE = 0, 1
"""Orders of expansion: d / pi (with a heuristic that of PHS*), and depth + weight * heuristic."""


class Board(NamedTuple):
    """What all positions of a search share.

    Attributes:
        puzzle: `SOKOBAN` or `TILES`.
        width: cells in a row.
        keys: uint64 `[kinds + 1, cells]`: random numbers whose sum (exclusive or) is a position's hash; the last row is
            the mover's.
        kinds: int64 `[contents, cells]`: what a cell counts as in a pattern, below `base`.
        base: number of kinds.
        outside: the kind of what lies outside of the board.
        windows: int32 `[F, 4]`: the row and column of each window in the square around the mover, its height and width.
        offsets: int64 `[F]`: the code of each window whose cells are all 0.
        radius: cells that windows reach away from the mover.
    """

    puzzle: int
    width: int
    keys: Array
    kinds: Array
    base: int
    outside: int
    windows: Array
    offsets: Array
    radius: int


class Tables(NamedTuple):
    """The tables of a prior of patterns.

    Attributes:
        codes: int64 `[S]`, S a power of 2: a hash table of the codes that have weights; -1: free.
        weights: float32 `[S, A + E]`: for the code in the same place, its part of the logits and its embedding.
        after: float32 `[A + 1, A]`: the part of the logits after each last action; the last row: before the first.
        layers: float32 `[D, H, H]` and biases `[D, H]` of the layers on the sum of embeddings, E = H, and `out [A, H]`.
    """

    codes: Array
    weights: Array
    after: Array
    layers: Array
    biases: Array
    out: Array


@njit(cache=True, nogil=True)
def _patterns(board: Board, cells: Array, mover: int, padded: Array, rows: Array, out: Array) -> None:
    """Write the codes of the windows around the mover to `out [F]`.

    `padded` is the board with a frame of what lies outside, as wide as `radius`; `rows [w, n, n]` is room for the codes
    of up to w cells in a row.
    """
    r, width = board.radius, board.width
    n, across = 2 * r + 1, width + 2 * r
    cell = 0
    for y in range(len(cells) // width):
        for x in range(width):
            padded[(y + r) * across + x + r] = board.kinds[cells[cell], cell]
            cell += 1
    first = mover // width * across + mover % width
    for y in range(n):
        for x in range(n):
            rows[0, y, x] = padded[first + y * across + x]
    for more in range(1, rows.shape[0]):
        for y in range(n):
            for x in range(n - more):
                rows[more, y, x] = rows[more - 1, y, x] * board.base + rows[0, y, x + more]
    for k in range(len(out)):
        y, x, high, wide = board.windows[k, 0], board.windows[k, 1], board.windows[k, 2], board.windows[k, 3]
        code, power = np.int64(0), np.int64(1)
        for _ in range(wide):
            power *= board.base
        for i in range(high):
            code = code * power + rows[wide - 1, y + i, x]
        out[k] = board.offsets[k] + code


@njit(cache=True, nogil=True)
def _log_probs(
    tables: Tables, codes: Array, last: int, places: Array, there: Array, hidden: Array, more: Array, out: Array
) -> None:
    """Write the log-probabilities of the actions at a position with these patterns to `out [A]` (float64).

    `places` and `there`, int64 `[F]`, are room for where the patterns should stand in the hash table, and what does.
    """
    for a in range(ACTIONS):
        out[a] = tables.after[last, a]
    size = len(hidden)
    hidden[:] = 0
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
            for e in range(size):
                hidden[e] += tables.weights[at, ACTIONS + e]
    for layer in range(tables.layers.shape[0]):
        for i in range(len(more)):
            total = tables.biases[layer, i]
            for e in range(len(hidden)):
                total += tables.layers[layer, i, e] * max(hidden[e], np.float32(0))
            more[i] = total
        hidden[:] = more
    if len(hidden):
        for a in range(ACTIONS):
            for e in range(len(hidden)):
                out[a] += tables.out[a, e] * max(hidden[e], np.float32(0))
    top = out.max()
    total = 0.0
    for a in range(ACTIONS):
        total += np.exp(out[a] - top)
    out -= top + np.log(total)


@njit(cache=True, nogil=True)
def _can(puzzle: int, cells: Array, width: int, mover: int, action: int) -> bool:
    """Whether the mover can go there: 0 up, 1 down, 2 left, 3 right."""
    y, x = mover // width, mover % width
    y += (action == 1) - (action == 0)
    x += (action == 3) - (action == 2)
    if y < 0 or x < 0 or x >= width or y * width >= len(cells):
        return False
    if puzzle == TILES:
        return True
    there = cells[y * width + x]
    if there == WALL:
        return False
    if there < BOX:
        return True
    y += (action == 1) - (action == 0)
    x += (action == 3) - (action == 2)
    if y < 0 or x < 0 or x >= width or y * width >= len(cells):
        return False
    behind = cells[y * width + x]
    return bool(behind != WALL and behind < BOX)


@njit(cache=True, nogil=True)
def _move(board: Board, cells: Array, mover: int, action: int, code: Any) -> tuple[int, Any]:
    """Make a move that can be made, in place: where the mover is then, and the hash of the position."""
    step = board.width if action < 2 else 1
    if action == 0 or action == 2:
        step = -step
    keys, kinds, to = board.keys, len(board.keys) - 1, mover + step
    code ^= keys[kinds, mover] ^ keys[kinds, to]
    there = cells[to]
    if board.puzzle == TILES:
        code ^= keys[there, to] ^ keys[0, to] ^ keys[0, mover] ^ keys[there, mover]
        cells[mover], cells[to] = there, 0
    elif there >= BOX:
        behind = to + step
        before = cells[behind]
        cells[to] -= BOX if there == BOX else BOX_ON_GOAL - 2
        cells[behind] = BOX if before == 0 else BOX_ON_GOAL
        code ^= keys[there, to] ^ keys[cells[to], to] ^ keys[before, behind] ^ keys[cells[behind], behind]
    return to, code


@njit(cache=True, nogil=True)
def _left(board: Board, cells: Array, distances: Array, best: Array) -> float:
    """The heuristic: in a sliding puzzle the sum over tiles, in Sokoban the cheapest matching of boxes and goals.

    `distances [G, cells]`: of each cell to each goal, in a sliding puzzle to the goal of each tile. `best` is room for
    the cheapest matching with each set of goals.
    """
    if board.puzzle == TILES:
        total = 0.0
        for cell in range(len(cells)):
            if cells[cell] > 0:
                total += distances[cells[cell], cell]
        return total
    goals, boxes = len(distances), 0
    best[0] = 0.0
    for cell in range(len(cells)):
        if cells[cell] < BOX:
            continue
        boxes += 1
        if len(best) == 1:  # too many sets: each box by itself
            best[0] += distances[:, cell].min()
            continue
        for chosen in range(len(best)):
            count = 0
            for goal in range(goals):
                count += (chosen >> goal) & 1
            if count == boxes:
                least = np.inf
                for goal in range(goals):
                    if (chosen >> goal) & 1:
                        least = min(least, best[chosen ^ (1 << goal)] + distances[goal, cell])
                best[chosen] = least
    return float(best[-1])


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
            path[at] = edge % 4
        edge = came[edge // 4]
    return length


@njit(cache=True, nogil=True)
def search(
    board: Board,
    tables: Tables,
    start: Array,
    mover: int,
    goal: Array,
    distances: Array,
    order: int,
    weight: float,
    informed: bool,
    reroot: bool,
    max_nodes: int,
    path: Array,
) -> tuple[int, int, float, int]:
    """Search from one position.

    Args:
        board, tables: see the classes.
        start: uint8 `[cells]`.
        mover: the place of the player or the blank.
        goal: uint8 `[cells]`: the solved board of a sliding puzzle; Sokoban needs none.
        distances: float64 `[G, cells]`, see `_left`; without a heuristic and rerooting it needs no rows.
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
    num, high, actions = len(start), len(start) // board.width, ACTIONS
    best = np.zeros(2 ** len(distances) if board.puzzle == SOKOBAN and len(distances) <= MATCHED else 1)
    patterned = order == LEVIN and (len(tables.codes) > 2 or np.any(tables.after != 0))  # else all are alike
    across = board.width + 2 * board.radius
    padded = np.full((high + 2 * board.radius) * across, board.outside, dtype=np.int64)
    square = 2 * board.radius + 1
    rows = np.zeros((max(board.windows[:, 3].max(), 1) if len(board.windows) else 1, square, square), dtype=np.int64)
    codes, hidden = np.zeros(len(board.windows), dtype=np.int64), np.zeros(tables.biases.shape[1], dtype=np.float32)
    more = np.zeros(tables.biases.shape[1], dtype=np.float32)
    places_of, there = np.zeros_like(codes), np.zeros_like(codes)
    room = max_nodes + 1
    boards, movers, hashes = (
        np.empty((room, num), dtype=np.uint8),
        np.empty(room, dtype=np.int32),
        np.empty(room, np.uint64),
    )
    came, depths = np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int32)
    log_probs, own = np.empty(room, dtype=np.float64), np.empty((room, actions), dtype=np.float64)
    sinces, peaks, leasts = np.empty(room, dtype=np.int32), np.empty(room), np.empty(room)  # see `best_first._Trees`
    places = 1
    while places < 2 * room:
        places *= 2
    mask, seen = np.uint64(places - 1), np.full(places, -1, dtype=np.int32)
    costs, edges, queued = np.empty(room * actions), np.empty(room * actions, dtype=np.int64), 0
    cells, child = start.copy(), np.empty(num, dtype=np.uint8)
    code, kinds = np.uint64(0), len(board.keys) - 1
    wrong = 0  # boxes beside goals, or tiles beside their places
    for cell in range(num):
        code ^= board.keys[cells[cell], cell]
        if board.puzzle == SOKOBAN:
            wrong += cells[cell] == BOX
        else:
            wrong += cells[cell] != goal[cell]
    code ^= board.keys[kinds, mover]
    wrongs = np.empty(room, dtype=np.int32)
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
            mover, code = _move(board, cells, int(before), action, hashes[parent])
            steps += 1
            wrong = wrongs[parent]
            if board.puzzle == SOKOBAN:
                if boards[parent, mover] >= BOX:
                    behind = 2 * mover - before
                    wrong += (boards[parent, mover] == BOX_ON_GOAL) - (cells[behind] == BOX_ON_GOAL)
            else:
                for place in (before, mover):
                    wrong += int(cells[place] != goal[place]) - int(boards[parent, place] != goal[place])
            depth, log_prob = depths[parent] + 1, log_probs[parent] + own[parent, action]
            since, lowest = sinces[parent] + 1, leasts[parent]
            peak = max(peaks[parent], np.log(since + 1.0) - log_prob)
        at = (code * np.uint64(MIXER) >> np.uint64(20)) & mask
        known = False
        while seen[at] >= 0:
            other = seen[at]
            if hashes[other] == code and movers[other] == mover:
                known = True
                for cell in range(num):
                    if boards[other, cell] != cells[cell]:
                        known = False
                        break
                if known:
                    break
            at = (at + np.uint64(1)) & mask
        if known:
            continue
        if wrong == 0:
            return nodes, _path(came, edge, depth, path), np.log(max(roots, 1)) + peak, steps
        node = nodes
        nodes += 1
        seen[at] = node
        boards[node], movers[node], hashes[node], wrongs[node] = cells, mover, code, wrong
        left = 0.0
        if informed or reroot:
            left = _left(board, cells, distances, best)
            if left < least:
                nearest, least = node, left
        if reroot and left < lowest:
            since, log_prob, lowest, roots = 0, 0.0, left, roots + 1
        came[node], depths[node], log_probs[node] = edge, depth, log_prob
        sinces[node], peaks[node], leasts[node] = since, peak, lowest
        if patterned:
            _patterns(board, cells, mover, padded, rows, codes)
            last = edge % actions if edge >= 0 else actions
            _log_probs(tables, codes, last, places_of, there, hidden, more, own[node])
        else:
            own[node] = -np.log(float(actions))
        for action in range(actions):
            if not _can(board.puzzle, cells, board.width, mover, action):
                continue
            left = 0.0
            if informed:
                child[:] = cells
                _move(board, child, mover, action, code)
                steps += 1
                left = _left(board, child, distances, best)
            if order == LEVIN:
                d = since + 2.0
                cost = np.log(d + left) - (1 + left / d) * (log_prob + own[node, action])
            elif weight == np.inf:
                cost = left
            else:
                cost = depth + 1 + weight * left
            _push(costs, edges, queued, cost, node * actions + action)
            queued += 1


KNOWN = (LogLinearPrior, PatternCounts, PatternNetwork)
"""Priors of patterns whose tables the loop reads; the uniform prior has none."""


def can_search(world: World, prior: Any) -> bool:
    """Whether the compiled loop knows the world and the prior, on the CPU."""
    if not isinstance(world, PuzzleWorld) or world.device.type != "cpu":
        return False
    if isinstance(prior, UniformPrior):
        return True
    patterned = world.observation == "patterns" and getattr(prior, "num_patterns", None) == len(world.windows.windows)
    return patterned and type(prior) in KNOWN and getattr(prior, "combine", "product") == "product"


def compiled_board(world: PuzzleWorld) -> Board:
    """What all positions of a puzzle share."""
    high, wide = world.shape
    windows, cells = world.windows, high * wide
    if isinstance(world, SlidingTilesWorld):
        puzzle, kinds = TILES, world.tile_kinds().numpy()
    else:
        puzzle, kinds = SOKOBAN, np.repeat(np.arange(windows.base)[:, None], cells, 1)
    random = np.random.default_rng(0).integers(2**63, size=(len(kinds) + 1, cells), dtype=np.uint64)
    reach = windows.radius
    shifted = [(row + reach, column + reach, height, width) for row, column, height, width in windows.windows]
    offsets = windows.offsets.numpy().astype(np.int64)
    return Board(
        puzzle,
        wide,
        random,
        kinds.astype(np.int64),
        windows.base,
        windows.outside,
        np.array(shifted, np.int32),
        offsets,
        reach,
    )


def compiled_tables(prior: Any) -> Tables:
    """The tables of a prior of patterns, or of the uniform prior."""
    actions = prior.num_actions
    if isinstance(prior, UniformPrior):
        codes, weights, after = (
            np.zeros(0, np.int64),
            np.zeros((0, actions), np.float32),
            np.zeros((actions + 1, actions)),
        )
    else:
        codes, weights, after = prior.patterns.numpy(), prior.weights[:-1].numpy(), prior.after.numpy()
    layers, biases, out = np.zeros((0, 0, 0)), np.zeros((0, 0)), np.zeros((actions, 0))
    if isinstance(prior, PatternNetwork):
        weights = np.concatenate([weights, prior.embeddings[:-1].numpy()], 1)
        layers, biases, out = (table.numpy() for table in (prior.layers, prior.biases, prior.out))
    if np.isnan(weights).any() or np.isnan(after).any():
        raise ValueError("prior: its weights are NaN")
    network = (np.ascontiguousarray(table, np.float32) for table in (layers, biases, out))
    placed = hash_table(codes.astype(np.int64), np.ascontiguousarray(weights, np.float32))
    return Tables(*placed, np.ascontiguousarray(after, np.float32), *network)


class Found(NamedTuple):
    """What a compiled search found for B problems: as `neuroprior.puzzles.best_first.Search`, in numpy's arrays."""

    solved: Array
    plans: list[Array]
    log_bound: Array
    expansions: Array
    model_steps: Array


def search_all(
    world: PuzzleWorld,
    prior: Any,
    state: Tensor,
    order: int,
    weight: float,
    informed: bool,
    reroot: bool,
    max_nodes: int,
) -> Found:
    """Search from each of `state [B, H, W]`; the cores share the problems."""
    board, tables = compiled_board(world), compiled_tables(prior)
    movers, batch = world.mover(state).numpy(), len(state)
    if isinstance(world, SlidingTilesWorld):
        cells, goal = state.flatten(1).numpy(), world.goal.flatten().numpy()
        distances: Any = world.distances().numpy().astype(np.float64)
    else:
        cells, goal = world.kinds(state).to(torch.uint8).flatten(1).numpy(), np.zeros(0, np.uint8)
        distances = None
    uninformed = np.zeros((0, cells.shape[1]))
    solved, log_bound = np.zeros(batch, bool), np.full(batch, np.inf)
    expansions, steps = np.zeros(batch, np.int64), np.zeros(batch, np.int64)
    plans: list[Array] = [np.zeros(0, np.uint8)] * batch

    def one(number: int) -> None:
        path, far = np.zeros(LONGEST, np.uint8), uninformed
        if informed or reroot:
            far = goal_distances(cells[number], board.width) if distances is None else distances
        start = np.ascontiguousarray(cells[number]), int(movers[number])
        while True:
            nodes, length, bound, taken = search(
                board, tables, *start, goal, far, order, weight, informed, reroot, max_nodes, path
            )
            if length <= len(path):
                break
            path = np.zeros(length, np.uint8)
        solved[number], log_bound[number], expansions[number], steps[number] = np.isfinite(bound), bound, nodes, taken
        plans[number] = path[:length].copy()

    try:
        share(one, range(batch))
    except MemoryError:
        raise ValueError(f"max_nodes: there is no memory for {max_nodes:,} nodes") from None
    return Found(solved, plans, log_bound, expansions, steps)


def goal_distances(cells: Array, width: int) -> Array:
    """The rows and columns between each goal of a Sokoban level and each cell, float64 `[G, cells]`."""
    goals, every = np.flatnonzero((cells == GOAL) | (cells == BOX_ON_GOAL)), np.arange(len(cells))
    rows = np.abs(goals[:, None] // width - every // width)
    distances: Array = (rows + np.abs(goals[:, None] % width - every % width)).astype(np.float64)
    return distances


@njit(cache=True, nogil=True)
def _replay(board: Board, start: Array, mover: int, path: Array, codes: Array) -> None:
    """Write the patterns before each action of `path [L]` to `codes` int32 `[L, F]`."""
    cells, high, width = start.copy(), len(start) // board.width, board.width
    square = 2 * board.radius + 1
    padded = np.full((high + 2 * board.radius) * (width + 2 * board.radius), board.outside, dtype=np.int64)
    rows = np.zeros((board.windows[:, 3].max(), square, square), dtype=np.int64)
    out = np.empty(len(board.windows), dtype=np.int64)
    for t in range(len(path)):
        _patterns(board, cells, mover, padded, rows, out)
        codes[t] = out
        if _can(board.puzzle, cells, width, mover, path[t]):
            mover, _ = _move(board, cells, mover, path[t], np.uint64(0))


def patterns_along(world: PuzzleWorld, state: Tensor, plans: Sequence[Tensor]) -> Tensor:
    """The patterns before each action of plans from `state [B, H, W]`, one plan after the other: int32 `[M, F]`."""
    board, movers = compiled_board(world), world.mover(state).numpy()
    cells = state if isinstance(world, SlidingTilesWorld) else world.kinds(state).to(torch.uint8)
    flat, out = cells.flatten(1).numpy(), np.empty((sum(map(len, plans)), len(board.windows)), np.int32)
    at = 0
    for number, plan in enumerate(plans):
        path = plan.to(torch.uint8).numpy()
        _replay(board, np.ascontiguousarray(flat[number]), int(movers[number]), path, out[at : at + len(path)])
        at += len(path)
    return torch.from_numpy(out)
