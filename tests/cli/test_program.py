"""What programs say and return when something goes wrong."""

import sys

import pytest

from neuroprior.cli.program import run_program


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
