"""Training of priors with Lightning: settings, modules and `train`; knows a prior only by how it reads plans."""

from neuroprior.training.batches import Batch, PlansModule
from neuroprior.training.fitting import few_threads, quiet, train
from neuroprior.training.module import PriorModule, bits
from neuroprior.training.settings import Settings

__all__ = ["Batch", "PlansModule", "PriorModule", "Settings", "bits", "few_threads", "quiet", "train"]
