"""`python -m eval mice`: do priors that learned from mice in a maze help a planner to find the water there?"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import pandas as pd
from jsonargparse.typing import NonNegativeInt, PositiveInt
from rich.console import Console

from eval.mice import figures
from eval.mice.experiment import (
    NEURAL,
    PRIORS,
    SOURCES,
    UNIFORM,
    MiceSettings,
    PriorName,
    paired_table,
    reached_table,
    simulate,
)
from eval.worlds.labyrinth import DATA, NODES, check_fits
from eval.worlds.runs import check_distinct, plus_minus, table_by
from neuroprior import read_plans
from neuroprior._folders import claim_out
from neuroprior._jobs import Progress
from neuroprior.behaviour.reporting.document import (
    Column,
    Document,
    results_of,
    show,
    table,
    write_figures,
    write_frames,
    write_results,
)
from neuroprior.behaviour.reporting.page import Section, Table
from neuroprior.worlds import labyrinth


@claim_out
def mice(
    seeds: PositiveInt = 3,
    starts: PositiveInt = 126,
    num_plans: Sequence[PositiveInt] = (16, 64, 256, 1024),
    lengths: Sequence[PositiveInt] = (8, 12, 16),
    training_plans: PositiveInt = 4000,
    steps: PositiveInt = 300,
    seed: NonNegativeInt = 0,
    out: str = "runs/mice-planner",
) -> None:
    """Do priors that learned from mice in a maze help a planner to find the water there?

    Priors learn from ten mice's moves in a labyrinth, and from what planners without a prior chose there. Then planners
    draw candidate plans from each prior, at every node. Prints tables; writes them (CSV), results.json and figures
    (PNG) to a folder.

    Args:
        seeds: repeats, each with neural priors trained anew and new candidates; intervals are over them.
        starts: nodes to plan from: of the 126 without water so many are drawn in each repeat.
        num_plans: numbers of candidate plans.
        lengths: moves in a plan.
        training_plans: starts from which each of the two planners without a prior collects plans to learn from.
        steps: of training of each neural prior, at most.
        seed: of everything random.
        out: folder to write to.
    """
    if seeds < 2:
        raise ValueError(f"`seeds` must be at least 2, for intervals, got {seeds}")
    check_fits(starts, lengths)
    check_distinct(num_plans=num_plans, lengths=lengths)
    settings = MiceSettings(seeds, starts, tuple(num_plans), tuple(lengths), training_plans, steps, seed)
    folder, console = Path(out), Console()
    world, plans = labyrinth(absorbing=True), read_plans(DATA)
    parts = 2 + seeds * (len(NEURAL) + len(PRIORS))
    with Progress("mice", parts, parts) as progress:
        reached, priors, learned = simulate(settings, world, plans, progress.advance)
    rows, paired = reached_table(reached), paired_table(reached)
    tables = (
        _learned_table(learned),
        _reached_table(rows, settings),
        _score_table(rows, settings),
        _difference_table(paired),
    )
    document = Document(
        "Mice in a labyrinth",
        _finding(rows, settings),
        [Section("Tables", tables=tables)],
        {"mice": rows, "paired": paired, "learned": learned},
        asdict(settings),
        results={"seed": seed},
        keys={"mice": "rows"},
    )
    show(document, console)
    write_frames(folder, document.frames)
    write_results(folder, results_of(document))
    examples = {
        "random legal moves": UNIFORM,
        "the mice's Markov prior, no context": PriorName("markov", "mice", "moves"),
        "the mice's GRU, given the node": PriorName("gru", "mice", "node"),
    }
    drawn = {title: priors[name] for title, name in examples.items()}
    pictures = {
        "mice_planner": figures.reached_against_candidates(rows),
        "maze": figures.maze(plans),
        "maze_plans": figures.plans_in_maze(drawn, world, seed),
    }
    write_figures(folder, pictures)
    console.print(f"written to {folder}")


def _learned_table(learned: pd.DataFrame) -> Table:
    columns: dict[str, Column] = {"learned\nfrom": "source", "plans": "plans:,", "moves": "moves:,"}
    for heading, context in (("no context", "moves"), ("node", "node")):
        columns |= {f"order,\n{heading}": f"markov_order_{context}", f"bits,\n{heading}": f"bits_{context}:.3f"}
    sources = "; ".join(f"{name}: {text}" for name, text in SOURCES.items())
    caption = f"{sources}. order: of the Markov prior that takes the fewest bits a move for held-out plans."
    return table(learned, columns, caption, "What the priors learned from")


def _reached_table(rows: pd.DataFrame, settings: MiceSettings) -> Table:
    length = max(settings.lengths)
    longest = rows[rows.length == length]
    numbers = pd.DataFrame({"num_plans": settings.num_plans}, dtype="Int64")
    best = longest[longest.prior == "oracle"].drop(columns="num_plans").merge(numbers, how="cross")
    steps = numbers.assign(learned_from="model steps", prior="", context="")
    longest = pd.concat([longest[longest.prior != "oracle"], best])
    cells = [plus_minus(row, "reached", 100) for _, row in longest.iterrows()]
    cells += [f"{length * number:,}" for number in settings.num_plans]
    starts = "all 126 nodes" if settings.starts == NODES else f"{settings.starts} nodes, drawn anew in each"
    caption = (
        f"±: 95 % interval over {settings.seeds} repeats from {starts}: neural priors trained anew, new candidates;"
        " what they learn from is the same. context: what a prior predicts from beside its own moves."
    )
    title = f"Water reached, % of the nodes: plans of {length} moves, by candidates"
    return _table_by_prior(pd.concat([longest, steps]), "num_plans", cells, title, caption)


def _score_table(rows: pd.DataFrame, settings: MiceSettings) -> Table:
    number = sorted(settings.num_plans)[len(settings.num_plans) // 2]
    chosen = rows[rows.num_plans == number]
    best = rows[rows.prior == "oracle"].assign(learned_from="oracle, % of the nodes", prior="")
    shares = [*chosen.oracle_share, *best.reached]
    cells = ["" if pd.isna(share) else f"{100 * share:.1f}" for share in shares]
    title = f"Normalised score (% of what the oracle reaches): {number:,} candidates, by moves in a plan"
    return _table_by_prior(pd.concat([chosen, best]), "length", cells, title)


def _difference_table(paired: pd.DataFrame) -> Table:
    length, numbers = paired.length.max(), sorted(paired.num_plans.unique())[:3]
    chosen = paired[(paired.length == length) & paired.num_plans.isin(numbers)]
    cells = [plus_minus(row, "difference", 100, sign="+") for _, row in chosen.iterrows()]
    caption = "±: 95 % interval, paired over repeats; more in paired.csv"
    return _table_by_prior(
        chosen, "num_plans", cells, f"Differences in points: plans of {length} moves, by candidates", caption
    )


def _finding(rows: pd.DataFrame, settings: MiceSettings) -> str:
    """How many candidates of the mice's priors are worth as much as the most random ones."""
    most, longest = max(settings.num_plans), rows[rows.length == max(settings.lengths)]
    random = longest[(longest.prior == "uniform") & (longest.num_plans == most)].reached.iloc[0]
    enough = longest[(longest.learned_from == "mice") & (longest.reached >= random)].groupby("context").num_plans.min()
    need = {name: f"{enough[name]:,}" if name in enough else f"more than {most:,}" for name in ("moves", "node")}
    return (
        f"What {most:,} random candidates reach, the mice's best prior reaches with {need['moves']} without context and"
        f" {need['node']} given the node."
    )


def _table_by_prior(rows: pd.DataFrame, by: str, cells: Sequence[str], title: str, caption: str = "") -> Table:
    """A row a prior (or a pair of them) and a column for each value of `by`."""
    context, prior = rows.context.str.replace("moves", "none"), rows.prior.str.replace("transformer", "transf.")
    names = {"learned from": "learned_from", "prior": "prior", "context": "context"}
    cells = [cell.replace(" ", "") for cell in cells]  # that names fit beside them into 80 columns
    return table_by(rows.assign(context=context, prior=prior), names, by, cells, caption, title)
