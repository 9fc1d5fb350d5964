"""Worlds with goals: Sokoban and sliding tiles, their patterns and their files."""

from neuroprior.worlds.puzzles.puzzle import PuzzleWorld
from neuroprior.worlds.puzzles.reading import format_sokoban, read_sokoban, read_tiles
from neuroprior.worlds.puzzles.sliding_tiles import SlidingTilesWorld, sliding_tiles, tile_windows
from neuroprior.worlds.puzzles.sokoban import SOKOBAN_WINDOWS, SokobanWorld, sokoban
from neuroprior.worlds.puzzles.windows import Window, Windows, windows_with_mover, windows_within

__all__ = [
    "SOKOBAN_WINDOWS",
    "PuzzleWorld",
    "SlidingTilesWorld",
    "SokobanWorld",
    "Window",
    "Windows",
    "format_sokoban",
    "read_sokoban",
    "read_tiles",
    "sliding_tiles",
    "sokoban",
    "tile_windows",
    "windows_with_mover",
    "windows_within",
]
