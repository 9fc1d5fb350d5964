"""What programs say and return when something goes wrong."""

import sys
from typing import Literal

import pytest
from jsonargparse.typing import NonNegativeInt, PositiveInt

from neuroprior.cli.program import Command, run_commands, run_program


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ValueError("what\n  was"), 2, "error: what was"),
        (FileNotFoundError(2, "No such file", "x"), 2, "error: [Errno 2] No such file: 'x'"),
        (ImportError("no module"), 2, "error: no module"),
        (MemoryError("too much"), 2, "error: too much"),
        (OverflowError("too large"), 2, "error: too large"),
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
    words = [
        "make",
        "x",
        "--worlds",
        "maze",
        "grid",
        "--sizes",
        "1",
        "2",
        "--number=0",
        "--rate",
        ".5",
        "--done",
        "true",
    ]
    assert ran(capsys, *words) == (0, "x ['maze', 'grid'] [1, 2] 0 0.5 True\n", "")
    assert ran(capsys, "say", "a", "--b-c") == (0, "['say', 'a', '--b_c']\n", "")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("make x --worlds cube", "error: worlds: one of grid, maze is expected, not cube"),
        ("make x --sizes 1 0", "error: sizes: an integer of at least 1 is expected, not 0"),
        ("make x --sizes 1.5", "error: sizes: an integer of at least 1 is expected, not 1.5"),
        ("make x --number -1", "error: number: an integer of at least 0 is expected, not -1"),
        ("make x --rate fast", "error: rate: a number is expected, not fast"),
        ("make x --done 3", "error: done: true or false is expected, not 3"),
        ("make x --size 3 --paint 2", "error: unrecognized arguments: --paint 2"),
        ("make", "error: the following arguments are required: file"),
        ("paint", "error: 'paint' is no command; there are make, say"),
    ],
)
def test_a_wrong_option_is_one_line(words, line, capsys):
    assert ran(capsys, *words.split()) == (2, "", line + "\n")


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
