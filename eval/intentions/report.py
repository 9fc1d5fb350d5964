"""The report of `python -m eval intentions`: what each observer makes of the agents, and how often it is right."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
import torch
from matplotlib.figure import Figure

from eval.intentions.calibration import calibration_error, filled_bins
from eval.intentions.grid import FORECAST_AFTER, SWITCH_AT
from eval.intentions.run import LABYRINTH
from eval.worlds import runs
from neuroprior._statistics import mean_interval
from neuroprior.behaviour.reporting.document import Column, Document, table
from neuroprior.behaviour.reporting.drawing import WIDTH, at_edges, band, drawn, legend, panels
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table

KINDS = {
    "uniform": "#7d838c",
    "straight": "#c8579a",
    "path": "#2e9e5b",
    "blind": "#9a5fd0",
    "blind, tempered": "#9a5fd0",
    "cell": "#3079d8",
    "cell, tempered": "#d9731a",
    "exact, sampled": "#000000",
    "exact": "#000000",
}
"""The observers of a grid, in order, and their colours."""

PAIRS = [(kind, "exact") for kind in KINDS if kind != "exact"]
PAIRS += [(f"{kind}, tempered", kind) for kind in ("blind", "cell")]
PAIRS += [(f"{kind}, {more}", kind) for more in ("posterior", "modes") for kind in ("node", "node, move")]
"""What is compared: the first minus the second."""

WHAT = (
    "uniform: knows nothing. straight, path: by progress towards each goal, were there no walls or through the grid."
    " blind, cell: a prior for each goal, of past moves alone or of the cell, too. tempered: likelihoods to a power"
    " chosen on held-out plans. exact: knows how agents act. plans: toward each goal."
)

SHOWN = [
    ("moves", "loss", "log-loss of the goal (nats), by observed moves", 1, 2),
    ("moves", "accuracy", "accuracy of the likeliest goal (%), by observed moves", 100, 1),
    ("way", "loss", "log-loss of the goal (nats), by % of the way", 1, 2),
    ("switched", "probability", f"probability (%) of the present goal, by moves after a switch at {SWITCH_AT}", 100, 1),
    ("cell", "loss", f"log-loss of the cell (nats), forecast after {FORECAST_AFTER} moves, by moves ahead", 1, 2),
    ("water", "loss", "log-loss (1/1000 nat) of reaching the water, by moves ahead", 1000, 1),
]
"""Measures, scores, titles of their tables, factors and digits."""

SCORES = ["loss", "accuracy", "probability"]

PLACE = ["world", "measure", "kind", "plans", "switch", "at"]
"""What is the same for the numbers of all seeds."""


def intentions_document(results: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], command: str) -> Document:
    """The tables of the results of `intentions_run`, and a figure of the grids."""
    frame = runs.frame_of(results)
    order = {kind: k for k, kind in enumerate(KINDS)}
    frame = frame.sort_values("kind", key=lambda kinds: kinds.map(order), kind="stable")
    # A column that no run has is empty.
    frame = frame.reindex(columns=[*PLACE, "seed", "agents", *SCORES, "sums"])
    counted, scored = frame[frame["sums"].notna()], frame[frame["sums"].isna()]
    long = scored.melt([*PLACE, "seed", "agents"], SCORES, "score").dropna(subset="value")
    rows = runs.seed_means(long, [*PLACE, "score"], "value", ["agents"])
    gaps = runs.paired_differences(compared(scored), ["world", "measure", "kind", "minus", "plans", "at"])
    errors = calibration_errors(counted)
    tables, leads = [], []
    for world in settings["worlds"]:
        means, more = (one[one["world"] == world] for one in (rows, gaps))
        for measure, score, title, factor, digits in SHOWN:
            chosen = means[(means["measure"] == measure) & (means["score"] == score)]
            gap = more[more["measure"] == measure]
            if len(chosen):
                tables.append(shown(chosen, measure, "value", f"{world}: {title}", factor, digits))
            if len(gap) and (measure, score) in (("moves", "loss"), ("water", "loss")):
                tables.append(shown(gap, measure, "difference", f"{world}: differences in {title}", factor, digits))
        if world != LABYRINTH:
            columns: dict[str, Column] = {"observer": "kind", "plans": _number}
            columns["error, %"] = lambda row: runs.plus_minus(row, "error", 100)
            caption = "Expected calibration error, all numbers of moves together; ±: jackknife over seeds."
            world_errors = errors[errors["world"] == world]
            tables.append(table(world_errors, columns, caption, f"{world}: calibration of goals"))
        leads.append(finding(more, world, settings))
    grids = [world for world in settings["worlds"] if world != LABYRINTH]
    caption = f"Above: log-loss of the goal (bands: Student's 95 % intervals over seeds). Below: reliability. {WHAT}"
    alt = (
        "Log-loss of the goal against observed moves, and how often goals are true against their forecast probability."
    )
    boxes = [FigureBox(observers_figure(rows, counted, grids), caption, alt, "intentions")] if grids else []
    sections = [Section("What observers know", figures=boxes), Section("Tables", tables=tables)]
    frames = {"rows": rows, "paired": gaps, "calibration": errors}
    return Document("Observed intentions", " ".join(leads), sections, frames, settings, command)


def compared(scored: pd.DataFrame) -> pd.DataFrame:
    """A row for each of `PAIRS`, place and seed: their losses, `first` and `second`."""
    losses, parts = scored.dropna(subset="loss").rename(columns={"loss": "first"}), []
    for kind, minus in PAIRS:
        # Observers that learned from nothing are compared with all numbers of plans.
        on = ["world", "measure", "at", "seed"] + ["plans"] * (minus != "exact")
        second = losses.loc[losses["kind"] == minus, [*on, "first"]].rename(columns={"first": "second"})
        parts.append(losses[losses["kind"] == kind].merge(second, on=on).assign(minus=minus))
    return pd.concat(parts)


def calibration_errors(counted: pd.DataFrame) -> pd.DataFrame:
    """The expected calibration error of each observer over all seeds, with the jackknife's interval over seeds."""
    rows = []
    for place, of_seeds in counted.groupby(["world", "kind", "plans"], sort=False):
        sums, number = torch.tensor(of_seeds["sums"].tolist(), dtype=torch.double), len(of_seeds)
        error = calibration_error(sums)
        ends = [float("nan")] * 2
        if number > 1:
            without = [calibration_error(sums[torch.arange(number) != k]) for k in range(number)]
            values = [number * error - (number - 1) * one for one in without]
            half = mean_interval(values).high - mean_interval(values).mean
            ends = [max(error - half, 0.0), error + half]
        rows.append((*place, error, *ends, number))
    return pd.DataFrame(rows, columns=["world", "kind", "plans", "error", "low", "high", "seeds"])


def _number(row: Any) -> str:
    return f"{row['plans']}" if row["plans"] else ""


def shown(rows: pd.DataFrame, measure: str, value: str, title: str, factor: float, digits: int) -> Table:
    """Means, or paired differences, of one measure in one world: a row an observer, a column a number of moves."""
    if "score" in rows and rows["score"].iloc[0] == "accuracy":
        rows = rows[~rows["kind"].str.endswith("tempered")]  # the same as of the likelihoods themselves
    signed = "+" if value == "difference" else ""
    cells = [runs.plus_minus(row, value, factor, digits, signed).replace(" ", "") for _, row in rows.iterrows()]
    at = (rows["at"] * (100 if measure == "way" else 1)).round().astype(int)
    names = {"observer": "kind"} | ({"minus": "minus"} if signed else {})
    names |= {"plans": "number"} if measure != "water" else {}
    names |= {"assumed": "switch"} if measure == "switched" else {}
    caption = "±: 95 % interval, paired by seed; more in paired.csv." if signed else runs.over_seeds(rows)
    what = WHAT if measure == "moves" and not signed else ""
    labelled = rows.assign(at=at, number=[_number(row) for _, row in rows.iterrows()])
    return runs.table_by(labelled, names, "at", cells, f"{caption} {what}".strip(), title)


def finding(gaps: pd.DataFrame, world: str, settings: Mapping[str, Any]) -> str:
    """How near priors come to exact inference, or what the posterior adds, in one sentence."""
    chosen = gaps[gaps["measure"].isin(["moves", "water"])]
    if chosen.empty:
        return f"{world}: differences need at least two seeds."
    last, most = chosen["at"].max(), max(settings["num_plans"])
    tempered = chosen["kind"].str.endswith("tempered") & (chosen["minus"] == "exact") & (chosen["plans"] == most)
    rows = [
        f"{row['kind']} minus {row['minus']} {runs.plus_minus(row, 'difference', 1, 4, '+')}"
        for _, row in chosen[(chosen["at"] == last) & (tempered | (world == LABYRINTH))].iterrows()
    ]
    learned = "" if world == LABYRINTH else f" {most} plans toward each goal and"
    return f"{world}, log-loss after{learned} {last:.0f} moves: {'; '.join(rows)}."


@drawn
def observers_figure(rows: pd.DataFrame, counted: pd.DataFrame, worlds: Sequence[str]) -> Figure:
    """Log-loss against observed moves, and below it reliability; a column a world."""
    numbers = sorted(number for number in rows["plans"].unique() if number)
    lines = {(kind, 0): "-" for kind in ("uniform", "straight", "path", "exact")}
    lines |= {("blind, tempered", numbers[-1]): "-"}
    for kind in ("cell", "cell, tempered"):
        lines |= {(kind, numbers[0]): ":", (kind, numbers[-1]): "-"}
    figure, axes = panels(2, len(worlds), (WIDTH, 6.4))
    for above, below, world in zip(axes[: len(worlds)], axes[len(worlds) :], worlds, strict=True):
        losses = rows[(rows["world"] == world) & (rows["measure"] == "moves") & (rows["score"] == "loss")]
        for (kind, number), style in lines.items():
            name = f"{kind}, {number} plans" if number else kind
            curve = losses[(losses["kind"] == kind) & (losses["plans"] == number)].sort_values("at")
            band(above, curve[["at", "value", "low", "high"]].to_numpy(float), KINDS[kind], name, style)
            counts = counted[(counted["world"] == world) & (counted["kind"] == kind) & (counted["plans"] == number)]
            if kind in ("exact", "cell", "cell, tempered"):
                sums = torch.tensor(counts["sums"].tolist(), dtype=torch.double)
                points = [[one.forecast, *one.true] for one in filled_bins(sums)]
                band(below, points, KINDS[kind], name, style)
        above.set_xscale("log", base=2)
        above.set_xticks(sorted(losses["at"].unique()), [f"{at:.0f}" for at in sorted(losses["at"].unique())])
        above.set(title=world, ylim=(0, None))
        below.plot([0, 1], [0, 1], color="#aaaaaa", lw=1, zorder=0)
        below.set(xlim=(0, 1), ylim=(0, 1))
    at_edges(axes[: len(worlds)], len(worlds), len(worlds), "observed moves", "log-loss of the goal, nats")
    at_edges(axes[len(worlds) :], len(worlds), len(worlds), "forecast probability of a goal", "how often it is true")
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure
