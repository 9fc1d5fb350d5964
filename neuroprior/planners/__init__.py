"""Planners: they choose, for each start, a plan with a high score."""

from neuroprior.planners.collect import collect
from neuroprior.planners.cross_entropy import CrossEntropyPlanner
from neuroprior.planners.distinct import DistinctPlanner
from neuroprior.planners.execution import Execution, execute
from neuroprior.planners.exhaustive import ExhaustivePlanner
from neuroprior.planners.expected import expected_score
from neuroprior.planners.foraging import ForagingOracle
from neuroprior.planners.frontier import FrontierPlanner
from neuroprior.planners.horizon import HorizonPlanner
from neuroprior.planners.horizon_curriculum import HorizonRound, extend_horizon
from neuroprior.planners.mcts import MCTSPlanner
from neuroprior.planners.oracle import oracle
from neuroprior.planners.planner import Decision, Planner
from neuroprior.planners.sampling import SamplingPlanner

__all__ = [
    "CrossEntropyPlanner",
    "Decision",
    "DistinctPlanner",
    "Execution",
    "ExhaustivePlanner",
    "ForagingOracle",
    "FrontierPlanner",
    "HorizonRound",
    "HorizonPlanner",
    "MCTSPlanner",
    "Planner",
    "SamplingPlanner",
    "collect",
    "execute",
    "expected_score",
    "extend_horizon",
    "oracle",
]
