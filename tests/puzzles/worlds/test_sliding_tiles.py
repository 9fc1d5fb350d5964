"""Sliding tiles: rules, parity, patterns and files, against enumeration and plain Python."""

from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neuroprior.puzzles import SlidingTilesWorld, read_tiles, sliding_tiles


def distances(world: SlidingTilesWorld) -> dict[tuple[int, ...], int]:
    """The distance of each board from the goal, breadth first; the moves are written anew here."""
    height, width = world.goal.shape
    front, found, depth = [tuple(world.goal.flatten().tolist())], {}, 0
    while front:
        found.update((board, depth) for board in front)
        after = set()
        for board in front:
            y, x = divmod(board.index(0), width)
            for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                if 0 <= y + dy < height and 0 <= x + dx < width:
                    tiles = list(board)
                    other = (y + dy) * width + x + dx
                    tiles[y * width + x], tiles[other] = tiles[other], 0
                    after.add(tuple(tiles))
        front, depth = [board for board in after if board not in found], depth + 1
    return found


@pytest.mark.parametrize("shape", [(2, 2), (2, 3), (3, 2), (1, 4), (5, 1)])
@pytest.mark.parametrize("turned", [False, True])
def test_boards_from_which_the_goal_can_be_reached_are_known(shape: tuple[int, int], turned: bool) -> None:
    cells = shape[0] * shape[1]
    goal = torch.arange(cells).flip(0).view(shape) if turned else None
    found = distances(sliding_tiles(shape=shape, goal=goal))
    for board in permutations(range(cells)):
        if board not in found:  # the others are given together
            with pytest.raises(ValueError, match=r"`boards\[0\]` must be .* the goal can be reached"):
                sliding_tiles(torch.tensor([board]), shape=shape, goal=goal)
    world = sliding_tiles(torch.tensor(sorted(found)), shape=shape, goal=goal)
    bound = world.lower_bound(world.boards).tolist()  # type: ignore[arg-type]
    assert all(low <= found[board] for low, board in zip(bound, sorted(found), strict=True))
    assert world.lower_bound(world.goal[None]).tolist() == [0]


def test_steps_move_the_blank() -> None:
    world = sliding_tiles(torch.tensor([[[3, 1, 2], [0, 4, 5]]]))
    state = world.reset(4)
    assert world.legal_actions(state)[0].tolist() == [True, False, False, True]
    after, reward = world.step(state, torch.arange(4))
    assert after.tolist() == [
        [[0, 1, 2], [3, 4, 5]],
        [[3, 1, 2], [0, 4, 5]],
        [[3, 1, 2], [0, 4, 5]],
        [[3, 1, 2], [4, 0, 5]],
    ]
    assert reward.tolist() == [1, 0, 0, 0]
    assert world.solved(after).tolist() == world.terminated(after).tolist() == [True, False, False, False]
    again, reward = world.step(after[:1], torch.tensor([1]))
    assert again.equal(after[:1])
    assert reward.tolist() == [0]
    assert world.lower_bound(after).tolist() == [0, 1, 1, 2]


def test_patterns_are_those_of_plain_python() -> None:
    """A cell is how far its tile must go, 1 + 5 (rows + 1) + columns + 2; what lies outside of the board is 0."""
    goal = torch.tensor([[1, 4, 0], [2, 5, 3]])
    windows = [(0, -1, 1, 2), (-1, 0, 1, 1), (1, 0, 1, 1), (0, 1, 2, 1)]
    world = sliding_tiles(shape=(2, 3), goal=goal, windows=windows, scramble=25)
    state = world.reset(30, torch.Generator().manual_seed(0))
    places = {int(goal[y, x]): (y, x) for y in range(2) for x in range(3)}
    for board, codes in zip(state.tolist(), world.observe(state).tolist(), strict=True):
        blank = next((y, x) for y in range(2) for x in range(3) if board[y][x] == 0)
        due, offset = [], 0
        for dy, dx, height, width in windows:
            code = 0
            for y in range(blank[0] + dy, blank[0] + dy + height):
                for x in range(blank[1] + dx, blank[1] + dx + width):
                    kind = 0
                    if 0 <= y < 2 and 0 <= x < 3:
                        row, column = places[board[y][x]]
                        kind = 1 + 5 * (row - y + 1) + column - x + 2
                    code = 16 * code + kind
            due.append(offset + code)
            offset += 16 ** (height * width)
        assert codes == due
    assert world.windows.num_codes == offset


@given(st.lists(st.permutations(range(6)), min_size=1, max_size=5), st.sampled_from([" ", "  ", "\t"]))
def test_what_is_written_is_read_again(boards: list[list[int]], between: str) -> None:
    text = "".join(between.join(map(str, board)) + " \n" for board in boards)
    assert read_tiles(text, shape=(2, 3)).reshape(-1, 6).tolist() == boards


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "it must hold a puzzle, got none"),
        ("0 1 2 3\n\n0 1 2 2\n", "line 3: each of 0 to 3 must be there once, got '0 1 2 2'"),
        ("0 1 2 3\n0 1 2\n", "line 2: each of 0 to 3"),
        ("0 1 2 x\n", "line 1: each of 0 to 3"),
        ("0 1 2\n", "line 1: boards must be square"),
    ],
)
def test_wrong_files_are_refused_in_one_line(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "puzzles.txt"
    path.write_text(content)
    with pytest.raises(ValueError, match=message) as error:
        sliding_tiles(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "boards, shape or goal"),
        ({"boards": torch.zeros(2, 4)}, r"`boards` must have the shape .* with shape"),
        ({"boards": torch.zeros(2, 2, 2)}, "must be integers"),
        ({"boards": torch.zeros(2, 2, 2, dtype=torch.long)}, r"`boards\[0\]` must hold each of 0 to 3 once"),
        ({"shape": (2, 2), "goal": torch.arange(4)}, r"`goal` must have the shape \[2, 2\], got \[4\]"),
        ({"shape": (1, 1)}, "2 to 256 cells"),
        ({"shape": 3}, "`shape` must be height and width"),
        ({"shape": (3.0, 3)}, "`shape` must be height and width"),
        ({"boards": ["1 0 2 3"]}, "`boards` must be a file or boards"),
        ({"boards": "0 1 2 3\n", "shape": (10**5, 10**5)}, "at most 256 cells"),
        ({"boards": "0 1 2 3\n", "shape": (-2, -2)}, "`shape` must be height and width"),
        ({"boards": [[*range(16)], [*range(1, 16), 0]], "shape": (4, 4)}, r"`boards\[1\]`.*without goal="),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sliding_tiles(**arguments)


@pytest.mark.parametrize("shape", [(2, 2), (6, 6), (7, 7), (2, 30), (15, 15)])
def test_boards_of_all_sizes_have_patterns(shape: tuple[int, int]) -> None:
    world = sliding_tiles(shape=shape, scramble=10)
    state = world.reset(4, torch.Generator().manual_seed(0))
    codes = world.observe(state)
    assert codes.dtype == torch.int32
    assert int(codes.min()) >= 0
    assert int(codes.max()) < world.windows.num_codes < 2**31
    large = max(height * width for _, _, height, width in world.windows.windows)
    assert large == (4 if shape in ((2, 2), (6, 6)) else 2)
    single = [window for window in world.windows.windows if window[2:] == (1, 1)]
    assert len(single) == (2 * shape[0] - 1) * (2 * shape[1] - 1)


def test_a_shape_may_be_a_list() -> None:
    boards = torch.arange(6).view(1, 6)
    assert sliding_tiles(boards, shape=[2, 3]).goal.equal(sliding_tiles(boards, shape=(2, 3)).goal)  # type: ignore[arg-type]


def test_no_boards_are_a_batch() -> None:
    world = sliding_tiles(shape=(2, 2))
    assert len(world.observe(world.reset(0))) == len(world.lower_bound(world.reset(0))) == 0


def test_each_tile_in_each_cell_and_the_blank_have_keys_of_their_own() -> None:
    """Compiled code reads them without a check of the bounds."""
    keys = sliding_tiles(shape=(2, 3)).rules.keys
    assert keys.shape == (2 * 3 + 1, 2 * 3)
    assert len(set(keys.ravel().tolist())) == keys.size


def test_states_that_are_no_boards_are_refused() -> None:
    world = sliding_tiles(shape=(2, 3))
    state = world.reset(3, torch.Generator().manual_seed(0))
    state[1, 0, :2] = 4
    with pytest.raises(ValueError, match=r"`state\[1\]` must hold each of 0 to 5 once"):
        world.rollout(state, torch.zeros(3, 1, 2, dtype=torch.long))
