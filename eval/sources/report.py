"""The report of `python -m eval sources`: scores of each source of candidates alone and of all together."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from eval.sources.run import ALL, LATE, SOURCES
from eval.worlds import runs
from neuroprior.behaviour.report.document import Column, Document, table
from neuroprior.behaviour.report.page import Section, Table

PLACE = ["part", "world", "plans"]


def sources_document(results: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], command: str) -> Document:
    """The tables of the results of `run_sources`: of all calls, and of their second half."""
    notes = [f"{one['world']}, seed {one['seed']}: left out, {one['note']}." for one in results if one["note"]]
    frame = runs.frame_of(results)
    if frame.empty:
        return Document("Sources of candidates", " ".join(notes), [Section("Scores")], {}, settings, command)
    rows = source_rows(frame)
    parts = [rows[rows["part"] == part] for part in (ALL, LATE)]
    sections = [Section("Scores", tables=[source_table(part) for part in parts])]
    lead = " ".join([*map(finding, parts), *notes])
    return Document("Sources of candidates", lead, sections, {"rows": rows, "scores": frame}, settings, command)


def source_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """A row a part, world and number of plans: mean scores, and how much higher `shared` is, with intervals.

    `over_best`: than the source with the highest mean over seeds, whose name is `best`; `over_uniform`.
    """
    best = frame.groupby(PLACE)[list(SOURCES)].transform("mean").idxmax(axis=1)
    highest = [row[name] for (_, row), name in zip(frame.iterrows(), best, strict=True)]
    frame = frame.assign(
        best=best, over_best=frame["shared"] - highest, over_uniform=frame["shared"] - frame["uniform"]
    )
    rows = frame.groupby(PLACE, sort=False)["best"].first().reset_index()
    rows = rows.merge(runs.seed_means(frame, PLACE, "shared", ["learned", *SOURCES]).drop(columns=["low", "high"]))
    for gap in ("over_best", "over_uniform"):
        ends = {"low": f"{gap}_low", "high": f"{gap}_high"}
        rows = rows.merge(runs.seed_means(frame, PLACE, gap).rename(columns=ends).drop(columns="seeds"))
    return rows


def source_table(rows: pd.DataFrame) -> Table:
    """Scores in one part of the calls, a row a world and number of plans."""

    def number(row: Any) -> str:
        return f"{row['plans']}" if row["learned"] == row["plans"] else f"{row['plans']} ({row['learned']:.0f})"

    def score(name: str) -> Column:
        return lambda row: f"{100 * row[name]:.1f}"

    def gap(name: str) -> Column:
        return lambda row: runs.plus_minus(row, name, 100, sign="+", ends=f"{name}_")

    columns: dict[str, Column] = {"world": "world", "plans": number}
    columns |= {name: score(name) for name in (*SOURCES, "shared")}
    columns |= {"- best": gap("over_best"), "- uniform": gap("over_uniform")}
    caption = (
        "Scores in %: 0: random plans, 100: the optimum, or the best that any reached. In brackets: plans that were"
        " collected where they are fewer than asked for. - best: shared minus the source of the highest mean score."
        f" {runs.over_seeds(rows)}"
    )
    return table(rows, columns, caption, f"Candidates by source: {rows['part'].iloc[0]}", "l" + "r" * 8)


def finding(rows: pd.DataFrame) -> str:
    """How often sources together are behind, and how far, in one sentence."""
    lowest, uniform = rows.loc[rows["over_best"].idxmin()], rows["over_uniform"]
    return (
        f"{rows['part'].iloc[0].capitalize()}: shared minus the best source is {100 * rows['over_best'].mean():+.1f}"
        f" points in the mean of {len(rows)} settings, at least {100 * lowest['over_best']:+.1f} ({lowest['world']},"
        f" {lowest['plans']} plans), its 95 % interval below 0 in {(rows['over_best_high'] < 0).sum()}; shared minus"
        f" uniform is at least {100 * uniform.min():+.1f}, its interval below 0 in"
        f" {(rows['over_uniform_high'] < 0).sum()}."
    )
