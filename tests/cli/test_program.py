"""What programs say and return when something goes wrong."""

import errno
import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Literal

import pytest
from jsonargparse.typing import NonNegativeInt, PositiveInt

from neuroprior import load
from neuroprior.__main__ import main as neuroprior_main
from neuroprior._interrupts import is_command
from neuroprior._version import __version__
from neuroprior.cli.program import Command, run_commands, run_program


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ValueError("what\n  was"), 2, "error: what was"),
        (ValueError("words " * 1000), 2, "error: " + "words " * 165 + "..."),
        (FileNotFoundError(2, "No such file", "x"), 2, "error: x: no such file"),
        (OSError("disk"), 2, "error: disk"),
        (MemoryError("too much"), 2, "error: too much"),
        (KeyboardInterrupt("go on"), 130, "go on"),
        (KeyboardInterrupt(), 130, "interrupted; what was not yet written is lost"),
        (RuntimeError("no memory\nfor it"), 2, "error: out of memory; a smaller run may fit (no memory)"),
    ],
)
def test_what_a_program_says(error, code, line, capsys, monkeypatch):
    monkeypatch.setattr("signal.signal", lambda *_: None)

    def fails(arguments):
        raise error

    assert run_program(fails, []) == code
    assert capsys.readouterr() == ("", line + "\n")


def test_other_errors_are_raised():
    def fails(arguments):
        raise RuntimeError("shapes do not fit")

    with pytest.raises(RuntimeError, match="shapes"):
        run_program(fails, [])


def test_dashes_and_underscores_are_the_same(monkeypatch):
    got = []
    assert run_program(got.extend, ["a-b", "--c-d=e-f", "--g-h", "-i-j"]) == 0
    monkeypatch.setattr(sys, "argv", ["program", "--k-l"])
    assert run_program(got.extend) == 0
    assert got == ["a-b", "--c_d=e-f", "--g_h", "-i-j", "--k_l"]


def made(
    file: str,
    worlds: list[Literal["grid", "maze"]] = ["grid"],  # noqa: B006
    sizes: list[PositiveInt] | None = None,
    number: NonNegativeInt = 3,
    rate: float | None = None,
    done: bool = False,
) -> None:
    """Make something.

    Args:
        file: where.
        worlds: in which worlds,
            one after another.
        sizes: of what is made.
        number: how many.
    """
    print(file, worlds, sizes, number, rate, done)


COMMANDS = {"make": Command(f"{__name__}:made", "make something"), "say": Command("builtins:print", "say", raw=True)}


def ran(capsys: pytest.CaptureFixture, *words: str) -> tuple[int, str, str]:
    code = run_commands("tool", "A tool.", COMMANDS, words)
    said = capsys.readouterr()
    return code, said.out, said.err


def test_options_are_the_parameters_of_a_function(capsys):
    assert ran(capsys, "make", "x") == (0, "x ['grid'] None 3 None False\n", "")
    words = "make x --worlds maze grid --sizes 1 2 --number=0 --rate .5 --done true"
    assert ran(capsys, *words.split()) == (0, "x ['maze', 'grid'] [1, 2] 0 0.5 True\n", "")
    assert ran(capsys, "say", "a", "--b-c") == (0, "['a', '--b_c']\n", "")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("make x --worlds grid cube", ["worlds", "maze", "cube"]),
        ("make x --sizes 1 0", ["sizes", "PositiveInt", "0"]),
        ("make x --rate fast", ["rate", "float", "fast"]),
        ("make x --size 3 --paint 2", ["--paint 2"]),
        ("make", ["required", "file"]),
        ("paint", ["'paint' is no command; there are make, say"]),
    ],
)
def test_a_wrong_option_is_one_line(words, named, capsys):
    code, out, said = ran(capsys, *words.split())
    assert (code, out, said.count("\n")) == (2, "", 1)
    assert all(word in said for word in named), said


def test_help_lists_commands_and_options(capsys):
    for words in ([], ["--help"]):
        code, out, _ = ran(capsys, *words)
        assert code == 0
        assert "make  make something" in out
    with pytest.raises(SystemExit) as ended:
        ran(capsys, "make", "--help")
    assert ended.value.code == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "usage: tool make" in out
    assert "In which worlds, one after another." in out


@pytest.mark.parametrize(("module", "after"), [("neuroprior", 0.15), ("eval", 0.3), ("train", 0.5)])
def test_ctrl_c_while_libraries_load(module, after):
    """It takes about two seconds until a command runs: no traceback before that either."""
    arguments = {"eval": ["plans", "none.csv"]}.get(module, ["fit", "--config", "none"])
    line = [sys.executable, "-c", LATE_INTERRUPT.format(after), sys.executable, "-m", module, *arguments]
    ended = subprocess.run(line, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout) == (130, ""), ended
    assert ended.stderr.startswith("interrupted")
    assert ended.stderr.count("\n") == 1


LATE_INTERRUPT = """
import signal, subprocess, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
running = subprocess.Popen(sys.argv[1:])
time.sleep({})
running.send_signal(signal.SIGINT)
sys.exit(running.wait())
"""
"""Tests may run where Ctrl-C is ignored, which processes inherit."""


@pytest.mark.parametrize(
    ("line", "is_one"),
    [
        ("python -m neuroprior fit", True),
        ("python /usr/bin/neuroprior report x.csv", True),
        ("python -W error -m eval paper", True),
        ("python mine.py", False),
        ("python", False),
        ("python -m", False),
        ("python -m pytest tests", False),
        ("python -c pass neuroprior", False),
    ],
)
def test_which_processes_end_at_once(line, is_one):
    assert is_command(line.split()) == is_one


def test_no_room_for_the_last_figure(tmp_path, capsys, monkeypatch):
    """The run fails with one line, and what was saved before stays."""
    plans, out = tmp_path / "plans.jsonl", tmp_path / "run"
    plans.write_text("\n".join('{"actions": [0, 1, 0, 1, 1]}' for _ in range(40)))

    def full(self, *_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", full)
    options = ["--config", "gru", "--prior.hidden_size", "4", "--max_steps", "10", "--out", str(out)]
    assert neuroprior_main(["fit", str(plans), *options]) == 2
    *progress, said = capsys.readouterr().err.splitlines()
    assert said.startswith("error: ")
    assert all(line.startswith("training: ") for line in progress)
    assert str(out / "learning_curve.png") in said
    assert not (out / "learning_curve.png").exists()
    assert json.loads((out / "metrics.json").read_text())["rows"]
    assert load(out).num_actions == 2


def test_the_version_is_an_option(capsys):
    assert neuroprior_main(["--version"]) == 0
    assert capsys.readouterr().out == f"neuroprior {__version__}\n"


def test_the_signal_of_a_cluster_is_answered_as_ctrl_c_is(capsys):
    before = signal.getsignal(signal.SIGTERM)

    def run(_):
        signal.raise_signal(signal.SIGTERM)

    ctrl_c = signal.getsignal(signal.SIGINT)
    try:
        assert run_program(run, []) == 130
    finally:
        signal.signal(signal.SIGINT, ctrl_c)
    assert capsys.readouterr().err == "interrupted; what was not yet written is lost\n"
    assert signal.getsignal(signal.SIGTERM) == before
