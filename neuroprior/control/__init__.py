"""Wing 2: actions that are vectors: their plans and files, priors, worlds, planners and conformance suites."""

from neuroprior.control.files import read_vector_plans, vector_plans_from_trajectories, write_vector_plans
from neuroprior.control.planners.coloured_noise import coloured_noise
from neuroprior.control.planners.control import Control, control
from neuroprior.control.planners.icem import ICEMPlanner
from neuroprior.control.planners.mppi import MPPIPlanner
from neuroprior.control.planners.shares import Shares
from neuroprior.control.planners.shooting import ShootingPlanner
from neuroprior.control.planners.vector_planner import Memory, VectorDecision, VectorPlanner
from neuroprior.control.priors.autoregressive import AutoregressivePrior
from neuroprior.control.priors.networks import VectorGRU
from neuroprior.control.priors.noise import NoisePrior
from neuroprior.control.priors.stored_windows import StoredWindows
from neuroprior.control.priors.vector_prior import GaussianForecast, VectorPrior
from neuroprior.control.testing.planners import check_vector_planner
from neuroprior.control.testing.priors import check_vector_prior
from neuroprior.control.testing.worlds import check_continuous_world
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.control.worlds.continuous_world import ContinuousWorld
from neuroprior.control.worlds.double_integrator import DoubleIntegrator
from neuroprior.control.worlds.mujoco import MujocoWorld
from neuroprior.control.worlds.mujoco_tasks import from_mujoco
from neuroprior.control.worlds.planar_arm import PlanarArm
from neuroprior.testing.rules import PRIOR_CHECKS, WORLD_CHECKS

PRIOR_CHECKS.add("VectorPrior", (VectorPrior, check_vector_prior))
WORLD_CHECKS.add("ContinuousWorld", (ContinuousWorld, check_continuous_world))

__all__ = [
    "AutoregressivePrior",
    "ContinuousWorld",
    "Control",
    "DoubleIntegrator",
    "GaussianForecast",
    "ICEMPlanner",
    "MPPIPlanner",
    "Memory",
    "MujocoWorld",
    "NoisePrior",
    "PlanarArm",
    "Shares",
    "ShootingPlanner",
    "StoredWindows",
    "VectorDecision",
    "VectorGRU",
    "VectorPlanner",
    "VectorPlans",
    "VectorPrior",
    "check_continuous_world",
    "check_vector_planner",
    "check_vector_prior",
    "coloured_noise",
    "control",
    "from_mujoco",
    "read_vector_plans",
    "vector_plans_from_trajectories",
    "write_vector_plans",
]
