"""`python -m eval paper`: the simulations of the paper, its figures beside ours."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

import neuroprior
from eval import figures
from eval.first_simulation import (
    PAPER_MATRIX,
    PROTOCOLS,
    Outcome,
    Protocol,
    Size,
    matrix_distance,
    rows_of,
    simulate,
    table_distance,
)
from eval.output import versions, write_csv, write_json
from neuroprior.statistics import paired_difference


def paper(
    worlds: int = 100,
    starts: int = 1000,
    training_plans: int = 20_000,
    size: int = 20,
    edges: Literal["torus", "wall"] = "torus",
    ties: Literal["uniform", "first"] = "uniform",
    learn_from: Literal["all", "shortest"] = "all",
    protocols: Literal["one", "all"] = "one",
    reward_power: float = 1.0,
    depth: int = 4,
    length: int = 8,
    num_plans: int = 256,
    seed: int = 0,
    out: str = "runs/paper",
) -> None:
    """The paper's first simulation: who finds the best plan on a grid of random rewards?

    A deterministic planner tries all plans of a small depth. Priors learn from what it chose. Then planners draw longer
    plans at random, from each prior, and are compared on the same starts. Prints a table; writes tables (CSV),
    results.json and figures (PNG) to a folder.

    Args:
        worlds: reward maps to compare in; intervals are over them. 1: one world, as the paper may have used, where the
            priors learn too; else they learn in as many other worlds.
        starts: random starts in each world.
        training_plans: starts from which the deterministic planner's plans are collected.
        size: side of the square grid.
        edges: a move off the grid comes back on the other side (torus) or stays (wall). The paper does not say.
        ties: of equally good plans the deterministic planner executes any (uniform), or the first by number (first),
            as a plain argmax would. The paper does not say.
        learn_from: all executed plans, or only the shortest: those that end as many cells away as they have moves.
        protocols: one: the protocol that edges, ties and learn_from name. all: every combination of them, with the
            Markov priors, and which is nearest to the paper.
        reward_power: rewards are uniform numbers raised to this power.
        depth: moves in a plan of the deterministic planner.
        length: moves in a plan of the others.
        num_plans: candidate plans of the others.
        seed: of everything random.
        out: folder to write to.
    """
    for name, value, least in (("worlds", worlds, 1), ("starts", starts, 2), ("training_plans", training_plans, 2)):
        if value < least:
            raise ValueError(f"{name}: at least {least} is expected, not {value}")
    settings = {name: value for name, value in locals().items() if name not in ("name", "value", "least")}
    amount = Size(worlds, starts, training_plans, size, reward_power, depth, length, num_plans, seed)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    console = Console()
    if protocols == "all":
        results = _all_protocols(amount, console, folder)
    else:
        results = _one_protocol(Protocol(edges, ties, learn_from), amount, console, folder)
    write_json(folder / "results.json", {"settings": settings, "versions": versions(), "seed": seed} | results)
    console.print(f"written to {folder}")


def _one_protocol(protocol: Protocol, amount: Size, console: Console, folder: Path) -> dict[str, Any]:
    with _progress(console, steps=11) as report:
        outcome = simulate(protocol, amount, neural=True, report=report)
    rows = rows_of(outcome)
    console.print(_table(f"Table 1 ({protocol}; {_amount(amount)})", rows))
    for line in _findings(outcome):
        console.print(line)
    console.print(_matrix_table(outcome.transition_matrix))
    write_csv(folder / "table_1.csv", rows)
    matrix = outcome.transition_matrix
    write_csv(folder / "transition_matrix.csv", _matrix_rows(outcome))
    figures.best_bars(folder / "table_1.png", rows)
    figures.matrices(folder / "transition_matrix.png", {"learned": matrix, "paper": PAPER_MATRIX})
    figures.plans_in_world(folder / "world.png", outcome)
    return {"simulation_1": {"protocol": asdict(protocol), "rows": rows, "transition_matrix": matrix.tolist()}}


def _all_protocols(amount: Size, console: Console, folder: Path) -> dict[str, Any]:
    found = []
    for number, protocol in enumerate(PROTOCOLS, 1):
        with _progress(console, steps=7, title=f"{number}/{len(PROTOCOLS)} {protocol}: ") as report:
            outcome = simulate(protocol, amount, neural=False, report=report)
        found.append((protocol, rows_of(outcome), outcome.transition_matrix))
    table = Table(title=f"Table 1 under every protocol ({_amount(amount)}); shares of starts in %")
    for heading in ("protocol", "deterministic", "random", "markov-1", "markov-2", "repeat", "turn", "reverse"):
        table.add_column(heading, justify="left" if heading == "protocol" else "right")
    table.add_column("off table", justify="right")
    table.add_column("off matrix", justify="right")
    table.caption = "off: root mean square difference from the paper's table (points) and matrix."
    flat = []
    for protocol, rows, matrix in found:
        structure = _structure(matrix)
        row: dict[str, Any] = asdict(protocol)
        row |= {str(r["planner"]): r["best"] for r in rows if r["paper"] is not None} | structure
        row |= {"table_distance": table_distance(rows), "matrix_distance": matrix_distance(matrix)}
        flat.append(row)
        shares = [f"{100 * row[name]:.1f}" for name in ("deterministic", "random", "markov-1", "markov-2")]
        table.add_row(
            str(protocol),
            *shares,
            *(f"{structure[name]:.2f}" for name in ("repeat", "turn", "reverse")),
            f"{100 * row['table_distance']:.1f}",
            f"{row['matrix_distance']:.3f}",
        )
    table.add_row("paper", "32.1", "53.7", "84.1", "84.4", "0.60", "0.20", "0.00", "", "", style="bold")
    console.print(table)
    nearest = {
        "table": min(found, key=lambda item: table_distance(item[1]))[0],
        "matrix": min(found, key=lambda item: matrix_distance(item[2]))[0],
    }
    for what, protocol in nearest.items():
        console.print(f"nearest to the paper's {what}: [bold]{protocol}[/bold]")
    write_csv(folder / "protocols.csv", flat)
    return {"protocols": flat, "nearest": {what: asdict(protocol) for what, protocol in nearest.items()}}


def _structure(matrix: torch.Tensor) -> dict[str, float]:
    """The mean probability of repeating a move, of each of its two turns, and of its reversal."""
    shifted = [float(torch.stack([matrix[a, (a + d) % 4] for a in range(4)]).mean()) for d in range(4)]
    return {"repeat": shifted[0], "turn": (shifted[1] + shifted[3]) / 2, "reverse": shifted[2]}


def _amount(amount: Size) -> str:
    worlds = "1 world" if amount.worlds == 1 else f"{amount.worlds} worlds"
    return f"{worlds} x {amount.starts:,} starts, {amount.num_plans} plans of {amount.length} moves"


def _table(title: str, rows: list[dict[str, Any]]) -> Table:
    table = Table(title=title)
    table.add_column("planner")
    for heading in ("best, %", "95 % interval", "paper, %", "mean reward", "share of oracle", "at oracle, %", "steps"):
        table.add_column(heading, justify="right")
    for row in rows:
        if row["planner"] == "oracle":
            table.add_section()
        table.add_row(
            row["planner"],
            f"{100 * row['best']:.1f}",
            f"{100 * row['low']:.1f} to {100 * row['high']:.1f}",
            "" if row["paper"] is None else f"{100 * row['paper']:.1f}",
            f"{row['mean_reward']:.4f}",
            f"{row['oracle_share']:.4f}",
            f"{100 * row['at_oracle']:.1f}",
            "" if row["model_steps"] is None else f"{row['model_steps']:,}",
        )
    table.caption = "best: at least as good as each of the paper's four planners; ties count for each."
    return table


def _findings(outcome: Outcome) -> Iterator[str]:
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


def _matrix_table(matrix: torch.Tensor) -> Table:
    names = neuroprior.worlds.grid.MOVES
    table = Table(title="Transition matrix, markov-1 (in brackets: the paper's, about)")
    table.add_column("after")
    for name in names:
        table.add_column(name, justify="right")
    for a, name in enumerate(names):
        table.add_row(name, *(f"{float(matrix[a, b]):.3f} ({float(PAPER_MATRIX[a, b]):.2f})" for b in range(4)))
    return table


def _matrix_rows(outcome: Outcome) -> list[dict[str, Any]]:
    names = outcome.world.action_names or ()
    return [
        {"after": a, "next": b, "learned": float(outcome.transition_matrix[i, j]), "paper": float(PAPER_MATRIX[i, j])}
        for i, a in enumerate(names)
        for j, b in enumerate(names)
    ]


@contextmanager
def _progress(console: Console, steps: int, title: str = "") -> Iterator[Callable[[str], None]]:
    """A progress bar; the function that it gives is told what begins."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(title, total=steps)
        begun = False

        def report(what: str) -> None:
            nonlocal begun
            progress.update(task, description=title + what, advance=1 if begun else 0)
            begun = True

        yield report
