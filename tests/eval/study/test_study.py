"""`python -m eval study`, small."""

import json
from types import SimpleNamespace

import pytest

from eval.__main__ import main
from eval.study import command

pytestmark = pytest.mark.usefixtures("undrawn")


def test_studies_with_and_without_an_effect(tmp_path, capsys):
    out = tmp_path / "study"
    arguments = ["study", "--studies", "2", "--with-effect", "2", "--seed", "0", "--processes", "1", "--out", str(out)]
    assert main(arguments) == 0
    found = json.loads((out / "results.json").read_text())
    assert {row["design"] for row in found["rows"]} == {"between", "within"}
    assert {row["sessions_alike"] for row in found["rows"]} == {True, False}
    assert all(row["studies"] == 2 for row in found["rows"])
    assert len(found["rows"]) == 4 * 7
    by_feature = {(row["design"], row["feature"]): row for row in found["features"]}
    # Both changed transitions and the changed duration are large enough to be found in both of these.
    for feature in ("durations: rest", "transitions: rear groom"):
        assert by_feature["within", feature]["found"] == 2
    assert by_feature["within", "any other transition or duration"]["planted"] is False
    assert "False alarms" in capsys.readouterr().out
    (kept,) = (out / "jobs").iterdir()
    changed = {path.name: path.stat().st_mtime_ns for path in kept.glob("*.json")}
    assert main(arguments) == 0
    assert changed == {path.name: path.stat().st_mtime_ns for path in kept.glob("*.json")}


@pytest.mark.parametrize(("effect", "number", "seeds"), [(True, 0, [5, 6]), (False, 0, range(5, 15)), (False, 1, [15])])
def test_each_study_has_a_seed_of_its_own(effect, number, seeds, monkeypatch):
    """Eleven studies without an effect, two with one, from seed 5."""
    done = SimpleNamespace(tests={"actions": (0.1, 0.2)}, p_value=0.3, families=[])
    drawn = []
    monkeypatch.setattr(
        command, "compare_conditions", lambda plans, generator: drawn.append(generator.initial_seed()) or done
    )
    rows = command.compared({"studies": 11, "with_effect": 2, "seed": 5}, command.Batch(effect, True, False, number))
    assert drawn == list(seeds)
    both = [("actions", 0.1, 0.2), ("all together", 0.3, 0.3)]
    assert [tuple(row.values()) for row in rows] == [("test", seed, *one) for seed in seeds for one in both]


def test_bad_numbers(tmp_path, capsys):
    assert main(["study", "--studies", "0", "--out", str(tmp_path)]) == 2
    assert "studies" in capsys.readouterr().err
