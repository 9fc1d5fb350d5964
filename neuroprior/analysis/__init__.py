"""Statistics of executed plans: how actions follow each other, how far back that reaches, what changes it.

Priors are compared in `neuroprior.analysis.comparison`, intervals and tests are in `neuroprior.analysis.statistics`.
"""

from neuroprior.analysis.calibration import Reliability, reliability
from neuroprior.analysis.comparison import Baseline, Score, action_bits, baselines, score, score_bits, unit_name, units
from neuroprior.analysis.conditions import (
    ConditionComparison,
    ConditionFamily,
    ConditionPrediction,
    compare_conditions,
)
from neuroprior.analysis.drift import (
    ActionDrift,
    GroupDrift,
    PlanDrift,
    PositionDrift,
    action_drift,
    by_group,
    by_plan,
    by_position,
)
from neuroprior.analysis.intentions import Posterior, forecast, infer
from neuroprior.analysis.lags import LagInformation, bits_by_position, mutual_information, pieces
from neuroprior.analysis.modes import (
    ModeChoice,
    choose_modes,
    match_modes,
    mode_frame,
    mode_plans,
    mode_table,
    mode_transitions,
)
from neuroprior.analysis.motifs import Motif, motifs
from neuroprior.analysis.orders import OrderFit, order_selection
from neuroprior.analysis.permutation_design import PermutationDesign
from neuroprior.analysis.statistics import (
    Difference,
    Interval,
    best_of,
    holm,
    interquartile_gap,
    interquartile_mean,
    mean_interval,
    mean_intervals,
    paired_difference,
    probability_of_improvement,
    ratio_difference,
    share_interval,
)
from neuroprior.analysis.transitions import Transitions, transitions
from neuroprior.analysis.two_sample import TwoSampleTest, two_sample_tests

__all__ = [
    "ActionDrift",
    "Baseline",
    "ConditionComparison",
    "ConditionFamily",
    "ConditionPrediction",
    "Difference",
    "GroupDrift",
    "Interval",
    "LagInformation",
    "ModeChoice",
    "Motif",
    "OrderFit",
    "PermutationDesign",
    "PlanDrift",
    "PositionDrift",
    "Posterior",
    "Reliability",
    "Score",
    "Transitions",
    "TwoSampleTest",
    "action_bits",
    "action_drift",
    "baselines",
    "best_of",
    "bits_by_position",
    "by_group",
    "by_plan",
    "by_position",
    "compare_conditions",
    "forecast",
    "holm",
    "infer",
    "interquartile_gap",
    "interquartile_mean",
    "choose_modes",
    "match_modes",
    "mean_interval",
    "mode_frame",
    "mode_plans",
    "mode_table",
    "mode_transitions",
    "mean_intervals",
    "motifs",
    "mutual_information",
    "order_selection",
    "paired_difference",
    "pieces",
    "probability_of_improvement",
    "ratio_difference",
    "reliability",
    "score",
    "score_bits",
    "share_interval",
    "transitions",
    "two_sample_tests",
    "unit_name",
    "units",
]
