"""Priors: distributions over action sequences, learned from plans, that samplers step through."""

from neuroprior.priors.counts import ContextTreePrior, Leaf, MarkovPrior
from neuroprior.priors.durations import DurationLaw, DurationModel, SemiMarkovPrior
from neuroprior.priors.ensembles import CombinedPrior, MixturePrior, StackedPrior
from neuroprior.priors.estimator import PriorEstimator
from neuroprior.priors.fitting import fit
from neuroprior.priors.macros import Macro, MacroPrior, learn_macros
from neuroprior.priors.matching import decode, match_plans
from neuroprior.priors.neural import GRUPrior, TransformerPrior
from neuroprior.priors.patterns import BoardNetwork, LogLinearPrior, PatternCounts, PatternNetwork, PatternPrior
from neuroprior.priors.prior import Prior
from neuroprior.priors.serialization import load, save
from neuroprior.priors.switching import ModePosterior, SwitchingNetwork, SwitchingPrior
from neuroprior.priors.uniform import UniformPrior
from neuroprior.priors.vectors import (
    AutoregressivePrior,
    DiscretisedPrior,
    GaussianForecast,
    NoisePrior,
    StepSynergies,
    StoredWindows,
    VectorGRU,
    VectorPrior,
    VectorTransformer,
    WindowSynergies,
)

__all__ = [
    "AutoregressivePrior",
    "BoardNetwork",
    "CombinedPrior",
    "ContextTreePrior",
    "DiscretisedPrior",
    "DurationLaw",
    "DurationModel",
    "GRUPrior",
    "GaussianForecast",
    "Leaf",
    "LogLinearPrior",
    "Macro",
    "MacroPrior",
    "MarkovPrior",
    "MixturePrior",
    "ModePosterior",
    "NoisePrior",
    "PatternCounts",
    "PatternNetwork",
    "PatternPrior",
    "Prior",
    "PriorEstimator",
    "SemiMarkovPrior",
    "StackedPrior",
    "StepSynergies",
    "StoredWindows",
    "SwitchingNetwork",
    "SwitchingPrior",
    "TransformerPrior",
    "UniformPrior",
    "VectorGRU",
    "VectorPrior",
    "VectorTransformer",
    "WindowSynergies",
    "decode",
    "fit",
    "learn_macros",
    "load",
    "match_plans",
    "save",
]
