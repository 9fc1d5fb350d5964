"""The report of a comparison: tables in the terminal, CSV files, `results.json`, and one HTML page."""

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from rich.console import Console

from eval.compare import findings, sections
from eval.compare.efficiency import efficiency
from eval.compare.findings import PLAIN, Comparison
from eval.compare.pairs import paired, words
from eval.compare.rows import Cells, Rows, bits_rows, growth_rows, rows
from eval.compare.summary import reasons, reasons_in_words, reasons_section
from neuroprior._files import versions, write_csv, write_json
from neuroprior.report.document import printed
from neuroprior.report.page import Page, Section, write_page

Settings = Mapping[str, Any]


def compared(cells: Cells, num_plans: Sequence[int]) -> Comparison:
    """All rows of a comparison.

    Raises:
        ValueError: there are no cells, or they lack one of the numbers of plans.
    """
    if not cells:
        raise ValueError("cells: at least one is expected; without any there is nothing to compare")
    worlds = list(dict.fromkeys(cell["world"] for cell in cells))
    cells = sorted(cells, key=lambda cell: (worlds.index(cell["world"]), int(cell["seed"])))
    every = sorted({number for cell in cells for number in cell["budgets"]})
    tables = {"paired": paired(cells, sorted(num_plans)), "words": words(cells, num_plans), "bits": bits_rows(cells)}
    return Comparison(
        cells,
        sorted(num_plans),
        rows=rows(cells, sorted(num_plans)),
        curves=rows(cells, every),
        efficiency=efficiency(cells),
        growth=growth_rows(cells),
        reasons=reasons(**tables, num_plans=num_plans),
        **tables,
    )


def write_report(
    cells: Cells, num_plans: Sequence[int], settings: Settings, command: str, folder: Path, console: Console
) -> None:
    """Print the tables, and write `report.html`, `results.json` and a CSV file for each kind of row.

    The same cells and settings give the same files.

    Args:
        cells: of all worlds and seeds; worlds are reported in the order in which they come first.
        num_plans: numbers of candidate plans that were asked for.
        settings: how the cells were made, by name.
        command: the command line.
        folder: where to write.
        console: where to print.

    Raises:
        ValueError: there are no cells, or they do not belong together.
    """
    comparison = compared(cells, num_plans)
    made = [
        findings.words_section(comparison),
        reasons_section(comparison.reasons),
        sections.share_section(comparison),
        sections.efficiency_section(comparison),
        findings.seeing_section(comparison),
        findings.grown_gain_section(comparison),
        sections.grown_section(comparison),
        sections.growth_section(comparison.growth),
        sections.bits_section(comparison),
        sections.plans_section(comparison),
        sections.transition_section(comparison),
        sections.worlds_section(comparison),
        sections.tables_section(comparison),
    ]
    parts = [section for section in made if section is not None]
    _print(comparison, parts, console)
    names = ("rows", "paired", "efficiency", "bits", "words", "growth", "reasons")
    title = f"Priors compared in {', '.join(comparison.worlds)}"
    if len(comparison.worlds) > 3:
        title = f"Priors compared in {len(comparison.worlds)} worlds"
    page = Page(title, findings.lead(comparison), command, _told(settings), parts)
    _write(folder, page, {name: getattr(comparison, name) for name in names}, settings)
    console.print(f"report: {folder / 'report.html'}", highlight=False, markup=False, soft_wrap=True)


def _print(comparison: Comparison, parts: Sequence[Section], console: Console) -> None:
    """The tables of each world and those of the findings; below them the words, which are read first there."""
    for world, tables in sections.world_tables(comparison).items():
        for table in tables:
            console.print(printed(world, table))
    for table in parts[0].tables:
        console.print(printed(parts[0].title, table))
    why = reasons_in_words(comparison.reasons)
    said = findings.told(comparison, PLAIN), findings.told_of_others(comparison), why, [findings.lead(comparison)]
    for line in chain(*said):
        console.print(line, highlight=False, markup=False)


def _told(settings: Settings) -> dict[str, Any]:
    return {**settings} | {f"version: {name}": number for name, number in versions().items()}


def _write(folder: Path, page: Page, files: Mapping[str, Rows], settings: Settings) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, some in files.items():
        if some:
            write_csv(folder / f"{name}.csv", some)
    write_json(folder / "results.json", {**files, "settings": {**settings}, "versions": versions()})
    write_page(folder / "report.html", page)
