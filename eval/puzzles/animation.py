"""An animated picture (SVG) of a solved puzzle, which browsers play without scripts."""

import torch
from torch import Tensor

from eval.puzzles.contest import LETTERS
from neuroprior.puzzles import PuzzleWorld, SlidingTilesWorld
from neuroprior.puzzles.worlds import rules

CELL = 32
"""Pixels of a cell."""

SECONDS, PAUSE = 0.15, 1.5
"""Of a move, and at the end."""

WALL, FLOOR, GOAL, BOX, PLAYER, TILE = "#6b7280", "#f3f4f6", "#bfdbfe", "#b45309", "#1d4ed8", "#e5e7eb"
"""Colours."""


def animation(world: PuzzleWorld, board: Tensor, moves: str) -> str:
    """A puzzle that is solved by `moves` (letters u, d, l, r) from `board [H, W]`, as SVG, over and over."""
    states = [board]
    for letter in moves:
        states.append(world.step(states[-1][None], torch.tensor([LETTERS.index(letter)]))[0][0])
    height, width = board.shape
    parts = [f'<rect width="{width * CELL}" height="{height * CELL}" fill="{FLOOR}"/>']
    if isinstance(world, SlidingTilesWorld):
        for tile in range(1, height * width):
            parts.append(_animate(_tile(tile), [_first_cell(state == tile) for state in states], width))
    else:
        for cell, code in enumerate(board.flatten().tolist()):
            if code in (rules.WALL, rules.GOAL, rules.BOX_ON_GOAL, rules.PLAYER_ON_GOAL):
                colour = WALL if code == rules.WALL else GOAL
                parts.append(_rectangle(cell % width * CELL, cell // width * CELL, CELL, colour))
        parts += [_animate(_rectangle(3, 3, CELL - 6, BOX), cells, width) for cells in _boxes(states)]
        player = f'<circle cx="{CELL / 2}" cy="{CELL / 2}" r="{CELL / 3}" fill="{PLAYER}"/>'
        parts.append(_animate(player, [_first_cell(state >= rules.PLAYER) for state in states], width))
    size = f'width="{width * CELL}" height="{height * CELL}"'
    title = f"<title>A puzzle solved in {len(moves)} moves</title>"
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img">{title}{"".join(parts)}</svg>\n'


def _first_cell(there: Tensor) -> int:
    return int(there.flatten().int().argmax())


def _boxes(states: list[Tensor]) -> list[list[int]]:
    """The cell of each box in each state."""
    cells = [
        ((state == rules.BOX) | (state == rules.BOX_ON_GOAL)).flatten().nonzero()[:, 0].tolist() for state in states
    ]
    tracks = [[cell] for cell in cells[0]]
    for now in cells[1:]:
        moved = [cell for cell in now if cell not in [track[-1] for track in tracks]]
        for track in tracks:
            track.append(track[-1] if track[-1] in now else moved[0])
    return tracks


def _rectangle(x: int, y: int, size: int, colour: str) -> str:
    rounded = 0 if size == CELL else 3  # walls join
    return f'<rect x="{x}" y="{y}" width="{size}" height="{size}" rx="{rounded}" fill="{colour}"/>'


def _tile(number: int) -> str:
    middle = f'x="{CELL / 2}" y="{CELL / 2 + 5}" text-anchor="middle"'
    return f'{_rectangle(1, 1, CELL - 2, TILE)}<text {middle} font-family="sans-serif" font-size="14">{number}</text>'


def _animate(shape: str, cells: list[int], width: int) -> str:
    """A shape that is in these cells, one after the other."""
    places = [f"{cell % width * CELL} {cell // width * CELL}" for cell in cells]
    kept = [k for k in range(len(places)) if k == 0 or places[k] != places[k - 1]]
    if len(kept) == 1:
        return f'<g transform="translate({places[0]})">{shape}</g>'
    seconds = (len(cells) - 1) * SECONDS + PAUSE
    values, times = ";".join(places[k] for k in kept), ";".join(f"{k * SECONDS / seconds:.4f}" for k in kept)
    return (
        f'<g transform="translate({places[0]})">{shape}<animateTransform attributeName="transform" type="translate"'
        f' calcMode="discrete" values="{values}" keyTimes="{times}" dur="{seconds:.2f}s" repeatCount="indefinite"/></g>'
    )
