"""The report of `python -m eval live`: rewards of agents in the same worlds that differ in their prior."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from eval.live.run import FORESIGHT, ORACLE, PARTS, RANDOM
from eval.worlds import runs
from eval.worlds.aggregates import mean_intervals
from neuroprior.behaviour.reporting.document import Column, Document, table
from neuroprior.behaviour.reporting.drawing import WIDTH, at_edges, band, drawn, legend, panels
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table

CONDITION = ["prior", "context", "learns", "warm_start"]
NAMES = {"prior": "prior", "context": "context", "learns": "learns"}

COLORS = {"never": "#7d838c", "before": "#d9731a", "online": "#3079d8", "oracle": "#2e9e5b"}
"""Of lines, by when the prior learned."""


def live_document(results: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], command: str) -> Document:
    """The tables of the results of `run_live`, and a figure named after each world."""
    frame = live_frame(results)
    rows, pairs = live_rows(frame), live_pairs(frame)
    gaps = runs.paired_differences(pairs, ["world", *CONDITION[:3], "against"])
    best = frame.loc[frame["prior"] == "oracle", ["world", "seed", "reward"]].rename(columns={"reward": "best"})
    shares = pairs[pairs["against"] == "random"].merge(best, on=["world", "seed"])
    for side in ("first", "second"):
        shares[side] /= shares["best"].clip(lower=1e-12)
    across = runs.across_worlds(shares, CONDITION[:3])
    tables, boxes = [], []
    for world, one in {result["world"]: result for result in results}.items():
        places = np.mean([result["places"] for result in results if result["world"] == world])
        caption = (
            f"{world}: {one['about']}; food grows in a patch of about {places:.0f} places, which moves with every"
            " season. Bands: Student's 95 % intervals over seeds."
        )
        alt = f"Food eaten in 100 steps in {world} against time, a line a prior; the numbers are in the tables."
        boxes.append(FigureBox(live_figure(frame, world, one["period"]), caption, alt, world))
        world_gaps = gaps[gaps["world"] == world]
        tables.append(live_table(rows[rows["world"] == world], world_gaps))
        if len(world_gaps):
            names = NAMES | {"against": "against"}
            tables.append(runs.difference_table(world_gaps, f"{world}: differences", names, "food eaten in 100 steps"))
    if len(across):
        tables.append(runs.across_table(across, NAMES, "agent", "random", "food eaten, % of the oracle's", 100))
    lead = runs.significance(gaps, "Food eaten in 100 steps")
    sections = [Section("Food eaten against time", figures=boxes), Section("Tables", tables=tables)]
    return Document(
        "Online learning",
        lead,
        sections,
        {"rows": rows, "paired": gaps, "across": across},
        settings,
        command,
        {"words": [lead]},
    )


def live_frame(results: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """A row a world, seed and condition: the rewards in 100 steps.

    `reward` in the whole run, `after` and `late`: in the first and the last quarter of all seasons but the first; NaN
    where there is but one season.
    """
    frame = runs.frame_of(results)
    rewards = 100 * np.array(frame["rewards"].tolist()).reshape(len(frame), -1, PARTS)
    quarters = {"reward": rewards, "after": rewards[:, 1:, : PARTS // 4], "late": rewards[:, 1:, -PARTS // 4 :]}
    means = {name: values.mean((1, 2)) if values.size else np.nan for name, values in quarters.items()}
    return frame.rename(columns={"warm": "warm_start"}).assign(**means)


def live_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """Rewards in 100 steps, a row a world and condition: `reward` with its interval over seeds, `after` and `late`.

    `oracle_share`: the reward in shares of the oracle's reward.
    """
    rows = runs.seed_means(frame, ["world", *CONDITION], "reward", ["after", "late", "model_steps", "seconds"])
    best = rows[rows["prior"] == "oracle"].set_index("world")["reward"].clip(lower=1e-12)
    return rows.assign(oracle_share=rows["reward"] / rows["world"].map(best))


def live_pairs(frame: pd.DataFrame) -> pd.DataFrame:
    """The rewards that are compared, a row a world, seed and comparison: `first` of a condition, `second` of another.

    What has learned, before or online, `against` random plans; learning online against having learned before; and a
    warm start against none.
    """
    place = ["world", "seed", *CONDITION]
    warm, learns = frame["warm_start"], frame["learns"]
    random = dict(zip(CONDITION, RANDOM, strict=True))
    parts = []
    for against, asked, changed in (
        ("learned before", warm & (learns == "online"), {"learns": "before"}),
        ("random", warm & (learns != "never"), random),
        ("no warm start", warm, {"warm_start": False}),
    ):
        rows = frame[asked]
        other = rows[place].assign(**changed).merge(frame[[*place, "reward"]], "left", place)["reward"]
        parts.append(rows[place].assign(against=against, first=rows["reward"], second=other.to_numpy()))
    return pd.concat(parts).dropna(subset="second").sort_index(kind="stable")


def live_table(rows: pd.DataFrame, gaps: pd.DataFrame) -> Table:
    """Rewards in one world, a row a condition."""
    against_random = gaps[gaps["against"] == "random"].assign(warm_start=True)
    rows = rows.merge(against_random[["world", *CONDITION, "p_holm"]], "left")
    columns: dict[str, Column] = {
        **NAMES,
        "learns": lambda row: row["learns"] + ("" if row["warm_start"] else ", cold"),
        "eaten": lambda row: runs.plus_minus(row, "reward") + "*" * bool(row["p_holm"] < 0.05),
        "%": lambda row: f"{100 * row['oracle_share']:,.0f}",
        "first": "after:,.1f",
        "last": "late:,.1f",
        "µs": lambda row: f"{1e6 * row['seconds']:,.0f}",
    }
    caption = (
        f"Food eaten in 100 steps; in % of the oracle's; in the first and the last quarter of the seasons after the"
        f" first; microseconds a step and agent. Cold: without a warm start, but with one plan more. The oracle knows"
        f" where all food lies, and plans {FORESIGHT} times as far; where food will grow it does not know."
        f" {runs.over_seeds(rows)} *: p < 0.05 against random plans (tested: priors that learned, with a warm start),"
        " corrected for all tests in this world."
    )
    return table(rows, columns, caption, rows["world"].iloc[0], "lllrrrrr")


@drawn
def live_figure(frame: pd.DataFrame, world: str, period: int) -> Figure:
    """Food eaten in 100 steps against time in one world, a panel a kind of prior and its context."""
    frame = frame[(frame["world"] == world) & frame["warm_start"]]
    learned = frame.loc[frame["learns"] != "never", ["prior", "context"]]
    shown = list(learned.drop_duplicates().itertuples(index=False, name=None))
    across = min(len(shown), 2)
    down = -(-len(shown) // across)
    figure, axes = panels(down, across, (WIDTH, 2.8 * down), sharey=True)
    for panel, (prior, context) in zip(axes, shown, strict=False):
        panel_rows = frame[(frame["learns"] == "never") | (frame["prior"] == prior) & (frame["context"] == context)]
        for (name, learns), lines in panel_rows.groupby(["prior", "learns"], sort=False):
            label = {RANDOM.prior: "random", ORACLE.prior: "oracle"}.get(name, f"learned {learns}")
            parts = 100 * pd.DataFrame(lines["rewards"].tolist())
            intervals = mean_intervals(parts.melt(var_name="part"), "part", "value")
            intervals["part"] = (intervals["part"].astype(float) + 0.5) * period / PARTS
            points = intervals[["part", "mean", "low", "high"]].to_numpy()
            band(panel, points, COLORS.get(name, COLORS[learns]), label, "-")
        panel.set_title(f"{prior}, context: {context}")
        panel.set_xticks(np.arange(0, len(parts.columns) // PARTS + 1) * period)
        panel.grid(axis="both")
    at_edges(axes, len(shown), across, "steps; the food moves at each line", "food in 100 steps")
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure
