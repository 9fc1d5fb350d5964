"""The other sections of the page of `python -m eval compare`: worlds, curves, plans needed, bits, drawings, tables."""

from collections.abc import Iterator, Mapping
from math import inf
from typing import Any

import numpy as np

from eval.compare import figures
from eval.compare.figures import Estimate, key_of, styles
from eval.compare.findings import Comparison, pair_table, times
from eval.compare.pairs import shown_plans
from eval.compare.rows import Rows
from neuroprior.report.figures import transition_figure
from neuroprior.report.page import FigureBox, Section, Table, breakable


def worlds_section(comparison: Comparison) -> Section:
    """What the worlds are."""
    rows = []
    for world in comparison.worlds:
        own = [cell for cell in comparison.cells if cell["world"] == world]
        numbers = (str(own[0]["length"]), f"{own[0]['num_starts']:,}", str(len(own)))
        rows.append([breakable(world), *numbers])
    caption = "actions: in a plan; starts: of each seed. What the worlds are stands below the first figures."
    table = Table(("world", "actions", "starts", "seeds"), rows, caption)
    text = [
        "Plans are learned from in training worlds and looked for in held-out ones. The share of the oracle is what a"
        " planner scores of what the best of all plans would, from the same starts; 0 is a plan of random moves where"
        " rewards can be negative, else a score of 0."
    ]
    return Section("The worlds", text, [table])


def share_section(comparison: Comparison) -> Section:
    """Curves, a figure a world."""
    return _share_section(comparison, False, "Share of the oracle against the number of plans")


def grown_section(comparison: Comparison) -> Section | None:
    """Curves of priors that have grown."""
    if not any(row["rounds"] for row in comparison.rows):
        return None
    return _share_section(comparison, True, "Share of the oracle after growth")


def _share_section(comparison: Comparison, grown: bool, title: str) -> Section:
    boxes, about = [], {cell["world"]: cell["about"] for cell in comparison.cells}
    for world in comparison.worlds:
        rows = [row for row in comparison.curves if row["world"] == world and row["sees"] == "nothing"]
        rows = [row for row in rows if bool(row["rounds"]) == grown or row["prior"] in (None, "uniform")]
        if not any(row["prior"] for row in rows):
            continue
        drawn = figures.share_figure(rows, comparison.strong(rows), comparison.style)
        last = [row for row in rows if row["num_plans"] == shown_plans(comparison.num_plans)]
        alt = f"{world}: " + ", ".join(f"{row['prior']} {100 * row['oracle_share']:.0f} %" for row in last)
        boxes.append(FigureBox(drawn, "" if grown else f"{world}: {about[world]}.", alt))
    text = [
        "Bands: 95 % bootstrap intervals over seeds. Thin lines: the other Markov chains. Dotted: the planner that"
        " tries all short plans, at a cost of its own."
    ]
    return Section(title, text, (), boxes, beside=True)


def efficiency_section(comparison: Comparison) -> Section | None:
    """How many plans are needed."""
    learned = [row for row in comparison.efficiency if row["prior"] != "uniform"]
    if not learned:
        return None
    estimates: dict[str, dict[str, Estimate]] = {}
    for row in learned:
        if row["sees"] == "nothing" and not row["rounds"]:
            low, high = row["needed_low"], row["needed_high"]
            high = row["most"] if high is None and low is not None else high
            mean = inf if row["needed"] is None else row["needed"]
            estimates.setdefault(row["world"], {})[row["prior"]] = (mean, low, high)
    most = max(row["most"] for row in learned)
    boxes = []
    if estimates:
        drawn = figures.dots_figure(estimates, comparison.style, "candidate plans needed", most)
        caption = "Plans needed for what random search finds with the most; arrow: more than that. Medians over seeds."
        boxes = [FigureBox(drawn, caption, "plans needed by each prior in each world")]
    text = [f"How many plans from a prior find as much as {most:,} random ones. The numbers are in the tables below."]
    return Section("Search efficiency", text, (), boxes)


def _efficiency_table(comparison: Comparison, world: str) -> Iterator[Table]:
    rows = [row for row in comparison.efficiency if row["world"] == world]
    if not any(row["prior"] != "uniform" for row in rows):
        return
    most = f"{rows[0]['most']:,}"
    cells = [[key_of(r).label, _needed(r), _times(r), f"{r['reached']} of {r['seeds']}"] for r in rows]
    caption = (
        f"{world}: plans needed for what {most} random ones find; medians over seeds with 95 % intervals (sign test)."
        " times fewer: than random search needs, which is less where it gains nothing by more. got there: seeds in"
        f" which the prior did with {most} plans."
    )
    yield Table(("prior", "plans needed", "times fewer", "got there"), cells, caption)


def _needed(row: Mapping[str, Any]) -> str:
    more = f"> {row['most']:,}"
    if row["needed"] is None:
        return more
    if row["needed_low"] is None:
        return times(row["needed"])
    high = more if row["needed_high"] is None else times(row["needed_high"])
    return f"{times(row['needed'])} ({times(row['needed_low'])} to {high})"


def _times(row: Mapping[str, Any]) -> str:
    if row["factor"] is None:
        return "< 1"
    if row["factor_high"] is None:
        return times(row["factor"])
    low = "< 1" if row["factor_low"] is None else times(row["factor_low"])
    return f"{times(row['factor'])} ({low} to {times(row['factor_high'])})"


def growth_section(growth: Rows) -> Section | None:
    """Curves against rounds of growth, a figure a world and what is seen; also for `python -m eval grow`."""
    if not growth:
        return None
    style, boxes = styles(row["prior"] for row in growth), []
    for world, sees in dict.fromkeys((row["world"], row["sees"]) for row in growth):
        rows = [row for row in growth if (row["world"], row["sees"]) == (world, sees)]
        last = max(row["round"] for row in rows)
        ends = {row["prior"]: row["oracle_share"] for row in rows if row["round"] == last}
        chains = [prior for prior in ends if "markov" in prior]
        strong = [prior for prior in ends if prior not in chains or prior == max(chains, key=ends.__getitem__)]
        drawn = figures.growth_figure(rows, strong, style)
        alt = f"{world}: " + ", ".join(f"{prior} {100 * share:.0f} %" for prior, share in ends.items())
        boxes.append(FigureBox(drawn, "", alt))
    number = ", ".join(f"{one:,}" for one in sorted({row["num_plans"] for row in growth}))
    text = [
        "A prior learns from all short plans that were tried, plans longer, learns from those plans, and so on. Below"
        " the axis: the round, and the number of actions in its plans, each against the best plans of as many actions.",
        f"{number} candidate plans, sampled at the temperature that serves best in the training worlds. Bands: 95 %"
        " bootstrap intervals over seeds; thin lines: the other Markov chains.",
    ]
    return Section("Growing the horizon", text, (), boxes, beside=True)


def bits_section(comparison: Comparison) -> Section | None:
    """What held-out plans cost."""
    rows = [row for row in comparison.bits if not row["rounds"]]
    if not rows:
        return None
    boxes = []
    for world in dict.fromkeys(row["world"] for row in rows):
        own = [row for row in rows if row["world"] == world and row["prior"] != "uniform"]
        if own:
            alt = f"{world}: " + ", ".join(f"{key_of(r).label} {r['bits_per_action']:.3f}" for r in own)
            boxes.append(FigureBox((figures.bits_figure(own, comparison.style)), "", alt))
    text = [
        "What the held-out plans of the planner that tries all short ones cost under each prior: the fewer bits, the"
        " more of their structure it holds. Hollow: sees nothing; filled, below: sees the start, or each step. The"
        " numbers are in the tables below."
    ]
    return Section("Bits per action of held-out plans", text, (), boxes, beside=True)


def _bits_table(comparison: Comparison, world: str) -> Iterator[Table]:
    rows = [row for row in comparison.bits if row["world"] == world and not row["rounds"]]
    if rows:
        cells = [[key_of(row).label, plus_minus(row, "bits_per_action", 1, 3), _more(row)] for row in rows]
        caption = f"{world}: bits per held-out action; more: than the best Markov chain that sees as much, paired."
        yield Table(("prior", "bits per action", "more"), cells, caption)


def _more(row: Mapping[str, Any]) -> str:
    if row["more"] is None:
        return ""
    half = max(row["more_high"] - row["more"], row["more"] - row["more_low"])
    return f"{row['more']:+.3f} ±{half:.3f}"


def plus_minus(row: Mapping[str, Any], name: str, factor: float, digits: int) -> str:
    """A mean with the longer side of its interval."""
    if row["low"] is None:
        return f"{factor * row[name]:.{digits}f}"
    half = factor * max(row["high"] - row[name], row[name] - row["low"])
    return f"{factor * row[name]:.{digits}f} ±{half:.{digits}f}"


def plans_section(comparison: Comparison) -> Section | None:
    """Plans drawn in the worlds."""
    boxes = []
    for cell in comparison.cells:
        for prior in (cell.get("plans") or {"paths": ()})["paths"]:
            title = f"{cell['world']}: {prior}"
            drawn = figures.plans_figure(cell["plans"], prior, comparison.style[prior][0], title)
            boxes.append(FigureBox(drawn, "", f"plans of {prior} in {cell['world']}"))
    if not boxes:
        return None
    text = [
        "Candidate plans of some priors from one start, as they are after the last round. Square: the start; dots:"
        " where plans end; green: rewards; grey: walls."
    ]
    return Section("Plans drawn in the worlds", text, (), boxes, beside=True)


def transition_section(comparison: Comparison) -> Section | None:
    """What follows what in plans sampled from the priors: the best chain drawn, and all that are no chains."""
    boxes = []
    for world in comparison.worlds:
        own = [cell for cell in comparison.cells if cell["world"] == world and cell.get("transitions")]
        rows = [r for r in comparison.rows if r["world"] == world and r["prior"] and r["sees"] == "nothing"]
        strong = comparison.strong(rows)
        for prior in own[0]["transitions"] if own else ():
            if prior in strong and prior != "uniform":
                matrices = np.array([cell["transitions"][prior] for cell in own if prior in cell["transitions"]])
                sums = matrices.sum(2, keepdims=True)
                # What never came has a row of zeros in its seed: nothing was seen to follow it.
                seen = (sums > 0).sum(0)
                mean = np.divide(matrices.sum(0), seen, out=np.full(matrices.shape[1:], np.nan), where=seen > 0)
                names = own[0]["action_names"] or [str(action) for action in range(len(mean))]
                drawn = transition_figure(mean, names, f"{world}: {prior}", small=True)
                boxes.append(FigureBox(drawn, "", f"transition matrix of {prior} in {world}"))
    if not boxes:
        return None
    text = ["How often each action follows each in plans from a prior as it is after the last round: means over seeds."]
    return Section("What follows what", text, (), boxes, beside=True)


def world_tables(comparison: Comparison) -> dict[str, list[Table]]:
    """Of each world: shares of the oracle and their differences, plans needed, bits, starts at the oracle and times."""
    made = (_share_table, pair_table, _efficiency_table, _bits_table, _oracle_table)
    return {world: [table for make in made for table in make(comparison, world)] for world in comparison.worlds}


def _share_table(comparison: Comparison, world: str) -> Iterator[Table]:
    caption = f"{world}: share of the oracle, %, by candidate plans. ±: the longer side of the 95 % interval."
    for row in comparison.rows:
        if row["world"] == world and row["num_plans"] is None:
            share = plus_minus(row, "oracle_share", 100, 1)
            caption += f" {row['planner'].capitalize()}, {row['model_steps']:,} model steps: {share}."
    own = _by_prior(comparison, world)
    cells = [[name, *(plus_minus(some[n], "oracle_share", 100, 1) for n in sorted(some))] for name, some in own.items()]
    yield Table(("prior", *(f"{number:,}" for number in comparison.num_plans)), cells, caption)


def _oracle_table(comparison: Comparison, world: str) -> Iterator[Table]:
    shown = shown_plans(comparison.num_plans)
    cells = [
        [name, *(f"{100 * own[n]['at_oracle']:.1f}" for n in sorted(own)), _milliseconds(own[shown])]
        for name, own in _by_prior(comparison, world).items()
    ]
    caption = f"{world}: starts at the oracle, %, by candidate plans; ms: for a decision with {shown:,} plans."
    yield Table(("prior", *(f"{number:,}" for number in comparison.num_plans), "ms"), cells, caption)


def _by_prior(comparison: Comparison, world: str) -> dict[str, dict[int, dict[str, Any]]]:
    found: dict[str, dict[int, dict[str, Any]]] = {}
    for row in comparison.rows:
        if row["world"] == world and row["num_plans"] is not None:
            found.setdefault(key_of(row).label, {})[row["num_plans"]] = row
    return found


def _milliseconds(row: Mapping[str, Any]) -> str:
    return "" if row["seconds_per_decision"] is None else f"{1000 * row['seconds_per_decision']:.3g}"


def tables_section(comparison: Comparison) -> Section:
    """All numbers, world by world."""
    tables = [table for own in world_tables(comparison).values() for table in own]
    return Section("Tables, world by world", (), tables)
