"""The mice's maze drawn as it is."""

from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from torch import Tensor

from neuroprior import TabularWorld
from neuroprior.worlds.labyrinth import DEPTH, WATER

ENTRANCE = (-8.0, 0.0)
"""Where the corridor from the home cage begins."""

STAR: dict[str, Any] = {"color": "#00a5cf", "markeredgecolor": "black", "markersize": 15, "zorder": 7}


def coordinates(world: TabularWorld) -> Tensor:
    """Where the nodes lie, in corridor cells from the first junction: `[127, 2]`, right and up.

    A mouse comes from the left to node 0, in the middle. Every junction is a T: its branches leave at right angles,
    4, 4, 2, 2, 1 and 1 cells long from level to level, so that the maze fills a square of 15 x 15 cells with its 64
    ends in rows of eight (Rosenberg et al. 2021, figure 1). Which node lies to the left of one who walks in is what the
    world's moves `in_left` and `in_right` say.
    """
    place = torch.zeros(world.num_states, 2)
    heading = torch.zeros(world.num_states, 2)
    heading[0, 0] = 1
    for level in range(DEPTH):
        node = torch.arange(2**level - 1, 2 ** (level + 1) - 1)
        to_the_left = torch.stack([-heading[node, 1], heading[node, 0]], 1)
        for move, way in ((0, to_the_left), (1, -to_the_left)):
            child = world.next_state[node, move]
            heading[child] = way
            place[child] = place[node] + 2 ** (2 - level // 2) * way
    return place


def corridors(axes: Axes, place: Tensor, width: float, value: Tensor | None = None, **colors: Any) -> None:
    """The corridors as wide lines, light grey or coloured by `value [127]`."""
    parent = (torch.arange(len(place)) - 1).div(2, rounding_mode="floor")
    ends = torch.stack([place[parent.clamp(min=0)], place], 1).numpy()
    ends[0, 0] = ENTRANCE
    order = np.arange(len(place))[::-1]  # wide corridors meet at junctions: the inner ones last, on top
    paint = {"colors": "#efefef"} if value is None else {"array": np.ma.masked_invalid(value.numpy()[order]), **colors}
    line: dict[str, Any] = {"capstyle": "projecting"}
    axes.add_collection(LineCollection(list(ends), colors="#9a9a9a", linewidths=width + 1.6, zorder=1, **line))
    axes.add_collection(LineCollection(list(ends[order]), linewidths=width, zorder=2, **line, **paint))
    axes.set(xlim=(-9.6, 8.1), ylim=(-8.1, 8.1), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def signs(axes: Axes, place: Tensor) -> None:
    """The water, the entrance and a legend."""
    axes.plot(*place[WATER, :, None].numpy(), "*", label="water", **STAR)
    x = ENTRANCE[0]
    axes.annotate("home", ENTRANCE, xytext=(x - 1.5, 0.75), fontsize=9, va="center")
    axes.annotate("", (x + 0.9, 0), xytext=(x - 0.9, 0), arrowprops={"arrowstyle": "-|>", "color": "black"}, zorder=8)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, -0.05), ncols=2, frameon=False, handletextpad=0.1)
