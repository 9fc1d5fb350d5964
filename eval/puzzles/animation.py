"""An animated picture (SVG) of a solved puzzle, which browsers play without scripts."""

from typing import Any

import torch
from torch import Tensor

from eval.puzzles.contest import LETTERS
from neuroprior.worlds import SlidingTilesWorld

CELL = 32
"""Pixels of a cell."""

SECONDS, PAUSE = 0.15, 1.5
"""Of a move, and at the end."""

COLOURS = {"wall": "#6b7280", "floor": "#f3f4f6", "goal": "#bfdbfe", "box": "#b45309", "player": "#1d4ed8", "tile": "#e5e7eb"}


def animation(world: Any, board: Tensor, moves: str) -> str:
    """A puzzle that is solved by `moves` (letters u, d, l, r) from `board [H, W]`, as SVG, over and over."""
    states = [board]
    for letter in moves:
        states.append(world.step(states[-1][None], torch.tensor([LETTERS.index(letter)]))[0][0])
    height, width = board.shape
    seconds = len(moves) * SECONDS + PAUSE
    times = [min(k * SECONDS / seconds, 1.0) for k in range(len(states))]
    parts = [f'<rect width="{width * CELL}" height="{height * CELL}" fill="{COLOURS["floor"]}"/>']
    if isinstance(world, SlidingTilesWorld):
        for tile in range(1, height * width):
            places = [int((state == tile).flatten().long().argmax()) for state in states]
            parts.append(_moving(_tile(tile), places, times, width, seconds))
    else:
        kinds = world.kinds(board[None])[0]
        for y in range(height):
            for x in range(width):
                kind = {1: "wall", 2: "goal", 4: "goal"}.get(int(kinds[y, x]))
                if kind:
                    parts.append(f'<rect x="{x * CELL}" y="{y * CELL}" width="{CELL}" height="{CELL}" fill="{COLOURS[kind]}"/>')
        parts += [_moving(_box(), places, times, width, seconds) for places in _boxes(world, states)]
        players = [int(world.mover(state[None])) for state in states]
        parts.append(_moving(f'<circle cx="{CELL / 2}" cy="{CELL / 2}" r="{CELL / 3}" fill="{COLOURS["player"]}"/>', players, times, width, seconds))
    size = f'width="{width * CELL}" height="{height * CELL}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img"><title>A puzzle solved in {len(moves)} moves</title>{"".join(parts)}</svg>\n'


def _boxes(world: Any, states: list[Tensor]) -> list[list[int]]:
    """The cell of each box in each state."""
    cells = [((state == 3) | (state == 4)).flatten().nonzero()[:, 0].tolist() for state in states]
    tracks = [[cell] for cell in cells[0]]
    for now in cells[1:]:
        moved = [cell for cell in now if cell not in [track[-1] for track in tracks]]
        for track in tracks:
            track.append(track[-1] if track[-1] in now else moved[0])
    return tracks


def _box() -> str:
    return f'<rect x="3" y="3" width="{CELL - 6}" height="{CELL - 6}" rx="3" fill="{COLOURS["box"]}"/>'


def _tile(number: int) -> str:
    text = f'<text x="{CELL / 2}" y="{CELL / 2 + 5}" text-anchor="middle" font-family="sans-serif" font-size="14">{number}</text>'
    return f'<rect x="1" y="1" width="{CELL - 2}" height="{CELL - 2}" rx="3" fill="{COLOURS["tile"]}" stroke="{COLOURS["wall"]}"/>{text}'


def _moving(shape: str, places: list[int], times: list[float], width: int, seconds: float) -> str:
    """A shape that is in these cells at these times."""
    kept = [k for k in range(len(places)) if k == 0 or places[k] != places[k - 1]]
    x, y = places[0] % width * CELL, places[0] // width * CELL
    if len(kept) == 1:
        return f'<g transform="translate({x} {y})">{shape}</g>'
    values = ";".join(f"{places[k] % width * CELL} {places[k] // width * CELL}" for k in kept)
    keys = ";".join(f"{times[k]:.4f}" for k in kept)
    return (
        f'<g transform="translate({x} {y})">{shape}<animateTransform attributeName="transform" type="translate"'
        f' calcMode="discrete" values="{values}" keyTimes="{keys}" dur="{seconds:.2f}s" repeatCount="indefinite"/></g>'
    )
