"""The section on recordings: the time budget, and how well observers agree."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from neuroprior._statistics import interval_words, mean_interval
from neuroprior.behaviour.analysis.rate_drift import overlap
from neuroprior.behaviour.recordings import KEYS, Recordings
from neuroprior.behaviour.reporting.document import Column, table
from neuroprior.behaviour.reporting.drawing import (
    WIDTH,
    at_edges,
    band,
    drawn,
    legend,
    level_colors,
    marker,
    names_down,
    panels,
    short,
)
from neuroprior.behaviour.reporting.page import INK, FigureBox, Section
from neuroprior.behaviour.reporting.part import LISTED, Part
from neuroprior.behaviour.reporting.scores import Evaluation

BINS = 10
"""Parts of the longest recording in which behaviours are counted."""

MOST_PANELS = 12
"""Behaviours that are drawn over time: those that take the most."""


def recording_section(evaluation: Evaluation) -> Part | None:
    """Return the time budget of the recordings, and the agreement of observers; None where no times are known."""
    recordings = evaluation.recordings
    if recordings is None or recordings.events["stop"].isna().all():
        return None
    each, course = subject_budget(recordings), time_course(recordings)
    budget = time_budget(each)
    frames = {"time_budget": budget}
    percent: dict[str, Column] = {
        "behaviour": "behaviour",
        "% of the time": lambda row: f"{100 * row.share:.1f}",
        "95 % interval": lambda row: interval_words(100 * row.low, 100 * row.high, ".1f"),
        "subjects": "subjects",
    }
    if budget["condition"].ne("").any():
        percent = {str(recordings.factors[0]): "condition", **percent}
    unknown = int(recordings.events["stop"].isna().sum())
    caption = "Share of the watched time, mean over subjects." + (
        f" Of {unknown:,} events the end is not known: they take no time here." if unknown else ""
    )
    tables = [table(budget, percent, caption, "Time budget")]
    if "observer" in recordings.events:
        agreement = recordings.agreement()
        frames["agreement"] = agreement
        columns: dict[str, Column] = {
            "observers": lambda row: f"{row['first']}, {row['second']}",
            "behaviour": "behaviour",
            "kappa": "kappa:.2f",
            "% agreed": lambda row: f"{100 * row.agreement:.1f}",
        }
        caption = "Cohen's kappa over the time that both watched; models are fitted to the sequences of one observer."
        tables.append(table(agreement[:LISTED], columns, caption, "Agreement of observers"))
    frames |= {"subject_budget": each, "time_course": course}
    caption = "Share of the watched time that each behaviour takes. Dots: subjects; bars: means with 95 % intervals."
    boxes = [FigureBox(budget_figure(budget, each), caption, "Time budget with a dot for each subject.", "time_budget")]
    if len(course):
        caption = (
            "Share of the watched time of each behaviour, by tenths of the longest recording; means over subjects,"
        )
        caption += " with 95 % intervals. What nobody watched does not count."
        boxes.append(FigureBox(course_figure(course), caption, "Behaviours over time.", "time_course"))
    return Part(Section("Time budget", tables=tables, figures=boxes), frames)


def subject_budget(recordings: Recordings) -> pd.DataFrame:
    """Return the share of the watched time of each behaviour and subject: `condition, subject, behaviour, share`."""
    kept = recordings.of_one_observer()
    parts = []
    for level, level_recordings in kept.by_level(_shown_factor(kept)):
        shares = level_recordings.time_budget().rename_axis(index="subject", columns="behaviour")
        parts.append(shares.reset_index().melt("subject", value_name="share").assign(condition=level))
    whole = pd.concat(parts, ignore_index=True).dropna()
    return whole.reindex(columns=["condition", "subject", "behaviour", "share"])


def time_course(recordings: Recordings, bins: int = BINS) -> pd.DataFrame:
    """Return how the time that behaviours take changes within recordings.

    Args:
        recordings: with known stops; times count from the first watched moment of each recording.
        bins: equal parts of the longest recording.

    Returns:
        A frame with the columns `condition` (of the only factor), `behaviour, time` (the middle of a part), `share` of
        the watched time there, mean over subjects, its 95 % interval `low, high`, and `subjects`. Empty where no
        recording takes any time.
    """
    kept = recordings.of_one_observer()
    columns = ["condition", "behaviour", "time", "share", "low", "high", "subjects"]
    factor = _shown_factor(kept)
    condition = kept.watched_levels(factor) if factor else ""
    begin = kept.watched.groupby(KEYS)["start"].min().rename("begin")
    events, watched = (frame.merge(begin, on=KEYS) for frame in (kept.events, kept.watched.assign(condition=condition)))
    longest = float((watched["stop"] - watched["begin"]).max())
    if not longest > 0:
        return pd.DataFrame(columns=columns)
    edges = np.linspace(0, longest, bins + 1)

    def inside(frame: pd.DataFrame) -> NDArray[np.float64]:
        """Return how much of each row lies in each part `[rows, bins]`."""
        start, stop = ((frame[end] - frame["begin"]).to_numpy(np.float64) for end in ("start", "stop"))
        return overlap(start, stop, edges)

    events = events.assign(condition=events[factor] if factor else "")
    time = pd.DataFrame(inside(watched)).groupby([watched["condition"], watched["subject"]]).sum()
    done = pd.DataFrame(inside(events)).groupby([events["condition"], events["subject"], events["behaviour"]]).sum()
    rows = []
    for level in time.index.get_level_values(0).unique():
        spent, whole = done.loc[level], time.loc[level].where(lambda values: values > 0)
        for behaviour in spent.index.get_level_values("behaviour").unique():
            shares = spent.xs(behaviour, level="behaviour").reindex(whole.index, fill_value=0.0) / whole
            for place in range(bins):
                values = shares[place].dropna().to_numpy()
                if len(values):
                    middle = (edges[place] + edges[place + 1]) / 2
                    rows.append((level, behaviour, middle, *_mean(values)))
    return pd.DataFrame(rows, columns=columns)


def _shown_factor(recordings: Recordings) -> str | None:
    """Return the factor that levels are of: the first; None without any."""
    return recordings.factors[0] if recordings.factors else None


@drawn
def budget_figure(budget: pd.DataFrame, each: pd.DataFrame) -> Figure:
    """The share of the watched time of each behaviour: a row a behaviour and level, a dot a subject, means with bars.

    Args:
        budget: `condition, behaviour, share, low, high`, see `time_budget`.
        each: `condition, subject, behaviour, share`, see `subject_budget`.
    """
    levels = list(budget["condition"].unique())
    order = list(budget.groupby("behaviour")["share"].max().sort_values().index)
    figure, (axes,) = panels(1, 1, (WIDTH, 0.8 + 0.2 * (1 + len(levels)) * len(order)))
    hues = level_colors(levels)
    spread = np.linspace(0.28, -0.28, len(levels)) if len(levels) > 1 else np.zeros(1)
    for place, behaviour in enumerate(order):
        for shift, level in zip(spread, levels, strict=True):
            of = (each["behaviour"] == behaviour) & (each["condition"] == level)
            dots = 100 * each.loc[of, "share"]
            axes.plot(dots, np.full(len(dots), place + shift), "o", ms=4.5, mew=0, alpha=0.5, color=hues[level])
            rows = budget[(budget["behaviour"] == behaviour) & (budget["condition"] == level)]
            for row in rows.itertuples():
                axes.hlines(place + shift, 100 * row.low, 100 * row.high, color=hues[level], lw=2.2)
                axes.plot(100 * row.share, place + shift, "|", ms=11, mew=2.4, color=INK)
    names_down(axes, [short(str(name), 24) for name in order])
    axes.set_xlim(left=0)
    axes.set_xlabel("% of the watched time")
    legend(figure, [marker(hues[level], False, short(str(level), 24)) for level in levels if level])
    return figure


@drawn
def course_figure(course: pd.DataFrame) -> Figure:
    """How the share of each behaviour changes over time: a panel a behaviour, a line with its band a level.

    Times at which less than half of the subjects of a level were watched are left out.

    Args:
        course: of `time_course`.
    """
    shown = list(course.groupby("behaviour")["share"].mean().sort_values(ascending=False).index)[:MOST_PANELS]
    levels = list(course["condition"].unique())
    hues = level_colors(levels)
    across = min(len(shown), 3)
    down = -(-len(shown) // across)
    figure, cells = panels(down, across, (WIDTH, 1.7 * down + 0.6), sharex=True)
    for axes, behaviour in zip(cells, shown, strict=False):
        for level in levels:
            curve = course[(course["behaviour"] == behaviour) & (course["condition"] == level)]
            curve = curve[curve["subjects"] >= curve["subjects"].max() / 2]
            bounds = curve[["share", "low", "high"]].clip(0, 1).mul(100)
            rows = np.column_stack([curve["time"], bounds])
            band(axes, rows, hues[level], short(str(level), 20), "-")
        axes.set_title(short(str(behaviour), 24), fontsize=9)
        axes.set_ylim(bottom=0)
    at_edges(cells, len(shown), across, "time", "% of the time")
    legend(figure, [marker(hues[level], False, short(str(level), 24)) for level in levels if level])
    return figure


def time_budget(each: pd.DataFrame) -> pd.DataFrame:
    """Return the share of the watched time that each behaviour takes at each level, from that of each subject.

    Args:
        each: `condition, subject, behaviour, share`, see `subject_budget`.

    Returns:
        A frame with the columns `condition` ("" without a factor), `behaviour, share, low, high, subjects`: means over
        subjects, with Student's 95 % interval (NaN for a single subject); the longest behaviour of each level first.
    """
    rows = []
    for level, shares in each.groupby("condition", sort=False):
        behaviours = shares.groupby("behaviour")["share"]
        for behaviour in behaviours.mean().sort_values(ascending=False).index:
            rows.append((level, behaviour, *_mean(behaviours.get_group(behaviour).to_numpy())))
    return pd.DataFrame(rows, columns=["condition", "behaviour", "share", "low", "high", "subjects"])


def _mean(shares: NDArray[np.float64]) -> tuple[float, float, float, int]:
    """Return the mean of shares, its 95 % interval (NaN for a single one), and their number."""
    bounds = mean_interval(shares)[:3] if len(shares) > 1 else (float(shares[0]), np.nan, np.nan)
    return *bounds, len(shares)
