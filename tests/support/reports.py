"""Reports that `python -m eval plans` writes, for tests: run quickly, read back, and checked for what all have."""

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest

from eval.__main__ import main
from neuroprior import Plans
from neuroprior.plans import write_plans
from neuroprior.report import page

QUICK = ("--models", "counts", "--max-steps", "3", "--processes", "1")


FROM_ELSEWHERE = r"<(script|img|iframe)|<link (?!rel=.icon. href=.data:,.)|(src|href)=.?(https?:)?//|url\(.?http"
"""What a page that stands alone does not have."""


def report(plans: Plans, folder: Path, *more: str, name: str = "new.npz", drawn: bool = False) -> dict[str, Any]:
    """What `results.json` says; every report must have the same shape. Figures take most of the time."""
    write_plans(plans, folder / name)
    out = folder / "out"
    with pytest.MonkeyPatch.context() as patch:
        for module in (page,) * (not drawn):
            patch.setattr(module, "svg", lambda figure: "<svg></svg>")
        assert main(["plans", str(folder / name), "--out", str(out), *QUICK, *more]) == 0
    results = json.loads((out / "results.json").read_text())
    for row in results["rows"]:
        assert row["nats_per_action"] == pytest.approx(row["bits_per_action"] * math.log(2))
        assert row["perplexity"] == pytest.approx(2 ** row["bits_per_action"])
        assert row["low"] <= row["bits_per_action"] <= row["high"]
        assert row["sees"] in ("actions", "actions and context")
    assert min(row["more"] for row in results["rows"]) == 0
    html = (out / "report.html").read_text()
    assert not re.search(FROM_ELSEWHERE, html)
    return results


def bits(results: dict[str, Any], sees: str = "actions") -> dict[str, float]:
    return {row["model"]: row["bits_per_action"] for row in results["rows"] if row["sees"] == sees}


def fails(arguments: list[str], capsys: Any, *words: str) -> None:
    """One line that has the words, and exit code 2."""
    assert main(["plans", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert len(said) < 400
    assert all(word in said for word in words), said
