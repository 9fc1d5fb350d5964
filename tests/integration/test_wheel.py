"""What pip installs: the wheel, built from the sdist, in an environment of its own, does what the README says."""

import json
import os
import site
import subprocess
import sys
import zipfile
from pathlib import Path

import pandas as pd
import pytest

from neuroprior.cli.example import example

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the programs of a fresh environment with the wheel; its dependencies are those of the tests."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder / "dist"), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    assert len(list((folder / "dist").glob("*.tar.gz"))) == 1
    (wheel,) = (folder / "dist").glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {
        "neuroprior",
        next(n for n in names if "dist-info" in n).split("/")[0],
    }
    for needed in ("cli/recipes/gru.yaml", "behaviour/reporting/page.html.j2", "py.typed"):
        assert f"neuroprior/{needed}" in names
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / "venv")], check=True)
    python = folder / "venv" / "bin" / "python"
    ask = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    library = Path(subprocess.run(ask, check=True, capture_output=True, text=True).stdout.strip())
    # A path file of a path file's folder is not read, so the tests' own editable install stays out of sight.
    (library / "dependencies.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*pip, str(wheel)], check=True, capture_output=True)
    return folder / "venv" / "bin"


def done(program: list[str], folder: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """What a program said, of which nothing but what is installed is known."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    ended = subprocess.run(program, cwd=folder, env=environment, capture_output=True, text=True)
    assert ended.returncode == code, ended.stderr
    assert "Traceback" not in ended.stderr
    return ended


def run(installed: Path, folder: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    return done([str(installed / "neuroprior"), *words], folder, code)


IN_ONE_PROCESS = """
import json, sys
import neuroprior
from neuroprior.__main__ import main

assert neuroprior.__file__.startswith(sys.prefix), neuroprior.__file__
for words in json.loads(sys.argv[1]):
    print("$", words[0], flush=True)
    assert main(words) == 0, words
"""


@pytest.mark.slow
def test_the_six_commands(installed: Path, tmp_path: Path) -> None:
    """In one process, as libraries load for seconds; the next test runs the program itself."""
    example(str(tmp_path / "expected.csv"))
    events = pd.read_csv(tmp_path / "expected.csv")
    assert events["animal"].nunique() == 12
    events[events["animal"].isin(events["animal"].unique()[:3])].to_csv(tmp_path / "few.csv", index=False)
    study = ["few.csv"]
    quick = ["--max_steps", "5", "--folds", "1"]
    commands = [
        ["example", "study.csv"],
        ["check", "study.csv"],
        ["fit", "--config", "gru", *study, "--out", "gru", *quick],
        ["report", *study, "--priors", "gru", "--out", "report"],
        ["score", "gru", *study, "--out", "score"],
        ["sample", "gru", "--num-plans", "7", "--length", "5"],
        ["sample", "gru", "--num-plans", "3", "--out", "new.csv"],
    ]
    program = [str(installed / "python"), "-c", IN_ONE_PROCESS, json.dumps(commands)]
    said = done(program, tmp_path).stdout.split("$ ")
    assert (tmp_path / "study.csv").read_bytes() == (tmp_path / "expected.csv").read_bytes()
    checked, fitted, reported, scored, sampled = said[2:7]
    assert "7,124 events of 8 behaviours, 24 recordings of 12 subjects" in checked
    assert "bits per action" in fitted
    assert (tmp_path / "gru" / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert "report: report/report.html" in reported
    assert (tmp_path / "report" / "report.html").stat().st_size > 10_000
    assert "bits per action" in scored
    plans = pd.read_csv(tmp_path / "score" / "plans.csv")
    groups = pd.read_csv(tmp_path / "score" / "groups.csv")
    assert len(plans) > len(groups) == 3
    assert plans["log_likelihood"].sum() == pytest.approx(groups["log_likelihood"].sum())
    lines = [json.loads(line) for line in sampled.splitlines()[1:]]
    assert [len(line["actions"]) for line in lines if "actions" in line] == [5] * 7
    known = {"drink", "eat", "freeze", "groom", "rear", "rest", "sniff", "walk"}
    assert set(pd.read_csv(tmp_path / "new.csv").stack()) <= known


def test_bad_input_is_one_line(installed: Path, tmp_path: Path) -> None:
    said = run(installed, tmp_path, "sample", "nowhere", "--num-plans", "0", code=2).stderr
    assert said.startswith('error: Parser key "num_plans": Not of type PositiveInt: 0')
    assert said.count("\n") == 1
