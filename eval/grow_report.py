"""What growing the horizon gave: share of the oracle against rounds and length, in tables, figures and one page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from rich.console import Console

from eval.compare_rows import estimated, growth_rows
from eval.drawing import WIDTH, band, drawn, legend, lines, panels, whole_numbers
from eval.page import FigureBox, Page, Section, Table, svg, write_page
from eval.plan_report import printed
from neuroprior.output import versions, write_csv, write_json

Rows = Sequence[Mapping[str, Any]]


def gain_rows(cells: Rows) -> list[dict[str, Any]]:
    """What growth gave: the share of the oracle after the last round minus that before the first, at the longest plans.

    A row a world and prior, with 95 % bootstrap intervals of the difference, which is paired over seeds.
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
    gains = estimated(np.array(row["gains"]) for row in kept.values())
    names = ("world", "prior", "sees")
    return [
        dict(zip(names, key, strict=True))
        | {"length": row["length"], "rounds": row["rounds"], "gain": gain["mean"]}
        | {name: gain[name] for name in ("low", "high", "seeds")}
        for (key, row), gain in zip(kept.items(), gains, strict=True)
    ]


def words(rows: Rows, gains: Rows, world: str) -> str:
    """A line of plain words: what growth gave each prior. No prior is picked out, which would favour the lucky ones."""
    own = [row for row in rows if row["world"] == world]
    longest = max(row["length"] for row in own)
    said = f"{world}, {own[0]['num_plans']:,} plans of {longest} actions: in points of the oracle, growth "
    told = [_gained(row) for row in gains if row["world"] == world]
    return said + ("was not tried" if not told else ", ".join(told)) + f" ({_over(own)})."


def _gained(row: Mapping[str, Any]) -> str:
    if row["low"] is None:
        return f"changes {_name(row)} by {100 * row['gain']:+.1f}"
    between = f"({100 * row['low']:+.1f} to {100 * row['high']:+.1f})"
    if row["low"] <= 0 <= row["high"]:
        return f"cannot be told to change {_name(row)} {between}"
    return f"changes {_name(row)} by {100 * row['gain']:+.1f} {between}"


def _over(rows: Rows) -> str:
    seeds = max(row["seeds"] for row in rows)
    return f"95 % bootstrap intervals over {seeds} seeds" if seeds > 1 else "intervals, which one seed does not have"


@drawn
def growth_figure(rows: Rows) -> Figure:
    """Share of the oracle of one world: at the longest plans round by round, and after the last round by length."""
    figure, axes = panels(1, 2, (WIDTH, 3.4), sharey=True)
    names = list(dict.fromkeys(_name(row) for row in rows))
    longest, last = max(row["length"] for row in rows), max(row["round"] for row in rows)
    for name, (color, line) in zip(names, lines(names), strict=True):
        own = [row for row in rows if _name(row) == name]
        for place, by, other, held in ((0, "round", "length", longest), (1, "length", "round", last)):
            curve = sorted((row for row in own if row[other] == held), key=lambda row: int(row[by]))
            points = [(row[by], row["oracle_share"], row["low"], row["high"]) for row in curve]
            if points:
                band(axes[place], points, color, name, line)
    whole_numbers(axes[0], "rounds of growth", "share of the oracle")
    whole_numbers(axes[1], "actions in a plan", "")
    axes[0].set_title(f"plans of {longest} actions")
    axes[1].set_title(f"after round {last}")
    axes[0].yaxis.set_major_formatter(PercentFormatter(1))
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure


def tables(rows: Rows, world: str) -> list[Table]:
    """Two tables of a world: by round at the longest plans, and by length after the last round."""
    own = [row for row in rows if row["world"] == world]
    longest, last = max(row["length"] for row in own), max(row["round"] for row in own)
    made = []
    for by, other, held, told in (
        ("round", "length", longest, f"plans of {longest} actions, by rounds of growth"),
        ("length", "round", last, f"after {last} rounds, by actions in a plan"),
    ):
        some = [row for row in own if row[other] == held]
        places = sorted({row[by] for row in some})
        at = {(_name(row), row[by]): row for row in some}
        cells = [
            [name, *(_told(at.get((name, place))) for place in places)]
            for name in dict.fromkeys(_name(row) for row in some)
        ]
        caption = (
            f"Share of the oracle, %: {told}; {some[0]['num_plans']:,} candidates. ±: the wider half of {_over(own)}."
        )
        made.append(Table(("prior", *map(str, places)), cells, caption))
    return made


def write_report(cells: Rows, settings: Mapping[str, Any], folder: Path, console: Console, command: str) -> None:
    """Print the tables, and write `report.html`, `results.json`, `grow.csv` and `gains.csv`."""
    rows, gains = growth_rows(cells), gain_rows(cells)
    worlds = list(dict.fromkeys(row["world"] for row in rows))
    told = {world: tables(rows, world) for world in worlds}
    for world, made in told.items():
        for table in made:
            console.print(printed(world, table))
    said = [words(rows, gains, world) for world in worlds]
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
    lead = "How much priors gain by planning with them, learning from those plans, and planning longer. " + said[0]
    shown = dict(settings) | {f"version: {name}": number for name, number in versions().items()}
    write_page(folder / "report.html", Page("Growing the horizon", lead, command, shown, sections))
    console.print(f"report: {folder / 'report.html'}", highlight=False, markup=False, soft_wrap=True)


def _box(rows: Rows, world: str) -> FigureBox:
    caption = (
        f"{world}: {rows[0]['num_plans']:,} candidate plans for each start; bands: 95 % bootstrap intervals over seeds."
    )
    alt = (
        f"Share of the oracle in {world} against rounds of growth and actions in a plan; the numbers are in the tables."
    )
    return FigureBox(svg(growth_figure(rows)), caption, alt)


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
