"""The sections of a report on plans about the behaviour itself: transitions, sequences, likeness of samples, drift."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from neuroprior.analysis import action_drift, by_group, by_plan, by_position
from neuroprior.analysis.comparison import unit_name
from neuroprior.report import figures as plan_figures
from neuroprior.report import matrix_figures, statistics
from neuroprior.report.crossval import ACTIONS, CONTEXT
from neuroprior.report.page import FigureBox, Section, Table
from neuroprior.report.scores import Model, leading

if TYPE_CHECKING:
    from neuroprior.report.study import Report

Rows = dict[str, Sequence[dict[str, Any]]]

DRAWN = 12
"""Sequences drawn, real and generated."""

MOTIFS = (
    "Sequences of three to six actions that occur more (or less) often than their parts explain: than a chain says that"
    " knows how often the sequence without its first, and without its last action occurs. All plans are taken to be of"
    " one chain: where groups differ, sequences of some of them stand out, too. One that stands out makes others do so"
    " that share its beginning."
)

MOST_LISTED = 12
"""Actions and groups in tables."""


def transition_section(report: "Report") -> tuple[Section, Rows] | None:
    """What follows what, overall and in each group."""
    if int(report.plans.mask().sum(1).max()) < 2:
        return None
    rows, test = statistics.transition_rows(report.plans)
    names = statistics.action_names(report.plans)
    figures = [
        FigureBox(
            (matrix_figures.transition_figure(test["probs"], names)),
            "The probability of each action (column) after each action (row).",
            "Transition matrix.",
        )
    ]
    text = ["How often each action follows each other one, within plans."]
    if len(test["groups"]) > 1:
        tested = test["test"] == "permutation"
        differ = "differ" if test["p_value"] < statistics.SIGNIFICANT else "cannot be told apart"
        text.append(
            f"{len(test['groups'])} groups: they {differ} (p = {test['p_value']:.2g}, permutation test over plans,"
            f" {test['permutations']} permutations). Marked cells differ at p < 0.05, corrected for all."
            if tested
            else f"{len(test['groups'])} groups, with too few plans in each to test whether they differ."
        )
        significant = test["significant"] & tested
        figures.append(
            FigureBox(
                (
                    matrix_figures.group_transition_figure(
                        test["group_probs"], test["probs"], names, test["groups"], significant
                    )
                ),
                "Each group's transition probabilities less those of all.",
                "Differences of the groups' transitions.",
            )
        )
    return Section("What follows what", text, [], figures), {"transitions": rows}


def motif_section(report: "Report") -> tuple[Section, Rows] | None:
    """Sequences that stand out."""
    rows = statistics.motif_rows(report.plans)
    rows = [row for row in rows if row["corrected"] < statistics.SIGNIFICANT]
    tables, figures = [], []
    for repeats in dict.fromkeys(row["repeats"] for row in rows):
        own = [row for row in rows if row["repeats"] == repeats]
        merged = ", repeats of an action merged" * (repeats == "merged")
        cells = [
            [
                r["sequence"],
                f"{r['count']:,}",
                f"{r['expected']:,.1f}",
                f"{r['ratio']:.2f}",
                f"{r['low']:.2f} to {r['high']:.2f}",
                _p(r["corrected"]),
            ]
            for r in own
        ]
        caption = f"Against a chain of order n - 2{merged}. p: Fisher's exact test, corrected for all sequences (Holm)."
        tables.append(Table(("sequence", "count", "expected", "ratio", "95 % interval", "p"), cells, caption))
        figures.append(
            FigureBox(
                (plan_figures.motif_figure(own)),
                f"How many times as often as expected{merged}.",
                "Over-represented sequences: " + "; ".join(row["sequence"] for row in own[:5]),
            )
        )
    text = [MOTIFS] + ([] if rows else ["None stands out (p < 0.05, corrected for all sequences)."])
    return Section("Sequences that stand out", text, tables, figures), {"motifs": rows}


def likeness_section(report: "Report") -> tuple[Section, Rows] | None:
    """Sequences sampled from the models beside real ones."""
    rows: list[dict[str, Any]] = []
    shown: tuple[Model, list[Any]] | None = None
    cost = {id(m): s.bits_per_action().mean for m, s in zip(report.models, report.scores, strict=True)}
    kept = [model for sees in (CONTEXT, ACTIONS) for model in leading(report.models, report.scores, sees)]
    tested = unit_name(report.scored) != "groups"
    real = statistics.first_fold(report.scored, report.settings)
    for model in sorted(kept, key=lambda model: cost[id(model)]):
        own, found = statistics.likeness_rows(real, model, tested)
        rows += own
        if found and shown is None:
            shown = model, found
    if shown is None:
        return None
    tables, figures = [_likeness_table(rows, shown[1], tested)], _likeness_figures(report, *shown)
    return (
        Section("Generated sequences beside real ones", _likeness_text(shown[0]), tables, figures),
        {"likeness": rows},
    )


def _likeness_table(rows: list[dict[str, Any]], found: Sequence[Any], tested: bool) -> Table:
    """A row a model, a column a statistic; and what two sets of one source differ by."""
    statistic = [one.statistic for one in found]
    cells: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        own = cells.setdefault((row["model"], row["sees"]), [])
        own.append(f"{row['distance']:.3f}{'*' * (tested and row['corrected'] < statistics.SIGNIFICANT)}")
    named = [[name, "+ context" if "context" in sees else "actions", *own] for (name, sees), own in cells.items()]
    test = (
        "*: told apart at p < 0.05, permutation test over plans, corrected."
        if tested
        else "Not tested: plans of one group are not independent."
    )
    return Table(
        ("model", "sees", *(name.replace(" ", "\n") for name in statistic)),
        [*named, ["alike", "", *(f"{one.null_distance:.3f}" for one in found)]],
        f"Total variation between the distributions in generated and in held-out real plans (0: the same). {test}"
        " alike: what two such sets of one source differ by, were all plans independent.",
        "ll" + "r" * len(statistic),
    )


def _likeness_text(model: Model) -> list[str]:
    return [
        "From each model of the first fold a plan was sampled for each held-out plan, as long as that. A good model of"
        " behaviour is one whose plans cannot be told from real ones, by sequences of actions (n-grams), by how long an"
        " action is repeated, and by how long it takes to come back.",
        f"The figures show the best model, {model.label}.",
    ]


def _likeness_figures(report: "Report", model: Model, found: Sequence[Any]) -> list[FigureBox]:
    real = statistics.first_fold(report.scored, report.settings)[:DRAWN]
    generated = model.load("generated")
    assert generated is not None
    beyond = ~real.mask()
    strips = [torch.as_tensor(a).long().masked_fill(beyond, -1) for a in (real.actions, generated[: len(real)])]
    lengths = {
        one.statistic: (one.real.tolist(), one.generated.tolist())
        for one in found
        if len(one.classes[0]) == 1 and "gram" not in one.statistic
    }
    boxes = [
        FigureBox(
            (matrix_figures.raster_figure(*strips, statistics.action_names(report.plans))),
            f"Held-out plans, and plans sampled from {model.label}.",
            "Real and generated sequences as strips of colour.",
        )
    ]
    if lengths:
        boxes.append(
            FigureBox(
                (plan_figures.distribution_figure({f"{name}, actions": pair for name, pair in lengths.items()})),
                "Shares of run lengths and return times; the last class holds all that are longer.",
                "Run lengths and return times, real and generated.",
            )
        )
    return boxes


def drift_section(report: "Report") -> tuple[Section, Rows] | None:
    """Whether plans get easier or harder to predict, within and between them."""
    if int(report.mask.sum(1).max()) < 2:
        return None
    cost = [one.bits_per_action().mean for one in report.scores]
    # The best whose bits are those of the plans' own actions; one that tells ends, too, has more of them.
    for place in sorted(range(len(cost)), key=lambda k: cost[k]):
        model, bits = report.models[place], report.models[place].bits()
        if bits.shape == report.scored.actions.shape:
            break
    else:
        return None
    drifts = report.scored, bits, report.mask
    within, plans, groups = by_position(*drifts), by_plan(*drifts), by_group(*drifts)
    names = statistics.group_names(report.scored, torch.tensor(list(groups.groups)))
    named = dict(zip(groups.groups, names, strict=True))
    rows = [
        {"what": "place", "name": f"part {n} of {len(within.parts)}", "bits": i.mean, "low": i.low, "high": i.high}
        for n, i in enumerate(within.parts, 1)
    ] + [
        {"what": "group", "name": named[g], "bits": i.mean, "low": i.low, "high": i.high}
        for g, i in groups.groups.items()
    ]
    figure = plan_figures.drift_figure(
        [(i.mean, i.low, i.high) for i in within.parts],
        _in_groups(plans, named),
        [(named[g], i.mean, i.low, i.high) for g, i in groups.groups.items()],
    )
    unit = unit_name(report.scored, report.mask)
    text = [
        f"Bits per held-out action of {model.label}: where behaviour changes, plans get harder (or easier) to predict.",
        *(
            ["The only plan was cut into consecutive parts, which stand for plans."]
            if report.settings.get("cut")
            else []
        ),
        _trends(within, plans, groups),
    ]
    box = FigureBox(
        (figure),
        f"95 % intervals over {unit}; of groups, over the plans of each.",
        "Bits per action by place, plan and group.",
    )
    changes, table = _action_changes(report)
    return Section("Drift", text, table, [box]), {"drift": rows, "action_drift": changes}


def _in_groups(plans: Any, named: dict[int, str]) -> list[tuple[str, int, float]]:
    """Each plan's group, its place in the group, and its bits per action."""
    seen: dict[int, int] = {}
    points = []
    for group, bits in zip(plans.group.tolist(), plans.bits.tolist(), strict=True):
        seen[group] = seen.get(group, 0) + 1
        points.append((named.get(group, ""), seen[group], bits))
    return points


def _trends(within: Any, plans: Any, groups: Any) -> str:
    """The tests in words."""
    said = []
    if within.trend is not None:
        trend = within.trend
        said.append(
            f"Over the length of a plan it changes by {trend.mean:+.3f} bits"
            f" ({trend.low:+.3f} to {trend.high:+.3f}, p = {trend.p_value:.2g})."
        )
    if plans.trend is not None:
        said.append(
            f"From one of the {plans.item} to the next in the file the rank correlation is {plans.trend.mean:+.2f}"
            f" ({plans.trend.low:+.2f} to {plans.trend.high:+.2f}, p = {plans.trend.p_value:.2g})."
        )
    if groups.p_value is not None:
        said.append(f"Groups: p = {groups.p_value:.2g} that all are alike (Kruskal and Wallis's test).")
    return " ".join(said) or "There is too little to test."


def _action_changes(report: "Report") -> tuple[list[dict[str, Any]], list[Table]]:
    """How the share of each action changes from the first to the second half of the plans."""
    names = statistics.action_names(report.plans)
    try:
        found = action_drift(report.plans)
    except ValueError:
        return [], []  # too few plans with two halves
    rows = [
        {
            "action": names[one.action],
            "first_half": one.first,
            "second_half": one.second,
            "change": one.change.mean,
            "low": one.change.low,
            "high": one.change.high,
            "p_value": one.change.p_value,
            "corrected": one.corrected,
        }
        for one in found
    ]
    most = sorted(rows, key=lambda row: (row["corrected"], -abs(row["change"])))[:MOST_LISTED]
    cells = [
        [
            row["action"],
            f"{100 * row['first_half']:.2f}",
            f"{100 * row['second_half']:.2f}",
            f"{100 * row['change']:+.2f} ± {100 * (row['high'] - row['change']):.2f}",
            _p(row["corrected"]),
        ]
        for row in most
    ]
    caption = "Share of all actions, %, in the first and in the second half of the plans. p: corrected (Holm)."
    return rows, [Table(("action", "first", "second", "change", "p"), cells, caption)]


def _p(value: float) -> str:
    return f"{value:.1g}" if value else "<1e-300"
