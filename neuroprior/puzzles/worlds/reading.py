"""Files of puzzles: Sokoban levels and sliding tiles."""

import lzma
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from neuroprior._checks import check_memory

SYMBOLS = " #.$*@+"
"""The symbols of the codes 0 to 6; `-` and `_` are floor, too."""
_ALL_SYMBOLS = SYMBOLS + "-_"
MOST_TILES = 256
"""Cells of a board of sliding tiles, at most: numbers are one byte."""
Boards = npt.NDArray[np.uint8]


def read_sokoban(path_or_text: str | Path) -> Boards:
    """Sokoban levels as codes of cells.

    Understood are Boxoban's files, in which lines `; number` separate levels, and the usual `.xsb` symbols: `#` wall,
    `@` player, `+` player on goal, `$` box, `*` box on goal, `.` goal, and a blank, `-` or `_` for floor. Blank lines,
    comments (`;`) and titles (lines that begin with another symbol) end a level. What is missing of shorter rows and
    smaller levels is wall.

    Args:
        path_or_text: a file (UTF-8; packed where its name ends in `.xz`), or levels as text of more than one line.

    Returns:
        uint8 `[n, H, W]`, H and W of the largest level: 0 floor, 1 wall, 2 goal, 3 box, 4 box on goal, 5 player, 6
        player on goal.

    Raises:
        OSError: the file cannot be read.
        ValueError: the text holds no levels, or one of them is none: an unknown symbol, not one player, no box, or not
            as many boxes as goals. The message names file, level (from 0) and line.

    Example:
        >>> read_sokoban("#####\\n#@$.#\\n#####").shape
        (1, 3, 5)
    """
    name, text = _text_of(path_or_text)
    levels: list[list[str]] = []
    first_lines: list[int] = []
    within = False
    for number, line in enumerate(text.split("\n"), 1):
        row = line.rstrip()
        if row[:1].isdigit() and "#" in row and not row.strip(_ALL_SYMBOLS + "0123456789|()"):
            raise ValueError(f"{name}, line {number}: rows must not be shortened by numbers, got {row!r}.")
        is_row = bool(row) and row.lstrip()[0] in _ALL_SYMBOLS
        if is_row:
            if not within:
                levels.append([])
                first_lines.append(number)
            if unknown := row.strip(_ALL_SYMBOLS):
                raise ValueError(
                    f"{name}, level {len(levels) - 1}, line {number}: symbols must be # wall, @ player, + player on"
                    f" goal, $ box, * box on goal, . goal, blank, - or _ floor, got {unknown[0]!r}."
                )
            levels[-1].append(row)
        within = is_row
    if not levels:
        raise ValueError(f"{name}: it must hold a level, got none.")
    height, width = max(map(len, levels)), max(len(row) for level in levels for row in level)
    check_memory(len(levels) * height * width, levels=name)
    filled = "".join(
        "".join(row.ljust(width, "#") for row in level) + "#" * ((height - len(level)) * width) for level in levels
    )
    code = np.zeros(128, dtype=np.uint8)
    code[[ord(symbol) for symbol in SYMBOLS]] = range(len(SYMBOLS))
    boards = code[np.frombuffer(filled.encode("ascii"), dtype=np.uint8)].reshape(len(levels), height, width)
    if (wrong := count_problem(boards)) is not None:
        raise ValueError(f"{name}, level {wrong[0]}, line {first_lines[wrong[0]]}: it {wrong[1]}")
    return boards


def count_problem(boards: Boards) -> tuple[int, str] | None:
    """The first of `boards [n, H, W]` that is no level by its numbers of players, boxes and goals, and why."""
    players, boxes, goals = (np.isin(boards, codes).sum((1, 2)) for codes in ([5, 6], [3, 4], [2, 4, 6]))
    wrong = np.flatnonzero((players != 1) | (boxes != goals) | (boxes == 0))
    if not len(wrong):
        return None
    first = int(wrong[0])
    if players[first] != 1:
        return first, f"must have one player, got {players[first]}."
    if boxes[first] != goals[first]:
        return first, f"must have as many boxes as goals, got {boxes[first]} and {goals[first]}."
    return first, "must have at least one box, got none."


def format_sokoban(board: npt.ArrayLike) -> str:
    """A board of codes `[H, W]` (an array or a tensor) as text in the usual symbols, one row a line.

    Raises:
        ValueError: it is no board.

    Example:
        >>> print(format_sokoban(read_sokoban("#####\\n#@$.#\\n#####")[0]))
        #####
        #@$.#
        #####
    """
    codes = np.asarray(board)
    if codes.ndim != 2 or codes.dtype.kind not in "iu" or codes.size == 0 or codes.min() < 0 or codes.max() > 6:
        raise ValueError(f"`board` must be integers [H, W] from 0 to 6, got {codes.dtype} {list(codes.shape)}.")
    return "\n".join("".join(SYMBOLS[code] for code in row) for row in codes)


def read_tiles(path: str | Path, shape: tuple[int, int] | None = None) -> Boards:
    """Sliding tiles: one puzzle a line, the numbers of its tiles row by row, 0 the blank.

    Args:
        path: a file (UTF-8; packed where its name ends in `.xz`), or puzzles as text of more than one line.
        shape: height and width; None: square.

    Returns:
        uint8 `[n, H, W]`.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file holds no puzzle, or a line is none; the message names file and line. Or the shape is none.

    Example:
        >>> with open("tiles.txt", "w") as file:
        ...     _ = file.write("1 0 2 3 4 5 6 7 8\\n")
        >>> read_tiles("tiles.txt").tolist()
        [[[1, 0, 2], [3, 4, 5], [6, 7, 8]]]
    """
    name, text = _text_of(path)
    lines = [(number, line.split()) for number, line in enumerate(text.split("\n"), 1) if line.strip()]
    if not lines:
        raise ValueError(f"{name}: it must hold a puzzle, got none.")
    if shape is not None:
        shape = board_shape(shape)
    cells = len(lines[0][1]) if shape is None else shape[0] * shape[1]
    if cells > MOST_TILES:
        raise ValueError(f"{name}: boards must have at most {MOST_TILES} cells, got {cells}.")
    side = math.isqrt(cells)
    if shape is None and side * side != cells:
        raise ValueError(
            f"{name}, line {lines[0][0]}: boards must be square without shape=(height, width), got {cells} numbers."
        )
    height, width = (side, side) if shape is None else shape
    tiles = {str(tile): tile for tile in range(cells)}
    boards = []
    for number, words in lines:
        board = [tiles.get(word, -1) for word in words]
        if len(board) != cells or -1 in board or len(set(board)) != cells:
            raise ValueError(
                f"{name}, line {number}: each of 0 to {cells - 1} must be there once, got {' '.join(words)[:80]!r}."
            )
        boards.append(board)
    return np.array(boards, dtype=np.uint8).reshape(-1, height, width)


def board_shape(shape: Sequence[int]) -> tuple[int, int]:
    """Height and width; ValueError for what is none."""
    if not isinstance(shape, Sequence) or len(shape) != 2 or not all(isinstance(n, int) and n > 0 for n in shape):
        raise ValueError(f"`shape` must be height and width, integers of at least 1, got {shape!r}.")
    return shape[0], shape[1]


def _text_of(path_or_text: str | Path) -> tuple[str, str]:
    """What messages call it, and the text; a string with a line break, or without a name, is the text itself."""
    if isinstance(path_or_text, str) and ("\n" in path_or_text or not path_or_text.strip()):
        return "text", path_or_text.removeprefix("\ufeff")
    path = Path(path_or_text)
    content = path.read_bytes()
    if path.suffix == ".xz":
        try:
            content = lzma.decompress(content)
        except (lzma.LZMAError, EOFError) as error:
            raise ValueError(f"{path}: it must be a whole .xz file, got one that is not: {error}") from error
    try:
        return str(path), content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}, line {line}: it must be UTF-8, got byte {content[error.start]:#04x}.") from error
