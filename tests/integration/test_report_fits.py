"""`python -m eval plans FILE`: known values, test files, and runs that were interrupted."""

import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from eval.__main__ import main
from neuroprior import MarkovPrior, Plans
from neuroprior.plans import write_plans
from neuroprior.priors.counts import BACKOFFS_TRIED
from tests.support.chains import markov_plans, markov_probs
from tests.support.reports import QUICK, QUICK_IN_TWO, QUICKLY, bits, fails, report
from tests.support.sessions import interrupted
from tests.support.sources import seeded

pytestmark = pytest.mark.usefixtures("undrawn")


def cost_after(probs: torch.Tensor, length: int, skip: int) -> float:
    """The mean entropy, bits, of actions `skip` + 1 to `length` of `markov_plans` of a chain of order 2."""
    size = probs.shape[1]
    pair = torch.full((size * size,), 1 / size**2, dtype=torch.double)
    entropy = -(probs * probs.log2()).sum(1)
    means = []
    for t in range(2, length):
        if t >= skip:
            means.append(float(pair @ entropy))
        both = (pair[:, None] * probs).view(size, size, size)  # older, newer, next
        pair = both.sum(0).flatten()
    return sum(means) / len(means)


def test_the_entropy_rate_is_reached(tmp_path):
    """The best chain takes what the source has, and at most 1 % more for learning; 4 half widths are 8 errors."""
    probs = markov_probs(3, 2, 0, 1.5)
    plans = markov_plans(probs, 400, 30, 1)
    results = report(plans, tmp_path, replace(QUICK_IN_TWO, models=["counts", "gru"]), skip=2)
    truth, own = cost_after(probs, 30, 2), bits(results)
    best = min(results["scores"], key=lambda row: row["bits_per_behaviour"])
    half = best["high"] - best["bits_per_behaviour"]
    assert half < 0.02
    assert truth - 2 * half < best["bits_per_behaviour"] < 1.01 * truth + 2 * half
    assert own["markov-2"] - best["bits_per_behaviour"] < 0.002
    assert own["uniform"] == pytest.approx(math.log2(3), abs=1e-6)
    assert own["markov-1"] > own["markov-2"] + 0.01
    assert own["markov-0"] > own["markov-1"]
    (row,) = (row for row in results["scores"] if row["model"] == "markov-1")
    assert row["more_low"] > 0
    assert results["reference"].startswith(best["model"])
    assert results["unit"] == "sequences"
    assert results["file"] | {"name": ""} == {
        "name": "",
        "sequences": 400,
        "behaviours": 12000,
        "shortest": 30,
        "longest": 30,
        "kinds": 3,
        "subjects": 0,
        "conditions": 0,
        "durations": False,
        "notes": [],
        "context": "none",
    }


def test_a_planted_difference_of_groups_is_found(tmp_path):
    """Two of four mice have a transition matrix of their own; the groups of one source differ in nothing."""
    one, other = markov_probs(3, 1, 0), markov_probs(3, 1, 7)
    parts = [markov_plans(one if n < 2 else other, 20, 15, n).actions for n in range(4)]
    group = torch.arange(4).repeat_interleave(20)
    plans = Plans(torch.cat(parts), 3, group=group, group_names=("<i>", "[/b]", "ü", "d"), action_names=("a", "b", "c"))
    results = report(plans, tmp_path, sections=["scores", "transitions"])
    assert results["unit"] == "subjects"
    cells = [row for row in results["transitions"] if row["subject"] != "all"]
    assert min(row["p_value"] for row in cells) == pytest.approx(0.001)
    (test,) = results["transition_test"]
    assert (test["subjects"], test["test"]) == (4, "permutation")
    assert test["p_value"] == pytest.approx(0.001)
    counts = torch.zeros(3, 3)
    for a, b in zip(plans.actions[:, :-1].flatten().tolist(), plans.actions[:, 1:].flatten().tolist(), strict=True):
        counts[a, b] += 1
    for row in results["transitions"]:
        if row["subject"] == "all":
            a, b = ("abc".index(row[end]) for end in ("from", "to"))
            assert row["count"] == counts[a, b]
            assert row["probability"] == pytest.approx(float(counts[a, b] / counts[a].sum()))
    alike = report(replace(plans, group=torch.arange(80) % 4), tmp_path, sections=["scores", "transitions"])
    assert min(row["p_value"] for row in alike["transitions"] if row["subject"] != "all") > 0.001


def test_a_test_file_by_name(tmp_path):
    """It numbers its names in another order, has fewer of them, and scores as by hand."""
    names = ("left", "on", "right")
    learned = markov_plans(markov_probs(3, 1, 0, 2.0), 30, 6, 1, action_names=names)
    test = markov_plans(markov_probs(2, 1, 3, 2.0), 12, 9, 2)
    write_plans(replace(test, action_names=("right", "left")), tmp_path / "test.npz")
    found = bits(report(learned, tmp_path, QUICK, test=tmp_path / "test.npz", skip=1, sections=["scores"]))
    renamed = torch.tensor([2, 0])[test.actions.long()]
    training, validation = learned.split(0.1, seeded(0))
    for order in (0, 1, 2):
        tried = [MarkovPrior(3, order, smoothing, backoff=rule) for rule, smoothing in BACKOFFS_TRIED]
        cost = [-float(prior.fit(training).log_prob(validation.actions).sum()) for prior in tried]
        best = tried[cost.index(min(cost))].fit(learned)
        want = -best.action_log_probs(Plans(renamed, 3))[:, 1:].double().mean() / math.log(2)
        assert found[f"markov-{order}"] == pytest.approx(float(want), abs=1e-5)


@pytest.mark.parametrize(
    ("learned", "test", "words"),
    [
        ({"action_names": ("a", "b", "c")}, {"action_names": ("a", "b", "[/x]")}, ("'[/x]'", "a, b, c")),
        ({}, {"num_actions": 4}, ("4 actions", "3")),
        ({}, {"context": torch.zeros(20).long()}, ("context indices", "no context")),
        ({"context": torch.zeros(20).long()}, {}, ("no context", "context indices")),
        ({"context": torch.zeros(20).long()}, {"context": torch.zeros(20, 2)}, ("2 features", "context indices")),
        ({"context": torch.zeros(20, 8, 3)}, {"context": torch.zeros(20, 8, 2)}, ("2 features", "3 features")),
        (
            {"context": torch.zeros(20).long(), "context_names": ("x",)},
            {"context": torch.zeros(20).long(), "context_names": ("y",)},
            ("'y'", "x"),
        ),
    ],
)
def test_test_files_of_another_kind(learned, test, words, tmp_path, capsys):
    plans = markov_plans(markov_probs(3, 1, 0), 20, 8, 1)
    write_plans(replace(plans, **learned), tmp_path / "learned.npz")
    write_plans(replace(plans, **test), tmp_path / "test.npz")
    paths = [str(tmp_path / name) for name in ("learned.npz", "test.npz", "out")]
    fails([paths[0], "--test", paths[1], "--out", paths[2], *QUICKLY], capsys, paths[1], *words)
    assert not list(tmp_path.rglob("fold*.npz"))


INTERRUPTED = ("--models", "counts", "--max-steps", "3", "--folds", "6")
WRITTEN = ("results.json", "scores.csv", "lags.csv", "drift.csv")


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """A folder with a file of plans, and in `alone` a report that one process made without a break."""
    folder = tmp_path_factory.mktemp("interrupted")
    write_plans(markov_plans(markov_probs(3, 1, 0), 24, 8, 1), folder / "new.npz")
    assert (
        main(["plans", str(folder / "new.npz"), *INTERRUPTED, "--processes", "1", "--out", str(folder / "alone")]) == 0
    )
    return folder


def program(plans: Path, out: Path) -> subprocess.Popen[str]:
    """The command in a session of its own, as from a terminal."""
    return subprocess.Popen(
        [sys.executable, "-m", "eval", "plans", str(plans), *INTERRUPTED, "--processes", "2", "--out", str(out)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # As in a terminal, also where the tests themselves are run in the background, deaf to Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


@pytest.mark.slow  # as in test_jobs.py
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_run_goes_on(how, alone):
    """Ctrl-C or a killed main process: nobody is left behind, nothing that is finished is done again.

    Begun by two processes and ended by one, results are to the byte those of a run that one did alone.
    """
    out = alone / how.name
    running = program(alone / "new.npz", out)
    output, said = interrupted(running, how, lambda: list(out.rglob("fold*-*.npz")))
    if how == signal.SIGINT:
        assert running.returncode == 130
        assert said.splitlines()[-1].startswith(f"interrupted; finished jobs are kept in {out}")
        assert all(line.startswith(("report: ", "counts: ")) for line in said.splitlines()[:-1])
    assert "Traceback" not in output + said
    finished = {path: path.stat().st_mtime_ns for path in out.rglob("fold*-*.npz")}
    assert 0 < len(finished) < 7
    status = "Interrupted: " if how == signal.SIGINT else "Still running: counts."
    assert status in (out / "report.html").read_text()
    assert json.loads((out / "results.json").read_text())["reference"] is None
    assert main(["plans", str(alone / "new.npz"), *INTERRUPTED, "--processes", "1", "--out", str(out)]) == 0
    assert finished.items() <= {path: path.stat().st_mtime_ns for path in out.rglob("fold*-*.npz")}.items()
    assert len(list(out.rglob("fold*-*.npz"))) == 7
    assert status not in (out / "report.html").read_text()
    for name in WRITTEN:
        assert (out / name).read_bytes() == (alone / "alone" / name).read_bytes()
