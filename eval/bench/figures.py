"""The figures of `python -m eval bench`."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from eval.bench.sizes import slope
from neuroprior.behaviour.reporting.drawing import FEWER, MORE, at_edges, dot, names_down, panels

ACROSS = 4
"""Panels beside each other."""

MEBI = 2**20
"""Bytes; no less is drawn."""


def peers_figure(rows: pd.DataFrame) -> Figure:
    """How many times as long each peer takes, minimum to maximum; a line across marks the goal."""
    figure, (axes,) = panels(1, 1, (8, 1 + 0.3 * len(rows)))
    rows = rows[::-1]
    estimates = rows[["ratio", "low", "high"]].to_numpy()
    for at, (estimate, goal) in enumerate(zip(estimates, rows.goal, strict=True)):
        dot(axes, at, estimate, FEWER if estimate[0] >= goal else MORE)
        axes.plot([goal] * 2, [at - 0.35, at + 0.35], color="black", lw=1.2)
    names_down(axes, list(rows.job + ": " + rows.peer))
    axes.axvline(1, color="black", lw=0.6, ls=":")
    axes.set_xscale("log")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("peer's time / ours (dots and lines: median, least and most; black: the goal)")
    return figure


def sizes_figure(rows: pd.DataFrame) -> Figure:
    """Seconds and memory against size, a panel for each size that increases."""
    kinds = rows.growing.nunique()
    figure, cells = panels(-(-kinds // ACROSS), ACROSS, (11, 2.7 * -(-kinds // ACROSS)))
    rows = rows.assign(peak=rows.peak_bytes.clip(lower=MEBI))
    for axes, (growing, kind_rows) in zip(cells, rows.groupby("growing", sort=False), strict=False):
        axes.loglog(kind_rows["size"], kind_rows.seconds, "o-", color=FEWER, ms=4)
        axes.set_ylim(_decades(rows.seconds))
        power = slope(kind_rows)
        axes.set_title(f"{growing}" if power is None else f"{growing}, slope {power:.2f}", fontsize=10)
        if kind_rows.peak.notna().all():
            right = axes.twinx()
            right.loglog(kind_rows["size"], kind_rows.peak, "s--", color=MORE, ms=3, lw=1)
            right.set_ylim(_decades(rows.peak))
            right.tick_params(axis="y", colors=MORE)
            if axes is cells[min(kinds, ACROSS) - 1]:
                right.set_ylabel("peak memory, bytes", color=MORE)
    at_edges(cells, kinds, ACROSS, "size", "seconds")
    return figure


def _decades(values: pd.Series) -> tuple[float, float]:
    """Powers of ten around them."""
    low, high = np.log10([min(values), max(values)])
    return 10 ** np.floor(low), 10 ** np.ceil(high)
