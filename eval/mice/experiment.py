"""The experiment of `python -m eval mice`: what priors learn in the maze, and how often they find the water."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from eval.worlds.labyrinth import cut_plans, dry_nodes, reaching_planner, shares_reached
from eval.worlds.runs import paired_differences, seed_means
from neuroprior import (
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    Planner,
    Plans,
    Prior,
    SamplingPlanner,
    TabularWorld,
    TransformerPrior,
    UniformPrior,
    collect,
    oracle,
)
from neuroprior._random import draw_seed
from neuroprior.behaviour.analysis.comparison import score

ORDERS = range(9)
DEPTH, SHOTS, SHOT_LENGTH = 6, 256, 16

SOURCES = {
    "mice": "the mice's moves, cut into plans as long as the longest that is tried",
    "planner": f"a planner that tries all plans of {DEPTH} moves; most reach no water, and any of them is taken",
    "reached": f"the best of {SHOTS} random plans of {SHOT_LENGTH} moves, only where it reached the water",
}
"""What the priors learn from."""

CONTEXTS = {"moves": None, "node": 127}
"""What a prior predicts from, and its number of contexts: its own "moves" alone, or the "node" before each move too."""


class PriorName(NamedTuple):
    """A prior of the comparison: its kind, what it learned from (`SOURCES`) and what it predicts from (`CONTEXTS`)."""

    prior: str
    learned_from: str
    context: str

    def __str__(self) -> str:
        return ", ".join(filter(None, self))


UNIFORM, ORACLE = PriorName("uniform", "", ""), PriorName("oracle", "", "")

NEURAL = [
    PriorName(kind, source, context)
    for source in SOURCES
    for kind in ("gru", "transformer")
    for context in CONTEXTS
    if kind == "gru" or source == "mice"
]
"""Neural priors, in the order of training: from the mice both kinds, from planners the GRU."""

PRIORS = [UNIFORM] + [
    name
    for source in SOURCES
    for context in CONTEXTS
    for name in (PriorName(kind, source, context) for kind in ("markov", "gru", "transformer"))
    if name.prior == "markov" or name in NEURAL
]
"""All priors, in the order of the tables."""


@dataclass(frozen=True)
class MiceSettings:
    """How much is done; see `mice`."""

    seeds: int
    starts: int
    num_plans: tuple[int, ...]
    lengths: tuple[int, ...]
    training_plans: int
    steps: int
    seed: int


def reached_table(reached: pd.DataFrame) -> pd.DataFrame:
    """A row a prior, length and number of candidates, and one a length for the oracle; intervals over repeats."""
    rows = seed_means(reached, [*PriorName._fields, "length", "num_plans"], "reached").drop(columns="seeds")
    rows = rows.sort_values("length", kind="stable", ignore_index=True)
    best = rows[rows["prior"] == "oracle"].set_index("length")["reached"]
    share = (rows["reached"] / rows["length"].map(best)).mask(rows["prior"] == "oracle", 1.0)
    rows = rows.assign(model_steps=rows["length"] * rows["num_plans"], oracle_share=share)
    return rows.assign(low=rows["low"].clip(lower=0), high=rows["high"].clip(upper=1))


def paired_table(reached: pd.DataFrame) -> pd.DataFrame:
    """Paired differences over repeats, a row a pair of priors, length and number of candidates."""
    groups = reached.set_index(["length", "num_plans", "seed"]).groupby(list(PriorName._fields))["reached"]
    by_prior, parts = dict(list(groups)), []
    for what, first, second in _pairs():
        ends = zip(PriorName._fields, first, second, strict=True)
        names: dict[str, str] = {field: " - ".join(dict.fromkeys(pair)) for field, *pair in ends}
        both = pd.DataFrame({"first": by_prior[first], "second": by_prior[second]}).reset_index()
        parts.append(both.assign(**names, what=what, world="labyrinth"))
    by = ["world", *PriorName._fields, "what", "length", "num_plans"]
    return paired_differences(pd.concat(parts), by).drop(columns="world")


def _pairs() -> Iterator[tuple[str, PriorName, PriorName]]:
    """Neural minus Markov, mice's minus planners', and with the node as context minus without; all else equal."""
    for name in PRIORS:
        if name in NEURAL:
            yield "neural minus Markov", name, name._replace(prior="markov")
    for name in PRIORS:
        others = (name._replace(learned_from=source) for source in ("planner", "reached"))
        for other in others if name.learned_from == "mice" else ():
            if other in PRIORS:
                yield "mice's minus a planner's", name, other
    for name in PRIORS:
        if name.context == "node":
            yield "node as context minus none", name, name._replace(context="moves")


def simulate(
    settings: MiceSettings, world: TabularWorld, mice_plans: Plans, finished: Callable[[str], object]
) -> tuple[pd.DataFrame, dict[PriorName, Prior], pd.DataFrame]:
    """Learn all priors and let a planner draw from each, `settings.seeds` times.

    Args:
        settings: how much.
        world: the maze; it ends at the water.
        mice_plans: what the mice did, with the node before each move as context.
        finished: is called twice, and in each repeat once for each neural prior trained and each prior planned with.

    Returns:
        The share of starts at which the water was reached, a row a repeat, prior, length and number of candidates, and
        a row a repeat and length for the oracle; the priors of the last repeat; and a row for each source: its size,
        and the orders that were chosen for the Markov priors.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    dry = dry_nodes(world)
    sources = collected(settings, world, mice_plans, dry, generator)
    finished("collecting plans")
    priors, learned = _fit_counts(sources, generator)
    finished("counting")
    rows: list[dict[str, Any]] = []
    for repeat in range(1, settings.seeds + 1):
        drawn = torch.Generator().manual_seed(draw_seed(generator))
        start = dry[torch.randperm(len(dry), generator=drawn)[: settings.starts]].sort().values
        for name in NEURAL:
            make = GRUPrior if name.prior == "gru" else TransformerPrior
            prior = make(4, num_contexts=CONTEXTS[name.context], seed=draw_seed(drawn))
            plans = sources[name.learned_from]
            priors[name] = prior.fit(plans, generator=drawn, progress=False, max_steps=settings.steps)
            finished(f"training {name}, repeat {repeat}")
        for name in PRIORS:
            planner = reaching_planner(priors[name], max(settings.lengths), max(settings.num_plans))
            shares = shares_reached(planner, world, start, settings.lengths, settings.num_plans, drawn)
            rows += [
                name._asdict() | {"seed": repeat, "length": length, "num_plans": number, "reached": share}
                for length, length_shares in zip(settings.lengths, shares.tolist(), strict=True)
                for number, share in zip(settings.num_plans, length_shares, strict=True)
            ]
            finished(f"planning with {name}, repeat {repeat}")
        for length in settings.lengths:
            best = float(oracle(world, start, length, objective="return").mean())
            rows.append(ORACLE._asdict() | {"seed": repeat, "length": length, "reached": best})
    return pd.DataFrame(rows).astype({"num_plans": "Int64"}), priors, learned


def collected(
    settings: MiceSettings, world: TabularWorld, mice_plans: Plans, dry: Tensor, generator: torch.Generator
) -> dict[str, Plans]:
    """What the priors learn from, by the names in `SOURCES`; planners start at random nodes of `dry`.

    The mice's sequences are cut, because a planner's candidates begin without a past: a neural prior that was trained
    on pieces as long as the plans reaches more, and trains in a fifth of the time.
    """

    def chosen(planner: Planner, min_score: float | None) -> Plans:
        state = dry[torch.randint(len(dry), (settings.training_plans,), generator=generator)]
        return collect(planner, world, state=state, context="step", min_score=min_score, generator=generator)

    searched = chosen(ExhaustivePlanner(DEPTH, objective="return"), None)
    shot = chosen(SamplingPlanner(UniformPrior(4), SHOT_LENGTH, SHOTS, objective="return"), 0.0)
    if len(shot) < 20:
        raise ValueError(f"training_plans: {len(shot)} plans reached the water; at least 20 are needed")
    return {"mice": cut_plans(mice_plans, max(settings.lengths)), "planner": searched, "reached": shot}


def _fit_counts(sources: dict[str, Plans], generator: torch.Generator) -> tuple[dict[PriorName, Prior], pd.DataFrame]:
    """The uniform prior, and for each source the Markov priors of the orders that predict held-out plans best."""
    priors: dict[PriorName, Prior] = {UNIFORM: UniformPrior(4)}
    learned = []
    for source, plans in sources.items():
        row: dict[str, Any] = {"source": source, "plans": len(plans), "moves": int(plans.mask().sum())}
        training, validation = plans.split(0.1, generator)
        for context, contexts in CONTEXTS.items():
            tried = {order: MarkovPrior(4, order, num_contexts=contexts).fit(training) for order in ORDERS}
            bits = {order: score("", prior, validation).bits_per_action().mean for order, prior in tried.items()}
            best = min(bits, key=lambda order: bits[order])
            priors[PriorName("markov", source, context)] = MarkovPrior(4, best, num_contexts=contexts).fit(plans)
            row |= {f"markov_order_{context}": best, f"bits_{context}": bits[best]}
        learned.append(row)
    return priors, pd.DataFrame(learned)
