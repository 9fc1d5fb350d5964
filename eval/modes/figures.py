"""Where the modes of mice lead, in their maze, and when they are in them."""

from collections.abc import Mapping

import pandas as pd
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

from eval.modes.experiment import WITHIN
from eval.worlds.labyrinth_drawing import coordinates, corridors, signs
from neuroprior.behaviour.reporting.drawing import STRIPS, WIDTH, band, drawn, legend, panels
from neuroprior.worlds import labyrinth

TITLES = {
    "moves": "moves in the mode",
    "turns": "of these, turn back",
    "water": f"reach the water in {WITHIN} moves",
    "home": f"reach home in {WITHIN} moves",
}


def maze_figure(shares: Mapping[str, Tensor]) -> Figure:
    """A row of mazes for each mode: what share of its moves at each node is what; see `node_shares`."""
    place, number = coordinates(labyrinth()), len(shares["moves"])
    figure = Figure(figsize=(4.1 * len(shares), 4.1 * number), layout="constrained")
    cells = figure.subplots(number, len(shares), squeeze=False)
    colors = colormaps["viridis"].with_extremes(bad="#dddddd")
    for column, (what, values) in enumerate(shares.items()):
        scale = Normalize(0, max(float(values.nan_to_num().max()), 1e-9))
        for k, axes in enumerate(cells[:, column]):
            corridors(axes, place, 5.5, values[k], cmap=colors, norm=scale)
            signs(axes, place)
            axes.set_title(f"mode {k + 1}: {TITLES[what]}", fontsize=10)
        figure.colorbar(
            ScalarMappable(scale, colors), ax=list(cells[:, column]), location="bottom", shrink=0.7, aspect=30
        )
    return figure


@drawn
def since_figure(since: pd.DataFrame) -> Figure:
    """The share of the moves in each mode against moves since the water; see `since_water`."""
    figure, (axes,) = panels(1, 1, (WIDTH, 2.8))
    for number, (mode, curve) in enumerate(since.groupby("mode", sort=False)):
        points = curve[["from", "share", "low", "high"]].assign(**{"from": curve["from"] + 1})
        band(axes, points.to_numpy(float), STRIPS[number % len(STRIPS)], f"mode {mode}", "-")
    edges = since["from"].unique()
    axes.set_xscale("log")
    axes.set_xticks(edges + 1, [str(edge) for edge in edges])
    axes.minorticks_off()
    axes.set(xlabel="moves since the water, from", ylabel="share of the moves", ylim=(0, 1))
    axes.grid(axis="y")
    legend(figure, axes.get_legend_handles_labels()[0])
    return figure
