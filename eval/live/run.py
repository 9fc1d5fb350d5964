"""One cell of `python -m eval live`: agents in the same world, with the same food, that differ in their prior."""

from collections.abc import Iterator
from time import perf_counter
from typing import Any, NamedTuple

import torch

from eval.compare.recipes import RECIPE, UnlimitedGRU
from eval.compare.settings import LiveSettings
from eval.worlds.foraging import Home
from neuroprior import MarkovPrior, Planner, Prior, SamplingPlanner, TabularWorld, UniformPrior
from neuroprior._random import draw_seed
from neuroprior.agents import Agent
from neuroprior.planners import ForagingOracle
from neuroprior.worlds import ForagingWorld, patches

ORDERS = {"nothing": 3, "each step": 2}
"""Of chains, by what they see."""

PARTS = 8
"""Of a season, over which rewards are added up."""

DISCOUNT = 0.95

FORESIGHT = 4
"""The oracle's plans are so many times as long as the others': it always knows of food."""

EVERY = 4
"""Actions that are executed of each plan."""

LEARN_EVERY = {"markov": 16, "gru": 64}
"""Steps after which a prior learns; a network takes its time."""

TRAINING = {"markov": None, "gru": {"max_steps": 40, "weight_decay": 0.3, "progress": False}}
"""Passed on to `fit`."""

HALF_LIFE = 96
"""Steps after which half of what was executed is forgotten."""

VERSION = 2
"""Of the way in which a cell is done; counts up with each change of it."""


class Life(NamedTuple):
    """How an agent lives.

    Attributes:
        prior: "uniform", or the kind of a prior that learns; "oracle": none.
        sees: what the prior sees, see `eval.compare.settings.SEES`.
        learns: "never"; "before": in a season before its life, and never again; "online": as long as it lives.
        warm: whether the rest of the last plan is a candidate.
    """

    prior: str
    sees: str
    learns: str
    warm: bool = True


def lives(kinds: tuple[str, ...]) -> Iterator[Life]:
    """All that are compared."""
    yield Life("uniform", "nothing", "never", warm=False)
    yield Life("uniform", "nothing", "never")
    for kind in kinds:
        for sees in ORDERS:
            yield Life(kind, sees, "before")
            yield Life(kind, sees, "online")
            if sees == "each step":
                yield Life(kind, sees, "online", warm=False)
    yield Life("oracle", "everything", "never")


def run_live(home: Home, seed: int, settings: LiveSettings) -> dict[str, Any]:
    """Let agents of each kind live in the world of one seed, from the same states and with food in the same patches.

    Args:
        home: where.
        seed: of the world and of everything that is drawn in it.
        settings: how much is done.

    Returns:
        `entries`, one of each life: the mean `rewards` a step of each eighth of a season, and the `seconds` of a step.
    """
    begin = perf_counter()
    generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + seed)
    table = home.table(settings.seed * 10_000 + seed)
    # One season more than is lived through: that in which priors learn that learn before.
    growth = patches(table, settings.seasons + 1, home.radius, generator)
    world = ForagingWorld(table, growth, settings.period, settings.items)
    state, own = world.reset(settings.agents, generator), draw_seed(generator)
    entries = []
    for life in lives(settings.kinds):
        drawn = torch.Generator().manual_seed(own)
        prior = _prior(life, table, own)
        if life.learns == "before":
            before = world.reset(settings.agents, drawn)
            before[:, 1] = settings.period * settings.seasons
            _agent(life, world, prior, world.regrow(before, drawn), settings, drawn).run(settings.period)
        start = perf_counter()
        agent = _agent(life, world, prior, state, settings, drawn, life.learns == "online")
        done = agent.run(settings.period * settings.seasons)
        rewards = done.rewards.double().mean(0).view(-1, settings.period // PARTS).mean(1)
        seconds = (perf_counter() - start) / len(done.rewards[0]) / settings.agents
        entry: dict[str, Any] = life._asdict() | {"rewards": rewards.tolist(), "seconds": seconds}
        entries.append(entry | {"model_steps": done.model_steps / len(done.rewards[0])})
    cell: dict[str, Any] = {"world": home.name, "seed": seed, "about": home.about, "period": settings.period}
    cell |= {"places": float((growth > 0).sum(1).double().mean()), "of": world.num_places}
    return cell | {"entries": entries, "seconds": perf_counter() - begin}


def recipe() -> str:
    """What decides a cell beside its world and settings; after a change of it, finished cells do not count."""
    decides = (ORDERS, PARTS, DISCOUNT, FORESIGHT, EVERY, LEARN_EVERY, TRAINING, HALF_LIFE, RECIPE["gru"], VERSION)
    return repr(decides)


def _prior(life: Life, table: TabularWorld, seed: int) -> Prior:
    """A prior that has learned nothing yet."""
    seeing = {"num_contexts": table.num_states} if life.sees == "each step" else {}
    if life.prior == "markov":
        return MarkovPrior(table.num_actions, ORDERS[life.sees], **seeing)
    if life.prior == "gru":
        return UnlimitedGRU(table.num_actions, seed=seed, **seeing, **RECIPE["gru"])
    return UniformPrior(table.num_actions)


def _agent(
    life: Life,
    world: ForagingWorld,
    prior: Prior,
    state: torch.Tensor,
    settings: LiveSettings,
    generator: torch.Generator,
    learns: bool = True,
) -> Agent:
    planner: Planner = ForagingOracle(FORESIGHT * settings.length, DISCOUNT)
    if life.prior != "oracle":
        # The rest of the last plan is one more candidate: without it there is one more plan.
        number = settings.num_plans + (not life.warm)
        planner = SamplingPlanner(prior, settings.length, number, objective="return", discount=DISCOUNT)
    often = LEARN_EVERY.get(life.prior)
    return Agent(
        world,
        planner,
        prior,
        state,
        replan_every=EVERY,
        change=world.regrow,
        warm_start=life.warm,
        learn_every=often if learns else None,
        plan_length=settings.length,
        retention=0.5 ** ((often or 1) / HALF_LIFE),
        min_score=0.0,
        generator=generator,
        training=TRAINING.get(life.prior),
    )
