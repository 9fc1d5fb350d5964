"""Figures of a comparison of priors: curves against plans and rounds, dots with intervals, plans drawn in a world."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from eval.compare.rows import Key
from neuroprior.report.drawing import (
    FEWER,
    MORE,
    Array,
    Number,
    band,
    dot,
    drawn,
    expect_some,
    lines,
    names_down,
    panels,
    short,
)
from neuroprior.report.page import INK, clean

SMALL = (3.0, 3.0)
"""Size of a figure beside others, inches."""

PHONE = 4.5
"""Width of a figure that a phone shows whole, inches."""

LETTERS = 8
"""Size of text in small figures, points."""

WALL, REWARD = (0.49, 0.51, 0.55), (0.18, 0.62, 0.36)
"""Colours of what stands in a drawn world, seen on light and dark pages."""

JITTER = 0.17
"""How far the paths of a drawing are moved apart, squares."""

Estimate = tuple[Number, Number, Number]
Style = tuple[str, str]


def key_of(row: Mapping[str, Any]) -> Key:
    """The planner and prior that a row is about."""
    return Key(row.get("planner", "sampling"), row["prior"], row["sees"], row.get("rounds", 0))


def styles(priors: Iterable[str]) -> dict[str, Style]:
    """A colour and a style of line for each prior by name, the same in all figures."""
    names = list(dict.fromkeys(priors))
    return dict(zip(names, lines(names), strict=True))


@drawn
def share_figure(rows: Sequence[Mapping[str, Any]], strong: Sequence[str], style: Mapping[str, Style]) -> Figure:
    """The share of the oracle of one world's priors against the number of candidate plans.

    Args:
        rows: of `compare_rows.rows`, of one world, with all numbers of plans; one without a number of plans is drawn
            as a line across.
        strong: priors drawn with a band; other ones are thin lines.
        style: of the priors by name.

    Raises:
        ValueError: there are none.
    """
    expect_some("rows", rows)
    figure, (axes,) = panels(1, 1, SMALL)
    for prior in dict.fromkeys(row["prior"] for row in rows if row["num_plans"] is not None):
        own = [row for row in rows if row["prior"] == prior and row["num_plans"] is not None]
        points = [(row["num_plans"], row["oracle_share"], row["low"], row["high"]) for row in own]
        _curve(axes, points, prior, style[prior], prior in strong)
    for row in rows:
        if row["num_plans"] is None:
            axes.axhline(100 * row["oracle_share"], color=INK, lw=1, ls=(0, (1, 2)), label=row["planner"])
    most = max((row["num_plans"] or 1 for row in rows), default=1)
    axes.set_xscale("log", base=2)
    base = 16 if most > 256 else 4
    axes.set_xticks([base**k for k in range(8) if base**k <= most])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axes.minorticks_off()
    _finish(axes, "candidate plans", "share of the oracle, %", rows[0]["world"])
    return figure


@drawn
def growth_figure(rows: Sequence[Mapping[str, Any]], strong: Sequence[str], style: Mapping[str, Style]) -> Figure:
    """The share of the oracle of one world's priors after each round of growth.

    Args:
        rows: of `compare_rows.growth_rows`, of one world and of priors that see the same.
        strong, style: see `share_figure`.

    Raises:
        ValueError: there are none.
    """
    expect_some("rows", rows)
    figure, (axes,) = panels(1, 1, SMALL)
    lengths = {row["round"]: row["length"] for row in rows}
    for prior in dict.fromkeys(row["prior"] for row in rows):
        own = sorted((row for row in rows if row["prior"] == prior), key=lambda row: int(row["round"]))
        points = [(row["round"], row["oracle_share"], row["low"], row["high"]) for row in own]
        _curve(axes, points, prior, style[prior], prior in strong)
    axes.set_xticks(sorted(lengths), [f"{one}\n{lengths[one]}" for one in sorted(lengths)])
    seeing = "" if rows[0]["sees"] == "nothing" else f", sees {rows[0]['sees']}"
    _finish(axes, "round, and actions in a plan", "share of the oracle, %", rows[0]["world"] + seeing)
    return figure


def _curve(
    axes: Axes, points: Sequence[tuple[float, float, Number, Number]], name: str, style: Style, strong: bool
) -> None:
    color, line = style
    if strong:
        percent = [(at, *_percent(*estimate)) for at, *estimate in points]
        band(axes, percent, color, short(name, 20), line)
        axes.lines[-1].set(markersize=3, linewidth=1.6)
    else:
        axes.plot([one[0] for one in points], [100 * one[1] for one in points], line, color=color, lw=0.8, alpha=0.6)


def _finish(axes: Axes, across: str, up: str, title: str) -> None:
    low, high = axes.get_ylim()
    low = max(low, -20)
    # The oracle's line has its place where it is near.
    near = high > 100 - 0.15 * (100 - low)
    axes.set_ylim(low, max(high, 100 + 0.03 * (100 - low)) if near else high)
    if near:
        axes.axhline(100, color=INK, lw=0.8, alpha=0.6)
    axes.set(xlabel=across, ylabel=up, title=clean(title))
    axes.grid(axis="y")
    axes.tick_params(labelsize=LETTERS)
    axes.xaxis.label.set_fontsize(LETTERS + 1)
    axes.yaxis.label.set_fontsize(LETTERS + 1)
    handles = axes.get_legend_handles_labels()[0]
    if handles:
        how: dict[str, Any] = {"handlelength": 1.4, "columnspacing": 1.0, "handletextpad": 0.4}
        axes.figure.legend(handles=handles, loc="outside upper left", ncols=3, fontsize=LETTERS, **how)


@drawn
def gap_figure(rows: Sequence[Mapping[str, Any]], better: tuple[str, str]) -> Figure:
    """The difference between two kinds of priors in each world, points of the oracle; hollow where it may be chance.

    Args:
        rows: of `compare_pairs.words`.
        better: what it means to be left, and right, of 0.

    Raises:
        ValueError: there are none.
    """
    expect_some("rows", rows)
    figure, (axes,) = panels(1, 1, (PHONE, 1.1 + 0.3 * max(len(rows), 2)))
    axes.axvline(0, color=INK, lw=0.8)
    for at, row in enumerate(reversed(rows)):
        color = MORE if row["difference"] > 0 else FEWER
        dot(axes, at, _percent(row["difference"], row["low"], row["high"]), color, hollow=row["better"] is None)
    names_down(axes, [short(row["world"]) for row in reversed(rows)])
    reach = 1.05 * max(abs(end) for end in axes.get_xlim())
    axes.set_xlim(-reach, reach)
    axes.set_xlabel("points of the oracle")
    axes.text(0, 1.01, f"← {better[0]}", color=FEWER, transform=axes.transAxes, fontsize=9, va="bottom")
    axes.text(1, 1.01, f"{better[1]} →", color=MORE, transform=axes.transAxes, fontsize=9, va="bottom", ha="right")
    return figure


def _percent(*values: Number) -> Estimate:
    mean, low, high = (None if value is None else 100 * value for value in values)
    return mean, low, high


@drawn
def dots_figure(
    estimates: Mapping[str, Mapping[str, Estimate]], style: Mapping[str, Style], label: str, most: int | None = None
) -> Figure:
    """A dot with its interval for each prior, by world.

    Args:
        estimates: (mean, low, high) by world and prior; an infinite mean is an arrow at the edge.
        style: of the priors by name.
        label: of the axis.
        most: for numbers of plans up to so many, on a logarithmic axis; None: a linear axis with a line at 0.

    Raises:
        ValueError: there are none.
    """
    expect_some("estimates", estimates)
    priors = [prior for prior in style if any(prior in own for own in estimates.values())]
    height = 0.3 + 0.12 * len(priors)
    figure, (axes,) = panels(1, 1, (PHONE, 1.3 + height * len(estimates)))
    limits = (1.0, float(most)) if most else (-np.inf, np.inf)
    if most:
        axes.set_xscale("log", base=2)
        axes.set_xlim(0.8, 1.3 * most)
        axes.set_xticks([4**k for k in range(9) if 4**k <= most])
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        axes.minorticks_off()
    axes.axvline(most or 0, color=INK, lw=0.8, ls=":" if most else "-")
    for at, own in enumerate(reversed(list(estimates.values()))):
        for place, prior in enumerate(priors):
            if prior in own:
                shift = 0.7 * ((len(priors) - 1) / 2 - place) / len(priors)
                dot(axes, at + shift, own[prior], style[prior][0], style[prior][1] != "-", limits)
    for between in range(len(estimates) - 1):
        axes.axhline(between + 0.5, color=INK, lw=0.5, alpha=0.25)
    names_down(axes, [short(world) for world in reversed(list(estimates))])
    axes.grid(visible=False, axis="y")
    axes.grid(axis="x")
    axes.tick_params(axis="x", labelsize=LETTERS + 1)
    axes.set_xlabel(label)
    marks = [_mark(prior, *style[prior]) for prior in priors]
    figure.legend(handles=marks, loc="outside upper left", ncols=4, fontsize=9, handletextpad=0.2, columnspacing=0.8)
    return figure


def _mark(name: str, color: str, line: str) -> Line2D:
    return Line2D([], [], marker="o", ls="none", color=color, mfc=color if line == "-" else "none", label=short(name))


@drawn
def bits_figure(rows: Sequence[Mapping[str, Any]], style: Mapping[str, Style]) -> Figure:
    """Held-out bits per action of one world's priors; hollow where a prior sees nothing and others see more.

    Args:
        rows: of `compare_rows.bits_rows`, of one world.
        style: of the priors by name.

    Raises:
        ValueError: there are none.
    """
    expect_some("rows", rows)
    priors = list(dict.fromkeys(row["prior"] for row in rows))
    ways = list(dict.fromkeys(row["sees"] for row in rows))
    figure, (axes,) = panels(1, 1, (SMALL[0], 0.9 + 0.27 * max(len(priors), 2)))
    for row in rows:
        shift = 0.5 * ((len(ways) - 1) / 2 - ways.index(row["sees"])) / len(ways)
        estimate = (row["bits_per_action"], row["low"], row["high"])
        hollow = len(ways) > 1 and row["sees"] == "nothing"
        dot(axes, len(priors) - 1 - priors.index(row["prior"]) + shift, estimate, style[row["prior"]][0], hollow)
    names_down(axes, [short(prior, 16) for prior in reversed(priors)])
    axes.tick_params(labelsize=LETTERS)
    axes.set(xlabel="bits per action", title=clean(rows[0]["world"]))
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
    axes.imshow(_shades(plans), interpolation="none")
    walks = np.array(plans["paths"][prior], dtype=np.float64)
    walks += np.random.default_rng(0).uniform(-JITTER, JITTER, (len(walks), 1, 2))
    axes.add_collection(LineCollection(list(walks[..., ::-1]), colors=color, lw=1.6, alpha=0.8, capstyle="round"))
    axes.plot(*walks[:, -1, ::-1].T, "o", color=color, ms=4, mew=0)
    axes.plot(plans["start"][1], plans["start"][0], "s", color=INK, ms=7)
    axes.set(xlim=(-0.5, plans["width"] - 0.5), ylim=(plans["height"] - 0.5, -0.5), aspect="equal")
    axes.set(xticks=[], yticks=[], title=short(title, 36))
    axes.spines[:].set(visible=True, alpha=0.3)
    return figure


def _shades(plans: Mapping[str, Any]) -> Array:
    """Colours `[height, width, 4]` of walls and rewards; the page shows through elsewhere."""
    walls = np.array(plans["walls"], dtype=bool)
    reward = np.zeros(walls.shape) if plans.get("reward") is None else np.array(plans["reward"], dtype=np.float64)
    top = reward[~walls].max(initial=0)
    shades = np.zeros((*walls.shape, 4))
    shades[..., :3] = np.where(walls[..., None], WALL, REWARD)
    shades[..., 3] = np.where(walls, 0.45, 0.6 * np.clip(reward / (top if top > 0 else 1), 0, 1))
    return shades
