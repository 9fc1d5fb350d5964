"""`python -m eval puzzles`, small."""

import json
from pathlib import Path
from xml.etree import ElementTree

import pytest
import torch

from eval.__main__ import main
from eval.puzzles.contest import LETTERS
from neuroprior.puzzles import sliding_tiles, sokoban

pytestmark = pytest.mark.usefixtures("undrawn")

EASY = ["#######\n#@ $ .#\n#######", "#######\n#.$  @#\n#######"]


def level_file(path: Path) -> str:
    """Corridors and rooms with one box, which 300 expansions solve."""
    levels = [f"########\n#{' ' * k}@ $ .#\n#{' ' * (6)}#\n########" for k in range(2)] + EASY
    path.write_text("\n\n".join(levels * 5) + "\n")
    return str(path)


def test_sokoban_from_files_to_solutions(tmp_path, capsys):
    train = level_file(tmp_path / "train.txt")
    out, test = tmp_path / "out", tmp_path / "test.txt"
    test.write_text("########\n#@ $ . #\n########\n########\n\n########\n#.$   @#\n########\n########\n")
    priors = ("bootstrap", "rerooted", "frontier", "mcts", "uniform", "greedy")
    arguments = [
        *("puzzles", "--train", train, "--num-train", "20", "--test", str(test), "--budget", "500", "--sweeps", "2"),
        *("--priors", *priors, "--processes", "1", "--out", str(out)),
    ]
    assert main(arguments) == 0
    found = json.loads((out / "results.json").read_text())
    rows = {row["prior"]: row for row in found["rows"]}
    assert set(rows) == set(priors)
    assert all(row["problems"] == 2 and row["solved"] == 1 for row in rows.values())
    assert rows["bootstrap"]["mean_expansions"] < rows["uniform"]["mean_expansions"]
    assert all(row["seconds_per_problem"] > 0 and row["median_expansions"] >= 1 for row in rows.values())
    boards = sokoban(test).boards
    lines = [json.loads(line) for line in (out / "solutions.jsonl").read_text().splitlines()]
    assert len(lines) == 6 * 2
    world = sokoban(test)
    for line in lines:
        state = boards[line["problem"]][None]
        for letter in line["moves"]:
            state, _ = world.step(state, torch.tensor([LETTERS.index(letter)]))
        assert world.solved(state).all()
    by_prior = [line["expansions"] for line in lines if line["prior"] == "uniform"]
    assert sum(by_prior) / 2 == rows["uniform"]["mean_expansions"]
    # Planners that do not search for the goal spend their budget, five plans of 100 moves, and stop at no solution.
    assert rows["frontier"]["mean_expansions"] == 500 >= rows["mcts"]["mean_expansions"] > 400
    assert all(len(line["moves"]) < 100 for line in lines if line["prior"] in ("frontier", "mcts"))
    assert ElementTree.fromstring((out / "solution.svg").read_text()).tag.endswith("svg")
    assert "Solve and learn" in capsys.readouterr().out
    kept = {path: path.stat().st_mtime_ns for path in out.rglob("*-0.json")}
    assert kept
    assert main(arguments) == 0
    assert kept == {path: path.stat().st_mtime_ns for path in out.rglob("*-0.json")}


def test_tiles_with_two_seeds(tmp_path):
    generator = torch.Generator().manual_seed(0)
    boards = sliding_tiles(shape=(3, 3), scramble=30).reset(30, generator)
    for name, some in (("train", boards[:20]), ("test", boards[20:])):
        text = "\n".join(" ".join(map(str, board)) for board in some.flatten(1).tolist())
        (tmp_path / name).write_text(text)
    out = tmp_path / "out"
    arguments = [
        *("puzzles", "--world", "tiles", "--train", str(tmp_path / "train"), "--num-train", "20", "--sweeps", "2"),
        *("--test", str(tmp_path / "test"), "--num-test", "8", "--budget", "1000", "--seeds", "2"),
        *("--priors", "bootstrap", "mcts", "a-star", "--processes", "1", "--out", str(out)),
    ]
    assert main(arguments) == 0
    found = json.loads((out / "results.json").read_text())
    rows = {row["prior"]: row for row in found["rows"]}
    assert {prior: row["seeds"] for prior, row in rows.items()} == {
        "bootstrap": 2, "mcts": 2, "a-star": 1,
    }  # fmt: skip
    assert rows["bootstrap"]["solved"] == 1.0
    # A* finds the shortest solutions.
    assert rows["bootstrap"]["mean_length"] >= rows["a-star"]["mean_length"]
    assert {(row["seed"], row["number"]) for row in found["sweeps"]} == {(0, 1), (0, 2), (1, 1), (1, 2)}
    assert {row["prior"] for row in found["pairs"]} == {"mcts", "a-star"}


def test_levels_of_other_sizes_and_of_known_walls(tmp_path):
    train = level_file(tmp_path / "train.txt")
    (tmp_path / "test.txt").write_text("#####\n#@$.#\n#####\n\n" + "\n".join(["#" * 12, "#@ $ .######", "#" * 12]))
    # The walls of the second level are those of a training level, too.
    for test, problems, own in ((str(tmp_path / "test.txt"), 2, 1), (train, 20, None)):
        out = tmp_path / f"out-{problems}"
        arguments = ["--train", train, "--test", test, "--budget", "300", "--sweeps", "1", "--processes", "1"]
        assert main(["puzzles", *arguments, "--priors", "bootstrap", "rerooted", "--out", str(out)]) == 0
        found = json.loads((out / "results.json").read_text())
        assert [row["problems"] for row in found["rows"]] == [problems] * 2
        assert found["rows"][0]["solved"] == 1
        assert (found["own_walls"][0]["problems"] if own else found.get("own_walls")) == own
