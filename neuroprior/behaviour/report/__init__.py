"""Reports: tables and figures of results, printed, written as CSV and JSON, and shown on one HTML page.

`report(plans)` makes the report on executed plans: which models predict them best, how far back they reach, what is
typical of them. Each of its figures is a function of its own, and `Document` and `publish` serve other reports.

Needs pandas, matplotlib, jinja2, joblib and rich (`pip install 'neuroprior[report]'`).
"""

from neuroprior.behaviour.report.document import Document, publish, table
from neuroprior.behaviour.report.figures import (
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
from neuroprior.behaviour.report.options import FitOptions, ReadOptions
from neuroprior.behaviour.report.page import FigureBox, Section, Table
from neuroprior.behaviour.report.plan_report import report

__all__ = [
    "Document",
    "FigureBox",
    "FitOptions",
    "ReadOptions",
    "Section",
    "Table",
    "condition_figure",
    "drift_figure",
    "dwell_figure",
    "ethogram_figure",
    "group_transition_figure",
    "lag_figure",
    "motif_figure",
    "occupancy_figure",
    "publish",
    "report",
    "score_figure",
    "table",
    "transition_figure",
]
