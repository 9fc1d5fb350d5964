"""The report of `python -m eval control`: returns against candidates, and how many candidates a prior saves."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from eval.control.priors import NONE
from eval.control.tasks import CONDITIONS, TASKS
from eval.worlds import runs
from neuroprior.report.document import Column, Document, table
from neuroprior.report.drawing import WIDTH, at_edges, band, drawn, legend, panels
from neuroprior.report.page import FigureBox, Section, Table

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

REFERENCE = 100
"""Candidates of the plain planner whose return is to be reached with fewer, or the nearest number that is tried."""

RESAMPLES = 1000
"""Of seeds, for the intervals of `savings`."""


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
    gaps = differences(frame)
    saved = savings(frame)
    scored, more = results.likelihoods, ["fit_seconds", "for_80", "for_95"]
    nats = scored  # empty where the plain planner is alone
    if len(scored):
        scored = scored.astype({"for_80": float, "for_95": float})
        nats = runs.seed_means(scored.assign(task=scored["world"]), ["task", "prior"], "nats", more)
    sections, leads = [], []
    for task in rows["task"].unique():
        about = TASKS[task].about
        own = rows[rows["task"] == task]
        tables = [return_table(some, about) for _, some in own.groupby(["condition", "planner"], sort=False)]
        if len(gaps):
            tables += [
                gap_table(some) for _, some in gaps[gaps["world"] == task].groupby(["condition", "planner"], sort=False)
            ]
        boxes = [
            FigureBox(
                return_figure(own[own["planner"] == planner]),
                f"{about}. Bands: Student's 95 % intervals over seeds. {planner}, with candidates of each prior.",
                f"The return in {task} against the number of candidates, a line a prior; the numbers are in tables.",
                f"{task}-{planner}",
            )
            for planner in own["planner"].unique()
        ]
        sections.append(Section(task, tables=tables, figures=boxes))
        if len(gaps):
            leads.append(runs.significance(gaps[gaps["world"] == task], f"{task}, with a prior minus without"))
    if len(saved):
        sections.insert(0, Section("Candidates saved", tables=[saving_table(saved)]))
    if len(nats):
        sections.append(Section("Likelihoods", tables=[likelihood_table(nats)]))
    alone = results.alone
    if len(alone):
        alone = runs.seed_means(alone.assign(task=alone["world"]), ["task", "condition", "prior"], "return")
        sections.append(Section("Behaviour cloning", tables=[alone_table(alone)]))
    frames = {"rows": rows, "paired": gaps, "savings": saved, "likelihoods": nats, "alone": alone}
    lead = " ".join(leads) or "Differences need at least two seeds."
    return Document("Priors that propose continuous actions", lead, sections, frames, settings, command)


def differences(frame: pd.DataFrame) -> pd.DataFrame:
    """The return with each prior minus that of the plain planner, paired by seed; see `runs.paired_differences`."""
    place = ["world", "condition", "planner", "budget"]
    plain = frame.loc[frame["prior"] == NONE, [*place, "seed", "return"]].rename(columns={"return": "second"})
    pairs = frame[frame["prior"] != NONE].rename(columns={"return": "first"}).merge(plain, on=[*place, "seed"])
    return runs.paired_differences(pairs, [*place, "prior"])


def savings(frame: pd.DataFrame) -> pd.DataFrame:
    """How many candidates reach what the plain planner reaches with `REFERENCE`, and how much time that takes.

    Returns and times are interpolated between budgets, linearly in the logarithm of the budget. The interval is a
    bootstrap over seeds, of the prior and the plain planner together.

    Returns:
        A row for each task, condition, planner and prior: `reference`, candidates of the plain planner; `needed`, of
        the planner with the prior, infinite where the largest budget does not suffice; `low`, `high` (missing with
        fewer than five seeds); `faster`: the time of a decision of the plain planner with `reference` candidates over
        that of the planner with the prior and `needed`, missing where this is infinite.
    """
    rows = []
    for place, own in frame.groupby(["task", "condition", "planner"], sort=False):
        curves = {
            prior: [some.pivot_table(name, "seed", "budget") for name in ("return", "seconds")]
            for prior, some in own.groupby("prior", sort=False)
        }
        if NONE not in curves:
            continue
        plain_curve, plain_seconds = curves.pop(NONE)
        plain_budgets, plain = plain_curve.columns.to_numpy(float), plain_curve.to_numpy()
        reference, seeds = float(np.clip(REFERENCE, plain_budgets[0], plain_budgets[-1])), len(plain)
        draws = np.random.default_rng(0).integers(seeds, size=(RESAMPLES, seeds))
        seconds = interpolated(reference, plain_budgets, plain_seconds.to_numpy().mean(0))
        for prior, (returns, times) in curves.items():
            budgets, curve = returns.columns.to_numpy(float), returns.to_numpy()
            needed = candidates_needed(budgets, curve.mean(0), interpolated(reference, plain_budgets, plain.mean(0)))
            low = high = float("nan")
            if seeds >= 5:
                sampled = [
                    candidates_needed(
                        budgets, curve[draw].mean(0), interpolated(reference, plain_budgets, plain[draw].mean(0))
                    )
                    for draw in draws
                ]
                low, high = np.quantile(sampled, [0.025, 0.975], method="inverted_cdf")
            faster = float("nan")
            if np.isfinite(needed):
                faster = seconds / interpolated(needed, budgets, times.to_numpy().mean(0))
            rows.append((*place, prior, reference, needed, low, high, faster, seeds))
    names = ["task", "condition", "planner", "prior", "reference", "needed", "low", "high", "faster", "seeds"]
    return pd.DataFrame(rows, columns=names)


def interpolated(budget: float, budgets: NDArray[np.float64], values: NDArray[np.float64]) -> float:
    """A value between those of the neighbouring budgets, linear in the logarithm of the budget."""
    return float(np.interp(np.log(budget), np.log(budgets), values))


def candidates_needed(budgets: NDArray[np.float64], returns: NDArray[np.float64], goal: float) -> float:
    """The budget at which `returns` first reach `goal`; infinite if they never do.

    At the smallest budget already reached, it is that one: fewer candidates were not tried.
    """
    if returns[0] >= goal:
        return float(budgets[0])
    for k in range(1, len(budgets)):
        if returns[k] >= goal:
            share = (goal - returns[k - 1]) / (returns[k] - returns[k - 1])
            return float(budgets[k - 1] * (budgets[k] / budgets[k - 1]) ** share)
    return float("inf")


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
    """How many candidates reach the return of the plain planner, a row a task and prior and a column a condition."""

    def text(value: float) -> str:
        return "more" if np.isinf(value) else f"{value:.0f}"

    cells = [
        text(row["needed"])
        + ("" if pd.isna(row["low"]) else f" ({text(row['low'])} to {text(row['high'])})")
        + ("" if pd.isna(row["faster"]) else f", {row['faster']:.1f}x")
        for _, row in saved.iterrows()
    ]
    labels = ["task", "planner", "prior"]
    wide = saved.assign(cell=cells).pivot_table("cell", labels, "condition", aggfunc="first")
    wide = wide[[condition for condition in CONDITIONS if condition in wide]].reset_index()
    order = saved[labels].drop_duplicates().merge(wide, on=labels)
    columns = {str(name): str(name) for name in order.columns}
    reference = saved["reference"].max()
    caption = (
        f"Candidates a decision with which the return of the plain planner with {reference:.0f} is reached; more: than"
        " were tried; the fewest tried where these suffice. In brackets: 95 % bootstrap interval over seeds, with at"
        " least five. x: so many times as fast is a decision, drawing from the prior included."
    )
    return table(order, columns, caption, align="lll" + "r" * (order.shape[1] - 3))


def likelihood_table(nats: pd.DataFrame) -> Table:
    """Held-out log-densities, a row a task and prior."""
    columns: dict[str, Column] = {
        "task": "task",
        "prior": "prior",
        "nats a vector": lambda row: runs.plus_minus(row, "nats", 1, 2),
        "fit, s": "fit_seconds:.1f",
        "80 %": "for_80:.0f",
        "95 %": "for_95:.0f",
    }
    caption = (
        "Log-density of vectors that the plain planner executed in other runs, nats; the higher the better. "
        + runs.over_seeds(nats)
        + " 80 %, 95 %: components that explain so much of the variance (of windows, or of single vectors), mean."
    )
    return table(nats, columns, caption, align="llrrrr")


def alone_table(alone: pd.DataFrame) -> Table:
    """Returns of a network that is executed without a planner."""
    columns: dict[str, Column] = {
        "task": "task",
        "condition": "condition",
        "return": lambda row: runs.plus_minus(row, "return", 1),
    }
    caption = f"The network's first draw is executed at each step, without simulations. {runs.over_seeds(alone)}"
    return table(alone, columns, caption, align="llr")


@drawn
def return_figure(rows: pd.DataFrame) -> Figure:
    """The return against the number of candidates with one planner: a panel a condition."""
    conditions = [condition for condition in CONDITIONS if (rows["condition"] == condition).any()]
    figure, axes = panels(1, len(conditions), (WIDTH, 3.0), sharex=True)
    budgets = sorted(rows["budget"].unique())
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
