"""`python -m eval study`, small."""

import json
from types import SimpleNamespace

import pandas as pd
import pytest

from eval.__main__ import main
from eval.study import calibration, command
from eval.study.time_tests import SOURCES, timed_study
from neuroprior.behaviour import read

pytestmark = pytest.mark.usefixtures("undrawn")


def test_studies_with_and_without_an_effect(tmp_path, capsys):
    out = tmp_path / "study"
    arguments = [
        "study",
        "--studies",
        "2",
        "--with-effect",
        "2",
        "--time-studies",
        "2",
        "--permutations",
        "199",
        "--actions",
        "150",
    ]
    arguments += ["--seed", "0", "--processes", "1", "--out", str(out)]
    assert main(arguments) == 0
    found = json.loads((out / "results.json").read_text())
    assert {row["design"] for row in found["rows"]} == {*command.DESIGNS}
    assert all(row["studies"] == 2 for row in found["rows"])
    assert len(found["rows"]) == 8 * len(command.DESIGNS) + 1
    levels = {row["design"]: row["level"] for row in found["rows"] if row["test"] == "behaviours"}
    # Nine of 200 random labellings are less than 5 %.
    assert [*levels.values()] == pytest.approx([0.045] * len(levels))
    assert all(row["power_low"] <= row["power"] <= row["power_high"] for row in found["rows"])
    by_feature = {(row["design"], row["feature"]): row for row in found["features"]}
    # Both changed transitions and the changed duration are large enough to be found in both of these.
    for feature in ("durations: rest", "transitions: rear groom"):
        assert by_feature["12 against 12", feature]["found"] == 2
    assert by_feature["8 paired", "any other transition or duration"]["planted"] is False
    time = {(row["source"], row["test"]): row for row in found["time"]}
    assert {*time} == {(source, test) for source, kinds in SOURCES.items() for test in kinds}
    # A doubled median of resting is found in both of 12 animals with 150 behaviours in each session.
    assert time["rest lasts longer", "survival, rest"]["starred"] == 1
    assert "False alarms" in capsys.readouterr().out
    (kept,) = (out / "jobs").iterdir()
    changed = {path.name: path.stat().st_mtime_ns for path in kept.glob("*.json")}
    assert main(arguments) == 0
    assert changed == {path.name: path.stat().st_mtime_ns for path in kept.glob("*.json")}


@pytest.mark.parametrize(("effect", "number", "seeds"), [(True, 0, [5, 6]), (False, 0, range(5, 15)), (False, 1, [15])])
def test_each_study_has_a_seed_of_its_own(effect, number, seeds, monkeypatch):
    """Eleven studies without an effect, two with one, from seed 5."""
    done = SimpleNamespace(
        tests={"behaviours": (0.1, 0.2)}, p_value=0.3, families=[], interaction=None, smallest_p=2 / 924
    )
    drawn = []
    monkeypatch.setattr(
        command, "compare_conditions", lambda plans, number, generator: drawn.append(generator.initial_seed()) or done
    )
    numbers = {"studies": 11, "with_effect": 2, "seed": 5, "actions": 10, "permutations": 99}
    rows = command.compared(numbers, command.Batch("8 paired", effect, number))
    assert drawn == list(seeds)
    each = [("behaviours", 0.1, 0.2), ("all together", 0.3, 0.3), ("any star", 1.0, 1.0)]
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


def test_studies_of_time_are_what_they_say():
    """Over 40 studies sniffing fades, grooming follows the ritual, resting lasts twice as long under the drug."""

    def many(source):
        tables = [timed_study(seed, source, 100).assign(seed=seed) for seed in range(40)]
        return pd.concat(tables, ignore_index=True)

    fading = many("sniff fades")
    third = fading.groupby(["seed", "animal", "session"]).cumcount() // 34
    shares = (fading.behaviour == "sniff").groupby(third).mean()
    # From the first third to the last the odds fall by e^(0.4 * 2 / 3), and with them the share by a fifth.
    assert shares[2] / shares[0] == pytest.approx(0.79, abs=0.05)
    for source, share in (("order 1", 1 / 5), ("one ritual", 6 / 10)):
        study = many(source)
        there = (study.behaviour.shift(2) == "eat") & (study.behaviour.shift(1) == "drink") & study.behaviour.notna()
        there &= study.groupby(["seed", "animal", "session"]).cumcount() > 1
        assert (study.behaviour[there] == "groom").mean() == pytest.approx(share, abs=0.06)
        assert study.behaviour.isna().mean() == pytest.approx(0.05, abs=0.005)
    study = many("rest lasts longer")
    lasts = (study.stop - study.start).groupby([study.behaviour, study.treatment]).median().unstack()
    assert lasts.drug["rest"] / lasts.saline["rest"] == pytest.approx(2, rel=0.1)
    assert lasts.drug["walk"] / lasts.saline["walk"] == pytest.approx(1, rel=0.1)


def test_calibration_counts_what_is_missed(tmp_path, monkeypatch, capsys):
    """Small designs: shares are of all their studies."""
    small = {"8 subjects": calibration.Design(8, ratio=3.0), "hidden modes": calibration.Design(7, modes=True)}
    for name, value in {"DESIGNS": small, "TOGETHER": 2, "MANY": 9, "REPEATED": 2}.items():
        monkeypatch.setattr(calibration, name, value)
    options = ["calibration", "--studies", "3", "--permutations", "99", "--processes", "1", "--out", str(tmp_path)]
    assert main(options) == 0
    rows = pd.read_csv(tmp_path / "shares.csv")
    assert {*rows["design"]} == {*small}
    assert {*rows["studies"]} <= {1, 2, 3, 4}  # rounded up; fewer where nothing can be tested
    assert (rows["low"] <= rows["share"]).all()
    assert (rows["share"] <= rows["high"]).all()
    known = rows.set_index(["kind", "name", "effect", "design"]).sort_index()["share"]
    assert known["interval", "bits of a chain"].max() > 0
    assert "Tests without an effect" in capsys.readouterr().out


@pytest.mark.parametrize("effect", [False, True])
def test_designs_are_as_they_say(effect):
    """Lengths within and between subjects, repeats, and what the treatment changes."""
    plans = calibration.draw_study(calibration.Design(60, ratio=10.0, treated_ratio=4.0, repeats=0.8), effect, 3)
    treated, lengths = plans.condition.bool(), plans.lengths.double()
    assert int(treated.sum()) == 40  # a third of 60 subjects, two sessions each
    assert 3 < float(lengths[~treated].mean() / lengths[treated].mean()) < 5
    assert lengths[~treated].max() > 5 * lengths[~treated].min()
    first, second = plans.actions[:, :-1], plans.actions[:, 1:]
    mask = plans.mask()[:, 1:]
    assert 0.8 < float((first == second)[mask].double().mean()) < 0.9
    longer = [
        plans.durations[(plans.actions == 1) & plans.mask() & one[:, None]].log().mean() for one in (~treated, treated)
    ]
    assert float(longer[1] - longer[0]) == pytest.approx(calibration.EFFECT * effect, abs=0.25)
