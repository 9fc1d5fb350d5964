"""Extra report: a table of events, and the report on it."""

from pathlib import Path

from neuroprior.behaviour import FitOptions, read, report, simulated_study

report(read(simulated_study(0)), fits=FitOptions(["counts"], processes=1), out="report")
assert "<svg" in Path("report/report.html").read_text(encoding="utf-8")
