"""The worked page on one's own data: its example writes the table, and the report finds what was put into it."""

import csv
import json
import re
import runpy
from pathlib import Path

import pytest

from eval.__main__ import main

PAGE = Path(__file__).parents[2] / "docs" / "your-own-data.md"


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("docs")
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (folder / "example.py").write_text(example, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        runpy.run_path("example.py")
        arguments = ["plans", "behaviour.csv", "--models", "counts", "--max-steps", "10", "--processes", "1"]
        assert main([*arguments, "--out", "report"]) == 0
    return folder / "report"


def rows(folder: Path, name: str) -> list[dict[str, str]]:
    with open(folder / f"{name}.csv", newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_order_that_was_put_in(report):
    scores = json.loads((report / "results.json").read_text())["rows"]
    chains = {row["model"]: row["bits_per_action"] for row in scores if row["model"].startswith("markov")}
    assert min(chains, key=chains.get) == "markov-2"


def test_the_sequence_that_was_put_in(report):
    first = rows(report, "motifs")[0]
    assert first["sequence"] == "sniff rear groom"
    assert float(first["low"]) > 1


def test_the_difference_that_was_put_in(report):
    """Only what follows walking differs between animals."""
    marked = [row for row in rows(report, "transitions") if row["p_value"] and float(row["p_value"]) < 0.05]
    assert marked
    assert {row["from"] for row in marked} == {"walk"}
