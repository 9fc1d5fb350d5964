"""The figures of `python -m eval bench`."""

import numpy as np
from matplotlib.figure import Figure

from eval.bench.sizes import slope
from eval.bench.timing import Rows
from neuroprior.report.drawing import FEWER, MORE, at_edges, names_down, panels

ACROSS = 4
"""Panels beside each other."""

MEBI = 2**20
"""Bytes; no less is drawn."""


def peers_figure(rows: Rows) -> Figure:
    """How many times as long each peer takes, minimum to maximum; a line across marks the goal."""
    figure, (axes,) = panels(1, 1, (8, 1 + 0.3 * len(rows)))
    for at, row in enumerate(reversed(rows)):
        color = FEWER if row["ratio"] >= row["goal"] else MORE
        axes.plot([row["low"], row["high"]], [at, at], color=color, lw=2.2, solid_capstyle="butt")
        axes.plot(row["ratio"], at, "o", color=color)
        axes.plot([row["goal"]] * 2, [at - 0.35, at + 0.35], color="black", lw=1.2)
    names_down(axes, [f"{row['job']}: {row['peer']}" for row in reversed(rows)])
    axes.axvline(1, color="black", lw=0.6, ls=":")
    axes.set_xscale("log")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("peer's time / ours (dots and lines: median, least and most; black: the goal)")
    return figure


def sizes_figure(rows: Rows) -> Figure:
    """Seconds and memory against size, a panel for each size that increases."""
    kinds = list(dict.fromkeys(row["growing"] for row in rows))
    figure, cells = panels(-(-len(kinds) // ACROSS), ACROSS, (11, 2.7 * -(-len(kinds) // ACROSS)))
    seconds = _decades([row["seconds"] for row in rows])
    memory = _decades([max(row["peak_bytes"] or 0, MEBI) for row in rows])
    for axes, growing in zip(cells, kinds, strict=False):
        own = [row for row in rows if row["growing"] == growing]
        size = np.array([row["size"] for row in own])
        axes.loglog(size, [row["seconds"] for row in own], "o-", color=FEWER, ms=4)
        axes.set_ylim(seconds)
        power = slope(own)
        axes.set_title(growing if power is None else f"{growing}, slope {power:.2f}", fontsize=10)
        if own[0]["peak_bytes"] is not None:
            right = axes.twinx()
            right.loglog(size, [max(row["peak_bytes"], MEBI) for row in own], "s--", color=MORE, ms=3, lw=1)
            right.set_ylim(memory)
            right.tick_params(axis="y", colors=MORE)
            if axes is cells[min(len(kinds), ACROSS) - 1]:
                right.set_ylabel("peak memory, bytes", color=MORE)
    at_edges(cells, len(kinds), ACROSS, "size", "seconds")
    return figure


def _decades(values: list[float]) -> tuple[float, float]:
    """Powers of ten around them."""
    low, high = np.log10([min(values), max(values)])
    return 10 ** np.floor(low), 10 ** np.ceil(high)
