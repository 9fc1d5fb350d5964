"""Worlds: batched simulators in which planners try plans."""

from neuroprior.worlds.cube import PocketCube, cube
from neuroprior.worlds.grid import GridWorld, gridworld
from neuroprior.worlds.labyrinth import labyrinth
from neuroprior.worlds.mazes import four_rooms, maze
from neuroprior.worlds.tabular import TabularWorld
from neuroprior.worlds.world import Rollout, World

__all__ = ["GridWorld", "PocketCube", "Rollout", "TabularWorld", "World", "cube", "gridworld", "labyrinth"]
