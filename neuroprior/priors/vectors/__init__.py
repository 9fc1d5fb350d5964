"""Priors over vectors in time: distributions over sequences of numbers between bounds, for continuous actions."""

from neuroprior.priors.vectors.autoregressive import AutoregressivePrior
from neuroprior.priors.vectors.discretised import DiscretisedPrior
from neuroprior.priors.vectors.networks import VectorGRU, VectorTransformer
from neuroprior.priors.vectors.noise import NoisePrior
from neuroprior.priors.vectors.stored_windows import StoredWindows
from neuroprior.priors.vectors.synergies import StepSynergies, WindowSynergies
from neuroprior.priors.vectors.vector_prior import Forecast, GaussianForecast, VectorPrior

__all__ = [
    "AutoregressivePrior",
    "DiscretisedPrior",
    "Forecast",
    "GaussianForecast",
    "NoisePrior",
    "StepSynergies",
    "StoredWindows",
    "VectorGRU",
    "VectorPrior",
    "VectorTransformer",
    "WindowSynergies",
]
