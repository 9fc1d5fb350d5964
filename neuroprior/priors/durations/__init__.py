"""Priors with durations: how long actions take, and a semi-Markov prior made of any prior and these."""

from neuroprior.priors.durations.duration_model import DurationLaw, DurationModel
from neuroprior.priors.durations.laws import LAW_NAMES, LawName
from neuroprior.priors.durations.semi_markov import SemiMarkovPrior

__all__ = ["LAW_NAMES", "DurationLaw", "DurationModel", "LawName", "SemiMarkovPrior"]
