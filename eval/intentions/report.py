"""The report of `python -m eval intentions`: what each observer makes of the agents, and how often it is right."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
import torch
from matplotlib.figure import Figure

from eval.intentions.grid import SWITCH_AT
from eval.intentions.run import LABYRINTH
from eval.worlds import runs
from neuroprior.analysis.calibration import Reliability
from neuroprior.analysis.statistics import mean_interval
from neuroprior.report.document import Column, Document, table
from neuroprior.report.drawing import WIDTH, at_edges, band, drawn, legend, panels
from neuroprior.report.page import FigureBox, Section, Table

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
PAIRS += [(f"{kind}, posterior", kind) for kind in ("node", "node and last move")]
"""What is compared: the first minus the second."""

WHAT = (
    "uniform: knows nothing. straight, path: by progress towards each goal, were there no walls or through the grid."
    " blind, cell: a prior for each goal, of past moves alone or of the cell, too. tempered: likelihoods to a power"
    " chosen on held-out plans. exact: knows how agents act. plans: toward each goal."
)

PLACE = ["world", "measure", "kind", "plans", "switch", "at"]
"""What is the same for the numbers of all seeds."""


def intentions_document(results: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], command: str) -> Document:
    """The tables of the results of `intentions_run`, and a figure of the grids."""
    frame = runs.frame_of(results)
    order = {kind: k for k, kind in enumerate(KINDS)}
    frame = frame.sort_values("kind", key=lambda kinds: kinds.map(order), kind="stable")
    frame = frame.reindex(columns=[*frame.columns.union([*PLACE, "sums"], sort=False)])
    counted, scored = frame[frame["sums"].notna()], frame[frame["sums"].isna()]
    long = scored.melt([*PLACE, "seed", "agents"], ["loss", "accuracy", "probability"], "score").dropna(subset="value")
    rows = runs.seed_means(long, [*PLACE, "score"], "value", ["agents"])
    gaps = runs.paired_differences(compared(scored), ["world", "measure", "kind", "minus", "plans", "at"])
    errors = calibration_errors(counted)
    tables, leads = [], []
    for world in settings["worlds"]:
        own, more = (one[one["world"] == world] for one in (rows, gaps))
        if world == LABYRINTH:
            tables.append(score_table(own, "water", "loss", "log-loss of whether water is reached, by moves", 4))
            tables.append(gap_table(more, "water", "differences in log-loss, by moves", 4))
        else:
            tables.append(score_table(own, "moves", "loss", "log-loss of the goal, by observed moves"))
            tables.append(gap_table(more, "moves", "differences in log-loss, by observed moves"))
            tables.append(score_table(own, "moves", "accuracy", "accuracy, by observed moves"))
            tables.append(score_table(own, "way", "loss", "log-loss of the goal, by % of the way"))
            columns: dict[str, Column] = {
                "observer": "kind",
                "plans": _number,
                "error, %": lambda row: runs.plus_minus(row, "error", 100),
            }
            caption = f"Expected calibration error, all numbers of moves together; jackknife over seeds. {WHAT}"
            some = errors[errors["world"] == world]
            tables.append(table(some, columns, caption, f"{world}: calibration of the goal's probability"))
            tables.append(score_table(own, "cell", "loss", "log-loss of the cell where an agent is, by moves ahead"))
            title = f"probability of the present goal, by moves after a switch at {SWITCH_AT}"
            tables.append(score_table(own, "switched", "probability", title))
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
    some, parts = scored.dropna(subset="loss").rename(columns={"loss": "first"}), []
    for kind, minus in PAIRS:
        # Observers that learned from nothing are compared with all numbers of plans.
        on = ["world", "measure", "at", "seed"] + ["plans"] * (minus != "exact")
        second = some.loc[some["kind"] == minus, [*on, "first"]].rename(columns={"first": "second"})
        parts.append(some[some["kind"] == kind].merge(second, on=on).assign(minus=minus))
    return pd.concat(parts)


def calibration_errors(counted: pd.DataFrame) -> pd.DataFrame:
    """The expected calibration error of each observer over all seeds, with the jackknife's interval over seeds."""
    found = []
    for place, own in counted.groupby(["world", "kind", "plans"], sort=False):
        sums, number = torch.tensor(own["sums"].tolist(), dtype=torch.double), len(own)
        error = Reliability(sums).expected_calibration_error
        ends = [float("nan")] * 2
        if number > 1:
            without = [Reliability(sums[torch.arange(number) != k]) for k in range(number)]
            values = [number * error - (number - 1) * one.expected_calibration_error for one in without]
            half = mean_interval(values).high - mean_interval(values).mean
            ends = [max(error - half, 0.0), error + half]
        found.append((*place, error, *ends, number))
    return pd.DataFrame(found, columns=["world", "kind", "plans", "error", "low", "high", "seeds"])


def _number(row: Any) -> str:
    return f"{row['plans']}" if row["plans"] else ""


def _shown(rows: pd.DataFrame, measure: str) -> tuple[pd.DataFrame, dict[str, str]]:
    """Rows of a measure with numbers as texts, and the columns that name them, by heading."""
    some = rows[rows["measure"] == measure]
    at = (some["at"] * (100 if measure == "way" else 1)).round().astype(int)
    names = {"observer": "kind"} | ({"minus": "minus"} if "minus" in some else {})
    if measure != "water":
        names["plans"] = "number"
    if measure == "switched":
        names["assumed"] = "switch"
    return some.assign(at=at, number=[_number(row) for _, row in some.iterrows()]), names


def score_table(rows: pd.DataFrame, measure: str, score: str, title: str, digits: int = 2) -> Table:
    """Means over seeds of one world, a row an observer and a column a number of moves."""
    some, names = _shown(rows[rows["score"] == score], measure)
    factor = 100 if score == "accuracy" else 1
    cells = [runs.plus_minus(row, "value", factor, digits).replace(" ", "") for _, row in some.iterrows()]
    unit = {"loss": "Nats.", "accuracy": "%.", "probability": ""}[score]
    caption = f"{unit} {runs.over_seeds(some)} {'' if measure == 'water' else WHAT}"
    return runs.table_by(some, names, "at", cells, caption.strip(), f"{rows['world'].iloc[0]}: {title}")


def gap_table(gaps: pd.DataFrame, measure: str, title: str, digits: int = 2) -> Table:
    """Paired differences in one world, a row a pair and a column a number of moves."""
    some, names = _shown(gaps, measure)
    cells = [runs.plus_minus(row, "difference", 1, digits, "+").replace(" ", "") for _, row in some.iterrows()]
    caption = "Nats; ±: 95 % interval, paired by seed; other measures are in paired.csv."
    world = gaps["world"].iloc[0] if len(gaps) else ""
    return runs.table_by(some, names, "at", cells, caption, f"{world}: {title}")


def finding(gaps: pd.DataFrame, world: str, settings: Mapping[str, Any]) -> str:
    """How near priors come to exact inference, or what the posterior adds, in one sentence."""
    if gaps.empty:
        return f"{world}: differences need at least two seeds."
    most, last = max(settings["num_plans"]), max(settings["observed"])
    wanted = [("cell, tempered", most), ("blind, tempered", most)] if world != LABYRINTH else [(k, 0) for k, _ in PAIRS]
    some = gaps[(gaps["at"] == last) & gaps["measure"].isin(["moves", "water"])]
    rows = [
        f"{row['kind']} minus {row['minus']} {runs.plus_minus(row, 'difference', 1, 4, '+')}"
        for kind, plans in wanted
        for _, row in some[(some["kind"] == kind) & (some["plans"] == plans)].drop_duplicates("kind").iterrows()
    ]
    learned = "" if world == LABYRINTH else f" {most} plans toward each goal and"
    return f"{world}, log-loss after{learned} {last} moves: {'; '.join(rows)}."


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
        own = rows[(rows["world"] == world) & (rows["measure"] == "moves") & (rows["score"] == "loss")]
        for (kind, number), style in lines.items():
            name = f"{kind}, {number} plans" if number else kind
            some = own[(own["kind"] == kind) & (own["plans"] == number)].sort_values("at")
            band(above, some[["at", "value", "low", "high"]].to_numpy(float), KINDS[kind], name, style)
            here = counted[(counted["world"] == world) & (counted["kind"] == kind) & (counted["plans"] == number)]
            bins = Reliability(torch.tensor(here["sums"].tolist(), dtype=torch.double)).bins
            if kind in ("exact", "cell", "cell, tempered"):
                points = [[one.forecast, *one.taken] for one in bins]
                band(below, points, KINDS[kind], name, style)
        above.set_xscale("log", base=2)
        above.set_xticks(sorted(own["at"].unique()), [f"{at:.0f}" for at in sorted(own["at"].unique())])
        above.set(title=world, ylim=(0, None), xlabel="observed moves")
        below.plot([0, 1], [0, 1], color="#aaaaaa", lw=1, zorder=0)
        below.set(xlim=(0, 1), ylim=(0, 1), xlabel="forecast probability of a goal")
    at_edges(axes[: len(worlds)], len(worlds), len(worlds), "observed moves", "log-loss of the goal, nats")
    at_edges(axes[len(worlds) :], len(worlds), len(worlds), "forecast probability of a goal", "how often it is true")
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure
