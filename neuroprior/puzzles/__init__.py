"""Wing 3: search with a guarantee: Sokoban and sliding tiles, priors over patterns, best-first search, bootstrap."""

from neuroprior.puzzles.best_first import AStarPlanner, BestFirstPlanner, LevinPlanner, Search
from neuroprior.puzzles.bootstrap import Sweep, bootstrap
from neuroprior.puzzles.priors.log_linear import LogLinearPrior, Steps
from neuroprior.puzzles.worlds.puzzle import PuzzleWorld
from neuroprior.puzzles.worlds.reading import format_sokoban, read_sokoban, read_tiles
from neuroprior.puzzles.worlds.sliding_tiles import SlidingTilesWorld, sliding_tiles, tile_windows
from neuroprior.puzzles.worlds.sokoban import SOKOBAN_WINDOWS, SokobanWorld, sokoban
from neuroprior.puzzles.worlds.windows import Window, Windows, windows_with_mover, windows_within

__all__ = [
    "AStarPlanner",
    "BestFirstPlanner",
    "LevinPlanner",
    "LogLinearPrior",
    "PuzzleWorld",
    "SOKOBAN_WINDOWS",
    "Search",
    "SlidingTilesWorld",
    "SokobanWorld",
    "Steps",
    "Sweep",
    "Window",
    "Windows",
    "bootstrap",
    "format_sokoban",
    "read_sokoban",
    "read_tiles",
    "sliding_tiles",
    "sokoban",
    "tile_windows",
    "windows_with_mover",
    "windows_within",
]
