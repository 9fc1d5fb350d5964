"""The report of `python -m eval options`: what is reached with candidates of each prior, and paired differences."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from eval.options.priors import pairs
from eval.options.run import LABYRINTH
from eval.worlds import runs
from neuroprior.behaviour.reporting.document import Document
from neuroprior.behaviour.reporting.drawing import WIDTH, at_edges, band, drawn, legend, panels
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table

PLACE = ["world", "context", "length", "num_plans"]
"""What is the same for two priors that are compared, beside the seed."""

LINES = {
    "uniform": ("#7d838c", "-"),
    "flat": ("#3079d8", "-"),
    "flat-{}": ("#3079d8", "--"),
    "switching-{}": ("#d9731a", "-"),
    "options-{}": ("#d9731a", "--"),
    "kept-{}": ("#d9731a", ":"),
    "macro": ("#2e9e5b", "-"),
}
"""Colours and styles of the lines of a figure; {}: a number of modes."""

WHAT = (
    "switching-K: K modes; options-K: as many candidates begin in each mode; kept-K: and never leave it; constant-K:"
    " the modes switch alike in all contexts; flat: the chain of the best order; flat-K: the one whose bits are nearest"
    " to those of switching-K; macro: a chain over actions and macro-actions."
)


def options_document(results: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], command: str) -> Document:
    """The tables of the results of `options_run`, and a figure of each world."""
    frame = runs.frame_of(results)
    rows = runs.seed_means(frame, ["world", "prior", "context", "length", "num_plans"], "share", ["bits"])
    rows = rows.assign(low=rows["low"].clip(lower=0), high=rows["high"].clip(upper=1))
    compared = compared_pairs(frame, settings["modes"])
    names = ["world", "first_prior", "second_prior", "context", "length", "num_plans"]
    gaps = runs.paired_differences(compared, names)
    tables, boxes, leads = [], [], []
    for world, one in {result["world"]: result for result in results}.items():
        world_rows, differences = rows[rows["world"] == world], gaps[gaps["world"] == world]
        for length in sorted(world_rows["length"].unique()):
            tables.append(share_table(world_rows[world_rows["length"] == length], world, length))
        if len(differences):
            tables += [gap_table(differences, world, number) for number in fewest_and_middling(settings["num_plans"])]
            leads.append(finding(differences, world))
        caption = f"{world}: {one['about']}. Bands: Student's 95 % intervals over seeds. {WHAT}"
        alt = f"What is reached in {world} against the number of candidates, a line a prior; the numbers are in tables."
        boxes.append(FigureBox(reached_figure(world_rows, settings["modes"]), caption, alt, world))
    sections = [Section("Reached against candidates", figures=boxes), Section("Tables", tables=tables)]
    lead = " ".join(leads) or "Differences need at least two seeds."
    frames = {"rows": rows, "paired": gaps}
    return Document("Modes as options", lead, sections, frames, settings, command)


def compared_pairs(frame: pd.DataFrame, modes: Sequence[int]) -> pd.DataFrame:
    """A row a pair of priors, place and seed: `first_prior`, `second_prior` and what they reached."""
    parts = []
    for first, second in pairs(modes):
        sides = [
            frame.loc[frame["prior"] == label, [*PLACE, "seed", "share"]].rename(columns={"share": side})
            for label, side in ((first, "first"), (second, "second"))
        ]
        parts.append(sides[0].merge(sides[1], on=[*PLACE, "seed"]).assign(first_prior=first, second_prior=second))
    return pd.concat(parts)


def share_table(rows: pd.DataFrame, world: str, length: int) -> Table:
    """What is reached with plans of one length in a world, a row a prior and a column a number of candidates."""
    cells = [runs.plus_minus(row, "share", 100).replace(" ", "") for _, row in rows.iterrows()]
    measure = "% of the nodes from which the water is reached" if world == LABYRINTH else "normalised score, %"
    caption = f"{measure}; bits: per action of held-out plans. {runs.over_seeds(rows)} {WHAT}"
    shown = rows.assign(bits=rows["bits"].map("{:.3f}".format))
    names = {"context": "context", "prior": "prior", "bits": "bits"}
    return runs.table_by(
        shown, names, "num_plans", cells, caption, f"{world}: plans of {length} actions, by candidates"
    )


def gap_table(gaps: pd.DataFrame, world: str, number: int) -> Table:
    """Paired differences with one number of candidates, a row a pair and a column a length."""
    chosen = gaps[gaps["num_plans"] == number]
    cells = [runs.plus_minus(row, "difference", 100, sign="+").replace(" ", "") for _, row in chosen.iterrows()]
    names = {"context": "context", "first": "first_prior", "minus": "second_prior"}
    caption = "Points; ±: 95 % interval, paired by seed; other numbers of candidates are in paired.csv."
    return runs.table_by(
        chosen, names, "length", cells, caption, f"{world}: differences with {number} candidates, by actions in a plan"
    )


def finding(gaps: pd.DataFrame, world: str) -> str:
    """How often modes reach more than the chain of equal likelihood, in one sentence."""
    compared = gaps["first_prior"].str.startswith("switching-") & gaps["second_prior"].str.startswith("flat-")
    sums = []
    for context, group in gaps[compared].groupby("context", sort=False):
        above, below = (group["low"] > 0).sum(), (group["high"] < 0).sum()
        sums.append(f"context {context}: {above} of {len(group)} above 0, {below} below")
    return f"{world}, switching minus flat of equal likelihood (95 % intervals): {'; '.join(sums)}."


def fewest_and_middling(num_plans: Sequence[int]) -> list[int]:
    """The numbers of candidates for which differences are shown."""
    numbers = sorted(num_plans)
    return sorted({numbers[0], numbers[len(numbers) // 2]})


@drawn
def reached_figure(rows: pd.DataFrame, modes: Sequence[int]) -> Figure:
    """What is reached against the number of candidates: a row of panels a context, a column a length."""
    number = sorted(modes)[len(modes) // 2]
    contexts, lengths = list(rows["context"].unique()), sorted(rows["length"].unique())[:3]
    figure, axes = panels(len(contexts), len(lengths), (WIDTH, 2.6 * len(contexts)), sharey=True, sharex=True)
    places = [(context, length) for context in contexts for length in lengths]
    for panel, (context, length) in zip(axes, places, strict=True):
        panel_rows = rows[(rows["context"] == context) & (rows["length"] == length)]
        for name, (color, style) in LINES.items():
            curve = panel_rows[panel_rows["prior"] == name.format(number)].sort_values("num_plans")
            if len(curve):
                points = curve[["num_plans", "share", "low", "high"]].to_numpy(float)
                points[:, 1:] *= 100
                band(panel, points, color, name.format(number), style)
        numbers = sorted(rows["num_plans"].unique())
        panel.set_xscale("log")
        panel.set_xticks(numbers, [f"{number:,}" for number in numbers])
        panel.minorticks_off()
        panel.set_title(f"{length} actions, context: {context}")
        panel.grid(axis="both")
    at_edges(axes, len(places), len(lengths), "candidates", "reached, %")
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure
