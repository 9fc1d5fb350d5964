"""Puzzles: worlds with a goal, read from files of levels."""

from neuroprior.worlds.puzzles.reading import format_sokoban, read_sokoban, read_tiles
from neuroprior.worlds.puzzles.sliding_tiles import SlidingTilesWorld, sliding_tiles
from neuroprior.worlds.puzzles.sokoban import SokobanWorld, sokoban
from neuroprior.worlds.puzzles.windows import SOKOBAN_WINDOWS, windows_within

__all__ = [
    "SOKOBAN_WINDOWS",
    "SlidingTilesWorld",
    "SokobanWorld",
    "format_sokoban",
    "read_sokoban",
    "read_tiles",
    "sliding_tiles",
    "sokoban",
    "windows_within",
]
