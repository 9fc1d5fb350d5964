"""Conformance suites: what every prior, world and planner must do, to be run on your own as on the library's."""

from neuroprior.testing.planners import check_planner
from neuroprior.testing.priors import check_prior
from neuroprior.testing.rules import FALSE_ALARM
from neuroprior.testing.worlds import check_world

__all__ = ["FALSE_ALARM", "check_planner", "check_prior", "check_world"]
