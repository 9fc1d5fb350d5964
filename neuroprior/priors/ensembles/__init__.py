"""Priors made of priors: a mixture, and experts that a network combines."""

from neuroprior.priors.ensembles.mixture import MixturePrior
from neuroprior.priors.ensembles.stacked import StackedPrior

__all__ = ["MixturePrior", "StackedPrior"]
