"""What new users' files showed: each was read as other events once."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from neuroprior.behaviour import read


@pytest.fixture
def study(tmp_path):
    """A function that reads a text as the file `name`."""

    def read_text(text: str, columns: Any = None, name: str = "f.csv", **options: Any):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        return read(path, columns, **options)

    return read_text


def rows(recordings):
    """Recording, behaviour, start and stop of each event."""
    events = recordings.events[["recording", "behaviour", "start", "stop"]].astype(object)
    return [tuple(None if value != value else value for value in row) for row in events.itertuples(index=False)]


def test_labels_0_and_1_are_labels(study):
    found = study("subject,behavior,start,stop\na,0,0,5\na,1,5,6\na,0,6,9\n")
    assert rows(found) == [("f", "0", 0, 5), ("f", "1", 5, 6), ("f", "0", 6, 9)]


def test_names_that_are_there_twice_make_no_data_of_a_header(study):
    found = study("subject,behavior,start,stop,notes,notes\nm1,rest,0,2,a,b\nm1,eat,2,3,x,y\nm2,rest,3,5,,z\n")
    assert rows(found) == [("f", "rest", 0, 2), ("f", "eat", 2, 3), ("f", "rest", 3, 5)]


@pytest.mark.parametrize("columns", [None, {"behaviour": ["cluster_0", "cluster_1", "cluster_2"]}])
def test_numbered_columns_of_zeros_and_ones_are_behaviours(columns, study):
    on = [0, 0, 1, 1, 1, 2, 0]
    lines = [f"{i}," + ",".join(str(int(k == one)) for k in range(3)) for i, one in enumerate(on)]
    found = study("frame,cluster_0,cluster_1,cluster_2\n" + "\n".join(lines) + "\n", columns)
    due = [("cluster_0", 0, 2), ("cluster_1", 2, 5), ("cluster_2", 5, 6), ("cluster_0", 6, 7)]
    assert [row[1:] for row in rows(found)] == due
    assert len(study("action_1,action_2,action_3\n0,1,0\n1,0,0\n").events) == 6  # a plan a row


def test_days_do_not_lie_upon_one_another(study):
    found = study(
        "animal,date,behavior,start,end\na,2024-03-04,rest,14:00:00,14:00:10\n"
        "a,2024-03-04,walk,23:59:50,00:00:20\na,2024-03-05,rest,09:00:05,09:00:11\n"
    )
    assert found.events["behaviour"].tolist() == ["rest", "walk", "rest"]
    np.testing.assert_allclose(np.diff(found.events["start"]), [35990, 32415])
    np.testing.assert_allclose(found.events["stop"] - found.events["start"], [10, 30, 6])


def test_trials_of_a_session_are_recordings_of_their_own(study):
    found = study("session,trial,subject,behavior,start,stop\n1,1,a,rest,0,5\n1,2,a,sleep,0,4\n1,2,a,walk,4,6\n")
    assert [row[0] for row in rows(found)] == ["1|1", "1|2", "1|2"]
    choices = study("rat,trial,choice,rt\na,1,left,.5\na,2,right,.4\na,3,left,.6\n", {"behaviour": "choice"})
    assert [row[:2] for row in rows(choices)] == [("f", "left"), ("f", "right"), ("f", "left")]


def test_units_are_not_mixed(study, tmp_path):
    found = study("subject,behaviour,start (s),duration (ms)\na,groom,0,5000\na,rest,5,250\n")
    assert [row[2:] for row in rows(found)] == [(0, 5), (5, 5.25)]
    frames = study("subject,behaviour,start (s),stop frame\na,groom,0,100\na,rest,5,200\n")
    assert [row[3] for row in rows(frames)] == [None, None]
    study("subject,behaviour,start_ms,stop_ms\nb,groom,1000,1500\n", name="g.csv")
    both = read([tmp_path / "g.csv", tmp_path / "f.csv"], {"stop": "none", "duration": "none"})
    assert both.unit == "ms"
    assert both.events["start"].tolist() == [1000, 0, 5000]


def test_totals_are_no_events(study):
    with pytest.raises(ValueError, match=r"table of totals \(column .Total duration"):
        study("Subject,Behavior,Total duration (s),Duration mean (s)\na,rest,12.5,3.1\na,walk,7,1.75\n")


def test_channels_of_frames_are_each_read(study):
    mother, infant = ["", "groom", "groom", "groom", "rest", "rest"], ["sleep", "sleep", "sleep", "cry", "cry", "cry"]
    lines = [f"{i / 2},{a},{b}" for i, (a, b) in enumerate(zip(mother, infant, strict=True))]
    found = study("Time,Mother,Behaviour\n" + "\n".join(lines) + "\n")
    assert [row[1:] for row in rows(found)] == [
        ("sleep", 0, 1.5),
        ("groom", 0.5, 2),
        ("cry", 1.5, 3),
        ("rest", 2, 3),
    ]


def test_one_column_of_zeros_and_ones_is_watched_from_the_first_frame(study):
    found = study("frame,freezing\n" + "".join(f"{i},{int(3 <= i < 6)}\n" for i in range(10)))
    assert rows(found) == [("f", "freezing", 3, 6)]
    assert found.watched[["start", "stop"]].to_numpy().tolist() == [[0, 10]]


@pytest.mark.parametrize(
    ("cells", "due"),
    [
        (["A-B-C", "B"], [["A", "B", "C"], ["B"]]),
        (["A/3-B/2-A/1", "B/2"], [["A", "B", "A"], ["B"]]),
        (["rest > walk > eat", "eat > rest"], [["rest", "walk", "eat"], ["eat", "rest"]]),
        (
            ["self-groom rear self-groom", "rear self-groom"],
            [["self-groom", "rear", "self-groom"], ["rear", "self-groom"]],
        ),
    ],
)
def test_strings_of_sequences(cells, due):
    found = read(pd.DataFrame({"id": ["1", "2"], "sequence": cells}))
    assert [list(one) for _, one in found.events.groupby("recording", sort=False)["behaviour"]] == due


def test_times_in_other_languages(study):
    found = study("Tier;Verhalten;Startzeit;Endzeit\na;ruhen;0,5;1.200,25\na;gehen;1.200,25;1.201\n")
    assert [row[2:] for row in rows(found)] == [(0.5, 1200.25), (1200.25, 1201)]
    french = study("Sujet;Comportement;Début;Fin\na;repos;0;2,5\n")
    assert rows(french) == [("f", "repos", 0, 2.5)]


def test_an_index_of_times_is_the_time():
    labels = ["a"] * 4 + ["b"] * 5 + ["a"] * 3
    frame = pd.DataFrame({"label": labels}, index=pd.timedelta_range("0s", freq="500ms", periods=12))
    found = read(frame)
    assert found.events[["start", "stop"]].to_numpy().tolist() == [[0, 2], [2, 4.5], [4.5, 6]]


def test_frames_with_rounded_times_are_frames(study):
    labels = ["rest"] * 40 + ["walk"] * 25 + ["rest"] * 35
    found = study("time,label\n" + "".join(f"{i / 30:.3f},{one}\n" for i, one in enumerate(labels)))
    np.testing.assert_allclose(found.events["stop"], [40 / 30, 65 / 30, 100 / 30], atol=0.001)


def test_times_that_cannot_be_read_are_errors(study):
    with pytest.raises(ValueError, match="`start` must be a time"):
        study("animal,behaviour,start\na,x,00:00:01:12\na,y,00:00:02:13\n")
    half_days = study("animal,behaviour,start\na,x,09:00:00 AM\na,y,01:00:00 PM\n")
    assert half_days.events["start"].tolist() == [32400, 46800]


def test_files_are_told_apart_by_as_many_folders_as_it_takes(study, tmp_path):
    for place in ("m1/day1/a.csv", "m2/day1/a.csv", "m2/day1/a.tsv"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text("behaviour,start,stop\nrest,0,5\nwalk,5,7\n")
    (tmp_path / ".hidden").mkdir()
    (tmp_path / ".hidden" / "a.csv").write_text("behaviour,start,stop\nrest,0,5\n")
    found = read([tmp_path, tmp_path / "m1" / "day1" / "a.csv"])
    assert list(dict.fromkeys(row[0] for row in rows(found))) == ["m1/day1/a", "m2/day1/a.csv", "m2/day1/a.tsv"]


def test_clocks_beyond_a_day_are_not_moved(study):
    found = study("animal,behaviour,start,stop\na,rest,25:00:00,25:10:00\na,walk,25:10:00,26:00:00\n")
    assert [row[2:] for row in rows(found)] == [(90000, 90600), (90600, 93600)]


def test_the_line_of_a_missing_state_in_a_row_of_states(study):
    with pytest.raises(ValueError, match=r"line 4: `behaviour` must be known, got 'NA'"):
        study("id,s1,s2,s3\n1,A,B,C\n2,B,B,A\n3,NA,C,A\n", missing="error")


def test_agreement_counts_all_that_was_watched(study):
    text = "session,animal,behaviour,start,stop,scorer\n"
    first = [("s1", "rest", 0, 100)], [("s2", "rest", 0, 50), ("s2", "walk", 50, 60), ("s2", "rest", 60, 100)]
    for scorers, events in zip((("A", "B"), ("B", "A")), first, strict=True):
        for scorer in scorers:
            text += "".join(f"{s},m1,{b},{start},{stop},{scorer}\n" for s, b, start, stop in events)
    found = study(text, {"observer": "scorer"}).agreement().set_index("behaviour")
    assert found["time"].to_dict() == {"rest": 200, "walk": 200}
    assert set(found["first"]) == {"A"}
    assert found["kappa"].to_dict() == pytest.approx({"rest": 1, "walk": 1})


def test_an_error_in_one_of_like_sheets_is_no_other_kind(tmp_path):
    pytest.importorskip("openpyxl")
    pytest.importorskip("python_calamine")
    with pd.ExcelWriter(tmp_path / "f.xlsx") as book:
        for name, stop in (("day1", 5), ("day2", -1)):
            pd.DataFrame({"behaviour": ["rest"], "start": [0], "stop": [stop]}).to_excel(
                book, sheet_name=name, index=False
            )
    with pytest.raises(ValueError, match="sheet 'day2'"):
        read(tmp_path / "f.xlsx")


def test_two_observers_in_two_files_are_noted(study, tmp_path):
    starts = [3.0, 9.5, 19.1, 24.2, 29.4, 36.0, 41.3]
    for name, late in (("S1_Anna", 0.0), ("S1_Ben", 0.2), ("S2_Anna", 1.7)):
        lines = [f"m1,{'abc'[i * i % 3]},{start + late * (1 + i % 2)},{start + 4.2}" for i, start in enumerate(starts)]
        study("subject,behaviour,start,stop\n" + "\n".join(lines) + "\n", name=f"{name}.csv")
    notes = read(tmp_path).notes
    assert [note for note in notes if "nearly the same events" in note] == [
        "the recordings 'S1_Anna' and 'S1_Ben' of 'm1' hold nearly the same events: if two people scored one session,"
        " read the files of one of them"
    ]


@pytest.mark.parametrize(
    ("subjects", "due"),
    [
        (("", ""), ["a day 1/a day 1", "a day 2/a day 2", "b day 1/b day 1", "b day 2/b day 2"]),
        ((",m1", ",m2"), ["m1/day 1", "m1/day 2", "m2/day 1", "m2/day 2"]),
    ],
    ids=["unknown", "known"],
)
def test_recordings_of_one_name_in_two_files_are_two_unless_their_subjects_are_known(subjects, due, study, tmp_path):
    for name, subject, label in zip("ab", subjects, ("rest", "walk"), strict=True):
        rows = [f"{day},{label},{start}{subject}" for day in ("day 1", "day 2") for start in (1, 2, 4)]
        header = "session,behaviour,start" + ",animal" * bool(subject)
        (tmp_path / f"{name}.csv").write_text("\n".join([header, *rows]) + "\n")
    recordings = read([tmp_path / "a.csv", tmp_path / "b.csv"])
    timelines = recordings.events.drop_duplicates(["recording", "subject"])
    assert list(timelines["subject"] + "/" + timelines["recording"]) == due
    assert any("files' names are put before" in note for note in recordings.notes) == (not subjects[0])
