"""Planners: they choose, for each start, a plan with a high score; executing, collecting and scoring plans."""

from neuroprior.planners.exact import expected_score, oracle, value_iteration
from neuroprior.planners.execution import Execution, collect, execute
from neuroprior.planners.exhaustive import ExhaustivePlanner
from neuroprior.planners.frontier import FrontierPlanner
from neuroprior.planners.horizon_curriculum import HorizonRound, extend_horizon
from neuroprior.planners.mcts import MCTSPlanner
from neuroprior.planners.planner import Candidates, Decision, Planner, PriorPlanner, random_best
from neuroprior.planners.rollouts import mean_scores
from neuroprior.planners.sampling import SamplingPlanner
from neuroprior.planners.sources import Sources
from neuroprior.planners.tuning import Tuned, best_sampling, proposers, search_weights

__all__ = [
    "Candidates",
    "Decision",
    "Execution",
    "ExhaustivePlanner",
    "FrontierPlanner",
    "HorizonRound",
    "MCTSPlanner",
    "Planner",
    "PriorPlanner",
    "SamplingPlanner",
    "Sources",
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
    "search_weights",
    "value_iteration",
]
