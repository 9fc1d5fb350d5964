"""The program `python -m eval`, end to end on small cases, and its answers to bad input."""

import csv
import importlib.metadata
import json
from pathlib import Path

import pytest
import torch

from eval.__main__ import main
from eval.paper.first_simulation import PAPER_BEST, training_plans
from eval.paper.planners import PaperSettings
from eval.paper.second_simulation import PAPER_REACHED
from neuroprior import Plans, gridworld

SMALL = ["--worlds=3", "--starts=20", "--training-plans=200", "--size=8", "--num-plans=16"]
SMALL += ["--value-functions=2", "--q-steps=300", "--max-plans=2", "--steps=30"]


@pytest.fixture(scope="module")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper")
    assert main(["paper", *SMALL, "--out", str(folder)]) == 0
    return folder


def test_paper_writes_results(small_run: Path) -> None:
    results = json.loads((small_run / "results.json").read_text())
    assert results["settings"]["worlds"] == 3
    assert results["seed"] == 0
    assert results["versions"]["torch"] == importlib.metadata.version("torch")
    rows = {row["planner"]: row for row in results["simulation_1"]["rows"]}
    assert list(rows) == ["deterministic", "random", "markov-1", "markov-2", "markov-3", "gru", "transformer", "oracle"]
    for name, row in rows.items():
        assert 0 <= row["low"] <= row["best"] <= row["high"] <= 1
        assert row["paper"] == PAPER_BEST.get(name)
        assert row["mean_reward"] <= rows["oracle"]["mean_reward"] + 1e-9
        assert row["oracle_share"] <= 1 + 1e-9
    assert rows["oracle"]["best"] == 1
    # At least one of the paper's four is best at every start.
    assert sum(rows[name]["best"] for name in PAPER_BEST) >= 1
    matrix = torch.tensor(results["simulation_1"]["transition_matrix"])
    assert torch.allclose(matrix.sum(1), torch.ones(4))


def test_paper_writes_table_2(small_run: Path) -> None:
    found = json.loads((small_run / "results.json").read_text())["simulation_2"]
    rows = {row["planner"]: row for row in found["rows"]}
    whole = ["deterministic", "random", "markov-1", "markov-2", "markov-3", "gru", "transformer"]
    assert list(rows) == whole + [name + " (any prefix)" for name in whole]
    assert all(0 <= row["low"] <= row["reached"] <= row["high"] <= 1 for row in rows.values())
    assert all(row["paper"] == PAPER_REACHED.get(name) for name, row in rows.items())
    assert max(rows[name]["reached"] for name in whole) <= found["ceiling"] + 1e-9
    assert found["ceiling"] <= found["ceiling_any_prefix"] <= 1
    with open(small_run / "table_2.csv") as file:
        assert len(list(csv.DictReader(file))) == 14


def test_paper_writes_tables_and_figures(small_run: Path) -> None:
    with open(small_run / "table_1.csv") as file:
        assert [row["planner"] for row in csv.DictReader(file)][:2] == ["deterministic", "random"]
    for name in ("table_1.png", "transition_matrix.png", "world.png", "figure_1.png", "value_quality.png"):
        assert (small_run / name).read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in small_run.glob(".*")] == [".neuroprior.json"]


def test_all_protocols_and_one_world(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shown in 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["paper", *SMALL, "--worlds", "1", "--protocols", "all", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert len(results["protocols"]) == 8
    distances = [row["table_distance"] for row in results["protocols"]]
    nearest = results["protocols"][distances.index(min(distances))]
    assert all(nearest[key] == value for key, value in results["nearest"]["table"].items())
    assert [(row["edges"], row["initial_scale"]) for row in results["scales"]][:2] == [("torus", 1e-4), ("torus", 0.01)]
    shown = capsys.readouterr().out
    assert "nearest to the paper's matrix" in shown
    assert "…" not in shown
    assert max(map(len, shown.splitlines())) <= 80


@pytest.mark.parametrize("edges", ["torus", "wall"])
def test_protocols_choose_the_plans_they_say(edges: str) -> None:
    world = gridworld(9, 9, edges, num_worlds=2, seed=3)
    states = world.reset(300, torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(1)

    def chosen(ties: str, learn_from: str) -> Plans:
        settings = PaperSettings(2, 300, 300, 9, edges, ties, learn_from, 1.0, 2, 0, 0.01, 1, 3, 3, 16, 10, 0)
        return training_plans(world, states, settings, generator)

    first, uniform = chosen("first", "all"), chosen("uniform", "all")
    for plans in (first, uniform):
        rewards = world.rollout(states, plans.actions[:, None]).rewards[:, 0, -1]
        every = torch.cartesian_prod(*[torch.arange(4)] * 3)
        scores = world.rollout(states, every.expand(300, -1, -1)).rewards[..., -1]
        assert rewards.equal(scores.amax(1))
    assert first.actions.long().equal(every[(scores == scores.amax(1, keepdim=True)).int().argmax(1)])
    shortest = chosen("uniform", "shortest")
    assert 0 < len(shortest) < 300
    # A plan of three moves is a shortest one exactly if it never reverses a move that it made (or bumps).
    for plan in shortest.actions.tolist():
        assert not any((a + 2) % 4 in plan for a in plan)


def test_unwritable_folder_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert main(["paper", *SMALL, "--out", str(tmp_path / "file" / "below")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_an_interrupted_command_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def interrupted(*args: object, **settings: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("eval.paper.first_simulation.simulate", interrupted)
    assert main(["paper", *SMALL, "--out", str(tmp_path)]) == 130
    error = capsys.readouterr().err
    assert error.startswith("interrupted")
    assert error.count("\n") == 1
