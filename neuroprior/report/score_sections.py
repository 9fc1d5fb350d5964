"""The sections of a report on plans: what each shows, its tables, figures and words."""

import re
from collections.abc import Sequence
from math import log2
from typing import TYPE_CHECKING, Any

from neuroprior.analysis.comparison import unit_name
from neuroprior.report import figures as plan_figures
from neuroprior.report import statistics
from neuroprior.report.page import FigureBox, Section, Table
from neuroprior.report.scores import leading

if TYPE_CHECKING:
    from neuroprior.report.study import Report

Rows = dict[str, Sequence[dict[str, Any]]]

ENOUGH_UNITS, LEAST = 5, 1e-9
"""Units below which no gain is starred, and bits that are none."""

CHAIN = re.compile(r"markov-\d+")
"""Names of Markov chains among fitted models."""

LISTED = (1, 2, 3, 4, 6, 8, 12, 16, 20)
"""Lags in the table."""


def lead(report: "Report") -> str:
    """The findings, in a few sentences."""
    rows = sorted(report.rows, key=lambda row: row["bits_per_action"])
    best, plans = rows[0], report.plans
    what = statistics.describe(plans)
    said = [
        f"{what['plans']:,} plans with {what['actions']:,} actions of {what['kinds of actions']} kinds.",
        f"The best model, {_named(best)}, takes {_bits(best)} bits per action"
        f" (perplexity {best['perplexity']:.2f}); even odds would take {log2(plans.num_actions):.3f}.",
    ]
    counted = [row for row in rows if CHAIN.fullmatch(row["model"]) or row["model"] == "context tree"]
    if counted and counted[0] is not best and best["more"] == 0:
        row = counted[0]
        gap = f"{row['more']:.4f} bits more ({row['more_low']:.4f} to {row['more_high']:.4f})"
        told = f"takes {gap}" if row["more_low"] > 0 else f"cannot be told from it ({gap})"
        said.append(f"The best count-based model, {_named(row)}, {told}.")
    return " ".join(said)


def score_section(report: "Report") -> tuple[Section, Rows]:
    """The main table."""
    unit = unit_name(report.scored, report.mask)
    cells = [
        [
            row["model"],
            "+ context" if "context" in row["sees"] else "actions",
            f"{row['nats_per_action']:.4f}",
            f"{row['bits_per_action']:.4f} ± {row['high'] - row['bits_per_action']:.4f}",
            f"{row['perplexity']:.3f}",
            "" if row["more"] is None else f"{row['more']:+.4f} ± {row['more_high'] - row['more']:.4f}",
        ]
        for row in report.rows
    ]
    table = Table(
        ("model", "sees", "nats", "bits per action", "perpl.", "more bits"),
        cells,
        f"On held-out actions. ±: 95 % intervals over {unit}. more: bits more than {report.reference} takes, paired.",
        "llrrrr",
    )
    text = [
        "What each model pays for actions that it has not learned from: the fewer bits, the more of the structure it"
        " holds; a nat is 1.44 bits. Perplexity (perpl.) is how many equally likely actions would cost as much.",
        "Order, back-off and smoothing of count-based models were chosen within the plans learned from. A difference"
        " whose interval holds 0 cannot be told from chance. The reference is the best of all models on the same plans,"
        " which favours it a little; differences are not corrected for the number of models.",
    ]
    figure = FigureBox(
        (plan_figures.score_figure(report.rows)),
        f"Bits per held-out action, 95 % intervals over {unit}.",
        "Bits per action of each model: " + ", ".join(f"{_named(r)} {r['bits_per_action']:.3f}" for r in report.rows),
    )
    return Section("Which model tells the plans best", text, [table], [figure]), {"plans": report.rows}


def lag_section(report: "Report") -> tuple[Section, Rows] | None:
    """How far back structure reaches."""
    rows = [*statistics.information_rows(report.plans, report.settings["skip"]), *report.steps]
    if not rows:
        return None
    curves: dict[str, list[tuple[int, float, float, float]]] = {}
    starred: dict[str, set[int]] = {}
    for row in rows:
        name = f"{row['model']}, sees context" if "context" in row["sees"] else row["model"]
        label = "mutual information" if row["what"] == "mutual information" else f"gain, {name}"
        few = row["units"] is not None and row["units"] < ENOUGH_UNITS
        starred.setdefault(label, set()).update([] if few or row["low"] < LEAST else [row["lag"]])
        curves.setdefault(label, []).append((row["lag"], row["bits"], row["low"], row["high"]))
    floor = [(row["lag"], row["chance"]) for row in rows if row["chance"] is not None]
    by_lag = {label: {row[0]: row for row in curve} for label, curve in curves.items()}
    lags = [lag for lag in LISTED if any(lag in own for own in by_lag.values())]
    cells = [[str(lag), *(_told(own.get(lag), lag in starred[label]) for label, own in by_lag.items())] for lag in lags]
    headings = ["lag", *(label.replace(", ", "\n").replace("sees context", "+ context") for label in by_lag)]
    first = statistics.first_fold(report.scored, report.settings)
    over = f"{unit_name(report.plans)} (gain: {unit_name(first)} of the first fold, if there are {ENOUGH_UNITS})"
    table = Table(headings, cells, f"Bits. *: above 0, by the 95 % interval of that lag over {over}.")
    text = [
        "Mutual information: what an action tells of the one k steps later, whatever lies between. Gain: what the"
        " action k steps back tells beyond all nearer ones, in held-out plans of the first fold: a model that knows k"
        " actions against one that knows k - 1, on the same actions (a Markov chain of that order with back-off; a GRU"
        " that has learned from pieces of plans).",
        "Where the gain of the chain ends before that of the GRU, longer histories matter but occur too seldom to be"
        " counted; below 0 more is lost by splitting the counts than an older action tells.",
    ]
    figure = FigureBox(
        (plan_figures.lag_figure(curves, floor)),
        "Bits that the action k steps back gives. Expected by chance: below it is 95 % of what is none.",
        "Information by lag.",
    )
    return Section("How far back the structure reaches", text, [table], [figure]), {"lags": rows}


def _told(row: tuple[int, float, float, float] | None, star: bool) -> str:
    return "" if row is None else f"{row[1]:.4f}{'*' if star else ' '}"


def order_section(report: "Report") -> tuple[Section, Rows] | None:
    """Which order."""
    if int(report.plans.mask().sum(1).max()) < 2 or report.plans.num_actions < 2:
        return None
    rows = statistics.order_rows(report.plans, statistics.num_contexts([report.plans]))
    held_out: dict[str, dict[int, dict[str, Any]]] = {}
    for row in report.rows:
        if CHAIN.fullmatch(row["model"]):
            held_out.setdefault(row["sees"], {})[int(row["model"].removeprefix("markov-"))] = row
    criteria = {
        f"{name.upper()}{', context' * ('context' in sees)}": [
            (r["order"], r[f"{name}_bits"]) for r in rows if r["sees"] == sees
        ]
        for sees in dict.fromkeys(row["sees"] for row in rows)
        for name in ("bic", "aic")
    }
    curves = {
        f"held out, {'sees context' if 'context' in sees else 'actions'}": [
            (order, row["bits_per_action"], row["low"], row["high"]) for order, row in sorted(own.items())
        ]
        for sees, own in held_out.items()
    }
    cells = []
    for row in rows:
        own = held_out.get(row["sees"], {}).get(row["order"])
        cells.append(
            [
                str(row["order"]),
                "+ context" if "context" in row["sees"] else "actions",
                f"{row['num_parameters']:,}",
                f"{row['bic_bits']:.4f}",
                f"{row['aic_bits']:.4f}",
                "" if own is None else f"{own['bits_per_action']:.4f}",
            ]
        )
    table = Table(
        ("order", "sees", "parameters", "BIC", "AIC", "held out"),
        cells,
        "Bits per action; the information criteria are halved, so that they stand on the same scale.",
        "llrrrr",
    )
    text = [_best_orders(rows, held_out)]
    figure = FigureBox(
        (plan_figures.order_figure(criteria, curves)), "The least of each curve is ringed.", "Order selection."
    )
    return Section("Which order a Markov chain needs", text, [table], [figure]), {"orders": rows}


def _best_orders(rows: Sequence[dict[str, Any]], held_out: dict[str, dict[int, dict[str, Any]]]) -> str:
    said = []
    for sees in dict.fromkeys(row["sees"] for row in rows):
        own = [row for row in rows if row["sees"] == sees]
        chosen = {name.upper(): min(own, key=lambda row: row[name])["order"] for name in ("bic", "aic")}
        if sees in held_out:
            chosen["held-out plans"] = min(held_out[sees], key=lambda order: held_out[sees][order]["bits_per_action"])
        said.append(
            f"Seeing {sees}: "
            + ", ".join(f"{name} choose{'s' * (name != 'held-out plans')} order {k}" for name, k in chosen.items())
        )
    why = (
        "The criteria judge plans that were learned from, and count a parameter for each action after each history"
        " that occurred; held-out chains lean on shorter histories where a history is rare."
    )
    return ". ".join([*said, why])


def calibration_section(report: "Report") -> tuple[Section, Rows] | None:
    """Whether probabilities are those with which actions are taken."""
    curves, rows, cells = {}, [], []
    best = min(report.rows, key=lambda row: row["bits_per_action"])
    for model in leading(report.models, report.scores, best["sees"]) or report.models:
        found = model.calibration()
        if found is None:
            continue
        curves[model.label] = [(b.forecast, b.taken.mean, b.taken.low, b.taken.high, b.number) for b in found.bins]
        cells.append([model.label, f"{100 * found.expected_calibration_error:.2f} %"])
        rows += [
            {"model": model.name, "sees": model.sees, "forecast": f, "taken": t, "low": low, "high": high, "number": n}
            for f, t, low, high, n in curves[model.label]
        ]
    if not curves:
        return None
    table = Table(("model", "expected calibration error"), cells, "Mean distance of forecast and share taken.")
    text = [
        "Of the actions that a model forecast with a probability of about 0.3, were 0.3 taken? Points on the diagonal:"
        " yes."
    ]
    figure = FigureBox(
        (plan_figures.calibration_figure(curves)),
        f"Forecast probability against the share taken; 95 % intervals over {unit_name(report.scored, report.mask)}.",
        "Calibration of " + ", ".join(curves),
    )
    return Section("Calibration", text, [table], [figure]), {"calibration": rows}


def _named(row: dict[str, Any]) -> str:
    return row["model"] + (" seeing the context" if "context" in row["sees"] else "")


def _bits(row: dict[str, Any]) -> str:
    return f"{row['bits_per_action']:.3f} ({row['low']:.3f} to {row['high']:.3f})"
