"""The section on individuals: how each differs from the others, where it stands, and whether there are types."""

from collections.abc import Sequence
from math import inf

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy.cluster.hierarchy import dendrogram, linkage
from scipy.spatial.distance import squareform

from neuroprior._statistics import ENOUGH_UNITS, LEVEL, interval_words, p_words
from neuroprior.behaviour.analysis.comparison import too_few
from neuroprior.behaviour.analysis.individuality import Individuality, individuality
from neuroprior.behaviour.analysis.individuals import (
    FEWEST_INDIVIDUALS,
    Individuals,
    divergence,
    individual_types,
    individuals,
)
from neuroprior.behaviour.recorded_plans import RecordedPlans, action_names, group_names, numbered_names
from neuroprior.behaviour.reporting.document import Column, table
from neuroprior.behaviour.reporting.drawing import (
    SPARE,
    STRIPS,
    WIDTH,
    Array,
    drawn,
    legend,
    level_colors,
    marker,
    names_down,
    panels,
    short,
)
from neuroprior.behaviour.reporting.figures import OTHER
from neuroprior.behaviour.reporting.findings import Finding
from neuroprior.behaviour.reporting.page import INK, FigureBox, Section, Table
from neuroprior.behaviour.reporting.part import LISTED, Part, without_verdict
from neuroprior.behaviour.reporting.scores import Evaluation


def individual_section(evaluation: Evaluation) -> Part | None:
    """A row and a strip for each individual; None where there are fewer than two."""
    plans, generator = evaluation.plans, torch.Generator().manual_seed(0)
    groups = plans[plans.mask().sum(1) > 1].group
    if groups is None or len(groups.unique()) < 2:
        return None
    result = individuals(plans, generator)
    frame, budget = result.frame(), individual_budget(plans)
    enough = len(result.names) >= ENOUGH_UNITS
    columns: dict[str, Column] = {
        "individual": "individual",
        "from the others": "distance:.3f",
        "95 % interval": lambda row: interval_words(row.low, row.high, ".3f"),
        "by chance": "by_chance:.3f",
        "differs most in": "differs_in",
    }
    caption = (
        "From the others: the Jensen-Shannon distance of its transition probabilities from those of all others."
        " By chance: 95 % stay below where all are alike (chains of order 1, with as many transitions)."
    )
    tables = [table(frame, columns, caption, "Individuals", "lrrrl")]
    frames = {"individuals": frame, "individual_budget": budget.reset_index(names="individual")}
    text = []
    if len(result.names) >= FEWEST_INDIVIDUALS:
        types = individual_types(plans, generator)
        frames["individual_types"] = types.frame()
        text.append(types.sentence)
    condition = _conditions(plans, result)
    boxes = [
        FigureBox(
            budget_strips(budget, result),
            "What each individual did, as shares of its behaviours, and how far it is from the others (95 % interval;"
            " grey: what is usual by chance).",
            "Strips of behaviours of each individual.",
            "individual_strips",
        ),
        FigureBox(
            plane_figure(result.places, result.names, condition),
            "Individuals in a plane: the nearer two are, the more alike are their transitions (classical scaling).",
            "Individuals as points in a plane.",
            "individual_plane",
        ),
    ]
    if len(result.action_names) > 2:
        boxes.append(
            FigureBox(
                dendrogram_figure(result.probs.mean(0), result.action_names),
                "Behaviours that are followed by the same ones stand together (average linkage of Jensen-Shannon"
                " distances).",
                "Tree of behaviours.",
                "behaviour_tree",
            )
        )
    most = frame.iloc[int(frame["distance"].argmax())]
    p_value = evaluation.transitions.p_value
    sentence = (
        f"Individuals differ in their transitions ({p_words(p_value)}), most of all {most.individual}: its distance"
        f" from the others is {most.distance:.3f}, 95 % interval {most.low:.3f} to {most.high:.3f} ({most.differs_in})."
    )
    estimate = (float(most.distance), float(most.low), float(most.high))
    starred = bool(enough and p_value < LEVEL)
    findings = [Finding("individuals", "individuals", "individuals", *estimate, p_value, p_value, starred, sentence)]
    if evaluation.transitions.test == "none":
        findings = []
    elif not starred:
        text.append(without_verdict(too_few(plans)) or f"That they differ was not found ({p_words(p_value)}).")
    if len(result.names) >= FEWEST_INDIVIDUALS:
        gain = individuality(plans)
        frames |= {"individuality": gain.frame(), "individuality_by_behaviour": gain.behaviours()}
        finding = _individuality_finding(gain, enough)
        findings.append(finding)
        text.append(finding.sentence)
        tables.append(_individuality_table(gain))
    return Part(Section("Individuals", text, tables, boxes), frames, findings=findings)


def _individuality_finding(gain: Individuality, enough: bool) -> Finding:
    saved, low, high, p_value = gain.total
    concentration = gain.concentrations[-1]
    after = f" (its own transitions count as much as those of all after {concentration:.0f} of them)"
    sentence = (
        f"Predictions that follow the individual save {saved:.4f} bits per behaviour, 95 % interval {low:.4f} to"
        f" {high:.4f}: {100 * gain.share:.2g} % of all that is predicted{after * (concentration < inf)};"
        f" {p_words(p_value)}."
    )
    name, starred = "individuality", enough and p_value < LEVEL and saved > 0
    return Finding(name, name, name, saved, low, high, p_value, p_value, bool(starred), sentence)


def _individuality_table(gain: Individuality) -> Table:
    rows = gain.behaviours().sort_values("saved", ascending=False, kind="stable")
    columns: dict[str, Column] = {
        "behaviour": "behaviour",
        "bouts": "bouts:,",
        "bits": "bits:.3f",
        "saved": "saved:+.4f",
    }
    caption = (
        "Bits per bout of each behaviour under a chain of order 1 of the other subjects, and how many are saved where"
        " its predictions are drawn to what the subject did before. What a condition changes counts, too."
    )
    return table(rows.head(LISTED), columns, caption, "Individuality", "lrrr")


def individual_budget(plans: RecordedPlans) -> pd.DataFrame:
    """The share of each behaviour among the actions of each individual: a row an individual, a column a behaviour."""
    mask, size = plans.mask(), plans.num_actions
    assert plans.group is not None
    subject = plans.group.long()[:, None].expand(mask.shape)[mask]
    present, rank = subject.unique(return_inverse=True)
    counts = (rank * size + plans.actions[mask].long()).bincount(minlength=len(present) * size).view(-1, size)
    shares = (counts / counts.sum(1, keepdim=True)).cpu().numpy()
    return pd.DataFrame(shares, index=group_names(plans, present), columns=action_names(plans))


def _conditions(plans: RecordedPlans, result: Individuals) -> list[str]:
    """The condition of each individual; "" where it is under several, or there are none."""
    if plans.condition is None or plans.group is None:
        return [""] * len(result.names)
    pairs = torch.stack([plans.group.long(), plans.condition.long()]).unique(dim=1)
    conditions = numbered_names(plans.condition_names, pairs[1], "condition")
    under: dict[str, list[str]] = {}
    for name, condition in zip(group_names(plans, pairs[0]), conditions, strict=True):
        under.setdefault(name, []).append(condition)
    return [under[name][0] if len(under[name]) == 1 else "" for name in result.names]


@drawn
def budget_strips(budget: pd.DataFrame, result: Individuals) -> Figure:
    """A strip for each individual, all of them: its shares of behaviours, and its distance from the others.

    Args:
        budget: shares; a row an individual, a column a behaviour.
        result: of `individuals`.
    """
    rows = budget.reindex([*result.names])
    order = rows.mean().sort_values(ascending=False).index
    figure, (left, right) = panels(1, 2, (WIDTH, 0.9 + 0.24 * len(rows)), sharey=True, width_ratios=(3, 1))
    at, edge = np.arange(len(rows))[::-1], np.zeros(len(rows))
    colors = [*STRIPS[:11], *[OTHER] * len(order)]
    for color, behaviour in zip(colors, order, strict=False):
        left.barh(at, rows[behaviour], left=edge, height=0.8, color=color, lw=0)
        edge = edge + rows[behaviour].to_numpy()
    left.set(xlim=(0, 1), xlabel="share of behaviours")
    names_down(left, [short(str(name), 16) for name in rows.index], at)
    right.barh(at, result.by_chance, height=0.8, color=OTHER, alpha=0.25, lw=0)
    distance, low, high = result.from_others.T
    right.hlines(at, low, high, color=INK, lw=1.6)
    right.plot(distance, at, "o", color=INK, ms=4.5)
    right.set(xlim=(0, None), xlabel="distance from the others")
    right.tick_params(axis="y", length=0)
    shown = [marker(color, False, short(str(name), 18), "s") for color, name in zip(STRIPS[:11], order, strict=False)]
    legend(figure, shown + [marker(OTHER, False, "others", "s")] * (len(order) > 11))
    return figure


@drawn
def plane_figure(places: ArrayLike, names: Sequence[str], condition: Sequence[str]) -> Figure:
    """Individuals as points in a plane, coloured by their condition.

    Args:
        places: `[S, 2]`.
        names: S of them.
        condition: of each; "" for none.
    """
    points = np.asarray(places, dtype=np.float64)
    figure, (axes,) = panels(1, 1, (WIDTH * 0.75, WIDTH * 0.6))
    kinds = sorted(set(condition))
    hues = level_colors(kinds)
    for (x, y), name, kind in zip(points, names, condition, strict=True):
        axes.plot(x, y, "o", ms=7, color=hues[kind], mew=0, alpha=0.8)
        axes.annotate(short(name, 14), (x, y), xytext=(5, 4), textcoords="offset points", fontsize=8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="first dimension", ylabel="second dimension")
    axes.margins(0.15)
    legend(figure, [marker(hues[kind], False, short(kind, 24)) for kind in kinds if kind])
    return figure


@drawn
def dendrogram_figure(probs: Array, names: Sequence[str]) -> Figure:
    """A tree of behaviours, by how alike the probabilities of the next one are.

    Args:
        probs: `[A, A]`: transition probabilities.
        names: A of them.
    """
    distances = np.sqrt(divergence(probs[:, None], probs))
    figure, (axes,) = panels(1, 1, (WIDTH * 0.75, 0.8 + 0.26 * len(names)))
    tree = linkage(squareform(distances, checks=False), "average")
    labels = [short(name, 24) for name in names]
    dendrogram(tree, orientation="left", labels=labels, ax=axes, color_threshold=0, above_threshold_color=SPARE[4])
    axes.tick_params(axis="y", labelsize=10)
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("distance")
    return figure
