"""Executed plans: the action sequences that were chosen before, from which a prior is learned; reading and writing."""

from neuroprior.plans.io.files import read_plans, write_plans
from neuroprior.plans.io.minari_datasets import read_minari, write_minari
from neuroprior.plans.io.trajectories import from_trajectories, to_trajectories
from neuroprior.plans.plans import Plans, action_dtype, all_plans, check_context, is_per_step

__all__ = [
    "Plans",
    "action_dtype",
    "all_plans",
    "check_context",
    "from_trajectories",
    "read_minari",
    "read_plans",
    "is_per_step",
    "to_trajectories",
    "write_minari",
    "write_plans",
]
