"""Priors that see patterns: the active patterns of a state, several indices at once; and the whole board."""

from neuroprior.priors.patterns.board import BoardNetwork
from neuroprior.priors.patterns.counts import PatternCounts
from neuroprior.priors.patterns.log_linear import LogLinearPrior
from neuroprior.priors.patterns.network import PatternNetwork
from neuroprior.priors.patterns.pattern_prior import PatternPrior

__all__ = ["BoardNetwork", "LogLinearPrior", "PatternCounts", "PatternNetwork", "PatternPrior"]
