"""Extra report: a table of events, and the report on it."""

from pathlib import Path

from neuroprior.behaviour.report import FitOptions, report
from neuroprior.behaviour.study import simulated_study
from neuroprior.behaviour.tables import plans_of_frame

names = {"action": "behaviour", "plan": "session", "group": "animal"}
report(plans_of_frame(simulated_study(0), names), fits=FitOptions(["counts"], processes=1), out="report")
assert "<svg" in Path("report/report.html").read_text(encoding="utf-8")
