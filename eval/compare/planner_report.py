"""The report of `python -m eval compare --planners` and `depth`: planners with the same priors at equal model steps."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from eval.worlds.runs import across_table, across_worlds, difference_table, paired_differences, plus_minus, significance
from neuroprior.analysis.statistics import mean_intervals
from neuroprior.report.document import Document, table
from neuroprior.report.drawing import WIDTH, band, drawn, expect_some, legend, lines, panels
from neuroprior.report.page import FigureBox, Section, Table

PLACE = ["world", "planner", "prior", "sees", "num_plans"]
NAMES = {"prior": "prior", "context": "sees", "planner": "planner"}


def planner_document(
    results: Sequence[Mapping[str, Any]],
    settings: Mapping[str, Any],
    command: str,
    baseline: str = "sampling",
    title: str = "Planners compared",
) -> Document:
    """The tables and figures of the results of `planner_run`.

    Args:
        results: of all runs; each `entries` has a row a planner, prior and number of plans.
        settings, command: as the page shows them.
        baseline: the planner that the others are compared with.
        title: of the page.
    """
    frame = pd.DataFrame([{k: one[k] for k in ("world", "seed")} | entry for one in results for entry in one["entries"]])
    rows, pairs = planner_rows(frame), planner_pairs(frame, baseline)
    gaps = paired_differences(pairs, PLACE)
    # Worlds offer unlike contexts: of each, the last counts.
    last = pairs.drop_duplicates(["world", "planner", "prior", "num_plans", "seed"], keep="last")
    across = across_worlds(last, ["prior", "planner", "num_plans"])
    most = frame["num_plans"].max()
    score = "normalised score, % of the optimum"
    tables, boxes = [], []
    for world, about in {one["world"]: one["about"] for one in results}.items():
        here, learned = rows[rows["world"] == world], gaps[(gaps["world"] == world) & (gaps["prior"] != "uniform")]
        tables.append(planner_table(here, gaps, baseline))
        if len(shown := learned[learned["num_plans"] == most]):
            above = f"{world}, {most:,} plans: differences to {baseline}"
            tables.append(difference_table(shown, above, NAMES, score, 100))
        alt = f"Normalised score in {world} against model steps, a line a planner; the numbers are in the tables."
        caption = f"{world}: {about}. Bands: Student's 95 % intervals over seeds."
        boxes.append(FigureBox(planner_figure(here), caption, alt))
    if len(shown := across[across["num_plans"] == most]):
        names = {"prior": "prior", "planner": "planner"}
        tables.append(across_table(shown, names, "score", baseline, f"the {score}, {most:,} plans", 100))
    lead = significance(gaps, f"Normalised scores against {baseline}")
    sections = [
        Section("Normalised score against model steps", [], figures=boxes),
        Section("Tables", [], tables),
    ]
    frames = {"rows": rows, "paired": gaps, "across": across}
    return Document(title, lead, sections, frames, settings, command, {"words": [lead]})


def planner_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """The normalised score with its interval over seeds, a row a world, planner, prior and number of plans."""
    found = mean_intervals(frame, PLACE, "share")
    means = frame.groupby(PLACE, sort=False)[["model_steps", "seconds"]].mean().reset_index(drop=True)
    return found[PLACE].assign(
        model_steps=means["model_steps"],
        oracle_share=found["mean"],
        low=found["low"],
        high=found["high"],
        seconds_per_decision=means["seconds"],
        seeds=found["n"],
    )


def planner_pairs(frame: pd.DataFrame, baseline: str) -> pd.DataFrame:
    """A row a world, planner, prior, number of plans and seed: its score `first`, and `second` that of the baseline."""
    same = [name for name in [*PLACE, "seed"] if name != "planner"]
    base = frame[frame["planner"] == baseline]
    others = frame[frame["planner"] != baseline]
    return others.merge(base[[*same, "share"]], on=same).rename(columns={"share_x": "first", "share_y": "second"})


def planner_table(rows: pd.DataFrame, gaps: pd.DataFrame, baseline: str) -> Table:
    """Normalised scores in one world, a row a prior and planner; stars mark significant differences."""
    own = rows.merge(gaps[[*PLACE, "p_holm"]], "left", PLACE)
    own["score"] = [plus_minus(r, "oracle_share", 100) + "*" * bool(r["p_holm"] < 0.05) for _, r in own.iterrows()]
    cells = own.pivot_table("score", ["prior", "sees", "planner"], "num_plans", aggfunc="first", sort=False)
    cells = cells.sort_index(axis=1).rename(columns=lambda number: f"{number:,} plans")
    slowest = own[own["num_plans"] == own["num_plans"].max()].set_index(["prior", "sees", "planner"])
    cells["ms"] = 1000 * slowest["seconds_per_decision"]
    seeds, length = own["seeds"].max(), round((own["model_steps"] / own["num_plans"]).max())
    over = f" ±: half of Student's 95 % interval over {seeds} seeds." if seeds > 1 else " A single seed."
    star = f" *: p < 0.05 against {baseline} with the same prior, corrected for all tests in this world (Holm)."
    caption = (
        f"Normalised score, % of the optimum, with so many plans of {length} model steps each, or as many steps"
        f" otherwise spent; ms: of a decision with the most.{over}" + star * bool((own["p_holm"] < 0.05).any())
    )
    columns = NAMES | {name: name for name in cells.columns} | {"ms": "ms:.3g"}
    return table(cells.reset_index(), columns, caption, rows["world"].iloc[0], "lll" + "r" * len(cells.columns))


@drawn
def planner_figure(rows: pd.DataFrame) -> Figure:
    """Normalised score against model steps in one world, a panel a prior, a line a planner.

    Raises:
        ValueError: there are no rows.
    """
    expect_some("rows", rows)
    planners = list(dict.fromkeys(rows["planner"]))
    styles = dict(zip(planners, lines(planners), strict=True))
    # Most planners spend all steps that they may.
    places = rows.groupby("num_plans")["model_steps"].max().astype(int)
    priors = list(rows.groupby(["prior", "sees"], sort=False))
    figure, axes = panels(1, len(priors), (WIDTH, 3.2), sharey=True)
    for panel, ((prior, context), own) in zip(axes, priors, strict=True):
        for planner, some in own.groupby("planner", sort=False):
            points = some[["model_steps", "oracle_share", "low", "high"]].sort_values("model_steps")
            color, style = styles[planner]
            band(panel, list(points.itertuples(index=False, name=None)), color, planner, style)
        panel.set_xscale("log", base=2)
        panel.set_xticks(places, [f"{place:,}" for place in places])
        panel.set_title(prior if context == "none" else f"{prior}, context: {context}")
        panel.set_xlabel("model steps per start")
        panel.grid(axis="y")
    axes[0].set_ylabel("normalised score, % of the optimum")
    axes[0].yaxis.set_major_formatter(PercentFormatter(1, symbol=""))
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure
