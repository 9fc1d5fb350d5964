"""`neuroprior check`: what files of behaviour are read as, before anything is computed."""

import shlex
from collections.abc import Iterator, Sequence

import pandas as pd
from rich.console import Console
from rich.table import Table

from neuroprior.behaviour.reading import Options, ReadingError
from neuroprior.behaviour.reading.read import read_recordings
from neuroprior.behaviour.recordings import Recordings, Source
from neuroprior.cli.reading import reading_words

MAX_ROWS = 40
"""Rows of a table that are shown; behaviours are shown all."""

SHOWN_EVENTS = 8


def check(files: list[str], reading: Options = Options()) -> None:  # noqa: B008
    """Show what files of behaviour are read as: columns, behaviours, subjects, gaps, and everything that is wrong.

    Args:
        files: of one study: tables of events, frames or sequences; folders and globs as well.
        reading: how they are read.
    """
    console = Console(soft_wrap=True, highlight=False)
    try:
        recordings = read_recordings(files, reading)
    except ReadingError as error:
        for problem in error.problems:
            console.print(f"problem: {problem}", markup=False)
        raise ValueError(f"{len(error.problems)} problems, and nothing is read") from None
    for line in describe(recordings):
        console.print(line, markup=False) if isinstance(line, str) else console.print(line)
    words = [*files, *reading_words(reading)]
    console.print(f"\nnext: neuroprior report {shlex.join(words)}", markup=False)


def describe(recordings: Recordings) -> Iterator[str | Table]:
    """Return what is shown of recordings, line by line and table by table."""
    yield from _sources(recordings.sources)
    events, watched = recordings.events, recordings.watched
    unit = recordings.unit or "units"
    time = float((watched["stop"] - watched["start"]).sum())
    yield (
        f"{len(events):,} events of {events['behaviour'].nunique():,} behaviours, {recordings.num_recordings:,}"
        " recordings"
        f" of {events['subject'].nunique():,} subjects"
    )
    gaps = len(watched) - len(watched[["recording", "subject"]].drop_duplicates())
    known = "no times are known" if watched["start"].isna().all() else f"{time:,.6g} {unit} watched"
    yield f"{known}, {gaps:,} gaps"
    for note in recordings.notes:
        yield f"note: {note}"
    if recordings.empty:
        yield f"recordings without events: {', '.join(recordings.empty[:MAX_ROWS])}"
    yield _table("Behaviours", recordings.behaviours(), all_rows=True)
    for factor in recordings.factors:
        counts = (
            events.drop_duplicates(["recording", "subject"]).groupby(["subject", factor]).size().unstack(fill_value=0)
        )
        yield _table(f"Recordings by {factor}", _with_total(counts).reset_index())
    first = events[
        (events["recording"] == events["recording"].iloc[0]) & (events["subject"] == events["subject"].iloc[0])
    ]
    yield _table("The first events", first.head(SHOWN_EVENTS))


def _with_total(counts: pd.DataFrame) -> pd.DataFrame:
    """Return a table of recordings with the number of subjects of each level as its last row."""
    return pd.concat(
        [counts, pd.DataFrame({level: [(counts[level] > 0).sum()] for level in counts}, index=["subjects"])]
    ).rename_axis("subject")


def _sources(sources: Sequence[Source]) -> Iterator[str | Table]:
    """Return as what the files were read; files that were read alike share a line."""
    kinds: dict[tuple[str, str, str], list[Source]] = {}
    for source in sources:
        kinds.setdefault((source.program, source.layout, str(source.columns)), []).append(source)
    for (program, layout, _), some in kinds.items():
        names = ", ".join(one.name for one in some[:3]) + (f" and {len(some) - 3} more" if len(some) > 3 else "")
        yield f"{names}: {program or 'a table'}, {layout}"
        rows = [
            (use, _shorten(columns), "found" if use in some[0].found else "named")
            for use, columns in some[0].columns.items()
            if columns
        ]
        yield _table("Columns", pd.DataFrame(rows, columns=["use", "column", ""]))


def _shorten(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 6 else f"{names[0]}, {names[1]}, ... {names[-1]} ({len(names)} columns)"


def _table(title: str, frame: pd.DataFrame, all_rows: bool = False) -> Table:
    table = Table(title=title, title_justify="left", box=None, padding=(0, 2, 0, 0))
    shown = frame if all_rows else frame.head(MAX_ROWS)
    for name in frame.columns:
        table.add_column(
            str(name), justify="right" if pd.api.types.is_numeric_dtype(frame[name]) else "left", overflow="fold"
        )
    for row in shown.itertuples(index=False):
        table.add_row(
            *("" if value is None else f"{value:,.6g}" if isinstance(value, float) else str(value) for value in row)
        )
    if len(shown) < len(frame):
        table.add_row(f"... {len(frame) - len(shown):,} more")
    return table
