"""neuroprior: behavioural priors, learned from executed plans, that sample better candidate plans for a planner."""

from neuroprior.planners import Decision, ExhaustivePlanner, Planner, SamplingPlanner, collect, expected_score, oracle
from neuroprior.plans import Plans, read_plans, write_plans
from neuroprior.priors import (
    ContextTreePrior,
    GRUPrior,
    MarkovPrior,
    MixturePrior,
    Prior,
    StackedPrior,
    TransformerPrior,
    UniformPrior,
    load,
    save,
)
from neuroprior.sampling import sample, sample_in_world
from neuroprior.worlds import (
    EpisodicWorld,
    GridWorld,
    PocketCube,
    Rollout,
    SteppedWorld,
    TabularWorld,
    World,
    cube,
    from_gymnasium,
    gridworld,
    labyrinth,
)

__version__ = "0.1.0"

__all__ = [
    "ContextTreePrior",
    "Decision",
    "EpisodicWorld",
    "ExhaustivePlanner",
    "GRUPrior",
    "GridWorld",
    "MarkovPrior",
    "MixturePrior",
    "Planner",
    "Plans",
    "PocketCube",
    "Prior",
    "Rollout",
    "SamplingPlanner",
    "StackedPrior",
    "SteppedWorld",
    "TabularWorld",
    "TransformerPrior",
    "UniformPrior",
    "World",
    "collect",
    "cube",
    "from_gymnasium",
    "gridworld",
    "labyrinth",
    "load",
    "maze",
    "oracle",
    "read_plans",
    "sample",
    "sample_in_world",
    "save",
    "write_plans",
]
