"""Options of the experiments that cannot be: one line that says why, and nothing is written."""

import pytest

from eval.__main__ import main

GRID = ["--worlds", "forage_grid"]
BAD = {
    "compare": [
        (["--worlds", "nowhere"], "worlds"),
        (["--worlds", "maze", "maze"], "worlds: each may be given once, not maze maze"),
        (["--num-plans", "16", "100"], "num_plans"),
        (["--num-plans", "16", "16"], "num_plans: each may be given once"),
        (["--num-plans", "many"], "num_plans"),
        (["--kinds", "lstm"], "kinds"),
        (["--worlds", "maze", "cliff", "--context", "initial"], "context: cliff offers no context of use"),
        (["--rounds", "-1"], "rounds"),
        (["--training-starts", "1"], "training_starts"),
        (["--priors", "nowhere"], "folders of saved priors, got 'nowhere'"),
        (["--priors", "gru"], "priors: gru is also the name of a fitted prior; give the folder as ./gru"),
        (["--seed", str(2**41)], "seed"),
        (["--planners", "best"], "sampling"),
        (["--planners", "mcts", "mcts"], "planners: each may be given"),
        (["--planners", "mcts", "--worlds", "grid", "slippery"], "planners: none of mcts is for slippery"),
        (["--planners", "halving", "--worlds", "grid"], "planners: none of halving is for grid"),
        (["--length", "5"], "`length` is for --world alone"),
    ],
    "curriculum": [
        (["--lengths", "4", "4"], "`lengths` must"),
        (["--lengths", "2", "4"], "`lengths` must"),
        (["--worlds", "grid", "--context", "initial"], "context: grid offers no context of use"),
        (["--kinds", "gru", "gru"], "kinds: each may be given once"),
        (["--num-plans", "100"], "num_plans"),
    ],
    "depth": [
        (["--length", "6"], "length"),
        (["--worlds", "slippery"], "slippery"),
        (["--num-plans", "3"], "num_plans"),
    ],
    "bench": [
        (["--scale", "0"], "scale"),
        (["--jobs", "sing"], "jobs"),
        (["--repetitions", "0"], "repetitions"),
    ],
    "control": [
        (["--priors", "none", "wizard"], "wizard"),
        (["--priors", "stored"], '`priors` must have "none"'),
        (["--scored", "none"], "scored"),
        (["--conditions", "validation"], "validation"),
        (["--budgets", "8", "8"], "budgets"),
    ],
    "intentions": [
        (["--goals", "1"], "`goals` must be integers from 2 to 32, got 1"),
        (["--num-plans", "1"], "`num_plans` must be integers from 2"),
        (["--observed", "33"], "`observed` must be integers from 1 to 32"),
        (["--ahead", "125"], "`ahead` must be integers from 1 to 124"),
        (["--seeds", "11"], "seeds: in the labyrinth at most 10"),
        (["--temperature", "0"], "temperature"),
    ],
    "live": [
        (["--kinds", "markov", "markov"], "kinds"),
        (["--period", "100"], "`period` must be a multiple of 64"),
        ([*GRID, "--length", "6"], "length"),
        ([*GRID, "--items", "20"], "items"),
        (["--agents", "0"], "agents"),
    ],
    "mice": [
        (["--seeds", "1"], "`seeds` must be at least 2"),
        (["--starts", "127"], "`starts` must be integers from 1 to 126"),
        (["--num-plans", "4", "4"], "num_plans: each may be given once"),
        (["--lengths", "501"], "`lengths` must be integers from 1 to 500"),
        (["--training-plans", "2", "--seeds", "2"], "training_plans"),
    ],
    "modes": [(["--modes", "2", "2"], "modes: each may be given once")],
    "options": [
        (["--lengths", "501"], "`lengths` must be integers from 1 to 500"),
        (["--starts", "127"], "`starts` must be integers from 1 to 126"),
        (["--modes", "2", "2"], "modes: each may be given once"),
    ],
    "pages": [(["--stages", "mouse"], "mouse")],
    "paper": [
        (["--worlds", "0"], "worlds"),
        (["--edges", "cliff"], "edges"),
        (["--worlds", "many"], "worlds"),
        (["--no-such-option", "1"], "no_such_option"),
        (["--initial-scale", "-1"], "initial_scale"),
        (["--seed", "-1"], "seed"),
        (["--size", "100000"], "memory"),
        (["--depth", "20", "--worlds", "1", "--starts", "2", "--training-plans", "2"], "depth"),
    ],
    "papers": [([], "papers")],
    "puzzles": [
        (["--train", "nowhere.txt"], "nowhere.txt"),
        (["--world", "chess"], "world"),
        (["--priors", "guess"], "guess"),
        (["--priors", "uniform", "uniform"], "uniform"),
        (["--world", "tiles", "--test", "eval/data/boxoban/test.txt.xz"], "test.txt.xz"),
    ],
    "quality": [(["--num-plans", "0", "--num-sequences", "0"], "must be above 0")],
    "sources": [
        (["--plans", "20", "20"], "plans"),
        (["--plans", "19"], "`plans` must be at least 20, got 19"),
        (["--calls", "1"], "`calls` must be at least 2, got 1"),
        (["--num-plans", "3"], "`num_plans` must be at least 4, got 3"),
    ],
    "study": [(["--actions", "0"], "actions")],
}


@pytest.mark.parametrize(
    ("command", "options", "says"), [(command, *bad) for command, rows in BAD.items() for bad in rows]
)
def test_bad_options_are_one_line(command, options, says, tmp_path, capsys):
    assert main([command, *options, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert said.count("\n") == 1
    assert says in said
    assert not (tmp_path / "out").exists()
