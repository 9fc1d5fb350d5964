"""Priors with hidden modes that persist and switch."""

from neuroprior.priors.switching.switching_prior import ModePosterior, SwitchingPrior

__all__ = ["ModePosterior", "SwitchingPrior"]
