"""Comparisons of priors and planners in one world, with intervals and tests: does a prior help here?"""

from neuroprior.comparison.experiment import compare
from neuroprior.comparison.results import Comparison, Row

__all__ = ["Comparison", "Row", "compare"]
