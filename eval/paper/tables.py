"""The tables that `python -m eval paper` prints."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import torch
from rich.box import SIMPLE_HEAD
from rich.table import Table

from eval.paper import second_simulation
from eval.paper.first_simulation import (
    PAPER_BEST,
    PAPER_MATRIX,
    Outcome,
    Protocol,
    Size,
    matrix_distance,
    table_distance,
)
from neuroprior.analysis.statistics import paired_difference
from neuroprior.worlds.grid import MOVES


def structure(matrix: torch.Tensor) -> dict[str, float]:
    """The mean probability of repeating a move, of each of its two turns, and of its reversal."""
    shifted = [float(torch.stack([matrix[a, (a + d) % 4] for a in range(4)]).mean()) for d in range(4)]
    return {"repeat": shifted[0], "turn": (shifted[1] + shifted[3]) / 2, "reverse": shifted[2]}


def amount_of(amount: Size) -> str:
    worlds = "1 world" if amount.worlds == 1 else f"{amount.worlds} worlds"
    return f"{worlds} x {amount.starts:,} starts, {amount.num_plans} plans of {amount.length} moves"


def table_1(title: str, rows: list[dict[str, Any]]) -> Table:
    table = titled(title)
    headings = (
        "best,\n%",
        "95 %\ninterval",
        "paper,\n%",
        "mean\nreward",
        "share of\noracle",
        "at ora-\ncle, %",
        "steps",
    )
    columns(table, ("planner", *headings), 1)
    for row in rows:
        if row["planner"] == "oracle":
            table.add_section()
        table.add_row(
            row["planner"],
            f"{100 * row['best']:.1f}",
            f"{100 * row['low']:.1f}-{100 * row['high']:.1f}",
            "" if row["paper"] is None else f"{100 * row['paper']:.1f}",
            f"{row['mean_reward']:.4f}",
            f"{row['oracle_share']:.4f}",
            f"{100 * row['at_oracle']:.1f}",
            "" if row["model_steps"] is None else f"{row['model_steps']:,}",
        )
    table.caption = "best: at least as good as each of the paper's four planners; ties count for each."
    return table


def findings(outcome: Outcome) -> Iterator[str]:
    """How the neural priors compare with the best Markov prior, world by world."""
    if outcome.scores.shape[1] < 2:
        return
    at_oracle = dict(zip(outcome.names, (outcome.scores >= outcome.oracle).double().mean(2) * 100, strict=True))
    markov = max((name for name in at_oracle if "markov" in name), key=lambda name: float(at_oracle[name].mean()))
    for name in ("gru", "transformer"):
        gap = paired_difference(at_oracle[name], at_oracle[markov])
        yield (
            f"at the oracle, {name} minus {markov}: {gap.mean:+.1f} points of the starts"
            f" ({gap.low:+.1f} to {gap.high:+.1f}), p = {gap.p_value:.1g} (paired over worlds)"
        )


def matrix_table(matrix: torch.Tensor) -> Table:
    table = titled("Transition matrix, markov-1 (in brackets: the paper's, about)")
    columns(table, ("after", *MOVES), 1)
    for a, name in enumerate(MOVES):
        table.add_row(name, *(f"{float(matrix[a, b]):.3f} ({float(PAPER_MATRIX[a, b]):.2f})" for b in range(4)))
    return table


def matrix_rows(outcome: Outcome) -> list[dict[str, Any]]:
    names = outcome.world.action_names or ()
    return [
        {"after": a, "next": b, "learned": float(outcome.transition_matrix[i, j]), "paper": float(PAPER_MATRIX[i, j])}
        for i, a in enumerate(names)
        for j, b in enumerate(names)
    ]


def protocol_row(protocol: Protocol, rows: list[dict[str, Any]], matrix: torch.Tensor) -> dict[str, Any]:
    """What one protocol gives, and how far that is from the paper."""
    shares = {str(row["planner"]): row["best"] for row in rows if row["paper"] is not None}
    distances = {"table_distance": table_distance(rows, "best"), "matrix_distance": matrix_distance(matrix)}
    return asdict(protocol) | shares | structure(matrix) | distances


def protocols_table(rows: list[dict[str, Any]], amount: str) -> Table:
    """Table 1 under every protocol."""
    table = titled(f"Table 1 under every protocol, % of starts ({amount})", gap=1)
    columns(
        table,
        ("edges", "ties", "learn from", "det.", "rand.", "m-1", "m-2", "repeat", "turn", "back", "off", "off m."),
        3,
    )
    table.caption = "off: root mean square difference from the paper's table, points; off m.: from its matrix."
    for row in rows:
        table.add_row(
            *(row[name] for name in ("edges", "ties", "learn_from")),
            *(f"{100 * row[name]:.1f}" for name in PAPER_BEST),
            *(f"{row[name]:.2f}" for name in ("repeat", "turn", "reverse")),
            f"{100 * row['table_distance']:.1f}",
            f"{row['matrix_distance']:.3f}",
        )
    table.add_row("paper", "", "", *(f"{100 * best:.1f}" for best in PAPER_BEST.values()), "0.60", "0.20", "0.00")
    return table


def scales_table(rows: list[dict[str, Any]]) -> Table:
    """Table 2 under every scale of initial values and both edges."""
    names = list(second_simulation.PAPER_REACHED)
    table = titled("Table 2 under every setting: goal reached, % of starts")
    columns(table, ("edges", "initial\nvalues", "det.", "random", "m-1", "m-2", "ceiling", "off", "95 %"), 1)
    table.caption = "off: root mean square difference from the paper's table, points (interval over value functions)."
    for row in rows:
        shares = [f"{100 * row[name]:.1f}" for name in (*names, "ceiling", "table_distance")]
        interval = f"{100 * row['low']:.1f}-{100 * row['high']:.1f}"
        table.add_row(row["edges"], f"{row['initial_scale']:g}", *shares, interval)
    table.add_row("paper", "", *(f"{100 * reached:.1f}" for reached in second_simulation.PAPER_REACHED.values()))
    return table


def table_2(task: second_simulation.Task, rows: list[dict[str, Any]], ceilings: dict[str, float]) -> Table:
    """How often each planner reached the goal."""
    what = (
        f"{task.edges}; {task.value_functions} value functions x {task.starts:,} starts, up to {task.max_plans} plans"
    )
    table = titled(f"Table 2 ({what})")
    columns(table, ("planner", "reached, %", "95 % interval", "paper, %", "steps"), 1)
    for row in rows:
        if row["planner"] == "deterministic" + second_simulation.ANY_PREFIX:
            table.add_section()
        interval = f"{100 * row['low']:.1f}-{100 * row['high']:.1f}"
        paper = "" if row["paper"] is None else f"{100 * row['paper']:.1f}"
        table.add_row(row["planner"], f"{100 * row['reached']:.1f}", interval, paper, f"{row['model_steps']:,}")
    table.add_section()
    table.add_row("ceiling", f"{100 * ceilings['ceiling']:.1f}", "", "")
    table.add_row("ceiling" + second_simulation.ANY_PREFIX, f"{100 * ceilings['ceiling_any_prefix']:.1f}", "", "")
    table.caption = (
        "reached: starts from which the goal was reached. steps: simulator steps for each plan. any prefix: plans may"
        " end after any move. ceiling: starts from which some plans of these lengths end on the goal at all."
    )
    return table


def paired_table(rows: list[dict[str, Any]]) -> Table:
    """Planners compared on the same value functions."""
    table = titled("Table 2, paired over value functions: goal reached, points")
    columns(table, ("", "minus", "gain", "95 % interval", "p"), 2)
    for row in rows:
        interval = f"{100 * row['low']:+.1f} to {100 * row['high']:+.1f}"
        first, second = (row[end].replace(second_simulation.ANY_PREFIX, ", any") for end in ("first", "second"))
        table.add_row(first, second, f"{100 * row['mean']:+.1f}", interval, f"{row['p_value']:.1g}")
    return table


def quality_table(rows: list[dict[str, Any]]) -> Table:
    """Success against the quality of the values."""
    names = [name for name in rows[0] if f"{name} low" in rows[0]]
    shorter = {"deterministic": "det.", "random": "rand.", "transformer": "trans."}
    short = [shorter.get(name, name.replace("markov", "m")) for name in names]
    table = titled("How wrong the values are, and the goal reached, % of starts")
    columns(table, ("values", "level", "qual.", *short, "ceil."), 1)
    table.caption = (
        "values: of Q-learning after so many steps; of value iteration cut short after so many sweeps; true ones"
        " averaged over tiles of that side; of a network trained for so many steps; for a goal so many cells away."
        " qual.: rank correlation with the true ones."
    )
    last = ""
    for row in rows:
        if row["kind"] != last:
            table.add_section()
        shares = (f"{100 * row[name]:.1f}" for name in (*names, "ceiling"))
        table.add_row(row["kind"] if row["kind"] != last else "", row["level"], f"{row['quality']:.2f}", *shares)
        last = row["kind"]
    return table


def titled(title: str, gap: int = 2) -> Table:
    """An empty table with `gap` spaces between columns, narrow enough for a terminal of 80."""
    return Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, gap - 1, 0, 0), title=title)


def columns(table: Table, headings: Sequence[str], left: int) -> None:
    """Columns with these headings; the first `left` of them aligned on the left, the others on the right."""
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="left" if number < left else "right", no_wrap=True)
