"""Worlds whose actions are vectors: a mass, an arm among obstacles, MuJoCo."""

from neuroprior.worlds.continuous.continuous_world import ContinuousWorld, check_vectors
from neuroprior.worlds.continuous.double_integrator import DoubleIntegrator
from neuroprior.worlds.continuous.mujoco import MujocoWorld
from neuroprior.worlds.continuous.mujoco_tasks import from_mujoco
from neuroprior.worlds.continuous.planar_arm import PlanarArm

__all__ = ["ContinuousWorld", "DoubleIntegrator", "MujocoWorld", "PlanarArm", "check_vectors", "from_mujoco"]
