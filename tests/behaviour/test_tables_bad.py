"""Tables as they come out of programs: what would be read wrongly is refused, or noted."""

import pandas as pd
import pytest

from neuroprior import Plans, read_plans
from tests.support.sources import refuses


def read(tmp_path, text, **options):
    path = tmp_path / "a.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_plans(path, **({"columns": {"action": "action"}} | options))


DATES = ["2024-01-05 10:00:00", "2024-01-05 10:00:10", "2024-01-05 10:01:00"]
STOPS = ["2024-01-05 10:00:04", "2024-01-05 10:00:20", "2024-01-05 10:01:01.5"]


@pytest.mark.parametrize("zone", [None, "UTC", "Europe/Helsinki"])
def test_durations_between_dates(zone, tmp_path):
    """Starts and stops are on one clock, whatever the first of each is, and in seconds with a time zone, too."""
    frame = pd.DataFrame({"action": list("aba"), "start": DATES, "stop": STOPS})
    if zone is None:
        assert read(tmp_path, frame.to_csv(index=False)).durations.tolist() == [[4, 10, 1.5]]
    for what in ("start", "stop"):
        frame[what] = pd.to_datetime(frame[what], format="ISO8601").dt.tz_localize(zone)
    assert Plans.from_dataframe(frame).durations.tolist() == [[4, 10, 1.5]]
    assert Plans.from_dataframe(frame.drop(columns="stop")).durations.nan_to_num().tolist() == [[10, 50, 0]]


@pytest.mark.parametrize(
    "dates", [("03/02/2024", "04/02/2024"), ("3.2.2024", "13.2.2024"), ("2024-02-03", "04/02/2024")]
)
def test_dates_whose_day_may_be_their_month(dates, tmp_path):
    with refuses("line 2", "start", dates[0], "year-month-day"):
        read(tmp_path, f"action,start\na,{dates[0]}\nb,{dates[1]}\n")


@pytest.mark.parametrize(
    ("text", "note"),
    [
        ("action,start\na,23:59:50\nb,00:00:10\n", "times of day go back from 23:59:50 to 00:00:10"),
        ("action,start,stop\na,0,10\nb,5,6\na,7,9\n", "1 actions begin before the one before them ended"),
        (
            "action,start,stop,duration\na,0,1,1.001\nb,5,6,1\na,7,9,3\n",
            "line 4, are not the time from start to stop; the column of durations counts",
        ),
        ("action,start,stop,duration\na,0,yes,1\nb,5,no,1\n", "the stops are not read as times"),
        ("action,start,stop,duration\na,0,0:00:01,1\nb,5,0:00:06,1\n", "the stops are not read as times"),
        # In the order of the file, not of time.
        ("action,start,stop,duration\na,8,9,3\nb,5,6,1\na,1,3,4\n", "line 2, are not the time from start to stop"),
        (",action\n0,a\n1,b\n", "columns that are not used: (without a name, column 1)"),
        ("action\nGr\u00fcn\nGru\u0308n\n", "are nearly the same"),
        (
            "action\nRear\nrear\nGroom\ngroom\n",
            "actions 'Rear' and 'rear', 'Groom' and 'groom' are nearly the same; rename them if they mean the same",
        ),
        ("action\n1000000000\n1\n", "of which 0, 2, 3, 4, 5, 6, 7, 8 and 999,999,991 more never occur"),
    ],
)
def test_what_is_noted(text, note, tmp_path):
    notes = read(tmp_path, text).notes
    assert any(note in one for one in notes), notes


def test_nothing_is_noted_of_plain_tables(tmp_path):
    assert not read(tmp_path, "action,start,stop\na,0:00:01,0:00:02\nb,0:00:02,0:00:05\n").notes
    late = "group,action,start\nx,a,0:00:01\nx,b,23:00:00\ny,a,0:10:00\n"
    assert all("go back" not in note for note in read(tmp_path, late).notes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("plan,action\n1,a\n".encode("utf-16-le"), ["line 1", "UTF-16"]),
        ("<!DOCTYPE html><html><body>Not found</body></html>", ["a web page"]),
        ("action,context\na,\nb,x\nc,\n", ["line 2", "context: an empty cell (2 in all)", "not known"]),
        ('action,duration\na,"1,5"\n', ["line 2", "'1,5'", "a decimal point"]),
        ("action,start\na,10:05\nb,10:06\n", ["line 2", "'10:05'", "hours and minutes, or minutes and seconds"]),
        ("action,start\na,1:10:05\nb,10:06\n", ["line 3", "'10:06'", "hours and minutes, or minutes and seconds"]),
        ("action,start\na,59.5\nb,1:00.5\n", ["line 3", "'1:00.5'", "or as numbers"]),
        ("action,start\na,1:00:75\n", ["line 2", "'1:00:75'", "below 60"]),
        ("action,start\na,1:75:00\n", ["line 2", "'1:75:00'", "below 60"]),
        ("action,start,stop\na,5,0:00:06\n", ["stop", "times of day", "numbers in another"]),
        ("action,start,stop\na,2020-01-01 10:00:00,10:00:05\n", ["stop", "times of day", "dates in another"]),
        ("notes\nx,y\na,b\n", ["line 2: 2 cells", "further down", "columns.action"]),
    ],
)
def test_what_is_refused(text, words, tmp_path):
    with refuses("a.csv", *words):
        read(tmp_path, text)


@pytest.mark.parametrize("text", ["# made by x\n0\n1\n", "# made by x, v2\n0,1\n1,0\n", "#action\na\n"])
def test_comments_are_no_actions(text, tmp_path):
    with refuses("a.csv, line 1", "begins with #"):
        read(tmp_path, text, columns=None)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"columns": ["action"]}, ["columns", "['action']"]),
        ({"columns": {"action": 1}}, ["columns.action", "'1'", "not there"]),
        ({"max_gap": "3"}, ["max_gap", "'3'"]),
        ({"merge_repeats": "no"}, ["merge_repeats", "'no'"]),
    ],
)
def test_options_of_other_types(option, words, tmp_path):
    with refuses(*words):
        read(tmp_path, "plan,action\n1,a\n", **option)


@pytest.mark.parametrize("path", [None, 3, b"a.csv", pd.DataFrame()])
def test_what_is_no_name_of_a_file(path):
    with refuses("path", "name of a file"):
        read_plans(path)


def test_what_is_no_frame():
    with refuses("pandas frame", "dict"):
        Plans.from_dataframe({"action": ["a"]})
    numbered = pd.DataFrame([["x", "a"], ["x", "b"]])
    assert Plans.from_dataframe(numbered, action=1, plan=0).actions.tolist() == [[0, 1]]
