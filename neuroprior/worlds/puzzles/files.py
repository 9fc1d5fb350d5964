"""Files of puzzles: Sokoban levels in Boxoban's and the usual text, sliding tiles a board a line; plain or .xz."""

import lzma
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

SYMBOLS = {" ": 0, "-": 0, "_": 0, "#": 1, ".": 2, "$": 3, "*": 4, "@": 5, "+": 6}
"""Cells of Sokoban levels in text; three symbols stand for the floor."""

WALL, BOX, BOX_ON_GOAL, PLAYER = 1, 3, 4, 5

LARGEST = 255
"""Cells of a sliding puzzle at most: boards are uint8."""


def read_sokoban(source: str | Path | Sequence[str]) -> Tensor:
    """Sokoban levels from a file, plain or .xz, or from texts of levels.

    Levels are lines of `#` wall, `@` player, `+` player on a goal, `$` box, `*` box on a goal, `.` goal, and a space, `-`
    or `_` floor. What stands between levels does not matter: `; 12` as in Boxoban's files, titles, comments, empty
    lines. Smaller levels are filled up with walls.

    Returns:
        uint8 `[n, H, W]`; see `neuroprior.worlds.sokoban`.

    Raises:
        ValueError: there are no levels, or one has not one player, has no boxes, or more boxes than goals.
        OSError: the file cannot be read.
    """
    if isinstance(source, str | Path):
        levels = [(f"{source}, line {line}", rows) for line, rows in _levels(_text(source).splitlines())]
        if not levels:
            raise ValueError(f"{source}: Sokoban levels are expected (lines of # @ $ . and spaces); there are none")
    else:
        levels = [(f"levels[{n}]", rows) for n, text in enumerate(source) for _, rows in _levels(text.splitlines())]
        if len(levels) != len(source) or not levels:
            raise ValueError("levels: one level a text is expected (lines of # @ $ . and spaces), and at least one")
    for where, rows in levels:
        counts = {symbol: sum(row.count(symbol) for row in rows) for symbol in "@+$*."}
        players, boxes = counts["@"] + counts["+"], counts["$"] + counts["*"]
        goals = counts["."] + counts["+"] + counts["*"]
        if players != 1:
            raise ValueError(f"{where}: one player (@ or +) is expected in a level, not {players}")
        if boxes == 0 or boxes > goals:
            raise ValueError(f"{where}: boxes, and a goal for each, are expected in a level, not {boxes} and {goals}")
    height, width = max(len(rows) for _, rows in levels), max(len(row) for _, rows in levels for row in rows)
    boards = torch.full((len(levels), height, width), WALL, dtype=torch.uint8)
    for board, (_, rows) in zip(boards, levels, strict=True):
        for y, row in enumerate(rows):
            board[y, : len(row)] = torch.tensor([SYMBOLS[symbol] for symbol in row], dtype=torch.uint8)
    return boards


def format_sokoban(board: Tensor) -> str:
    """A board `[H, W]` as text, in the symbols of `read_sokoban`; its trailing walls are kept."""
    symbols = {number: symbol for symbol, number in reversed(SYMBOLS.items())}
    return "\n".join("".join(symbols[cell] for cell in row) for row in board.tolist())


def read_tiles(path: str | Path, shape: tuple[int, int] | None = None) -> Tensor:
    """Boards of sliding tiles from a file, plain or .xz: a board a line, its tiles row by row, 0 the blank.

    Args:
        path: the file.
        shape: rows and columns; None: a square.

    Returns:
        uint8 `[n, H, W]`.

    Raises:
        ValueError: a line is no board; the message names it.
        OSError: the file cannot be read.
    """
    rows = []
    for number, line in enumerate(_text(path).splitlines(), 1):
        if not line.strip():
            continue
        where = f"{path}, line {number}"
        try:
            rows.append([int(tile) for tile in line.replace(",", " ").split()])
        except ValueError:
            raise ValueError(f"{where}: numbers of tiles are expected, not {line.strip()[:40]!r}") from None
        if len(rows[-1]) != len(rows[0]):
            raise ValueError(f"{where}: {len(rows[0])} tiles are expected, as before, not {len(rows[-1])}")
        if sorted(rows[-1]) != list(range(len(rows[-1]))):
            raise ValueError(f"{where}: each of 0 to {len(rows[-1]) - 1} once is expected (0 is the blank)")
    if not rows:
        raise ValueError(f"{path}: boards of sliding tiles, one a line, are expected; there are none")
    size = len(rows[0])
    high, wide = shape or (round(size**0.5),) * 2
    if high * wide != size:
        raise ValueError(f"{path}: {size} tiles a line are no board of {high} x {wide}; give its shape")
    return check_boards(str(path), torch.tensor(rows).view(-1, high, wide))


def check_boards(what: str, boards: Tensor) -> Tensor:
    """Boards of sliding tiles as uint8 `[n, H, W]`; ValueError unless each has every tile once."""
    if not isinstance(boards, Tensor) or boards.dim() != 3 or boards.is_floating_point() or boards.numel() == 0:
        raise ValueError(f"{what}: integers [n, H, W] are expected, at least one board")
    tiles = boards.flatten(1).long()
    if tiles.shape[1] > LARGEST or min(boards.shape[1:]) < 2:
        raise ValueError(
            f"{what}: boards of at least 2 x 2 and at most {LARGEST} cells are expected, not {list(boards.shape[1:])}"
        )
    wrong = (tiles.sort(1).values != torch.arange(tiles.shape[1], device=tiles.device)).any(1)
    if bool(wrong.any()):
        raise ValueError(f"{what}[{int(wrong.nonzero()[0])}]: each of 0 to {tiles.shape[1] - 1} once is expected")
    return boards.to(torch.uint8)


def _text(path: str | Path) -> str:
    """The text of a file, plain or packed with xz."""
    data = Path(path).read_bytes()
    try:
        return (lzma.decompress(data) if data[:6] == b"\xfd7zXZ\x00" else data).decode("utf-8")
    except lzma.LZMAError as error:
        raise ValueError(f"{path}: a damaged .xz file ({error})") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: a text file (UTF-8, plain or .xz) is expected") from None


def _levels(lines: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
    """The first line's number and the rows of each level: lines of symbols alone, with a wall."""
    rows: list[str] = []
    for number, line in enumerate([*lines, ""], 1):
        row = line.rstrip()
        if row and "#" in row and set(row) <= set(SYMBOLS):
            rows.append(row)
        elif rows:
            yield number - len(rows), rows
            rows = []
