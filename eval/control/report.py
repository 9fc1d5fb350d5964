"""The report of `python -m eval control`: returns against candidates, and how many candidates a prior saves."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from eval.control.comparison import against_simple, differences, matches, over_budgets, savings, synergies
from eval.control.priors import NONE
from eval.control.tasks import CONDITIONS, TASKS
from eval.worlds import runs
from neuroprior.behaviour.analysis.statistics import ENOUGH_UNITS
from neuroprior.behaviour.report.document import Column, Document, table
from neuroprior.behaviour.report.drawing import WIDTH, at_edges, band, drawn, legend, panels
from neuroprior.behaviour.report.page import FigureBox, Section, Table

PLACE = ["task", "condition", "planner", "prior", "budget"]

LINES = {
    NONE: ("#7d838c", "-"),
    "noise": ("#7d838c", "--"),
    "autoregressive": ("#3079d8", "-"),
    "synergies": ("#2e9e5b", "-"),
    "step-synergies": ("#2e9e5b", "--"),
    "stored": ("#8452c4", "-"),
    "gru": ("#d9731a", "-"),
    "transformer": ("#d9731a", "--"),
    "discretised": ("#b3446c", "--"),
    "cloning": ("#d9731a", ":"),
    "shuffled": ("#3079d8", ":"),
}
"""Colours and styles of the lines of figures."""


CLOSEST = 1.4
"""Ratio of two numbers of candidates from which both have a label."""


class Results(NamedTuple):
    """What the runs of the experiment found, a row each; see `eval.control.run`.

    Attributes:
        entries: of planners, a row a task (`world`), condition, planner, prior, budget and seed.
        likelihoods: of priors, a row a task, prior and seed; may be empty.
        alone: of behaviour cloning, a row a task, condition and seed; may be empty.
    """

    entries: pd.DataFrame
    likelihoods: pd.DataFrame
    alone: pd.DataFrame


def control_document(results: Results, settings: Mapping[str, Any], command: str) -> Document:
    """The tables and figures of the results."""
    frame = results.entries.assign(task=results.entries["world"])
    rows = runs.seed_means(frame, PLACE, "return", ["seconds", "sampling"])
    gaps, saved, matched, drawn_shares = differences(frame), savings(frame), matches(frame), drawing(rows)
    common = over_budgets(frame)
    networks = against_simple(common, ["world", "condition", "planner"], "return")
    windows = synergies(frame)
    scored, nats = results.likelihoods, results.likelihoods  # empty where the plain planner is alone
    scored_networks = windows[:0]
    if len(scored):
        scored = scored.astype({"for_80": float, "for_95": float})
        by_task = scored.assign(task=scored["world"])
        nats = runs.seed_means(by_task, ["task", "prior"], "nats", ["fit_seconds", "for_80", "for_95"])
        scored_networks = against_simple(scored, ["world"], "nats")
    tables = [match_table(some) for _, some in matched.groupby(["planner", "condition"], sort=False)]
    tables += [saving_table(some) for _, some in saved.groupby("planner", sort=False)]
    tables += [drawing_table(some) for _, some in drawn_shares.groupby("planner", sort=False)]
    sections = [Section("Candidates saved", tables=tables)]
    tables = [likelihood_table(nats)] if len(nats) else []
    tables += [nats_table(scored_networks)] if len(scored_networks) else []
    tables += [network_table(networks)] if len(networks) else []
    sections += [Section("Sequence models", tables=tables)] if tables else []
    explained = nats[nats["for_80"].notna()] if len(nats) else nats
    tables = [component_table(explained)] if len(explained) else []
    tables += [synergy_table(windows)] if len(windows) else []
    sections += [Section("Synergies", tables=tables)] if tables else []
    alone = results.alone
    if len(alone):
        alone = runs.seed_means(alone.assign(task=alone["world"]), ["task", "condition", "prior"], "return")
        sections.append(Section("Behaviour cloning", tables=[alone_table(alone)]))
    leads, seeds = [], frame["seed"].nunique()
    for task in rows["task"].unique():
        own = rows[rows["task"] == task]
        places = ["condition", "planner"]
        tables = [return_table(some, TASKS[task].about) for _, some in own.groupby(places, sort=False)]
        tables += [gap_table(some) for _, some in gaps[gaps["world"] == task].groupby(places, sort=False)]
        boxes = [
            FigureBox(
                return_figure(own[own["planner"] == planner]),
                f"{TASKS[task].about}. Bands: Student's 95 % intervals over seeds. {planner}, with candidates of each"
                " prior.",
                f"The return in {task} against the number of candidates, a line a prior; the numbers are in tables.",
                f"{task}-{planner}",
            )
            for planner in own["planner"].unique()
        ]
        sections.append(Section(task, tables=tables, figures=boxes))
        if len(gaps) and seeds >= ENOUGH_UNITS:
            leads.append(runs.significance(gaps[gaps["world"] == task], f"{task}, with a prior minus without"))
    few = f"{seeds} seeds are too few for a verdict; it takes {ENOUGH_UNITS}." if seeds < ENOUGH_UNITS else ""
    frames = {
        "rows": rows,
        "paired": gaps,
        "savings": saved,
        "matches": matched,
        "drawing": drawn_shares,
        "likelihoods": nats,
        "networks": networks,
        "networks_scored": scored_networks,
        "synergies": windows,
        "alone": alone,
    }
    title = "Priors that propose continuous actions"
    return Document(title, few or " ".join(leads), sections, frames, settings, command)


def drawing(rows: pd.DataFrame) -> pd.DataFrame:
    """The share of a decision's time in which priors are drawn from, the largest of all conditions."""
    shares = rows.assign(share=rows["sampling"] / rows["seconds"])
    found = shares[shares["prior"] != NONE].groupby(["task", "planner", "prior", "budget"], sort=False)["share"].max()
    return pd.DataFrame(found.reset_index())


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


def component_table(nats: pd.DataFrame) -> Table:
    """How many components explain the variance, a row a task and prior."""
    columns: dict[str, Column] = {"task": "task", "prior": "prior", "80 %": "for_80:.1f", "95 %": "for_95:.1f"}
    caption = (
        "synergies: of windows as long as the planner's plans; step-synergies: of single vectors. Means over seeds."
    )
    title = "Components that explain 80 and 95 % of the variance"
    return table(nats, columns, caption, title, "llrr")


def alone_table(alone: pd.DataFrame) -> Table:
    """Returns of a network that is executed without a planner."""
    columns: dict[str, Column] = {
        "task": "task",
        "condition": "condition",
        "return": lambda row: runs.plus_minus(row, "return", 1),
    }
    caption = f"The network's first draw is executed at each step, without simulations. {runs.over_seeds(alone)}"
    return table(alone, columns, caption, align="llr")


def match_table(matched: pd.DataFrame) -> Table:
    """Candidates that match the plain planner in one condition, a row a prior and a column a task."""

    def text(value: float) -> str:
        return "?" if pd.isna(value) else "more" if np.isinf(value) else f"{value:.0f}"

    first = matched.iloc[0]
    cells = [f"{text(row['equal'])} ({text(row['close'])})" for _, row in matched.iterrows()]
    wide = matched.assign(cell=cells).pivot_table("cell", "prior", "task", aggfunc="first")
    half = (matched[["equal", "close"]] <= matched["reference"].to_numpy()[:, None] / 2).astype(int)
    counts = half.assign(prior=matched["prior"]).groupby("prior").sum()
    wide = wide[matched["task"].unique()]
    wide["tasks"] = [f"{counts.loc[prior, 'equal']} ({counts.loc[prior, 'close']})" for prior in wide.index]
    wide = wide.loc[matched["prior"].unique()].reset_index()
    reference = first["reference"]
    caption = (
        f"Fewest candidates of those tried with at least the mean return of the plain planner with {reference:.0f}; in"
        " brackets: whose return is not significantly below it (the 95 % interval of the difference, paired by seed,"
        f" reaches 0; no verdict from fewer than {ENOUGH_UNITS} seeds). more: than were tried. none: the plain planner"
        f" itself. tasks: in how many this is at most {reference / 2:.0f}."
    )
    title = f"{first['condition']}, {first['planner']}: candidates that match {reference:.0f} of the plain planner"
    return table(wide, {str(name): str(name) for name in wide.columns}, caption, title, "l" + "r" * (wide.shape[1] - 1))


def drawing_table(shares: pd.DataFrame) -> Table:
    """How long drawing takes, a row a task and prior and a column a budget."""
    cells = [f"{100 * share:.1f}" for share in shares["share"]]
    caption = "Per cent of the processor time of a decision, simulations included; the largest of all conditions."
    title = f"{shares['planner'].iloc[0]}: share of a decision in which the prior is drawn, by candidates"
    return runs.table_by(shares, {"task": "task", "prior": "prior"}, "budget", cells, caption, title)


def nats_table(gaps: pd.DataFrame) -> Table:
    """Networks against the best of the other priors, in likelihood."""
    names: dict[str, Column] = {"task": "world", "network": "prior", "minus": "baseline"}
    return _difference_table(gaps, names, "nats a vector", 2)


def network_table(gaps: pd.DataFrame) -> Table:
    """Networks against the best of the other priors, in planning."""
    names: dict[str, Column] = {"task": "world", "condition": "condition", "network": "prior", "minus": "baseline"}
    return _difference_table(gaps, names, "the return, mean over budgets", 1)


def synergy_table(gaps: pd.DataFrame) -> Table:
    """Synergies of windows against those per step, in planning."""
    names: dict[str, Column] = {"task": "world", "condition": "condition", "components": "components"}
    return _difference_table(
        gaps, names, "the return, mean over budgets", 1, "Synergies of windows minus synergies per step"
    )


def _difference_table(
    gaps: pd.DataFrame,
    names: Mapping[str, Column],
    unit: str,
    digits: int,
    title: str = "Networks minus the best other prior",
) -> Table:
    columns = dict(names) | {
        "difference": lambda row: runs.plus_minus(row, "difference", 1, digits, "+"),
        "p": lambda row: "" if pd.isna(row["p_holm"]) else f"{row['p_holm']:.3f}",
    }
    caption = (
        f"Differences in {unit}, paired by seed, with half of Student's 95 % interval; p: Holm's correction for all"
        f" tests of the table in a task; none from fewer than {ENOUGH_UNITS} seeds."
    )
    return table(gaps, columns, caption, f"{title}: {unit}", "l" * len(names) + "rr")


@drawn
def return_figure(rows: pd.DataFrame) -> Figure:
    """The return against the number of candidates with one planner: a panel a condition."""
    conditions = [condition for condition in CONDITIONS if (rows["condition"] == condition).any()]
    figure, axes = panels(1, len(conditions), (WIDTH, 3.0), sharex=True)
    budgets = sorted(rows["budget"].unique())
    budgets = [one for one, more in zip(budgets, [*budgets[1:], np.inf], strict=True) if more >= CLOSEST * one]
    for panel, condition in zip(axes, conditions, strict=True):
        here = rows[rows["condition"] == condition]
        for prior in here["prior"].unique():
            own = here[here["prior"] == prior].sort_values("budget")
            color, style = LINES.get(prior, LINES.get(prior.rpartition("-")[0], ("#444444", ":")))
            band(panel, own[["budget", "return", "low", "high"]].to_numpy(float), color, prior, style)
        panel.set_xscale("log")
        panel.set_xticks(budgets, [f"{budget:,}" for budget in budgets])
        panel.minorticks_off()
        panel.set_title({"same": "same world", "masses": "new masses", "goal": "new goal"}[condition])
        panel.grid(axis="both")
    at_edges(axes, len(conditions), len(conditions), "candidates a decision", "return")
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure
