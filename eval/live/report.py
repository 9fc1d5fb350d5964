"""The report of `python -m eval live`: rewards of agents that live in the same worlds and differ in their prior."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from eval.compare.planner_report import Findings, publish
from eval.compare.rows import Array, Cells, Rows, corrected, estimated, number_or_none
from eval.compare.sections import plus_minus
from eval.live.run import FORESIGHT, PARTS
from eval.paper.figures import save
from neuroprior.analysis.statistics import paired_difference
from neuroprior.report.drawing import WIDTH, at_edges, band, drawn, expect_some, legend, panels
from neuroprior.report.page import FigureBox, Section, Table

Place = tuple[str, str, str, str, bool]
"""World, prior, what it sees, when it learns, whether the rest of the last plan is a candidate."""

ABOUT = (
    "Learning while living",
    "Agents plan, execute, and learn from what they executed, while food is eaten and grows elsewhere: does it pay?",
)

COLORS = {"never": "#7d838c", "before": "#d9731a", "online": "#3079d8", "oracle": "#2e9e5b"}
"""Of lines, by when the prior learned."""

WHEN = {"rewards": slice(None), "after": slice(0, PARTS // 4), "late": slice(3 * PARTS // 4, None)}
"""Which parts of the seasons are told of; those after a change do not hold the first season."""


def live_rows(cells: Cells) -> Rows:
    """Rewards in 100 steps, a row a world and life, with intervals over seeds.

    `reward` (`low`, `high`) in the whole life, `after` and `late`: in the first and the last quarter of all seasons but
    the first; None where there is but one. `oracle_share`: of what the oracle was rewarded.
    """
    found, rows = _found(cells), []
    shares = estimated(np.array([_mean(entry, "rewards") for entry in own.values()]) for own in found.values())
    for (place, own), share in zip(found.items(), shares, strict=True):
        best = found[(place[0], "oracle", "everything", "never", True)]
        row = dict(zip(("world", "prior", "sees", "learns", "warm_start"), place, strict=True))
        row |= {"reward": share["mean"], "low": share["low"], "high": share["high"], "seeds": share["seeds"]}
        row |= {what: number_or_none(_whole(own, what)) for what in ("after", "late")}
        row |= {"oracle_share": _whole(own, "rewards") / max(_whole(best, "rewards"), 1e-12)}
        row |= {name: float(np.mean([entry[name] for entry in own.values()])) for name in ("model_steps", "seconds")}
        rows.append(row)
    return rows


def paired_rows(cells: Cells) -> Rows:
    """What each life is rewarded more, in 100 steps, than the same with one thing less; paired over seeds.

    What has learned, before or online, against random plans; learning online against having learned before; and a warm
    start against none. Each with its `difference`, Student's interval, `p_value`, and `p_holm`, corrected for all rows
    of the world. Nothing where there is a single seed.
    """
    found, rows = _found(cells), []
    for place, own in found.items():
        world, prior, sees, learns, warm = place
        others: list[tuple[str, Place]] = []
        if learns == "online" and warm:
            others += [("learned before", (world, prior, sees, "before", True))]
        if learns != "never" and warm:
            others += [("random", (world, "uniform", "nothing", "never", True))]
        if warm:
            others += [("no warm start", (world, prior, sees, learns, False))]
        for name, other in others:
            if other in found and len(own) > 1:
                gap = paired_difference(
                    *([_mean(entry, "rewards") for entry in side.values()] for side in (own, found[other]))
                )
                row = {"world": world, "prior": prior, "sees": sees, "learns": learns, "against": name}
                rows.append(row | {"difference": gap.mean, "low": gap.low, "high": gap.high, "p_value": gap.p_value})
    return corrected(rows)


def _found(cells: Cells) -> dict[Place, dict[int, Mapping[str, Any]]]:
    """By place and seed: the entries."""
    found: dict[Place, dict[int, Mapping[str, Any]]] = {}
    for cell in cells:
        for entry in cell["entries"]:
            place = cell["world"], entry["prior"], entry["sees"], entry["learns"], entry["warm"]
            found.setdefault(place, {})[cell["seed"]] = entry
    return found


def _mean(entry: Mapping[str, Any], what: str) -> float:
    """The mean reward in 100 steps of some parts of seasons, see `WHEN`; NaN of none."""
    seasons = np.array(entry["rewards"], dtype=np.float64).reshape(-1, PARTS)
    some = (seasons if what == "rewards" else seasons[1:])[:, WHEN[what]]
    # Rounded, so that means that are the same are seen to be.
    return round(100 * float(some.mean()), 9) if some.size else float("nan")


def _whole(own: Mapping[int, Mapping[str, Any]], what: str) -> float:
    return float(np.mean([_mean(entry, what) for entry in own.values()]))


def table(rows: Rows, gaps: Rows, world: str) -> Table:
    """Rewards in one world, a row a life."""
    own = [row for row in rows if row["world"] == world]
    cells = []
    for row in own:
        told = plus_minus(row, "reward", 1, 1)
        if any(_sure(gap) for gap in gaps if gap["against"] == "random" and _same(gap, row) and row["warm_start"]):
            told += "*"
        seasons = ["" if row[what] is None else _number(row[what], 1) for what in ("after", "late")]
        learns = row["learns"] + ("" if row["warm_start"] else ", cold")
        share = _number(100 * row["oracle_share"], 0)
        cells.append([row["prior"], row["sees"], learns, told, share, *seasons, _number(1e6 * row["seconds"], 0)])
    seeds = max(row["seeds"] for row in own)
    over = f" ±: the wider half of 95 % bootstrap intervals over {seeds} seeds." if seeds > 1 else " A single seed."
    star = " *: p < 0.05 against random (tested: what learned, with a warm start), corrected for all tests here."
    star *= any(row[3].endswith("*") for row in cells)
    caption = (
        f"{world}: food eaten in 100 steps; in % of the oracle's; in the first and the last quarter of the"
        f" seasons after the first; and microseconds a step and agent. Cold: without a warm start, but with one plan"
        f" more. The oracle knows all food that lies, and plans {FORESIGHT} times as far; what will grow it does not"
        f" know.{over}"
    )
    headings = ("prior", "sees", "learns", "eaten", "%", "first", "last", "µs")
    return Table(headings, cells, caption + star, "lllrrrrr")


def words(gaps: Rows, world: str) -> str:
    """A line of plain words on one world."""
    own = [row for row in gaps if row["world"] == world]
    if not own:
        return f"{world}: differences need several seeds."
    clear = [_told(row) for row in own if _sure(row)]
    unclear = [_told(row) for row in own if not _sure(row)]
    parts = [f"{'; '.join(clear)}: food in 100 steps"] if clear else []
    parts += [f"Not to be told apart in so many tests: {'; '.join(unclear)}"] if unclear else []
    return f"{world}: {'. '.join(parts)}."


def _told(row: Mapping[str, Any]) -> str:
    what = "random" if row["prior"] == "uniform" else f"{row['prior']}, sees {row['sees']}, learns {row['learns']}"
    between = f"{row['low']:+.1f} to {row['high']:+.1f}"
    return f"{what} against {row['against']} {row['difference']:+.1f} ({between})"


def _sure(gap: Mapping[str, Any]) -> bool:
    return bool(gap["p_holm"] < 0.05)


def _same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    return all(one[name] == other[name] for name in ("world", "prior", "sees", "learns"))


def _number(value: float, digits: int) -> str:
    return f"{value:,.{digits}f}"


@drawn
def live_figure(cells: Cells, world: str) -> Figure:
    """Food eaten in 100 steps against time in one world, a panel a kind of prior and what it sees.

    Raises:
        ValueError: there are no cells of it.
    """
    found = {place: own for place, own in _found(cells).items() if place[0] == world and place[4]}
    expect_some("cells", found)
    period = next(cell["period"] for cell in cells if cell["world"] == world)
    shared = [place for place in found if place[3] == "never"]
    pairs = list(dict.fromkeys(place[1:3] for place in found if place[3] != "never")) or [("", "")]
    across = min(len(pairs), 2)
    figure, axes = panels(-(-len(pairs) // across), across, (WIDTH, 2.8 * -(-len(pairs) // across)), sharey=True)
    for panel, pair in zip(axes, pairs, strict=False):
        for place in [*shared, *(place for place in found if place[1:3] == pair)]:
            name = {"never": "random"}.get(place[3], f"learned {place[3]}") if place[1] != "oracle" else "oracle"
            rewards = 100 * np.array([entry["rewards"] for entry in found[place].values()])
            color = COLORS["oracle" if place[1] == "oracle" else place[3]]
            band(panel, _points(rewards, period), color, name, "-")
        panel.set_title(f"{pair[0]}, sees {pair[1]}" if pair[0] else "")
        seasons = next(iter(next(iter(found.values())).values()))["rewards"]
        panel.set_xticks(np.arange(0, len(seasons) // PARTS + 1) * period)
        panel.grid(axis="both")
    at_edges(axes, len(pairs), across, "steps lived; the food moves at each line", "food in 100 steps")
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure


def _points(rewards: Array, period: int) -> list[tuple[float, float, float | None, float | None]]:
    """Place, mean, low and high of rewards `[seeds, parts]`."""
    found = estimated(rewards.T)
    width = period / PARTS
    return [((k + 0.5) * width, one["mean"], one["low"], one["high"]) for k, one in enumerate(found)]


def write_report(cells: Cells, settings: Mapping[str, Any], folder: Path, console: Console, command: str) -> None:
    """Print the tables; write `report.html`, `results.json`, `rows.csv`, `paired.csv` and a picture of each world."""
    rows, gaps = live_rows(cells), paired_rows(cells)
    about = {cell["world"]: cell for cell in cells}
    found = Findings(rows, gaps, [words(gaps, world) for world in about], {w: table(rows, gaps, w) for w in about})
    figures = Section("Food eaten against time", [], figures=[_box(cells, cell) for cell in about.values()])
    publish(found, figures, ABOUT, settings, folder, console, command)
    for world in about:
        save(live_figure(cells, world), folder / f"{world}.png")


def _box(cells: Cells, cell: Mapping[str, Any]) -> FigureBox:
    places = [one["places"] for one in cells if one["world"] == cell["world"]]
    caption = (
        f"{cell['world']}: {cell['about']}; food grows in a patch of about {np.mean(places):.0f} places, which moves"
        " with every season. Bands: 95 % bootstrap intervals over seeds."
    )
    alt = f"Food eaten in 100 steps in {cell['world']} against time, a line a prior; the numbers are in the tables."
    return FigureBox((live_figure(cells, cell["world"])), caption, alt)
