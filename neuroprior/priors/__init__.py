"""Priors: distributions over action sequences that samplers step through."""

from neuroprior.priors.counts.context_tree import ContextTreePrior, Leaf
from neuroprior.priors.counts.markov import MarkovPrior
from neuroprior.priors.ensembles.mixture import MixturePrior
from neuroprior.priors.ensembles.stacked import StackedPrior
from neuroprior.priors.macros.macro_prior import MacroPrior
from neuroprior.priors.macros.macros import Macro, learn_macros
from neuroprior.priors.neural.gru import GRUPrior
from neuroprior.priors.neural.transformer import TransformerPrior
from neuroprior.priors.prior import Prior
from neuroprior.priors.serialization import load, save
from neuroprior.priors.uniform import UniformPrior

__all__ = [
    "ContextTreePrior",
    "GRUPrior",
    "Leaf",
    "Macro",
    "MacroPrior",
    "MarkovPrior",
    "MixturePrior",
    "Prior",
    "StackedPrior",
    "TransformerPrior",
    "UniformPrior",
    "learn_macros",
    "load",
    "save",
]
