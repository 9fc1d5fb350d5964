"""The paper's first simulation: planners on a grid of random rewards, with and without behavioural priors."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from neuroprior import (
    ExhaustivePlanner,
    GridWorld,
    GRUPrior,
    MarkovPrior,
    Planner,
    Plans,
    Prior,
    SamplingPlanner,
    TransformerPrior,
    UniformPrior,
    gridworld,
    oracle,
)
from neuroprior.analysis.statistics import Interval, best_of, mean_interval, share_interval
from neuroprior.plans import all_plans

PAPER_BEST = {"deterministic": 0.321, "random": 0.537, "markov-1": 0.841, "markov-2": 0.844}
"""Hyvärinen, Table 1: in what share of the starts each planner was best, of these four."""

PAPER_STRUCTURE = (0.60, 0.20, 0.0, 0.20)
"""Hyvärinen's transition matrix, about: repeat the last move, turn, reverse it, turn the other way."""

PAPER_MATRIX = torch.tensor([[PAPER_STRUCTURE[(b - a) % 4] for b in range(4)] for a in range(4)])

Report = Callable[[str], None]


@dataclass(frozen=True)
class Protocol:
    """What the paper leaves open."""

    edges: Literal["wall", "torus"]
    ties: Literal["uniform", "first"]
    learn_from: Literal["all", "shortest"]

    def __str__(self) -> str:
        return f"{self.edges}, {self.ties} ties, learn from {self.learn_from}"


PROTOCOLS = [
    Protocol(edges, ties, learn_from)
    for edges in ("torus", "wall")
    for ties in ("uniform", "first")
    for learn_from in ("all", "shortest")
]


@dataclass(frozen=True)
class Size:
    """How much is simulated."""

    worlds: int
    starts: int
    training_plans: int
    size: int
    reward_power: float
    depth: int
    length: int
    num_plans: int
    seed: int


class Outcome(NamedTuple):
    """What came of one protocol: K planners, W worlds, n starts a world.

    Attributes:
        names: of the planners.
        scores: `[K, W, n]`.
        oracle: `[W, n]`: the best of any plan.
        plans: `[K, W, n, L]`, padded with -1 where a planner's plans are shorter.
        states: `[W, n]`: the starts.
        world: in which the planners were compared.
        model_steps: single simulator steps for each start, by planner.
        transition_matrix: `[A, A]` of the Markov prior of order 1.
    """

    names: list[str]
    scores: Tensor
    oracle: Tensor
    plans: Tensor
    states: Tensor
    world: GridWorld
    model_steps: list[int]
    transition_matrix: Tensor


def simulate(protocol: Protocol, size: Size, neural: bool, report: Report) -> Outcome:
    """Collect plans, fit the priors, and let all planners plan from the same starts.

    With one world the priors learn in the world where they are used; with more, in as many other ones.

    Args:
        protocol: what the paper leaves open.
        size: how much.
        neural: also fit a GRU and a transformer.
        report: is told what begins.
    """
    generator = torch.Generator().manual_seed(size.seed)
    more = size.worlds if size.worlds > 1 else 0
    everywhere = gridworld(
        size.size,
        size.size,
        protocol.edges,
        reward_power=size.reward_power,
        num_worlds=size.worlds + more,
        seed=size.seed,
    )
    cells = everywhere.num_states
    learn_in = more * cells + torch.randint(size.worlds * cells, (size.training_plans,), generator=generator)
    report("collecting plans")
    plans = training_plans(everywhere, learn_in, size.depth, protocol, generator)
    priors = learn_priors(plans, size.seed, neural, generator, report)
    planners = make_planners(priors, size.depth, size.length, size.num_plans)
    start = torch.randint(cells, (size.worlds, size.starts), generator=generator)
    states = start + torch.arange(size.worlds)[:, None] * cells
    scores, chosen, steps = [], [], []
    for name, planner in planners.items():
        report(f"planning: {name}")
        decision = planner.plan(everywhere, states.flatten(), generator)
        chosen.append(decision.plan.long())
        scores.append(decision.score)
        steps.append(decision.model_steps)
    width = max(plan.shape[1] for plan in chosen)
    chosen = [torch.nn.functional.pad(plan, (0, width - plan.shape[1]), value=-1) for plan in chosen]
    shape = (len(planners), size.worlds, size.starts)
    report("planning: oracle")
    return Outcome(
        list(planners),
        torch.stack(scores).view(shape),
        oracle(everywhere, states.flatten(), size.length).view(shape[1:]),
        torch.stack(chosen).view(*shape, width),
        states,
        everywhere,
        steps,
        MarkovPrior(4, 1).fit(plans).transition_matrix(),
    )


def training_plans(
    world: GridWorld, states: Tensor, depth: int, protocol: Protocol, generator: torch.Generator
) -> Plans:
    """The executed plans of the deterministic planner that the priors learn from."""
    decision = ExhaustivePlanner(depth).plan(world, states, generator)
    actions = decision.plan.long()
    if protocol.ties == "first":
        actions = _first_of_equals(world, states, decision.score, depth)
    kept = torch.ones(len(states), dtype=torch.bool)
    if protocol.learn_from == "shortest":
        kept = _distance(world, states, decision.final_state) == depth
    if int(kept.sum()) < 2:
        raise ValueError("training_plans: too few plans to learn from; give more, or a larger grid")
    return Plans(actions[kept], 4, action_names=world.action_names, group=groups(world, states[kept]))


def groups(world: GridWorld, states: Tensor) -> Tensor | None:
    """The reward map of each state as its plan's group; None for one map: a single group cannot be split in two."""
    maps = world.reward_map(states)
    return maps if len(maps.unique()) > 1 else None


def learn_priors(plans: Plans, seed: int, neural: bool, generator: torch.Generator, report: Report) -> dict[str, Prior]:
    """The priors of the tables by name, with neural ones or without.

    Order 3, which the paper does not have, is the highest that plans of four moves can teach: the neural priors' rival.
    """
    priors: dict[str, Prior] = {"random": UniformPrior(4)}
    for order in (1, 2, 3):
        priors[f"markov-{order}"] = MarkovPrior(4, order).fit(plans)
    if neural:
        for name, make in (("gru", GRUPrior), ("transformer", TransformerPrior)):
            report(f"training: {name}")
            priors[name] = make(4, seed=seed).fit(plans, generator=generator, progress=False)
    return priors


def make_planners(
    priors: dict[str, Prior],
    depth: int,
    length: int,
    num_plans: int,
    value: Callable[[Tensor], Tensor] | None = None,
    any_prefix: bool = False,
) -> dict[str, Planner]:
    """The planners of the tables by name: the deterministic one, and one for each prior."""
    planners: dict[str, Planner] = {"deterministic": ExhaustivePlanner(depth, value=value, any_prefix=any_prefix)}
    for name, prior in priors.items():
        planners[name] = SamplingPlanner(prior, length, num_plans, value=value, any_prefix=any_prefix)
    return planners


def rows_of(outcome: Outcome) -> list[dict[str, Any]]:
    """A row a planner: the share of starts where it was best of the paper's four, its rewards, and the oracle's."""
    rivals = [outcome.names.index(name) for name in PAPER_BEST]
    scores = torch.cat([outcome.scores, outcome.oracle[None]])
    best = best_of(scores, rivals)
    rows: list[dict[str, Any]] = []
    for k, name in enumerate([*outcome.names, "oracle"]):
        share = over_groups(best[k])
        rows.append(
            {
                "planner": name,
                "best": share.mean,
                "low": share.low,
                "high": share.high,
                "paper": PAPER_BEST.get(name),
                "mean_reward": float(scores[k].double().mean()),
                "oracle_share": float(scores[k].double().sum() / outcome.oracle.double().sum()),
                "at_oracle": float((scores[k] >= outcome.oracle).double().mean()),
                "model_steps": None if name == "oracle" else outcome.model_steps[k],
            }
        )
    return rows


def table_distance(rows: list[dict[str, Any]], column: str) -> float:
    """The root mean square difference between a column and the paper's figures, over its four planners."""
    gaps = [row[column] - row["paper"] for row in rows if row["paper"] is not None]
    return float(torch.tensor(gaps).square().mean().sqrt())


def matrix_distance(matrix: Tensor) -> float:
    """The root mean square difference between a transition matrix and the paper's."""
    return float((matrix - PAPER_MATRIX).square().mean().sqrt())


def over_groups(hits: Tensor) -> Interval:
    """The share of True in `hits [G, n]` with an interval over the G worlds or value functions.

    Where there is one alone, the interval is over its starts.
    """
    if len(hits) == 1:
        return share_interval(int(hits.sum()), hits.numel())
    share, low, high = mean_interval(hits.double().mean(1))
    return Interval(share, max(low, 0.0), min(high, 1.0))


def _first_of_equals(world: GridWorld, states: Tensor, score: Tensor, depth: int) -> Tensor:
    """For each start the first, in the order of their numbers, of the plans with `score`: `[N, depth]`."""
    every = all_plans(4, depth)
    chosen = []
    for some, best in zip(states.split(4096), score.split(4096), strict=True):
        rewards = world.rollout(some, every.expand(len(some), *every.shape)).rewards[..., -1]
        chosen.append(every[(rewards == best[:, None]).int().argmax(1)])
    return torch.cat(chosen)


def _distance(world: GridWorld, first: Tensor, second: Tensor) -> Tensor:
    """The number of moves between states of an empty grid."""
    gap = (world.coordinates(first) - world.coordinates(second)).abs()
    if world.edges == "torus":
        gap = torch.minimum(gap, torch.tensor([world.height, world.width]) - gap)
    return gap.sum(-1)
