"""`python -m eval study`, small."""

import json
from types import SimpleNamespace

import pytest

from eval.__main__ import main
from eval.study import command
from neuroprior.behaviour import read

pytestmark = pytest.mark.usefixtures("undrawn")


def test_studies_with_and_without_an_effect(tmp_path, capsys):
    out = tmp_path / "study"
    arguments = ["study", "--studies", "2", "--with-effect", "2", "--permutations", "199", "--actions", "150"]
    arguments += ["--seed", "0", "--processes", "1", "--out", str(out)]
    assert main(arguments) == 0
    found = json.loads((out / "results.json").read_text())
    assert {row["design"] for row in found["rows"]} == {*command.DESIGNS}
    assert all(row["studies"] == 2 for row in found["rows"])
    assert len(found["rows"]) == 8 * len(command.DESIGNS) + 1
    levels = {row["design"]: row["level"] for row in found["rows"] if row["test"] == "actions"}
    # Nine of 200 random labellings are less than 5 %.
    assert [*levels.values()] == pytest.approx([0.045] * len(levels))
    assert all(row["power_low"] <= row["power"] <= row["power_high"] for row in found["rows"])
    by_feature = {(row["design"], row["feature"]): row for row in found["features"]}
    # Both changed transitions and the changed duration are large enough to be found in both of these.
    for feature in ("durations: rest", "transitions: rear groom"):
        assert by_feature["12 against 12", feature]["found"] == 2
    assert by_feature["8 paired", "any other transition or duration"]["planted"] is False
    assert "False alarms" in capsys.readouterr().out
    (kept,) = (out / "jobs").iterdir()
    changed = {path.name: path.stat().st_mtime_ns for path in kept.glob("*.json")}
    assert main(arguments) == 0
    assert changed == {path.name: path.stat().st_mtime_ns for path in kept.glob("*.json")}


@pytest.mark.parametrize(("effect", "number", "seeds"), [(True, 0, [5, 6]), (False, 0, range(5, 15)), (False, 1, [15])])
def test_each_study_has_a_seed_of_its_own(effect, number, seeds, monkeypatch):
    """Eleven studies without an effect, two with one, from seed 5."""
    done = SimpleNamespace(
        tests={"actions": (0.1, 0.2)}, p_value=0.3, families=[], interaction=None, smallest_p=2 / 924
    )
    drawn = []
    monkeypatch.setattr(
        command, "compare_conditions", lambda plans, number, generator: drawn.append(generator.initial_seed()) or done
    )
    numbers = {"studies": 11, "with_effect": 2, "seed": 5, "actions": 10, "permutations": 99}
    rows = command.compared(numbers, command.Batch("8 paired", effect, number))
    assert drawn == list(seeds)
    each = [("actions", 0.1, 0.2), ("all together", 0.3, 0.3), ("any star", 1.0, 1.0)]
    level = pytest.approx(46 / 924)
    assert [tuple(row.values()) for row in rows] == [("test", seed, level, *one) for seed in seeds for one in each]


@pytest.mark.parametrize("options", [{}, {"within": True}, {"sex_effect": 0.5, "unequal": 10.0, "animals": 5}])
def test_recordings_are_those_that_are_read(options):
    events = command.simulated_study(1, actions=80, **options)
    whole, quick = (one.plans(compare="treatment") for one in (read(events), command.recordings_of(events)))
    assert whole.recording == quick.recording
    for name in ("actions", "lengths", "group", "condition", "stratum", "durations", "began"):
        first, second = getattr(whole, name), getattr(quick, name)
        assert (first is None and second is None) or first.nan_to_num().equal(second.nan_to_num())


def test_bad_numbers(tmp_path, capsys):
    assert main(["study", "--studies", "0", "--out", str(tmp_path)]) == 2
    assert "studies" in capsys.readouterr().err
