"""Recordings: what was watched, windows, merging, time budgets, names, and the plans that they become."""

import numpy as np
import pandas as pd
import pytest

from neuroprior.behaviour import read
from neuroprior.behaviour.recordings import near_names

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


def test_merging_dropping_and_renaming():
    merged = read(TABLE, merge_repeats=True)
    assert merged.events.loc[merged.events["behaviour"] == "walk", ["start", "stop"]].to_numpy().tolist() == [
        [4, 5],
        [8, 12],
    ]
    left = read(TABLE, drop=["walk"])
    assert set(left.events["behaviour"]) == {"rest", "eat"}
    assert left.watched.equals(read(TABLE).watched)
    assert set(read(TABLE, rename={"walk": "move", "eat": "feed"}).events["behaviour"]) == {"rest", "move", "feed"}


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
