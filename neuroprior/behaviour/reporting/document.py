"""A document of results: tables and figures, printed in the terminal and written as CSV, JSON and one HTML page.

Needs pandas, matplotlib, jinja2 and rich (`neuroprior[report]`).
"""

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import networkx as nx
import pandas as pd
import rich.table
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.text import Text

from neuroprior._files import quote_frame, versions, write_json, write_whole, written_whole
from neuroprior._folders import claim
from neuroprior.behaviour.reporting.findings import Sentence
from neuroprior.behaviour.reporting.page import Section, Table, clean, write_page

Column = str | Callable[[Any], str]

FigureKind = Literal["pdf", "svg", "png"]

RESULTS, PAGE = "results.json", "report.html"
"""Files of a document, beside those of its frames."""


@dataclass(frozen=True)
class Document:
    """Results with all that it takes to show them.

    Each of `frames`, the tables of results, is written as `NAME.csv`, and as a list of rows in `results.json` under
    `NAME`, or under what `keys` has for it.

    Attributes:
        title: of the page.
        lead: the finding in one or two plain sentences.
        sections: in order; their tables are printed too.
        frames: tables of results, by name.
        settings: how the results were made, by name.
        command: the command line that makes them again.
        results: further JSON values for `results.json`.
        keys: the name in `results.json` of a frame, where it is another.
        headline: the findings as sentences, in place of a lead.
        status: what is still to come, above all else; "" where it is whole.
        graphs: by name; written as `NAME.graphml`, and as `NAME.gv` for Graphviz.

    Example:
        >>> Document(
        ...     "Chains", "Order 1 is best.", [Section("Scores", tables=[Table(["order", "bits"], [["1", "0.92"]])])]
        ... ).title
        'Chains'
    """

    title: str
    lead: str
    sections: Sequence[Section]
    frames: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    command: str = ""
    results: Mapping[str, Any] = field(default_factory=dict)
    keys: Mapping[str, str] = field(default_factory=dict)
    headline: Sequence[Sentence] = ()
    status: str = ""
    graphs: Mapping[str, nx.DiGraph] = field(default_factory=dict)

    @property
    def said(self) -> list[str]:
        """The sentences at the top."""
        return [one.sentence for one in self.headline] or [self.lead]

    @property
    def tables(self) -> dict[str, pd.DataFrame]:
        """The frames that have rows, by name."""
        return {name: frame for name, frame in self.frames.items() if len(frame)}

    @property
    def figures(self) -> dict[str, Figure]:
        """The figures by name."""
        return {box.name: box.figure for section in self.sections for box in section.figures}


def publish(document: Document, folder: Path) -> None:
    """Print a document's tables and lead, and write its files; see `write_document`.

    Args:
        document: the document.
        folder: where to write; made if it is not there.

    Raises:
        ValueError: see `write_document`.
        OSError: the files cannot be written.

    Example:
        >>> publish(Document("Chains", "Order 1 is best.", [Section("Scores")]), Path("runs/chains"))
        Order 1 is best.
        report: runs/chains/report.html
    """
    console = Console(markup=False, emoji=False)
    show(document, console)
    write_document(document, folder)
    console.print(f"report: {folder / 'report.html'}", highlight=False, markup=False, soft_wrap=True)


def show(document: Document, console: Console) -> None:
    """Print a document's tables and lead."""
    for section in document.sections:
        for table in section.tables:
            console.print(printed(table.title or section.title, table))
    show_headline(document, console)


def show_headline(document: Document, console: Console) -> None:
    """Print the sentences at the top."""
    mark = "- " if len(document.said) > 1 else ""
    for sentence in document.said:
        console.print(f"{mark}{sentence}", highlight=False, markup=False, emoji=False)


def write_document(document: Document, folder: Path) -> None:
    """Write `report.html`, `results.json` and a CSV file for each frame to a folder, which is made if it is not there.

    Results of an earlier run there are removed.

    Raises:
        ValueError: a file of one of these names is there, and no run wrote it; or another run uses the folder.
        OSError: the files cannot be written.
    """
    with claim(folder, replaces=True) as place:
        graphs = [f"{name}.{ending}" for name in document.graphs for ending in ("graphml", "gv")]
        place.add([RESULTS, PAGE, *(f"{name}.csv" for name in document.tables), *graphs])
        write_results(folder, results_of(document))
        write_frames(folder, document.frames)
        for name, graph in document.graphs.items():
            write_graph(folder / name, graph)
        shown = {**document.settings, **{f"version: {name}": number for name, number in versions().items()}}
        top = document.said
        write_page(folder / PAGE, document.title, top, document.sections, shown, document.command, document.status)


def results_of(document: Document) -> dict[str, Any]:
    """What `results.json` holds: the rows of each frame, further results, settings and versions."""
    rows = {document.keys.get(name, name): records(frame) for name, frame in document.frames.items()}
    headline = {"headline": [asdict(one) for one in document.headline]} if document.headline else {}
    entries = {**headline, **document.results, "settings": dict(document.settings), "versions": versions()}
    return {**rows, **entries}


def write_results(folder: Path, content: dict[str, Any]) -> None:
    """Write `results.json`."""
    with claim(folder) as place:
        place.add([RESULTS])
        write_json(folder / RESULTS, content)


def write_frames(folder: Path, frames: Mapping[str, pd.DataFrame]) -> None:
    """Write each frame as `NAME.csv`, but for empty ones."""
    files = {f"{name}.csv": frame for name, frame in frames.items() if len(frame)}
    with claim(folder) as place:
        place.add(files)
        for name, frame in files.items():
            with written_whole(folder / name) as file:
                quote_frame(frame).to_csv(file, index=False, lineterminator="\n")


def write_graph(path: Path, graph: nx.DiGraph) -> None:
    """Write a graph as `path` with the endings `.graphml` and `.gv` (Graphviz)."""
    with written_whole(path.with_suffix(".graphml"), "wb") as file:
        nx.write_graphml(nx.relabel_nodes(graph, clean), file)
    quoted = {name: json.dumps(clean(str(name)), ensure_ascii=False) for name in graph}
    lines = [f"  {quoted[name]};" for name in graph]
    for first, second, edge in graph.edges(data=True):
        weight = edge["weight"]
        how = f'label="{weight:.2f}", penwidth={0.5 + 5 * weight:.2f}, weight={weight:.4f}'
        lines.append(f"  {quoted[first]} -> {quoted[second]} [{how}];")
    write_whole(path.with_suffix(".gv"), "\n".join(["digraph {", *lines, "}", ""]).encode())


def write_figures(folder: Path, figures: Mapping[str, Figure], kind: FigureKind = "png") -> None:
    """Write each figure as `NAME.png`, `.pdf` or `.svg`; the folder is made if it is not there."""
    files = {f"{name}.{kind}": figure for name, figure in figures.items()}
    with claim(folder) as place:
        place.add(files)
        for name, figure in files.items():
            with written_whole(folder / name, "wb") as file, warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Glyph .* missing from font")
                figure.savefig(file, format=kind, dpi=150, bbox_inches="tight", facecolor="white")


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a frame as JSON values; what is missing is None."""
    rows = frame.astype(object).where(frame.notna(), None).to_dict("records")
    return [
        {str(key): getattr(value, "item", lambda value=value: value)() for key, value in row.items()} for row in rows
    ]


def table(
    frame: pd.DataFrame, columns: Mapping[str, Column], caption: str = "", title: str = "", align: str | None = None
) -> Table:
    """The text of a frame, as the terminal and the page show it.

    Args:
        frame: the results.
        columns: what stands below each heading: the name of a column, perhaps with a format behind a colon
            ("bits:.3f"; what is missing is left blank), or a function of the row.
        caption: what the numbers are, and what their intervals are over.
        title: above it; by default that of its section.
        align: see `Table`.

    Example:
        >>> import pandas as pd
        >>> table(
        ...     pd.DataFrame({"prior": ["uniform"], "bits": [2.0]}), {"prior": "prior", "bits per action": "bits:.2f"}
        ... ).rows
        [['uniform', '2.00']]
    """
    rows = [[_cell(row, column) for column in columns.values()] for _, row in frame.iterrows()]
    return Table(list(columns), rows, caption, align, title)


def _cell(row: Any, column: Column) -> str:
    if callable(column):
        return column(row)
    name, _, form = column.partition(":")
    value = row[name]
    return "" if pd.isna(value) else format(value, form)


def printed(title: str, table: Table) -> rich.table.Table:
    """A table for a terminal of 80 columns: names are folded where there is no room, numbers are not."""
    rich_table = rich.table.Table(
        box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), title=Text(title, "table.title")
    )
    for heading, side in zip(table.headings, table.align or "", strict=True):
        name = Text(heading, "table.header")
        rich_table.add_column(name, justify="left" if side == "l" else "right", no_wrap=side == "r", overflow="fold")
    for row in table.rows:
        rich_table.add_row(*map(Text, row))  # names are no markup
    rich_table.caption = Text(table.caption, "table.caption")
    return rich_table
