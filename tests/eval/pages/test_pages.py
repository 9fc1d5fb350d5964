"""`python -m eval pages`: the commands are those of the pages; what is done is not done again."""

import re
from pathlib import Path

import pytest

from eval.__main__ import main
from eval.pages.command import DOCS, HOURS, commands, is_done, numbered, perform
from tests.support.sources import refuses


def test_every_page_of_results_is_a_stage() -> None:
    results = (DOCS / "results.md").read_text(encoding="utf-8")
    (listed,) = re.findall(r":hidden:\n\n(.*?)```", results, re.DOTALL)
    assert set(HOURS) == set(listed.split())
    assert dict(re.findall(r"^\| ([\w-]+) \| (.*) \|$", results, re.MULTILINE)).items() >= HOURS.items()
    assert all(commands(DOCS / f"{name}.md") for name in HOURS)


def test_listing_runs_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["pages", "--stages", "mice", "--listing", "true", "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert f"mice-2: python -m eval mice --out {tmp_path / 'out/mice-2'}" in said
    assert not (tmp_path / "out").exists()
    assert main(["pages", "--stages", "mouse"]) == 2


def test_commands_of_a_page(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "```console\nmake x\npython -m eval paper \\\n    --worlds 2 --out a  # slow\n```\nneuroprior fit y\n"
    )
    found = commands(page)
    assert found == [["python", "-m", "eval", "paper", "--worlds", "2", "--out", "a"]]
    steps = numbered("page", found, tmp_path)
    assert steps == {"page-1": ["python", "-m", "eval", "paper", "--worlds", "2", "--out", str(tmp_path / "page-1")]}


def test_done_is_not_done_again(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    count = f"from pathlib import Path; p = Path({str(tmp_path / 'count')!r}); p.open('a').write('x'); print('made')"
    steps = {"first": ["python", "-c", count], "second": ["python", "-c", "import sys; sys.exit(3)"]}
    with refuses("second", "ended with 3"):
        perform(steps, tmp_path)
    assert "made" in capfd.readouterr().out
    text = (tmp_path / "first.txt").read_text()
    assert "made" in text.splitlines()
    assert re.search(r"took \d+ s\n$", text)
    assert not (tmp_path / "second.txt").exists()
    steps["second"] = ["python", "-c", "print('mended')"]
    perform(steps, tmp_path)
    assert (tmp_path / "count").read_text() == "x"
    assert is_done(tmp_path / "second.txt", steps["second"])
    assert not is_done(tmp_path / "first.txt", ["python", "-c", "another"])
