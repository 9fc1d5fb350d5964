"""Worlds: batched simulators in which planners try plans; grids, mazes, cube, Gymnasium environments."""

from neuroprior.worlds.cube import PocketCube, cube
from neuroprior.worlds.episodes import EpisodicWorld
from neuroprior.worlds.grid import GridWorld, egocentric, goal_direction, gridworld, local_view
from neuroprior.worlds.gymnasium import from_gymnasium
from neuroprior.worlds.labyrinth import labyrinth
from neuroprior.worlds.mazes import four_rooms, maze
from neuroprior.worlds.observations import Categories, Features, Patterns
from neuroprior.worlds.simulators import SimulatorWorld, from_simulator
from neuroprior.worlds.tabular import TabularWorld
from neuroprior.worlds.world import Rollout, World

__all__ = [
    "Categories",
    "EpisodicWorld",
    "Features",
    "GridWorld",
    "Patterns",
    "PocketCube",
    "Rollout",
    "SimulatorWorld",
    "TabularWorld",
    "World",
    "cube",
    "egocentric",
    "four_rooms",
    "from_gymnasium",
    "from_simulator",
    "goal_direction",
    "gridworld",
    "labyrinth",
    "local_view",
    "maze",
]
