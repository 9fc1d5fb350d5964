"""`python -m eval mice`: do priors that learned from mice in a maze help a planner to find the water there?"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from eval.mice import figures as maze_figures
from eval.mice.study import SOURCES, UNIFORM, Key, Outcome, Study, simulate
from eval.paper.tables import columns, titled
from neuroprior import labyrinth, read_plans
from neuroprior._files import versions, write_csv, write_json
from neuroprior.analysis.statistics import Interval, mean_interval, paired_difference

DATA = Path(__file__).parents[1] / "data" / "labyrinth" / "plans.jsonl"
NODES, LONGEST = 126, 500
LISTS = {"num_plans": ((16, 64, 256, 1024), "numbers of candidate plans"), "lengths": ((8, 12, 16), "moves in a plan")}
"""Options that take several numbers: their defaults, and what they are."""

PER_SIGHT = (("markov_order", "d"), ("bits", ".3f"))


def mice(
    seeds: int = 3,
    starts: int = 126,
    num_plans: Sequence[int] = LISTS["num_plans"][0],
    lengths: Sequence[int] = LISTS["lengths"][0],
    training_plans: int = 4000,
    steps: int = 300,
    seed: int = 0,
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
    study = Study(seeds, starts, tuple(num_plans), tuple(lengths), training_plans, steps, seed)
    _check(study)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    console = Console()
    world, plans = labyrinth(absorbing=True), read_plans(DATA)
    with console.status("") as status:
        outcome = simulate(study, world, plans, lambda text: status.update(text))
    rows, paired = rows_of(outcome, study), list(comparisons(outcome, study))
    for table in (_learned_table(outcome), _reached_table(rows, study), _lengths_table(rows, study)):
        console.print(table)
    console.print(_paired_table(paired, study))
    console.print(" ".join(findings(rows, paired, study)))
    write_csv(folder / "mice.csv", rows)
    write_csv(folder / "paired.csv", paired)
    found = {"settings": asdict(study), "learned": outcome.learned, "rows": rows, "paired": paired}
    write_json(folder / "results.json", found | {"versions": versions(), "seed": seed})
    maze_figures.reached_against_candidates(folder / "mice_planner.png", rows)
    maze_figures.maze(folder / "maze.png", plans)
    shown = {
        "random legal moves": UNIFORM,
        "the mice's Markov prior, sees its moves": Key("markov", "mice", "moves"),
        "the mice's GRU, sees the node": Key("gru", "mice", "node"),
    }
    examples = {name: outcome.priors[key] for name, key in shown.items()}
    maze_figures.plans_in_maze(folder / "maze_plans.png", examples, world, seed)
    console.print(f"written to {folder}")


def _check(study: Study) -> None:
    """Raise ValueError, naming the option, where a number is out of range or given twice."""
    least = {"seeds": 2, "starts": 1, "num_plans": 1, "lengths": 1, "training_plans": 2, "steps": 1, "seed": 0}
    most = {"starts": NODES, "lengths": LONGEST, "seed": 2**62 - 1}
    for name, low in least.items():
        given = getattr(study, name)
        values = given if isinstance(given, tuple) else (given,)
        shown = " ".join(map(str, values)) or "nothing"
        if not values or min(values) < low or max(values) > most.get(name, float("inf")):
            wanted = f"from {low} to {most[name]}" if name in most else f"at least {low}"
            raise ValueError(f"{name}: {wanted} is expected, not {shown}")
        if len(set(values)) < len(values):
            raise ValueError(f"{name}: each may be given once, not {shown}")


def rows_of(outcome: Outcome, study: Study) -> list[dict[str, Any]]:
    """A row a prior, length and number of candidates, with intervals over repeats; and the oracle's, a row a length."""
    rows = []
    for t, length in enumerate(study.lengths):
        best = _share(outcome.oracle[:, t])
        for key, reached in outcome.reached.items():
            for p, number in enumerate(study.num_plans):
                share = _share(reached[:, t, p])
                of_oracle = share.mean / best.mean if best.mean else None
                rows.append(_row(key, length, number, length * number, share, of_oracle))
        rows.append(_row(Key("oracle", "", ""), length, None, None, best, 1.0))
    return rows


def _row(
    key: Key, length: int, number: int | None, model_steps: int | None, share: Interval, of_oracle: float | None
) -> dict[str, Any]:
    named = key._asdict() | {"length": length, "num_plans": number, "model_steps": model_steps}
    return named | {"reached": share.mean, "low": share.low, "high": share.high, "oracle_share": of_oracle}


def _share(values: Tensor) -> Interval:
    mean, low, high = mean_interval(values)
    return Interval(mean, max(low, 0.0), min(high, 1.0))


def comparisons(outcome: Outcome, study: Study) -> Iterator[dict[str, Any]]:
    """Paired differences over repeats, a row a pair of priors, length and number of candidates."""
    for what, first, second in _pairs(list(outcome.reached)):
        for t, length in enumerate(study.lengths):
            for p, number in enumerate(study.num_plans):
                # Rounded, so that differences that are all the same are seen to be.
                gaps = (outcome.reached[first] - outcome.reached[second])[:, t, p].round(decimals=9)
                gap = paired_difference(gaps, torch.zeros_like(gaps))
                named = _difference_names(first, second) | {"what": what, "length": length, "num_plans": number}
                yield named | {"difference": gap.mean, "low": gap.low, "high": gap.high, "p_value": gap.p_value}


def _difference_names(first: Key, second: Key) -> dict[str, Any]:
    """Such as prior "gru - markov", learned_from "mice", sees "node"."""
    return {name: " - ".join(dict.fromkeys(pair)) for name, *pair in zip(Key._fields, first, second, strict=True)}


def _pairs(keys: list[Key]) -> Iterator[tuple[str, Key, Key]]:
    """Neural minus Markov, mice's minus planners', and seeing the node minus not; all else equal."""
    for key in keys:
        if key.prior in ("gru", "transformer"):
            yield "neural minus Markov", key, key._replace(prior="markov")
    for key in keys:
        others = (key._replace(learned_from=source) for source in ("planner", "reached"))
        for other in others if key.learned_from == "mice" else ():
            if other in keys:
                yield "mice's minus a planner's", key, other
    for key in keys:
        if key.sees == "node":
            yield "seeing the node minus not", key, key._replace(sees="moves")


def findings(rows: list[dict[str, Any]], paired: list[dict[str, Any]], study: Study) -> Iterator[str]:
    """What the figures say, in words, for the longest plans."""
    length, most = max(study.lengths), max(study.num_plans)
    few = sorted(study.num_plans)[min(1, len(study.num_plans) - 1)]
    some = [row for row in rows if row["length"] == length and row["num_plans"] == few]
    random = {row["num_plans"]: row for row in rows if row["prior"] == "uniform" and row["length"] == length}
    yield f"With {few} candidates of {length} moves, random legal moves find the water from {_percent(random[few])} of"
    yield "the nodes."
    for sees, told in (("moves", "its own moves alone"), ("node", "the node too")):
        own, other = (_best([row for row in some if row["sees"] == sees], from_mice) for from_mice in (True, False))
        yield f"With a prior that sees {told} it is {_percent(own)} after learning from mice ({own['prior']}) and"
        yield f"{_percent(other)} after learning from a planner ({other['prior']}, {other['learned_from']})."
    yield f"For what {most:,} random candidates find ({_percent(random[most])}), the mice's best prior that sees"
    for sees, told in (("moves", "its own moves alone needs"), ("node", "and the one that sees the node")):
        enough = [row["num_plans"] for row in rows if _as_good(row, random[most], sees)]
        few_enough = f"{min(enough):,}" if enough else f"more than {most:,}"
        yield f"{told} {few_enough}{',' if sees == 'moves' else '.'}"
    for what in dict.fromkeys(row["what"] for row in paired):
        gaps = [row for row in paired if (row["what"], row["length"], row["num_plans"]) == (what, length, few)]
        above, below = sum(row["low"] > 0 for row in gaps), sum(row["high"] < 0 for row in gaps)
        least, largest = (100 * pick(row["difference"] for row in gaps) for pick in (min, max))
        yield f"{what.capitalize()}: {above} of {len(gaps)} differences are above 0 with their whole interval, {below}"
        yield f"below ({least:+.1f} to {largest:+.1f} points)."


def _best(rows: list[dict[str, Any]], from_mice: bool) -> dict[str, Any]:
    """The row that reached the most of those that learned from mice, or from planners."""
    some = (row for row in rows if (row["learned_from"] == "mice") == from_mice)
    return max(some, key=lambda row: float(row["reached"]))


def _as_good(row: dict[str, Any], other: dict[str, Any], sees: str) -> bool:
    alike = (row["length"], row["learned_from"], row["sees"]) == (other["length"], "mice", sees)
    return alike and bool(row["reached"] >= other["reached"])


def _percent(row: dict[str, Any]) -> str:
    return f"{100 * row['reached']:.1f} %"


def _learned_table(outcome: Outcome) -> Table:
    table = titled("What the priors learned from")
    columns(table, ("learned from", "plans", "moves", "order (moves)", "bits", "order (node)", "bits"), 1)
    for row in outcome.learned:
        orders = (f"{row[f'{what}_{sees}']:{form}}" for sees in ("moves", "node") for what, form in PER_SIGHT)
        table.add_row(row["source"], f"{row['plans']:,}", f"{row['moves']:,}", *orders)
    told = "; ".join(f"{name}: {text}" for name, text in SOURCES.items())
    table.caption = f"{told}. order: of the Markov prior that takes the fewest bits a move for held-out plans."
    return table


def _reached_table(rows: list[dict[str, Any]], study: Study) -> Table:
    length = max(study.lengths)
    table = titled(f"Water reached, % of the nodes: plans of {length} moves, by candidates", gap=1)
    columns(table, ("learned from", "prior", "sees", *(f"{number:,}" for number in study.num_plans)), 3)
    for source, kind, sees, some in _by_prior([row for row in rows if row["length"] == length]):
        if (kind, sees) in (("markov", "moves"), ("oracle", "")):
            table.add_section()
        everywhere = some * len(study.num_plans) if kind == "oracle" else some
        table.add_row(source, kind, sees, *(_share_text(row) for row in everywhere))
    table.add_row("model steps", "", "", *(f"{length * number:,}" for number in study.num_plans), style="dim")
    starts = "all 126 nodes" if study.starts == NODES else f"{study.starts} nodes, drawn anew in each"
    table.caption = (
        f"±: 95 % interval over {study.seeds} repeats from {starts}: neural priors trained anew, new candidates; what"
        " they learn from is the same."
    )
    return table


def _lengths_table(rows: list[dict[str, Any]], study: Study) -> Table:
    number = sorted(study.num_plans)[len(study.num_plans) // 2]
    table = titled(f"Share of what the oracle reaches, %: {number:,} candidates, by moves in a plan", gap=1)
    columns(table, ("learned from", "prior", "sees", *map(str, study.lengths)), 3)
    for source, kind, sees, some in _by_prior([row for row in rows if row["num_plans"] == number]):
        shares = (row["oracle_share"] for row in some)
        table.add_row(source, kind, sees, *("" if share is None else f"{100 * share:.1f}" for share in shares))
    table.add_section()
    best = [row for row in rows if row["prior"] == "oracle"]
    table.add_row("", "oracle, % of the nodes", "", *(f"{100 * row['reached']:.1f}" for row in best))
    return table


def _by_prior(rows: list[dict[str, Any]]) -> Iterator[tuple[str, str, str, list[dict[str, Any]]]]:
    for kind, source, sees in dict.fromkeys((row["prior"], row["learned_from"], row["sees"]) for row in rows):
        yield source, kind, sees, [row for row in rows if Key(kind, source, sees) == Key(*_names(row))]


def _names(row: dict[str, Any]) -> tuple[str, str, str]:
    return row["prior"], row["learned_from"], row["sees"]


def _share_text(row: dict[str, Any]) -> str:
    half = max(row["high"] - row["reached"], row["reached"] - row["low"])  # one of them may be cut at 0 or 1
    return f"{100 * row['reached']:.1f}±{100 * half:.1f}"


def _paired_table(paired: list[dict[str, Any]], study: Study) -> Table:
    length, shown = max(study.lengths), sorted(study.num_plans)[:3]
    table = titled(f"Differences in points: plans of {length} moves, by candidates", gap=1)
    columns(table, (*Key._fields, *(f"{number:,}" for number in shown)), 3)
    last = ""
    for what, kind, source, sees in dict.fromkeys((row["what"], *_names(row)) for row in paired):
        if what != last:
            table.add_section()
        last = what
        some = [row for row in paired if (row["what"], *_names(row)) == (what, kind, source, sees)]
        at = {row["num_plans"]: row for row in some if row["length"] == length}
        gaps = (f"{100 * at[n]['difference']:+.1f}±{50 * (at[n]['high'] - at[n]['low']):.1f}" for n in shown)
        table.add_row(kind.replace("transformer", "transf."), source, sees, *gaps)
    table.caption = "±: 95 % interval, paired over repeats; more in paired.csv"
    return table
