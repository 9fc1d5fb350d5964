"""`python -m eval mice`: do priors that learned from mice in a maze help a planner to find the water there?"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import pandas as pd
from jsonargparse.typing import NonNegativeInt, PositiveInt
from rich.console import Console

from eval.mice import figures
from eval.mice.experiment import NEURAL, PRIORS, SOURCES, UNIFORM, MiceSettings, PriorName, simulate
from neuroprior import read_plans
from neuroprior._files import versions, write_json
from neuroprior._jobs import Progress
from neuroprior.report.document import Column, printed, records, table, write_figures, write_frames
from neuroprior.report.page import Table
from neuroprior.worlds import labyrinth

DATA = Path(__file__).parents[1] / "data" / "labyrinth" / "plans.jsonl"
NODES, LONGEST = 126, 500
NAMES = list(PriorName._fields)


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
        raise ValueError(f"seeds: at least 2 are expected, for intervals, not {seeds}")
    for name, values, most in (("starts", [starts], NODES), ("lengths", lengths, LONGEST)):
        if max(values) > most:
            raise ValueError(f"{name}: integers from 1 to {most} are expected, not {max(values)}")
    for name, values in (("num_plans", num_plans), ("lengths", lengths)):
        if len(set(values)) < len(values):
            raise ValueError(f"{name}: each may be given once, not {' '.join(map(str, values))}")
    settings = MiceSettings(seeds, starts, tuple(num_plans), tuple(lengths), training_plans, steps, seed)
    folder, console = Path(out), Console()
    folder.mkdir(parents=True, exist_ok=True)
    world, plans = labyrinth(absorbing=True), read_plans(DATA)
    parts = 2 + seeds * (len(NEURAL) + len(PRIORS))
    with Progress("mice", parts, parts) as progress:
        result = simulate(settings, world, plans, progress.advance)
    rows, paired = result.table(), result.paired()
    tables = _learned(result.learned), _reached(rows, settings), _normalised(rows, settings)
    for each in (*tables, _differences(paired, settings)):
        console.print(printed(each.title, each))
    console.print(_finding(rows, settings), highlight=False)
    write_frames(folder, {"mice": rows, "paired": paired})
    found = {"settings": asdict(settings), "learned": records(result.learned), "versions": versions(), "seed": seed}
    write_json(folder / "results.json", {**found, "rows": records(rows), "paired": records(paired)})
    examples = {
        "random legal moves": UNIFORM,
        "the mice's Markov prior, no context": PriorName("markov", "mice", "moves"),
        "the mice's GRU, given the node": PriorName("gru", "mice", "node"),
    }
    drawn = {title: result.priors[name] for title, name in examples.items()}
    pictures = {
        "mice_planner": figures.reached_against_candidates(rows),
        "maze": figures.maze(plans),
        "maze_plans": figures.plans_in_maze(drawn, world, seed),
    }
    write_figures(folder, pictures)
    console.print(f"written to {folder}")


def _learned(learned: pd.DataFrame) -> Table:
    columns: dict[str, Column] = {"learned\nfrom": "source", "plans": "plans:,", "moves": "moves:,"}
    for context, sees in (("no context", "moves"), ("node", "node")):
        columns |= {f"order,\n{context}": f"markov_order_{sees}", f"bits,\n{context}": f"bits_{sees}:.3f"}
    sources = "; ".join(f"{name}: {text}" for name, text in SOURCES.items())
    caption = f"{sources}. order: of the Markov prior that takes the fewest bits a move for held-out plans."
    return table(learned, columns, caption, "What the priors learned from")


def _reached(rows: pd.DataFrame, settings: MiceSettings) -> Table:
    length = max(settings.lengths)
    some = rows[rows.length == length]
    everywhere = some[some.prior == "oracle"].drop(columns="num_plans").merge(_numbers(settings), how="cross")
    some = pd.concat([some[some.prior != "oracle"], everywhere])
    # One end of an interval may be cut at 0 or 1: the other shows its width.
    half = (some.high - some.reached).combine(some.reached - some.low, max)
    text = [f"{100 * mean:.1f}±{100 * width:.1f}" for mean, width in zip(some.reached, half, strict=True)]
    starts = "all 126 nodes" if settings.starts == NODES else f"{settings.starts} nodes, drawn anew in each"
    caption = (
        f"±: 95 % interval over {settings.seeds} repeats from {starts}: neural priors trained anew, new candidates;"
        " what they learn from is the same. context: what a prior predicts from beside its own moves."
    )
    title = f"Water reached, % of the nodes: plans of {length} moves, by candidates"
    steps = _numbers(settings).assign(text="", learned_from="model steps", prior="", sees="")
    steps["text"] = [f"{length * number:,}" for number in steps.num_plans]
    return _by_prior(pd.concat([some.assign(text=text), steps]), "num_plans", title, caption)


def _normalised(rows: pd.DataFrame, settings: MiceSettings) -> Table:
    number = sorted(settings.num_plans)[len(settings.num_plans) // 2]
    some = rows[rows.num_plans == number]
    text = ["" if pd.isna(share) else f"{100 * share:.1f}" for share in some.oracle_share]
    best = rows[rows.prior == "oracle"].assign(learned_from="oracle, % of the nodes", prior="")
    best["text"] = [f"{100 * share:.1f}" for share in best.reached]
    title = f"Normalised score (% of what the oracle reaches): {number:,} candidates, by moves in a plan"
    return _by_prior(pd.concat([some.assign(text=text), best]), "length", title)


def _differences(paired: pd.DataFrame, settings: MiceSettings) -> Table:
    length = max(settings.lengths)
    some = paired[(paired.length == length) & paired.num_plans.isin(sorted(settings.num_plans)[:3])]
    values = zip(some.difference, some.high, some.low, strict=True)
    text = [f"{100 * gap:+.1f}±{50 * (high - low):.1f}" for gap, high, low in values]
    caption = "±: 95 % interval, paired over repeats; more in paired.csv"
    title = f"Differences in points: plans of {length} moves, by candidates"
    return _by_prior(some.assign(text=text), "num_plans", title, caption)


def _finding(rows: pd.DataFrame, settings: MiceSettings) -> str:
    """How many candidates of the mice's priors are worth as much as the most random ones."""
    most, some = max(settings.num_plans), rows[rows.length == max(settings.lengths)]
    random = some[(some.prior == "uniform") & (some.num_plans == most)].reached.iloc[0]
    enough = some[(some.learned_from == "mice") & (some.reached >= random)].groupby("sees").num_plans.min()
    need = {sees: f"{enough[sees]:,}" if sees in enough else f"more than {most:,}" for sees in ("moves", "node")}
    return (
        f"What {most:,} random candidates reach, the mice's best prior reaches with {need['moves']} without context and"
        f" {need['node']} given the node."
    )


def _by_prior(rows: pd.DataFrame, by: str, title: str, caption: str = "") -> Table:
    """The column `text` of `rows`, a row a prior (or a pair of them) and a column for each value of `by`."""
    cells = rows.pivot(index=NAMES, columns=by, values="text").fillna("")
    cells = cells[list(dict.fromkeys(rows[by].dropna()))].rename(columns=lambda number: f"{number:,}")
    shown = rows[NAMES].drop_duplicates().merge(cells.reset_index(), on=NAMES)
    shown["context"] = shown.sees.str.replace("moves", "none")
    shown["prior"] = shown.prior.str.replace("transformer", "transf.")
    columns: dict[str, Column] = {"learned from": "learned_from", "prior": "prior", "context": "context"}
    columns |= {name: name for name in cells.columns}
    return table(shown, columns, caption, title, align="lll" + "r" * len(cells.columns))


def _numbers(settings: MiceSettings) -> pd.DataFrame:
    return pd.DataFrame({"num_plans": settings.num_plans}, dtype="Int64")
