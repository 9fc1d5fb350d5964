"""What a release promises: one version everywhere, versions of packages, extras, types, and the time of an import."""

import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import neuroprior

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_one_version() -> None:
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert cited is not None
    assert newest is not None
    assert {cited[1], newest[1]} == {neuroprior.__version__}


def pinned(name: str) -> dict[str, str]:
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    pairs = (line.split("==") for line in lines if "==" in line)
    return {package.lower(): version for package, version in pairs}


def test_lowest_versions_are_those_that_are_promised() -> None:
    """Of the library's own extras; the others compare, build pages or test."""
    extras = PROJECT["optional-dependencies"]
    own = ("report", "tables", "cli", "dask", "gym", "mujoco")
    asked = [*PROJECT["dependencies"], *(need for name in own for need in extras[name])]
    least = dict(re.match(r"([\w-]+)(?:\[\w+\])?>=(.+)", need).groups() for need in asked if ">=" in need)
    lowest = pinned("constraints-lowest.txt")
    assert set(lowest) == set(least)
    for package, version in lowest.items():
        assert re.fullmatch(re.escape(least[package]) + r"(\.0)*", version), package
    assert set(lowest) <= set(pinned("constraints.txt"))


def test_each_extra_is_tried() -> None:
    tried = {path.stem.removeprefix("extra_") for path in (ROOT / ".ci/smoke").glob("extra_*.py")}
    assert tried == set(PROJECT["optional-dependencies"]) - {"all"}


def test_code_of_a_user_runs(tmp_path: Path) -> None:
    """`make check` reads its types."""
    runpy.run_path(str(ROOT / "tests/typing/user_code.py"))["main"](tmp_path)


HEAVY = {"gymnasium", "jinja2", "joblib", "jsonargparse", "lightning", "matplotlib", "numba", "pandas", "rich", "scipy"}
"""What an import of the library leaves for when it is needed."""

BUDGET = 0.5
"""Most that an import of the library may take beyond that of torch, as a share of that of torch."""


EVERYTHING = "import torch, neuroprior.planners, neuroprior.priors.scoring; from neuroprior import *"
"""The rooms first, by statements: imports by `import_module` are not timed."""


def imported(code: str = EVERYTHING) -> tuple[float, set[str]]:
    """How much longer than torch an import of all names takes, as a share of torch's time; and what is imported."""
    command = [sys.executable, "-X", "importtime", "-c", code]
    said = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True).stderr
    # With one space the module was imported by the code itself, with more by another module.
    lines = [
        (int(cumulative), len(spaces) == 1, name)
        for cumulative, spaces, name in re.findall(r"\| +(\d+) \|( +)(\S+)$", said, re.MULTILINE)
    ]
    own = sum(time for time, first, name in lines if first and name.partition(".")[0] == "neuroprior")
    torchs = sum(time for time, first, name in lines if first and name == "torch")
    return own / max(torchs, 1), {name.partition(".")[0] for _, _, name in lines}


def test_import_is_light() -> None:
    """The least of three times counts: on a machine at work one may take long."""
    share, packages = imported()
    assert "torch" in packages
    assert not packages & HEAVY
    if share > BUDGET:
        share = min(imported()[0] for _ in range(2))
    assert share <= BUDGET


def test_what_needs_no_library_imports_none() -> None:
    assert not imported("import neuroprior; neuroprior.__version__; dir(neuroprior)")[1] & {*HEAVY, "torch", "numpy"}
    assert "torch" not in imported("from neuroprior.__main__ import COMMANDS")[1]


def test_the_top_level_has_its_names_and_rooms() -> None:
    assert {*neuroprior.__all__, "plans", "priors", "worlds", "agents", "behaviour", "control", "puzzles"} <= set(
        dir(neuroprior)
    )
    for name in dir(neuroprior):
        assert getattr(neuroprior, name) is not None
    assert neuroprior.priors.MarkovPrior is neuroprior.MarkovPrior
    with pytest.raises(AttributeError, match="no attribute 'MarkovPriors'"):
        _ = neuroprior.MarkovPriors
