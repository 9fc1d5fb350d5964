"""Priors that count: Markov chains with back-off, and context trees."""

from neuroprior.priors.counts.context_tree import ContextTreePrior, Leaf
from neuroprior.priors.counts.histories import TooLargeError
from neuroprior.priors.counts.history_prior import HistoryPrior
from neuroprior.priors.counts.markov import BACKOFFS, BACKOFFS_TRIED, Backoff, MarkovPrior, chains

__all__ = [
    "BACKOFFS",
    "BACKOFFS_TRIED",
    "Backoff",
    "ContextTreePrior",
    "HistoryPrior",
    "Leaf",
    "MarkovPrior",
    "TooLargeError",
    "chains",
]
