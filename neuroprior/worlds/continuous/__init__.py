"""Worlds whose actions are vectors: a mass, an arm among obstacles, MuJoCo."""

from neuroprior.worlds.continuous.continuous_world import ContinuousWorld, check_vectors

__all__ = ["ContinuousWorld", "check_vectors"]
