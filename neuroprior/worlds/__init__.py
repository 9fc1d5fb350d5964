"""Worlds: batched simulators in which planners try plans."""

from neuroprior.worlds.grid import GridWorld, egocentric, gridworld, local_view
from neuroprior.worlds.labyrinth import labyrinth
from neuroprior.worlds.mazes import four_rooms, maze
from neuroprior.worlds.tabular import TabularWorld
from neuroprior.worlds.world import Rollout, World

__all__ = [
    "GridWorld",
    "Rollout",
    "TabularWorld",
    "World",
    "egocentric",
    "four_rooms",
    "gridworld",
    "labyrinth",
    "local_view",
    "maze",
]
