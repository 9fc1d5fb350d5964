"""Macro-actions, and a prior over actions and macro-actions."""

from neuroprior.priors.macros.macro_prior import MacroPrior
from neuroprior.priors.macros.macros import CRITERIA, Criterion, Macro, learn_macros

__all__ = ["CRITERIA", "Criterion", "Macro", "MacroPrior", "learn_macros"]
