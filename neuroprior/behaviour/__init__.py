"""Wing 1: recorded behaviour: tables of events, durations, statistics of sequences, tests, the report.

The report is in `neuroprior.behaviour.report`; intervals and tests in `neuroprior._statistics`.
"""

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
    ActionDrift,
    GroupDrift,
    PlanDrift,
    PositionDrift,
    action_drift,
    by_group,
    by_plan,
    by_position,
)
from neuroprior.behaviour.analysis.lags import LagInformation, mutual_information
from neuroprior.behaviour.analysis.modes import (
    ModeChoice,
    choose_modes,
    mode_frame,
    mode_plans,
    mode_table,
)
from neuroprior.behaviour.analysis.motifs import Motif, motifs
from neuroprior.behaviour.analysis.permutation_design import PermutationDesign
from neuroprior.behaviour.analysis.transitions import Transitions, transitions
from neuroprior.behaviour.durations.duration_model import DurationLaw, DurationModel
from neuroprior.behaviour.durations.laws import LAW_NAMES, LawName
from neuroprior.behaviour.durations.past_durations import PastDurations
from neuroprior.behaviour.durations.semi_markov import SemiMarkovPrior
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.study import simulated_study
from neuroprior.priors.fitting import PRIORS

PRIORS.add("semi-markov", SemiMarkovPrior)

__all__ = [
    "ActionDrift",
    "Baseline",
    "ConditionComparison",
    "ConditionFamily",
    "ConditionPrediction",
    "Difference",
    "DurationLaw",
    "DurationModel",
    "GroupDrift",
    "Interval",
    "LAW_NAMES",
    "LagInformation",
    "LawName",
    "ModeChoice",
    "Motif",
    "PastDurations",
    "PermutationDesign",
    "PlanDrift",
    "PositionDrift",
    "RecordedPlans",
    "Score",
    "SemiMarkovPrior",
    "Transitions",
    "action_bits",
    "action_drift",
    "baselines",
    "by_group",
    "by_plan",
    "by_position",
    "choose_modes",
    "compare_conditions",
    "holm",
    "mean_interval",
    "mode_frame",
    "mode_plans",
    "mode_table",
    "motifs",
    "mutual_information",
    "paired_difference",
    "ratio_difference",
    "score",
    "score_bits",
    "share_interval",
    "simulated_study",
    "transitions",
    "unit_name",
    "units",
]
