"""Figures of a comparison of priors: curves against plans and rounds, dots with intervals, plans drawn in a world.

Each takes rows of a table of `eval.compare.results` and the colour and line of each prior by name (`styles`);
curves of priors that are not `strong` are thin lines without a band. Without rows a ValueError is raised.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, PercentFormatter

from neuroprior.behaviour.reporting.drawing import (
    FEWER,
    MORE,
    WIDTH,
    band,
    dot,
    drawn,
    expect_some,
    legend,
    lines,
    names_down,
    panels,
    short,
)
from neuroprior.behaviour.reporting.page import INK, clean

SMALL = (3.0, 3.0)
"""Size of a figure beside others, inches."""

PHONE = 4.5
"""Width of a figure that a phone shows whole, inches."""

LETTERS = 8
"""Size of text in small figures, points."""

WALL, REWARD = (0.49, 0.51, 0.55), (0.18, 0.62, 0.36)
"""Colours of what stands in a drawn world, legible on light and dark pages."""

JITTER = 0.17
"""How far the paths of a drawing are moved apart, squares."""

POINTS = "difference in normalised score, percentage points"

Style = tuple[str, str]


class View(NamedTuple):
    """A panel of curves: its title and rows, with the `name` of each line; the column that goes across; its label."""

    title: str
    rows: pd.DataFrame
    across: str
    label: str
    ticks: Sequence[int]


def styles(priors: Iterable[str]) -> dict[str, Style]:
    """A colour and a style of line for each prior by name, the same in all figures."""
    names = list(dict.fromkeys(priors))
    return dict(zip(names, lines(names), strict=True))


@drawn
def score_panels(views: Sequence[View], height: float = 3.2, log: bool = False) -> Figure:
    """Normalised scores with their bands, a panel a view; `log`: on a logarithmic axis."""
    expect_some("views", views)
    figure, axes = panels(1, len(views), (WIDTH, height), sharey=True)
    style = styles(name for view in views for name in view.rows["name"])
    for panel, view in zip(axes, views, strict=True):
        for name in style:
            curve = view.rows[view.rows["name"] == name].sort_values(view.across)
            band(
                panel,
                curve[[view.across, "oracle_share", "low", "high"]].to_numpy(),
                style[name][0],
                name,
                style[name][1],
            )
        if log:
            panel.set_xscale("log", base=2)
        panel.set_xticks(view.ticks, [f"{tick:,}" for tick in view.ticks])
        panel.set(title=view.title, xlabel=view.label)
        panel.grid(axis="y")
    axes[0].set_ylabel("normalised score,\n% of the optimum")
    axes[0].yaxis.set_major_formatter(PercentFormatter(1, symbol=""))
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure


@drawn
def score_figure(rows: pd.DataFrame, strong: Sequence[str], style: Mapping[str, Style]) -> Figure:
    """The normalised score of one world's priors against the number of candidate plans: rows of `Results.curves`.

    A row without a number of plans is drawn as a line across.
    """
    expect_some("rows", rows)
    figure, (axes,) = panels(1, 1, SMALL)
    counted = rows[rows["num_plans"].notna()]
    _curves(axes, counted, "num_plans", strong, style)
    for _, row in rows[rows["num_plans"].isna()].iterrows():
        axes.axhline(100 * row["oracle_share"], color=INK, lw=1, ls=(0, (1, 2)), label=row["planner"])
    most = int(counted["num_plans"].max()) if len(counted) else 1
    _powers(axes, most, 16 if most > 256 else 4)
    _finish(axes, "candidate plans", rows["world"].iloc[0])
    return figure


@drawn
def curriculum_figure(rows: pd.DataFrame, strong: Sequence[str], style: Mapping[str, Style]) -> Figure:
    """The normalised score of one world's priors after each round of the curriculum: `Results.curriculum`."""
    expect_some("rows", rows)
    figure, (axes,) = panels(1, 1, SMALL)
    _curves(axes, rows, "round", strong, style)
    lengths = dict(sorted(zip(rows["round"], rows["length"], strict=True)))
    axes.set_xticks(list(lengths), [f"{one}\n{length}" for one, length in lengths.items()])
    context = rows["context"].iloc[0]
    title = rows["world"].iloc[0] + ("" if context == "none" else f", {context} context")
    _finish(axes, "round, and actions in a plan", title)
    return figure


def _curves(axes: Axes, rows: pd.DataFrame, across: str, strong: Sequence[str], style: Mapping[str, Style]) -> None:
    """A line a prior, with a band if it is one of `strong`."""
    for prior in rows["prior"].unique():
        prior_rows, (color, line) = rows[rows["prior"] == prior], style[prior]
        points = prior_rows[[across, "oracle_share", "low", "high"]].astype("float64").to_numpy() * (1, 100, 100, 100)
        points = points[points[:, 0].argsort()]
        if prior in strong:
            band(axes, points, color, short(prior, 20), line)
            axes.lines[-1].set(markersize=3, linewidth=1.6)
        else:
            axes.plot(points[:, 0], points[:, 1], line, color=color, lw=0.8, alpha=0.6)


def _powers(axes: Axes, most: int, base: int) -> None:
    """A logarithmic axis of numbers of plans, with ticks at powers of `base`."""
    axes.set_xscale("log", base=2)
    axes.set_xticks([base**k for k in range(9) if base**k <= most])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axes.minorticks_off()


def _finish(axes: Axes, across: str, title: str) -> None:
    """Labels, a legend, and the line of the optimum where it is near."""
    low, high = axes.get_ylim()
    low = max(low, -20)
    near = high > 100 - 0.15 * (100 - low)
    axes.set_ylim(low, max(high, 100 + 0.03 * (100 - low)) if near else high)
    if near:
        axes.axhline(100, color=INK, lw=0.8, alpha=0.6)
    axes.set_title(clean(title))
    axes.set_xlabel(across, fontsize=LETTERS + 1)
    axes.set_ylabel("normalised score,\n% of the optimum", fontsize=LETTERS + 1)
    axes.grid(axis="y")
    axes.tick_params(labelsize=LETTERS)
    if handles := axes.get_legend_handles_labels()[0]:
        how: dict[str, Any] = {"handlelength": 1.4, "columnspacing": 1.0, "handletextpad": 0.4}
        axes.figure.legend(handles=handles, loc="outside upper left", ncols=3, fontsize=LETTERS, **how)


@drawn
def gap_figure(rows: pd.DataFrame, better: tuple[str, str]) -> Figure:
    """The difference between two kinds of priors in each world, rows of `Results.words`; hollow: not significant.

    `better`: what it means to be left, and right, of 0.
    """
    expect_some("rows", rows)
    figure, (axes,) = panels(1, 1, (PHONE, 1.1 + 0.3 * max(len(rows), 2)))
    axes.axvline(0, color=INK, lw=0.8)
    upwards = rows[::-1]
    for at, (_, row) in enumerate(upwards.iterrows()):
        estimate = [100 * float(row[name]) for name in ("difference", "low", "high")]
        dot(axes, at, estimate, MORE if row["difference"] > 0 else FEWER, hollow=bool(pd.isna(row["better"])))
    names_down(axes, [short(world) for world in upwards["world"]])
    reach = 1.05 * max(abs(end) for end in axes.get_xlim())
    axes.set_xlim(-reach, reach)
    axes.set_xlabel(POINTS)
    axes.text(0, 1.01, f"← {better[0]}", color=FEWER, transform=axes.transAxes, fontsize=9, va="bottom")
    axes.text(1, 1.01, f"{better[1]} →", color=MORE, transform=axes.transAxes, fontsize=9, va="bottom", ha="right")
    return figure


@drawn
def dots_figure(rows: pd.DataFrame, style: Mapping[str, Style], label: str, most: int | None = None) -> Figure:
    """A dot with its interval for each prior, by world.

    Args:
        rows: columns `world`, `prior`, `mean`, `low`, `high`; an infinite mean is an arrow at the edge.
        style: of the priors by name.
        label: of the axis.
        most: for numbers of plans up to so many, on a logarithmic axis; None: a linear axis with a line at 0.
    """
    expect_some("rows", rows)
    priors = [prior for prior in style if prior in set(rows["prior"])]
    worlds = rows["world"].unique().tolist()[::-1]
    height = 0.3 + 0.12 * len(priors)
    figure, (axes,) = panels(1, 1, (PHONE, 1.3 + height * len(worlds)))
    limits = (1.0, float(most)) if most else (-np.inf, np.inf)
    if most:
        _powers(axes, most, 4)
        axes.set_xlim(0.8, 1.3 * most)
    axes.axvline(most or 0, color=INK, lw=0.8, ls=":" if most else "-")
    for _, row in rows.iterrows():
        color, line = style[row["prior"]]
        shift = 0.7 * ((len(priors) - 1) / 2 - priors.index(row["prior"])) / len(priors)
        estimate = [float(row[name]) for name in ("mean", "low", "high")]
        dot(axes, worlds.index(row["world"]) + shift, estimate, color, line != "-", limits)
    for between in range(len(worlds) - 1):
        axes.axhline(between + 0.5, color=INK, lw=0.5, alpha=0.25)
    names_down(axes, [short(world) for world in worlds])
    axes.grid(visible=False, axis="y")
    axes.grid(axis="x")
    axes.tick_params(axis="x", labelsize=LETTERS + 1)
    axes.set_xlabel(label)
    marks = [
        Line2D([], [], marker="o", ls="none", color=color, mfc=color if line == "-" else "none", label=short(prior))
        for prior, (color, line) in ((prior, style[prior]) for prior in priors)
    ]
    figure.legend(handles=marks, loc="outside upper left", ncols=4, fontsize=9, handletextpad=0.2, columnspacing=0.8)
    return figure


@drawn
def bits_figure(rows: pd.DataFrame, style: Mapping[str, Style]) -> Figure:
    """Held-out bits per action, rows of `Results.bits`; hollow without context where other rows have one."""
    expect_some("rows", rows)
    priors, ways = rows["prior"].unique().tolist(), rows["context"].unique().tolist()
    figure, (axes,) = panels(1, 1, (SMALL[0], 0.9 + 0.27 * max(len(priors), 2)))
    for _, row in rows.iterrows():
        shift = 0.5 * ((len(ways) - 1) / 2 - ways.index(row["context"])) / len(ways)
        estimate = [float(row[name]) for name in ("bits_per_action", "low", "high")]
        hollow = len(ways) > 1 and row["context"] == "none"
        dot(axes, len(priors) - 1 - priors.index(row["prior"]) + shift, estimate, style[row["prior"]][0], hollow)
    names_down(axes, [short(prior, 16) for prior in reversed(priors)])
    axes.tick_params(labelsize=LETTERS)
    axes.set(xlabel="bits per action", title=clean(rows["world"].iloc[0]))
    axes.xaxis.label.set_fontsize(LETTERS + 1)
    return figure


@drawn
def plans_figure(plans: Mapping[str, Any], prior: str, color: str, title: str) -> Figure:
    """Candidate plans of a prior from one start, drawn in their world.

    Args:
        plans: `height`, `width`, `walls` (rows of bools), `start` (row, column), `paths` (of each prior, lists of
            places), `reward` (rows of numbers, the greener the more) or None.
        prior: whose plans.
        color: of their lines.
        title: above.
    """
    height = (SMALL[0] - 0.1) * plans["height"] / plans["width"] + 0.35
    figure, (axes,) = panels(1, 1, (SMALL[0], height))
    walls = np.array(plans["walls"], dtype=bool)
    reward = np.array(plans["reward"] or np.zeros(walls.shape).tolist())
    shades = np.zeros((*walls.shape, 4))  # the page shows through elsewhere
    shades[..., :3] = np.where(walls[..., None], WALL, REWARD)
    shades[..., 3] = np.where(walls, 0.45, 0.6 * np.clip(reward / (reward[~walls].max(initial=0) or 1), 0, 1))
    axes.imshow(shades, interpolation="none")
    walks = np.array(plans["paths"][prior], dtype=np.float64)
    walks += np.random.default_rng(0).uniform(-JITTER, JITTER, (len(walks), 1, 2))
    axes.add_collection(LineCollection(list(walks[..., ::-1]), colors=color, lw=1.6, alpha=0.8, capstyle="round"))
    axes.plot(*walks[:, -1, ::-1].T, "o", color=color, ms=4, mew=0)
    axes.plot(plans["start"][1], plans["start"][0], "s", color=INK, ms=7)
    axes.set(xlim=(-0.5, plans["width"] - 0.5), ylim=(plans["height"] - 0.5, -0.5), aspect="equal")
    axes.set(xticks=[], yticks=[], title=short(title, 36))
    axes.spines[:].set(visible=True, alpha=0.3)
    return figure
