"""Kinds of files that laboratories have, each small: what is right, or what the line of error says."""

import io
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from neuroprior.behaviour import Recordings, read


@pytest.fixture
def study(tmp_path: Path) -> Any:
    """A function that reads a text as the file `name`."""

    def read_text(text: str, columns: Any = None, name: str = "f.csv", **options: Any) -> Recordings:
        (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return read(tmp_path / name, columns, **options)

    return read_text


def rows(recordings: Recordings) -> list[tuple[Any, ...]]:
    """Subject, behaviour, start and stop of each event; None for an unknown time."""
    events = recordings.events[["subject", "behaviour", "start", "stop"]].astype(object)
    return [tuple(None if value != value else value for value in row) for row in events.itertuples(index=False)]


def labels(recordings: Recordings) -> list[list[str]]:
    """The behaviours of each subject."""
    return [list(one) for _, one in recordings.events.groupby(["recording", "subject"], sort=False)["behaviour"]]


@pytest.mark.parametrize("header", ["{}", "family{}", "t.{}", "V{}"])
def test_a_header_of_numbers_is_none_of_the_sequences(header, study):
    first = ",".join(header.format(i) for i in (1, 2, 3, 4))
    found = study(f"{first}\n2,1,1,0\n1,1,2,2\n0,2,0,1\n")
    assert labels(found) == [[*"2110"], [*"1122"], [*"0201"]]


def test_a_column_that_counts_the_rows_is_no_action(study):
    assert labels(study(",0,1,2\n0,2,1,1\n1,0,1,2\n2,1,1,0\n")) == [[*"211"], [*"012"], [*"110"]]
    assert labels(study("animal\tbehaviour\n1\tm1\trest\n2\tm1\twalk\n")) == [["rest", "walk"]]  # R's names of rows


def test_without_a_header_the_first_line_is_data(study):
    assert labels(study("1,1,2,2\n2,2,2,1\n")) == [[*"1122"], [*"2221"]]
    audacity = study("0.5\t1.25\tsong\n\\\t6441.0\t12296.5\n2.0\t2.0\tclick\n", name="bird 7.txt")
    assert rows(audacity) == [("bird 7", "song", 0.5, 1.25), ("bird 7", "click", 2.0, 2.0)]


BORIS = "Observation id,Duration,Subject,Behavior,Start (s),Stop (s)\n"
BORIS += "o1,{},m1,rest,0,5\no1,{},m1,walk,5,7\no2,{},m2,rest,0,3\n"


@pytest.mark.parametrize("length", ["", "600"])
@pytest.mark.parametrize("columns", [None, {"start": "Start (s)", "stop": "Stop (s)", "behaviour": "Behavior"}])
def test_what_is_named_beats_what_is_found(length, columns, study):
    found = study(BORIS.format(*[length] * 3), columns)
    assert rows(found) == [("m1", "rest", 0, 5), ("m1", "walk", 5, 7), ("m2", "rest", 0, 3)]
    named = study(BORIS.format(6, 2, 4), {"duration": "Duration"})
    assert [stop for *_, stop in rows(named)] == [6, 7, 4]
    assert any("the durations count" in note for note in named.notes)


def test_found_columns_that_hold_something_else_are_noted_and_can_be_left_out(study):
    found = study("animal,behaviour,start\nm1,rest,yes\nm1,walk,no\n")
    assert rows(found) == [("m1", "rest", None, None), ("m1", "walk", None, None)]
    assert any("'start' holds no times" in note for note in found.notes)
    varies = study("session,animal,behaviour,condition\n1,m1,rest,calm\n1,m1,walk,windy\n")
    assert varies.factors == ()
    assert any("'condition' varies" in note for note in varies.notes)
    off = study("animal,behaviour,start\nm1,rest,1\nm1,walk,2\n", {"start": "none"})
    assert rows(off) == [("m1", "rest", None, None), ("m1", "walk", None, None)]


def test_an_empty_duration_beside_a_stop_is_known(study):
    found = study(
        "plan,action,start,stop,duration\no1,rest,0,100,\no1,walk,100,103,3\no1,peck,103,103,NA\no1,rest,103,,97\n"
    )
    assert [stop - start for *_, start, stop in rows(found)] == [100, 3, 0, 97]
    assert len(found.plans(max_gap=10)) == 1


@pytest.mark.parametrize(
    ("start", "stop"),
    [("START", "STOP"), ("State start", "State stop"), ("start", "complete"), ("begin", "end"), ("on", "off")],
)
def test_words_for_starts_and_stops(start, stop, study):
    text = "subject,behavior,event_type,time\nc1,Lying,{0},0\nc1,Lying,{1},5.2\n"
    text += "c1,Walking,{0},5.2\nc1,Sniff,Point,7\nc1,Walking,{1},10\n"
    assert rows(study(text.format(start, stop))) == [
        ("c1", "Lying", 0, 5.2),
        ("c1", "Walking", 5.2, 10),
        ("c1", "Sniff", 7, 7),
    ]
    own = text.replace("event_type", "kind").format("in", "out")
    told = study(own, {"event_type": "kind"}, words={"in": "start", "out": "stop"})
    assert len(told.events) == 3
    with pytest.raises(ValueError, match=r"line 2: `event_type` must be a word .* got 'in'.*--words in=start"):
        study(own, {"event_type": "kind"})


def test_of_two_starts_at_once_a_stop_closes_the_earlier(study):
    tie = "plan,action,type,time\no,walk,START,0\no,walk,START,2\no,walk,STOP,2\n"
    tie += "o,walk,STOP,5\no,nod,START,7\no,nod,STOP,7\n"
    assert rows(study(tie)) == [("o", "walk", 0, 2), ("o", "walk", 2, 5), ("o", "nod", 7, 7)]


def test_unpaired_rows_are_listed_dropped_or_open(study):
    text = "plan,action,type,time\no,walk,START,0\no,walk,STOP,2\no,rest,STOP,3\n"
    text += "o,eat,START,3\no,eat,STOP,9\no,dig,START,9\n"
    with pytest.raises(
        ValueError, match=r"line 4: 'rest' has a stop without a start; --unpaired drop .*\(2 rows: 4, 7\)"
    ):
        study(text)
    assert rows(study(text, unpaired="drop")) == [("o", "walk", 0, 2), ("o", "eat", 3, 9)]
    kept = study(text, unpaired="open")
    assert rows(kept) == [("o", "walk", 0, 2), ("o", "eat", 3, 9), ("o", "dig", 9, None)]
    assert any(note.startswith("2 rows are starts or stops without the other") for note in kept.notes)


def test_a_behaviour_of_several_columns(study):
    text = (
        "Observation id,Subject,Behavior,Modifier #1,Behavior type,Time\n"
        "o1,f,walk,A,START,0\no1,f,walk,B,START,2\no1,f,walk,A,STOP,3\no1,f,walk,B,STOP,5\no1,f,rest,,START,5\no1,f,rest,,STOP,9\n"
    )
    due = [("f", "walk|A", 0, 3), ("f", "walk|B", 2, 5), ("f", "rest", 5, 9)]
    assert rows(study(text, {"behaviour": ["Behavior", "Modifier #1"]})) == due
    assert rows(study(text, {"behaviour": "Behavior,Modifier #1"})) == due
    assert rows(study(text, {"behaviour": pd.Index(["Behavior", "Modifier #1"])})) == due
    with pytest.raises(ValueError, match=r"--columns\.behaviour 'Behavior,Modifier #1'"):
        study(text)


def test_an_empty_column_of_subjects_is_left_out(study):
    text = (
        "Observation id,Subject,Behavior,Behavior type,Time\no1,,sniff,START,5.5\no1,,sniff,STOP,7\no2,,groom,POINT,3\n"
    )
    found = study(text, {"subject": "Subject"})
    assert rows(found) == [("o1", "sniff", 5.5, 7), ("o2", "groom", 3, 3)]
    assert any("'Subject' is empty" in note for note in found.notes)


def test_rows_of_commas_totals_and_units(study):
    assert labels(study("animal,session,behaviour\nm1,1,rest\nm1,1,walk\n,,\n,,\n")) == [["rest", "walk"]]
    total = study("animal,session,behaviour\nm1,1,rest\nm1,1,walk\nTotal,,\n")
    assert labels(total) == [["rest", "walk"]]
    assert any("line 4" in note for note in total.notes)
    units = study("animal;behaviour;start\n;;s\nm1;rest;0,5\nm1;walk;1,5\n")
    assert rows(units) == [("m1", "rest", 0.5, None), ("m1", "walk", 1.5, None)]
    assert units.unit == "s"


def test_negative_labels_stand_for_none(study):
    found = study("animal,label\nm1,3\nm1,3\nm1,-1\nm1,2\nm2,0\nm2,-1\nm2,-1\nm2,1\n")
    assert [[*map(str, one)] for one in labels(found)] == [["3", "3", "2"], ["0", "1"]]
    assert len(found.plans()) == 4
    kept = study("animal,label\nm1,3\nm1,-1\n", rename={"-1": "noise"})
    assert labels(kept) == [["3", "noise"]]


def test_contexts_that_are_measurements_are_features(study):
    heading = study("animal,behaviour,heading\nm1,a,-90\nm1,b,0\nm1,a,90\nm2,b,45\n", {"context": "heading"}).plans()
    assert heading.context.tolist() == [[[-90], [0], [90]], [[45], [0], [0]]]
    mixed = study("animal,behaviour,zone\nm1,w,0\nm1,1,far\nm1,w,0\n", {"context": "zone"}).plans()
    assert (mixed.action_names, mixed.context_names) == (("1", "w"), ("0", "far"))
    assert mixed.context.tolist() == [[0, 1, 0]]


def test_ends_that_are_inclusive(study):
    text = "id,begin,end,state\n1,1,3,school\n1,4,4,out\n1,5,20,work\n2,1,10,school\n2,11,11,out\n2,12,20,work\n"
    found = study(text)
    assert [stop - start for *_, start, stop in rows(found)] == [3, 1, 16, 10, 1, 9]
    assert "--ends exclusive" in found.notes[0]
    assert [stop - start for *_, start, stop in rows(study(text, ends="exclusive"))] == [2, 0, 15, 9, 0, 8]


def test_rows_of_frames_are_bouts_and_blank_frames_are_watched(study):
    frames = [("", 5), ("groom", 7), ("", 3), ("dig", 4), ("groom", 6), ("", 2)]
    cells = [label for label, count in frames for _ in range(count)]
    text = "Time,Behaviour,animal\n" + "".join(f"{i / 25:.2f},{cell},m0\n" for i, cell in enumerate(cells))
    found = study(text)
    np.testing.assert_allclose(found.events["start"], [0.2, 0.6, 0.76])
    np.testing.assert_allclose(found.events["stop"], [0.48, 0.76, 1.0])
    assert found.watched[["start", "stop"]].to_numpy().tolist() == [[0.0, pytest.approx(1.08)]]
    assert len(found.plans()) == 1


def test_columns_of_behaviours(study):
    on = [(1, 0, 0)] * 4 + [(0, 1, 0)] * 3 + [(0, 1, 1)] * 2 + [(0, 0, 1)] * 5 + [(-1, -1, -1)] * 2 + [(1, 0, 0)]
    text = ",background,attack,sniff\n" + "".join(f"{i},{','.join(map(str, one))}\n" for i, one in enumerate(on))
    found = study(text)
    due = [("f", "background", 0, 4), ("f", "attack", 4, 9), ("f", "sniff", 7, 14), ("f", "background", 16, 17)]
    assert rows(found) == due
    assert found.sources[0].program == "DeepEthogram, labels"
    assert found.watched[["start", "stop"]].to_numpy().tolist() == [[0, 14], [16, 17]]
    joined = study(text, overlaps="join")
    assert labels(joined) == [["background", "attack", "attack+sniff", "sniff", "background"]]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("f.csv", "animal\tbehaviour\nm1\trest\nm1\twalk é\n".encode("utf-16-le")),
        ("f.tsv", 'sep=;\nanimal;behaviour\nm1;rest\nm1;"walk é"\n'.encode()),
    ],
)
def test_encodings_and_separators(name, content, study):
    assert labels(study(content, name=name)) == [["rest", "walk é"]]


@pytest.mark.parametrize("suffix", [".xlsx", ".parquet", ".feather"])
def test_workbooks_and_binary_tables(suffix, tmp_path):
    pytest.importorskip("pyarrow")
    frame = pd.DataFrame(
        {"animal": ["m1", "m1", "m2"], "behaviour": ["rest", "walk", "rest"], "start": [0, 1.5, 2], "stop": [1.5, 2, 9]}
    )
    if suffix == ".xlsx":
        pytest.importorskip("openpyxl")
        pytest.importorskip("python_calamine")
        with pd.ExcelWriter(tmp_path / "f.xlsx") as book:
            frame.to_excel(book, sheet_name="events", index=False)
            pd.DataFrame({"code": ["r"], "meaning": ["rest"]}).to_excel(book, sheet_name="ethogram", index=False)
    else:
        (frame.to_parquet if suffix == ".parquet" else frame.to_feather)(tmp_path / f"f{suffix}")
    found = read(tmp_path / f"f{suffix}")
    assert rows(found) == [("m1", "rest", 0, 1.5), ("m1", "walk", 1.5, 2), ("m2", "rest", 2, 9)]
    assert (suffix == ".xlsx") == any("ethogram" in note for note in found.notes)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"PK\x03\x04\x14\x00 cut off", "zip archive or workbook"),
        (b"\x1f\x8b\x08\x00 cut", "gzip"),
        (b"<!DOCTYPE html><html></html>", "web page"),
        (b"\x00\x01\x02\x03\x00\x00\x00\x07\x08\x09\x10", "binary"),
        (b"  \n", "empty file"),
        (b"start,stop\n0,1\n2,3\n", "--columns.behaviour"),
        (
            b"animal,behaviour,start\nm1,a,soon\nm1,b,2\nm1,a,3\nm1,b,late\nm1,a,7\n",
            "line 2: `start` must be a number, got 'soon' (2 rows: 2, 5)",
        ),
        (b"animal,behaviour,start,stop\nm1,a,1,0\nm1,b,2,3\n", "line 2: `stop` must not be before `start`"),
        (b"animal,behaviour,start\nm1,a,01/02/2024\nm1,b,03/04/2024\n", "--day_first"),
        (b"animal,behaviour,start\nm1,a,10:20\nm1,b,11:30\n", "h:m:s"),
        (b"animal,behaviour,start\nm1,a,1,9\nm1,b,2\nm1,b,3\n", "line 2: a row must have 3 cells"),
    ],
)
def test_what_cannot_be_read_is_one_line(content, words, study):
    with pytest.raises(ValueError, match=re.escape(words)) as error:
        study(content)
    assert "f.csv" in str(error.value)


def test_the_header_is_the_line_with_most_of_the_names(study):
    text = (
        "Observation id,o1,,\n,,,\nMedia file,a.mp4,,\n\nTime,Subject,Behavior,Status\n3.3,s1,s,START\n7.7,s1,s,STOP\n"
    )
    for columns in (None, {"behaviour": "Behavior", "recording": "Observation id"}):
        found = study(text, columns)
        assert rows(found) == [("s1", "s", 3.3, 7.7)]
        assert found.events["recording"].tolist() == ["o1"]


def test_labels_that_are_unknown_to_a_prior_are_an_error_or_gaps(study):
    found = study("animal,behaviour\nm1,a\nm1,b\nm1,new\nm1,a\nm2,b\n")
    with pytest.raises(ValueError, match=r"'new' is none of a, b \(1 events\).*--unknown gap"):
        found.plans(action_names=["a", "b"])
    plans = found.plans(action_names=["a", "b"], unknown="gap")
    assert plans.actions.tolist() == [[0, 1], [0, 0], [1, 0]]
    assert plans.lengths.tolist() == [2, 1, 1]


def test_times_of_day_go_on_over_midnight(study):
    text = "animal,behaviour,start,stop\nm1,rest,23:58:12,23:59:23.5\n"
    text += "m1,feed,23:59:23.5,00:00:22\nm1,rest,00:00:22,00:01:32\n"
    found = study(text)
    np.testing.assert_allclose(found.events["start"], [86292, 86363.5, 86422])
    np.testing.assert_allclose(found.events["stop"] - found.events["start"], [71.5, 58.5, 70])
    assert "midnight" in found.notes[0]


def test_dates_with_the_day_first(study):
    found = study(
        "animal,behaviour,start\nm1,a,31/12/2023 23:59:58\nm1,b,01/01/2024 00:00:03\nm1,a,02/01/2024 00:00:03\n"
    )
    np.testing.assert_allclose(np.diff(found.events["start"]), [5, 86400])
    told = study("animal,behaviour,start\nm1,a,01/02/2024\nm1,b,02/02/2024\n", day_first=True)
    assert np.diff(told.events["start"]).tolist() == [86400]


def test_sessions_without_a_name_are_kept_apart(study):
    one = "".join(f"m1,{'abc'[i % 3]},{i * 2},{i * 2 + 2}\n" for i in range(6))
    found = study("animal,behaviour,start,stop\n" + one + one)
    assert labels(found) == [[*"abcabc"], [*"abcabc"]]
    assert "starts again" in found.notes[0]
    by_behaviour = sorted(one.splitlines(), key=lambda line: line.split(",")[1])  # merely in another order
    assert labels(study("animal,behaviour,start,stop\n" + "\n".join(by_behaviour) + "\n")) == [[*"abcabc"]]


def test_two_observers_of_one_session_are_refused_or_kept_apart(study):
    anna = [("walk", 0, 4), ("rest", 4, 9), ("walk", 9, 14)]
    text = "session,animal,behaviour,start,stop,scored by\n"
    text += "".join(
        f"s1,m1,{b},{start},{stop},Anna\ns1,m1,{b},{start + 0.2},{stop + 0.3},Ben\n" for b, start, stop in anna
    )
    with pytest.raises(ValueError, match="overlap another of the same subject"):
        study(text)
    with pytest.raises(ValueError, match="overlap another"):
        study(text, {"observer": "none"})
    found = study(text, {"observer": "scored by"})
    assert found.events["observer"].value_counts().to_dict() == {"Anna": 3, "Ben": 3}
    assert found.plans().actions.tolist() == [[1, 0, 1]]
    kappa = found.agreement().set_index("behaviour")["kappa"]
    # Of the 13.8 s that both watched, 4 and 3.8 and 5 and 4.8 s are walk in the eyes of both: counted by hand.
    both, a, b, time = 3.8 + 4.8, 3.8 + 5, 4.1 + 4.8, 13.8
    agree, chance = (both + time - a - b + both) / time, a / time * b / time + (1 - a / time) * (1 - b / time)
    assert kappa["walk"] == pytest.approx((agree - chance) / (1 - chance))


def test_several_files_are_one_study(tmp_path):
    for name, start in (("cage2_day1", 3), ("cage1_day1", 0)):
        (tmp_path / f"{name}.csv").write_text(
            f"subject;behaviour;start;stop;treatment\nm1;rest;{start},5;5;drug\nm2;walk;5;7;none\n"
        )
    (tmp_path / "empty.csv").write_text("subject;behaviour;start;stop;treatment\n")
    found = read(tmp_path)
    assert sorted(set(found.events["recording"])) == ["cage1_day1", "cage2_day1"]
    assert found.empty == ("empty",)
    assert found.num_recordings == 5
    pd.testing.assert_frame_equal(read(str(tmp_path / "*.csv")).events, found.events)
    assert read([tmp_path / "cage1_day1.csv"]).num_recordings == 2


def test_bad_options_are_one_line(study):
    for options, words in (
        ({"missing": "drop"}, "missing"),
        ({"from_": 3, "to": 1}, "from_"),
        ({"drop": ["x"]}, "'x'"),
    ):
        with pytest.raises(ValueError, match=words):
            study("animal,behaviour,start\nm1,a,0\nm1,b,2\n", **options)


def test_focal_data_of_jwatcher(study):
    """What stands above the first line of data is none; the end of the session is no behaviour."""
    above = "FirstLineOfData=5\n# Format: Focal Data File Version 1.0\nFocalAnimal=ant 7\n# ----\n"
    found = study(above + "0,f\n1500, r\n\n4250,f\n6000,EOF\n", name="ant 7.dat")
    assert rows(found) == [("ant 7", "f", 0.0, None), ("ant 7", "r", 1500.0, None), ("ant 7", "f", 4250.0, None)]
    assert found.unit == "ms"
    assert any("JWatcher" in note for note in found.notes)


FRAMES = "aaabbbbccccaaabbcccc", "ccccbbbbaaaabbbbaaaa"
"""Labels of two subjects at twenty frames."""


def bouts_of_frames(step: float = 1.0, begin: float = 0.0) -> list[tuple[Any, ...]]:
    """Runs of `FRAMES` by hand, of the subjects x and y."""
    ends = {"x": [3, 7, 11, 14, 16, 20], "y": [4, 8, 12, 16, 20]}
    return [
        (subject, label, begin + step * start, begin + step * stop)
        for subject, labels in (("x", "abcabc"), ("y", "cbaba"))
        for label, start, stop in zip(labels, [0, *ends[subject][:-1]], ends[subject], strict=True)
    ]


@pytest.mark.parametrize(
    ("header", "times", "step", "begin", "columns"),
    [
        ("frame,{},{}", range(20), 1.0, 0.0, None),
        ("Time (s),{},{}", [0.5 + i / 4 for i in range(20)], 0.25, 0.5, None),
        ("clock,{},{}", [f"0:{i // 6:02d}:{i % 6 * 10:02d}" for i in range(20)], 10.0, 0.0, {"start": "clock"}),
        ("n,{},{}", range(20), 1.0, 0.0, {"subject": "{}:{}"}),
    ],
)
def test_a_column_of_labels_for_each_subject(header, times, step, begin, columns, study):
    """A row is a frame: its time, or the user, says so."""
    lines = [f"{time},{x},{y}" for time, x, y in zip(times, *FRAMES, strict=True)]
    uses = columns and {use: name.format("x", "y") for use, name in columns.items()}
    recordings = study("\n".join([header.format("x", "y"), *lines]) + "\n", uses)
    assert rows(recordings) == bouts_of_frames(step, begin)
    assert "(--columns.behaviour 'x:y' if each row is a sequence)" in str(recordings.notes)


def test_whether_a_row_is_a_frame_or_a_sequence(study):
    """The names of subjects say it; what may be either is refused, until the user says which it is."""
    lines = [f"{x},{y},{x}" for x, y in zip(*FRAMES, strict=True)]
    mice = study("\n".join(["mouse 2,mouse 5,mouse 9", *lines]) + "\n")
    assert labels(mice) == [[*"abcabc"], [*"cbaba"], [*"abcabc"]]
    text = "\n".join(["p3,p5,p8", *lines]) + "\n"
    with pytest.raises(ValueError, match=r"--columns.subject 'p3:p8'.*--columns.behaviour 'p3:p8'"):
        study(text)
    assert labels(study(text, {"subject": "p3:p8"})) == labels(mice)
    assert labels(study(text, {"behaviour": "p3:p8"}))[:4] == [[*"aca"], [*"aca"], [*"aca"], [*"bcb"]]
    assert labels(study(text, {"behaviour": "p3:p5"}))[:4] == [[*"ac"], [*"ac"], [*"ac"], [*"bc"]]
    # A cell may be as the one above it since nearly all of its column are alike.
    routes = [f"a,{'ab'[row % 2]},{'ba'[row % 3 % 2]},b" for row in range(24)]
    assert labels(study("\n".join(["w1,w2,w3,w4", *routes]) + "\n"))[1] == [*"abab"]
    # A diary: each row is a day, whose cells are as those before them.
    days = ["wplm"[day % 4] * 7 + "sh"[day % 2] * 6 for day in range(28)]
    header = ",".join(["date", *(f"h{hour}" for hour in range(13))])
    diary = [",".join([f"2024-02-{number:02d}", *day]) for number, day in enumerate(days, 1)]
    assert labels(study("\n".join([header, *diary]) + "\n")) == [[*day] for day in days]


def array(values: Any) -> bytes:
    """The bytes of a `.npy` file."""
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "name"),
    [
        ('[{"animal": "m1", "what": {"behaviour": "a"}}, {"animal": "m2", "what": {"behaviour": "b"}}]', "f.json"),
        ('{"animal": "m1", "behaviour": "a"}\n{"animal": "m2", "behaviour": "b"}\n', "f.json"),
        ('{"animal": {"0": "m1", "5": "m2"}, "behaviour": {"0": "a", "5": "b"}}', "f.json"),
        ('{"study": {"animal": ["m1", "m2"], "behaviour": ["a", "b"]}}', "f.json"),
        ('{"columns": ["animal", "behaviour"], "index": [0, 1], "data": [["m1", "a"], ["m2", "b"]]}', "f.txt"),
        ('{"schema": {}, "data": [{"animal": "m1", "behaviour": "a"}, {"animal": "m2", "behaviour": "b"}]}', "f.json"),
        (array(np.array([("m1", "a"), ("m2", "b")], [("animal", "U2"), ("behaviour", "U1")])), "f.npy"),
    ],
)
def test_documents_are_tables(content, name, study):
    assert rows(study(content, name=name)) == [("m1", "a", None, None), ("m2", "b", None, None)]


@pytest.mark.parametrize(
    ("content", "name"),
    [
        ('{"m1": ["a", "b", "a"], "m2": ["b", "b"]}', "f.json"),
        ('[["a", "b", "a"], ["b", "b"]]', "f.json"),
        ('[{"id": "m1", "labels": ["a", "b", "a"]}, {"id": "m2", "labels": ["b", "b"]}]', "f.json"),
        (array(np.array([["a", "b", "a"], ["b", "b", ""]])), "f.npy"),
    ],
)
def test_documents_are_sequences(content, name, study):
    assert labels(study(content, name=name)) == [[*"aba"], [*"bb"]]


def test_an_array_of_labels_is_a_recording(study):
    recordings = study(array(np.array([3, 3, 0], np.int16)), name="day 2.npy", merge_repeats=True)
    assert labels(recordings) == [["3", "0"]]
    assert set(recordings.events["recording"]) == {"day 2"}
    with pytest.raises(ValueError, match="whole numbers or texts, got float64"):
        study(array(np.array([0.5, 1.0])), name="f.npy")
    with pytest.raises(ValueError, match="one or two dimensions"):
        study(array(np.zeros((2, 2, 2), int)), name="f.npy")


@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        (array([1, 2])[:-3], "f.npy", "whole array"),
        (array(np.array([{}], object)), "f.npy", "whole array"),
        (b"\x80\x04\x95 ", "f.pkl", "a pickle"),
        (b"MATLAB 5.0 MAT-file, Platform", "f.mat", "MATLAB data"),
        ('{"animal": "m1"', "f.json", "whole JSON"),
        ('{"animal": "m1", "n": 3}', "f.json", "another form"),
        ('[{"labels": [["a"]]}]', "f.json", "deeper lists"),
        ('{"columns": ["animal", "behaviour"], "data": [["m1", "a", 3]]}', "f.json", "must fit its `columns`"),
        ("[" * 100_000, "f.json", "nested too deep"),
    ],
)
def test_files_that_are_no_tables_are_refused_in_a_line(content, name, words, study):
    with pytest.raises(ValueError, match=words) as error:
        study(content, name=name)
    assert name in str(error.value)
    assert "\n" not in str(error.value)


TIMES_OF_DAY = [
    (["8:00 AM", "12:30 pm", "1:15 PM"], [0, 4.5, 5.25]),
    (["2024-05-01 8:00 AM", "2024-05-01 12:30:00 pm", "2024-05-02 12:00 am"], [0, 4.5, 16]),
    (["5/13/2024 8:00 p.m.", "5/13/2024 11:30 p.m.", "5/14/2024 9:30 a.m."], [0, 3.5, 13.5]),
    (["2024-05-01 8:00", "2024-05-01 09:30", "2024-05-01 10:00"], [0, 1.5, 2]),
]


@pytest.mark.parametrize(("times", "hours"), TIMES_OF_DAY)
def test_times_of_day_may_count_halves(times, hours, study):
    text = "animal,behaviour,start\n" + "".join(f"m1,a,{time}\n" for time in times)
    start = study(text).events["start"].to_numpy(float)
    assert (start - start[0]).tolist() == [3600 * hour for hour in hours]


def test_trials_of_one_choice_are_no_recordings(study):
    """A column that differs in each row of a subject counts its trials; one that does not tells its sessions apart."""
    lines = [f"r{1 + row // 6},{1 + row // 3 % 2},{1 + row % 6},{'LRRLLR'[row % 5]},{row % 2}" for row in range(12)]
    recordings = study("\n".join(["subj_id,session,trial,choice,reward", *lines]) + "\n")
    assert labels(recordings) == [[*"LRR"], [*"LLL"], [*"RRL"], [*"LLR"]]
    assert recordings.events["subject"].nunique() == 2
    recordings = study("\n".join(["worker_id,trial,picked", *(line[:3] + line[5:-2] for line in lines)]) + "\n")
    assert labels(recordings) == [[*"LRRLLL"], [*"RRLLLR"]]


def test_what_never_recurs_is_no_behaviour(study):
    songs = "\n".join(f"song{row}" for row in range(20))
    with pytest.raises(ValueError, match=r"must recur, got 20 different ones in 20 events, such as 'song0'"):
        study(songs + "\n", name="songs.txt")


def test_the_unit_of_durations_alone(study):
    assert study("animal,behaviour,dur_ms\nm1,a,20\nm1,b,7\n").unit == "ms"


def test_a_factor_that_is_empty_in_some_recordings_is_noted(study):
    rows = ["m1,a,drug", "m1,b,drug", "m2,b,", "m2,a,", "m3,a,saline", "m4,b,"]
    recordings = study("animal,behaviour,treatment\n" + "\n".join(rows) + "\n")
    notes = [note for note in recordings.notes if "'treatment'" in note]
    assert len(notes) == 1
    assert "empty in 2 of 4 recordings (first of 'm2')" in notes[0]


@pytest.mark.parametrize(
    ("text", "due"),
    [
        # Sessions that are numbered anew each day, with and without times; trials of one choice in sessions and blocks.
        (
            "animal,day,session,time,behaviour\n"
            "a,1,1,0,x\na,1,1,9,y\na,1,2,0,z\na,1,2,7,x\na,2,1,1,y\na,2,1,8,y\na,2,2,2,z\na,2,2,4,z\n",
            ["xy", "zx", "yy", "zz"],
        ),
        ("animal,day,behaviour\na,1,x\na,1,y\na,2,z\na,2,x\nb,1,y\nb,1,y\n", ["xy", "zx", "yy"]),
        ("id,session,trial,choice\na,1,1,l\na,1,2,l\na,1,3,r\na,2,1,r\na,2,2,l\nb,1,1,r\n", ["llr", "rl", "r"]),
        ("id,block,trial,choice\na,1,1,l\na,1,2,l\na,2,1,r\na,2,2,r\nb,1,1,r\n", ["ll", "rr", "r"]),
        ("id,session,block,trial,choice\na,1,A,1,l\na,1,B,2,l\na,1,A,3,r\na,2,B,1,r\na,2,B,2,r\n", ["llr", "rr"]),
        ("id,session,trial_number,choice\na,1,1,l\na,1,2,l\na,2,1,r\nb,1,1,r\nb,1,2,l\n", ["ll", "r", "rl"]),
        # Times without days go on, so that a new day is no new recording.
        ("animal,day,session,time,behaviour\na,1,s,0,x\na,1,s,9,y\na,2,s,20,z\na,2,s,27,x\n", ["xyzx"]),
        # Subjects by other names.
        ("AnimalID,time,behaviour\nm1,0,x\nm2,1,y\nm1,2,x\nm2,3,z\n", ["xx", "yz"]),
        ("Tier-Nr.;Zeit;Verhalten\nm1;0;x\nm2;1;y\nm1;2;x\nm2;3;z\n", ["xx", "yz"]),
        ("Participant name,time,behaviour\nm1,0,x\nm2,1,y\nm1,2,x\nm2,3,z\n", ["xx", "yz"]),
        ("dog,time,behaviour\nm1,0,x\nm1,2,x\nm2,1,y\nm2,3,z\n", ["xx", "yz"]),
        ("cage,time,behaviour\nm1,0,x\nm1,2,x\nm2,1,y\nm2,3,z\n", ["xx", "yz"]),
        # Merged cells.
        ("animal,session,behaviour\na,1,x\n,,y\n,2,z\n,,x\nb,1,x\n,,x\n", ["xy", "zx", "xx"]),
        # Sequences as lists, paths, letters, and beside another text.
        ("id,labels\na,\"['x', 'y', 'x']\"\nb,\"['z', 'x']\"\n", ["xyx", "zx"]),
        ("id,sequence\na,[1 2 1]\nb,[2  2]\n", ["121", "22"]),
        ("visitor,path\na,x > y > x\nb,z > x\nb,x > z\n", ["xyx", "zx", "xz"]),
        ("id,sequence\na,XYXXYZXXYX\nb,YXYYXZYYXX\nc,ZZYXX\n", ["XYXXYZXXYX", "YXYYXZYYXX", "ZZYXX"]),
        ("id,codes,outcome\na,x|y|x,alive\nb,y|x,dead\nc,x|z,dead\nd,y|y,alive\n", ["xyx", "yx", "xz", "yy"]),
        # Numbers that give the order of rows.
        ("id,order,behaviour\na,3,x\na,1,y\na,2,z\nb,2,x\nb,1,y\n", ["yzx", "yx"]),
        ("id,session,trial,choice\na,1,2,l\na,1,1,r\na,1,3,l\nb,1,1,r\nb,1,2,r\n", ["rll", "rr"]),
        # What looks alike, and is not: a week that was entered twice, kinds of blocks, numbers of what has none.
        ("id,week,state\na,1,x\na,2,y\na,3,x\na,3,z\na,4,y\nb,1,x\nb,2,x\n", ["xyxzy", "xx"]),
        ("id,trial,block,choice\na,1,easy,l\na,2,easy,r\na,3,hard,l\na,4,hard,l\na,5,easy,r\na,6,easy,r\n", ["lrllrr"]),
        ("time,behaviour,BehaviourID\n0,x,1\n1,y,2\n2,x,1\n3,z,3\n", ["xyxz"]),
        ("time,behaviour,cat\n0,x,self\n1,y,food\n2,x,self\n3,z,food\n", ["xyxz"]),
        ("TimeStamp,behaviour\n5,x\n2,y\n9,x\n7,z\n", ["yxzx"]),
        ("id,seq\na,\"['x y', 'z']\"\nb,\"['z', 'x y', 'z']\"\n", ["x yz", "zx yz"]),
        # Columns of subjects, of which one shows few of the labels of the others.
        ("time,Anna,Ben,Carl\n0,x,z,x\n1,x,z,x\n2,y,x,x\n3,y,x,z\n4,x,x,z\n", ["xyx", "zx", "xz"]),
    ],
)
def test_recordings_are_told_apart(text, due, study):
    assert list(map("".join, labels(study(text)))) == due


@pytest.mark.parametrize(
    ("header", "ends", "stops", "unit"),
    [
        ("Start (s),Duration (min)", (1, 1.5), (60, 150), "s"),
        ("start_min,Stop (s)", (90, 4200), (1.5, 70), "min"),
        ("Onset / h,Offset (h)", (1, 61.5), (1, 61.5), "h"),
        ("t_start [ms],t_stop [ms]", (1, 61.5), (1, 61.5), "ms"),
        ("Onset (µs),Duration (ms)", (1, 1.5), (1000, 1560), "us"),
    ],
)
def test_units_of_starts_and_of_stops(header, ends, stops, unit, study):
    recordings = study(f"animal,behaviour,{header}\na,x,0,{ends[0]}\na,y,60,{ends[1]}\n")
    assert tuple(recordings.events["stop"]) == pytest.approx(stops)
    assert recordings.unit == unit


def test_words_for_missing_are_no_levels_and_levels_alike_are_noted(study):
    recordings = study("id,treatment,behaviour\n1,drug,x\n2,Drug,x\n3,NA,y\n4,n/a,x\n5,saline,y\n")
    assert list(recordings.events["treatment"]) == ["drug", "Drug", "", "", "saline"]
    assert "the levels 'Drug' and 'drug' of 'treatment' are nearly alike" in recordings.notes


def test_recordings_of_sequences_are_named_by_what_divides_them(study):
    recordings = study("session,file,a1,a2,a3\n1,f1,x,y,x\n2,f2,y,y,x\n3,f3,x,x,z\n")
    assert list(recordings.events["recording"].unique()) == ["1", "2", "3"]


def test_two_levels_may_be_words_for_missing(study):
    for other in ("null", "-", "NA"):
        recordings = study(f"id,genotype,behaviour\n1,wt,x\n2,{other},x\n3,{other},y\n4,wt,x\n")
        assert list(recordings.events["genotype"]) == ["wt", other, other, "wt"]


def test_levels_go_on_within_a_subject_alone(study):
    recordings = study("id,treatment,behaviour\na,drug,x\na,,y\na,,x\nb,,x\nb,,y\nc,saline,x\nc,,x\n")
    assert list(recordings.events["treatment"]) == ["drug"] * 3 + [""] * 2 + ["saline"] * 2


def test_one_behaviour_a_row_in_columns_beside_starts_and_stops(study):
    recordings = study("start,stop,x,y,z\n0,4,1,0,0\n4,5,0,1,0\n5,11,1,0,0\n11,13,0,0,1\n")
    assert labels(recordings) == [["x", "y", "x", "z"]]


def test_objects_of_bouts(study):
    text = '{"v1": {"x": [[0, 1], [4, 6]], "y": [[1, 4]]}, "v2": {"y": [[2, 3]]}}'
    due = [("v1", "x", 0, 1), ("v1", "y", 1, 4), ("v1", "x", 4, 6), ("v2", "y", 2, 3)]
    assert rows(study(text, name="f.json")) == due
    assert rows(study('{"x": [[0, 1], [4, null]]}', name="f.json")) == [("f", "x", 0, 1), ("f", "x", 4, None)]


@pytest.mark.parametrize(
    ("text", "name", "due"),
    [
        ("animal,corner,correct,start,end\na,3,1,1,5.5\nb,1,0,20,23\na,2,1,30,33\n", "f.csv", "must hold behaviours"),
        ("2024-05-01 08:00:00,a,x\n2024-05-01 08:01:00,a,y\n2024-05-01 08:07:00,b,x\n", "f.csv", "must have a header"),
        ("[2024-05-01 08:00:00] a x y\n[2024-05-01 08:01:00] a y\n[2024-05-01 08:07:00] b\n", "f.txt", "must hold"),
        ("start_h,start_min,start_s,behaviour\n9,5,30,x\n9,5,41,y\n9,6,2,x\n", "f.csv", "must stand in one column"),
        ("id,seq\na,[1 2 ... 3 1]\nb,[2 2 ... 1 3]\n", "f.csv", "line 2: lists must be whole"),
        ("giraffe\nelephant\nlion\n" + "".join(f"{a}{b}ant\n" for a in "dghklmnp" for b in "aeo"), "f.txt", "recur"),
        ("subject,behaviour,bout number\na,x,3\na,y,5\nb,x,2\nb,y,7\n", "f.csv", "totals"),
        ('{"m1": {"x": [[{"y": 1}, 2]]}, "m2": {"x": [[1, 2]]}}', "f.json", "another form"),
        ('{"meta": {"v": ["x", "y"]}, "s": {"i": {"t": {"labels": [3, 3, 0]}}}}', "f.json", "another form"),
    ],
)
def test_what_was_misread_is_refused(text, name, due, study):
    with pytest.raises(ValueError, match=due):
        study(text, name=name)


def test_files_of_one_name_in_the_folders_of_an_archive_are_two(tmp_path):
    with zipfile.ZipFile(tmp_path / "f.zip", "w") as archive:
        for folder, label in (("drug", "x"), ("saline", "y")):
            archive.writestr(f"{folder}/m1.csv", f"behaviour,start\n{label},0\nz,3\n")
        archive.writestr(".DS_Store", b"\0\1")
    assert list(map("".join, labels(read(tmp_path / "f.zip")))) == ["xz", "yz"]


def test_an_event_log_has_starts_completions_and_completions_alone(study):
    header = "case:concept:name,concept:name,time:timestamp,lifecycle:transition\n"
    lines = [("a", "x", 0, "start"), ("a", "x", 4, "complete"), ("a", "y", 5, "complete"), ("a", "z", 6, "schedule")]
    lines += [("b", "y", 1, "complete"), ("b", "x", 2, "start"), ("b", "x", 9, "complete")]
    recordings = study(
        header + "".join(f"{case},{what},2024-05-01 08:00:0{at},{kind}\n" for case, what, at, kind in lines)
    )
    begin = recordings.events["start"].min()
    bouts = [(case, what, start - begin, stop - begin) for case, what, start, stop in rows(recordings)]
    assert bouts == [("a", "x", 0, 4), ("a", "y", 5, 5), ("b", "y", 1, 1), ("b", "x", 2, 9)]
    assert any("2 completions have no start" in note for note in recordings.notes)
    assert any("1 rows are neither starts nor completions (schedule)" in note for note in recordings.notes)


def test_labels_that_end_in_start_and_stop(study):
    lines = [
        ("a", 0, "rest start"),
        ("a", 1, "walk_ON"),
        ("a", 3, "rest stop"),
        ("a", 4, "walk_off"),
        ("b", 2, "rest start"),
    ]
    lines += [("b", 9, "rest stop")]
    recordings = study("animal,time,event\n" + "".join(f"{animal},{at},{what}\n" for animal, at, what in lines))
    assert rows(recordings) == [("a", "rest", 0, 3), ("a", "walk", 1, 4), ("b", "rest", 2, 9)]
    one = study("animal,time,event\na,0,lights on\na,2,rest\na,5,lights off\n")
    assert labels(one) == [["lights on", "rest", "lights off"]]
    jumps = study("animal,time,event\na,0,jump on\na,2,jump on\na,5,jump off\na,6,jump off\nb,3,jump on\nb,4,jump on\n")
    assert labels(jumps) == [["jump on", "jump on", "jump off", "jump off"], ["jump on", "jump on"]]


def test_the_length_of_the_session_is_no_duration(study):
    recordings = study("animal,time,behaviour,length_min\na,0,x,10\na,5,y,10\na,9,x,10\n")
    assert rows(recordings) == [("a", "x", 0, None), ("a", "y", 5, None), ("a", "x", 9, None)]


def test_a_stop_before_its_start_is_shown_as_it_is_written(study):
    with pytest.raises(ValueError, match="the stop 2024-10-27 02:05 is before the start 2024-10-27 02:55"):
        study(
            "animal,behaviour,start,stop\na,x,2024-10-27 02:55,2024-10-27 02:05\na,y,2024-10-27 03:00,2024-10-27 03:10"
        )


@pytest.mark.parametrize("legend_first", [True, False])
def test_the_sheet_of_the_events_is_read_wherever_the_legend_stands(legend_first, tmp_path):
    events = pd.DataFrame({"animal": [*"aabbab" * 2], "time": range(12), "behaviour": [*"xyxyzz" * 2]})
    legend = pd.DataFrame({"code": ["x", "y"], "behaviour": ["rest", "walk"]})
    pages = [("Ethogram", legend), ("Data", events), ("More", events.assign(animal="c"))]
    with pd.ExcelWriter(tmp_path / "f.xlsx") as file:
        for name, page in pages if legend_first else [*pages[1:], pages[0]]:
            page.to_excel(file, sheet_name=name, index=False)
    recordings = read(tmp_path / "f.xlsx")
    assert (len(recordings.events), set(recordings.events["subject"])) == (24, {"a", "b", "c"})
    assert any("Ethogram" in note and "not read" in note for note in recordings.notes)
