"""Figures of a report on plans: scores, how far back structure reaches, orders, calibration, sequences, drift."""

from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from neuroprior.report.drawing import (
    FEWER,
    MORE,
    PLAIN,
    WIDTH,
    Number,
    at_edges,
    band,
    colors,
    dot,
    drawn,
    expect_some,
    floats,
    legend,
    lines,
    marker,
    names_down,
    panels,
    short,
    whole_numbers,
)
from neuroprior.report.page import INK, clean

MOST_PLANS = 1000
"""Plans drawn as points; of more, evenly spaced ones are drawn."""

MOST_GROUPS = 40
"""Groups drawn as a row each; of more, evenly spaced ones between the lowest and the highest."""

DIGITS = FuncFormatter(lambda value, _: f"{value:g}")
"""Numbers on a logarithmic axis in plain digits: matplotlib's own are formulas."""


@drawn
def score_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Bits per action of each model with its interval, the best at the top.

    A model that is far worse than most is an arrow at the edge, so that the others can be told apart; all values stand
    at the right.

    Args:
        rows: `model`, `sees` ("actions" or "actions and context"), `bits_per_action`, `low`, `high`; a model may have
            a row for each of the two it sees.

    Raises:
        ValueError: there are none.
    """
    expect_some("rows", rows)
    taken: dict[str, dict[bool, list[Number]]] = {}
    for row in rows:
        estimate = [row["bits_per_action"], row["low"], row["high"]]
        taken.setdefault(row["model"], {})["context" in row["sees"]] = estimate
    best = {
        model: min((e[0] for e in ways.values() if e[0] is not None), default=np.inf) for model, ways in taken.items()
    }
    models = sorted(taken, key=lambda model: -best[model])
    figure, (axes,) = panels(1, 1, (WIDTH, 0.9 + 0.36 * max(len(models), 2)))
    both = len({sees for ways in taken.values() for sees in ways}) > 1
    limit = _edge([best[model] for model in models])
    color = dict(zip(taken, colors(list(taken)), strict=True))
    for y, model in enumerate(models):
        ways = taken[model]
        for sees, estimate in ways.items():
            at = y + (0 if len(ways) < 2 else -0.17 if sees else 0.17)
            dot(axes, at, estimate, color[model], hollow=both and not sees, limits=(-np.inf, limit))
        told = ", ".join("" if ways[sees][0] is None else f"{ways[sees][0]:.3f}" for sees in sorted(ways))
        axes.text(1.03, y, told, transform=axes.get_yaxis_transform(), va="center")
    names_down(axes, [short(model, 36) for model in models])
    axes.set_xlabel("bits per action (less is better)")
    axes.set_xlim(right=limit if np.isfinite(limit) else None)
    if both:
        legend(figure, [marker(INK, True, "sees actions"), marker(INK, False, "sees actions and context")])
    return figure


def _edge(bits: Sequence[float]) -> float:
    """Where the axis of the scores ends: far beyond the middle one; infinite where none is so far."""
    finite = np.array([value for value in bits if np.isfinite(value)])
    if len(finite) < 3:
        return float("inf")
    far = finite.min() + 5 * (np.median(finite) - finite.min())
    return float(far) if finite.max() > far > finite.min() else float("inf")


@drawn
def lag_figure(
    information: Mapping[str, Sequence[tuple[int, Number, Number, Number]]],
    floor: Sequence[tuple[int, Number]] | None = None,
) -> Figure:
    """Bits that the action k steps back gives, one line with its band a name.

    Where the values span decades the axis is logarithmic above, and linear around 0, where estimates are negative too.

    Args:
        information: by name, (lag, bits, low, high).
        floor: (lag, bits): what is expected by chance.

    Raises:
        ValueError: there are none.
    """
    expect_some("information", information)
    figure, (axes,) = panels(1, 1, (WIDTH, 3.7))
    chance = floats([bits for _, bits in floor or []])
    sizes = [abs(row[1]) for rows in information.values() for row in rows if row[1]]
    largest = max(sizes, default=0.0)
    small = np.abs(chance) if floor else [min(sizes, default=1.0)]
    linear = 10 ** np.round(np.log10(np.nanmax([largest / 100, *small, 1e-9])))
    if largest > 30 * linear:
        axes.set_yscale("symlog", linthresh=linear, linscale=0.6)
        axes.yaxis.set_major_formatter(DIGITS)
    for name, (color, line) in zip(information, lines(list(information)), strict=True):
        band(axes, information[name], color, short(name, 40), line)
    if floor:
        axes.plot([lag for lag, _ in floor], chance, "--", color=INK, alpha=0.7, lw=1.2, label="expected by chance")
    axes.axhline(0, color=INK, lw=0.8)
    whole_numbers(axes, "steps back", "bits")
    legend(figure, axes.get_legend_handles_labels()[0])
    return figure


@drawn
def order_figure(
    criteria: Mapping[str, Sequence[tuple[int, Number]]],
    held_out: Mapping[str, Sequence[tuple[int, Number, Number, Number]]],
) -> Figure:
    """Information criteria and held-out bits against the order of the chain; the least of each is ringed.

    Args:
        criteria: by name (BIC, AIC), (order, half the criterion in bits per action): on the scale of the others.
        held_out: by name, (order, bits per action, low, high).
    """
    figure, (axes,) = panels(1, 1, (WIDTH, 3.7))
    for number, (name, pairs) in enumerate(criteria.items()):
        rows = [(order, bits, None, None) for order, bits in pairs]
        band(axes, rows, INK, clean(name), ("--", ":", "-.")[number % 3])
    for name, (color, line) in zip(held_out, lines(list(held_out)), strict=True):
        band(axes, held_out[name], color, short(name, 40), line)
    lows, tops = [], []
    for curve in [curve for curve in axes.lines if np.isfinite(curve.get_ydata()).any()]:
        orders, bits = curve.get_data()
        least = int(np.nanargmin(bits))
        axes.plot(orders[least], bits[least], "o", ms=13, mfc="none", mec=curve.get_color(), mew=1.3)
        lows.append(bits[least])
        tops.append(max(np.nanmax(bits[: least + 1]), 1.05 * bits[least]))
    if lows:
        # A criterion climbs without end with the number of parameters; that it leaves the figure says enough.
        reach = 1.2 * (max(tops) - min(lows))
        axes.set_ylim(min(lows) - 0.1 * reach, min(axes.get_ylim()[1], min(lows) + reach))
    whole_numbers(axes, "order: actions seen", "bits per action")
    legend(figure, axes.get_legend_handles_labels()[0])
    return figure


@drawn
def calibration_figure(curves: Mapping[str, Sequence[tuple[Number, Number, Number, Number, int]]]) -> Figure:
    """How often actions came against how probable they were said to be: a panel a model; the diagonal is calibrated.

    Args:
        curves: by model, (mean forecast, share taken, low, high, number of forecasts) a bin; larger points hold more.

    Raises:
        ValueError: there are none.
    """
    expect_some("curves", curves)
    across = min(len(curves), 3)
    down = -(-len(curves) // across)
    figure, cells = panels(down, across, (2.45 * across + 0.15, 2.65 * down + 0.3))
    for axes, name, color in zip(cells, curves, colors(list(curves)), strict=False):
        forecast, share, low, high, number = floats([v for row in curves[name] for v in row]).reshape(-1, 5).T
        size = 8 + 70 * np.sqrt(number / max(number.max(initial=0), 1))
        axes.plot([0, 1], [0, 1], color=INK, lw=0.8, alpha=0.6)
        axes.vlines(forecast, low, high, color=color, lw=1.8)
        axes.scatter(forecast, share, s=size, color=color, lw=0, zorder=3)
        axes.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), aspect="equal", title=short(name))
        axes.set(xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])
        axes.grid()
    at_edges(cells, len(curves), across, "forecast probability", "share taken")
    return figure


@drawn
def motif_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """How much more, or less, often sequences occur than expected, on an axis in powers of two.

    Args:
        rows: `sequence` (text), `ratio` (observed by expected), `low`, `high`, `count`; drawn from the top down.

    Raises:
        ValueError: there are none.
    """
    expect_some("rows", rows)
    names = ["\n".join(wrap(clean(row["sequence"]), 36, max_lines=4, placeholder=" …")) for row in rows][::-1]
    heights = np.array([0.5 + 0.5 * (1 + name.count("\n")) for name in names])
    figure, (axes,) = panels(1, 1, (WIDTH, 0.9 + 0.3 * max(heights.sum(), 2)))
    ratios = floats([row["ratio"] for row in rows])
    told = ratios[np.isfinite(ratios) & (ratios > 0)]
    reach = 2 ** max(1.25 * float(np.abs(np.log2(told)).max(initial=0)), 1.0)
    axes.axvline(1, color=INK, lw=0.8, alpha=0.6)
    places = np.cumsum(heights) - heights / 2
    for row, at in zip(reversed(rows), places, strict=True):
        estimate = [row["ratio"], row["low"], row["high"]]
        dot(axes, at, estimate, FEWER if (row["ratio"] or 0) < 1 else MORE, limits=(1 / reach, reach))
        axes.text(1.03, at, f"{row['count']:,}", transform=axes.get_yaxis_transform(), va="center")
    axes.text(1.03, 1, "count", transform=axes.transAxes, va="bottom")
    axes.set_xscale("log", base=2)
    axes.set_xlim(0.9 / reach, reach / 0.9)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}" if value >= 1 else f"1/{1 / value:g}"))
    axes.minorticks_off()
    names_down(axes, names, places)
    axes.set_ylim(0, heights.sum())
    axes.set_xlabel("times as often as expected")
    return figure


@drawn
def distribution_figure(distributions: Mapping[str, tuple[Sequence[Number], Sequence[Number]]]) -> Figure:
    """Distributions of lengths in real and in generated sequences, a panel each, on a logarithmic axis.

    Args:
        distributions: by what the length is of, such as "run length, actions": the shares of the lengths 1, 2, 3 and
            so on, real and generated. Lengths that never occur are left out.

    Raises:
        ValueError: there are none.
    """
    expect_some("distributions", distributions)
    figure, cells = panels(1, len(distributions), (WIDTH if len(distributions) > 1 else 5, 3.2))
    for axes, (name, pair) in zip(cells, distributions.items(), strict=True):
        for shares, label, color, line in zip(pair, ("real", "generated"), (INK, MORE), ("-", "--"), strict=True):
            share = floats(shares)
            lengths = np.arange(1, len(share) + 1)[share > 0]
            axes.plot(lengths, share[share > 0], line, color=color, marker=".", ms=5, lw=1.4, label=label)
        axes.set_yscale("log")
        if np.divide(*axes.get_ylim()) > 0.01:
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(DIGITS)
        axes.minorticks_off()
        whole_numbers(axes, clean(name), "share")
    legend(figure, cells[0].get_legend_handles_labels()[0])
    return figure


@drawn
def drift_figure(
    positions: Sequence[tuple[Number, Number, Number]],
    plans: Sequence[tuple[str, int, Number]],
    groups: Sequence[tuple[str, Number, Number, Number]],
) -> Figure:
    """Bits per action within plans, from plan to plan, and from group to group: three panels.

    Args:
        positions: (mean, low, high) of each of the equal parts of the plans, from the first to the last.
        plans: (group, index in its group, bits per action); at most `MOST_PLANS` are drawn.
        groups: (name, mean, low, high); the one that costs most at the top, at most `MOST_GROUPS` of them.
    """
    ranked = sorted((row for row in groups if row[1] is not None), key=lambda row: row[1] or 0)
    ranked = [ranked[place] for place in _evenly(len(ranked), MOST_GROUPS)]
    low = 0.9 + 0.24 * max(len(ranked), 2)
    figure = Figure(figsize=(WIDTH, 3.1 + low), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[3.1, low])
    (within, between), below = upper.subplots(1, 2), lower.subplots()
    band(within, [(100 * (n + 0.5) / len(positions), *row) for n, row in enumerate(positions)], PLAIN, "", "-")
    within.set(xlim=(0, 100), xlabel="place in the plan, %", ylabel="bits per action", title="within plans")
    within.grid(axis="y")
    _cloud(between, plans)
    for at, (_, *estimate) in enumerate(ranked):
        dot(below, at, estimate, PLAIN)
    names_down(below, [short(row[0]) for row in ranked])
    of_all = f" ({len(ranked)} of {len(groups)})" if len(ranked) < len(groups) else ""
    below.set(xlabel="bits per action", title="groups" + of_all)
    return figure


def _cloud(axes: Axes, plans: Sequence[tuple[str, int, Number]]) -> None:
    """Bits of each plan against its place in its group, and the means of neighbouring places."""
    index, bits = floats([row[1] for row in plans]), floats([row[2] for row in plans])
    some = _evenly(len(plans), MOST_PLANS)
    axes.plot(index[some], bits[some], "o", ms=3.5, mew=0, color=INK, alpha=0.3)
    told = np.isfinite(bits)
    places = np.unique(index[told])
    parts = np.array_split(places, min(20, len(places))) if len(places) else []
    means = [bits[told & (index >= part[0]) & (index <= part[-1])].mean() for part in parts]
    axes.plot([part.mean() for part in parts], means, color=MORE, lw=2.2)
    whole_numbers(axes, "number of the plan in its group", "")
    of_all = f" ({len(some):,} of {len(plans):,} drawn)" if len(some) < len(plans) else ""
    axes.set_title("from plan to plan" + of_all)


def _evenly(number: int, most: int) -> list[int]:
    """At most `most` of `number` places, evenly spaced from the first to the last."""
    places: list[int] = np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(int)).tolist()
    return places
