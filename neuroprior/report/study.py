"""The report on plans: its sections, in the terminal, as CSV and JSON, and as one HTML page."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.text import Text
from torch import Tensor

from eval.paper.tables import columns, titled
from neuroprior._files import versions, write_csv, write_json
from neuroprior.analysis.comparison import Score, unit_name
from neuroprior.plans import Plans
from neuroprior.report import behaviour_sections as behaviour
from neuroprior.report import score_sections as sections
from neuroprior.report.macro_section import macro_section
from neuroprior.report.page import Page, Section, Table, write_page
from neuroprior.report.scores import Model
from neuroprior.report.statistics import describe


@dataclass(frozen=True)
class Report:
    """All that a report is made of.

    Attributes:
        plans: those whose statistics are told.
        scored: those on which models were scored.
        mask: `[N, L]` bool: their actions that count.
        models, scores, rows: what was scored, in the same order.
        reference: what the rows are compared with.
        steps: rows of the information by lag that models give.
        settings: how it was made.
        command, source: the command line, and the file.
    """

    plans: Plans
    scored: Plans
    mask: Tensor
    models: Sequence[Model]
    scores: Sequence[Score]
    rows: Sequence[dict[str, Any]]
    reference: str
    steps: Sequence[dict[str, Any]]
    settings: dict[str, Any]
    command: str = ""
    source: str = ""


@dataclass(frozen=True)
class Part:
    """A section, and the rows of the files beside the page, by name."""

    section: Section
    files: dict[str, Sequence[dict[str, Any]]]


WIDEST = 24
"""Letters in the first column beyond which it is folded."""

PARTS: list[tuple[str, Callable[[Any], Any]]] = [
    ("scores", sections.score_section),
    ("information by lag", sections.lag_section),
    ("orders", sections.order_section),
    ("calibration", sections.calibration_section),
    ("transitions", behaviour.transition_section),
    ("over-represented sequences", behaviour.motif_section),
    ("macro-actions", macro_section),
    ("generated sequences", behaviour.likeness_section),
    ("drift", behaviour.drift_section),
]
"""The sections, in order, and what to say while they are made."""


def write_report(report: Report, folder: Path, console: Console) -> None:
    """Print the tables, and write `report.html`, `results.json` and a CSV file for each table."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = []
    with console.status("") as status:
        for what, make in PARTS:
            status.update(f"{what} ...")
            part = make(report)
            if part is None:
                continue
            section, files = part
            for table in section.tables:
                console.print(printed(section.title, table))
            parts.append(Part(section, files))
    lead = sections.lead(report)
    console.print(lead, highlight=False, markup=False)
    files = {name: rows for part in parts for name, rows in part.files.items() if rows}
    for name, rows in files.items():
        write_csv(folder / f"{name}.csv", rows)
    others = {name: list(rows) for name, rows in files.items() if name != "plans"}
    results = {
        "rows": list(report.rows),
        "reference": report.reference,
        "unit": unit_name(report.scored, report.mask),
        "file": {"name": report.source} | describe(report.plans),
        "settings": report.settings,
        "versions": versions(),
    }
    write_json(folder / "results.json", results | others)
    settings = {f"file: {key}": value for key, value in describe(report.plans).items()}
    settings |= report.settings | {f"version: {name}": number for name, number in versions().items()}
    title = f"Plans in {Path(report.source).name}"
    write_page(folder / "report.html", Page(title, lead, report.command, settings, [part.section for part in parts]))
    console.print(f"report: {folder / 'report.html'}", highlight=False, markup=False, soft_wrap=True)


def printed(title: str, table: Table) -> Any:
    """A table of the page for the terminal."""
    made = titled(title)
    assert table.align is not None
    columns(made, table.headings, len(table.align) - len(table.align.lstrip("l")))
    if any(len(row[0]) > WIDEST for row in table.rows):
        made.columns[0].no_wrap, made.columns[0].overflow = False, "fold"
    for row in table.rows:
        made.add_row(*map(Text, row))  # names are no markup
    made.caption = escape(table.caption)
    return made
