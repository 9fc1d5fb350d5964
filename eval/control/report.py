"""The report of `python -m eval control`: returns against candidates, and how many candidates a prior saves."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from eval.control.comparison import against_simple, differences, over_budgets, savings
from eval.control.priors import NONE
from eval.control.tasks import CONDITIONS, TASKS
from eval.worlds import runs
from neuroprior._statistics import ENOUGH_UNITS
from neuroprior.behaviour.reporting.document import Column, Document, table
from neuroprior.behaviour.reporting.drawing import WIDTH, at_edges, band, drawn, legend, panels
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table

PLACE = ["task", "condition", "planner", "prior", "budget"]

LINES = {
    NONE: ("#7d838c", "-"),
    "noise": ("#7d838c", "--"),
    "autoregressive": ("#3079d8", "-"),
    "synergies": ("#2e9e5b", "-"),
    "stored": ("#8452c4", "-"),
    "gru": ("#d9731a", "-"),
    "cloning": ("#d9731a", ":"),
    "shuffled": ("#3079d8", ":"),
}
"""Colours and styles of the lines of figures."""

MIN_LABEL_RATIO = 1.4
"""Ratio of two numbers of candidates from which both have a label."""


class Results(NamedTuple):
    """What the runs of the experiment found, a row each; see `eval.control.run`.

    Attributes:
        entries: of planners, a row a task (`world`), condition, planner, prior, budget and seed.
        likelihoods: of priors, a row a task, prior and seed; may be empty.
    """

    entries: pd.DataFrame
    likelihoods: pd.DataFrame


def control_document(results: Results, settings: Mapping[str, Any], command: str) -> Document:
    """The tables and figures of the results."""
    frame = results.entries.assign(task=results.entries["world"])
    rows = runs.seed_means(frame, PLACE, "return", ["seconds"])
    gaps, saved = differences(frame), savings(frame)
    networks = against_simple(over_budgets(frame), ["world", "condition", "planner"], "return")
    nats = scored_networks = results.likelihoods  # empty where the plain planner is alone
    if len(nats):
        scored_networks = against_simple(nats, ["world"], "nats")
        nats = runs.seed_means(nats.assign(task=nats["world"]), ["task", "prior"], "nats", ["fit_seconds"])
    tables = [saving_table(group) for _, group in saved.groupby("planner", sort=False)]
    sections = [Section("Candidates saved", tables=tables)]
    tables = [likelihood_table(nats)] if len(nats) else []
    tables += [nats_table(scored_networks)] if len(scored_networks) else []
    tables += [network_table(networks)] if len(networks) else []
    sections += [Section("Sequence models", tables=tables)] if tables else []
    leads, seeds = [], frame["seed"].nunique()
    for task in rows["task"].unique():
        task_rows = rows[rows["task"] == task]
        places = ["condition", "planner"]
        tables = [return_table(group, TASKS[task].about) for _, group in task_rows.groupby(places, sort=False)]
        tables += [gap_table(group) for _, group in gaps[gaps["world"] == task].groupby(places, sort=False)]
        boxes = [
            FigureBox(
                return_figure(task_rows[task_rows["planner"] == planner]),
                f"{TASKS[task].about}. Bands: Student's 95 % intervals over seeds. {planner}, with candidates of each"
                " prior.",
                f"The return in {task} against the number of candidates, a line a prior; the numbers are in tables.",
                f"{task}-{planner}",
            )
            for planner in task_rows["planner"].unique()
        ]
        sections.append(Section(task, tables=tables, figures=boxes))
        if len(gaps) and seeds >= ENOUGH_UNITS:
            leads.append(runs.significance(gaps[gaps["world"] == task], f"{task}, with a prior minus without"))
    few = f"{seeds} seeds are too few for a verdict; it takes {ENOUGH_UNITS}." if seeds < ENOUGH_UNITS else ""
    frames = {
        "rows": rows,
        "paired": gaps,
        "savings": saved,
        "likelihoods": nats,
        "networks": networks,
        "networks_scored": scored_networks,
    }
    title = "Priors that propose continuous actions"
    return Document(title, few or " ".join(leads), sections, frames, settings, command)


def return_table(rows: pd.DataFrame, about: str) -> Table:
    """Returns in one task and condition with one planner, a row a prior and a column a budget."""
    first = rows.iloc[0]
    cells = [runs.plus_minus(row, "return", 1).replace(" ", "") for _, row in rows.iterrows()]
    title = f"{first['task']}, {first['condition']}, {first['planner']}: return by candidates a decision"
    timed = int(rows.groupby("prior")["budget"].max().min())  # the plain planner is tried with more
    caption = f"{about}. {runs.over_seeds(rows)} ms: of a decision with {timed} candidates."
    rows = rows.rename(columns={"seconds": "seconds_per_decision"})
    return runs.table_by(rows, {"prior": "prior"}, "budget", cells, caption, title, timed)


def gap_table(gaps: pd.DataFrame) -> Table:
    """Differences to the plain planner in one task and condition, a row a prior and a column a budget."""
    first = gaps.iloc[0]
    cells = [
        runs.plus_minus(row, "difference", 1, sign="+").replace(" ", "") + ("*" if row["p_holm"] < 0.05 else "")
        for _, row in gaps.iterrows()
    ]
    title = f"{first['world']}, {first['condition']}, {first['planner']}: return with a prior minus without"
    caption = "±: 95 % interval, paired by seed. *: p < 0.05, Holm's correction for all tests in the task."
    return runs.table_by(gaps, {"prior": "prior"}, "budget", cells, caption, title)


def saving_table(saved: pd.DataFrame) -> Table:
    """Candidates that reach the return of one plain planner, a row a task and prior, a column a condition."""

    def text(value: float) -> str:
        return "more" if np.isinf(value) else f"{value:.0f}"

    cells = [
        text(row["needed"])
        + ("" if pd.isna(row["low"]) else f" ({text(row['low'])} to {text(row['high'])})")
        + ("" if pd.isna(row["faster"]) else f", {row['faster']:.1f}x")
        for _, row in saved.iterrows()
    ]
    labels = ["task", "prior"]
    wide = saved.assign(cell=cells).pivot_table("cell", labels, "condition", aggfunc="first")
    wide = wide[[condition for condition in CONDITIONS if condition in wide]].reset_index()
    order = saved[labels].drop_duplicates().merge(wide, on=labels)
    columns = {str(name): str(name) for name in order.columns}
    reference, planner = saved["reference"].max(), saved["planner"].iloc[0]
    caption = (
        f"Candidates a decision with which the return of the plain planner with {reference:.0f} is reached; more: than"
        " were tried; the fewest tried where these suffice. In brackets: 95 % bootstrap interval over seeds, with at"
        " least five. x: so many times as fast is a decision, drawing from the prior included."
    )
    title = f"{planner}: candidates needed, interpolated"
    return table(order, columns, caption, title, "ll" + "r" * (order.shape[1] - 2))


def likelihood_table(nats: pd.DataFrame) -> Table:
    """Held-out log-densities, a row a task and prior."""
    columns: dict[str, Column] = {
        "task": "task",
        "prior": "prior",
        "nats a vector": lambda row: runs.plus_minus(row, "nats", 1, 2),
        "fit, s": "fit_seconds:.1f",
    }
    caption = "Log-density of vectors that the plain planner executed in other runs, nats; the higher the better. "
    return table(nats, columns, caption + runs.over_seeds(nats), align="llrr")


def nats_table(gaps: pd.DataFrame) -> Table:
    """Networks against the best of the other priors, in likelihood."""
    names: dict[str, Column] = {"task": "world", "network": "prior", "minus": "baseline"}
    return _difference_table(gaps, names, "nats a vector", 2)


def network_table(gaps: pd.DataFrame) -> Table:
    """Networks against the best of the other priors, in planning."""
    names: dict[str, Column] = {"task": "world", "condition": "condition", "network": "prior", "minus": "baseline"}
    return _difference_table(gaps, names, "the return, mean over budgets", 1)


def _difference_table(
    gaps: pd.DataFrame,
    names: Mapping[str, Column],
    unit: str,
    digits: int,
) -> Table:
    columns = dict(names) | {
        "difference": lambda row: runs.plus_minus(row, "difference", 1, digits, "+"),
        "p": lambda row: "" if pd.isna(row["p_holm"]) else f"{row['p_holm']:.3f}",
    }
    caption = (
        f"Differences in {unit}, paired by seed, with half of Student's 95 % interval; p: Holm's correction for all"
        f" tests of the table in a task; none from fewer than {ENOUGH_UNITS} seeds."
    )
    return table(gaps, columns, caption, f"Networks minus the best other prior: {unit}", "l" * len(names) + "rr")


@drawn
def return_figure(rows: pd.DataFrame) -> Figure:
    """The return against the number of candidates with one planner: a panel a condition."""
    conditions = [condition for condition in CONDITIONS if (rows["condition"] == condition).any()]
    figure, axes = panels(1, len(conditions), (WIDTH, 3.0), sharex=True)
    budgets = sorted(rows["budget"].unique())
    budgets = [one for one, more in zip(budgets, [*budgets[1:], np.inf], strict=True) if more >= MIN_LABEL_RATIO * one]
    for panel, condition in zip(axes, conditions, strict=True):
        condition_rows = rows[rows["condition"] == condition]
        for prior in condition_rows["prior"].unique():
            curve = condition_rows[condition_rows["prior"] == prior].sort_values("budget")
            color, style = LINES[prior]
            band(panel, curve[["budget", "return", "low", "high"]].to_numpy(float), color, prior, style)
        panel.set_xscale("log")
        panel.set_xticks(budgets, [f"{budget:,}" for budget in budgets])
        panel.minorticks_off()
        panel.set_title({"same": "same world", "masses": "new masses", "goal": "new goal"}[condition])
        panel.grid(axis="both")
    at_edges(axes, len(conditions), len(conditions), "candidates a decision", "return")
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure
