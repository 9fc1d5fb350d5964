"""Priors of boards: of their patterns (log-linear weights, smoothed counts, a network), and of the board itself."""

from neuroprior.priors.patterns.board import BoardNetwork
from neuroprior.priors.patterns.counts import PatternCounts
from neuroprior.priors.patterns.log_linear import LogLinearPrior, PatternNetwork
from neuroprior.priors.patterns.pattern_prior import PatternPrior, Steps

__all__ = ["BoardNetwork", "LogLinearPrior", "PatternCounts", "PatternNetwork", "PatternPrior", "Steps"]
