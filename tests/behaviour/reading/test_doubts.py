"""Notes on what a reader of shares of time and of conditions should know, each with its first line."""

from contextlib import chdir

import pytest

from neuroprior.behaviour import read
from tests.support.sources import refuses

HEADER = "animal,behaviour,start,stop,treatment\n"
SOUND = (
    *("m1,rest,0,4,saline", "m1,walk,4,6,saline", "m1,rest,7,9,saline"),
    *("m2,walk,0,3,drug", "m2,rest,3,5,drug", "m2,walk,6,7,drug", "m2,eat,8,9,drug"),
)


def notes_on(tmp_path, changes, **options):
    lines = [changes.get(number, line) for number, line in enumerate(SOUND, 2)]
    (tmp_path / "study.csv").write_text(HEADER + "\n".join(lines) + "\n")
    with chdir(tmp_path):
        return read("study.csv", **options).notes


def test_a_sound_file_needs_no_notes(tmp_path):
    assert not any(word in note for note in notes_on(tmp_path, {}) for word in ("stop", "ended", "varies"))


@pytest.mark.parametrize(
    ("changes", "options", "note"),
    [
        (
            {4: "m1,rest,7,,saline", 8: "m2,eat,8,,drug"},
            {},
            "2 of 7 events have no stop (first in study.csv, line 4): their durations are unknown"
            " (--ends next: until the next begins)",
        ),
        (
            {5: "m2,walk,0,3.5,drug", 7: "m2,walk,6,8.25,drug"},
            {},
            "2 of 7 bouts begin before another one has ended (first in study.csv, line 6): shares of time add up to"
            " more than 100 %",
        ),
        (
            {7: "m2,walk,6,7,saline"},
            {},
            "the column 'treatment' varies within recordings, and is not used as a factor (first in study.csv, line 7:"
            " 'saline' beside 'drug')",
        ),
    ],
)
def test_a_doubt_is_said_with_its_first_line(changes, options, note, tmp_path):
    assert note in notes_on(tmp_path, changes, **options)


def test_where_each_bout_ends_with_the_next_no_stop_is_missing(tmp_path):
    notes = notes_on(tmp_path, {4: "m1,rest,7,,saline", 8: "m2,eat,8,,drug"}, ends="next")
    assert not any("no stop" in note for note in notes)


def test_bouts_are_not_joined(tmp_path):
    with refuses("study.csv, line 2: `overlaps` must be error or keep in events, got 'join'"):
        notes_on(tmp_path, {}, overlaps="join")
