"""Priors: distributions over action sequences, learned from plans, that samplers step through."""

from neuroprior.priors.adaptive import AdaptivePrior, adapt
from neuroprior.priors.counts import ContextTreePrior, Leaf, MarkovPrior
from neuroprior.priors.ensembles import CombinedPrior, MixturePrior, StackedPrior
from neuroprior.priors.fitting import fit
from neuroprior.priors.intentions import Posterior, infer
from neuroprior.priors.matching import decode, match_plans
from neuroprior.priors.neural import GRUPrior, TransformerPrior
from neuroprior.priors.prior import Prior
from neuroprior.priors.serialization import load, save
from neuroprior.priors.switching import ModePosterior, SwitchingPrior
from neuroprior.priors.uniform import UniformPrior

__all__ = [
    "Posterior",
    "infer",
    "AdaptivePrior",
    "CombinedPrior",
    "ContextTreePrior",
    "GRUPrior",
    "Leaf",
    "MarkovPrior",
    "MixturePrior",
    "ModePosterior",
    "Prior",
    "StackedPrior",
    "SwitchingPrior",
    "TransformerPrior",
    "UniformPrior",
    "adapt",
    "decode",
    "fit",
    "load",
    "match_plans",
    "save",
]
