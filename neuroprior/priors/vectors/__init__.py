"""Priors over vectors in time: distributions over sequences of numbers between bounds, for continuous actions."""

from neuroprior.priors.vectors.discretised import DiscretisedForecast, DiscretisedPrior
from neuroprior.priors.vectors.networks import VectorGRU, VectorTransformer
from neuroprior.priors.vectors.vector_prior import Forecast, GaussianForecast, VectorPrior

__all__ = [
    "DiscretisedForecast",
    "DiscretisedPrior",
    "Forecast",
    "GaussianForecast",
    "VectorGRU",
    "VectorPrior",
    "VectorTransformer",
]
