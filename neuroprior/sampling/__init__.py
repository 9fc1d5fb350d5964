"""Sampling: plans from any prior, one by one or by prefix tree, blindly or in a world."""

from neuroprior.sampling.ancestral import sample, sample_in_world
from neuroprior.sampling.states import map_state, select_rows
from neuroprior.sampling.stepping import Steppable, Stepper

__all__ = [
    "Steppable",
    "Stepper",
    "map_state",
    "sample",
    "sample_in_world",
    "select_rows",
]
