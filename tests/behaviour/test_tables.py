"""Tables of events: from a frame, and from files as laboratories export them."""

import datetime

import numpy as np
import pandas as pd
import pytest
import torch

from neuroprior import Plans
from neuroprior.plans import read_plans, write_plans
from tests.support.sources import refuses

LAB = """animal,session,behaviour,t,seconds,drug,observer,arena
m1,1,walk,0.0,1.5,saline,AB,A
m1,1,Rear,1.5,0.5,saline,AB,A
m1,1,,2.0,3.0,saline,AB,A
m1,1,walk,5.0,1.0,saline,AB,B
m1,2,rear,0.0,2.0,saline,AB,A
m2,1,walk,3.0,1.0,drug,CD,A
m2,1,groom,0.0,,drug,CD,B
"""
COLUMNS = {"action": "behaviour", "plan": "session", "group": "animal", "condition": "drug", "context": "arena"}


def read(tmp_path, text, name="lab.csv", **options):
    (tmp_path / name).write_text(text)
    return read_plans(tmp_path / name, **options)


def listed(plans):
    """The actions of each plan, by name."""
    lengths = plans.mask().sum(1).tolist()
    names = plans.action_names or range(plans.num_actions)
    return [[names[a] for a in row[:n]] for row, n in zip(plans.actions.tolist(), lengths, strict=True)]


def test_a_table_of_a_laboratory(tmp_path):
    plans = read(tmp_path, LAB, columns=COLUMNS | {"start": "t", "duration": "seconds"})
    assert listed(plans) == [["walk", "Rear"], ["walk"], ["rear"], ["groom", "walk"]]
    assert [plans.group_names[g] for g in plans.group] == ["m1", "m1", "m1", "m2"]
    assert [plans.condition_names[c] for c in plans.condition] == ["saline"] * 3 + ["drug"]
    assert [[plans.context_names[c] for c in row[:n]] for row, n in zip(plans.context, plans.lengths, strict=True)] == [
        ["A", "A"],
        ["B"],
        ["A"],
        ["B", "A"],
    ]
    known = torch.tensor([[1.5, 0.5], [1.0, 0], [2.0, 0], [torch.nan, 1.0]])
    assert torch.equal(plans.durations.nan_to_num(-1), known.nan_to_num(-1))
    assert list(plans.notes) == [
        "rows are put in the order of their start",
        "actions 'Rear' and 'rear' are nearly the same; rename them if they mean the same",
        "1 rows have no label",
        "1 gaps end a plan, and the next begins after each",
        "the durations of 1 of 6 actions are not known",
        "columns that are not used: observer",
    ]


def test_a_frame_is_read_as_its_file(tmp_path):
    file = read(tmp_path, LAB, columns=COLUMNS | {"start": "t", "duration": "seconds"})
    frame = Plans.from_dataframe(pd.read_csv(tmp_path / "lab.csv"), start="t", duration="seconds", **COLUMNS)
    assert listed(frame) == listed(file)
    for what in ("group", "condition", "context", "lengths"):
        assert torch.equal(getattr(frame, what), getattr(file, what))
    assert frame.notes == file.notes


@pytest.mark.parametrize(
    ("options", "actions", "num_actions"),
    [
        ({}, [["a", "b"], ["c", "c"]], 3),
        ({"max_gap": 0}, [["a", "b"], ["c"], ["c"]], 3),
        ({"merge_repeats": True}, [["a", "b"], ["c"]], 3),
        ({"missing": "label"}, [["a", "b"], ["c", "missing", "c"]], 4),
        ({"missing": "label", "merge_repeats": True, "max_gap": 2}, [["a", "b"], ["c", "missing", "c"]], 4),
        ({"action_names": ["z", "c", "b", "a"]}, [["a", "b"], ["c", "c"]], 4),
    ],
)
def test_options_mean_the_same_for_files_and_frames(tmp_path, options, actions, num_actions):
    text = "plan,action,start,stop\n1,a,0,1\n1,b,1,2\n2,c,0,1\n2,,1,1.5\n2,c,1.5,2\n"
    if "missing" not in options:
        text = text.replace("2,,1,1.5\n", "")
    file = read(tmp_path, text, **options)
    frame = Plans.from_dataframe(pd.read_csv(tmp_path / "lab.csv"), **options)
    for plans in (file, frame):
        assert listed(plans) == actions
        assert plans.num_actions == num_actions
        assert list(plans.action_names) == options.get("action_names", sorted({a for row in actions for a in row}))


def test_numbers_are_read_as_pandas_writes_them():
    """Whole numbers become floating point where one of them is missing; a context of them is an index."""
    frame = pd.DataFrame({"action": [2.0, np.nan, 0.0], "context": [1.0, 3.0, 0.0], "group": [7.0, 7.0, 7.0]})
    plans = Plans.from_dataframe(frame)
    assert listed(plans) == [[2], [0]]
    assert plans.context.tolist() == [[1], [0]]
    assert plans.group.tolist() == [7, 7]
    numbers = Plans.from_dataframe(pd.DataFrame({"action": [0, 1]}), num_actions=5)
    assert (numbers.num_actions, numbers.notes) == (5, ())


@pytest.mark.parametrize("word", ["", "NaN", "NA", "N/A", "null", "?", "-", " nan "])
def test_a_missing_label_is_no_behaviour(tmp_path, word):
    text = f"plan,action\n1,a\n1,{word}\n1,{word}\n1,b\n2,b\n2,{word}\n"
    plans = read(tmp_path, text)
    assert listed(plans) == [["a"], ["b"], ["b"]]
    assert plans.group.tolist() == [0, 0, 1]  # what a gap parts is not independent
    assert "1 gaps end a plan, and the next begins after each" in plans.notes
    assert listed(read(tmp_path, text, missing="label")) == [["a", "missing", "missing", "b"], ["b", "missing"]]
    with refuses("lab.csv, line 3", "no label"):
        read(tmp_path, text, missing="error")


def test_a_number_in_two_spellings_is_noted(tmp_path):
    plans = read(tmp_path, "group,plan,action\n01,a,x\n1,b,y\n01,c,y\n2,d,x\n")
    assert plans.group.tolist() == [1, 1, 1, 2]
    assert plans.notes == ("groups '01' and '1' are the same number, and count as the same",)
    assert "actions '007' and '7'" in " ".join(read(tmp_path, "plan,action\na,007\na,7\nb,8\n").notes)
    # Among names they are names.
    plans = read(tmp_path, "group,plan,action\n01,a,x\n1,b,y\nz,c,y\n")
    assert plans.group_names == ("01", "1", "z")
    assert plans.notes == ()


def test_missing_values_of_pandas():
    frame = pd.DataFrame({"action": ["a", None, "b", np.nan, pd.NA, "c"]})
    plans = Plans.from_dataframe(frame)
    assert listed(plans) == [["a"], ["b"], ["c"]]
    categories = Plans.from_dataframe(frame.astype("category"))
    assert listed(categories) == [["a"], ["b"], ["c"]]


def test_a_pause_ends_a_plan(tmp_path):
    text = "action,start,stop\na,0,5\nb,1,2\nc,6,7\nd,9,10\n"
    assert listed(read(tmp_path, text, max_gap=1.5)) == [["a", "b", "c"], ["d"]]
    assert listed(read(tmp_path, text, max_gap=2)) == [["a", "b", "c", "d"]]
    # The end of an action of another plan does not count, and an unknown end as the beginning.
    assert listed(read(tmp_path, "plan,action,start,stop\n1,a,0,99\n2,b,0,1\n2,c,5,6\n", max_gap=1)) == [
        ["a"],
        ["b"],
        ["c"],
    ]
    assert listed(read(tmp_path, "action,start,stop\na,0,1\nb,2,\nc,10,11\n", max_gap=5)) == [["a", "b"], ["c"]]
    # It has not ended before it began: 12 - 9 is no gap, and 1,000 - 0 is one, in a plan's first action as in others.
    text = "action,start,stop\na,0,1\nb,9,\nc,12,13\nd,500,\ne,1000,1001\n"
    plans = read(tmp_path, text, max_gap=10)
    assert listed(plans) == [["a", "b", "c"], ["d"], ["e"]]
    assert any("2 actions without an end" in note for note in plans.notes)
    assert listed(read(tmp_path, "action,start,stop\na,0,\nb,1000,1001\n", max_gap=10)) == [["a"], ["b"]]
    with refuses("max_gap", "start"):
        read(tmp_path, "plan,action\n1,a\n", max_gap=1)


def test_durations_from_starts_alone(tmp_path):
    plans = read(tmp_path, "plan,action,start\n1,a,0\n1,b,2\n1,,3\n1,a,7\n2,a,1\n")
    assert listed(plans) == [["a", "b"], ["a"], ["a"]]
    assert plans.durations.tolist()[0] == [2, 1]
    assert plans.durations[1:, 0].isnan().all()


@pytest.mark.parametrize(
    "times",
    [
        ["0", "1.5", "61.5"],
        ["00:00:00", "00:00:01.5", "00:01:01.5"],
        ["2020-01-01 10:00:00.0", "2020-01-01 10:00:01.5", "2020-01-01 10:01:01.5"],
    ],
)
def test_times_are_numbers_clocks_or_dates(times):
    plans = Plans.from_dataframe(pd.DataFrame({"action": ["a", "b", "a"], "start": times}))
    assert plans.durations[0, :2].tolist() == [1.5, 60]
    if "-" in times[0]:
        stamps = Plans.from_dataframe(pd.DataFrame({"action": ["a", "b", "a"], "start": pd.to_datetime(times)}))
        assert stamps.durations[0, :2].tolist() == [1.5, 60]


@pytest.mark.parametrize("convert", [list, pd.to_datetime])
def test_dates_of_starts_and_stops_count_from_the_same_one(convert):
    def days(*numbers):
        return convert([f"2020-01-0{number} 23:59:59.5" for number in numbers])

    frame = pd.DataFrame({"action": ["b", "a"], "start": days(2, 1), "stop": days(4, 2)})
    assert Plans.from_dataframe(frame).durations.tolist() == [[86400, 2 * 86400]]
    assert listed(Plans.from_dataframe(frame, max_gap=0)) == [["a", "b"]]
    frame["stop"] = pd.to_datetime(frame["stop"]).dt.tz_localize("UTC")
    frame["start"] = pd.to_datetime(frame["start"])
    with refuses("stop", "time zone"):
        Plans.from_dataframe(frame)
    texts = frame.assign(start=frame["start"].astype(str), stop=[f"2020-01-0{day}T23:59:59.5+02:00" for day in (4, 2)])
    with refuses("stop", "time zone"):
        Plans.from_dataframe(texts)
    frame["start"] = frame["start"].dt.tz_localize("Europe/Helsinki")
    assert Plans.from_dataframe(frame).durations.tolist() == [[86400 + 7200, 2 * 86400 + 7200]]


def test_frames_are_merged_to_actions():
    frame = pd.DataFrame({"name": list("xxxxxxyy"), "syllable": [3, 3, 0, 0, 0, 3, 3, 3]})
    plans = Plans.from_dataframe(frame, plan="name", action="syllable", merge_repeats=True)
    assert listed(plans) == [[3, 0, 3], [3]]
    assert plans.durations.tolist() == [[2, 3, 1], [2, 0, 0]]
    assert "actions are numbers from 0 to 3, of which 1, 2 never occur" in plans.notes
    notes = Plans.from_dataframe(pd.DataFrame({"action": [0, 10]})).notes
    assert "actions are numbers from 0 to 10, of which 1, 2, 3, 4, 5, 6, 7, 8 and 1 more never occur" in notes
    timed = Plans.from_dataframe(frame.assign(duration=0.5), plan="name", action="syllable", merge_repeats=True)
    assert timed.durations.tolist() == [[1, 1.5, 0.5], [1, 0, 0]]


def test_what_a_gap_parts_is_not_merged():
    frame = pd.DataFrame({"plan": [1, 1, 1, 1, 1, 2], "action": ["a", "a", None, "a", "b", "b"]})
    plans = Plans.from_dataframe(frame, merge_repeats=True)
    assert listed(plans) == [["a"], ["a", "b"], ["b"]]
    assert plans.durations.tolist() == [[2, 0], [1, 1], [1, 0]]
    assert plans.group.tolist() == [0, 0, 1]


def test_features_of_several_columns():
    frame = pd.DataFrame({"action": list("ab"), "speed": [1, 2.5], "turn": ["0", "-1"]})
    plans = Plans.from_dataframe(frame, context=["speed", "turn"])
    assert plans.context.tolist() == [[[1, 0], [2.5, -1]]]
    assert Plans.from_dataframe(frame, context="speed").context.tolist() == [[[1], [2.5]]]


def test_commas_in_a_header_do_not_part_it(tmp_path):
    plans = read(tmp_path, "plan;action;what, when, where, how\n1;x;0\n1;y;0\n")
    assert listed(plans) == [["x", "y"]]
    assert "columns that are not used: what, when, where, how" in plans.notes


def test_the_same_plan_name_in_two_groups_is_two_plans(tmp_path):
    plans = read(tmp_path, "group,plan,action\nm1,1,a\nm2,1,b\n")
    assert listed(plans) == [["a"], ["b"]]
    assert listed(read(tmp_path, "group,action\nm1,a\nm1,b\nm2,b\n", columns={"action": "action"})) == [
        ["a", "b"],
        ["b"],
    ]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"columns": {"action": "act"}}, ["columns.action", "'act'", "session, behaviour"]),
        ({"columns": {"acts": "behaviour"}}, ["columns", "acts"]),
        ({"columns": {"action": "behaviour", "plan": "behaviour"}}, ["'behaviour'", "action and plan"]),
        ({"columns": {"plan": "session"}}, ["no column 'action'", "columns.action"]),
        ({"columns": {"action": "behaviour", "plan": "animal", "condition": "session"}}, ["line 6", "condition"]),
        ({"columns": {"action": "behaviour", "plan": "session"}}, ["line 7", "goes on after another plan"]),
        ({"columns": {"action": "behaviour", "start": "drug"}}, ["line 2", "start 'saline'", "time"]),
        ({"columns": {"action": "behaviour", "duration": "animal"}}, ["line 2", "'m1'"]),
        ({"columns": {"action": "behaviour", "stop": "t"}}, ["columns.stop", "start"]),
        ({"columns": {"action": "behaviour", "start": "seconds"}}, ["line 8", "start: an empty cell"]),
        ({"columns": {"action": "behaviour", "start": "t", "stop": "seconds"}}, ["line 3", "stop", "-1"]),
        ({"columns": {"action": "behaviour"}, "missing": "drop"}, ["missing", "gap, label, error"]),
        ({"columns": {"action": "behaviour"}, "max_gap": -1}, ["max_gap", "-1"]),
        ({"columns": {"action": "seconds"}}, ["line 2", "'1.5' is not a whole number"]),
    ],
)
def test_bad_tables_are_one_line(tmp_path, options, words):
    text = LAB.replace("m1,2,rear,0.0,2.0", "m1,1,rear,6.0,2.0") if "plan" not in options["columns"] else LAB
    text = text + "m1,1,walk,9,1,saline,AB,A\n" if options["columns"].get("plan") == "session" else text
    with refuses(*words):
        read(tmp_path, text, **options)


@pytest.mark.parametrize("name", ["a.jsonl", "a.npz"])
def test_columns_are_for_tables(tmp_path, name):
    with refuses("columns", "CSV"):
        read(tmp_path, "x", name, columns={"action": "b"})


def test_durations_and_conditions_stay_with_their_plans():
    plans = Plans(
        torch.tensor([[0, 1], [1, 0]]),
        2,
        torch.tensor([2, 1]),
        durations=torch.tensor([[1.0, 2], [3, 9]]),
        condition=torch.tensor([0, 1]),
        condition_names=("wild", "mutant"),
    )
    assert plans.durations.tolist() == [[1, 2], [3, 0]]
    assert plans[1:].durations.tolist() == [[3, 0]]
    assert plans[torch.tensor([1])].condition.tolist() == [1]
    closed = plans.with_end()
    assert closed.durations.tolist() == [[1, 2, 0], [3, 0, 0]]
    assert closed.without_end().durations.tolist() == [[1, 2], [3, 0]]
    first, last = plans[:1].split(0.5)
    assert (first.durations.tolist(), last.durations.tolist()) == ([[1]], [[2]])
    for wrong in (torch.tensor([[1.0, -1], [1, 1]]), torch.tensor([[1.0, torch.inf], [1, 1]])):
        with refuses("durations[0, 1]"):
            Plans(plans.actions, 2, durations=wrong)
    with refuses("`durations` must have shape"):
        Plans(plans.actions, 2, durations=torch.ones(2))
    with refuses("condition"):
        Plans(plans.actions, 2, condition=torch.tensor([0.5, 1]))


BORIS = """\
Observation id,Description,Subject,Behavior,Behavioral category,Behavior type,Start (s),Stop (s),Duration (s)
day1,,mouse 1,walk,move,STATE,0.5,2.5,2.0
day1,,mouse 1,rear,move,POINT,2.5,2.5,NA
day1,,mouse 2,groom,self,STATE,1.0,4.0,3.0
day1,,mouse 1,groom,self,STATE,3.0,4.5,1.5
"""


def test_aggregated_events_of_boris(tmp_path):
    columns = {"plan": "Observation id", "group": "Subject", "action": "Behavior"}
    plans = read(tmp_path, BORIS, columns=columns | {"start": "Start (s)", "stop": "Stop (s)"})
    assert listed(plans) == [["walk", "rear", "groom"], ["groom"]]
    assert plans.group_names == ("mouse 1", "mouse 2")
    assert plans.durations.tolist() == [[2, 0, 1.5], [3, 0, 0]]


MOSEQ = """name,centroid_x,centroid_y,heading,angular_velocity,velocity_px_s,syllable,frame_index,group,onset
21_11_8_one,10.1,5.2,0.1,0.0,0.0,3,0,wild,False
21_11_8_one,10.2,5.2,0.1,0.0,1.0,3,1,wild,False
21_11_8_one,10.2,5.3,0.2,0.1,1.0,0,2,wild,True
21_12_2_two,3.0,4.0,1.1,0.0,0.0,0,0,mutant,False
21_12_2_two,3.0,4.1,1.2,0.0,0.2,1,1,mutant,True
21_12_2_two,3.0,4.1,1.2,0.0,0.2,1,2,mutant,False
"""


TABULAR = """Observation id,Subject,Behavior,Behavior type,Time,Media file
ob1,ann,dig,START,0.5,a.mp4
ob1,ben,dig,START,1.0,a.mp4
ob1,ann,call,POINT,2.0,a.mp4
ob1,ann,dig,STOP,2.5,a.mp4
ob1,ann,eat,START,2.5,a.mp4
ob1,ben,dig,STOP,4.0,a.mp4
ob1,ann,eat,STOP,3.0,a.mp4
ob1,ann,dig,START,3.0,a.mp4
"""
OF_TABULAR = {"plan": "Observation id", "group": "Subject", "action": "Behavior", "start": "Time"}
OF_TABULAR |= {"event_type": "Behavior type"}


def test_tabular_events_of_boris(tmp_path):
    plans = read(tmp_path, TABULAR, columns=OF_TABULAR)
    assert listed(plans) == [["dig", "call", "eat", "dig"], ["dig"]]
    assert plans.durations[0].tolist()[:3] == [2.0, 0.0, 0.5]
    assert plans.durations[0, 3].isnan()
    assert plans.durations[1, 0] == 3.0
    assert "1 actions have a START and no STOP" in plans.notes
    assert "columns that are not used: Media file" in plans.notes
    frame = Plans.from_dataframe(pd.read_csv(tmp_path / "lab.csv"), **OF_TABULAR)
    assert listed(frame) == listed(plans)


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (("ob1,ann,dig,STOP,2.5", "ob1,ann,dig,START,2.5"), {}, ["line 5", "'dig'", "START, and no STOP"]),
        (("ob1,ann,eat,START,2.5", "ob1,ann,eat,STOP,2.5"), {}, ["line 6", "'eat'", "STOP without a START"]),
        (("POINT", "BEGIN"), {}, ["line 4", "event_type", "START, STOP, POINT", "BEGIN"]),
        (("", ""), {"start": None}, ["columns.event_type", "columns.start"]),
        (("", ""), {"stop": "Media file"}, ["columns.stop", "leave it out"]),
        (("", ""), {"group": None}, ["line 3", "columns.group"]),
    ],
)
def test_bad_tabular_events(tmp_path, change, options, words):
    with refuses(*words):
        read(tmp_path, TABULAR.replace(*change) if change[0] else TABULAR, columns=OF_TABULAR | options)


def test_missing_labels_with_one_plan_a_row(tmp_path):
    text = "action_1,action_2,action_3,action_4,group,context\na,b,NA,a,x,0\nb,,,,x,1\na,,b,,y,2\n"
    plans = read(tmp_path, text)
    assert listed(plans) == [["a", "b"], ["a"], ["b"], ["a"], ["b"]]
    assert [plans.group_names[g] for g in plans.group] == ["x", "x", "x", "y", "y"]
    assert plans.context[:, 0].tolist() == [0, 0, 1, 2, 2]
    assert "2 gaps end a plan, and the next begins after each" in plans.notes
    whole = read(tmp_path, text, missing="label")
    assert listed(whole) == [["a", "b", "missing", "a"], ["b"], ["a", "missing", "b"]]
    with refuses("lab.csv, line 2", "no label"):
        read(tmp_path, text, missing="error")
    assert listed(read(tmp_path, "a,a,b\nb,b,\n", merge_repeats=True)) == [["a", "b"], ["b"]]
    assert listed(read(tmp_path, "NA,b\nb,NA\n", action_names=["NA", "b"])) == [["NA", "b"], ["b", "NA"]]


def test_starts_and_stops_that_are_not_used_are_noted(tmp_path):
    plans = read(tmp_path, TABULAR, columns=OF_TABULAR | {"event_type": None})
    assert any("'Behavior type' holds START and STOP" in note for note in plans.notes)


def test_unused_columns_of_one_name():
    frame = pd.DataFrame([[1, "a", "x", "y"], [1, "b", "x", "y"]], columns=["plan", "action", "note", "note"])
    assert Plans.from_dataframe(frame).notes == ("columns that are not used: note, note",)


def test_decimal_commas_where_semicolons_part_columns(tmp_path):
    text = "plan;action;start;stop\n1;a;0,0;1,5\n1;b;1,5;4\n"
    assert read(tmp_path, text).durations.tolist() == [[1.5, 2.5]]
    with refuses("line 2", "'0,0'", "decimal point"):
        read(tmp_path, 'plan,action,start\n1,a,"0,0"\n1,b,"1,5"\n')


def test_doses_changes_and_days_are_conditions(tmp_path):
    plans = read(tmp_path, "plan,action,condition\n1,a,0\n2,b,0.5\n3,b,10\n")
    assert [plans.condition_names[c] for c in plans.condition] == ["0", "0.5", "10"]
    changes = read(tmp_path, "plan,action,condition\n1,a,-1\n2,b,0\n3,b,1\n")
    assert (changes.condition.tolist(), changes.condition_names) == ([-1, 0, 1], None)
    days = read(tmp_path, "day,action\n1,a\n2,b\n", columns={"plan": "day", "condition": "day", "action": "action"})
    assert days.condition.tolist() == [1, 2]
    with refuses("columns", "'day'", "plan and group"):
        read(tmp_path, "day,action\n1,a\n", columns={"plan": "day", "group": "day", "action": "action"})


def test_errors_of_spreadsheets_are_no_behaviour(tmp_path):
    plans = read(tmp_path, "plan,action\n1,a\n1,#N/A\n1,#VALUE!\n1,b\n")
    assert listed(plans) == [["a"], ["b"]]


def test_columns_that_are_taken_by_their_name(tmp_path):
    text = "name,syllable,group\nx,1,drug\ny,1,saline\n"
    found = read(tmp_path, text, columns={"action": "syllable", "plan": "name"})
    assert "the column 'group' is taken for what is independent, such as the animal" in found.notes
    named = read(tmp_path, text, columns={"action": "syllable", "plan": "name", "condition": "group"})
    assert named.group is None
    assert not any("independent" in note for note in named.notes)
    # without plans each group is one
    assert len(read(tmp_path, "group,action\nann,a\nann,b\nben,a\n")) == 2


def test_a_pause_needs_ends(tmp_path):
    with refuses("max_gap", "stop or duration"):
        read(tmp_path, "plan,action,start\n1,a,0\n1,b,500\n", max_gap=1)


def test_frames_of_keypoint_moseq(tmp_path):
    columns = {"plan": "name", "action": "syllable", "condition": "group"}
    plans = read(tmp_path, MOSEQ, columns=columns, merge_repeats=True)
    assert listed(plans) == [[3, 0], [0, 1]]
    assert plans.durations.tolist() == [[2, 1], [1, 2]]
    assert [plans.condition_names[c] for c in plans.condition] == ["wild", "mutant"]
    assert plans.group is None
    assert "actions are numbers from 0 to 3, of which 2 never occurs" in plans.notes
    assert len(read(tmp_path, MOSEQ, columns=columns).actions[0]) == 3  # only on request


@pytest.mark.parametrize("first", ["sep=;", "sep=;;", '"sep=;"', "SEP=;"])
def test_a_line_that_names_the_separator_is_no_row(tmp_path, first):
    """As spreadsheets write it; lines are still counted from the first one."""
    (tmp_path / "a.csv").write_text(f"{first}\nplan;action;duration\nx;walk;0,5\nx;rest;1\n")
    plans = read_plans(tmp_path / "a.csv")
    assert plans.action_names == ("rest", "walk")
    assert plans.durations.tolist() == [[0.5, 1.0]]
    assert plans.notes[-1] == "line 1 names the delimiter, ';', and is not read as a plan"
    (tmp_path / "b.csv").write_text(f"{first}\naction_1;action_2\n1;0\n0\n")
    with pytest.raises(ValueError, match=r"b\.csv, line 4: 1 cells, where the header has 2"):
        read_plans(tmp_path / "b.csv")


EVENTS = "session,behaviour,start\n1,walk,0\n1,rest,2\n"
ABOVE = "the header is line {}; what is above it is not read"


@pytest.mark.parametrize(
    "above",
    [
        "# made by a program\n",
        "# made by a program, version 2\n\n# arena: A\n",
        "Observation id,x\nDate,2020-01-01\n\n",
        "session notes,,\ndate,2020-01-01,\n,,\n",  # as a spreadsheet writes them
        "walk\na,b,c\n",
    ],
)
def test_what_is_above_the_header_is_not_read(tmp_path, above):
    line = above.count("\n") + 1
    columns = {"action": "behaviour", "plan": "session"}
    plans = read(tmp_path, above + EVENTS, columns=columns)
    assert listed(plans) == [["walk", "rest"]]
    assert plans.durations[0, 0] == 2
    assert list(plans.notes)[-1] == ABOVE.format(line)
    named = read(tmp_path, above + EVENTS.replace("session,behaviour", "plan,action"))
    assert (listed(named), named.notes[-1]) == ([["walk", "rest"]], ABOVE.format(line))
    with refuses(f"line {line + 2}", "start 'x'"):
        read(tmp_path, above + EVENTS.replace(",2", ",x"), columns=columns)
    semicolons = above + EVENTS.replace(",", ";").replace("2", "2,5")
    assert read(tmp_path, semicolons, columns=columns).durations[0, 0] == 2.5


def test_a_header_that_begins_with_a_hash(tmp_path):
    plans = read(tmp_path, "#,plan,action\n1,x,a\n2,x,b\n")
    assert (listed(plans), plans.notes) == ([["a", "b"]], ("columns that are not used: #",))
    wide = read(tmp_path, "# x\naction_1,action_2\na,b\n")
    assert listed(wide) == [["a", "b"]]


@pytest.mark.parametrize("columns", [{"action": "walk"}, {"action": "rest"}])
def test_rows_are_no_headers(tmp_path, columns):
    """A slip in the name of a column that is an action does not make a header of its row."""
    with refuses("columns.action", "not there", "session, behaviour, start"):
        read(tmp_path, EVENTS, columns=columns)


@pytest.mark.parametrize(
    ("starts", "seconds"),
    [
        (["10:05.5", "10:07"], 1.5),
        (["0:10:05", "0:10:07"], 2),
        (["00:10:05,5", "00:10:07"], 1.5),
        (["59:58", "1:00:01"], 3),
        (["59.5", "61"], 1.5),
        (["0:05.5", "0:07"], 1.5),
    ],
)
def test_times_of_day_are_minutes_and_seconds_where_that_is_sure(tmp_path, starts, seconds):
    assert read(tmp_path, f"plan;action;start\n1;a;{starts[0]}\n1;b;{starts[1]}\n").durations[0, 0] == seconds


def test_a_broken_character_in_a_column_that_is_not_used_is_no_harm():
    frame = pd.DataFrame({"action": ["a", "b"], "x\ud800": [1, 2]})
    assert any("not used" in note for note in Plans.from_dataframe(frame).notes)


def test_times_of_python_are_times_of_day():
    times = [datetime.time(10, 0, 5), datetime.time(10, 0, 7, 500_000)]
    assert Plans.from_dataframe(pd.DataFrame({"action": ["a", "b"], "start": times})).durations[0, 0] == 2.5


def test_times_of_day_of_starts_and_stops_that_are_rows(tmp_path):
    text = "action,kind,start\na,START,0:10:05\na,STOP,0:10:07.5\n"
    columns = {"action": "action", "event_type": "kind"}
    assert read(tmp_path, text, columns=columns).durations.tolist() == [[2.5]]


def test_starts_and_stops_that_are_rows_may_overlap(tmp_path):
    """Each STOP ends the last START of its own action, whatever else goes on, in any order of rows."""
    rows = ["a,START,0", "b,START,1", "a,STOP,2", "b,STOP,4", "a,START,5", "a,STOP,5.5"]
    columns = {"action": "action", "event_type": "kind"}
    for order in (rows, rows[::-1]):
        plans = read(tmp_path, "action,kind,start\n" + "\n".join(order) + "\n", columns=columns)
        assert (listed(plans), plans.durations.tolist()) == ([["a", "b", "a"]], [[2, 3, 0.5]])
        assert "1 actions begin before the one before them ended" in plans.notes


def of_times(starts, stops=None, **more):
    frame = pd.DataFrame({"action": list("abab")[: len(starts)], "plan": 1, "start": starts} | more)
    return Plans.from_dataframe(frame if stops is None else frame.assign(stop=stops))


def test_a_stop_that_is_missing_among_times_of_day_is_not_known():
    plans = of_times(["1:00:00", "1:00:10", "1:01:00"], ["1:00:05", None, "1:02:30.5"])
    assert plans.durations[0, [0, 2]].tolist() == [5.0, 90.5]
    assert plans.durations[0, 1].isnan()


def test_two_numbers_beyond_the_hours_of_a_day_are_minutes_and_seconds():
    assert of_times(["24:10", "24:30", "24:31"]).durations[0, :2].tolist() == [20.0, 1.0]
    with pytest.raises(ValueError, match="hours and minutes, or minutes and seconds"):
        of_times(["23:10", "23:30", "23:31"])


def test_times_that_go_back_a_little_are_only_put_in_order():
    little, much = of_times(["10:00:05", "10:00:01"]), of_times(["23:59:05", "0:00:01"])
    assert [any("go back" in note for note in plans.notes) for plans in (little, much)] == [False, True]
    assert all(any("order of their start" in note for note in plans.notes) for plans in (little, much))


def test_a_column_of_starts_and_stops_is_told_from_one_of_other_words():
    for words, noted in ((["START", "stop", "POINT", "START"], True), (["start", "stop", "pause", "start"], False)):
        notes = of_times([1.0, 2.0, 3.0, 4.0], kind=words).notes
        assert any("holds START and STOP" in note for note in notes) == noted
        assert any("not used: kind" in note for note in notes)


def test_what_parts_the_columns_is_what_makes_known_names_of_the_header(tmp_path):
    """Here semicolons, though there are more commas."""
    (tmp_path / "plans.csv").write_text("plan;action;a note, long, and, with, commas\n1;0;x\n1;1;y\n2;1;z\n")
    plans = read_plans(tmp_path / "plans.csv")
    assert plans.mask().sum(1).tolist() == [2, 1]


def test_parts_of_a_plan_that_no_group_holds_together_are_written_as_plans(tmp_path):
    """Else they would be read as one plan with a gap, whose parts form a group."""
    plans = Plans(torch.tensor([[0, 1], [1, 1], [1, 0]]), 2, plan_names=("a", "a", "b"))
    write_plans(plans, tmp_path / "plans.csv", layout="step")
    again = read_plans(tmp_path / "plans.csv")
    assert again.actions.tolist() == plans.actions.tolist()
    assert again.group is None
    assert again.plan_names is None


STEPS = torch.tensor([[0, 1, 1], [2, 0, 0], [1, 2, 0]])
WRITTEN = {
    "numbers": {},
    "names": {"action_names": ("eat", "rest", "walk"), "plan_names": ("b", "a", "c")},
    "context": {"context": torch.tensor([[0, 1, 0], [1, 1, 0], [0, 0, 0]]), "context_names": ("day", "night")},
    "features": {"context": torch.tensor([[[0.5, 1], [2, 3], [4, 5]]]).repeat(3, 1, 1)},
    "groups": {"group": torch.tensor([0, 1, 1]), "group_names": ("m1", "m2"), "condition": torch.tensor([1, 0, 0])},
    "durations": {"durations": torch.tensor([[1.5, torch.nan, 2], [1, 0, 0], [0, 3, 0]])},
    "parts of a plan": {"group": torch.tensor([0, 0, 1]), "plan_names": ("s1", "s1", "s1")},
}


@pytest.mark.parametrize("fields", WRITTEN.values(), ids=WRITTEN)
def test_a_frame_and_back(fields):
    plans = Plans(STEPS, 3, torch.tensor([3, 1, 2]), **fields)
    frame = plans.to_dataframe()
    assert list(frame["action"].dropna().map(str)) == [name for row in listed(plans) for name in map(str, row)]
    back = Plans.from_dataframe(frame, num_actions=3, action_names=fields.get("action_names"))
    for name in ("actions", "lengths", "context", "group", "condition", "durations"):
        want, got = getattr(plans, name), getattr(back, name)
        if want is None:
            assert got is None
        else:
            want = want.masked_fill(~plans.mask().view(3, 3, *[1] * (want.dim() - 2)), 0) if want.dim() > 1 else want
            assert torch.equal(got.double().nan_to_num(-1), want.double().nan_to_num(-1)), name
    for name in ("action_names", "plan_names", "group_names", "context_names"):
        if name in fields:
            assert tuple(getattr(back, name)) == tuple(fields[name])


def test_what_a_frame_cannot_hold():
    with refuses("without_end"):
        Plans(STEPS, 3).with_end().to_dataframe()
    with refuses("patterns"):
        Plans(STEPS, 3, context=torch.zeros(3, 3, 2, dtype=torch.int32)).to_dataframe()
    with refuses("plan 1 has no actions"):
        Plans(STEPS, 3, torch.tensor([3, 0, 2])).to_dataframe()
    with refuses("'-'"):
        Plans(STEPS, 3, action_names=("a", "-", "b")).to_dataframe()


@pytest.mark.parametrize("ends", ["stop", "duration"])
def test_actions_that_follow_one_another_at_once_do_so_whatever_is_rounded(ends):
    """In floating point .011 + (.051 - .011) is less than .051, and .1 + .2 more than .3."""
    rng = np.random.default_rng(0)
    steps = rng.integers(1, 2000, (300, 6))
    times = steps.cumsum(1) / 1000
    rows = pd.DataFrame(
        {
            "plan": np.repeat(np.arange(300), 5),
            "action": np.tile(list("abcde"), 300),
            "start": times[:, :-1].ravel(),
            "stop": times[:, 1:].ravel(),
        }
    )
    if ends == "duration":
        rows["duration"] = (steps[:, 1:] / 1000).ravel()
        rows = rows.drop(columns="stop")
    plans = Plans.from_dataframe(rows, max_gap=0)
    assert len(plans) == 300
    assert not plans.notes
    late = 0.0005 * (rows["action"] == "e")
    for column in {"start", "stop"} & set(rows.columns):
        rows[column] += late
    assert len(Plans.from_dataframe(rows, max_gap=0)) == 600


def test_several_columns_of_a_context_in_one_text():
    frame = pd.DataFrame({"plan": [1, 1], "action": ["a", "b"], "c1": [0.0, 1.0], "c2": [0.0, 1.0]})
    with refuses("columns.context: the column 'c1,c2' is not there", "several are given as '[c1,c2]'"):
        Plans.from_dataframe(frame, context="c1,c2")


def test_a_pause_of_just_max_gap_is_none_whatever_is_rounded():
    """1,035.9 - 35.9 is more than 1,000 in floating point."""
    frame = pd.DataFrame({"plan": 1, "action": ["a", "b"], "start": [0.0, 1035.9], "stop": [35.9, 1036.9]})
    assert len(Plans.from_dataframe(frame, max_gap=1000)) == 1
    assert len(Plans.from_dataframe(frame, max_gap=999.999)) == 2


def test_decimal_commas_are_features_as_points_are(tmp_path):
    """Where semicolons part the columns; a comma in names stays one."""
    for cells, features in ((["0,64", "0,04", "1"], True), (["0,64", "0,04 m", "1,5 m"], False)):
        (tmp_path / "t.csv").write_text("plan;action;context\n" + "".join(f"{i};a;{c}\n" for i, c in enumerate(cells)))
        plans = read_plans(tmp_path / "t.csv")
        assert plans.context.is_floating_point() == features
        if features:
            assert plans.context.flatten().tolist() == pytest.approx([0.64, 0.04, 1.0])


def test_animals_whose_numbers_are_the_same_are_noted(tmp_path):
    (tmp_path / "t.csv").write_text("group,action\n1E2,a\n100,b\n+7,a\n007,a\n12,b\n")
    (said,) = [note for note in read_plans(tmp_path / "t.csv").notes if "the same number" in note]
    assert "'1E2' and '100'" in said
    assert "'+7' and '007'" in said or "'007' and '+7'" in said
    assert "12" not in said


def test_actions_that_begin_together_are_noted(tmp_path):
    (tmp_path / "t.csv").write_text("plan,action,start\n1,a,1\n1,b,1\n1,b,1\n1,c,5\n2,a,5\n")
    (said,) = [note for note in read_plans(tmp_path / "t.csv").notes if "same time" in note]
    assert said.startswith("2 actions begin at the same time as the one before them")
    assert "1 are the same action" in said
