"""The runs of a comparison: what goes to other processes, what makes another folder, and files that are damaged."""

from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path

import pytest
import torch

from eval.__main__ import main
from eval.compare import command
from eval.compare.run import Settings
from eval.worlds.runs import runs_of
from neuroprior import MarkovPrior, save
from neuroprior._jobs import JobRun
from tests.support.made_up_runs import made_up

pytestmark = pytest.mark.usefixtures("undrawn")

SETTINGS = Settings((2, 4), ("markov",), ("none",), 1, 3, 4, 5, 0)
RUNS = runs_of(["maze", "grid"], 3)
OPTIONS = ("compare", "--worlds", "maze", "grid", "--seeds", "3", "--num-plans", "4", "--seed", "1")
OPTIONS += ("--training-starts", "9", "--steps", "5")  # what a command line gives goes to other processes


def jobs_in(folder: Path, run=made_up, **changes) -> JobRun:
    settings = replace(SETTINGS, **changes)
    return JobRun(partial(run, settings=settings), folder, settings.asked, name=attrgetter("name"))


def test_runs_are_worlds_times_seeds():
    assert [(*run,) for run in RUNS] == [(world, seed) for seed in range(3) for world in ("maze", "grid")]
    assert len({run.name for run in RUNS}) == 6


def test_numbers_of_a_command_line_are_plain_where_they_go_to_other_processes(monkeypatch, tmp_path):
    """Those of types that the command makes could not be read where its module is not imported."""
    given = []
    monkeypatch.setattr(command, "compare_run", lambda run, settings: given.append(settings) or made_up(run, settings))
    numbers = {"training-starts": 9, "steps": 5, "starts": 7, "rounds": 3, "seed": 2}
    options = [f"--{name}={number}" for name, number in numbers.items()]
    assert (
        main(["compare", "--worlds=maze", "--seeds=1", "--num-plans=4", *options, "--processes=1", f"--out={tmp_path}"])
        == 0
    )
    for name, number in numbers.items():
        kept = getattr(given[0], name.replace("-", "_"))
        assert (kept, type(kept)) == (number, int)
    assert [(number, type(number)) for number in given[0].num_plans] == [(4, int)]


def test_whatever_changes_results_makes_another_folder(tmp_path):
    base = jobs_in(tmp_path)
    assert jobs_in(tmp_path).folder == base.folder
    changes = [
        {"num_plans": (2, 8)},
        {"kinds": ("gru",)},
        {"context": ("initial",)},
        *({name: 9} for name in ("rounds", "steps", "starts", "training_starts", "seed")),
        {"lengths": (4,)},
    ]
    folders = [base.folder, *(jobs_in(tmp_path, **change).folder for change in changes)]
    prior = save(MarkovPrior(4, 1).fit(torch.zeros(3, 4, dtype=torch.long)), tmp_path / "prior")
    folders += [jobs_in(tmp_path, priors=(str(prior),)).folder]
    save(MarkovPrior(4, 1).fit(torch.ones(3, 4, dtype=torch.long)), prior)  # another model at the same place
    folders += [jobs_in(tmp_path, priors=(str(prior),)).folder]
    assert len(set(folders)) == len(folders)


# A process that is killed: in `test_jobs.py`, too.


def finish(out: Path) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "compare_run", made_up)
        return main([*OPTIONS, "--processes", "1", "--out", str(out)])


@pytest.mark.parametrize("text", ['{"world": ', "[]", '{"world": "maze", "seed": 2}'])
def test_a_damaged_file_is_named(text, tmp_path, capsys):
    assert finish(tmp_path) == 0
    (path,) = tmp_path.rglob("maze-1.json")
    path.write_text(text)
    assert finish(tmp_path) == 2
    assert f"{path}: damaged" in capsys.readouterr().err
