"""Wing 1: recorded behaviour: recordings, durations, statistics of sequences, tests, the report.

The report's figures are in `neuroprior.behaviour.reporting`; intervals and tests in `neuroprior._statistics`. A room is
imported when one of its names is first used: `read` and `Recordings` need no torch, which takes seconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuroprior._statistics import (
        Difference,
        Interval,
        holm,
        mean_interval,
        paired_difference,
        ratio_difference,
        share_interval,
    )
    from neuroprior.behaviour.analysis.comparison import (
        Baseline,
        Score,
        action_bits,
        baselines,
        score,
        score_bits,
        unit_name,
        units,
    )
    from neuroprior.behaviour.analysis.conditions import (
        ConditionComparison,
        ConditionFamily,
        ConditionPrediction,
        compare_conditions,
    )
    from neuroprior.behaviour.analysis.drift import (
        GroupDrift,
        PlanDrift,
        PositionDrift,
        by_group,
        by_plan,
        by_position,
    )
    from neuroprior.behaviour.analysis.individuality import Individuality, individuality
    from neuroprior.behaviour.analysis.individuals import Individuals, Types, individual_types, individuals
    from neuroprior.behaviour.analysis.interaction import ConditionInteraction, InteractionFamily
    from neuroprior.behaviour.analysis.lags import HowFarBack, how_far_back
    from neuroprior.behaviour.analysis.modes import ModeChoice, choose_modes, mode_frame, mode_plans, mode_table
    from neuroprior.behaviour.analysis.motifs import Motif, motifs
    from neuroprior.behaviour.analysis.permutation_design import PermutationDesign
    from neuroprior.behaviour.analysis.rate_drift import RateDrift, rate_drift
    from neuroprior.behaviour.analysis.transitions import Transitions, transitions
    from neuroprior.behaviour.durations.duration_model import DurationLaw, DurationModel
    from neuroprior.behaviour.durations.laws import LAW_NAMES, LawName
    from neuroprior.behaviour.durations.past_durations import PastDurations
    from neuroprior.behaviour.durations.semi_markov import SemiMarkovPrior
    from neuroprior.behaviour.durations.survival import DurationSurvival, duration_survival
    from neuroprior.behaviour.reading import Columns, Options, ReadingError, read
    from neuroprior.behaviour.recorded_plans import RecordedPlans
    from neuroprior.behaviour.recordings import Recordings
    from neuroprior.behaviour.reporting import FitOptions, ReadOptions, report
    from neuroprior.behaviour.study import large_study, simulated_study

__all__ = [
    "Baseline",
    "Columns",
    "ConditionComparison",
    "ConditionFamily",
    "ConditionInteraction",
    "ConditionPrediction",
    "Difference",
    "DurationLaw",
    "DurationModel",
    "DurationSurvival",
    "FitOptions",
    "GroupDrift",
    "HowFarBack",
    "Individuality",
    "Individuals",
    "InteractionFamily",
    "Interval",
    "LAW_NAMES",
    "LawName",
    "ModeChoice",
    "Motif",
    "Options",
    "PastDurations",
    "PermutationDesign",
    "PlanDrift",
    "PositionDrift",
    "RateDrift",
    "ReadOptions",
    "ReadingError",
    "RecordedPlans",
    "Recordings",
    "Score",
    "SemiMarkovPrior",
    "Transitions",
    "Types",
    "action_bits",
    "baselines",
    "by_group",
    "by_plan",
    "by_position",
    "choose_modes",
    "compare_conditions",
    "duration_survival",
    "holm",
    "how_far_back",
    "individual_types",
    "individuality",
    "individuals",
    "large_study",
    "mean_interval",
    "mode_frame",
    "mode_plans",
    "mode_table",
    "motifs",
    "paired_difference",
    "rate_drift",
    "ratio_difference",
    "read",
    "report",
    "score",
    "score_bits",
    "share_interval",
    "simulated_study",
    "transitions",
    "unit_name",
    "units",
]

_ROOMS = (
    "neuroprior.behaviour.reading",
    "neuroprior.behaviour.recordings",
    "neuroprior._statistics",
    "neuroprior.behaviour.analysis.comparison",
    "neuroprior.behaviour.analysis.conditions",
    "neuroprior.behaviour.analysis.drift",
    "neuroprior.behaviour.analysis.individuals",
    "neuroprior.behaviour.analysis.interaction",
    "neuroprior.behaviour.analysis.individuality",
    "neuroprior.behaviour.analysis.lags",
    "neuroprior.behaviour.analysis.modes",
    "neuroprior.behaviour.analysis.motifs",
    "neuroprior.behaviour.analysis.permutation_design",
    "neuroprior.behaviour.analysis.rate_drift",
    "neuroprior.behaviour.analysis.transitions",
    "neuroprior.behaviour.durations.duration_model",
    "neuroprior.behaviour.durations.laws",
    "neuroprior.behaviour.durations.past_durations",
    "neuroprior.behaviour.durations.semi_markov",
    "neuroprior.behaviour.durations.survival",
    "neuroprior.behaviour.recorded_plans",
    "neuroprior.behaviour.study",
    "neuroprior.behaviour.reporting",
)
"""Where the names above are: first those that need no torch."""

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name in __all__:
            for room in map(import_module, _ROOMS):
                if name in vars(room):
                    globals()[name] = getattr(room, name)
                    return globals()[name]
        raise AttributeError(f"module 'neuroprior.behaviour' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
