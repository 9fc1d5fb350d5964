"""The rules of Sokoban and sliding tiles, in compiled loops: moves, lower bounds and patterns.

They stand here alone: the worlds call them for batches of boards, the compiled search for one position after the other.
A board holds the codes of a world's states. A position is a board and the cell of its mover: in Sokoban the player,
whose own cell then holds what lies under it, in sliding tiles the blank.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

Array = np.ndarray[Any, Any]

SOKOBAN, TILES = 0, 1

FLOOR, WALL, GOAL, BOX, BOX_ON_GOAL, PLAYER, PLAYER_ON_GOAL = range(7)
"""Codes of Sokoban's cells."""

ACTIONS = 4
"""A constant lets the compiler unroll loops over actions."""

MATCHED = 5
"""Up to so many boxes are matched with goals; with more, each goes to its nearest goal."""


class Rules(NamedTuple):
    """What all boards of a world share.

    Attributes:
        puzzle: `SOKOBAN` or `TILES`.
        width: cells in a row.
        goal: uint8 `[cells]`: the solved board of sliding tiles; of Sokoban no cells.
        distances: float64 `[tiles, cells]`: from each cell to each tile's place; of Sokoban no rows.
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
    goal: Array
    distances: Array
    keys: Array
    kinds: Array
    base: int
    outside: int
    windows: Array
    offsets: Array
    radius: int


@njit(cache=True, nogil=True)
def read_board(rules: Rules, board: Array, cells: Array) -> int:
    """Write the cells of a position to `cells`; returns the mover's cell."""
    mover = 0
    for cell in range(len(board)):
        code = board[cell]
        if rules.puzzle == TILES:
            if code == 0:
                mover = cell
        elif code >= PLAYER:
            mover, code = cell, FLOOR if code == PLAYER else GOAL
        cells[cell] = code
    return mover


@njit(cache=True, nogil=True)
def count_misplaced(rules: Rules, cells: Array) -> int:
    """The boxes beside goals, or the tiles (and the blank) beside their places; 0 where the puzzle is solved."""
    misplaced = 0
    for cell in range(len(cells)):
        if rules.puzzle == SOKOBAN:
            misplaced += cells[cell] == BOX
        else:
            misplaced += cells[cell] != rules.goal[cell]
    return misplaced


@njit(cache=True, nogil=True)
def can_move(rules: Rules, cells: Array, mover: int, action: int) -> bool:
    """Whether the mover can go there: 0 up, 1 down, 2 left, 3 right."""
    width = rules.width
    y, x = mover // width, mover % width
    y += (action == 1) - (action == 0)
    x += (action == 3) - (action == 2)
    if y < 0 or x < 0 or x >= width or y * width >= len(cells):
        return False
    if rules.puzzle == TILES:
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
def move(rules: Rules, cells: Array, mover: int, action: int, code: Any) -> tuple[int, Any]:
    """Make a move that can be made, in place: where the mover is then, and the hash of the position."""
    step = rules.width if action < 2 else 1
    if action == 0 or action == 2:
        step = -step
    keys, kinds, to = rules.keys, len(rules.keys) - 1, mover + step
    code ^= keys[kinds, mover] ^ keys[kinds, to]
    there = cells[to]
    if rules.puzzle == TILES:
        code ^= keys[there, to] ^ keys[0, to] ^ keys[0, mover] ^ keys[there, mover]
        cells[mover], cells[to] = there, 0
    elif there >= BOX:
        behind = to + step
        before = cells[behind]
        cells[to] = FLOOR if there == BOX else GOAL
        cells[behind] = BOX if before == FLOOR else BOX_ON_GOAL
        code ^= keys[there, to] ^ keys[cells[to], to] ^ keys[before, behind] ^ keys[cells[behind], behind]
    return to, code


@njit(cache=True, nogil=True)
def steps_left(rules: Rules, cells: Array, distances: Array, best: Array) -> float:
    """The heuristic: in a sliding puzzle the sum over tiles, in Sokoban the cheapest matching of boxes and goals.

    `distances [G, cells]`: of each cell to each goal, in a sliding puzzle to the goal of each tile. `best` is room for
    the cheapest matching with each set of goals.
    """
    if rules.puzzle == TILES:
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
def write_patterns(rules: Rules, cells: Array, mover: int, padded: Array, rows: Array, out: Array) -> None:
    """Write the codes of the windows around the mover to `out [F]`.

    `padded` is the board with a frame of what lies outside, as wide as `radius`; `rows [w, n, n]` is room for the codes
    of up to w cells in a row.
    """
    r, width = rules.radius, rules.width
    n, across = 2 * r + 1, width + 2 * r
    cell = 0
    for y in range(len(cells) // width):
        for x in range(width):
            padded[(y + r) * across + x + r] = rules.kinds[cells[cell], cell]
            cell += 1
    first = mover // width * across + mover % width
    for y in range(n):
        for x in range(n):
            rows[0, y, x] = padded[first + y * across + x]
    for more in range(1, rows.shape[0]):
        for y in range(n):
            for x in range(n - more):
                rows[more, y, x] = rows[more - 1, y, x] * rules.base + rows[0, y, x + more]
    for k in range(len(out)):
        y, x, high, wide = rules.windows[k, 0], rules.windows[k, 1], rules.windows[k, 2], rules.windows[k, 3]
        code, power = np.int64(0), np.int64(1)
        for _ in range(wide):
            power *= rules.base
        for i in range(high):
            code = code * power + rows[wide - 1, y + i, x]
        out[k] = rules.offsets[k] + code


@njit(cache=True, nogil=True)
def goal_distances(rules: Rules, cells: Array) -> Array:
    """The rows and columns between each goal and each cell, float64 `[G, cells]`; in sliding tiles of each tile."""
    if rules.puzzle == TILES:
        return rules.distances
    width, goals = rules.width, 0
    for cell in range(len(cells)):
        goals += cells[cell] == GOAL or cells[cell] == BOX_ON_GOAL
    distances, row = np.empty((goals, len(cells))), 0
    for goal in range(len(cells)):
        if cells[goal] == GOAL or cells[goal] == BOX_ON_GOAL:
            for cell in range(len(cells)):
                rows, columns = goal // width - cell // width, goal % width - cell % width
                distances[row, cell] = abs(rows) + abs(columns)
            row += 1
    return distances


@njit(cache=True, nogil=True)
def matching_room(rules: Rules, distances: Array) -> Array:
    """Room for `steps_left`: a number for each set of goals, or one where there are too many sets."""
    matched = rules.puzzle == SOKOBAN and len(distances) <= MATCHED
    return np.zeros(2 ** len(distances) if matched else 1)


@njit(cache=True, nogil=True)
def pattern_room(rules: Rules, num_cells: int) -> tuple[Array, Array]:
    """Room for `write_patterns`: its `padded` and `rows`."""
    side, width = 2 * rules.radius + 1, rules.width
    frame = (num_cells // width + side - 1) * (width + side - 1)
    padded = np.full(frame, rules.outside, dtype=np.int64)
    return padded, np.zeros((rules.windows[:, 3].max(), side, side), dtype=np.int64)


@njit(cache=True, nogil=True)
def step_boards(rules: Rules, boards: Array, actions: Array, absorbing: bool, after: Array, reward: Array) -> None:
    """Write `boards [N, cells]` after `actions [N]` to `after`, and 1 for each that is solved by it to `reward [N]`.

    Solved boards stay as they are where they are `absorbing`.
    """
    cells = np.empty(boards.shape[1], dtype=np.uint8)
    for n in range(len(boards)):
        mover = read_board(rules, boards[n], cells)
        misplaced = count_misplaced(rules, cells)
        if (misplaced > 0 or not absorbing) and can_move(rules, cells, mover, actions[n]):
            mover, _ = move(rules, cells, mover, actions[n], np.uint64(0))
            reward[n] = misplaced > 0 and count_misplaced(rules, cells) == 0
        after[n] = cells
        if rules.puzzle == SOKOBAN:
            after[n, mover] = PLAYER if cells[mover] == FLOOR else PLAYER_ON_GOAL


@njit(cache=True, nogil=True)
def legal_in_boards(rules: Rules, boards: Array, legal: Array) -> None:
    """Write which actions move something to `legal [N, 4]`; where none does, all are legal."""
    cells = np.empty(boards.shape[1], dtype=np.uint8)
    for n in range(len(boards)):
        mover = read_board(rules, boards[n], cells)
        for action in range(ACTIONS):
            legal[n, action] = can_move(rules, cells, mover, action)
        if not legal[n].any():
            legal[n] = True


@njit(cache=True, nogil=True)
def bound_boards(rules: Rules, boards: Array, bound: Array) -> None:
    """Write the moves that a solution of each of `boards [N, cells]` needs at least to `bound [N]`."""
    cells = np.empty(boards.shape[1], dtype=np.uint8)
    distances = rules.distances
    best = matching_room(rules, distances)
    for n in range(len(boards)):
        read_board(rules, boards[n], cells)
        if rules.puzzle == SOKOBAN:
            distances = goal_distances(rules, cells)
            best = matching_room(rules, distances)
        bound[n] = steps_left(rules, cells, distances, best)


@njit(cache=True, nogil=True)
def observe_boards(rules: Rules, boards: Array, codes: Array) -> None:
    """Write the patterns of each of `boards [N, cells]` to `codes` int32 `[N, F]`."""
    cells = np.empty(boards.shape[1], dtype=np.uint8)
    padded, rows = pattern_room(rules, len(cells))
    board_codes = np.empty(codes.shape[1], dtype=np.int64)
    for n in range(len(boards)):
        mover = read_board(rules, boards[n], cells)
        write_patterns(rules, cells, mover, padded, rows, board_codes)
        codes[n] = board_codes
