"""neuroprior: behavioural priors, learned from executed plans, that sample better candidate plans for a planner.

Here are the names that most programs need. The others of the core are in its rooms: `neuroprior.plans`,
`neuroprior.priors`, `neuroprior.sampling`, `neuroprior.worlds`, `neuroprior.planners`, `neuroprior.comparison`,
`neuroprior.training`, `neuroprior.agents` and `neuroprior.testing`. Each wing exports its own: `neuroprior.behaviour`
(recorded behaviour), `neuroprior.control` (actions that are vectors) and `neuroprior.puzzles` (search with a
guarantee). A room is imported when one of its names is first used: torch, which all need, takes seconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from neuroprior._version import __version__

if TYPE_CHECKING:
    from neuroprior.comparison import compare
    from neuroprior.planners import (
        ExhaustivePlanner,
        FrontierPlanner,
        MCTSPlanner,
        Planner,
        SamplingPlanner,
        collect,
        oracle,
    )
    from neuroprior.plans import Plans, read_plans, write_plans
    from neuroprior.priors import (
        CombinedPrior,
        ContextTreePrior,
        GRUPrior,
        MarkovPrior,
        Prior,
        TransformerPrior,
        UniformPrior,
        fit,
        load,
        save,
    )
    from neuroprior.sampling import sample
    from neuroprior.worlds import TabularWorld, World, from_gymnasium, from_simulator, gridworld

__all__ = [
    "CombinedPrior",
    "ContextTreePrior",
    "ExhaustivePlanner",
    "FrontierPlanner",
    "GRUPrior",
    "MCTSPlanner",
    "MarkovPrior",
    "Planner",
    "Plans",
    "Prior",
    "SamplingPlanner",
    "TabularWorld",
    "TransformerPrior",
    "UniformPrior",
    "World",
    "__version__",
    "collect",
    "compare",
    "fit",
    "from_gymnasium",
    "from_simulator",
    "gridworld",
    "load",
    "oracle",
    "read_plans",
    "sample",
    "save",
    "write_plans",
]

_ROOMS = ("plans", "worlds", "sampling", "priors", "planners", "comparison")
"""Where the names above are: those that import the fewest others first."""

_OTHER_ROOMS = ("agents", "behaviour", "control", "puzzles", "testing", "training")

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name in (*_ROOMS, *_OTHER_ROOMS):
            return import_module(f"neuroprior.{name}")
        if name in __all__:
            for room in map(import_module, (f"neuroprior.{room}" for room in _ROOMS)):
                if name in getattr(room, "__all__", vars(room)):
                    globals()[name] = getattr(room, name)
                    return globals()[name]
        raise AttributeError(f"module 'neuroprior' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_ROOMS, *_OTHER_ROOMS})
