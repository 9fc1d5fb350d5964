"""The figures of a report on plans. Each takes a table of the report, as pandas frame, or arrays, and stands alone.

Where there is nothing to draw, it is a ValueError.
"""

from collections.abc import Sequence
from textwrap import wrap
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import ArrayLike, NDArray

from neuroprior.behaviour.analysis.comparison import ACTIONS, CONTEXT, DURATIONS
from neuroprior.behaviour.recorded_plans import RecordedPlans, action_names, group_names
from neuroprior.behaviour.reporting.drawing import (
    DIGITS,
    FEWER,
    MORE,
    PLAIN,
    STRIPS,
    WIDTH,
    Array,
    at_edges,
    band,
    colors,
    decades,
    dot,
    drawn,
    expect_some,
    floats,
    legend,
    level_colors,
    lines,
    marker,
    names_down,
    panels,
    short,
    whole_numbers,
)
from neuroprior.behaviour.reporting.page import INK, clean
from neuroprior.plans import Plans
from neuroprior.plans.plans import check_are_plans

MOST_PLANS = 1000  # drawn as points; of more, evenly spaced ones
MOST_GROUPS = 40  # drawn as a row each; of more, evenly spaced ones between the lowest and the highest
MOST_DOTS = 200  # units drawn as a dot for each condition; of more, evenly spaced ones
MOST_PANELS = 12  # groups drawn as a panel each; of more, those that differ most
MOST_ROWS = 60  # plans of an ethogram
MOST_BINS = 1600  # parts of the longest plan of an ethogram, each of which has the colour of one action
NUMBERED = 8  # actions up to which the cells of a matrix hold their numbers
MOST_NAMES = 60  # actions up to which each has its name beside the matrix; of more, every second or third one

OTHER = "#7d838c"

INPUT_STYLES = {ACTIONS: ("o", True), CONTEXT: ("o", False), DURATIONS: ("D", False)}
"""How a dot of a model with an input is drawn: its marker, and whether it is hollow."""

DEEPEST = 0.8
"""Opacity of the deepest colour: black text in light and white text in dark stay legible on it."""

GAMMA = 0.7
"""Power of a value that gives its opacity: below 1, so that small values are visible."""


def model_names(frame: pd.DataFrame) -> pd.Series:
    """The names of models with their input, from the columns `model` and `input`."""
    model_input = frame["input"].str.extract("(context|durations)")[0]
    return frame["model"] + (", with " + model_input).fillna("")


def lag_names(lags: pd.DataFrame) -> pd.Series:
    """The name of the curve of each row of the table `lags`."""
    return "gain, " + model_names(lags)


@drawn
def score_figure(scores: pd.DataFrame) -> Figure:
    """Bits per action of each model with its interval, the best at the top.

    A model has a dot for each input, a hollow one for past actions alone. A model that is far worse than most is an
    arrow at the edge, so that the others can be compared; all values stand at the right.

    Args:
        scores: the table `scores` of a report: `model`, `input` (`ACTIONS`, `CONTEXT` or `DURATIONS`),
            `bits_per_behaviour`, `low`, `high`; a model may have a row for each input.
    """
    expect_some("scores", scores)
    best = scores.assign(bits=floats(scores["bits_per_behaviour"])).groupby("model", sort=False)["bits"].min()
    models = best.fillna(np.inf).sort_values(ascending=False, kind="stable").index
    figure, (axes,) = panels(1, 1, (WIDTH, 0.9 + 0.36 * max(len(models), 2)))
    styles = {inputs: INPUT_STYLES[inputs] for inputs in INPUT_STYLES if inputs in set(scores["input"])}
    many = len(styles) > 1
    limit = _edge(best.dropna().to_numpy())
    color = dict(zip(best.index, colors(list(best.index)), strict=True))
    for y, model in enumerate(models):
        rows = scores[scores["model"] == model].sort_values("input", key=lambda names: names.map([*styles].index))
        reach = (0, 0.17, 0.26)[len(rows) - 1]
        for row, place in zip(rows.itertuples(), np.linspace(reach, -reach, len(rows)), strict=True):
            estimate, (shape, hollow) = (row.bits_per_behaviour, row.low, row.high), styles[row.input]
            dot(axes, y + place, estimate, color[model], many and hollow, (-np.inf, limit), shape)
        values = ", ".join("" if np.isnan(bits) else f"{bits:.3f}" for bits in floats(rows["bits_per_behaviour"]))
        axes.text(1.03, y, values, transform=axes.get_yaxis_transform(), va="center")
    names_down(axes, [short(model, 36) for model in models])
    axes.set_xlabel("bits per behaviour (less is better)")
    axes.set_xlim(right=limit if np.isfinite(limit) else None)
    if many:
        legend(figure, [marker(INK, hollow, inputs, shape) for inputs, (shape, hollow) in styles.items()])
    return figure


def _edge(bits: Array) -> float:
    """Where the axis of the scores ends: far beyond the median; infinite where no score is so far."""
    finite = bits[np.isfinite(bits)]
    if len(finite) < 3:
        return float("inf")
    far = finite.min() + 5 * (np.median(finite) - finite.min())
    return float(far) if finite.max() > far > finite.min() else float("inf")


@drawn
def lag_figure(lags: pd.DataFrame) -> Figure:
    """Bits that the action k steps back adds, a line with its band for each model.

    Where the values span decades the axis is logarithmic above, and linear around 0, where estimates are negative too.

    Args:
        lags: the table `lags` of a report: `model`, `context`, `lag`, `bits`, `low`, `high`.
    """
    expect_some("lags", lags)
    figure, (axes,) = panels(1, 1, (WIDTH, 3.7))
    sizes = np.abs(floats(lags["bits"]))
    sizes = sizes[sizes > 0]
    largest = sizes.max(initial=0)
    linear = 10 ** np.round(np.log10(np.nanmax([largest / 100, min(sizes, default=1.0), 1e-9])))
    if largest > 30 * linear:
        axes.set_yscale("symlog", linthresh=linear, linscale=0.6)
        axes.yaxis.set_major_formatter(DIGITS)
    curves = dict(iter(lags.groupby(lag_names(lags), sort=False)))
    for (name, curve), (color, line) in zip(curves.items(), lines(list(curves)), strict=True):
        band(axes, curve[["lag", "bits", "low", "high"]].to_numpy(), color, short(name, 40), line)
    axes.axhline(0, color=INK, lw=0.8)
    whole_numbers(axes, "steps back", "bits")
    legend(figure, axes.get_legend_handles_labels()[0])
    return figure


@drawn
def dwell_figure(dwell: pd.DataFrame) -> Figure:
    """How long actions take, a panel an action: a histogram on a logarithmic axis with the law that was fitted.

    At most `MOST_PANELS` actions are drawn, the commonest; the figure says so.

    Args:
        dwell: the table of a report, a row a bin: `action`, `number` (of its durations above 0), `zero` (the share of
            durations of 0, which are not drawn), `law`, `low` and `high` (the edges), `density` and `fitted`: shares by
            unit of the natural logarithm.
    """
    expect_some("dwell", dwell)
    actions = list(dict(iter(dwell.groupby("behaviour", sort=False))).items())
    shown = sorted(actions, key=lambda item: -int(item[1]["number"].iloc[0]))[:MOST_PANELS]
    across = min(len(shown), 3)
    down = -(-len(shown) // across)
    size = (WIDTH if across > 1 else 5, 1.9 * down + 0.5)
    figure, cells = panels(down, across, size)
    for axes, (name, histogram) in zip(cells, shown, strict=False):
        low, high = floats(histogram["low"]), floats(histogram["high"])
        axes.bar(low, floats(histogram["density"]), high - low, align="edge", color=PLAIN, alpha=0.45, lw=0)
        axes.plot(np.sqrt(low * high), floats(histogram["fitted"]), color=MORE, lw=1.8)
        zero = float(histogram["zero"].iloc[0])
        at_zero = f", {100 * zero:.0f} % at 0" if zero else ""
        axes.set_title(f"{short(str(name), 20)}\n{histogram['law'].iloc[0]}{at_zero}", fontsize=9)
        axes.set_xscale("log")
        decades(axes, low.min(), high.max())
        axes.set(yticks=[], ylim=(0, None))
        axes.spines["left"].set_visible(False)
    at_edges(cells, len(shown), across, "duration", "density")
    if len(shown) < len(actions):
        figure.suptitle(f"the {len(shown)} commonest of {len(actions)} behaviours", fontsize=10, x=0.01, ha="left")
    return figure


@drawn
def transition_figure(matrix: ArrayLike, names: Sequence[str], title: str = "", small: bool = False) -> Figure:
    """A transition matrix as a heat map; actions that nothing followed (NaN) are hatched.

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
    _write_names(axes, names, 7.5 if small or len(probs) > 20 else 10)
    axes.set(xlabel="next behaviour", ylabel="last behaviour", title=clean(title))
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
            _write_names(axes, names, 8, left=number % across == 0, below=number >= len(chosen) - across)
        else:
            axes.set(xticks=[], yticks=[])
    at_edges(cells, len(chosen), across, "next behaviour", "last behaviour")
    if len(chosen) < len(gaps):
        figure.suptitle(f"the {len(chosen)} of {len(gaps)} that differ most", fontsize=10, x=0.01, ha="left")
    _scale(cells[: len(chosen)], -top, top, MORE, "difference in probability")
    return figure


@drawn
def condition_figure(means: pd.DataFrame, values: pd.DataFrame, paired: bool = False) -> Figure:
    """Features of behaviour under each condition: a panel a feature, a dot a unit, and means with their intervals.

    At most `MOST_DOTS` dots of each condition are drawn.

    Args:
        means: `feature` (text), `condition`, `mean`, `low`, `high`; features from the top down, conditions in order.
        values: `feature`, `unit`, `condition`, `value`; missing values are left out.
        paired: each unit is under every condition: lines join its dots.
    """
    expect_some("means", means)
    conditions = list(means["condition"].unique())
    features = list(means["feature"].unique())
    height = 0.62 + (0.36 if paired else 0.26) * len(conditions)
    figure, cells = panels(len(features), 1, (WIDTH, height * len(features) + 0.5))
    hues = level_colors(conditions)
    for axes, feature in zip(cells, features, strict=True):
        unit_values, mean = values[values["feature"] == feature], means[means["feature"] == feature]
        wide = unit_values.pivot(index="unit", columns="condition", values="value").reindex(columns=conditions)
        wide = wide.iloc[_spread(len(wide), MOST_DOTS * (1 if paired else len(conditions)))]
        places = -np.arange(len(conditions), dtype=np.float64)
        if paired:
            axes.plot(wide.to_numpy().T, places, color=INK, lw=0.7, alpha=0.3)
        for place, condition in zip(places, conditions, strict=True):
            dots = floats(wide[condition])
            axes.plot(dots, np.full(len(dots), place), "o", ms=5, mew=0, color=hues[condition], alpha=0.55)
            estimate = floats(mean.loc[mean["condition"] == condition, ["mean", "low", "high"]].to_numpy()[0])
            axes.plot(estimate[1:], [place - 0.32] * 2, color=hues[condition], lw=2.4, solid_capstyle="butt")
            axes.plot(estimate[0], place - 0.32, "|", ms=9, mew=2.4, color=hues[condition])
        names_down(axes, [short(condition, 20) for condition in conditions], places)
        axes.set_ylim(places.min() - 0.6, 0.4)
        axes.set_title(short(feature, 70), fontsize=9.5)
    return figure


@drawn
def motif_figure(motifs: pd.DataFrame) -> Figure:
    """How much more, or less, often sequences occur than expected, on an axis in powers of two.

    Args:
        motifs: rows of the table of a report: `sequence` (text), `ratio` (observed by expected), `low`, `high`,
            `count`; drawn from the top down.
    """
    expect_some("motifs", motifs)
    names = ["\n".join(wrap(clean(name), 36, max_lines=4, placeholder=" …")) for name in motifs["sequence"]][::-1]
    heights = np.array([0.5 + 0.5 * (1 + name.count("\n")) for name in names])
    figure, (axes,) = panels(1, 1, (WIDTH, 0.9 + 0.3 * max(heights.sum(), 2)))
    ratios = floats(motifs["ratio"])
    finite = ratios[np.isfinite(ratios) & (ratios > 0)]
    reach = 2 ** max(1.25 * float(np.abs(np.log2(finite)).max(initial=0)), 1.0)
    axes.axvline(1, color=INK, lw=0.8, alpha=0.6)
    places = np.cumsum(heights) - heights / 2
    estimates = floats(motifs[["ratio", "low", "high"]].to_numpy())
    for at, estimate, count in zip(places, estimates[::-1], motifs["count"][::-1], strict=True):
        dot(axes, at, estimate, FEWER if estimate[0] < 1 else MORE, limits=(1 / reach, reach))
        axes.text(1.03, at, f"{count:,}", transform=axes.get_yaxis_transform(), va="center")
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
def ethogram_figure(plans: Plans) -> Figure:
    """Plans as rows of coloured strips over time, one colour an action, by condition and group.

    Time is that of the recording, from its first action on, where it is known when all actions began: gaps are as long
    as they were. Else it is the sum of the durations, where plans have them, and a step is an action where they have
    none. A duration that is not known is left blank: until the next action, or as long as the median one. Of actions
    shorter than one of `MOST_BINS` parts of the longest plan some are not drawn. At most `MOST_ROWS` plans are drawn,
    evenly spaced; the figure says so. The fragments of a recording of one group are in one row, in their order.

    Args:
        plans: with names of actions and recordings, groups, conditions and durations where there are any.

    Raises:
        ValueError: no plan has an action.

    Example:
        >>> ethogram_figure(
        ...     Plans(torch.tensor([[0, 1, 2], [2, 1, 0]]), 3, action_names=("eat", "rest", "walk"))
        ... ).savefig("ethogram.png")
    """
    check_are_plans(plans)
    plans = RecordedPlans.of(plans if plans.end is None else plans.without_end())
    mask = plans.mask().cpu().numpy()
    if not mask.any():
        raise ValueError("`plans` must have at least one action: without any there is no figure.")
    names = action_names(plans)
    count = plans.actions.cpu()[torch.from_numpy(mask)].long().bincount(minlength=len(names)).numpy()
    palette, keys, columns = _strip_colors(count, names)
    whole = np.flatnonzero(mask.any(1))
    row_of = _rows_of(plans, whole)
    starts_row = np.unique(row_of, return_index=True)[1]
    chosen = whole[starts_row[_spread(len(starts_row), MOST_ROWS)]]  # the first plan of each row
    group, condition = (
        np.zeros(len(chosen), int) if values is None else values.cpu().numpy()[chosen]
        for values in (plans.group, plans.condition)
    )
    order = np.lexsort((group, condition))
    chosen, group, condition = chosen[order], group[order], condition[order]
    first = np.arange(len(chosen)) == 0
    new_condition = first | (np.diff(condition, prepend=0) != 0)
    new_group = new_condition | (np.diff(group, prepend=0) != 0)
    # Strips of five lines, the last of them blank; more blank lines before a group, and still more before a condition.
    tops = 5 * np.arange(len(chosen)) + np.cumsum(3 * new_group + 10 * new_condition * (plans.condition is not None))
    lines = int(tops[-1]) + 5
    place = np.full(len(starts_row), -1)
    place[row_of[np.searchsorted(whole, chosen)]] = np.arange(len(chosen))
    parts = np.argsort(place[row_of], kind="stable")
    parts = parts[place[row_of[parts]] >= 0]
    drawn_plans, rows = plans[torch.from_numpy(whole[parts])], place[row_of[parts]]
    in_time = _known_times(drawn_plans)
    shown, longest = (_strips_in_time if in_time else _strips_by_duration)(drawn_plans, rows)
    image = np.zeros((lines, shown.shape[1], 4))
    image[np.add.outer(tops, range(4))] = palette[shown][:, None]
    figure, (axes,) = panels(1, 1, (WIDTH, 0.034 * lines + 0.7 + 0.22 * -(-len(keys) // columns)))
    axes.imshow(image, aspect="auto", interpolation="none", extent=(0, longest, lines, 0))
    starts = np.flatnonzero(new_group)
    middle = (tops[starts] + tops[np.append(starts[1:], len(chosen)) - 1]) / 2 + 2
    called = group_names(plans, torch.from_numpy(group[starts]))
    axes.set_yticks([], []) if plans.group is None else axes.set_yticks(middle, [short(c, 18) for c in called])
    axes.tick_params(axis="y", length=0, labelsize=8)
    for row in np.flatnonzero(new_condition) if plans.condition is not None else []:
        name = plans.condition_names[condition[row]] if plans.condition_names else f"condition {condition[row]}"
        axes.text(0, tops[row] - 2, short(name, 40), va="bottom", fontsize=9, weight="bold")
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.xaxis.set_major_locator(MaxNLocator(integer=plans.durations is None and not in_time, min_n_ticks=1))
    across = "behaviour of the sequence" if plans.durations is None else "time, in the unit of the durations"
    across = "time since the first behaviour, in the unit of the recordings" if in_time else across
    axes.set_xlabel(
        across + (f"; {len(chosen)} of {len(starts_row)} sequences" if len(chosen) < len(starts_row) else "")
    )
    figure.legend(handles=keys, loc="outside lower left", ncols=columns, fontsize=9, handlelength=1, columnspacing=1.4)
    return figure


def _rows_of(plans: RecordedPlans, index: NDArray[np.int64]) -> NDArray[np.int64]:
    """The row of an ethogram of each of some plans, numbered from 0: parts of one plan have the same."""
    if plans.recording is None:
        return np.arange(len(index))
    names = np.unique(np.array(plans.recording, dtype=str)[index], return_inverse=True)[1]
    group = np.zeros(len(index), np.int64) if plans.group is None else plans.group.cpu().numpy()[index]
    _, first, row = np.unique(np.stack([names, group]), axis=1, return_index=True, return_inverse=True)
    rows: NDArray[np.int64] = np.argsort(np.argsort(first))[row.reshape(-1)]  # in the order of the plans
    return rows


def _known_times(plans: RecordedPlans) -> bool:
    """Whether it is known of all actions when they began, and in their order."""
    if plans.began is None:
        return False
    mask = plans.mask()
    return bool(plans.began[mask].isfinite().all()) and float(plans.began[mask].max()) > float(plans.began[mask].min())


def _strips_in_time(plans: RecordedPlans, row: NDArray[np.int64]) -> tuple[NDArray[np.int64], float]:
    """The action `[R, bins]` in R rows at evenly spaced times of their recordings; else as `_strips_by_duration`."""
    mask = plans.mask().cpu().numpy()
    assert plans.began is not None
    began = plans.began.cpu().double().numpy()[mask]
    seconds = np.full(len(began), np.nan) if plans.durations is None else plans.durations.cpu().double().numpy()[mask]
    at_row, actions = np.repeat(row, mask.sum(1)), plans.actions.cpu().numpy()[mask]
    first = np.full(int(row[-1]) + 1, np.inf)
    np.minimum.at(first, at_row, began)
    begin = began - first[at_row]
    end = np.where(np.isnan(seconds), np.inf, begin + seconds)
    longest = float(np.where(np.isfinite(end), end, begin).max()) or 1.0
    at = (np.arange(MOST_BINS) + 0.5) * longest / MOST_BINS
    shown = np.full((len(first), MOST_BINS), plans.num_actions)
    for number in range(len(first)):
        in_row = np.flatnonzero(at_row == number)
        in_row = in_row[np.argsort(begin[in_row], kind="stable")]
        last = np.searchsorted(begin[in_row], at, side="right") - 1
        inside = (last >= 0) & (at < end[in_row][last]) & (np.isfinite(end[in_row][last]) | (last < len(in_row) - 1))
        shown[number] = np.where(inside, actions[in_row][last], plans.num_actions)
    return shown, longest


def _strips_by_duration(plans: RecordedPlans, row: NDArray[np.int64]) -> tuple[NDArray[np.int64], float]:
    """The action `[R, bins]` in R rows at evenly spaced times, A for none, and how long the longest row takes.

    Args:
        plans: N of them.
        row: `[N]`, ascending from 0: in which row each is, behind those before it in the same row.
    """
    mask, rows = plans.mask().cpu().numpy(), int(row[-1]) + 1
    # A part takes its actions and, where another one comes after it, a blank whose duration is not known.
    size = mask.sum(1) + np.append(row[1:] == row[:-1], False)
    before = np.cumsum(size) - size
    offset = before - before[np.searchsorted(row, row)]
    reach = np.bincount(row, size).astype(int)
    plan, step = mask.nonzero()
    at_row, at = row[plan], offset[plan] + step
    actions = np.full((rows, reach.max()), plans.num_actions)
    actions[at_row, at] = plans.actions.cpu().numpy()[plan, step]
    taken = np.arange(actions.shape[1]) < reach[:, None]
    times, bins = taken.astype(np.float64), min(actions.shape[1], MOST_BINS)
    if plans.durations is not None:
        times, bins = np.where(taken, np.nan, 0.0), MOST_BINS
        times[at_row, at] = plans.durations.cpu().double().numpy()[plan, step]
    unknown = np.isnan(times)
    observed = times[taken & ~unknown]
    ends = np.where(unknown, np.median(observed) if observed.size else 1.0, times).cumsum(1)
    longest = float(ends.max()) or 1.0
    at = (np.arange(bins) + 0.5) * longest / bins
    shown = np.where(unknown | ~taken, plans.num_actions, actions)
    shown = np.pad(shown, ((0, 0), (0, 1)), constant_values=plans.num_actions)
    return np.stack(
        [strip[np.searchsorted(end, at, side="right")] for strip, end in zip(shown, ends, strict=True)]
    ), longest


def _strip_colors(count: Any, names: Sequence[str]) -> tuple[Array, list[Patch], int]:
    """Colours `[A + 1, 4]` of actions in strips, the last of no action; the entries of the legend, and its columns."""
    most = len(STRIPS) if len(names) <= len(STRIPS) else len(STRIPS) - 1
    kept = np.sort(np.argsort(-count, kind="stable")[:most])
    palette = np.array([(*to_rgb(OTHER), 0.45)] * len(names) + [(0, 0, 0, 0)])
    palette[kept, :3], palette[kept, 3] = [to_rgb(color) for color in STRIPS[: len(kept)]], 1
    keys = [Patch(color=STRIPS[place], label=short(names[action])) for place, action in enumerate(kept)]
    if len(kept) < len(names):
        keys.append(Patch(color=OTHER, alpha=0.45, lw=0, label=f"{len(names) - len(kept)} other behaviours"))
    return palette, keys, 6 if max(len(str(key.get_label())) for key in keys) <= 10 else 3


@drawn
def occupancy_figure(occupancy: pd.DataFrame) -> Figure:
    """The share of each hidden mode over the parts of plans, with bands.

    Args:
        occupancy: columns `mode`, `part` (from 1), `share`, `low`, `high`.
    """
    expect_some("occupancy", occupancy)
    figure, (axes,) = panels(1, 1, (WIDTH, 2.8))
    names = list(occupancy["mode"].unique())
    for number, name in enumerate(names):
        mode_rows = occupancy[occupancy["mode"] == name]
        band(axes, mode_rows[["part", "share", "low", "high"]].to_numpy(float), STRIPS[number % len(STRIPS)], name, "-")
    whole_numbers(axes, f"part of the sequence, of {occupancy['part'].max()}", "share of the behaviours")
    axes.set_ylim(bottom=0)
    legend(figure, axes.get_legend_handles_labels()[0])
    return figure


@drawn
def drift_figure(drift: pd.DataFrame, plans: pd.DataFrame) -> Figure:
    """Bits per action within plans, from plan to plan, and from group to group: three panels.

    Args:
        drift: the table of a report: `what`, `name`, `bits`, `low`, `high`. Where `what` is "place", the equal parts of
            the plans from the first to the last; where it is "subject", the groups, of which at most `MOST_GROUPS` are
            drawn, the one that takes the most bits at the top.
        plans: `index` of a plan in its group, `bits` per action; at most `MOST_PLANS` are drawn.
    """
    parts, groups = (drift[drift["what"] == what] for what in ("place", "subject"))
    ranked = groups[groups["bits"].notna()].sort_values("bits", kind="stable")
    ranked = ranked.iloc[_spread(len(ranked), MOST_GROUPS)]
    low = 0.9 + 0.24 * max(len(ranked), 2)
    figure = Figure(figsize=(WIDTH, 3.1 + low), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[3.1, low])[:, 0]
    within, between = upper.subplots(1, 2)
    below = lower.subplots()
    place = 100 * (np.arange(len(parts)) + 0.5) / max(len(parts), 1)
    band(within, parts.assign(place=place)[["place", "bits", "low", "high"]].to_numpy(), PLAIN, "", "-")
    within.set(xlim=(0, 100), xlabel="place in the sequence, %", ylabel="bits per behaviour", title="within sequences")
    within.grid(axis="y")
    _cloud(between, floats(plans["index"]), floats(plans["bits"]))
    for at, row in enumerate(ranked.itertuples()):
        dot(below, at, (row.bits, row.low, row.high), PLAIN)
    names_down(below, [short(name) for name in ranked["name"]])
    of_all = f" ({len(ranked)} of {len(groups)})" if len(ranked) < len(groups) else ""
    below.set(xlabel="bits per behaviour", title="subjects" + of_all)
    return figure


def _cloud(axes: Axes, index: Array, bits: Array) -> None:
    """Bits of each plan against its place in its group, and the means of neighbouring places."""
    chosen = _spread(len(index), MOST_PLANS)
    axes.plot(index[chosen], bits[chosen], "o", ms=3.5, mew=0, color=INK, alpha=0.3)
    finite = np.isfinite(bits)
    places = np.unique(index[finite])
    parts = np.array_split(places, min(20, len(places))) if len(places) else []
    means = [bits[finite & (index >= chunk[0]) & (index <= chunk[-1])].mean() for chunk in parts]
    axes.plot([chunk.mean() for chunk in parts], means, color=MORE, lw=2.2)
    whole_numbers(axes, "number of the sequence of its subject", "")
    of_all = f" ({len(chosen):,} of {len(index):,} drawn)" if len(chosen) < len(index) else ""
    axes.set_title("from sequence to sequence" + of_all)


def _spread(number: int, most: int) -> list[int]:
    """At most `most` of `number` places, evenly spaced from the first to the last."""
    places: list[int] = np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(int)).tolist()
    return places


def _shades(values: Array, more: str) -> Array:
    """Colours `[..., 4]` of values from -1 to 1: the page shows through where they are small or NaN."""
    clipped = np.nan_to_num(np.clip(values, -1, 1))
    hues = np.array([to_rgb(FEWER), to_rgb(more)])
    return np.concatenate([hues[(clipped > 0).astype(int)], DEEPEST * np.abs(clipped)[..., None] ** GAMMA], -1)


def _cells(axes: Axes, values: Array, more: str) -> None:
    """A matrix of values from -1 to 1, whose unknown rows are hatched."""
    axes.imshow(_shades(values, more), interpolation="none")
    for row in np.flatnonzero(np.isnan(values).all(1)):
        place = (-0.5, row - 0.5)
        axes.add_patch(Rectangle(place, values.shape[1], 1, fill=False, hatch="////", ec=INK, lw=0, alpha=0.35))
    for spine in axes.spines.values():
        spine.set(visible=True, alpha=0.3)


def _write_names(axes: Axes, names: Sequence[str], size: float, left: bool = True, below: bool = True) -> None:
    """Names of actions down the left side and below; some of them where they are many."""
    places = range(0, len(names), -(-len(names) // MOST_NAMES))
    shown = [short(names[place], 24) for place in places]
    turned = 0 if max(map(len, shown)) <= 5 and len(shown) <= NUMBERED else 90
    axes.set_xticks(places, shown if below else [""] * len(shown), rotation=turned, fontsize=size)
    axes.set_yticks(places, shown if left else [""] * len(shown), fontsize=size)
    axes.tick_params(length=0 if len(places) == len(names) else 2)


def _scale(axes: Axes | list[Axes], low: float, high: float, more: str, label: str) -> None:
    """The scale of the colours of `axes`, beside them."""
    first = axes if isinstance(axes, Axes) else axes[0]
    bar = first.figure.colorbar(ScalarMappable(Normalize(low, high)), ax=axes, shrink=0.6, aspect=16, label=label)
    # Of its own, matplotlib draws hundreds of cells, with seams where they are not opaque.
    assert bar.solids is not None
    bar.solids.remove()
    steps = np.linspace(low, high, 128)[::-1, None]
    bar.ax.imshow(_shades(steps / high, more), extent=(0, 1, low, high), aspect="auto", interpolation="none")
    bar.outline.set(edgecolor=INK, alpha=0.3)
