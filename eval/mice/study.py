"""The study behind `python -m eval mice`: what priors learn in the maze, and how often they find the water."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

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
from neuroprior.analysis.comparison import score
from neuroprior.sampling import sample_in_world
from neuroprior.worlds.labyrinth import WATER

ORDERS = range(9)
DEPTH, SHOTS, SHOT_LENGTH = 6, 256, 16
ROWS = 2048
"""Candidates drawn together; with more the caches of a transformer are slower to move than to compute."""

SOURCES = {
    "mice": "the mice's moves, cut into plans as long as the longest that is tried",
    "planner": f"a planner that tries all plans of {DEPTH} moves; most see no water, and any of them is taken",
    "reached": f"the best of {SHOTS} random plans of {SHOT_LENGTH} moves, only where it reached the water",
}
"""What the priors learn from."""


class Key(NamedTuple):
    """A prior of the comparison: its kind, what it learned from, and whether it sees its "moves" or the "node" too."""

    prior: str
    learned_from: str
    sees: str

    def __str__(self) -> str:
        return f"{self.prior} ({self.learned_from}, {self.sees})"


UNIFORM = Key("uniform", "", "")


@dataclass(frozen=True)
class Study:
    """How much is done; see `mice`."""

    seeds: int
    starts: int
    num_plans: tuple[int, ...]
    lengths: tuple[int, ...]
    training_plans: int
    steps: int
    seed: int


@dataclass(frozen=True, eq=False)
class Outcome:
    """What was reached.

    Attributes:
        reached: of each prior `[R, T, P]`: the share of starts at which the water was reached, in R repeats, with plans
            of T lengths and P numbers of candidates.
        oracle: `[R, T]`: the share of starts from which plans of these lengths can reach it.
        priors: those of the last repeat.
        learned: a row for each source: its size, and the orders that were chosen for the Markov priors.
    """

    reached: dict[Key, Tensor]
    oracle: Tensor
    priors: dict[Key, Prior]
    learned: list[dict[str, Any]]


def simulate(study: Study, world: TabularWorld, mice_plans: Plans, report: Callable[[str], None]) -> Outcome:
    """Learn all priors and let a planner draw from each, `study.seeds` times.

    Args:
        study: how much.
        world: the maze; it ends at the water.
        mice_plans: what the mice did, with the node before each move as context.
        report: is told what begins.
    """
    generator = torch.Generator().manual_seed(study.seed)
    dry = torch.tensor([node for node in range(world.num_states) if node != WATER])
    report("collecting plans")
    sources = collected(study, world, mice_plans, dry, generator)
    report("counting")
    counted, learned = _count_based(sources, generator)
    reached: dict[Key, list[Tensor]] = {}
    best, priors = [], counted
    for repeat in range(study.seeds):
        drawn = torch.Generator().manual_seed(draw_seed(generator))
        start = dry[torch.randperm(len(dry), generator=drawn)[: study.starts]].sort().values
        best.append(torch.stack([oracle(world, start, n, objective="return").mean() for n in study.lengths]))
        priors = dict(counted)
        for key, prior in _neural(sources, study.steps, drawn, report):
            priors[key] = prior
        for key in sorted(priors, key=_place):
            report(f"planning, {key}, repeat {repeat + 1}")
            reached.setdefault(key, []).append(
                shares_reached(priors[key], world, start, study.lengths, study.num_plans, drawn)
            )
    return Outcome({key: torch.stack(found) for key, found in reached.items()}, torch.stack(best), priors, learned)


def _place(key: Key) -> tuple[int, int, int]:
    """Where a prior stands in tables."""
    kinds = ("uniform", "markov", "gru", "transformer")
    return ("", *SOURCES).index(key.learned_from), ("", "moves", "node").index(key.sees), kinds.index(key.prior)


def shares_reached(
    prior: Prior,
    world: TabularWorld,
    start: Tensor,
    lengths: tuple[int, ...],
    num_plans: tuple[int, ...],
    generator: torch.Generator,
) -> Tensor:
    """The share of starts at which a sampling planner reaches the water.

    Candidates are drawn once, as many and as long as the most asked for. Fewer are blocks of them, each block a
    planner's decision; shorter ones are their beginnings.

    Returns:
        `[T, P]`, float64, for T `lengths` and P `num_plans`.
    """
    most = max(num_plans)
    found = torch.empty(len(start), most, len(lengths), dtype=torch.bool)
    ends = torch.tensor(lengths) - 1
    size = max(ROWS // most, 1)
    for at in range(0, len(start), size):
        some = start[at : at + size]
        _, rollout = sample_in_world(prior, world, some, most, max(lengths), generator=generator)
        found[at : at + size] = (rollout.rewards.cumsum(-1) > 0)[..., ends]
    shares = []
    for number in num_plans:
        blocks = most // number
        block = found[:, : blocks * number].view(len(start), blocks, number, len(lengths))
        shares.append(block.any(2).double().mean((0, 1)))
    return torch.stack(shares, 1)


def collected(
    study: Study, world: TabularWorld, mice_plans: Plans, dry: Tensor, generator: torch.Generator
) -> dict[str, Plans]:
    """What the priors learn from, by the names in `SOURCES`; planners start at random nodes of `dry`.

    The mice's sequences are cut, because a planner's candidates begin without a past: a neural prior that was trained
    on pieces as long as the plans reaches more, and trains in a fifth of the time.
    """

    def chosen(planner: Planner, min_score: float | None) -> Plans:
        state = dry[torch.randint(len(dry), (study.training_plans,), generator=generator)]
        return collect(planner, world, state=state, context="step", min_score=min_score, generator=generator)

    looked = chosen(ExhaustivePlanner(DEPTH, objective="return"), None)
    shot = chosen(SamplingPlanner(UniformPrior(4), SHOT_LENGTH, SHOTS, objective="return"), 0.0)
    if len(shot) < 20:
        raise ValueError(f"training_plans: {len(shot)} plans reached the water; at least 20 are needed")
    return {"mice": _cut(mice_plans, max(study.lengths)), "planner": looked, "reached": shot}


def _cut(plans: Plans, length: int) -> Plans:
    """Plans in pieces of `length` moves; what is left over at the end is dropped. A plan's pieces are a group."""
    assert plans.context is not None
    pieces = plans.max_length // length

    def cut(values: Tensor) -> Tensor:
        return values[:, : pieces * length].reshape(-1, length)

    group = torch.arange(len(plans)).repeat_interleave(pieces)
    return replace(plans, actions=cut(plans.actions), context=cut(plans.context), group=group)


def _count_based(
    sources: dict[str, Plans], generator: torch.Generator
) -> tuple[dict[Key, Prior], list[dict[str, Any]]]:
    """The uniform prior, and for each source the Markov priors of the orders that tell held-out plans best."""
    priors: dict[Key, Prior] = {UNIFORM: UniformPrior(4)}
    learned = []
    for source, plans in sources.items():
        row: dict[str, Any] = {"source": source, "plans": len(plans), "moves": int(plans.mask().sum())}
        training, validation = plans.split(0.1, generator)
        for sees, contexts in (("moves", None), ("node", 127)):
            tried = {order: MarkovPrior(4, order, num_contexts=contexts).fit(training) for order in ORDERS}
            bits = {order: score("", prior, validation).bits_per_action().mean for order, prior in tried.items()}
            best = min(bits, key=lambda order: bits[order])
            priors[Key("markov", source, sees)] = MarkovPrior(4, best, num_contexts=contexts).fit(plans)
            row |= {f"markov_order_{sees}": best, f"bits_{sees}": bits[best]}
        learned.append(row)
    return priors, learned


def _neural(
    sources: dict[str, Plans], steps: int, generator: torch.Generator, report: Callable[[str], None]
) -> Iterator[tuple[Key, Prior]]:
    """The neural priors, trained: from the mice both kinds, from planners the GRU."""
    for source, plans in sources.items():
        for name, make in (("gru", GRUPrior), ("transformer", TransformerPrior)):
            if name == "transformer" and source != "mice":
                continue
            for sees, contexts in (("moves", None), ("node", 127)):
                key = Key(name, source, sees)
                report(f"training, {key}")
                prior = make(4, num_contexts=contexts, seed=draw_seed(generator))
                yield key, prior.fit(plans, generator=generator, progress=False, max_steps=steps)
