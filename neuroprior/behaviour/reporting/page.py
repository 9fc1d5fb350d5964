"""A page of results that stands alone: one HTML file that holds its tables and figures and needs no network."""

import re
import unicodedata
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from neuroprior._files import write_whole

INK = "#0a0b0c"
"""Drawn with this colour, text and axes of a figure take that of the page's text, light or dark."""

PAPER = "#f3f4f5"
"""Drawn with this colour, an area of a figure takes that of the page's background."""

STYLE: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": INK,
    "axes.facecolor": "none",
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    # A narrow screen shows the left of a figure first.
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "figure.facecolor": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 10,
    "grid.alpha": 0.15,
    "grid.color": INK,
    "hatch.color": INK,
    "legend.frameon": False,
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
    # Names of ids are drawn from it: without it they would differ from run to run.
    "svg.hashsalt": "neuroprior",
    "text.color": INK,
    # A name such as "$x" is a name, not a formula.
    "text.parse_math": False,
    "xtick.color": INK,
    "xaxis.labellocation": "left",
    "ytick.color": INK,
}
"""Settings of matplotlib under which a figure for a page is made."""

_LETTER = "\u0590-\u08ff\ufb1d-\ufdff\ufe70-\ufefc\U00010800-\U00010fff\U0001e800-\U0001efff"
_CONTROL = "\u200f\u202a-\u202e\u2066-\u2069"
_WORD = rf"[^\s,;:()]*[{_LETTER}{_CONTROL}][^\s,;:()]*"

RIGHT_TO_LEFT = re.compile(rf"({_WORD}(?: +{_WORD})*)")
"""Words that are read from right to left, or say so: without isolation they reorder the numbers beside them."""

SMALLEST = 9.5
"""Height of the smallest text of a figure, CSS pixels, down to which it shrinks with the page; then its box scrolls."""


@dataclass(frozen=True)
class Table:
    """A table of text, with K columns.

    Attributes:
        headings: K of them.
        rows: the first cell of each names its row.
        caption: what the numbers are, and what their intervals go over.
        align: K letters, "l" or "r" (right, for numbers); None: the first column left, others right.
        title: above it; by default, in the terminal, that of its section.

    Raises:
        ValueError: a row, or `align`, does not have as many columns as there are headings.

    Example:
        >>> Table(["prior", "bits"], [["uniform", "2.00"]], caption="Bits per action.").rows
        [['uniform', '2.00']]
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    align: str | None = None
    title: str = ""

    def __post_init__(self) -> None:
        wide = len(self.headings)
        for number, row in enumerate(self.rows):
            if len(row) != wide:
                raise ValueError(f"`rows[{number}]` must have {wide} cells, one a heading, got {len(row)}.")
        if self.align is None:
            object.__setattr__(self, "align", "l" + "r" * (wide - 1))
        elif len(self.align) != wide or set(self.align) - set("lr"):
            raise ValueError(f"`align` must be {wide} letters l or r, got {self.align!r}.")


@dataclass(frozen=True)
class FigureBox:
    """A figure with its words.

    Attributes:
        figure: made with matplotlib's settings `STYLE`.
        caption: below it: what it shows, in which units, and what intervals go over.
        alt: what it says, for readers who cannot see it.
        name: by which programs find it.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2], [2, 1, 0]]), 3)
        >>> FigureBox(ethogram_figure(plans), "What was done.", "A row a plan, a colour an action.").caption
        'What was done.'
    """

    figure: Figure
    caption: str
    alt: str
    name: str = ""

    @cached_property
    def drawing(self) -> str:
        """The figure as `svg`, drawn once however often the page is written."""
        return svg(self.figure)


@dataclass(frozen=True)
class Section:
    """A part of a page with a line in its contents: paragraphs, then figures, then tables.

    Where `beside` is set, figures stand beside one another as far as there is room: small ones, up to 3 inches wide.
    A `folded` section shows its title alone, until a reader opens it.

    Attributes:
        title: its line in the contents.
        text: paragraphs.
        tables: in order.
        figures: in order.
        beside, folded: see above.
        files: names of the files that have its tables and figures, beside the page.

    Example:
        >>> Section("Scores", ["Two priors."], tables=[Table(["prior", "bits"], [["uniform", "2.00"]])]).title
        'Scores'
    """

    title: str
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[FigureBox] = ()
    beside: bool = False
    folded: bool = False
    files: Sequence[str] = ()


def write_page(
    path: Path,
    title: str,
    lead: Sequence[str],
    sections: Sequence[Section],
    settings: Mapping[str, Any],
    command: str = "",
    status: str = "",
) -> None:
    """Write a page as one HTML file, whole or not at all; the same page gives the same bytes.

    All text is escaped: names in a user's file may hold anything. What it shows is explained at `Document`.

    Raises:
        ValueError: the place is a directory.
        OSError: the file cannot be written.
    """
    # Autoescape for every template: the ending .j2 would not switch it on.
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        finalize=_escape,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["plain"] = lambda value: Markup.escape(clean(value))  # where there can be no elements
    drawings = [
        [_drawing(box, f"figure-{s}-{number}-") for number, box in enumerate(section.figures, 1)]
        for s, section in enumerate(sections, 1)
    ]
    page = {"title": title, "lead": lead, "sections": sections, "settings": settings, "command": command}
    page["status"] = status
    text = environment.get_template("page.html.j2").render(page=page, drawings=drawings)
    write_whole(path, text.encode())


def svg(figure: Figure) -> str:
    """A figure as an SVG element to stand inside a page: its text stays text, `INK` and `PAPER` follow the page.

    The same figure gives the same text. Figures are made with matplotlib's settings `STYLE`.
    """
    content = StringIO()
    nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
    with mpl.rc_context(STYLE), warnings.catch_warnings():
        # Text is not drawn with matplotlib's font, so that font need not have the letter.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(content, format="svg", metadata=nothing, bbox_inches="tight", pad_inches=0.03)
    text = content.getvalue()
    # Its style sheet would hold for the whole page, and its metadata name addresses.
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", text[text.index("<svg") :], flags=re.DOTALL)
    return _change_tags(_follow_page, _fit_width(text)).strip()


def clean(text: str) -> str:
    """Text in one line without characters that HTML and XML cannot hold; each becomes U+FFFD."""
    return "".join(
        "\N{REPLACEMENT CHARACTER}"
        if unicodedata.category(letter) in ("Cc", "Cs") or ord(letter) & 0xFFFE == 0xFFFE
        else letter
        for letter in " ".join(text.split())
    )


def _escape(value: Any) -> Any:
    """What stands in the page for a value of the template; what is markup already stays as it is."""
    if isinstance(value, Markup):
        return value
    text = clean(", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value))
    parts = RIGHT_TO_LEFT.split(text)  # every second one is to be isolated
    return Markup("").join(Markup("<bdi>{}</bdi>").format(piece) if k % 2 else piece for k, piece in enumerate(parts))


def _fit_width(text: str) -> str:
    """The SVG as wide as the page has room for: at most its own width, and at least what keeps its text legible."""
    width = 4 / 3 * float(re.findall(r'<svg[^>]* width="([\d.]+)pt"', text)[0])
    letters = 4 / 3 * min(map(float, re.findall(r'<text style="[^"]*font-size: ([\d.]+)px', text)), default=SMALLEST)
    least = width * min(SMALLEST / letters, 1)
    style = f"width:100%;min-width:{least:.0f}px;max-width:{width:.0f}px;height:auto;stroke-linejoin:round"
    return text.replace("<svg ", f'<svg style="{style}" ', 1)


def _follow_page(tag: str) -> str:
    """A tag with the page's colours and font."""
    tag = tag.replace(INK, "currentColor").replace(PAPER, "var(--paper, #fff)")
    return tag.replace("font-family: 'DejaVu Sans', sans-serif", "font-family: inherit")


def _drawing(box: FigureBox, prefix: str) -> Markup:
    """The SVG of a figure under ids of its own: matplotlib numbers those of every figure alike."""
    labelled = Markup('<svg role="img" aria-label="{}" ').format(clean(box.alt))
    text = _change_tags(lambda tag: re.sub(r'( id="|href="#|url\(#)', rf"\g<1>{prefix}", tag), box.drawing)
    return Markup(text.replace("<svg ", labelled, 1))


def _change_tags(change: Any, text: str) -> str:
    """Change the tags of XML and leave the text between them, in which matplotlib escapes < and >."""
    return re.sub(r"<[^>]*>", lambda match: change(match[0]), text)
