"""`python -m eval compare --world module:function`: a comparison in anybody's world, end to end."""

import json

import pytest

from eval.__main__ import main

MODULE = """
import torch
from neuroprior import TabularWorld

def make_world():
    ring = torch.stack([(torch.arange(40) - 1) % 40, (torch.arange(40) + 1) % 40], 1)
    return TabularWorld(ring, torch.arange(40) / 40)

def make_number():
    return 3
"""

QUICK = ["--num-plans", "2", "8", "--seeds", "2", "--starts", "8", "--training-starts", "40", "--length", "5"]


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "ring_of_forty.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    return "ring_of_forty"


def test_the_command_compares_and_writes(module, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--planners", "sampling", "frontier", "--kinds", "markov", "macro", *QUICK, "--out", str(out)]
    assert main(["compare", "--world", f"{module}:make_world", *options]) == 0
    printed = capsys.readouterr().out
    content = json.loads((out / "comparison.json").read_text())
    assert content["summary"] in printed
    assert content["priors"] == ["uniform", "markov", "macro"]
    assert content["planners"] == ["sampling", "frontier"]
    assert (content["budgets"], content["length"], len(content["seeds"])) == ([2, 8], 5, 2)
    assert len((out / "comparison.csv").read_text().splitlines()) == 1 + 2 * 3 * 2
    assert (out / "comparison.png").read_bytes().startswith(b"\x89PNG")


BAD = [
    (["--world", "ring_of_forty"], "`world` must be module:function"),
    (["--world", "nowhere_at_all:make_world"], "nowhere_at_all"),
    (["--world", "ring_of_forty:make"], "`world` must name a function of ring_of_forty"),
    (["--world", "ring_of_forty:make_number"], "`world` must name a function that returns a World, got int"),
    (["--world", "ring_of_forty:make_world", "--worlds", "maze"], "`worlds` is not for --world"),
    (["--world", "ring_of_forty:make_world", "--context", "none"], "`context` is not for --world"),
    (["--world", "ring_of_forty:make_world", "--rounds", "2"], "`rounds` is not for --world"),
    (["--world", "ring_of_forty:make_world", "--planners", "halving"], "`planners` must be among"),
    (["--world", "ring_of_forty:make_world", "--seconds", "0"], "seconds"),
]


@pytest.mark.usefixtures("module")
@pytest.mark.parametrize(("options", "words"), BAD)
def test_bad_options_are_a_line(options, words, capsys):
    assert main(["compare", *options]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
