"""Training of priors with Lightning: settings, data, module, and one trainer for `fit` and the command line."""

from neuroprior.training.batches import Batch, PlansModule
from neuroprior.training.module import PriorModule, bits
from neuroprior.training.settings import Settings
from neuroprior.training.trainer import planned_steps, train

__all__ = ["Batch", "PlansModule", "PriorModule", "Settings", "bits", "planned_steps", "train"]
