"""Priors that count: Markov chains with back-off, and context trees."""

from neuroprior.priors.counts.context_tree import ContextTreePrior, Leaf
from neuroprior.priors.counts.histories import TooLargeError
from neuroprior.priors.counts.history_prior import HistoryPrior
from neuroprior.priors.counts.markov import BACKOFFS, BACKOFFS_TRIED, Backoff, Chains, MarkovPrior

__all__ = [
    "BACKOFFS",
    "BACKOFFS_TRIED",
    "Backoff",
    "Chains",
    "ContextTreePrior",
    "HistoryPrior",
    "Leaf",
    "MarkovPrior",
    "TooLargeError",
]
