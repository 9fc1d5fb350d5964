"""Worlds: batched simulators in which planners try plans."""

from neuroprior.worlds.grid import GridWorld, gridworld
from neuroprior.worlds.labyrinth import labyrinth
from neuroprior.worlds.tabular import TabularWorld
from neuroprior.worlds.world import Rollout, World

__all__ = ["GridWorld", "Rollout", "TabularWorld", "World", "gridworld", "labyrinth"]
