"""Priors: distributions over action sequences that samplers step through."""

from neuroprior.priors.context_tree import ContextTreePrior, Leaf
from neuroprior.priors.folders import load, save
from neuroprior.priors.gru import GRUPrior
from neuroprior.priors.macro_prior import MacroPrior
from neuroprior.priors.macros import Macro, learn_macros
from neuroprior.priors.markov import MarkovPrior
from neuroprior.priors.mixture import MixturePrior
from neuroprior.priors.prior import Prior
from neuroprior.priors.stacked import StackedPrior
from neuroprior.priors.transformer import TransformerPrior
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
