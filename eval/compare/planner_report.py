"""The report of `python -m eval compare --planners`: what planners find with the same priors, at equal model steps."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from rich.console import Console

from eval.compare.rows import Array, Cells, Rows, corrected, estimated
from eval.compare.sections import plus_minus
from neuroprior._files import versions, write_csv, write_json
from neuroprior.analysis.statistics import paired_difference
from neuroprior.report.document import printed
from neuroprior.report.drawing import WIDTH, band, drawn, expect_some, legend, lines, panels
from neuroprior.report.page import FigureBox, Page, Section, Table, write_page

PLAIN = "sampling"
"""The planner that the others are compared with."""

ABOUT = (
    "Planners compared",
    "The same priors, the same number of steps in a model of the world: what do other planners make of them?",
)

Place = tuple[str, str, str, str, int]
"""World, planner, prior, what it sees, number of plans."""


def planner_rows(cells: Cells) -> Rows:
    """The share of the oracle: a row a world, planner, prior and number of plans, with its interval over seeds."""
    found = _found(cells)
    shares = estimated(np.array([some["share"] for some in own.values()]) for own in found.values())
    return [
        _named(place)
        | {
            "model_steps": float(np.mean([some["model_steps"] for some in own.values()])),
            "oracle_share": share["mean"],
            "low": share["low"],
            "high": share["high"],
            "seconds_per_decision": float(np.mean([some["seconds"] for some in own.values()])),
            "seeds": share["seeds"],
        }
        for (place, own), share in zip(found.items(), shares, strict=True)
    ]


def paired_rows(cells: Cells, plain: str = PLAIN) -> Rows:
    """How much further than `plain` each planner comes with the same prior and as many model steps.

    A row a world, planner, prior and number of plans: the `difference` in the share of the oracle, paired over seeds,
    with Student's interval (`low`, `high`), `p_value` of the two-sided t-test, and `p_holm`, corrected for all rows of
    the world. Nothing where there is a single seed, or no `plain`.
    """
    found, rows = _found(cells), []
    for place, own in found.items():
        rival = found.get((place[0], plain, *place[2:]))
        if place[1] == plain or rival is None or len(common := [seed for seed in own if seed in rival]) < 2:
            continue
        first, second = (_shares(side, common) for side in (own, rival))
        gap = paired_difference(first, second)
        rows.append(_named(place) | {"difference": gap.mean, "low": gap.low, "high": gap.high, "p_value": gap.p_value})
    return corrected(rows)


def _found(cells: Cells) -> dict[Place, dict[int, dict[str, float]]]:
    """By place and seed: share, model steps and seconds."""
    found: dict[Place, dict[int, dict[str, float]]] = {}
    for cell in cells:
        for entry in cell["entries"]:
            for k, number in enumerate(cell["num_plans"]):
                place = cell["world"], entry["planner"], entry["prior"], entry["sees"], number
                some = {what: entry[what][k] for what in ("share", "model_steps", "seconds")}
                found.setdefault(place, {})[cell["seed"]] = some
    return found


def _named(place: Place) -> dict[str, Any]:
    return dict(zip(("world", "planner", "prior", "sees", "num_plans"), place, strict=True))


def _shares(own: Mapping[int, Mapping[str, float]], seeds: Sequence[int]) -> Array:
    return np.array([own[seed]["share"] for seed in seeds], dtype=np.float64)


def table(rows: Rows, gaps: Rows, world: str, plain: str = PLAIN) -> Table:
    """Shares of the oracle in one world, a row a prior and planner; stars where it cannot be chance."""
    own = [row for row in rows if row["world"] == world]
    numbers = _numbers(own)
    sure = {_key(row) for row in gaps if row["world"] == world and row["p_holm"] < 0.05}
    at = {_key(row): row for row in own}
    names = dict.fromkeys((row["prior"], row["sees"], row["planner"]) for row in own)
    sights = {row["sees"] for row in own if row["prior"] != "uniform"}
    seen = f" Learned priors see {next(iter(sights))}." if len(sights) == 1 else ""
    cells = []
    for name in names:
        found = [at[(*name, number)] for number in numbers]
        told = [plus_minus(row, "oracle_share", 100, 1) + "*" * (_key(row) in sure) for row in found]
        prior = _prior(found[0]) if len(sights) > 1 else name[0]
        cells.append([prior, name[2], *told, _milliseconds(found[-1])])
    seeds = max(row["seeds"] for row in own)
    over = f" ±: the wider half of 95 % bootstrap intervals over {seeds} seeds." if seeds > 1 else " A single seed."
    star = f" *: p < 0.05 against {plain} with the same prior, corrected for all of this table." if sure else ""
    length = round(max(row["model_steps"] / row["num_plans"] for row in own))
    caption = (
        f"{world}: share of the oracle, %, with so many plans of {length} model steps each, or as many steps otherwise"
        f" spent; and how long a decision takes with the most.{seen}{over}{star}"
    )
    headings = ("prior", "planner", *(f"{number:,} plans" for number in numbers), "ms")
    return Table(headings, cells, caption, "ll" + "r" * (len(numbers) + 1))


def words(rows: Rows, gaps: Rows, world: str, plain: str = PLAIN) -> str:
    """A line of plain words: what each planner adds to the best prior's samples, with the most plans."""
    own = [row for row in rows if row["world"] == world]
    most = max(row["num_plans"] for row in own)
    told = f"{world}, {most:,} plans:"
    clear, unclear = [], []
    for row in gaps:
        if row["world"] == world and row["num_plans"] == most and row["prior"] != "uniform":
            gap = f"{row['planner']} with {_prior(row)} {100 * row['difference']:+.1f}"
            interval = f"({100 * row['low']:+.1f} to {100 * row['high']:+.1f})"
            (clear if row["p_holm"] < 0.05 else unclear).append(f"{gap} {interval}")
    if not clear and not unclear:
        return f"{told} differences need several seeds, {plain}, and another planner."
    parts = [f"{', '.join(clear)} points of the oracle against {plain} with the same prior"] if clear else []
    if unclear:
        parts.append(f"cannot be told apart from {plain} in so many tests: {', '.join(unclear)}")
    return f"{told} {'; '.join(parts)}."


def _numbers(rows: Rows) -> list[int]:
    """The numbers of plans."""
    return sorted({row["num_plans"] for row in rows})


def _prior(row: Mapping[str, Any]) -> str:
    return str(row["prior"]) + ("" if row["sees"] == "nothing" else f", sees {row['sees']}")


def _milliseconds(row: Mapping[str, Any]) -> str:
    value = 1000 * row["seconds_per_decision"]
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"


def _key(row: Mapping[str, Any]) -> tuple[str, str, str, int]:
    return row["prior"], row["sees"], row["planner"], row["num_plans"]


@drawn
def planner_figure(rows: Rows) -> Figure:
    """Share of the oracle against model steps in one world, a panel a prior, a line a planner.

    Raises:
        ValueError: there are no rows.
    """
    expect_some("rows", rows)
    priors = list(dict.fromkeys(_prior(row) for row in rows))
    planners = list(dict.fromkeys(row["planner"] for row in rows))
    # Most planners spend all steps that they may.
    places = sorted({max(int(row["model_steps"]) for row in rows if row["num_plans"] == n) for n in _numbers(rows)})
    figure, axes = panels(1, len(priors), (WIDTH, 3.2), sharey=True)
    for panel, prior in zip(axes, priors, strict=True):
        for planner, (color, line) in zip(planners, lines(planners), strict=True):
            own = [row for row in rows if _prior(row) == prior and row["planner"] == planner]
            if own:
                points = [(row["model_steps"], row["oracle_share"], row["low"], row["high"]) for row in own]
                band(panel, sorted(points), color, planner, line)
        panel.set_xscale("log", base=2)
        panel.set_xticks(places, [f"{place:,}" for place in places])
        panel.set_title(prior)
        panel.set_xlabel("model steps a decision")
        panel.grid(axis="y")
    axes[0].set_ylabel("share of the oracle")
    axes[0].yaxis.set_major_formatter(PercentFormatter(1))
    legend(figure, axes[0].get_legend_handles_labels()[0])
    return figure


def write_report(
    cells: Cells,
    settings: Mapping[str, Any],
    folder: Path,
    console: Console,
    command: str,
    plain: str = PLAIN,
    about: tuple[str, str] = ABOUT,
) -> None:
    """Print the tables, and write `report.html`, `results.json`, `rows.csv` and `paired.csv`.

    Args:
        cells: what was found.
        settings, command: to tell on the page.
        folder: for the files.
        console: for the tables.
        plain: the planner that the others are compared with.
        about: the title of the page, and a line below it.
    """
    rows, gaps = planner_rows(cells), paired_rows(cells, plain)
    worlds = list(dict.fromkeys(row["world"] for row in rows))
    made = {world: table(rows, gaps, world, plain) for world in worlds}
    found = Findings(rows, gaps, [words(rows, gaps, world, plain) for world in worlds], made)
    figures = Section("Share of the oracle against model steps", [], figures=list(_boxes(rows, cells, worlds)))
    publish(found, figures, about, settings, folder, console, command)


class Findings(NamedTuple):
    """What a comparison of planners, or of agents, found.

    Attributes:
        rows, paired: of the files of that name.
        words: a line a world.
        tables: by world.
    """

    rows: Rows
    paired: Rows
    words: list[str]
    tables: Mapping[str, Table]


def publish(
    found: Findings,
    figures: Section,
    about: tuple[str, str],
    settings: Mapping[str, Any],
    folder: Path,
    console: Console,
    command: str,
) -> None:
    """Print what was found, and write it; see `write_report`."""
    for world, one in found.tables.items():
        console.print(printed(world, one))
    console.print("\n".join(found.words), highlight=False, markup=False)
    folder.mkdir(parents=True, exist_ok=True)
    for name, some in (("rows", found.rows), ("paired", found.paired)):
        if some:
            write_csv(folder / f"{name}.csv", some)
        else:
            (folder / f"{name}.csv").unlink(missing_ok=True)  # of an earlier run
    results = {"rows": found.rows, "paired": found.paired, "words": found.words}
    write_json(folder / "results.json", results | {"settings": dict(settings), "versions": versions()})
    tables = Section("Tables", [], tables=list(found.tables.values()))
    sections = [Section("In plain words", found.words), figures, tables]
    shown = dict(settings) | {f"version: {name}": number for name, number in versions().items()}
    write_page(folder / "report.html", Page(*about, command, shown, sections))
    console.print(f"report: {folder / 'report.html'}", highlight=False, markup=False, soft_wrap=True)


def _boxes(rows: Rows, cells: Cells, worlds: Sequence[str]) -> Iterator[FigureBox]:
    about = {cell["world"]: cell["about"] for cell in cells}
    for world in worlds:
        own = [row for row in rows if row["world"] == world]
        alt = f"Share of the oracle in {world} against model steps, a line a planner; the numbers are in the tables."
        caption = f"{world}: {about[world]}. Bands: 95 % bootstrap intervals over seeds."
        yield FigureBox((planner_figure(own)), caption, alt)
