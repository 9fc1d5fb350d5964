"""Reports on plans, for tests: made quickly, and checked for what all have in common."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from eval.__main__ import main
from neuroprior import Plans
from neuroprior.behaviour.reporting.document import results_of
from neuroprior.behaviour.reporting.options import FitOptions
from neuroprior.behaviour.reporting.plan_report import report as report_on
from neuroprior.plans import write_plans

QUICK = FitOptions(models=["counts"], max_steps=3, processes=1)

QUICK_IN_TWO = replace(QUICK, folds=2)

QUICKLY = ("--models", "counts", "--max-steps", "3", "--processes", "1")
"""The same as options of the command."""

FROM_ELSEWHERE = r"<(script|img|iframe)|<link (?!rel=.icon. href=.data:,.)|(src|href)=.?(https?:)?//|url\(.?http"
"""What a page that stands alone does not have."""


def report(plans: Plans, folder: Path, fits: FitOptions = QUICK_IN_TWO, **options: Any) -> dict[str, Any]:
    """What `results.json` of a report on a file of plans would hold; every report must have the same shape."""
    write_plans(plans, folder / "new.npz")
    results = json.loads(json.dumps(results_of(report_on(folder / "new.npz", fits=fits, **options))))
    for row in results["scores"]:
        assert row["nats_per_behaviour"] == pytest.approx(row["bits_per_behaviour"] * math.log(2))
        assert row["perplexity"] == pytest.approx(2 ** row["bits_per_behaviour"])
        assert row["low"] <= row["bits_per_behaviour"] <= row["high"]
        assert row["input"] in ("behaviours", "behaviours and context")
    assert min(row["more"] for row in results["scores"]) == 0
    return results


def bits(results: dict[str, Any], inputs: str = "behaviours") -> dict[str, float]:
    return {row["model"]: row["bits_per_behaviour"] for row in results["scores"] if row["input"] == inputs}


def fails(arguments: list[str], capsys: Any, *words: str) -> None:
    """One line that has the words, and exit code 2."""
    assert main(["plans", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert len(said) < 400
    assert all(word in said for word in words), said
