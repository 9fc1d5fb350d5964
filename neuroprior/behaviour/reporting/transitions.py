"""The section on transitions: overall, under each condition, as a graph, and whether groups differ in them."""

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from neuroprior._statistics import interval_words
from neuroprior.behaviour.analysis.comparison import too_few
from neuroprior.behaviour.analysis.transitions import Transitions, transitions
from neuroprior.behaviour.reporting.document import Column, table
from neuroprior.behaviour.reporting.drawing import PLAIN, WIDTH, drawn, panels, short
from neuroprior.behaviour.reporting.figures import group_transition_figure, transition_figure
from neuroprior.behaviour.reporting.page import INK, PAPER, FigureBox, Section
from neuroprior.behaviour.reporting.part import LISTED, Part, without_verdict
from neuroprior.behaviour.reporting.scores import Evaluation

MOST_NODES = 20
"""Actions up to which the graph of transitions is drawn."""


def transition_section(evaluation: Evaluation) -> Part | None:
    """Transition probabilities, overall and under each condition, and a test of whether groups have the same."""
    plans = evaluation.plans
    if int(plans.mask().sum(1).max()) < 2:
        return None
    result, few = evaluation.transitions, too_few(plans)
    names, probs = result.action_names, result.probs()
    frame = result.frame()
    frames = {"transitions": frame, "transition_test": pd.DataFrame()}
    text = ["The probability of each behaviour after each other one, within sequences."]
    shown = frame[frame["subject"] == result.name_of_all].sort_values("count", ascending=False, kind="stable")[:LISTED]
    columns: dict[str, Column] = {
        "transition": lambda row: f"{row['from']} → {row['to']}",
        "count": "count:,",
        "probability": "probability:.3f",
        "95 % interval": lambda row: interval_words(row.low, row.high, ".3f"),
    }
    over = "subjects" if len(result.groups) > 1 else "sequences"
    tables = [table(shown, columns, f"The commonest; intervals over {over}.", "Transitions")]
    caption = "The probability of each behaviour (column) after each behaviour (row)."
    boxes = [FigureBox(transition_figure(probs, names), caption, "Transition matrix.", "transitions")]
    if len(names) <= MOST_NODES:
        caption = (
            "Transitions above chance: arrows whose 95 % interval lies above the share of their second behaviour among"
            " all that follow another one. The wider an arrow, the more probable; the larger a circle, the more"
            " frequent."
        )
        boxes.append(FigureBox(transition_graph_figure(result), caption, "Graph of transitions.", "transition_graph"))
    if plans.condition is not None and len(plans.condition.unique()) > 1:
        levels = transitions(plans, by="condition", generator=torch.Generator().manual_seed(0))
        frames["condition_transitions"] = levels.frame()
        each = levels.group_probs()
        for name, matrix in zip(levels.group_names, each, strict=True):
            drawing = transition_figure(matrix, names, f"under {name}")
            boxes.append(
                FigureBox(drawing, f"Under {name}.", f"Transitions under {name}.", f"transitions_{len(boxes)}")
            )
        if len(each) == 2:
            first, second = levels.group_names
            none = np.zeros((1, len(names), len(names)), dtype=bool)
            drawing = group_transition_figure(each[1:], each[0], names, [f"{second} less {first}"], none)
            caption = f"Difference in probability, {second} less {first}. What is significant: see Conditions."
            boxes.append(FigureBox(drawing, caption, "Difference of transitions.", "transition_difference"))
    if len(result.groups) > 1:
        row = {"subjects": len(result.groups), "test": result.test, "permutations": result.permutations}
        test = pd.DataFrame([row | {"statistic": result.statistic, "p_value": result.p_value}])
        frames["transition_test"] = test
        text.append(without_verdict(few) or "That subjects have the same transitions is tested by permuting sequences.")
        if not few:
            columns = {"subjects": "subjects", "permutations": "permutations:,", "p": "p_value:.2g"}
            caption = "Whether subjects have the same transitions (p: blank if not tested)."
            tables.append(table(test, columns, caption, "Do subjects differ?", align="rrr"))
    return Part(Section("Transitions", text, tables, boxes), frames, graphs={"transition_graph": result.graph()})


@drawn
def transition_graph_figure(result: Transitions, group: str | None = None) -> Figure:
    """The transitions above chance as arrows between actions on a circle; see `Transitions.graph`.

    Args:
        result: of `transitions`.
        group: whose; None: of all.
    """
    graph = result.graph(group)
    names = list(graph.nodes)
    angle = np.pi / 2 - 2 * np.pi * np.arange(len(names)) / max(len(names), 1)
    place = dict(zip(names, np.stack([np.cos(angle), np.sin(angle)], 1), strict=True))
    most = max((graph.nodes[name]["count"] for name in names), default=1) or 1
    figure, (axes,) = panels(1, 1, (WIDTH * 0.8, WIDTH * 0.8))
    for first, second, edge in graph.edges(data=True):
        if first == second:
            continue  # a loop says how long a bout is counted; its number stands in the matrix
        arrow = FancyArrowPatch(
            place[first],
            place[second],
            arrowstyle="-|>",
            mutation_scale=8 + 10 * edge["weight"],
            connectionstyle="arc3,rad=0.14",
            shrinkA=14,
            shrinkB=14,
            lw=0.6 + 5 * edge["weight"],
            color=PLAIN,
            alpha=0.35 + 0.6 * min(edge["weight"], 1),
        )
        axes.add_patch(arrow)
    for name in names:
        x, y = place[name]
        size = 5 + 13 * (graph.nodes[name]["count"] / most) ** 0.5
        axes.plot(x, y, "o", ms=size, color=PLAIN, mec=PAPER, mew=1.5)
        side = "left" if x > 0.15 else "right" if x < -0.15 else "center"
        axes.text(1.12 * x, 1.12 * y, short(name, 18), ha=side, va="center", fontsize=10, color=INK)
    axes.set(xlim=(-1.6, 1.6), ylim=(-1.3, 1.3), aspect="equal")
    axes.axis("off")
    return figure
