"""Recordings: what was watched, windows, merging, time budgets, names, and the plans that they become."""

import numpy as np
import pandas as pd
import pytest

from neuroprior.behaviour import PermutationDesign, read
from neuroprior.behaviour.recordings import near_names
from tests.support.sources import refuses

TABLE = pd.DataFrame(
    [
        ("s1", "m1", "rest", 0.0, 4.0, "drug"),
        ("s1", "m1", "walk", 4.0, 5.0, "drug"),
        ("s1", "m1", None, 5.0, 8.0, "drug"),
        ("s1", "m1", "walk", 8.0, 9.5, "drug"),
        ("s1", "m1", "walk", 9.5, 12.0, "drug"),
        ("s2", "m1", "eat", 2.0, 3.0, "saline"),
        ("s1", "m2", "eat", 1.0, 2.0, "saline"),
        ("s1", "m2", "rest", 20.0, 26.0, "saline"),
    ],
    columns=["session", "animal", "behaviour", "start", "stop", "treatment"],
)


def test_what_was_watched_is_without_the_gaps():
    assert read(TABLE).watched.to_numpy().tolist() == [
        ["s1", "m1", 0.0, 5.0],
        ["s1", "m1", 8.0, 12.0],
        ["s2", "m1", 2.0, 3.0],
        ["s1", "m2", 1.0, 26.0],
    ]


def test_plans_are_fragments_with_recording_group_condition_and_times():
    plans = read(TABLE).plans(max_gap=10)
    assert plans.action_names == ("eat", "rest", "walk")
    assert [row[:n] for row, n in zip(plans.actions.tolist(), plans.lengths.tolist(), strict=True)] == [
        [1, 2],
        [2, 2],
        [0],
        [0],
        [1],
    ]
    assert plans.recording == ("s1", "s1", "s2", "s1", "s1")
    assert [plans.group_names[g] for g in plans.group.tolist()] == ["m1", "m1", "m1", "m2", "m2"]
    assert [plans.condition_names[c] for c in plans.condition.tolist()] == [
        "drug",
        "drug",
        "saline",
        "saline",
        "saline",
    ]
    assert plans.began[:, 0].tolist() == [0, 8, 2, 1, 20]
    assert plans.durations[1].tolist() == [1.5, 2.5]
    assert len(read(TABLE).plans()) == 4


def test_a_summary_lists_all_behaviours_and_the_first_events():
    many = pd.DataFrame({"animal": "m1", "behaviour": [f"b{n % 45:02d}" for n in range(90)], "start": range(90)})
    said = read(many).summary()
    assert all(f"b{n:02d} " in said for n in range(45))
    assert said.count("b00 ") > said.count("b44 ")


def test_time_budgets_are_shares_of_the_watched_time():
    budget = read(TABLE).time_budget()
    assert budget.loc["m1"].to_dict() == pytest.approx({"eat": 1 / 10, "rest": 4 / 10, "walk": 5 / 10})
    assert budget.loc["m2"].to_dict() == pytest.approx({"eat": 1 / 25, "rest": 6 / 25, "walk": 0})


def test_windows_cut_events_and_what_was_watched():
    part = read(TABLE, from_=4.5, to=9).events[["behaviour", "start", "stop"]].to_numpy().tolist()
    assert part == [["walk", 4.5, 5.0], ["walk", 8.0, 9.0]]
    watched = read(TABLE, from_=4.5, to=9).watched[["start", "stop"]].to_numpy().tolist()
    assert watched == [[4.5, 5.0], [8.0, 9.0], [4.5, 9.0]]
    with pytest.raises(ValueError, match="enclose events"):
        read(TABLE, from_=100)


def test_what_is_dropped_was_watched():
    left = read(TABLE, drop=["walk"])
    assert set(left.events["behaviour"]) == {"rest", "eat"}
    assert left.watched.equals(read(TABLE).watched)


def test_starts_alone_leave_stops_unknown_unless_the_next_ends_them():
    table = TABLE.drop(columns="stop")
    assert read(table).events["stop"].isna().all()
    stops = read(table, ends="next").events["stop"].to_numpy()
    np.testing.assert_array_equal(stops, [4, np.nan, 9.5, np.nan, np.nan, 20, np.nan])


@pytest.mark.parametrize(
    ("names", "due"),
    [
        (["Grooming", "Groming"], {"Grooming": ["Groming"], "Groming": ["Grooming"]}),
        (["sniff", "snif", "walk"], {"sniff": ["snif"], "snif": ["sniff"]}),
        (["Rear", "rear", "dig"], {"Rear": ["rear"], "rear": ["Rear"]}),
        (["rear up", "rear-up"], {"rear up": ["rear-up"], "rear-up": ["rear up"]}),
        (["form", "from"], {"form": ["from"], "from": ["form"]}),
        (["rest", "rise"], {}),
        (["eat", "fat"], {}),
        (["zone1", "zone2"], {}),
    ],
)
def test_names_that_are_nearly_equal(names, due):
    assert near_names(names) == due


def test_behaviours_say_what_is_odd():
    rows = [(f"m{i}", behaviour, t) for i in range(4) for t, behaviour in enumerate(["rest", "walk"] * 3)]
    rows += [("m1", "wlak", 9), ("m2", "dig", 9), ("m2", "dig", 10)]
    table = read(pd.DataFrame(rows, columns=["animal", "behaviour", "start"])).behaviours().set_index("behaviour")
    assert table["events"].to_dict() == {"rest": 12, "walk": 12, "dig": 2, "wlak": 1}
    assert table["subjects"].to_dict() == {"rest": 4, "walk": 4, "dig": 1, "wlak": 1}
    assert table["note"].to_dict() == {
        "rest": "",
        "walk": "like 'wlak'",
        "dig": "one subject only",
        "wlak": "like 'walk', rare, one subject only",
    }


def test_the_summary_says_what_was_read():
    said = read(TABLE).summary()
    for words in (
        "7 events of 3 behaviours, 3 recordings of 2 subjects",
        "35 units watched, 1 gaps",
        "1 of 8 rows have no label",
    ):
        assert words in said
    assert [line.split() for line in said.splitlines() if line.startswith("walk ")] == [["walk", "3", "1", "5"]]
    assert [line.split() for line in said.splitlines() if line.startswith("m1 ")] == [["m1", "1", "1"]]


def factor_table(rows):
    """Two recordings of each animal; `rows` are animal, treatment, sex, day of each."""
    names = ["animal", "treatment", "sex", "day"]
    events = [
        (*row, f"s{number}", behaviour, t, t + 1.0)
        for number, row in enumerate(rows)
        for t, behaviour in enumerate(["rest", "walk", "eat"])
    ]
    return pd.DataFrame(events, columns=[*names, "session", "behaviour", "start", "stop"])


BETWEEN = [
    *(("m1", "drug", "f", "1"), ("m1", "drug", "f", "2"), ("m2", "saline", "f", "1"), ("m2", "saline", "f", "2")),
    *(("m3", "saline", "m", "1"), ("m4", "drug", "m", "2"), ("m5", "drug", "m", "1")),
]
FACTORS = ["treatment", "sex", "day"]


def plans_by(rows, columns=FACTORS, **options):
    table = factor_table(rows)
    return read(table, columns={"behaviour": "behaviour", "factors": columns}).plans(**options)


def test_one_factor_is_compared_within_the_levels_of_others():
    plans = plans_by(BETWEEN, reference="saline")
    assert plans.condition_names == ("saline", "drug")
    assert plans.condition.tolist() == [1, 1, 0, 0, 0, 1, 1]
    assert plans.stratum_names == ("f", "m")
    assert plans.stratum.tolist() == [0, 0, 0, 0, 1, 1, 1]
    assert "'day' varies within a subject: 'treatment' is not compared within its levels" in plans.notes
    said = "of the factors treatment, sex, day, 'treatment' is compared within the levels of sex;"
    said += " --compare chooses another"
    assert said in plans.notes
    named = plans_by(BETWEEN, compare="treatment", reference="saline")
    assert said not in named.notes
    assert named.stratum.equal(plans.stratum)
    assert plans_by(BETWEEN, compare="treatment", strata=[]).stratum is None


def test_another_factor_may_be_compared_and_days_are_paired():
    plans = plans_by(BETWEEN, compare="day")
    assert plans.condition_names == ("1", "2")
    assert plans.condition.tolist() == [0, 1, 0, 1, 0, 1, 0]
    # Within subjects every subject is compared with itself, and both others are strata of subjects.
    assert plans.stratum_names == ("drug, f", "drug, m", "saline, f", "saline, m")
    design = PermutationDesign.of(plans)
    assert (design.kind, design.units.tolist(), design.left_out.tolist()) == ("within", [0, 1], [2, 3, 4])


def test_factors_that_would_leave_nothing_to_compare_are_no_strata():
    rows = [("m1", "drug", "f", "1"), ("m2", "saline", "m", "1"), ("m3", "drug", "f", "1")]
    plans = plans_by(rows)
    assert plans.stratum is None
    assert (
        "'sex' has a level with one level of 'treatment' alone: 'treatment' is not compared within its levels"
        in plans.notes
    )
    assert plans_by(rows, strata="sex").stratum.tolist() == [0, 1, 0]
    assert plans_by(rows, ["day", "treatment"]).condition_names == ("saline", "drug")


@pytest.mark.parametrize(
    ("levels", "ordered"),
    [
        (("high", "low", "Vehicle"), ("Vehicle", "high", "low")),
        (("KO", "WT", "het"), ("WT", "KO", "het")),
        (("drug", "saline", "sham"), ("drug", "saline", "sham")),
        (("drug", "saline solution", "uncontrolled"), ("drug", "saline solution", "uncontrolled")),
    ],
)
def test_the_only_level_with_the_name_of_a_control_is_the_reference(levels, ordered):
    rows = [(f"m{number}", levels[number % 3], "f", "1") for number in range(6)]
    assert plans_by(rows, ["treatment"]).condition_names == ordered
    assert plans_by(rows, ["treatment"], reference=levels[0]).condition_names[0] == levels[0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"compare": "dose"}, ("`compare` must be a factor of the recordings, treatment, sex, day, got 'dose'",)),
        ({"strata": ["dose"]}, ("`strata` must be a factor of the recordings, treatment, sex, day, got 'dose'",)),
        ({"strata": ["day"]}, ("`strata` must be known and constant for each subject, got 'day', which varies",)),
        ({"strata": ["treatment"]}, ("`strata` must be other factors", "'treatment'")),
        ({"reference": "vehicle"}, ("`reference` must be one of drug, saline, got 'vehicle'",)),
    ],
)
def test_wrong_designs_are_refused(options, words):
    with refuses(*words):
        plans_by(BETWEEN, **options)
