"""One run of `python -m eval live`: agents in the same world, with the same food, that differ in their prior."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple

import torch

from eval.live.foraging import ForagingWorld, patches
from eval.live.oracle import ForagingOracle
from eval.live.worlds import FORAGING_WORLDS
from eval.worlds.runs import Run
from neuroprior._random import draw_seed
from neuroprior.agents.agent import Agent
from neuroprior.planners import Planner, SamplingPlanner
from neuroprior.priors import GRUPrior, MarkovPrior, Prior, UniformPrior
from neuroprior.worlds import TabularWorld

ORDERS = {"none": 3, "per-step": 2}
"""Orders of the Markov priors, by their context."""

PARTS = 8
"""Parts of a season, in each of which the mean reward is taken."""

DISCOUNT = 0.95

FORESIGHT = 4
"""The oracle's plans are so many times as long as the others': they always reach food."""

REPLAN_EVERY = 4
"""Actions that are executed of each plan."""

LEARN_EVERY = {"markov": 16, "gru": 64}
"""Steps after which a prior learns; a network takes its time."""

TRAINING = {"markov": None, "gru": {"max_steps": 40, "weight_decay": 0.3, "progress": False}}
"""Passed on to `fit`."""

HALF_LIFE = 96
"""Steps after which half of what was executed is forgotten."""


@dataclass(frozen=True)
class LiveSettings:
    """All that decides the results of a run, beside its world and seed; see `eval.live.command.live`."""

    kinds: tuple[str, ...]
    period: int
    seasons: int
    agents: int
    items: int
    num_plans: int
    length: int
    seed: int


class Condition(NamedTuple):
    """What is compared in a world.

    Attributes:
        prior: "uniform", or the kind of a prior that learns; "oracle": none.
        context: the context of the prior: "none" or "per-step"; "full" for the oracle, which knows the state.
        learns: "never"; "before": in a season before the run; "online": during the run.
        warm: whether the rest of the last plan is a candidate.
    """

    prior: str
    context: str
    learns: str
    warm: bool = True


RANDOM, ORACLE = Condition("uniform", "none", "never"), Condition("oracle", "full", "never")


def conditions(kinds: Sequence[str]) -> Iterator[Condition]:
    """All that are compared."""
    yield RANDOM._replace(warm=False)
    yield RANDOM
    for kind in kinds:
        for context in ORDERS:
            yield Condition(kind, context, "before")
            yield Condition(kind, context, "online")
            if context == "per-step":
                yield Condition(kind, context, "online", warm=False)
    yield ORACLE


def run_live(run: Run, settings: LiveSettings) -> dict[str, Any]:
    """Run the agents of each condition in the world of one seed, from the same states and with the same seasons.

    Returns:
        `entries`, one of each condition: the mean `rewards` a step in each part of each season, the `model_steps` of a
        step, and its `seconds`.
    """
    task = FORAGING_WORLDS[run.world]
    generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + run.seed)
    table = task.table(settings.seed * 10_000 + run.seed)
    # There is one season more than those of the run: priors that learn before the run learn in it.
    food = patches(table, settings.seasons + 1, task.radius, generator)
    world = ForagingWorld(table, food, settings.period, settings.items)
    state, agent_seed = world.reset(settings.agents, generator), draw_seed(generator)
    steps = settings.period * settings.seasons

    def agent(condition: Condition, prior: Prior, state: torch.Tensor, drawn: torch.Generator, learns: bool) -> Agent:
        planner: Planner = ForagingOracle(FORESIGHT * settings.length, DISCOUNT)
        if condition != ORACLE:
            # The rest of the last plan is one more candidate: without it there is one more plan.
            number = settings.num_plans + (not condition.warm)
            planner = SamplingPlanner(prior, settings.length, number, objective="return", discount=DISCOUNT)
        often = LEARN_EVERY.get(condition.prior, 1)
        return Agent(
            world,
            planner,
            prior,
            state,
            generator=drawn,
            replan_every=REPLAN_EVERY,
            change=world.regrow,
            warm_start=condition.warm,
            learn_every=often if learns else None,
            retention=0.5 ** (often / HALF_LIFE),
            plan_length=settings.length,
            min_score=0.0,
            training=TRAINING.get(condition.prior),
        )

    entries = []
    for condition in conditions(settings.kinds):
        drawn = torch.Generator().manual_seed(agent_seed)
        prior = untrained(condition, table, agent_seed)
        if condition.learns == "before":
            before = world.reset(settings.agents, drawn)
            before[:, 1] = steps
            agent(condition, prior, world.regrow(before, drawn), drawn, True).run(settings.period)
        begin = perf_counter()
        done = agent(condition, prior, state, drawn, condition.learns == "online").run(steps)
        rewards = done.rewards.double().mean(0).view(-1, settings.period // PARTS).mean(1)
        entry: dict[str, Any] = condition._asdict() | {"rewards": rewards.tolist()}
        entry |= {
            "seconds": (perf_counter() - begin) / steps / settings.agents,
            "model_steps": done.model_steps / steps,
        }
        entries.append(entry)
    places = float((food > 0).sum(1).double().mean())
    return run._asdict() | {"about": task.about, "period": settings.period, "places": places, "entries": entries}


def untrained(condition: Condition, table: TabularWorld, seed: int) -> Prior:
    """The prior of a condition, which has learned nothing yet."""
    num_contexts = table.num_states if condition.context == "per-step" else None
    if condition.prior == "markov":
        return MarkovPrior(table.num_actions, ORDERS[condition.context], num_contexts=num_contexts)
    if condition.prior == "gru":
        return GRUPrior(table.num_actions, num_layers=1, lags=1, dropout=0.2, seed=seed, num_contexts=num_contexts)
    return UniformPrior(table.num_actions)
