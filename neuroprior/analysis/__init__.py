"""Statistics of executed plans: how actions follow each other, how far back that reaches, and where it changes."""

from neuroprior.analysis.calibration import Reliability, reliability
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
from neuroprior.analysis.lags import LagInformation, bits_by_position, mutual_information, pieces
from neuroprior.analysis.likeness import Likeness, likeness
from neuroprior.analysis.motifs import Motif, motifs
from neuroprior.analysis.orders import OrderFit, order_selection
from neuroprior.analysis.transitions import Transitions, transitions

__all__ = [
    "ActionDrift",
    "GroupDrift",
    "LagInformation",
    "Likeness",
    "Motif",
    "OrderFit",
    "PlanDrift",
    "PositionDrift",
    "Reliability",
    "Transitions",
    "action_drift",
    "bits_by_position",
    "by_group",
    "by_plan",
    "by_position",
    "likeness",
    "motifs",
    "mutual_information",
    "order_selection",
    "pieces",
    "reliability",
    "transitions",
]
