"""Executed plans: the action sequences that were chosen before, from which a prior is learned; reading and writing."""

from neuroprior.plans.files import read_plans, write_plans
from neuroprior.plans.minari_datasets import read_minari, write_minari
from neuroprior.plans.plans import Plans, action_dtype, all_plans, check_context, sees_each_step
from neuroprior.plans.trajectories import from_trajectories, to_trajectories

__all__ = [
    "Plans",
    "action_dtype",
    "all_plans",
    "check_context",
    "from_trajectories",
    "read_minari",
    "read_plans",
    "sees_each_step",
    "to_trajectories",
    "write_minari",
    "write_plans",
]
