"""Sampling: plans from any prior, one by one or by prefix tree, blindly or in a world, with or without replacement."""

from neuroprior.sampling.ancestral import sample, sample_in_world
from neuroprior.sampling.distinct import Distinct, most_probable, sample_distinct, sample_distinct_in_world
from neuroprior.sampling.stepping import Steppable, Stepper

__all__ = [
    "Distinct",
    "Steppable",
    "Stepper",
    "most_probable",
    "sample",
    "sample_distinct",
    "sample_distinct_in_world",
    "sample_in_world",
]
