"""What a release says of itself is the same everywhere."""

import re
import tomllib
from pathlib import Path

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
    own = ("report", "cli", "dask", "gym", "mujoco", "fast")
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
