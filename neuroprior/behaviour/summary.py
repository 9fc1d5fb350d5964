"""What recordings hold, as text and tables: columns, counts, behaviours, factors, first events."""

from collections.abc import Iterator, Sequence
from io import StringIO
from typing import Any

import pandas as pd
from rich.console import Console
from rich.table import Table

KEYS = ["recording", "subject"]
"""What tells timelines apart."""

MAX_ROWS = 40
"""Rows at most that are shown of a table; of behaviours all are."""

MAX_EVENTS = 8
"""Events at most that are shown."""

WIDTH = 160
"""Characters of a line of a summary."""


def render_summary(recordings: Any) -> str:
    """Return the text of what `describe` yields; see `Recordings.summary`."""
    text = StringIO()
    console = Console(file=text, width=WIDTH, highlight=False, markup=False, emoji=False)
    for line in describe(recordings):
        console.print(line, soft_wrap=isinstance(line, str))
    return text.getvalue()


def describe(recordings: Any) -> Iterator[str | Table]:
    """Yield what is shown of recordings, line by line and table by table."""
    yield from _describe_sources(recordings.sources)
    events, watched = recordings.events, recordings.watched
    yield (
        f"{len(events):,} events of {events['behaviour'].nunique():,} behaviours,"
        f" {recordings.num_recordings:,} recordings of {events['subject'].nunique():,} subjects"
    )
    gaps = len(watched) - len(watched[KEYS].drop_duplicates())
    time = f"{float((watched['stop'] - watched['start']).sum()):,.6g} {recordings.unit or 'units'} watched"
    yield f"{'no times are known' if watched['start'].isna().all() else time}, {gaps:,} gaps"
    for note in recordings.notes:
        yield f"note: {note}"
    if recordings.empty:
        yield f"recordings without events: {', '.join(recordings.empty[:MAX_ROWS])}"
    yield _table("Behaviours", recordings.behaviours(), all_rows=True)
    for factor in recordings.factors:
        counts = events.drop_duplicates(KEYS).groupby(["subject", factor]).size().unstack(fill_value=0)
        yield _table(f"Recordings by {factor}", _add_total(counts).reset_index())
    first = events[events[KEYS].eq(events[KEYS].iloc[0]).all(axis=1)]
    yield _table("The first events", first.head(MAX_EVENTS))


def _add_total(counts: pd.DataFrame) -> pd.DataFrame:
    """Return a table of recordings with the number of subjects of each level as its last row."""
    total = (counts > 0).sum().to_frame("subjects").T
    return pd.concat([counts, total]).rename_axis("subject")


def _describe_sources(sources: Sequence[Any]) -> Iterator[str | Table]:
    """Yield what the files were read as; files that were read alike share a line."""
    kinds: dict[tuple[str, str, str], list[Any]] = {}
    for source in sources:
        kinds.setdefault((source.program, source.layout, str(source.columns)), []).append(source)
    for (program, layout, _), alike in kinds.items():
        names = ", ".join(one.name for one in alike[:3]) + (f" and {len(alike) - 3} more" if len(alike) > 3 else "")
        yield f"{names}: {program or 'a table'}, {layout}"
        rows = [
            (use, _shorten(columns), "found" if use in alike[0].inferred else "named")
            for use, columns in alike[0].columns.items()
            if columns
        ]
        yield _table("Columns", pd.DataFrame(rows, columns=["use", "column", ""]))


def _format_cell(value: Any) -> str:
    return "" if value is None else f"{value:,.6g}" if isinstance(value, float) else str(value)


def _shorten(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 6 else f"{names[0]}, {names[1]}, ... {names[-1]} ({len(names)} columns)"


def _table(title: str, frame: pd.DataFrame, all_rows: bool = False) -> Table:
    """Return a table of `rich`, with its first `MAX_ROWS` rows or all."""
    table = Table(title=title, title_justify="left", box=None, padding=(0, 2, 0, 0))
    shown = frame if all_rows else frame.head(MAX_ROWS)
    for name in frame.columns:
        numeric = pd.api.types.is_numeric_dtype(frame[name])
        table.add_column(str(name), justify="right" if numeric else "left", overflow="fold")
    for row in shown.itertuples(index=False):
        table.add_row(*map(_format_cell, row))
    if len(shown) < len(frame):
        table.add_row(f"... {len(frame) - len(shown):,} more")
    return table
