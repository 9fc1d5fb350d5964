"""Worlds: batched simulators in which planners try plans; grids, mazes, puzzles, foraging, Gymnasium environments."""

from neuroprior.worlds.continuous import ContinuousWorld, DoubleIntegrator, PlanarArm, from_mujoco
from neuroprior.worlds.cube import PocketCube, cube
from neuroprior.worlds.episodes import EpisodicWorld
from neuroprior.worlds.foraging import ForagingWorld, patches
from neuroprior.worlds.grid import GridWorld, egocentric, goal_direction, gridworld, local_view
from neuroprior.worlds.gymnasium import SteppedWorld, from_gymnasium
from neuroprior.worlds.labyrinth import labyrinth
from neuroprior.worlds.mazes import four_rooms, maze
from neuroprior.worlds.puzzles import (
    SOKOBAN_WINDOWS,
    PuzzleWorld,
    SlidingTilesWorld,
    SokobanWorld,
    format_sokoban,
    read_sokoban,
    read_tiles,
    sliding_tiles,
    sokoban,
    windows_within,
)
from neuroprior.worlds.tabular import TabularWorld
from neuroprior.worlds.world import Rollout, World

__all__ = [
    "ContinuousWorld",
    "DoubleIntegrator",
    "PlanarArm",
    "EpisodicWorld",
    "ForagingWorld",
    "GridWorld",
    "PocketCube",
    "PuzzleWorld",
    "Rollout",
    "SOKOBAN_WINDOWS",
    "SlidingTilesWorld",
    "SokobanWorld",
    "SteppedWorld",
    "TabularWorld",
    "World",
    "cube",
    "egocentric",
    "format_sokoban",
    "four_rooms",
    "from_gymnasium",
    "from_mujoco",
    "goal_direction",
    "gridworld",
    "labyrinth",
    "local_view",
    "maze",
    "patches",
    "read_sokoban",
    "read_tiles",
    "sliding_tiles",
    "sokoban",
    "windows_within",
]
