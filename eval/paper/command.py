"""`python -m eval paper`: the simulations of the paper, its figures beside ours."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from eval.paper import figures, first_simulation, second_simulation, tables, value_quality
from eval.paper.first_simulation import PAPER_MATRIX, PROTOCOLS, Protocol, Report, Size
from eval.paper.second_simulation import Task
from neuroprior._files import versions, write_csv, write_json

SCALES = (1e-4, 0.01, 0.1, 1.0)
"""Scales of Q-learning's initial values that `--protocols all` compares."""


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
    value_functions: int = 10,
    q_steps: int = 10_000,
    initial_scale: float = 0.01,
    max_plans: int = 10,
    depth: int = 4,
    length: int = 8,
    num_plans: int = 256,
    seed: int = 0,
    out: str = "runs/paper",
) -> None:
    """The paper's two simulations: who finds the best plan on a grid, and who reaches the goal on poor values?

    A deterministic planner tries all plans of a small depth. Priors learn from what it chose. Then planners draw longer
    plans at random, from each prior, and are compared on the same starts. Prints tables; writes them (CSV),
    results.json and figures (PNG) to a folder.

    Args:
        worlds: first simulation: reward maps to compare in; intervals are over them. 1: one world, as the paper may
            have used, where the priors learn too; else they learn in as many other worlds.
        starts: random starts in each world, and for each value function.
        training_plans: about how many plans of the deterministic planner the priors learn from.
        size: side of the square grid.
        edges: a move off the grid comes back on the other side (torus) or stays (wall). The paper does not say.
        ties: first simulation: of equally good plans the deterministic planner executes any (uniform), or the first by
            number (first), as a plain argmax would. The paper does not say.
        learn_from: first simulation: all executed plans, or only the shortest, those that end as many cells away as
            they have moves.
        protocols: one: what the other options say. all: every combination of edges, ties and learn_from, and of edges
            and initial_scale (whatever those options say), with the Markov priors, and which is nearest to the paper.
        reward_power: first simulation: rewards are uniform numbers raised to this power.
        value_functions: second simulation: independent Q-learners to compare with; intervals are over them. The priors
            learn under as many others.
        q_steps: second simulation: steps that each of them learns for.
        initial_scale: second simulation: their initial values are uniform between 0 and this.
        max_plans: second simulation: plans one after another from each start.
        depth: moves in a plan of the deterministic planner.
        length: moves in a plan of the others.
        num_plans: candidate plans of the others.
        seed: of everything random.
        out: folder to write to.
    """
    settings = dict(locals())
    least = {"worlds": 1, "starts": 2, "training_plans": 2, "value_functions": 2, "max_plans": 1, "size": 2}
    least |= {"depth": 1, "length": 1, "num_plans": 1, "q_steps": 0, "initial_scale": 0}
    for name, value in least.items():
        if not value <= settings[name] < float("inf"):
            raise ValueError(f"{name}: at least {value} is expected, not {settings[name]}")
    if not 0 <= seed < 2**62:
        raise ValueError(f"seed: an integer from 0 to 2**62 - 1 is expected, not {seed}")
    amount, task = (kind(**{field.name: settings[field.name] for field in fields(kind)}) for kind in (Size, Task))
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    console = Console()
    results = {"settings": settings, "versions": versions(), "seed": seed}
    if protocols == "all":
        results |= _all_protocols(amount, console, folder) | _all_scales(task, console, folder)
        write_json(folder / "results.json", results)
    else:
        # Written after each simulation, so that the second cannot take the first along.
        results |= _first(Protocol(edges, ties, learn_from), amount, console, folder)
        write_json(folder / "results.json", results)
        results |= _second(task, console, folder)
        write_json(folder / "results.json", results)
    console.print(f"written to {folder}")


def _first(protocol: Protocol, amount: Size, console: Console, folder: Path) -> dict[str, Any]:
    with _progress(console, steps=11) as report:
        outcome = first_simulation.simulate(protocol, amount, neural=True, report=report)
    rows = first_simulation.rows_of(outcome)
    console.print(tables.table_1(f"Table 1 ({protocol}; {tables.amount_of(amount)})", rows))
    for line in tables.findings(outcome):
        console.print(line)
    matrix = outcome.transition_matrix
    console.print(tables.matrix_table(matrix))
    write_csv(folder / "table_1.csv", rows)
    write_csv(folder / "transition_matrix.csv", tables.matrix_rows(outcome))
    figures.best_bars(folder / "table_1.png", rows)
    figures.matrices(folder / "transition_matrix.png", {"learned": matrix, "paper": PAPER_MATRIX})
    figures.plans_in_world(folder / "world.png", outcome)
    return {"simulation_1": {"protocol": asdict(protocol), "rows": rows, "transition_matrix": matrix.tolist()}}


def _second(task: Task, console: Console, folder: Path) -> dict[str, Any]:
    with _progress(console, steps=4 + 14 + 5) as report:
        outcome, priors = second_simulation.simulate(task, full=True, report=report)
        quality = value_quality.measure(task, priors, report)
    rows = second_simulation.rows_of(outcome)
    ceilings = second_simulation.ceilings_of(outcome)
    paired = second_simulation.findings(outcome)
    console.print(tables.table_2(task, rows, ceilings))
    console.print(tables.paired_table(paired))
    console.print(tables.quality_table(quality))
    write_csv(folder / "table_2.csv", rows)
    write_csv(folder / "value_quality.csv", quality)
    figures.values_and_stuck(folder / "figure_1.png", outcome, task)
    figures.success_against_quality(folder / "value_quality.png", quality)
    found = {"task": asdict(task), "rows": rows, **ceilings, "paired": paired, "value_quality": quality}
    return {"simulation_2": found}


def _all_protocols(amount: Size, console: Console, folder: Path) -> dict[str, Any]:
    found = []
    with _progress(console, steps=7 * len(PROTOCOLS)) as report:
        for protocol in PROTOCOLS:
            outcome = first_simulation.simulate(protocol, amount, neural=False, report=_prefixed(report, protocol))
            found.append((protocol, first_simulation.rows_of(outcome), outcome.transition_matrix))
    flat = [tables.protocol_row(*item) for item in found]
    console.print(tables.protocols_table(flat, tables.amount_of(amount)))
    nearest = {}
    for what in ("table", "matrix"):
        best = min(flat, key=lambda row: row[f"{what}_distance"])
        nearest[what] = {name: best[name] for name in ("edges", "ties", "learn_from")}
        console.print(f"nearest to the paper's {what}: [bold]{Protocol(**nearest[what])}[/bold]")
    write_csv(folder / "protocols.csv", flat)
    return {"protocols": flat, "nearest": nearest}


def _all_scales(task: Task, console: Console, folder: Path) -> dict[str, Any]:
    flat = []
    settings = [(edges, scale) for edges in ("torus", "wall") for scale in SCALES]
    with _progress(console, steps=7 * len(settings)) as report:
        for edges, scale in settings:
            changed = Task(**(asdict(task) | {"edges": edges, "initial_scale": scale}))
            outcome, _ = second_simulation.simulate(changed, full=False, report=_prefixed(report, (edges, scale)))
            rows = second_simulation.rows_of(outcome)
            row: dict[str, Any] = {"edges": edges, "initial_scale": scale}
            row |= {r["planner"]: r["reached"] for r in rows} | second_simulation.ceilings_of(outcome)
            distance, low, high = second_simulation.distance_interval(outcome)
            flat.append(row | {"table_distance": distance, "low": low, "high": high})
    console.print(tables.scales_table(flat))
    best = min(flat, key=lambda row: row["table_distance"])
    alike = [row for row in flat if row["low"] <= best["high"]]
    console.print(
        f"nearest to the paper's Table 2: [bold]{_setting(best)}[/bold]; not told apart from it (intervals overlap): "
        + "; ".join(_setting(row) for row in alike if row is not best)
    )
    write_csv(folder / "scales.csv", flat)
    return {"scales": flat, "nearest_scale": {name: best[name] for name in ("edges", "initial_scale")}}


def _setting(row: dict[str, Any]) -> str:
    return f"{row['edges']}, values up to {row['initial_scale']:g}"


def _prefixed(report: Report, what: object) -> Report:
    return lambda text: report(f"{what}: {text}")


@contextmanager
def _progress(console: Console, steps: int) -> Iterator[Callable[[str], None]]:
    """A progress bar; the function that it gives is told what begins."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("", total=steps)
        begun = False

        def report(what: str) -> None:
            nonlocal begun
            progress.update(task, description=what, advance=1 if begun else 0)
            begun = True

        yield report
