"""What a comparison found: in words, as differences between priors, and what seeing and growth add."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eval.compare import figures
from eval.compare.figures import Estimate, Style, key_of, styles
from eval.compare.pairs import BEST, points, question_of, shown_plans
from eval.compare.rows import Cells, Rows
from eval.compare.summary import summary_table
from neuroprior.report.page import FigureBox, Section, Table, breakable

INTERVALS = "Intervals: 95 %, over seeds, each with worlds and priors of its own."

STARRED = "±: the longer side of the interval. *: p < 0.05, corrected for all pairs of the world (Holm)."

PLAIN = ("nothing", False)
"""The question that is answered first: of priors that see nothing and have not grown."""


@dataclass(frozen=True)
class Comparison:
    """All that the page is made of: cells, and the rows that `compare_rows` and its like make of them.

    Attributes:
        cells: one a world and seed.
        num_plans: numbers of candidate plans that were asked for.
        rows, curves: shares of the oracle with these numbers, and with all there are.
        paired, words, efficiency, bits, growth, reasons: see the functions that make them.
        style: of priors in figures, by name.
    """

    cells: Cells
    num_plans: Sequence[int]
    rows: Rows
    curves: Rows
    paired: Rows
    words: Rows
    efficiency: Rows
    bits: Rows
    growth: Rows
    reasons: Rows

    @property
    def style(self) -> dict[str, Style]:
        return styles(row["prior"] for row in [*self.rows, *self.growth] if row["prior"])

    @property
    def worlds(self) -> list[str]:
        return list(dict.fromkeys(cell["world"] for cell in self.cells))

    def strong(self, rows: Rows) -> list[str]:
        """The priors of rows of one world to be drawn with a band: all but the chains that are not the best."""
        number = shown_plans(self.num_plans)
        asked = [row for row in rows if row["num_plans"] == number] or rows
        share = {row["prior"]: row["oracle_share"] for row in asked}
        chains = [row["prior"] for row in asked if key_of(row).kind == "markov"]
        best = max(chains, key=share.__getitem__, default=None)
        return [prior for prior in share if prior == best or prior not in chains]


def lead(comparison: Comparison) -> str:
    """The findings in a few sentences."""
    said = []
    for question in dict.fromkeys([PLAIN, *map(question_of, comparison.words)]):
        best = [row for row in comparison.words if (question_of(row), row["what"]) == (question, BEST)]
        if best:
            said.append(_counted(best, question, shown_plans(comparison.num_plans), again=bool(said)))
    factors: dict[str, list[float]] = {}
    for row in comparison.efficiency:
        if (row["sees"], row["rounds"] > 0) == PLAIN and row["prior"] != "uniform":
            factors.setdefault(row["world"], []).append(row["factor"] or 0.0)
    if factors:
        most = max(row["most"] for row in comparison.efficiency)
        middle = [float(np.median(own)) for own in factors.values()]
        ends = dict.fromkeys(times(end) for end in (min(middle), max(middle)))
        said.append(
            f"For what random search finds with {most:,} candidates, the middle one of the priors of each world needs"
            f" {' to '.join(ends)} times fewer."
        )
    seeds = {cell["seed"] for cell in comparison.cells}
    said.append(f"{len(seeds)} seeds." if len(seeds) > 1 else "One seed: nothing is told of chance.")
    return " ".join(said)


def _counted(best: Rows, question: tuple[str, bool], number: int, again: bool) -> str:
    """In how many worlds which kind of prior is the better; briefly where the same was said of others before."""
    better = {side: sum(row["better"] == row[side] for row in best) for side in ("first", "second")}
    rest = len(best) - sum(better.values())
    worlds = f"{len(best)} world{'s' * (len(best) > 1)}"
    if again:
        return f"The same of {_priors(question)}: {better['first']}, {better['second']} and {rest} of {worlds}."
    which = "" if question == PLAIN else f", of {_priors(question)},"
    return (
        f"With {number:,} candidate plans{which} the best neural prior is better than the best Markov chain in"
        f" {better['first']} of {worlds}, the chain is better in {better['second']}, and they cannot be told apart in"
        f" {rest}."
    )


def times(factor: float) -> str:
    """How many times, in two digits where it is less than ten."""
    return "less than 1" if factor <= 0 else f"{factor:,.0f}" if factor >= 10 else f"{factor:.2g}"


def words_section(comparison: Comparison) -> Section:
    """What is said of each world."""
    text = [*told(comparison, PLAIN)]
    if not text:
        text = ["There are no priors to be compared."]
    text.append(
        "The best prior of each kind is chosen on half of the seeds and compared on the other half, both ways, so that"
        " the choice does not favour it. Intervals and p hold whichever prior is the best of its kind: better is one"
        " that is better than every prior of the other kind (paired t-tests over seeds, corrected for the number of"
        " priors, and p for the number of worlds: Bonferroni, Holm). A number of plans in the middle was fixed for"
        " these words beforehand; other numbers are in the tables."
    )
    summary = summary_table(comparison.words, comparison.num_plans)
    tables = [*([summary] if summary else []), *_gap_tables(comparison)]
    return Section("In plain words", text, tables, _gap_boxes(comparison, PLAIN))


def told_of_others(comparison: Comparison) -> Iterator[str]:
    """The words on all further questions, each after what it is about."""
    for question in dict.fromkeys(question_of(row) for row in comparison.words):
        if question != PLAIN:
            yield f"Of {_priors(question)}:"
            yield from told(comparison, question)


def told(comparison: Comparison, question: tuple[str, bool]) -> Iterator[str]:
    """The words of all worlds on a question."""
    yield from (row["words"] for row in comparison.words if question_of(row) == question)


def _gap_boxes(comparison: Comparison, question: tuple[str, bool]) -> list[FigureBox]:
    rows = [row for row in comparison.words if question_of(row) == question and row["what"] == BEST]
    if not rows:
        return []
    number = shown_plans(comparison.num_plans)
    caption = f"Best neural minus best Markov, of {_priors(question)}: points of the oracle with {number:,} plans."
    alt = "; ".join(f"{row['world']} {points(row['difference'], True)}" for row in rows)
    drawn = figures.gap_figure(rows, ("Markov better", "neural better"))
    return [FigureBox(drawn, f"{caption} Hollow: may be chance. {INTERVALS}", alt)]


def _gap_tables(comparison: Comparison) -> list[Table]:
    numbers = comparison.num_plans
    cells: dict[str, dict[int, str]] = {}
    for row in comparison.paired:
        if (row["what"], row["sees"], row["rounds"]) == (BEST, "nothing", "0"):
            cells.setdefault(breakable(row["world"]), {})[row["num_plans"]] = _gap(row)
    rows = [[world, *(own.get(number, "") for number in numbers)] for world, own in cells.items()]
    caption = f"Best neural minus best Markov prior: points of the oracle, by candidate plans. {STARRED} {INTERVALS}"
    return [Table(("world", *(f"{number:,}" for number in numbers)), rows, caption)] if rows else []


def _gap(row: Mapping[str, Any]) -> str:
    star = "*" if row["p_holm"] is not None and row["p_holm"] < 0.05 else " "
    gap = row["difference"]
    half = "" if row["low"] is None else f" ±{100 * max(row['high'] - gap, gap - row['low']):.1f}{star}"
    return f"{100 * gap:+.1f}{half}"


def pair_table(comparison: Comparison, world: str) -> Iterator[Table]:
    """All differences of a world by number of plans."""
    numbers = comparison.num_plans
    cells: dict[str, dict[int, str]] = {}
    for row in comparison.paired:
        if row["world"] == world:
            sees = "" if row["sees"] == "nothing" else f", sees {row['sees']}"
            grown = "" if row["rounds"] == "0" else f", rounds {row['rounds']}" if "-" in row["rounds"] else ", grown"
            pair = row["first"] if row["first"] == row["second"] else f"{row['first']} - {row['second']}"
            # Which ones are the best may differ with the number of plans.
            pair = "best neural - best Markov" if row["what"] == BEST else pair
            cells.setdefault(pair + sees + grown, {})[row["num_plans"]] = _gap(row)
    if cells:
        rows = [[pair, *(own.get(number, "") for number in numbers)] for pair, own in cells.items()]
        caption = f"{world}: differences between priors, points of the oracle, by candidate plans, paired. {STARRED}"
        yield Table(("first - second", *(f"{number:,}" for number in numbers)), rows, caption)


def seeing_section(comparison: Comparison) -> Section | None:
    """What priors gain by seeing."""
    return _gain_section(comparison, "seeing minus not", "What seeing adds", lambda asked: asked[0] != "nothing")


def grown_gain_section(comparison: Comparison) -> Section | None:
    """What priors gain by growth."""
    return _gain_section(comparison, "grown minus not", "What growing the horizon adds", lambda asked: asked[1])


def _gain_section(
    comparison: Comparison, what: str, title: str, asked: Callable[[tuple[str, bool]], bool]
) -> Section | None:
    rows = [row for row in comparison.paired if row["what"] == what]
    if not rows:
        return None
    text, boxes = [], []
    for question in dict.fromkeys(question_of(row) for row in comparison.words):
        # Told once: of what has both seen and grown, where seeing is.
        if asked(question) and (question[0] == "nothing" or what.startswith("seeing")):
            text += [f"Of {_priors(question)}:", *told(comparison, question)]
            boxes += _gap_boxes(comparison, question)
    boxes = [*_gain_boxes(comparison, rows), *boxes]
    return Section(title, text, (), boxes)


def _gain_boxes(comparison: Comparison, rows: Rows) -> Iterator[FigureBox]:
    """A figure for each way to see and to have grown."""
    number = shown_plans(comparison.num_plans)
    shown: dict[tuple[str, bool], dict[str, dict[str, Estimate]]] = {}
    for row in rows:
        if row["num_plans"] == number:
            low, high = (None if row[end] is None else 100 * row[end] for end in ("low", "high"))
            estimates = shown.setdefault((row["sees"], row["rounds"] != "0"), {}).setdefault(row["world"], {})
            estimates[row["first"]] = (100 * row["difference"], low, high)
    for (sees, grown), by_world in shown.items():
        how = f"{rows[0]['what']} (sees: {sees}{', grown' * grown})".capitalize()
        drawn = figures.dots_figure(by_world, comparison.style, "points of the oracle")
        yield FigureBox(drawn, f"{how}: points of the oracle with {number:,} plans. {INTERVALS}", how)


def _priors(question: tuple[str, bool]) -> str:
    sees = "the start" if question[0] == "start" else question[0]
    return f"priors that see {sees}" + ", after growth" * question[1]
