"""Executed plans: the action sequences that were chosen before, from which a prior learns; reading, writing, folds."""

from neuroprior.plans.folds import BLOCKS, FEWEST_UNITS, divisible, folds, in_parts
from neuroprior.plans.io import (
    from_trajectories,
    read_minari,
    read_plans,
    to_trajectories,
    write_minari,
    write_plans,
)
from neuroprior.plans.plans import (
    Plans,
    action_dtype,
    all_plans,
    check_context,
    check_patterns,
    has_patterns,
)
from neuroprior.plans.sequences import constant_context, expand_context

__all__ = [
    "BLOCKS",
    "FEWEST_UNITS",
    "Plans",
    "action_dtype",
    "all_plans",
    "check_context",
    "check_patterns",
    "constant_context",
    "divisible",
    "expand_context",
    "folds",
    "from_trajectories",
    "in_parts",
    "has_patterns",
    "read_minari",
    "read_plans",
    "to_trajectories",
    "write_minari",
    "write_plans",
]
