"""Figures of a report on plans that are made of cells: transition matrices, and sequences as coloured strips."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import ArrayLike

from neuroprior.report.drawing import FEWER, MORE, PLAIN, WIDTH, Array, at_edges, drawn, expect_some, panels, short
from neuroprior.report.page import INK, clean

NUMBERED = 8
"""Actions up to which the cells of a matrix hold their numbers."""

MOST_NAMES = 60
"""Actions up to which each has its name beside the matrix; of more, every second or third one has."""

MOST_PANELS = 12
"""Groups drawn: of more, those that differ most."""

MOST_STEPS = 400
"""Actions of a sequence that are drawn, from its first."""

STRIPS = [
    "#3b82d6",
    "#e08a1e",
    "#2fa35f",
    "#cf4a4a",
    "#8e6bd1",
    "#b8a42a",
    "#d773b0",
    "#29a3a3",
    "#8f5f42",
    "#93c94e",
    "#4b4fb8",
    "#8d97a8",
]
"""Colours of actions in strips; of more actions, the most frequent ones have a colour and the others a common grey."""

OTHER = "#7d838c"

DEEPEST = 0.8
"""Opacity of the deepest colour: black text in light and white text in dark stay legible on it."""

GAMMA = 0.7
"""Power of a value that gives its opacity: below 1, so that small values are seen."""


@drawn
def transition_figure(matrix: ArrayLike, names: Sequence[str], title: str = "", small: bool = False) -> Figure:
    """A transition matrix as a heat map; actions that nothing was seen to follow (NaN) are hatched.

    Args:
        matrix: `[A, A]`, probabilities, from row to column.
        names: A of them.
        title: above the matrix.
        small: to stand beside others, 3 inches wide and without a scale.
    """
    probs = np.asarray(matrix, dtype=np.float64)
    numbered = len(probs) <= NUMBERED
    side = 1.6 + (0.62 * len(probs) if numbered else min(max(0.125 * len(probs), 4.4), 7.4))
    figure, (axes,) = panels(1, 1, (3.0, 3.0) if small else (side + 0.9, side))
    top = 1.0 if numbered else float(np.nanmax(probs, initial=0)) or 1.0
    _cells(axes, probs / top, PLAIN)
    for a, b in np.argwhere(np.isfinite(probs)) if numbered else []:
        axes.text(b, a, f"{probs[a, b]:.2f}", ha="center", va="center", fontsize=7.5 if small else 9)
    _named(axes, names, 7.5 if small or len(probs) > 20 else 10)
    axes.set(xlabel="next action", ylabel="last action", title=clean(title))
    if not small:
        _scale(axes, 0, top, PLAIN, "probability")
    return figure


@drawn
def group_transition_figure(
    matrices: ArrayLike,
    pooled: ArrayLike,
    names: Sequence[str],
    group_names: Sequence[str],
    significant: ArrayLike,
) -> Figure:
    """How each group's transition probabilities differ from the pooled ones; significant cells have a dot.

    At most `MOST_PANELS` groups are drawn: those with the most significant cells, and among these the largest
    differences; the figure says so.

    Args:
        matrices: `[G, A, A]`, probabilities; rows of NaN are hatched.
        pooled: `[A, A]`.
        names: A of them.
        group_names: G of them.
        significant: `[G, A, A]` bool.

    Raises:
        ValueError: there are no groups.
    """
    expect_some("group_names", group_names)
    gaps = np.asarray(matrices, dtype=np.float64) - np.asarray(pooled, dtype=np.float64)
    marked = np.asarray(significant, dtype=bool)
    weight = np.nan_to_num(np.abs(gaps)).sum((1, 2)) / np.maximum(np.isfinite(gaps).sum((1, 2)), 1)
    chosen = np.sort(np.lexsort((-weight, -marked.sum((1, 2))))[:MOST_PANELS])
    across = min(len(chosen), 4 if len(chosen) > 6 else 3)
    down = -(-len(chosen) // across)
    side = (WIDTH if across > 1 else 4.5) / max(across, 2)
    figure, cells = panels(down, across, (side * across + 0.9, side * down + 0.9))
    top = float(np.nan_to_num(np.abs(gaps[chosen])).max(initial=0)) or 1.0
    for number, (axes, group) in enumerate(zip(cells, chosen, strict=False)):
        _cells(axes, gaps[group] / top, MORE)
        a, b = np.nonzero(marked[group])
        axes.plot(b, a, "o", ms=min(5, 45 / len(names)), color=INK, mew=0)
        axes.set_title(short(group_names[group], 22 if across < 4 else 17), fontsize=9)
        if len(names) <= 12:
            _named(axes, names, 8, left=number % across == 0, below=number >= len(chosen) - across)
        else:
            axes.set(xticks=[], yticks=[])
    at_edges(cells, len(chosen), across, "next action", "last action")
    if len(chosen) < len(gaps):
        figure.suptitle(f"{len(chosen)} of {len(gaps)} groups: those that differ most", fontsize=10, x=0.01, ha="left")
    _scale(cells[: len(chosen)], -top, top, MORE, "difference in probability")
    return figure


@drawn
def raster_figure(real: ArrayLike, generated: ArrayLike, names: Sequence[str]) -> Figure:
    """Sequences as strips of colour, one colour an action: real ones above, generated ones below.

    Args:
        real: `[n, T]`, action numbers; negative ones stand for no action. The first `MOST_STEPS` are drawn.
        generated: `[m, T']`, likewise.
        names: of the actions, by number.
    """
    both = [np.asarray(actions, dtype=np.int64)[:, :MOST_STEPS] for actions in (real, generated)]
    count = sum(np.bincount(actions[actions >= 0], minlength=len(names)) for actions in both)
    most = len(STRIPS) if len(names) <= len(STRIPS) else len(STRIPS) - 1
    kept = np.sort(np.argsort(-count, kind="stable")[:most])
    palette = np.array([(*to_rgb(OTHER), 0.45)] * len(names) + [(0, 0, 0, 0)])
    palette[kept, :3], palette[kept, 3] = [to_rgb(color) for color in STRIPS[: len(kept)]], 1
    keys = [Patch(color=STRIPS[place], label=short(names[action])) for place, action in enumerate(kept)]
    if len(kept) < len(names):
        keys.append(Patch(color=OTHER, alpha=0.45, lw=0, label=f"{len(names) - len(kept)} other actions"))
    columns = 6 if max(len(key.get_label()) for key in keys) <= 10 else 3
    heights = [0.16 * max(len(actions), 1) + 0.25 for actions in both]
    size = (WIDTH, sum(heights) + 0.7 + 0.22 * -(-len(keys) // columns))
    longest = max(actions.shape[1] for actions in both)
    figure, cells = panels(2, 1, size, sharex=True, height_ratios=heights)
    for axes, actions, title in zip(cells, both, ("real", "generated"), strict=True):
        strips = np.repeat(palette[np.where(actions < 0, len(names), actions)], 5, axis=0)
        # A gap between the strips of two sequences.
        strips[4::5, :, 3] = 0
        extent = (0.5, actions.shape[1] + 0.5, len(actions) - 0.5, -0.5)
        axes.imshow(strips, aspect="auto", interpolation="none", extent=extent)
        axes.set(yticks=[], xlim=(0.5, longest + 0.5))
        axes.set_title(title, loc="left")
        axes.spines[:].set_visible(False)
    cut = max(np.shape(real)[1], np.shape(generated)[1]) > MOST_STEPS
    cells[1].set_xlabel("action of the sequence" + f" (the first {MOST_STEPS})" * cut)
    figure.legend(handles=keys, loc="outside lower left", ncols=columns, fontsize=9, handlelength=1, columnspacing=1.4)
    return figure


def _shades(values: Array, more: str) -> Array:
    """Colours `[..., 4]` of values from -1 to 1: the page shows through where they are small or NaN."""
    known = np.nan_to_num(np.clip(values, -1, 1))
    hues = np.array([to_rgb(FEWER), to_rgb(more)])
    return np.concatenate([hues[(known > 0).astype(int)], DEEPEST * np.abs(known)[..., None] ** GAMMA], -1)


def _cells(axes: Axes, values: Array, more: str) -> None:
    """A matrix of values from -1 to 1, whose unknown rows are hatched."""
    axes.imshow(_shades(values, more), interpolation="none")
    for row in np.flatnonzero(np.isnan(values).all(1)):
        place = (-0.5, row - 0.5)
        axes.add_patch(Rectangle(place, values.shape[1], 1, fill=False, hatch="////", ec=INK, lw=0, alpha=0.35))
    for spine in axes.spines.values():
        spine.set(visible=True, alpha=0.3)


def _named(axes: Axes, names: Sequence[str], size: float, left: bool = True, below: bool = True) -> None:
    """Names of actions down the left side and below; some of them where they are many."""
    some = range(0, len(names), -(-len(names) // MOST_NAMES))
    told = [short(names[place], 24) for place in some]
    turned = 0 if max(map(len, told)) <= 5 and len(told) <= NUMBERED else 90
    axes.set_xticks(some, told if below else [""] * len(told), rotation=turned, fontsize=size)
    axes.set_yticks(some, told if left else [""] * len(told), fontsize=size)
    axes.tick_params(length=0 if len(some) == len(names) else 2)


def _scale(axes: Axes | list[Axes], low: float, high: float, more: str, label: str) -> None:
    """The scale of the colours of `axes`, beside them."""
    first = axes if isinstance(axes, Axes) else axes[0]
    bar = first.figure.colorbar(ScalarMappable(Normalize(low, high)), ax=axes, shrink=0.6, aspect=16, label=label)
    # Of its own, matplotlib draws hundreds of cells, with seams where they are not opaque.
    bar.solids.remove()
    steps = np.linspace(low, high, 128)[::-1, None]
    bar.ax.imshow(_shades(steps / high, more), extent=(0, 1, low, high), aspect="auto", interpolation="none")
    bar.outline.set(edgecolor=INK, alpha=0.3)
