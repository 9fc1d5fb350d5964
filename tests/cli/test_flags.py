"""Each option of how files are read changes what is read, and nothing else: a table of the options themselves."""

import io
import re
from dataclasses import fields
from typing import Any

import numpy as np
import pandas as pd
import pytest
from jsonargparse import ArgumentParser

from neuroprior.behaviour import Recordings, read
from neuroprior.behaviour.reading import Columns, Options
from neuroprior.cli.reading import SPELLED, add_reading_arguments, pop_reading, reading_words

BOUTS = """id,who,act,more,from,until,seen,drug,room
s1,m1,walk,slow,0.5,2.5,A,d,x
s1,m1,walk,fast,2.5,4.0,A,d,x
s1,m1,n/a,fast,4.0,5.0,A,d,y
s1,m1,rest,slow,5.0,9.0,A,d,y
s2,m2,rest,slow,1.0,3.5,A,s,x
s2,m2,rear,fast,6.0,6.5,A,s,y
"""
LONG = "who,act,from,until,took\nm1,walk,0.5,2.5,1.0\nm1,rest,3.0,4.0,0.5\nm1,walk,5.0,9.0,3.0\n"
TWICE = "who,act,from,until\nm1,walk,0.5,2.5\nm1,walk,2.0,4.0\nm1,rest,6.0,9.0\n"
KEYS = "who,act,from,sign\nm1,walk,0.5,in\nm1,walk,2.0,out\nm1,rest,2.0,in\nm1,rest,7.5,out\nm1,walk,8.0,in\n"
DAYS = "who,act,from\nm1,walk,3/2/2024 10:00:00\nm1,rest,3/2/2024 10:00:09\nm1,walk,4/2/2024 10:00:11\n"

BASE = "--columns.behaviour act --columns.subject who --columns.start from"
STOPS = f"{BASE} --columns.stop until"
SESSIONS = f"{STOPS} --columns.recording id"
MARKS = f"{BASE} --columns.event_type sign --unpaired drop"


def at(time: str) -> float:
    return pd.Timestamp(time).timestamp()


CASES: dict[str, tuple[str, str, list[int], dict[str, list[Any]]]] = {
    # option: the table, the options beside it, which of the events are left, and what of these changes
    "columns.behaviour more": (
        BOUTS, f"{SESSIONS} --missing label", [*range(6)],
        {"behaviour": ["slow", "fast", "fast", "slow", "slow", "fast"]},
    ),
    "columns.subject room": (BOUTS, SESSIONS, [*range(5)], {"subject": [*"xxyxy"]}),
    "columns.recording room": (BOUTS, STOPS, [*range(5)], {"recording": [*"xxyxy"]}),
    "columns.start until": (LONG, BASE, [0, 1, 2], {"start": [2.5, 4.0, 9.0]}),
    "columns.stop until": (LONG, BASE, [0, 1, 2], {"stop": [2.5, 4.0, 9.0]}),
    "columns.duration took": (LONG, BASE, [0, 1, 2], {"stop": [1.5, 3.5, 8.0]}),
    "columns.event_type sign --words in=start out=stop --unpaired drop": (
        KEYS, BASE, [0, 2], {"stop": [2.0, 7.5]},
    ),
    "columns.observer seen": (BOUTS, SESSIONS, [*range(5)], {"observer": [*"AAAAA"]}),
    "columns.factors drug seen": (BOUTS, SESSIONS, [*range(5)], {"seen": [*"AAAAA"]}),
    "columns.context room": (BOUTS, SESSIONS, [*range(5)], {"room": [*"xxyxy"]}),
    "missing error": (BOUTS, SESSIONS, [], {}),
    "missing_words rear": (
        BOUTS, f"{SESSIONS} --missing label", [*range(6)],
        {"behaviour": ["walk", "walk", "n/a", "rest", "rest", "missing"]},
    ),
    "unpaired error": (KEYS, f"{MARKS} --words in=start out=stop", [], {}),
    "overlaps error": (TWICE, f"{STOPS} --overlaps keep", [], {}),
    "ends inclusive": (TWICE, f"{STOPS} --overlaps keep", [0, 1, 2], {"stop": [2.6, 4.1, 9.1]}),
    "day_first false": (
        DAYS, f"{BASE} --day_first true", [0, 1, 2],
        {"start": [at("2024-03-02 10:00:00"), at("2024-03-02 10:00:09"), at("2024-04-02 10:00:11")]},
    ),
    "words in=stop out=start": (KEYS, f"{MARKS} --words in=start out=stop", [], {}),
    "merge_repeats true": (BOUTS, SESSIONS, [0, 2, 3, 4], {"stop": [4.0, 9.0, 3.5, 6.5]}),
    "from 2.0": (BOUTS, SESSIONS, [*range(5)], {"start": [2.0, 2.5, 5.0, 2.0, 6.0]}),
    "to 6.0": (BOUTS, SESSIONS, [0, 1, 2, 3], {"stop": [2.5, 4.0, 6.0, 3.5]}),
    "drop rear walk": (BOUTS, SESSIONS, [2, 3], {}),
    "rename rear=up rest=lie": (BOUTS, SESSIONS, [*range(5)], {"behaviour": ["walk", "walk", "lie", "lie", "up"]}),
}  # fmt: skip


def recordings(table: str, options: str) -> Recordings:
    """What a table is read as, with options as a command line has them."""
    parser = ArgumentParser(exit_on_error=False)
    add_reading_arguments(parser, Options)
    reading = pop_reading(parser.parse_args(options.split()).as_dict(), Options)
    assert pop_reading(parser.parse_args(reading_words(reading)).as_dict(), Options) == reading
    frame = pd.read_csv(io.StringIO(table), dtype=str, keep_default_na=False)
    return read(frame, **{field.name: getattr(reading, field.name) for field in fields(Options)})


def events(table: str, options: str) -> pd.DataFrame:
    """The events of a table; none where it is refused."""
    try:
        return recordings(table, options).events
    except ValueError:
        return pd.DataFrame()


def test_no_option_is_left_out():
    names = [f"columns.{field.name}" for field in fields(Columns)]
    names += [SPELLED.get(field.name, field.name) for field in fields(Options) if field.name != "columns"]
    assert sorted(case.split()[0] for case in CASES) == sorted(names)


@pytest.mark.parametrize("option", CASES)
def test_an_option_changes_what_it_says_and_nothing_else(option):
    table, beside, left, changes = CASES[option]
    without, found = events(table, beside), events(table, f"{beside} --{option}")
    assert len(without)
    if not left:
        assert not without.equals(found)
        return
    expected = without.iloc[left].reset_index(drop=True).assign(**changes)
    assert not expected.equals(without)
    pd.testing.assert_frame_equal(found[sorted(found)], expected[sorted(expected)], check_dtype=False)


def test_a_row_in_which_nothing_was_done_ends_no_sequence():
    """The row of `n/a` stands between two of the first session; by default what follows is another sequence."""
    gap, nothing = (recordings(BOUTS, f"{SESSIONS} --missing {missing}") for missing in ("gap", "nothing"))
    assert gap.plans().mask().sum(1).tolist() == [2, 1, 2]
    assert nothing.plans().mask().sum(1).tolist() == [3, 2]
    assert (gap.watched["stop"] - gap.watched["start"]).sum() + 1 == (
        nothing.watched["stop"] - nothing.watched["start"]
    ).sum()
    assert "nothing was done in them" in " ".join(nothing.notes)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("table", "options"),
    [(BOUTS, SESSIONS), (TWICE, f"{STOPS} --overlaps keep"), (DAYS, f"{BASE} --day_first true"), (LONG, BASE)],
    ids=["bouts", "twice", "days", "long"],
)
def test_rows_in_another_order_are_the_same_recordings_with_the_same_notes(table, options, seed):
    """Beside the note that they are in another order, and the number of the row that a note names."""
    lines = table.splitlines()
    order = np.random.default_rng(seed).permutation(len(lines) - 1)
    first, other = recordings(table, options), recordings("\n".join([lines[0], *np.array(lines[1:])[order]]), options)
    assert sorted_events(other.events).equals(sorted_events(first.events))
    notes = [{re.sub(r" \(first in [^)]*\)", "", note) for note in one.notes} for one in (first, other)]
    assert notes[0] ^ notes[1] <= {"rows are not in the order of time, and are sorted by it"}


def sorted_events(events: pd.DataFrame) -> pd.DataFrame:
    return events.sort_values(["recording", "subject", "start"]).reset_index(drop=True)
