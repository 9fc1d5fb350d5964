"""How the figures of a page are drawn: colours by kind of model, dots with intervals, lines with bands."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from functools import wraps
from itertools import cycle
from typing import Any, ParamSpec
from warnings import catch_warnings, filterwarnings

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator
from numpy.typing import ArrayLike, NDArray

from neuroprior.behaviour.reporting.page import PAPER, STYLE, clean

Number = float | None
"""A value, or None where there is none."""

Array = NDArray[np.float64]
P = ParamSpec("P")

DIGITS = FuncFormatter(lambda value, _: f"{value:g}")
"""Numbers on a logarithmic axis in plain digits: matplotlib's own are formulas."""

WIDTH = 7.5
"""Width of a figure, inches: that of a column of text."""

KINDS = {
    "stacked": "#a0703c",
    "combined": "#d64550",
    "uniform": "#7d838c",
    "tree": "#2e9e5b",
    "gru": "#d9731a",
    "transformer": "#9a5fd0",
}
"""The colour of each kind of model, by what its name holds."""

MARKOV = ["#1f9db3", "#2a94cf", "#2f89d6", "#3079d8", "#3a69d6", "#4360d4", "#4659cf"]
"""The colours of Markov chains of order 0, 1, 2 and so on; the last for all higher ones."""

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

SPARE = ["#1f9797", "#c8579a", "#7f8f2a", "#5f7fa8", "#3079d8"]
"""Colours of what is no kind of model, in turn."""

PLAIN = MARKOV[3]
"""The colour of the only thing in a figure."""

MORE, FEWER = "#d9731a", "#3079d8"
"""Colours of more, and fewer, than a reference."""


def drawn(make: Callable[P, Figure]) -> Callable[P, Figure]:
    """A function that makes a figure, under the settings of the page."""

    @wraps(make)
    def styled(*args: P.args, **settings: P.kwargs) -> Figure:
        with mpl.rc_context(STYLE), catch_warnings():
            filterwarnings("ignore", message="Glyph .* missing from font")
            return make(*args, **settings)

    return styled


def colors(names: Sequence[str]) -> Iterator[str]:
    """A colour for each model, by its kind; names of no known kind get spare colours in turn."""
    spare = 0
    for name in names:
        color = _kind(name.lower())
        spare += color is None
        yield color or SPARE[(spare - 1) % len(SPARE)]


def level_colors(levels: Sequence[str]) -> dict[str, str]:
    """A colour for each level of a factor, the same in whatever order they are given."""
    return dict(zip(sorted(levels), cycle(SPARE), strict=False))


def lines(names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """A colour and a style of line for each model; models of one colour differ in style."""
    drawn_before: Counter[str] = Counter()
    for color in colors(names):
        yield color, ("-", "--", ":", "-.")[drawn_before[color] % 4]
        drawn_before[color] += 1


def _kind(name: str) -> str | None:
    kind_color = next((color for kind, color in KINDS.items() if kind in name), None)
    if kind_color is not None or "markov" not in name:
        return kind_color
    order = "".join(letter for letter in name.split("markov")[1][:3] if letter in "0123456789")
    return MARKOV[min(int(order or 1), len(MARKOV) - 1)]


def short(name: str, most: int = 28) -> str:
    """A name that fits its place: cut in the middle where it is longer than `most` letters."""
    name = clean(name)
    if len(name) > most:
        name = f"{name[: most * 2 // 3 - 1]}…{name[-(most - most * 2 // 3) :]}"
    # Of a name that begins with an underscore, matplotlib makes no legend.
    return f" {name}" if name.startswith("_") else name


def panels(rows: int, columns: int, size: tuple[float, float], **shared: Any) -> tuple[Figure, list[Axes]]:
    """A figure of `size` inches with `rows` times `columns` axes, listed row by row."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(rows, columns, squeeze=False, **shared).flat)


def at_edges(cells: Sequence[Axes], number: int, across: int, below: str, left: str) -> None:
    """Labels beside the first and below the last of `number` panels in rows of `across`; what is left is hidden."""
    for place, axes in enumerate(cells):
        axes.set_visible(place < number)
        axes.set_ylabel(left if place % across == 0 else "")
        axes.set_xlabel(below if number - across <= place < number else "")


def expect_some(name: str, values: Sized) -> None:
    """Raise ValueError where there is nothing to draw."""
    if not len(values):
        raise ValueError(f"`{name}` must not be empty: without any there is no figure.")


def floats(values: Iterable[Any]) -> Array:
    """Numbers, or rows of them, as an array, float64; None becomes NaN."""
    return np.array(list(values), dtype=np.float64)


def dot(
    axes: Axes,
    at: float,
    estimate: Iterable[Any],
    color: str,
    hollow: bool = False,
    limits: tuple[float, float] = (-np.inf, np.inf),
    shape: str = "o",
) -> None:
    """One estimate (mean, low, high) drawn across at height `at`; beyond the limits, an arrow at the edge."""
    mean, low, high = floats(estimate)
    if not np.isfinite([low, high]).all():
        low = high = mean
    if not limits[0] <= mean <= limits[1]:
        if not np.isnan(mean):
            edge, marker = (limits[0], "<") if mean < limits[0] else (limits[1], ">")
            axes.plot(edge, at, marker, color=color, ms=8, clip_on=False, mfc=PAPER if hollow else color)
        return
    axes.plot(np.clip([low, high], *limits), [at, at], color=color, lw=2.2, solid_capstyle="butt")
    axes.plot(mean, at, shape, color=color, mfc=PAPER if hollow else color, ms=6.5 if shape == "o" else 5, mew=1.6)


def band(axes: Axes, rows: Iterable[Iterable[Any]], color: str, name: str, line: Any) -> None:
    """A line through the means of (place, mean, low, high) with a band between low and high."""
    place, mean, low, high = floats(rows).reshape(-1, 4).T
    axes.fill_between(place, low, high, color=color, alpha=0.2, lw=0)
    axes.plot(place, mean, ls=line, color=color, marker="o", ms=4, lw=1.8, label=name)


def names_down(axes: Axes, names: Sequence[str], places: ArrayLike | None = None) -> None:
    """Rows with names down the left side, with a line across at each."""
    at = np.arange(len(names)) if places is None else np.asarray(places)
    axes.set_yticks(at, names)
    axes.set_ylim((at.min() if len(at) else 0) - 0.6, (at.max() if len(at) else 0) + 0.6)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.grid(axis="y")


def whole_numbers(axes: Axes, across: str, up: str) -> None:
    """Axes with labels, whole numbers across, and lines across at the values."""
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1, steps=[1, 2, 5, 10]))
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.grid(axis="y")


def marker(color: str, hollow: bool, name: str, shape: str = "o") -> Line2D:
    """A dot with a name for a legend."""
    inner, size = PAPER if hollow else color, 6.5 if shape == "o" else 5
    return Line2D([], [], marker=shape, ls="none", color=color, mfc=inner, ms=size, mew=1.6, label=name)


def legend(figure: Figure, entries: Sequence[Artist]) -> None:
    """A legend above the axes, from the left: there it covers nothing, and a phone shows it first."""
    if entries:
        figure.legend(handles=entries, loc="outside upper left", ncols=3, handletextpad=0.5, columnspacing=1.6)


def decades(axes: Axes, low: float, high: float) -> None:
    """Put three to six numbers on a logarithmic axis across, in plain digits."""
    span = np.log10(high / low)
    steps = (1, 2, 5) if span < 1.2 else (1, 3) if span < 2.2 else (1,)
    if high > low:
        axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(LogLocator(subs=steps, numticks=6))
    axes.xaxis.set_major_formatter(DIGITS)
    axes.minorticks_off()
