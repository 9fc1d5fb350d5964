"""What growing the horizon gave: share of the oracle against rounds and length, in tables, figures and one page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from rich.console import Console

from eval.compare.rows import growth_rows
from neuroprior._files import versions, write_csv, write_json
from neuroprior.analysis.statistics import paired_difference
from neuroprior.report.document import printed
from neuroprior.report.drawing import WIDTH, band, drawn, expect_some, legend, lines, panels, short
from neuroprior.report.page import FigureBox, Page, Section, Table, write_page

Rows = Sequence[Mapping[str, Any]]


def gain_rows(cells: Rows) -> list[dict[str, Any]]:
    """What growth gave: the share of the oracle after the last round minus that before the first, at the longest plans.

    A row a world and prior, with Student's 95 % interval of the difference, which is paired over seeds: a bootstrap of
    few seeds would be too sure.
    """
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    for cell in cells:
        longest = max(one["length"] for one in cell["growth"])
        for key in dict.fromkeys((one["prior"], one["sees"]) for one in cell["growth"]):
            own = [one for one in cell["growth"] if (one["prior"], one["sees"], one["length"]) == (*key, longest)]
            share = {one["round"]: one["share"] for one in own}
            row = found.setdefault((cell["world"], *key), {"length": longest, "rounds": max(share), "gains": []})
            if min(share) < max(share):
                row["gains"].append(share[max(share)] - share[min(share)])
    kept = {key: row for key, row in found.items() if row["gains"]}
    gains = [_gain(row["gains"]) for row in kept.values()]
    names = ("world", "prior", "sees")
    return [
        dict(zip(names, key, strict=True))
        | {"length": row["length"], "rounds": row["rounds"], "gain": gain["mean"]}
        | {name: gain[name] for name in ("low", "high", "seeds")}
        for (key, row), gain in zip(kept.items(), gains, strict=True)
    ]


def _gain(gains: Sequence[float]) -> dict[str, Any]:
    """The mean gain over seeds, and its interval; a single seed has none."""
    if len(gains) < 2:
        return {"mean": gains[0], "low": None, "high": None, "seeds": 1}
    # Rounded, so that gains that are all the same are seen to be.
    mean, low, high, _ = paired_difference(np.round(gains, 12), np.zeros(len(gains)))
    return {"mean": mean, "low": low, "high": high, "seeds": len(gains)}


def words(rows: Rows, gains: Rows) -> str:
    """A line of plain words on one world: what growth gave each prior.

    No prior is picked out, which would favour the lucky ones.
    """
    at = f"{rows[0]['world']}, {rows[0]['num_plans']:,} plans of {max(row['length'] for row in rows)} actions"
    if not gains:
        return f"{at}: what growth gives is not told, as each round has plans of its own length."
    clear = [row for row in gains if row["low"] is None or not _holds_zero(row)]
    unclear = [row for row in gains if row not in clear]
    said = ["changes " + ", ".join(f"{_name(row)} by {_points(row)}" for row in clear)] if clear else []
    if unclear:
        said.append("cannot be told to change " + ", ".join(f"{_name(row)} ({_points(row)})" for row in unclear))
    intervals = _over(rows, "paired 95 % intervals over {} seeds (Student's)")
    return f"{at}: growth {', and '.join(said)}; points of the oracle, {intervals}."


def lead(gains: Rows) -> str:
    """How often growth helped, in a sentence or two."""
    about = "How much priors gain by planning with them, learning from those plans, and planning longer."
    counted = [row for row in gains if row["low"] is not None]
    if not counted:
        return about
    more, less = sum(row["low"] > 0 for row in counted), sum(row["high"] < 0 for row in counted)
    worlds = len({row["world"] for row in counted})
    told = (
        f"Of {len(counted)} cases, a prior in one of {worlds} world{'s' * (worlds > 1)}, it helped in {more} and harmed"
    )
    return f"{about} {told} in {less}, each by its own 95 % interval; in the others no change can be told."


def _holds_zero(row: Mapping[str, Any]) -> bool:
    return bool(row["low"] <= 0 <= row["high"])


def _points(row: Mapping[str, Any]) -> str:
    gain = f"{100 * row['gain']:+.1f}"
    if row["low"] is None:
        return gain
    between = f"{100 * row['low']:+.1f} to {100 * row['high']:+.1f}"
    return between if _holds_zero(row) else f"{gain} ({between})"


def _over(rows: Rows, told: str = "95 % bootstrap intervals over {} seeds") -> str:
    seeds = max(row["seeds"] for row in rows)
    return told.format(seeds) if seeds > 1 else "a single seed, so no intervals"


class View(NamedTuple):
    """A curve a prior: what is told of it, what goes across, what goes there by place, and the rows."""

    told: str
    across: str
    places: dict[int, str]
    rows: list[Mapping[str, Any]]
    by: str


def views(rows: Rows) -> list[View]:
    """How the rows of one world are looked at: round by round with the longest plans, and after the last by length.

    Where each round was looked at with plans as long as its own alone, there is one view: round by round.
    """
    longest, last = max(row["length"] for row in rows), max(row["round"] for row in rows)
    by_round = [row for row in rows if row["length"] == longest]
    by_length = [row for row in rows if row["round"] == last]
    if len({row["round"] for row in by_round}) == 1 < len({row["round"] for row in rows}):
        lengths = {row["round"]: row["length"] for row in rows}
        places = {turn: f"{turn} ({lengths[turn]})" for turn in sorted(lengths)}
        return [View("each round's own plans", "round of growth (actions in a plan)", places, list(rows), "round")]
    turns, lengths_tried = (
        sorted({row[by] for row in some}) for by, some in (("round", by_round), ("length", by_length))
    )
    return [
        View(f"plans of {longest} actions", "rounds of growth", {n: str(n) for n in turns}, by_round, "round"),
        View(f"after {last} rounds", "actions in a plan", {n: str(n) for n in lengths_tried}, by_length, "length"),
    ]


@drawn
def growth_figure(rows: Rows) -> Figure:
    """Share of the oracle of one world's priors, a panel a view.

    Raises:
        ValueError: there are no rows.
    """
    expect_some("rows", rows)
    shown = views(rows)
    figure, axes = panels(1, len(shown), (WIDTH, 3.4), sharey=True)
    names = list(dict.fromkeys(_name(row) for row in rows))
    for panel, view in zip(axes, shown, strict=True):
        for name, (color, line) in zip(names, lines(names), strict=True):
            own = sorted((row for row in view.rows if _name(row) == name), key=lambda row: int(row[view.by]))
            if own:
                points = [(row[view.by], row["oracle_share"], row["low"], row["high"]) for row in own]
                band(panel, points, color, short(name, 40), line)
        panel.set_xticks(list(view.places), list(view.places.values()))
        panel.set_xlabel(view.across)
        panel.set_title(view.told)
        panel.grid(axis="y")
    axes[0].set_ylabel("share of the oracle")
    axes[0].yaxis.set_major_formatter(PercentFormatter(1))
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure


def tables(rows: Rows) -> list[Table]:
    """A table a view of one world."""
    made = []
    for view in views(rows):
        at = {(_name(row), row[view.by]): row for row in view.rows}
        names = dict.fromkeys(_name(row) for row in view.rows)
        cells = [[name, *(_told(at.get((name, place))) for place in view.places)] for name in names]
        half = "±: the wider half of " if max(row["seeds"] for row in rows) > 1 else ""
        counted = f"{rows[0]['num_plans']:,} candidates; {half}{_over(rows)}"
        caption = f"Share of the oracle, %: {view.told}, by {view.across}; {counted}."
        made.append(Table(("prior", *view.places.values()), cells, caption))
    return made


def write_report(cells: Rows, settings: Mapping[str, Any], folder: Path, console: Console, command: str) -> None:
    """Print the tables, and write `report.html`, `results.json`, `grow.csv` and `gains.csv`."""
    rows, gains = growth_rows(cells), gain_rows(cells)
    worlds = list(dict.fromkeys(row["world"] for row in rows))
    told = {world: tables([row for row in rows if row["world"] == world]) for world in worlds}
    for world, made in told.items():
        for table in made:
            console.print(printed(world, table))
    said = [words(*([row for row in some if row["world"] == world] for some in (rows, gains))) for world in worlds]
    console.print("\n".join(said), highlight=False, markup=False)
    write_csv(folder / "grow.csv", rows)
    if gains:
        write_csv(folder / "gains.csv", gains)
    results = {"rows": rows, "gains": gains, "words": said, "settings": dict(settings), "versions": versions()}
    write_json(folder / "results.json", results)
    boxes = [_box([row for row in rows if row["world"] == world], world) for world in worlds]
    sections = [
        Section("In plain words", said),
        Section("Share of the oracle against rounds and length", [], figures=boxes),
        Section("Tables", [], tables=[_named(world, table) for world, made in told.items() for table in made]),
    ]
    shown = dict(settings) | {f"version: {name}": number for name, number in versions().items()}
    write_page(folder / "report.html", Page("Growing the horizon", lead(gains), command, shown, sections))
    console.print(f"report: {folder / 'report.html'}", highlight=False, markup=False, soft_wrap=True)


def _box(rows: Rows, world: str) -> FigureBox:
    caption = (
        f"{world}: {rows[0]['num_plans']:,} candidate plans for each start; bands: 95 % bootstrap intervals over seeds."
    )
    alt = (
        f"Share of the oracle in {world} against rounds of growth and actions in a plan; the numbers are in the tables."
    )
    return FigureBox((growth_figure(rows)), caption, alt)


def _named(world: str, table: Table) -> Table:
    return Table(table.headings, table.rows, f"{world}. {table.caption}", table.align)


def _name(row: Mapping[str, Any]) -> str:
    seeing = {"nothing": "", "start": ", sees the start"}.get(row["sees"], f", sees {row['sees']}")
    return f"{row['prior']}{seeing}"


def _told(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return ""
    share = f"{100 * row['oracle_share']:.1f}"
    if row["low"] is None:
        return share
    half = max(row["high"] - row["oracle_share"], row["oracle_share"] - row["low"])
    return f"{share} ± {100 * half:.1f}"
