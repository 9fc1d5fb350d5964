"""Planners: they choose, for each start, a plan with a high score; executing, collecting and scoring plans."""

from neuroprior.planners.cross_entropy import CrossEntropyPlanner
from neuroprior.planners.distinct import DistinctPlanner
from neuroprior.planners.exact import expected_score, oracle
from neuroprior.planners.execution import Execution, collect, execute
from neuroprior.planners.exhaustive import ExhaustivePlanner
from neuroprior.planners.foraging import ForagingOracle
from neuroprior.planners.frontier import FrontierPlanner
from neuroprior.planners.horizon import HorizonPlanner
from neuroprior.planners.horizon_curriculum import HorizonRound, extend_horizon
from neuroprior.planners.mcts import MCTSPlanner
from neuroprior.planners.options import OptionPlanner
from neuroprior.planners.planner import Decision, Planner, PriorPlanner, random_best
from neuroprior.planners.rollouts import mean_scores
from neuroprior.planners.sampling import SamplingPlanner
from neuroprior.planners.tuning import Tuned, best_sampling, proposers, sampling_for, search_weights

__all__ = [
    "CrossEntropyPlanner",
    "Decision",
    "DistinctPlanner",
    "Execution",
    "ExhaustivePlanner",
    "ForagingOracle",
    "FrontierPlanner",
    "HorizonPlanner",
    "HorizonRound",
    "MCTSPlanner",
    "OptionPlanner",
    "Planner",
    "PriorPlanner",
    "SamplingPlanner",
    "Tuned",
    "best_sampling",
    "collect",
    "execute",
    "expected_score",
    "extend_horizon",
    "mean_scores",
    "oracle",
    "proposers",
    "random_best",
    "sampling_for",
    "search_weights",
]
