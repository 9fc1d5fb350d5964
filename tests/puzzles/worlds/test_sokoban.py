"""Sokoban: its rules, its patterns and its files, against plain Python."""

import lzma
from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neuroprior.puzzles import SOKOBAN_WINDOWS, SokobanWorld, format_sokoban, read_sokoban, sokoban, windows_within

LEVELS = Path(__file__).parents[3] / "eval/data/boxoban/test.txt.xz"
EASY = "#######\n#@ $ .#\n#######\n"
MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))


@pytest.fixture(scope="module")
def world() -> SokobanWorld:
    return sokoban(LEVELS)


def cell(board: list[list[int]], y: int, x: int) -> int:
    return board[y][x] if 0 <= y < len(board) and 0 <= x < len(board[0]) else 1


def player(board: list[list[int]]) -> tuple[int, int]:
    return next((y, x) for y, row in enumerate(board) for x, code in enumerate(row) if code >= 5)


def moved(board: list[list[int]], action: int) -> tuple[list[list[int]], bool]:
    """The board after an action, and whether it is legal."""
    (y, x), (dy, dx) = player(board), MOVES[action]
    first, second = cell(board, y + dy, x + dx), cell(board, y + 2 * dy, x + 2 * dx)
    if first not in (0, 2) and not (first in (3, 4) and second in (0, 2)):
        return board, False
    after = [list(row) for row in board]
    after[y][x] = 2 if board[y][x] == 6 else 0
    after[y + dy][x + dx] = 6 if first in (2, 4) else 5
    if first in (3, 4):
        after[y + 2 * dy][x + 2 * dx] = 4 if second == 2 else 3
    return after, True


def scattered(world: SokobanWorld, num: int, steps: int = 30) -> torch.Tensor:
    """Boards after random moves."""
    generator = torch.Generator().manual_seed(1)
    state = world.reset(num, generator)
    for _ in range(steps):
        state, _ = world.step(state, torch.randint(4, (num,), generator=generator))
    return state


# Without outer walls, so that the edge of the board counts.
OPEN = read_sokoban("@ $ \n  . \n.$# \n\n+*  \n$ $.\n#   \n")


@pytest.mark.parametrize("levels", [LEVELS, OPEN], ids=["boxoban", "no outer walls"])
def test_steps_and_legal_actions_are_those_of_the_rules(levels: object) -> None:
    world = sokoban(levels)
    state = scattered(world, 60)
    legal, solved = world.legal_actions(state), world.solved(state)
    for action in range(4):
        after, reward = world.step(state, torch.full((60,), action))
        for n, board in enumerate(state.tolist()):
            due, is_legal = (board, bool(legal[n, action])) if solved[n] else moved(board, action)
            assert after[n].tolist() == due
            assert float(reward[n]) == (not solved[n] and not any(3 in row for row in due))
            stuck = not any(moved(board, other)[1] for other in range(4))
            assert bool(legal[n, action]) == (is_legal or stuck)


def test_solving_rewards_once_and_absorbs() -> None:
    world = sokoban([EASY])
    state = world.reset(2)
    rewards = []
    for action in (3, 3, 3, 2):
        state, reward = world.step(state, torch.full((2,), action))
        rewards.append(float(reward[0]))
    assert rewards == [0, 0, 1, 0]
    assert format_sokoban(state[0]) == "#######\n#   @*#\n#######"
    assert world.solved(state).all()
    assert world.terminated(state).all()
    assert world.has_goal


def test_a_player_who_cannot_move_has_all_actions_to_no_effect() -> None:
    world = sokoban(["#####\n#@$##\n##. #\n#####"])
    state = world.reset(4)
    assert world.legal_actions(state).all()
    after, reward = world.step(state, torch.arange(4))
    assert after.equal(state)
    assert not reward.any()


def test_patterns_are_those_of_plain_python(world: SokobanWorld) -> None:
    for some in (world, sokoban(OPEN)):
        state = scattered(some, 20)
        codes = some.observe(state)
        assert codes.dtype == torch.int32
        assert codes.shape == (20, len(SOKOBAN_WINDOWS))
        for board, row in zip(state.tolist(), codes.tolist(), strict=True):
            y, x = player(board)
            due, offset = [], 0
            for dy, dx, h, w in SOKOBAN_WINDOWS:
                code = 0
                for i in range(h):
                    for j in range(w):
                        kind = cell(board, y + dy + i, x + dx + j)
                        code = 5 * code + {5: 0, 6: 2}.get(kind, kind)
                due.append(offset + code)
                offset += 5 ** (h * w)
            assert row == due
        assert some.windows.num_codes == offset


def test_windows_are_those_within_a_distance() -> None:
    assert windows_within(3, 3, 4)[:2] == ((-4, -4, 3, 3), (-4, -3, 3, 3))
    assert len(windows_within(3, 3, 4)) == 49
    assert len(windows_within(4, 2, 3)) == len(windows_within(2, 4, 3)) == 24
    assert windows_within(2, 2, 1) == SOKOBAN_WINDOWS[97:101]


def test_groups_are_wall_layouts() -> None:
    world = sokoban([EASY, "#######\n#. $ @#\n#######", "#######\n#@ $. #\n####  #"])
    groups = world.group(world.boards)
    assert groups[0] == groups[1] != groups[2]
    assert (groups >= 0).all()
    assert groups[:2].equal(sokoban([EASY, EASY]).group(world.boards[:2]))


def test_lower_bound_is_the_cheapest_matching(world: SokobanWorld) -> None:
    """Of all orders of the goals; with more than 5 boxes each counts to its nearest goal. And one more move solves."""
    many = sokoban(["########\n#@     #\n#$$$$$$#\n#......#\n#     .#\n# *   $#\n########"])
    few = sokoban(  # two boxes are nearest to the same goal
        [
            "#########\n#       #\n# $.$  .#\n#@      #\n#########",
            "#########\n#   $. .#\n# $.$   #\n#@  *   #\n#########",
        ]
    )
    assert few.lower_bound(few.boards[:1]).tolist() == [4]
    for some in (world, few, many, sokoban([EASY])):
        state = scattered(some, 30)
        for board, bound in zip(state.tolist(), some.lower_bound(state).tolist(), strict=True):
            cells = [(y, x, code) for y, row in enumerate(board) for x, code in enumerate(row)]
            boxes = [(y, x) for y, x, code in cells if code in (3, 4)]
            goals = [(y, x) for y, x, code in cells if code in (2, 4, 6)]
            far = [[abs(y - v) + abs(x - u) for v, u in goals] for y, x in boxes]
            orders = permutations(range(len(goals))) if len(goals) <= 5 else ()
            due = min((sum(row[goal] for row, goal in zip(far, order, strict=True)) for order in orders), default=None)
            assert bound == (sum(map(min, far)) if due is None else due)
    assert few.lower_bound(few.boards[:0]).tolist() == []


@given(
    st.integers(1, 5).flatmap(lambda w: st.lists(st.text("#.$*@+ ", min_size=w, max_size=w), min_size=1, max_size=5))
)
def test_what_is_written_is_read_again(rows: list[str]) -> None:
    rows = ["#" * len(rows[0]), *["#" + row[1:] for row in rows]]
    text = "\n".join(rows)
    count = {symbol: text.count(symbol) for symbol in "#.$*@+"}
    right = count["@"] + count["+"] == 1 and count["$"] == count["."] + count["+"] and count["$"] + count["*"] > 0
    if right:
        board = read_sokoban("; 0\n" + text + "\n")[0]
        # Blanks at the end of a row are not seen: wall is filled in there.
        due = "\n".join(row.rstrip().ljust(len(rows[0]), "#") for row in rows)
        assert format_sokoban(board) == due
    else:
        with pytest.raises(ValueError, match="text, level 0, line 2: "):
            read_sokoban("; 0\n" + text + "\n")


def test_usual_files_are_read() -> None:
    text = "Title: one\n; by nobody\n\n  ####\n  #.@#\n###$-#\n#__  #\n######\nTitle: two\n####\n#+$#\n####\n\r\n"
    boards = read_sokoban(text)
    assert boards.shape == (2, 5, 6)
    assert format_sokoban(boards[1]) == "######\n#+$###\n######\n######\n######"
    assert format_sokoban(boards[0]).split("\n")[2] == "###$ #"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"; 0\n####\n#.$#\n####\n", r"level 0, line 2: it must have one player, got 0"),
        (EASY.encode() + b"\n####\n#@@#\n#.$#\n", r"level 1, line 5: it must have one player, got 2"),
        (b"#####\n#@$ #\n", r"level 0, line 1: it must have as many boxes as goals, got 1 and 0"),
        (b"#####\n#@$.#\n#  .#\n", r"got 1 and 2"),
        (b"####\n#@ #\n", r"at least one box"),
        (b"####\n#@x#\n", r"level 0, line 2: symbols must be .* got 'x'"),
        (b"", r"it must hold a level"),
        (b"; 0\n; 1\n", r"it must hold a level"),
        (b"####\n\xff\n", r"line 2: it must be UTF-8, got byte 0xff"),
        (b"Title\n7#\n#@-$-.#\n7#\n", r"line 2: rows must not be shortened by numbers, got '7#'"),
    ],
)
def test_wrong_files_are_refused_in_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    for name, packed in (("levels.txt", content), ("levels.txt.xz", lzma.compress(content))):
        (tmp_path / name).write_bytes(packed)
        with pytest.raises(ValueError, match=message) as error:
            sokoban(tmp_path / name)
        assert name in str(error.value)
        assert "\n" not in str(error.value)


def test_a_mark_of_the_byte_order_is_no_title(tmp_path: Path) -> None:
    (tmp_path / "levels.txt").write_text(EASY, encoding="utf-8-sig")
    for levels in (tmp_path / "levels.txt", (tmp_path / "levels.txt").read_text(encoding="utf-8")):
        assert read_sokoban(levels).shape == (1, 3, 7)


def test_broken_packing_is_refused(tmp_path: Path) -> None:
    for content in (b"no xz", lzma.compress(EASY.encode())[:-9]):
        (tmp_path / "a.xz").write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.xz: it must be a whole \.xz file"):
            read_sokoban(tmp_path / "a.xz")


WINDOWS = [(0, 0, 0, 1), (0, 0, -1, 1), (0, 0, 1), (0.5, 0, 1, 1), (10**6, 0, 1, 1)]


@pytest.mark.parametrize(
    ("levels", "windows", "message"),
    [
        (torch.zeros(1, 3, 3, dtype=torch.uint8), SOKOBAN_WINDOWS, r"`levels\[0\]` must have one player, got 0"),
        (torch.full((1, 3, 3), 7), SOKOBAN_WINDOWS, "levels.*out of range"),
        *((levels, SOKOBAN_WINDOWS, "`levels` must be a file") for levels in (None, [Path("a")], [[[1, 2], [1]]])),
        *((empty, SOKOBAN_WINDOWS, "it must hold a level, got none") for empty in ("", [], ["", ""])),
        (["", EASY], SOKOBAN_WINDOWS, "one level in each text, got 1 in 2 texts"),
        ([EASY + "\n" + EASY], SOKOBAN_WINDOWS, "one level in each text, got 2 in 1 texts"),
        *(([EASY], [(0, 0, 1, 1), window], r"`windows\[1\]` must be integers") for window in WINDOWS),
        ([EASY], [], "`windows` must hold at least one"),
        ([EASY], [(0, 0, 2, 7)], r"fewer than 2\*\*31"),
    ],
)
def test_wrong_arguments_are_refused(levels: Any, windows: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sokoban(levels, windows=windows)


def test_wrong_states_are_refused() -> None:
    world = sokoban([EASY])
    unknown, boxes, goals = (world.boards.clone() for _ in range(3))
    unknown[unknown == 5] = 9
    boxes[0, 1, 2], goals[0, 1, 2] = 3, 2
    for state, message in (
        (world.boards.long(), "`state` must be boards, uint8"),
        (torch.zeros(1, 3, 7, dtype=torch.uint8), r"`state\[0\]` must have one player"),
        (unknown, r"state\[0, 1, 1\]: 9 is out of range"),
        (boxes, r"`state\[0\]` must have as many boxes as goals, got 2 and 1"),
        (goals, r"`state\[0\]` must have as many boxes as goals, got 1 and 2"),
    ):
        with pytest.raises(ValueError, match=message):
            world.rollout(state, torch.zeros(1, 1, 1, dtype=torch.long))
