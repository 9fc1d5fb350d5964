"""Studies with known events are written in every layout, separator, encoding and vocabulary, and read back."""

import gzip
import io
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior.behaviour.reading import ReadingError, read

EXAMPLES = int(os.environ.get("NEUROPRIOR_EXAMPLES", "25"))
"""Studies of each test; `NEUROPRIOR_EXAMPLES=1000` searches longer."""

NAMES = st.lists(
    st.sampled_from(["rest", "walk", "groom", "Rear", "eat é", "sniff (nose)", "dig-hole"]),
    min_size=2,
    max_size=5,
    unique=True,
)
USES = ("recording", "subject", "behaviour", "start", "stop", "duration")
VOCABULARIES = [
    dict(zip(USES, words, strict=True))
    for words in (
        ("session", "animal", "behaviour", "start", "stop", "duration"),
        ("Observation id", "Subject", "Behavior", "Start (s)", "Stop (s)", "Duration (s)"),
        ("video", "mouse_id", "Label", "onset_s", "offset_s", "bout_time"),
        ("Trial", "ID", "State", "Begin", "End", "Dur"),
    )
]
EVENT_WORDS = [
    ("START", "STOP"),
    ("State start", "State stop"),
    ("begin", "end"),
    ("onset", "offset"),
    ("on", "off"),
    ("1", "0"),
]


@st.composite
def studies(draw: Any) -> pd.DataFrame:
    """Events whose recordings, subjects, lengths, starts and gaps all differ."""
    names = draw(NAMES)
    rows = []
    for r in range(draw(st.integers(1, 3))):
        for s in range(draw(st.integers(1, 2))):
            now = draw(st.integers(0, 500))
            last = ""
            for _ in range(draw(st.integers(3, 9))):
                now += draw(st.sampled_from([0, 0, 0, 30, 170]))
                behaviour = draw(st.sampled_from([name for name in names if name != last]))
                length = draw(st.integers(10, 400))
                rows.append((f"s{r + 1}", f"m{r * 2 + s + 1}", behaviour, now / 10, (now + length) / 10))
                now, last = now + length, behaviour
    return pd.DataFrame(rows, columns=["recording", "subject", "behaviour", "start", "stop"])


def write(frame: pd.DataFrame, folder: str, separator: str, encoding: str, comma: bool, packed: str) -> str:
    """Write a table as text."""
    text = frame.map(
        lambda value: f"{value:g}".replace(".", "," if comma else ".") if isinstance(value, float) else value
    )
    content = text.to_csv(index=False, sep=separator).encode(encoding)
    name = "study.csv" if separator == "," else "study.txt"
    path = Path(folder) / (name + packed)
    if packed == ".gz":
        content = gzip.compress(content)
    elif packed == ".zip":
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr(name, content)
        content = buffer.getvalue()
    path.write_bytes(content)
    return str(path)


FILES = st.tuples(
    st.sampled_from([",", ";", "\t", "|"]),
    st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    st.booleans(),
    st.sampled_from(["", ".gz", ".zip"]),
)


def same_events(found: pd.DataFrame, study: pd.DataFrame, times: bool = True) -> None:
    keys = ["recording", "subject", "behaviour"]
    expected = study.sort_values(["recording", "subject", "start"], kind="stable").reset_index(drop=True)
    got = found.sort_values(["recording", "subject", "start"], kind="stable").reset_index(drop=True)
    assert got[keys].to_numpy().tolist() == expected[keys].to_numpy().tolist()
    if times:
        np.testing.assert_allclose(
            got[["start", "stop"]].to_numpy(float), expected[["start", "stop"]].to_numpy(float), atol=1e-9
        )


def read_back(frame: pd.DataFrame, file: tuple[str, str, bool, str], **options: Any) -> pd.DataFrame:
    separator, encoding, comma, packed = file
    with tempfile.TemporaryDirectory() as folder:
        path = write(frame, folder, separator, encoding, comma and separator != ",", packed)
        return read(path, **options).events


@settings(max_examples=EXAMPLES, deadline=None)
@given(
    study=studies(), file=FILES, words=st.sampled_from(VOCABULARIES), ends=st.sampled_from(["stop", "duration", "both"])
)
def test_rows_of_events(
    study: pd.DataFrame, file: tuple[str, str, bool, str], words: dict[str, str], ends: str
) -> None:
    table = study.assign(duration=study["stop"] - study["start"])
    table = table.drop(columns={"stop": ["duration"], "duration": ["stop"], "both": []}[ends]).rename(columns=words)
    same_events(read_back(table, file, ends="exclusive"), study)


@settings(max_examples=EXAMPLES, deadline=None)
@given(study=studies(), file=FILES, pair=st.sampled_from(EVENT_WORDS), order=st.sampled_from(["time", "behaviour"]))
def test_rows_of_starts_and_stops(
    study: pd.DataFrame, file: tuple[str, str, bool, str], pair: tuple[str, str], order: str
) -> None:
    begin = study.drop(columns="stop").rename(columns={"start": "time"}).assign(type=pair[0])
    end = study.drop(columns="start").rename(columns={"stop": "time"}).assign(type=pair[1])
    table = pd.concat([begin, end]).sort_values(
        ["recording", "subject", *([order] if order == "behaviour" else []), "time"], kind="stable"
    )
    same_events(read_back(table, file), study)


@settings(max_examples=EXAMPLES, deadline=None)
@given(study=studies(), file=FILES, words=st.sampled_from(VOCABULARIES))
def test_rows_of_frames_and_columns_of_behaviours(
    study: pd.DataFrame, file: tuple[str, str, bool, str], words: dict[str, str]
) -> None:
    parts = []
    for (recording, subject), one in study.groupby(["recording", "subject"], sort=False):
        frame = np.arange(round(one["stop"].max() * 10))
        now = (frame + 0.5) / 10
        at = np.searchsorted(one["start"].to_numpy(), now) - 1
        done = (at >= 0) & (now < one["stop"].to_numpy()[at])
        behaviour = np.where(done, one["behaviour"].to_numpy(object)[at], "")
        parts.append(
            pd.DataFrame({"time": frame / 10, "behaviour": behaviour}).assign(recording=recording, subject=subject)
        )
    frames = pd.concat(parts, ignore_index=True)[["recording", "subject", "time", "behaviour"]]
    runs = study.copy()  # a behaviour that goes on at once is one run
    same_events(
        read_back(frames.rename(columns={key: words[key] for key in ("recording", "subject", "behaviour")}), file), runs
    )
    indicators = frames.drop(columns="behaviour")
    for name in sorted(set(study["behaviour"])):
        indicators[name] = (frames["behaviour"] == name).astype(int)
    same_events(read_back(indicators, file), runs)


@settings(max_examples=EXAMPLES, deadline=None)
@given(study=studies(), file=FILES, header=st.sampled_from(["action_{}", "t{}", "{}", "Jan.{:02d}"]))
def test_rows_of_sequences(study: pd.DataFrame, file: tuple[str, str, bool, str], header: str) -> None:
    rows = [[subject, *one["behaviour"]] for subject, one in study.groupby("subject", sort=False)]
    width = max(map(len, rows))
    names = ["id", *(header.format(i + 1) for i in range(width - 1))]
    table = pd.DataFrame([[*row, *[""] * (width - len(row))] for row in rows], columns=names)
    try:
        found = read_back(table, file)
    except ReadingError:
        assert not header.startswith("action")  # other names tell nothing where columns share few labels
        return
    expected = study.assign(recording=study["subject"])
    same_events(found, expected, times=False)


@settings(max_examples=EXAMPLES, deadline=None)
@given(study=studies(), file=FILES)
def test_strings_of_sequences(study: pd.DataFrame, file: tuple[str, str, bool, str]) -> None:
    study = study.assign(behaviour=study["behaviour"].str.replace("[^A-Za-z]", "", regex=True))
    whole = study.assign(length=((study["stop"] - study["start"]) * 10).round().astype(int))
    strings = whole.groupby("subject", sort=False).apply(
        lambda one: "-".join(f"({name},{length})" for name, length in zip(one["behaviour"], one["length"], strict=True))
    )
    found = read_back(pd.DataFrame({"id": strings.index, "sequence": strings.to_numpy()}), file)
    assert found["behaviour"].tolist() == study["behaviour"].tolist()
    np.testing.assert_allclose(found["stop"] - found["start"], whole["length"])


@settings(max_examples=EXAMPLES, deadline=None)
@given(study=studies(), file=FILES, seed=st.integers(0, 99), extra=st.booleans())
def test_the_order_of_rows_other_columns_and_units_change_nothing(
    study: pd.DataFrame, file: tuple[str, str, bool, str], seed: int, extra: bool
) -> None:
    table = study.sample(frac=1, random_state=seed)
    table = table.assign(comment="nothing odd", number=np.arange(len(table)) % 3) if extra else table
    same_events(read_back(table, file, ends="exclusive"), study)
    clock = table.assign(
        **{
            use: [f"{int(t) // 3600:02d}:{int(t) // 60 % 60:02d}:{t % 60:06.3f}" for t in table[use]]
            for use in ("start", "stop")
        }
    )
    same_events(read_back(clock, file, ends="exclusive"), study)


@settings(max_examples=EXAMPLES, deadline=None)
@given(study=studies(), cut=st.integers(1, 200), file=FILES)
def test_a_file_that_is_cut_off_gives_no_other_events_silently(
    study: pd.DataFrame, cut: int, file: tuple[str, str, bool, str]
) -> None:
    separator, encoding, comma, _ = file
    with tempfile.TemporaryDirectory() as folder:
        path = Path(write(study, folder, separator, encoding, comma and separator != ",", ""))
        path.write_bytes(path.read_bytes()[:-cut])
        try:
            found = read(str(path), ends="exclusive")
        except ReadingError:
            return
        whole = {tuple(row) for row in study.round(6).itertuples(index=False)}
        odd = [
            row for row in found.events[list(study.columns)].round(6).itertuples(index=False) if tuple(row) not in whole
        ]
        # Only the last row can have lost a part of a cell: that it is short, or its number, cannot be seen.
        assert len(odd) <= 1


def test_a_named_column_that_is_none_is_listed_with_the_others() -> None:
    table = pd.DataFrame({"a": ["m1", "m1"], "b": ["x", "y"], "c": [0, 2]})
    with pytest.raises(ReadingError) as error:
        read(table, {"behaviour": "B!", "start": "seconds", "subject": "a"})
    assert len(error.value.problems) == 2
    assert "a, b, c" in error.value.problems[0]
