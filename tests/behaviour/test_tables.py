"""Tables of events: from a frame, and from files as laboratories and programs export them."""

import datetime
from typing import Any

import numpy as np
import pandas as pd
import pytest

from neuroprior.behaviour.report import ReadOptions
from neuroprior.behaviour.tables import plans_of_frame, read_events
from neuroprior.plans import read_plans
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
    (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_events(tmp_path / name, **options)


def listed(plans):
    """The actions of each plan, by name."""
    lengths = plans.mask().sum(1).tolist()
    names = plans.action_names or range(plans.num_actions)
    return [[names[a] for a in row[:n]] for row, n in zip(plans.actions.tolist(), lengths, strict=True)]


def known(durations):
    """Durations in lists, None where they are not known."""
    return [[None if np.isnan(one) else one for one in row] for row in durations.tolist()]


def test_a_table_of_a_laboratory(tmp_path):
    """All that is read of it; and a frame is read as its file."""
    file = read(tmp_path, LAB, columns=COLUMNS | {"start": "t", "duration": "seconds"})
    frame = plans_of_frame(pd.read_csv(tmp_path / "lab.csv"), COLUMNS | {"start": "t", "duration": "seconds"})
    for plans in (file, frame):
        assert listed(plans) == [["walk", "Rear"], ["walk"], ["rear"], ["groom", "walk"]]
        assert [plans.group_names[g] for g in plans.group] == ["m1", "m1", "m1", "m2"]
        assert [plans.condition_names[c] for c in plans.condition] == ["saline"] * 3 + ["drug"]
        contexts = [[plans.context_names[c] for c in row] for row in plans.context]
        assert [row[:n] for row, n in zip(contexts, plans.lengths, strict=True)] == [[*"AA"], ["B"], ["A"], [*"BA"]]
        assert known(plans.durations) == [[1.5, 0.5], [1.0, 0], [2.0, 0], [None, 1.0]]
        assert list(plans.notes) == [
            "rows are put in the order of their start",
            "actions 'Rear' and 'rear' are nearly the same; rename them if they mean the same",
            "1 rows have no label",
            "1 gaps end a plan, and the next begins after each",
            "the durations of 1 of 6 actions are not known",
            "columns that are not used: observer",
        ]


BORIS = """\
Observation id,Description,Subject,Behavior,Behavioral category,Behavior type,Start (s),Stop (s),Duration (s)
day1,,mouse 1,walk,move,STATE,0.5,2.5,2.0
day1,,mouse 1,rear,move,POINT,2.5,2.5,NA
day1,,mouse 2,groom,self,STATE,1.0,4.0,3.0
day1,,mouse 1,groom,self,STATE,3.0,4.5,1.5
"""
OF_BORIS = {"plan": "Observation id", "group": "Subject", "action": "Behavior"}
OF_BORIS |= {"start": "Start (s)", "stop": "Stop (s)"}

MOSEQ = """name,centroid_x,centroid_y,heading,angular_velocity,velocity_px_s,syllable,frame_index,group,onset
21_11_8_one,10.1,5.2,0.1,0.0,0.0,3,0,wild,False
21_11_8_one,10.2,5.2,0.1,0.0,1.0,3,1,wild,False
21_11_8_one,10.2,5.3,0.2,0.1,1.0,0,2,wild,True
21_12_2_two,3.0,4.0,1.1,0.0,0.0,0,0,mutant,False
21_12_2_two,3.0,4.1,1.2,0.0,0.2,1,1,mutant,True
21_12_2_two,3.0,4.1,1.2,0.0,0.2,1,2,mutant,False
"""
OF_MOSEQ = {"plan": "name", "action": "syllable", "condition": "group"}

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

KIND = {"columns": {"action": "action", "event_type": "kind"}}
OVERLAPPING = ["a,START,0", "b,START,1", "a,STOP,2", "b,STOP,4", "a,START,5", "a,STOP,5.5"]
OPTIONED = "plan,action,start,stop\n1,a,0,1\n1,b,1,2\n2,c,0,1\n2,c,1.5,2\n"
UNLABELLED = OPTIONED.replace("2,c,1.5", "2,,1,1.5\n2,c,1.5")
PAUSES = "action,start,stop\na,0,5\nb,1,2\nc,6,7\nd,9,10\n"
WIDE = "action_1,action_2,action_3,action_4,group,context\na,b,NA,a,x,0\nb,,,,x,1\na,,b,,y,2\n"
GAPS = "2 gaps end a plan, and the next begins after each"

READ: list[tuple[str, dict[str, Any], list[list[Any]], list[list[Any]] | None, list[str]]] = [
    # what laboratories' programs write
    (BORIS, {"columns": OF_BORIS}, [["walk", "rear", "groom"], ["groom"]], [[2, 0, 1.5], [3, 0, 0]], []),
    (
        TABULAR,
        {"columns": OF_TABULAR},
        [["dig", "call", "eat", "dig"], ["dig"]],
        [[2, 0, 0.5, None], [3, 0, 0, 0]],
        ["1 actions have a START and no STOP", "columns that are not used: Media file"],
    ),
    (
        MOSEQ,
        {"columns": OF_MOSEQ, "merge_repeats": True},
        [[3, 0], [0, 1]],
        [[2, 1], [1, 2]],
        ["actions are numbers from 0 to 3, of which 2 never occurs"],
    ),
    (MOSEQ, {"columns": OF_MOSEQ}, [[3, 3, 0], [0, 1, 1]], None, []),
    *(
        (
            "action,kind,start\n" + "\n".join(rows) + "\n",
            KIND,
            [["a", "b", "a"]],
            [[2, 3, 0.5]],
            ["1 actions begin before the one before them ended"],
        )
        for rows in (OVERLAPPING, OVERLAPPING[::-1])
    ),
    ("action,kind,start\na,start,0:10:05\na,Stop,0:10:07.5\n", KIND, [["a"]], [[2.5]], []),
    # options
    (OPTIONED, {}, [["a", "b"], ["c", "c"]], [[1, 1], [1, 0.5]], []),
    (OPTIONED, {"max_gap": 0}, [["a", "b"], ["c"], ["c"]], None, []),
    (OPTIONED, {"merge_repeats": True}, [["a", "b"], ["c"]], [[1, 1], [1.5, 0]], []),
    (UNLABELLED, {"missing": "label"}, [["a", "b"], ["c", "missing", "c"]], None, []),
    (UNLABELLED, {"missing": "label", "merge_repeats": True}, [["a", "b"], ["c", "missing", "c"]], None, []),
    (OPTIONED, {"action_names": ["z", "c", "b", "a"]}, [["a", "b"], ["c", "c"]], None, []),
    # gaps: the end of an action of another plan does not count, and an unknown end as the beginning
    (PAUSES, {"max_gap": 1.5}, [["a", "b", "c"], ["d"]], None, []),
    (PAUSES, {"max_gap": 2}, [["a", "b", "c", "d"]], None, []),
    ("plan,action,start,stop\n1,a,0,99\n2,b,0,1\n2,c,5,6\n", {"max_gap": 1}, [["a"], ["b"], ["c"]], None, []),
    ("action,start,stop\na,0,1\nb,2,\nc,10,11\n", {"max_gap": 5}, [["a", "b"], ["c"]], None, []),
    (
        "action,start,stop\na,0,1\nb,9,\nc,12,13\nd,500,\ne,1000,1001\n",
        {"max_gap": 10},
        [["a", "b", "c"], ["d"], ["e"]],
        None,
        ["2 actions without an end count for max_gap as ended when they began"],
    ),
    ("action,start,stop\na,0,\nb,1000,1001\n", {"max_gap": 10}, [["a"], ["b"]], None, []),
    # labels that are missing
    (WIDE, {}, [["a", "b"], ["a"], ["b"], ["a"], ["b"]], None, [GAPS]),
    (WIDE, {"missing": "label"}, [["a", "b", "missing", "a"], ["b"], ["a", "missing", "b"]], None, []),
    ("a,a,b\nb,b,\n", {"merge_repeats": True}, [["a", "b"], ["b"]], None, []),
    ("NA,b\nb,NA\n", {"action_names": ["NA", "b"]}, [["NA", "b"], ["b", "NA"]], None, []),
    ("plan,action\n1,a\n1,#N/A\n1,#VALUE!\n1,b\n", {}, [["a"], ["b"]], None, []),
    # durations
    ("plan,action,start\n1,a,0\n1,b,2\n1,,3\n1,a,7\n2,a,1\n", {}, [["a", "b"], ["a"], ["a"]], [[2, 1], [None, 0]] , []),
    ("plan;action;start;stop\n1;a;0,0;1,5\n1;b;1,5;4\n", {}, [["a", "b"]], [[1.5, 2.5]], []),
    # which rows are a plan
    ("group,plan,action\nm1,1,a\nm2,1,b\n", {}, [["a"], ["b"]], None, []),
    ("group,action\nm1,a\nm1,b\nm2,b\n", {"columns": {"action": "action"}}, [["a", "b"], ["b"]], None, []),
    # columns
    (
        "plan;action;what, when, where, how\n1;x;0\n1;y;0\n",
        {},
        [["x", "y"]],
        None,
        ["columns that are not used: what, when, where, how"],
    ),
    ("#,plan,action\n1,x,a\n2,x,b\n", {}, [["a", "b"]], None, ["columns that are not used: #"]),
    ("# x\naction_1,action_2\na,b\n", {}, [["a", "b"]], None, []),
    ("plan;action;a note, and, with, commas\n1;0;x\n1;1;y\n2;1;z\n", {}, [[0, 1], [1]], None, []),
    (
        "name,syllable,group\nx,1,drug\ny,1,saline\n",
        {"columns": {"action": "syllable", "plan": "name"}},
        [[1], [1]],
        None,
        ["the column 'group' is taken for what is independent, such as the animal"],
    ),
    ("\ufeffplan,action\n1,a\n", {}, [["a"]], None, []),
]  # fmt: skip


@pytest.mark.parametrize(("text", "options", "actions", "durations", "notes"), READ)
def test_what_is_read(tmp_path, text, options, actions, durations, notes):
    """Options mean the same for files and frames."""
    plans = read(tmp_path, text, **options)
    assert listed(plans) == actions
    assert durations is None or known(plans.durations)[: len(durations)] == durations
    assert set(notes) <= set(plans.notes)
    if "plan,action,start,stop" in text:
        frame = plans_of_frame(pd.read_csv(tmp_path / "lab.csv"), **options)
        assert (listed(frame), frame.notes) == (actions, plans.notes)


@pytest.mark.parametrize(
    ("text", "note"),
    [
        ("action,start\na,23:59:50\nb,00:00:10\n", "times of day go back from 23:59:50 to 00:00:10"),
        ("action,start,stop\na,0,10\nb,5,6\na,7,9\n", "1 actions begin before the one before them ended"),
        ("action,start,stop,duration\na,0,1,1.001\nb,5,6,1\na,7,9,3\n", "line 4, are not the time from start to stop"),
        ("action,start,stop,duration\na,0,yes,1\nb,5,no,1\n", "the stops are not read as times"),
        # In the order of the file, not of time.
        ("action,start,stop,duration\na,8,9,3\nb,5,6,1\na,1,3,4\n", "line 2, are not the time from start to stop"),
        (",action\n0,a\n1,b\n", "columns that are not used: (without a name, column 1)"),
        ("action\nGr\u00fcn\nGru\u0308n\n", "are nearly the same"),
        ("action\nRear\nrear\nGroom\ngroom\n", "actions 'Rear' and 'rear', 'Groom' and 'groom' are nearly the same;"),
        ("action\n1000000000\n1\n", "of which 0, 2, 3, 4, 5, 6, 7, 8 and 999,999,991 more never occur"),
        ("plan,action\na,007\na,7\nb,8\n", "actions '007' and '7' are the same number, and count as the same"),
        ("group,action\n1E2,a\n100,b\n12,b\n", "groups '1E2' and '100' are the same number"),
        ("plan,action,start\n1,a,1\n1,b,1\n1,b,1\n1,c,5\n2,a,5\n", "2 actions begin at the same time as the one"),
        ("plan,action,start\n1,a,1\n1,b,1\n1,b,1\n1,c,5\n2,a,5\n", "(1 are the same action:"),
        ("action,x\na,START\nb,stop\nc,POINT\n", "the column 'x' holds START and STOP, and is not used"),
    ],
)
def test_what_is_noted(text, note, tmp_path):
    notes = read(tmp_path, text, **ACTION).notes
    assert any(note in one for one in notes), notes


@pytest.mark.parametrize(
    "text",
    [
        "plan,action,start,stop\n1,a,0:00:01,0:00:02\n1,b,0:00:02,0:00:05\n",
        "group,plan,action\n01,a,x\n1,b,y\nz,c,y\n",  # among names, numbers are names
        "group,action,start\nx,a,0:00:01\nx,b,23:00:00\ny,a,0:10:00\n",
    ],
)
def test_nothing_is_noted_of_plain_tables(text, tmp_path):
    assert not [note for note in read(tmp_path, text).notes if "not known" not in note]


ACTION = {"columns": {"action": "action"}}
REFUSED = [
    ("action,context\na,\nb,x\nc,\n", ACTION, ["line 2", "context: an empty cell (2 in all)", "not known"]),
    ('action,duration\na,"1,5"\n', ACTION, ["line 2", "'1,5'", "a decimal point"]),
    ('plan,action,start\n1,a,"0,0"\n1,b,"1,5"\n', {}, ["line 2", "'0,0'", "decimal point"]),
    ("action,start\na,10:05\nb,10:06\n", ACTION, ["line 2", "'10:05'", "hours and minutes, or minutes and seconds"]),
    ("action,start\na,1:10:05\nb,10:06\n", ACTION, ["line 3", "'10:06'", "hours and minutes, or minutes and seconds"]),
    ("action,start\na,59.5\nb,1:00.5\n", ACTION, ["line 3", "'1:00.5'", "or as numbers"]),
    ("action,start\na,1:00:75\n", ACTION, ["line 2", "'1:00:75'", "below 60"]),
    ("action,start\na,1:75:00\n", ACTION, ["line 2", "'1:75:00'", "below 60"]),
    ("action,start\na,03/02/2024\nb,04/02/2024\n", ACTION, ["line 2", "start", "03/02/2024", "year-month-day"]),
    ("action,start\na,2024-02-03\nb,04/02/2024\n", ACTION, ["line 2", "2024-02-03", "year-month-day"]),
    ("action,start,stop\na,5,0:00:06\n", ACTION, ["stop", "times of day", "numbers in another"]),
    ("action,start,stop\na,2020-01-01 10:00:00,10:00:05\n", ACTION, ["stop", "times of day", "dates in another"]),
    ("plan,action\n1,a\n1,\n", {"missing": "error"}, ["line 3", "no label"]),
    (WIDE, {"missing": "error"}, ["line 2", "no label"]),
    ("plan,action\n1,a\n", {"max_gap": 1}, ["`columns` must have start, and stop or duration"]),
    ("plan,action,start\n1,a,0\n1,b,500\n", {"max_gap": 1}, ["`columns` must have start, and stop or duration"]),
    ("plan,action\n1,a\n", {"max_gap": "3"}, ["`max_gap` must be at least 0, got '3'"]),
    ("plan,action\n1,a\n", {"merge_repeats": "no"}, ["merge_repeats", "'no'"]),
    ("plan,action\n1,a\n", {"columns": ["action"]}, ["columns", "['action']"]),
    ("plan,action\n1,a\n", {"columns": {"action": 1}}, ["`columns.action` must be one of plan, action, got '1'"]),
    ("day,action\n1,a\n", {"columns": {"plan": "day", "group": "day"}}, ["`columns`", "plan and group", "'day'"]),
    ("session,behaviour,start\n1,walk,0\n1,rest,2\n", {"columns": {"action": "walk"}}, ["`columns.action`", "'walk'"]),
    ("notes\nx,y\na,b\n", {"columns": {"action": "action"}}, ["line 2: 2 cells", "further down", "columns.action"]),
    ("plan,action\n1,a\n".encode("utf-16-le"), {}, ["line 1", "UTF-16"]),
    ("<!DOCTYPE html><html><body>Not found</body></html>", {}, ["a web page"]),
    ("# made by x\n0\n1\n", {}, ["line 1", "begins with #"]),
    ("#action\na\n", {}, ["line 1", "begins with #"]),
    # of the table of a laboratory
    (LAB, {"columns": {"action": "act"}}, ["`columns.action` must be one of animal, session, behaviour", "'act'"]),
    (LAB, {"columns": {"acts": "behaviour"}}, ["`columns` must be some of", "acts"]),
    (LAB, {"columns": {"action": "behaviour", "plan": "behaviour"}}, ["action and plan, got 'behaviour'"]),
    (LAB, {"columns": {"plan": "session"}}, ["no column 'action'", "columns.action"]),
    (LAB, {"columns": {"action": "behaviour", "plan": "animal", "condition": "session"}}, ["line 6", "condition"]),
    (LAB, {"columns": {"action": "behaviour", "plan": "session"}}, ["line 7", "goes on after another plan"]),
    (LAB, {"columns": {"action": "behaviour", "start": "drug"}}, ["line 2", "start 'saline'", "time"]),
    (LAB, {"columns": {"action": "behaviour", "duration": "animal"}}, ["line 2", "'m1'"]),
    (LAB, {"columns": {"action": "behaviour", "stop": "t"}}, ["`columns.start` must be given"]),
    (LAB, {"columns": {"action": "behaviour", "start": "seconds"}}, ["line 8", "start: an empty cell"]),
    (LAB, {"columns": {"action": "behaviour", "start": "t", "stop": "seconds"}}, ["line 3", "stop", "-1"]),
    (LAB, {"columns": {"action": "behaviour"}, "missing": "drop"}, ["`missing` must be one of gap, label, error"]),
    (LAB, {"columns": {"action": "seconds"}}, ["line 2", "'1.5' is not a whole number"]),
    # of starts and stops in rows of their own
    (TABULAR.replace("ann,dig,STOP", "ann,dig,START"), {"columns": OF_TABULAR}, ["line 5", "'dig'", "and no STOP"]),
    (TABULAR.replace("eat,START", "eat,STOP"), {"columns": OF_TABULAR}, ["line 6", "'eat'", "STOP without a START"]),
    (TABULAR.replace("POINT", "BEGIN"), {"columns": OF_TABULAR}, ["line 4", "START, STOP, POINT", "BEGIN"]),
    (TABULAR, {"columns": OF_TABULAR | {"start": None}}, ["`columns.start` must be given with `columns.event_type`"]),
    (TABULAR, {"columns": OF_TABULAR | {"stop": "Media file"}}, ["`columns.stop` must be left out"]),
    (TABULAR, {"columns": OF_TABULAR | {"group": None}}, ["line 3", "columns.group"]),
]


@pytest.mark.parametrize(("text", "options", "words"), REFUSED)
def test_what_is_refused(text, options, words, tmp_path):
    with refuses(*words):
        read(tmp_path, text, **options)


@pytest.mark.parametrize("name", ["a.jsonl", "a.npz"])
def test_columns_are_for_tables(tmp_path, name):
    with refuses("columns", "CSV"):
        ReadOptions(columns={"action": "b"}).read(str(tmp_path / name))


@pytest.mark.parametrize("path", [None, 3, b"a.csv", pd.DataFrame()])
def test_what_is_no_name_of_a_file(path):
    with refuses("path", "name of a file"):
        read_plans(path)


@pytest.mark.parametrize("word", ["", "NaN", "NA", "N/A", "null", "?", "-", " nan "])
def test_a_missing_label_is_no_behaviour(tmp_path, word):
    text = f"plan,action\n1,a\n1,{word}\n1,{word}\n1,b\n2,b\n2,{word}\n"
    plans = read(tmp_path, text)
    assert listed(plans) == [["a"], ["b"], ["b"]]
    assert plans.group.tolist() == [0, 0, 1]  # what a gap parts is not independent
    assert listed(read(tmp_path, text, missing="label")) == [["a", "missing", "missing", "b"], ["b", "missing"]]


def test_frames_of_pandas():
    """Missing values of all kinds; whole numbers become floating point where one of them is missing."""
    frame = pd.DataFrame({"action": ["a", None, "b", np.nan, pd.NA, "c"]})
    for one in (frame, frame.astype("category")):
        assert listed(plans_of_frame(one)) == [["a"], ["b"], ["c"]]
    frame = pd.DataFrame({"action": [2.0, np.nan, 0.0], "context": [1.0, 3.0, 0.0], "group": [7.0, 7.0, 7.0]})
    plans = plans_of_frame(frame)
    assert (listed(plans), plans.context.tolist(), plans.group.tolist()) == ([[2], [0]], [[1], [0]], [7, 7])
    numbers = plans_of_frame(pd.DataFrame({"action": [0, 1]}), num_actions=5)
    assert (numbers.num_actions, numbers.notes) == (5, ())
    with refuses("pandas frame", "dict"):
        plans_of_frame({"action": ["a"]})
    numbered = pd.DataFrame([["x", "a"], ["x", "b"]])
    assert plans_of_frame(numbered, {"action": 1, "plan": 0}).actions.tolist() == [[0, 1]]
    twice = pd.DataFrame([[1, "a", "x", "y"], [1, "b", "x", "y"]], columns=["plan", "action", "note", "note"])
    assert plans_of_frame(twice).notes == ("columns that are not used: note, note",)
    broken = pd.DataFrame([["a", 1], ["b", 2]], columns=pd.Index(["action", "x\ud800"], dtype=object))
    assert any("not used" in note for note in plans_of_frame(broken).notes)


def of_times(starts, stops=None):
    frame = pd.DataFrame({"action": list("abab")[: len(starts)], "plan": 1, "start": starts})
    return plans_of_frame(frame if stops is None else frame.assign(stop=stops))


DATES = ["2024-01-05 10:00:00", "2024-01-05 10:00:10", "2024-01-05 10:01:00"]
STOPS = ["2024-01-05 10:00:04", "2024-01-05 10:00:20", "2024-01-05 10:01:01.5"]


@pytest.mark.parametrize(
    ("starts", "stops", "durations"),
    [
        (["0", "1.5", "61.5"], None, [1.5, 60, None]),
        (["00:00:00", "00:00:01.5", "00:01:01.5"], None, [1.5, 60, None]),
        (["10:05.5", "10:07"], None, [1.5, None]),
        (["00:10:05,5", "00:10:07"], None, [1.5, None]),
        (["59:58", "1:00:01"], None, [3, None]),
        (["24:10", "24:30", "24:31"], None, [20, 1, None]),  # beyond the hours of a day: minutes and seconds
        (["1:00:00", "1:00:10", "1:01:00"], ["1:00:05", None, "1:02:30.5"], [5, None, 90.5]),
        ([datetime.time(10, 0, 5), datetime.time(10, 0, 7, 500_000)], None, [2.5, None]),
        (DATES, STOPS, [4, 10, 1.5]),
        (DATES, None, [10, 50, None]),
        (pd.to_datetime(DATES), pd.to_datetime(STOPS, format="ISO8601"), [4, 10, 1.5]),
        (
            pd.to_datetime(DATES).tz_localize("Europe/Helsinki"),
            pd.to_datetime(STOPS, format="ISO8601").tz_localize("UTC"),
            [7204, 7210, 7201.5],
        ),
    ],
)
def test_times_are_numbers_clocks_or_dates(starts, stops, durations):
    """Starts and stops are on one clock, whatever the first of each is."""
    assert known(of_times(starts, stops).durations) == [durations]


@pytest.mark.parametrize("stops", [pd.to_datetime(DATES).tz_localize("UTC"), ["2024-01-05T10:00:59.5+02:00"] * 3])
def test_times_with_a_zone_are_not_compared_with_those_without(stops):
    with refuses("stop", "time zone"):
        of_times(pd.to_datetime(DATES) if isinstance(stops, pd.DatetimeIndex) else DATES, stops)


def test_times_that_go_back_a_little_are_only_put_in_order():
    little, much = of_times(["10:00:05", "10:00:01"]), of_times(["23:59:05", "0:00:01"])
    assert [any("go back" in note for note in plans.notes) for plans in (little, much)] == [False, True]
    assert all(any("order of their start" in note for note in plans.notes) for plans in (little, much))


def test_frames_are_merged_to_actions():
    """A run takes as many rows as it has, or as long as these; what a gap parts is not merged."""
    frame = pd.DataFrame({"name": list("xxxxxxyy"), "syllable": [3, 3, 0, 0, 0, 3, 3, 3]})
    plans = plans_of_frame(frame, {"plan": "name", "action": "syllable"}, merge_repeats=True)
    assert (listed(plans), plans.durations.tolist()) == ([[3, 0, 3], [3]], [[2, 3, 1], [2, 0, 0]])
    timed = plans_of_frame(frame.assign(duration=0.5), {"plan": "name", "action": "syllable"}, merge_repeats=True)
    assert timed.durations.tolist() == [[1, 1.5, 0.5], [1, 0, 0]]
    gaps = pd.DataFrame({"plan": [1, 1, 1, 1, 1, 2], "action": ["a", "a", None, "a", "b", "b"]})
    plans = plans_of_frame(gaps, merge_repeats=True)
    assert (listed(plans), plans.group.tolist()) == ([["a"], ["a", "b"], ["b"]], [0, 0, 1])
    assert plans.durations.tolist() == [[2, 0], [1, 1], [1, 0]]


def test_contexts_are_names_indices_or_features(tmp_path):
    """Decimal commas count where semicolons part the columns; a comma in names stays one."""
    frame = pd.DataFrame({"action": list("ab"), "speed": [1, 2.5], "turn": ["0", "-1"]})
    assert plans_of_frame(frame, {"context": ["speed", "turn"]}).context.tolist() == [[[1, 0], [2.5, -1]]]
    assert plans_of_frame(frame, {"context": "speed"}).context.tolist() == [[[1], [2.5]]]
    with refuses("`columns.context` must be one of", "'speed,turn' (several are given as '[speed,turn]')"):
        plans_of_frame(frame, {"context": "speed,turn"})
    numbers = read(tmp_path, "plan;action;context\n0;a;0,64\n1;a;0,04\n2;a;1\n").context
    assert numbers.flatten().tolist() == pytest.approx([0.64, 0.04, 1.0])
    assert not read(tmp_path, "plan;action;context\n0;a;0,64\n1;a;0,04 m\n").context.is_floating_point()


def test_doses_changes_and_days_are_conditions(tmp_path):
    plans = read(tmp_path, "plan,action,condition\n1,a,0\n2,b,0.5\n3,b,10\n")
    assert [plans.condition_names[c] for c in plans.condition] == ["0", "0.5", "10"]
    changes = read(tmp_path, "plan,action,condition\n1,a,-1\n2,b,0\n3,b,1\n")
    assert (changes.condition.tolist(), changes.condition_names) == ([-1, 0, 1], None)
    days = read(tmp_path, "day,action\n1,a\n2,b\n", columns={"plan": "day", "condition": "day", "action": "action"})
    assert days.condition.tolist() == [1, 2]
    named = read(tmp_path, MOSEQ, columns=OF_MOSEQ)
    assert ([named.condition_names[c] for c in named.condition], named.group) == (["wild", "mutant"], None)


def test_numbers_of_groups_are_numbers(tmp_path):
    assert read(tmp_path, "group,plan,action\n01,a,x\n1,b,y\n01,c,y\n2,d,x\n").group.tolist() == [1, 1, 1, 2]


@pytest.mark.parametrize("first", ["sep=;", "sep=;;", '"sep=;"', "SEP=;"])
def test_a_line_that_names_the_separator_is_no_row(tmp_path, first):
    """As spreadsheets write it; lines are still counted from the first one."""
    plans = read(tmp_path, f"{first}\nplan;action;duration\nx;walk;0,5\nx;rest;1\n")
    assert (plans.action_names, plans.durations.tolist()) == (("rest", "walk"), [[0.5, 1.0]])
    assert plans.notes[-1] == "line 1 names the delimiter, ';', and is not read as a plan"
    with refuses("lab.csv, line 4: 1 cells, where the header has 2"):
        read(tmp_path, f"{first}\naction_1;action_2\n1;0\n0\n")


EVENTS = "session,behaviour,start\n1,walk,0\n1,rest,2\n"


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
    for text, options in (
        (above + EVENTS, {"columns": columns}),
        (above + EVENTS.replace("session,behaviour", "plan,action"), {}),
    ):
        plans = read(tmp_path, text, **options)
        assert (listed(plans), plans.durations[0, 0]) == ([["walk", "rest"]], 2)
        assert plans.notes[-1] == f"the header is line {line}; what is above it is not read"
    with refuses(f"line {line + 2}", "start 'x'"):
        read(tmp_path, above + EVENTS.replace(",2", ",x"), columns=columns)
    semicolons = above + EVENTS.replace(",", ";").replace("2", "2,5")
    assert read(tmp_path, semicolons, columns=columns).durations[0, 0] == 2.5


@pytest.mark.parametrize("ends", ["stop", "duration"])
def test_actions_that_follow_one_another_at_once_do_so_whatever_is_rounded(ends):
    """In floating point .011 + (.051 - .011) is less than .051, and .1 + .2 more than .3."""
    steps = np.random.default_rng(0).integers(1, 2000, (300, 6))
    times = steps.cumsum(1) / 1000
    rows = pd.DataFrame({"plan": np.repeat(np.arange(300), 5), "action": np.tile(list("abcde"), 300)})
    rows["start"] = times[:, :-1].ravel()
    rows[ends] = times[:, 1:].ravel() if ends == "stop" else (steps[:, 1:] / 1000).ravel()
    plans = plans_of_frame(rows, max_gap=0)
    assert (len(plans), plans.notes) == (300, ())
    for column in {"start", "stop"} & set(rows.columns):
        rows[column] += 0.0005 * (rows["action"] == "e")
    assert len(plans_of_frame(rows, max_gap=0)) == 600


def test_a_pause_of_just_max_gap_is_none_whatever_is_rounded():
    """1,035.9 - 35.9 is more than 1,000 in floating point."""
    frame = pd.DataFrame({"plan": 1, "action": ["a", "b"], "start": [0.0, 1035.9], "stop": [35.9, 1036.9]})
    assert len(plans_of_frame(frame, max_gap=1000)) == 1
    assert len(plans_of_frame(frame, max_gap=999.999)) == 2


def times(start):
    return "plan,action,context_1,context_2\n" + "".join(f"p{i // 5},{i % 3},0.1,{start + 60 * i}\n" for i in range(10))


def test_features_that_single_precision_does_not_hold(tmp_path):
    """Minutes as seconds since 1970, where float32 counts in steps of 128; not a constant that it rounds."""
    (tmp_path / "a.csv").write_text(times(1.7e9))
    with refuses("context", "feature 2 of 2", "1.7e+09", "subtract a constant"):
        read_events(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text(times(0))
    assert read_events(tmp_path / "a.csv").context.shape == (2, 5, 2)


def test_features_that_are_constant_within_plans_have_no_note(tmp_path):
    """A dose of each session, over many frames."""
    lines = "".join(f"p{i // 30_000},{i % 2},{(0.1, 0.2)[i // 30_000]},{i % 7}.5\n" for i in range(60_000))
    (tmp_path / "a.csv").write_text("plan,action,context_1,context_2\n" + lines)
    assert not [note for note in read_events(tmp_path / "a.csv").notes if "within plans" in note]


def test_features_that_hardly_vary_within_plans_are_noted(tmp_path):
    """Sessions far apart, each of some seconds: what is left is a clock of sessions."""
    for begin in (1.7e9, 0):
        lines = [f"p{i // 5},{i % 3},0.5,{begin + 1000 * (i // 5) + i}\n" for i in range(60)]
        (tmp_path / "a.csv").write_text("plan,action,context_1,context_2\n" + "".join(lines))
        noted = [note for note in read_events(tmp_path / "a.csv").notes if "within plans" in note]
        assert [note.split(",")[0] for note in noted] == ["feature 2 of the context is about 1.7e+09"] * bool(begin)


@pytest.mark.parametrize("gap", ["", " ", "NA"])
def test_a_plan_in_a_row_ends_where_a_label_is_missing(gap, tmp_path):
    """And goes on as another behind it: what is before and after was not one after the other."""
    rows = ["plan,group,action_1,action_2,action_3,action_4", f"x,a,0,{gap},1,2", f"y,b,{gap},1,2,", "z,b,2,0,,"]
    (tmp_path / "plans.csv").write_text("\n".join(rows) + "\n")
    plans = read_events(tmp_path / "plans.csv")
    parts = [row[:length] for row, length in zip(plans.actions.tolist(), plans.lengths.tolist(), strict=True)]
    assert parts == [[0], [1, 2], [1, 2], [2, 0]]
    assert plans.recording == ("x", "x", "y", "z")
    assert plans.group.tolist() == [0, 0, 1, 1]
    assert "2 rows have no label" in plans.notes


def test_recordings_are_named_as_in_the_file(tmp_path):
    """Where a row without a label ends a plan, its parts have one name; numbers from 0 are no names."""
    rows = ["s,b", "m1-day2,walk", "m1-day2,", "m1-day2,rest", "m1-day3,walk"]
    plans = read(tmp_path, "\n".join(rows) + "\n", columns={"action": "b", "plan": "s"})
    assert plans.recording == ("m1-day2", "m1-day2", "m1-day3")
    plans = read(tmp_path, "plan,action_1,action_2,action_3\nx,0,?,1\ny,1,1,\n")
    assert plans.recording == ("x", "x", "y")
    assert read(tmp_path, "plan,action\n0,1\n1,0\n").recording is None


def test_the_beginnings_of_actions_are_those_of_the_file(tmp_path):
    """Of actions that are merged, the first of them; the parts of a plan go on in its time."""
    text = "plan,action,start\n1,a,0.5\n1,a,2\n1,,3\n1,b,1e9\n2,b,7\n"
    assert read(tmp_path, text).began.tolist() == [[0.5, 2], [1e9, 0], [7, 0]]
    assert read(tmp_path, text, merge_repeats=True).began.tolist() == [[0.5], [1e9], [7]]
    assert read(tmp_path, "plan,action\n1,a\n").began is None


@pytest.mark.parametrize("text", ["action_1,action_2,action_3\n1,2,3\n3,1,\n", "plan,action\n1,1\n1,2\n1,3\n2,3\n"])
def test_codes_from_1_are_noted(text, tmp_path):
    """Action 0 never occurs: that there is one more action than the user thinks is said, unless the user said it."""
    (note,) = read(tmp_path, text).notes
    assert note == "actions are numbers from 0 to 3, of which 0 never occurs"
    assert read(tmp_path, text).num_actions == 4
    assert not read(tmp_path, text, num_actions=4).notes
    assert not read(tmp_path, text, action_names=list("abcd")).notes
