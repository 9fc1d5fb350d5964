"""Priors made of priors: the combined prior, a mixture, and experts that a network combines."""

from neuroprior.priors.ensembles.combined import CombinedPrior
from neuroprior.priors.ensembles.mixture import MixturePrior
from neuroprior.priors.ensembles.stacked import StackedPrior

__all__ = ["CombinedPrior", "MixturePrior", "StackedPrior"]
