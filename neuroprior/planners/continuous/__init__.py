"""Planners of vectors: random shooting, iCEM and MPPI, each of which may sample from a prior."""

from neuroprior.planners.continuous.coloured_noise import coloured_noise
from neuroprior.planners.continuous.control import Control, control
from neuroprior.planners.continuous.icem import ICEMPlanner
from neuroprior.planners.continuous.mppi import MPPIPlanner
from neuroprior.planners.continuous.shares import Shares
from neuroprior.planners.continuous.shooting import ShootingPlanner
from neuroprior.planners.continuous.vector_planner import Memory, VectorDecision, VectorPlanner

__all__ = [
    "Control",
    "ICEMPlanner",
    "MPPIPlanner",
    "Memory",
    "Shares",
    "ShootingPlanner",
    "VectorDecision",
    "VectorPlanner",
    "coloured_noise",
    "control",
]
