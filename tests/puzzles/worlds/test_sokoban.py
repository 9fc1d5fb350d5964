"""Sokoban: its rules, its patterns and its files, against plain Python."""

import lzma
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from neuroprior import FrontierPlanner, SamplingPlanner, UniformPrior
from neuroprior.puzzles import SOKOBAN_WINDOWS, SokobanWorld, format_sokoban, read_sokoban, sokoban, windows_within
from neuroprior.worlds import from_gymnasium

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
    with pytest.raises(ValueError, match=r"fewer than 2\*\*31"):
        sokoban([EASY], windows=[(0, 0, 2, 7)])


def test_board_observation_shows_planes() -> None:
    world = sokoban(["#####\n#+$.#\n#*  #\n#  $#\n#####"], observation="board")
    planes = world.observe(world.boards).view(4, 5, 5)
    assert planes.dtype == torch.float32
    assert planes[0].sum() == 16
    assert [plane.nonzero().tolist() for plane in planes[1:]] == [
        [[1, 1], [1, 3], [2, 1]],
        [[1, 2], [2, 1], [3, 3]],
        [[1, 1]],
    ]


def test_groups_are_wall_layouts() -> None:
    world = sokoban([EASY, "#######\n#. $ @#\n#######", "#######\n#@ $. #\n####  #"])
    groups = world.group(world.boards)
    assert groups[0] == groups[1] != groups[2]
    assert (groups >= 0).all()
    assert groups[:2].equal(sokoban([EASY, EASY]).group(world.boards[:2]))


def shortest(world: SokobanWorld, state: torch.Tensor) -> int:
    """Breadth-first search from one board."""
    front, seen, depth = state[None], {state.numpy().tobytes()}, 0
    while not world.solved(front).any():
        after, _ = world.step(front.repeat_interleave(4, 0), torch.arange(4).repeat(len(front)))
        new = [board for board in after if board.numpy().tobytes() not in seen]
        new = list({board.numpy().tobytes(): board for board in new}.values())
        assert new, "unsolvable"
        seen.update(board.numpy().tobytes() for board in new)
        front, depth = torch.stack(new), depth + 1
    return depth


def test_lower_bound_is_one_and_matches_boxes_with_goals() -> None:
    # Both boxes are nearest to the same goal: the matching counts 1 + 3, the nearest goals would count 1 + 1.
    text = "#########\n#       #\n# $.$  .#\n#@      #\n#########"
    world = sokoban([text, EASY])
    assert world.lower_bound(world.boards).tolist() == [4, 2]
    assert (world.lower_bound(world.boards[:1]) <= shortest(world, world.boards[0])).all()
    many = sokoban(["########\n#@     #\n#$$$$$$#\n#......#\n#      #\n########"])
    assert many.lower_bound(many.boards).tolist() == [6]
    assert many.lower_bound(many.boards[:0]).tolist() == []


def test_files_hold_what_their_page_says(world: SokobanWorld) -> None:
    assert world.boards.shape == (1000, 10, 10)
    assert ((world.boards == 3).flatten(1).sum(1) == 4).all()
    assert not (world.boards == 6).any()


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
        (b"; 0\n####\n#.$#\n####\n", r"level 0, line 2: one player is expected, not 0"),
        (EASY.encode() + b"\n####\n#@@#\n#.$#\n", r"level 1, line 5: one player is expected, not 2"),
        (b"#####\n#@$ #\n", r"level 0, line 1: as many boxes as goals are expected, not 1 and 0"),
        (b"#####\n#@$.#\n#  .#\n", r"as many boxes as goals are expected, not 1 and 2"),
        (b"####\n#@ #\n", r"at least one box"),
        (b"####\n#@x#\n", r"level 0, line 2: 'x' is no symbol"),
        (b"", r"there is no level"),
        (b"; 0\n; 1\n", r"there is no level"),
        (b"####\n\xff\n", r"line 2: UTF-8 is expected, not byte 0xff"),
        (b"Title\n7#\n#@-$-.#\n7#\n", r"line 2: rows of repeated symbols, such as '7#', are not understood"),
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
        with pytest.raises(ValueError, match=r"a\.xz: it is no whole \.xz file"):
            read_sokoban(tmp_path / "a.xz")


def test_wrong_arguments_are_refused(world: SokobanWorld) -> None:
    with pytest.raises(ValueError, match="observation"):
        sokoban([EASY], observation="picture")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"levels\[0\]: one player"):
        sokoban(torch.zeros(1, 3, 3, dtype=torch.uint8))
    with pytest.raises(ValueError, match=r"levels.*out of range"):
        sokoban(torch.full((1, 3, 3), 7))
    for levels in (None, [Path("levels.txt")], [[[1, 2], [1]]], EASY.encode()):
        with pytest.raises(ValueError, match="levels: a file or boards of one size"):
            sokoban(levels)
    for empty in ("", [], ["", ""]):
        with pytest.raises(ValueError, match="there is no level"):
            sokoban(empty)
    for texts, found in ((["", EASY], 1), ([EASY + "\n" + EASY], 2)):
        with pytest.raises(ValueError, match=f"one in each of {len(texts)} texts is expected, not {found}"):
            sokoban(texts)
    for window in ((0, 0, 0, 1), (0, 0, -1, 1), (0, 0, 1), (0.5, 0, 1, 1), (10**6, 0, 1, 1)):
        with pytest.raises(ValueError, match=r"windows\[1\]: integers"):
            sokoban([EASY], windows=[(0, 0, 1, 1), window])  # type: ignore[list-item]


def test_wrong_states_are_refused() -> None:
    world = sokoban([EASY])
    unknown, boxes, goals = (world.boards.clone() for _ in range(3))
    unknown[unknown == 5] = 9
    boxes[0, 1, 2], goals[0, 1, 2] = 3, 2
    empty = torch.zeros(1, 3, 7, dtype=torch.uint8)
    for state, message in (
        (world.boards.long(), "state: uint8"),
        (empty, r"state\[0\]: a board with one player"),
        (unknown, r"state\[0, 1, 1\]: 9 is out of range"),
        (boxes, r"state\[0\]: .* as many boxes as goals"),
        (goals, r"state\[0\]: .* as many boxes as goals"),
    ):
        with pytest.raises(ValueError, match=message):
            world.rollout(state, torch.zeros(1, 1, 1, dtype=torch.long))


def test_planners_solve_an_easy_level() -> None:
    world = sokoban([EASY])
    state = world.reset(3)
    # There are 64 plans of 3 actions. The frontier planner tries all; 2,000 samples miss the right one with p < 1e-13.
    for planner in (
        FrontierPlanner(UniformPrior(4), 3, 64, objective="return"),
        SamplingPlanner(UniformPrior(4), 3, 2000, objective="return"),
    ):
        decision = planner.plan(world, state, torch.Generator().manual_seed(0))
        assert world.solved(decision.final_state).all()
        assert decision.plan.tolist() == [[3, 3, 3]] * 3


def test_goals_of_minigrid_are_solved() -> None:
    pytest.importorskip("minigrid")
    world = from_gymnasium("MiniGrid-Empty-5x5-v0", progress=False)
    states = torch.arange(world.num_states)  # type: ignore[attr-defined]
    assert world.has_goal
    assert world.solved(states).equal(world.terminated(states))
    assert 0 < world.solved(states).sum() < len(states)


def test_lava_and_holes_are_no_goals() -> None:
    world = from_gymnasium("FrozenLake-v1")
    states = torch.arange(16)
    assert world.solved(states).nonzero().flatten().tolist() == [15]
    assert world.terminated(states).sum() == 5
