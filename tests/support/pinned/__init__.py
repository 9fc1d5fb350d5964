"""The cases of `tests.support.unchanged`."""

# ruff: noqa: F401
import tests.support.pinned.analysis
import tests.support.pinned.experiments
import tests.support.pinned.planners
import tests.support.pinned.priors
