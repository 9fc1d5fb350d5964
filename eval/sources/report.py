"""The report of `python -m eval sources`: scores of each source of candidates alone and of all together."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from eval.sources.run import PARTS, SOURCES
from eval.worlds import runs
from neuroprior.behaviour.reporting.document import Column, Document, table
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table

PLACE = ["part", "world", "plans"]


def sources_document(results: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], command: str) -> Document:
    """The tables of the results of `run_sources`: of all calls, and of their second half."""
    words = [f"{one['world']}, seed {one['seed']}: left out, {one['note']}." for one in results if one["note"]]
    frames: dict[str, pd.DataFrame] = {}
    tables: list[Table] = []
    if any(one["entries"] for one in results):
        frame = runs.frame_of(results)
        rows = source_rows(frame)
        parts = [rows[rows["part"] == calls] for calls in PARTS]
        frames, tables = {"rows": rows, "scores": frame}, [*map(source_table, parts)]
        words = [*map(finding, parts), *words]
    boxes = []
    if frames:
        caption = "Shared candidates minus the best source alone, by world; bars: 95 % intervals over seeds."
        alt = "How far shared candidates are ahead of the best source, in points; the numbers are in the table."
        boxes = [FigureBox(gap_figure(frames["rows"]), caption, alt, name="which_planner")]
    sections = [Section("Scores", tables=tables, figures=boxes)]
    return Document("Sources of candidates", " ".join(words), sections, frames, settings, command)


def source_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """A row a part, world and number of plans: mean scores, and how much higher `shared` is, with intervals.

    `over_best`: than the source that has the highest mean over seeds; `over_uniform`.
    """
    scores = frame[list(SOURCES)]
    means = frame.groupby(PLACE)[list(SOURCES)].transform("mean")
    best = scores.where(means.eq(means.max(axis=1), axis=0)).mean(axis=1)
    frame = frame.assign(over_best=frame["shared"] - best, over_uniform=frame["shared"] - frame["uniform"])
    rows = runs.seed_means(frame, PLACE, "over_best", ["learned", *SOURCES, "shared"])
    rows = rows.rename(columns={"low": "over_best_low", "high": "over_best_high"})
    uniform = runs.seed_means(frame, PLACE, "over_uniform")
    uniform = uniform.rename(columns={"low": "over_uniform_low", "high": "over_uniform_high"})
    return rows.merge(uniform.drop(columns="seeds"), on=PLACE)


def source_table(rows: pd.DataFrame) -> Table:
    """Scores in one part of the calls, a row a world and number of plans."""

    def number(row: Any) -> str:
        return f"{row['plans']} ({row['learned']:.0f})" if row["learned"] < row["plans"] else f"{row['plans']}"

    percent = 100 * rows[[*SOURCES, "shared"]]
    columns: dict[str, Column] = {"world": "world", "plans": number}
    columns |= {name: f"{name}:.1f" for name in (*SOURCES, "shared")}
    for gap, heading in (("over_best", "- best"), ("over_uniform", "- uniform")):
        columns[heading] = partial(runs.plus_minus, name=gap, factor=100, sign="+", ends=f"{gap}_")
    caption = (
        "Scores, %: 0: random plans, 100: the optimum, or the best that any reached. In brackets: how many plans were"
        " collected where they were fewer. - best: shared minus the source of the highest mean."
        f" {runs.over_seeds(rows)}"
    )
    title = f"Candidates by source: {rows['part'].iloc[0]}"
    return table(rows.assign(**percent), columns, caption, title, "l" + "r" * 8)


def gap_figure(rows: pd.DataFrame) -> Figure:
    """Shared candidates minus the best source, in all calls: a row a world, a mark a number of plans."""
    rows = rows[rows["part"] == PARTS[0]]
    worlds = list(dict.fromkeys(rows["world"]))
    figure = Figure(figsize=(6.4, 0.42 * len(worlds) + 0.9), layout="constrained")
    axes = figure.subplots()
    axes.axvline(0, color="0.6", linewidth=0.8)
    for k, (number, group) in enumerate(rows.groupby("plans")):
        height = [worlds.index(world) + 0.22 * (k - 1) for world in group["world"]]
        gap = 100 * group["over_best"]
        ends = [gap - 100 * group["over_best_low"], 100 * group["over_best_high"] - gap]
        axes.errorbar(gap, height, xerr=ends, fmt="o", markersize=3.5, linewidth=1, label=f"{number} plans")
    axes.set(yticks=range(len(worlds)), yticklabels=worlds, xlabel="shared minus best source, points of the optimum")
    axes.set_xlim(-20, 20)
    axes.invert_yaxis()
    axes.legend(frameon=False)
    return figure


def finding(rows: pd.DataFrame) -> str:
    """How often sources together are behind, and how far, in one sentence."""
    says = [
        f"{100 * rows[gap].mean():+.1f} points minus {other} (lowest {100 * rows[gap].min():+.1f}; 95 % interval below"
        f" 0 in {(rows[f'{gap}_high'] < 0).sum()}, above 0 in {(rows[f'{gap}_low'] > 0).sum()})"
        for gap, other in (("over_best", "the best source"), ("over_uniform", "uniform"))
    ]
    return f"{rows['part'].iloc[0].capitalize()}, mean of {len(rows)} settings: shared {', '.join(says)}."
