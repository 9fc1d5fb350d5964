"""Executed plans: the action sequences that were chosen before, from which a prior is learned; reading and writing."""

from neuroprior.plans.plans import Plans, action_dtype, all_plans, check_context, sees_each_step

__all__ = ["Plans", "action_dtype", "all_plans", "check_context", "sees_each_step"]
