"""What the section on durations says of survival: curves under each condition, and the log-rank test."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from neuroprior._statistics import LEVEL, interval_words, p_words
from neuroprior.behaviour.durations.survival import DurationSurvival
from neuroprior.behaviour.reporting.document import Column, table
from neuroprior.behaviour.reporting.drawing import (
    PLAIN,
    WIDTH,
    at_edges,
    decades,
    drawn,
    expect_some,
    floats,
    legend,
    level_colors,
    marker,
    panels,
    short,
)
from neuroprior.behaviour.reporting.findings import Finding
from neuroprior.behaviour.reporting.page import Table
from neuroprior.behaviour.reporting.part import LISTED, p_text
from neuroprior.plans.columns import listed

MOST_PANELS = 12
"""Behaviours that are drawn: those of which most bouts are known."""


def survival_findings(result: DurationSurvival, few: str, unit: str) -> list[Finding]:
    """A finding for each behaviour: whether its bouts last as long under each condition.

    Args:
        result: of `duration_survival`.
        few: why no verdict is drawn; "" where one is.
        unit: of the durations.
    """
    findings = []
    for name, (p, corrected) in result.tests.items():
        curves = {level: curve for (behaviour, level), curve in result.curves.items() if behaviour == name}
        ratio = result.ratios.get(name)
        if ratio is None:
            medians = [f"{one.median:.3g}{f' {unit}' * bool(unit)} under {level}" for level, one in curves.items()]
            sentence = f"How long a bout of {name} lasts differs between conditions: medians {listed(medians)}"
        else:
            first, second = curves
            sentence = f"Bouts of {name} last {ratio.mean:.3g} times as long under {second} as under {first}"
            sentence += interval_words(ratio.low, ratio.high, ".3g", ", 95 % interval ")
        sentence += f"; log-rank test, {p_words(corrected)}."
        feature, starred = f"survival of {name}", corrected < LEVEL and not few
        effect, low, high = ratio or (None, None, None)
        estimate = (effect, low, high, p, corrected)
        findings.append(Finding(f"survival: {name}", "survival", feature, *estimate, starred, sentence))
    return findings


def survival_table(result: DurationSurvival, few: str) -> Table:
    """The medians of each behaviour under each condition, with the test, the clearest difference first."""
    frame = result.medians().sort_values("p_corrected", kind="stable")
    columns: dict[str, Column] = {"behaviour": "behaviour"}
    columns |= {name.replace(", ", ",\n"): f"{name}:.3g" for name in frame.columns if name.startswith("median")}
    caption = "Medians of bouts, of which some were cut off by the end of watching (Kaplan-Meier)."
    if result.ratios:
        columns["ratio"] = "ratio:.3g"
        columns["95 % interval"] = lambda row: interval_words(row.low, row.high, ".3g")
        caption += " ratio: of mean durations, the second by the first."
    if result.tests and not few:
        columns["p"] = lambda row: (
            "" if np.isnan(row.p_corrected) else p_text(row.p_corrected) + "*" * (row.p_corrected < LEVEL)
        )
        caption += " p: log-rank test, corrected for the behaviours (step-down minP). *: p < 0.05."
    return table(frame[:LISTED], columns, caption, "Survival of bouts")


@drawn
def survival_figure(survival: pd.DataFrame) -> Figure:
    """The share of bouts that last longer than a time, a panel a behaviour, a step line with its band a condition.

    At most `MOST_PANELS` behaviours are drawn.

    Args:
        survival: `behaviour, condition, time, survival, low, high, at_risk`, see `DurationSurvival.frame`.
    """
    expect_some("survival", survival)
    most = survival.groupby("behaviour")["at_risk"].max().sort_values(ascending=False, kind="stable")
    shown, levels = list(most.index[:MOST_PANELS]), list(survival["condition"].unique())
    hues = level_colors(levels) if len(levels) > 1 else dict.fromkeys(levels, PLAIN)
    across = min(len(shown), 3)
    down = -(-len(shown) // across)
    figure, cells = panels(down, across, (WIDTH, 1.8 * down + 0.6))
    for axes, behaviour in zip(cells, shown, strict=False):
        for level in levels:
            curve = survival[(survival["behaviour"] == behaviour) & (survival["condition"] == level)]
            time, share, low, high = floats(curve[["time", "survival", "low", "high"]].to_numpy()).reshape(-1, 4).T
            axes.step(time, share, where="post", color=hues[level], lw=1.6)
            axes.fill_between(time, low, high, step="post", color=hues[level], alpha=0.2, lw=0)
        axes.set_title(short(str(behaviour), 24), fontsize=9)
        axes.set(xscale="log", ylim=(0, 1.02))
        times = floats(survival.loc[(survival["behaviour"] == behaviour) & (survival["time"] > 0), "time"])
        decades(axes, times.min(), times.max())
    at_edges(cells, len(shown), across, "duration", "share that lasts longer")
    legend(figure, [marker(hues[level], False, short(str(level), 24)) for level in levels if level])
    return figure
