"""Reports: tables and figures of results, printed, written as CSV and JSON, and shown on one HTML page.

`report(plans)` makes the report on executed plans: which models predict them best, how far back they reach, what is
typical of them. Each of its figures is a function of its own, and `Document` and `publish` serve other reports.

Needs pandas, matplotlib, jinja2, joblib and rich (`pip install 'neuroprior[report]'`).
"""

from neuroprior.behaviour.reporting.document import Document, publish, table
from neuroprior.behaviour.reporting.figures import (
    condition_figure,
    drift_figure,
    dwell_figure,
    ethogram_figure,
    group_transition_figure,
    lag_figure,
    motif_figure,
    occupancy_figure,
    score_figure,
    transition_figure,
)
from neuroprior.behaviour.reporting.individuals import budget_strips, dendrogram_figure, plane_figure
from neuroprior.behaviour.reporting.options import FitOptions, ReadOptions
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table
from neuroprior.behaviour.reporting.plan_report import report
from neuroprior.behaviour.reporting.recordings import budget_figure, course_figure
from neuroprior.behaviour.reporting.survival import survival_figure
from neuroprior.behaviour.reporting.transitions import transition_graph_figure

__all__ = [
    "Document",
    "FigureBox",
    "FitOptions",
    "ReadOptions",
    "Section",
    "Table",
    "budget_figure",
    "budget_strips",
    "condition_figure",
    "course_figure",
    "dendrogram_figure",
    "drift_figure",
    "dwell_figure",
    "ethogram_figure",
    "group_transition_figure",
    "lag_figure",
    "motif_figure",
    "occupancy_figure",
    "plane_figure",
    "publish",
    "report",
    "score_figure",
    "survival_figure",
    "table",
    "transition_figure",
    "transition_graph_figure",
]
