"""Priors whose context is a set of patterns: log-linear weights, smoothed counts, a network on the same patterns."""

from neuroprior.priors.patterns.counts import PatternCounts
from neuroprior.priors.patterns.log_linear import LogLinearPrior, PatternNetwork
from neuroprior.priors.patterns.pattern_prior import PatternPrior, Steps

__all__ = ["LogLinearPrior", "PatternCounts", "PatternNetwork", "PatternPrior", "Steps"]
