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

from neuroprior.cli.__main__ import main

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
    for needed in ("cli/recipes/gru.yaml", "report/page.html.j2", "py.typed"):
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


def run(installed: Path, folder: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    program = [str(installed / "neuroprior"), *words]
    done = subprocess.run(program, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done


def test_the_four_commands(installed: Path, tmp_path: Path) -> None:
    run(installed, tmp_path, "example", "study.csv")
    study = ["study.csv", "--columns.action", "behaviour", "--columns.plan", "session", "--columns.group", "animal"]
    quick = ["--trainer.max_steps", "20", "--trainer.accelerator", "cpu", "--data.folds", "1"]
    fitted = run(installed, tmp_path, "fit", "--config", "gru", "--data.file", *study, "--out", "gru", *quick)
    assert "bits per action" in fitted.stdout
    report = ["--models", "counts", "--processes", "1", "--out", "report"]
    assert "report: report/report.html" in run(installed, tmp_path, "report", *study, *report).stdout
    assert (tmp_path / "report" / "report.html").stat().st_size > 10_000
    scored = run(installed, tmp_path, "score", "gru", *study, "--out", "score")
    assert "bits per action" in scored.stdout
    plans = pd.read_csv(tmp_path / "score" / "plans.csv")
    groups = pd.read_csv(tmp_path / "score" / "groups.csv")
    assert (len(plans), len(groups)) == (100, 12)
    assert plans["log_likelihood"].sum() == pytest.approx(groups["log_likelihood"].sum())
    said = run(installed, tmp_path, "sample", "gru", "--num-plans", "7", "--length", "5").stdout.splitlines()
    actions = [json.loads(line)["actions"] for line in said if "actions" in json.loads(line)]
    assert [len(some) for some in actions] == [5] * 7
    run(installed, tmp_path, "sample", "gru", "--num-plans", "3", "--out", "new.csv")
    known = {"drink", "eat", "freeze", "groom", "rear", "rest", "sniff", "walk"}
    assert set(pd.read_csv(tmp_path / "new.csv").stack()) <= known


def test_bad_input_is_one_line(installed: Path, tmp_path: Path) -> None:
    said = run(installed, tmp_path, "sample", "nowhere", "--num-plans", "0", code=2).stderr
    assert said == "error: num_plans: an integer of at least 1 is expected, not 0\n"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["score", "nowhere", "plans.csv"], "nowhere"),
        (["sample", "nowhere"], "nowhere"),
        (["fit", "--config", "gruu", "--data.file", "x.csv"], "gru"),
        (["report", "nowhere.csv"], "nowhere.csv"),
        (["example", "."], "ends in .csv"),
        (["paint"], "there are fit, report, score, sample"),
    ],
)
def test_each_command_names_what_is_wrong(words: list[str], says: str, capsys: pytest.CaptureFixture) -> None:
    assert main(words) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert says in said
