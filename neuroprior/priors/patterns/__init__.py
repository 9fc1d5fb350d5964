"""Priors that see patterns: the active patterns of a state, several indices at once."""

from neuroprior.priors.patterns.log_linear import LogLinearPrior

__all__ = ["LogLinearPrior"]
