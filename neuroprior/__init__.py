"""neuroprior: behavioural priors, learned from executed plans, that sample better candidate plans for a planner.

Here are the names that most programs need; everything else is in its room: `neuroprior.worlds`, `neuroprior.sampling`,
`neuroprior.priors`, `neuroprior.planners`, `neuroprior.agents`, `neuroprior.analysis`, `neuroprior.report` and
`neuroprior.testing`.
"""

from neuroprior._interrupts import ending_at_interrupts
from neuroprior._version import __version__

with ending_at_interrupts():
    from neuroprior.planners import (
        ExhaustivePlanner,
        FrontierPlanner,
        MCTSPlanner,
        Planner,
        SamplingPlanner,
        collect,
        execute,
        oracle,
    )
    from neuroprior.plans import Plans, read_plans, write_plans
    from neuroprior.priors import (
        CombinedPrior,
        ContextTreePrior,
        GRUPrior,
        MacroPrior,
        MarkovPrior,
        MixturePrior,
        Prior,
        StackedPrior,
        TransformerPrior,
        UniformPrior,
        decode,
        fit,
        load,
        save,
    )
    from neuroprior.priors.scoring import score
    from neuroprior.sampling import sample
    from neuroprior.worlds import TabularWorld, World, from_gymnasium, gridworld

__all__ = [
    "CombinedPrior",
    "ContextTreePrior",
    "ExhaustivePlanner",
    "FrontierPlanner",
    "GRUPrior",
    "MCTSPlanner",
    "MacroPrior",
    "MarkovPrior",
    "MixturePrior",
    "Planner",
    "Plans",
    "Prior",
    "SamplingPlanner",
    "StackedPrior",
    "TabularWorld",
    "TransformerPrior",
    "UniformPrior",
    "World",
    "__version__",
    "collect",
    "decode",
    "execute",
    "fit",
    "from_gymnasium",
    "gridworld",
    "load",
    "oracle",
    "read_plans",
    "sample",
    "save",
    "score",
    "write_plans",
]
