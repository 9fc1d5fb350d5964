"""One cell of `python -m eval compare`: everything about one world and one seed."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields, replace
from functools import cached_property, partial
from time import perf_counter
from typing import Any, NamedTuple

import torch

from eval.compare.curves import (
    CLOSE,
    ROLLOUTS,
    TEMPERATURES,
    best_temperature,
    curve,
    seconds_per_decision,
    starts_of,
)
from eval.compare.pictures import drawn_plans, transitions
from eval.compare.recipes import MANY, NEURAL, ORDERS, RECIPE, TRAINING, WIDE, chain, macro, network
from eval.compare.saved import load_for
from eval.compare.settings import SEES, Settings
from eval.worlds.foraging import Home
from eval.worlds.splits import LAYOUTS, MAPS, SCRAMBLE
from eval.worlds.suite import Task
from neuroprior import ExhaustivePlanner, Plans, Prior, UniformPrior, World, collect
from neuroprior._random import draw_seed
from neuroprior.analysis.comparison import score
from neuroprior.planners import extend_horizon

GROWN_WITH = 64
"""Candidate plans in the rounds of growth."""

JUDGED_WITH = 256
"""Candidate plans with which temperatures are chosen, and growth is told."""

VERSION = 7
"""Of the way in which a cell is done; counts up with each change of it."""

CHOSEN_AT = 2
"""For each held-out start so many in the validation worlds, to choose temperatures at: differences are small."""

TIMED_STARTS = 4
"""Starts planned from together when a decision is timed."""


def recipe() -> str:
    """What decides a cell beside its world and settings; after a change of it, finished cells do not count.

    Changes of code are not seen: they count `VERSION` up.
    """
    priors = (ORDERS, RECIPE, WIDE, MANY, TRAINING)
    return repr((priors, GROWN_WITH, JUDGED_WITH, ROLLOUTS, TEMPERATURES, CHOSEN_AT, TIMED_STARTS, VERSION))


def digest(task: Task | Home) -> str:
    """Eight letters for all that is said of a world but in words; after a change, its finished cells do not count."""
    said = [_said(getattr(task, field.name)) for field in fields(task) if field.name != "about"]
    return hashlib.sha256(repr((said, MAPS, LAYOUTS, SCRAMBLE)).encode()).hexdigest()[:8]


def _said(value: Any) -> Any:
    """A value, or the names of a function and its arguments."""
    if isinstance(value, partial):
        return _said(value.func), value.args, [(name, _said(given)) for name, given in sorted(value.keywords.items())]
    return value.__qualname__ if callable(value) else value


def run_cell(task: Task, seed: int, settings: Settings) -> dict[str, Any]:
    """Collect, fit, grow and compare in the worlds of one seed.

    Args:
        task: the world.
        seed: of these worlds and of everything that is drawn in them.
        settings: how much is done.

    Returns:
        What `eval.compare.rows` reads.

    Raises:
        ValueError: too few plans or starts lead anywhere, or a saved prior does not fit the world.
    """
    begin = perf_counter()
    contest = Contest(task, seed, settings)
    entries, growth, last = [], [], {}
    if (tried_all := contest.exhaustive()) is not None:
        entries.append(tried_all)
    for one in contest.contestants():
        if one.length is not None:
            growth.append(contest.growth(one, one.length))
        if one.rounds in (0, contest.rounds):
            entries.append(contest.entry(one))
        if one.sees == "nothing":
            last[one.label] = one.prior  # which goes on learning until all are done
    cell: dict[str, Any] = {"world": task.name, "seed": seed, "about": task.about, "length": task.length}
    cell |= {"num_starts": settings.starts, "budgets": settings.budgets, "entries": entries, "growth": growth}
    cell |= {"action_names": task.action_names}
    world = contest.worlds.held_out
    cell |= {"transitions": {label: transitions(prior, world, contest.generator) for label, prior in last.items()}}
    cell |= {"plans": drawn_plans(last, contest.starts, contest.generator) if seed == 0 else None}
    return cell | {"seconds": perf_counter() - begin}


def run_growth(task: Task, seed: int, settings: Settings) -> dict[str, Any]:
    """Grow all priors in the worlds of one seed, and plan with each after every round with plans of every length.

    Args, raises: see `run_cell`.
    """
    begin = perf_counter()
    contest = Contest(task, seed, settings)
    growth = [
        contest.growth(one, length)
        for one in contest.contestants()
        for length in (contest.lengths if one.length is not None else ())
    ]
    cell: dict[str, Any] = {"world": task.name, "seed": seed, "about": task.about, "growth": growth}
    return cell | {"seconds": perf_counter() - begin}


def as_seen(plans: Plans, sees: str) -> Plans:
    """Plans of which each step is seen, as priors that see less of them see them."""
    assert plans.context is not None
    seen = {None: None, "plan": plans.context[:, 0], "step": plans.context}[SEES[sees]]
    return replace(plans, context=seen)


class Contestant(NamedTuple):
    """A prior as it is after some rounds of growth, the plans of the last of which had `length` actions."""

    label: str
    sees: str
    prior: Prior
    rounds: int
    length: int | None


class Contest:
    """The worlds of a seed, what is learned from there, and where priors are compared."""

    def __init__(self, task: Task, seed: int, settings: Settings, orders: Sequence[int] = ORDERS) -> None:
        self.task, self.settings, self.orders = task, settings, orders
        self.generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + seed)
        self.worlds = task.worlds(settings.seed * 10_000 + seed)
        self.longer = (settings.lengths or task.lengths)[: settings.rounds]
        self.rounds, self.lengths = len(self.longer), tuple(sorted({task.depth, *self.longer}))
        self.training_starts = settings.training_starts * task.times
        self.starts_at, self.chosen_at = (
            {
                length: starts_of(task, world, number, length, self.generator)
                for length in sorted({*self.lengths, task.length})
            }
            for world, number in (
                (self.worlds.held_out, settings.starts),
                (self.worlds.validation, CHOSEN_AT * settings.starts),
            )
        )
        self.starts = self.starts_at[task.length]
        self._heats: dict[tuple[str, str, int, int], float] = {}

    def contestants(self) -> Iterator[Contestant]:
        """All priors, each after every round of its growth; the object is the same, and goes on learning."""
        yield Contestant("uniform", "nothing", UniformPrior(self.worlds.training.num_actions), 0, None)
        for folder in self.settings.priors:
            prior = load_for(folder, self.task.name, self.task.num_actions, self.task.action_names)
            sees = next(name for name, per in SEES.items() if per == prior.context_per)
            yield Contestant(folder, sees, prior, 0, None)
        for sees in self.settings.sees or self.task.sights:
            if self.task.shows(sees):
                yield from self._learners(sees)

    def grown(self) -> Iterator[Contestant]:
        """Each prior after its growth alone; saved priors and random plans do not grow."""
        return (one for one in self.contestants() if one.rounds == (0 if one.length is None else self.rounds))

    def _learners(self, sees: str) -> Iterator[Contestant]:
        first = as_seen(self.first, sees)
        if "markov" in self.settings.kinds:
            for order in self.orders:
                prior = chain(order, self.worlds.training, first, self.task.near)
                yield from self._grown(f"markov-{order}", sees, prior, first, {})
        for kind in (kind for kind in NEURAL if kind in self.settings.kinds):
            prior = network(kind, self.worlds.training, first, draw_seed(self.generator))
            yield from self._grown(kind, sees, prior, first, TRAINING | {"max_steps": self.settings.steps})

        if "macro" in self.settings.kinds and sees == "nothing":
            yield from self._grown("macro", sees, macro(first), first, {})

    def _grown(
        self, label: str, sees: str, prior: Prior, first: Plans, training: dict[str, Any]
    ) -> Iterator[Contestant]:
        growth = extend_horizon(
            prior,
            first,
            self.worlds.training,
            self.longer,
            num_starts=self.training_starts,
            num_plans=GROWN_WITH,
            min_score=self.task.min_score,
            num_rollouts=ROLLOUTS,
            temperatures=TEMPERATURES,
            generator=self.generator,
            **self.task.scoring,
            **training,
        )
        for rounds, _ in enumerate(growth):
            yield Contestant(label, sees, prior, rounds, (self.task.depth, *self.longer)[rounds])

    @cached_property
    def first(self) -> Plans:
        """What the planner that tries all short plans chooses in the training worlds."""
        return self._collected(self.worlds.training, self.training_starts)

    @cached_property
    def told(self) -> Plans:
        """The same in the held-out worlds, on which bits are told."""
        return self._collected(self.worlds.held_out, self.training_starts // 4)

    def _collected(self, world: World, number: int) -> Plans:
        planner = ExhaustivePlanner(self.task.depth, num_rollouts=ROLLOUTS, **self.task.scoring)
        return collect(planner, world, number, context="step", min_score=self.task.min_score, generator=self.generator)

    def entry(self, one: Contestant) -> dict[str, Any]:
        """What a prior's plans reach in the held-out worlds, and how well it tells those that were chosen there."""
        starts, heat = self.starts, self._heat(one, self.task.length)
        entry: dict[str, Any] = {"planner": "sampling", "prior": one.label, "sees": one.sees, "rounds": one.rounds}
        entry |= {"temperature": heat}
        entry |= asdict(curve(starts, one.prior, self.settings.budgets, self.generator, heat))
        asked = self.settings.num_plans
        timed = seconds_per_decision(starts, one.prior, asked, TIMED_STARTS, self.generator, heat)
        seconds, steps = ([timed[b][k] if b in timed else None for b in self.settings.budgets] for k in (0, 1))
        entry |= {"seconds": seconds, "model_steps": steps}
        scored = score(one.label, one.prior, as_seen(self.told, one.sees))
        return entry | {"bits": scored.bits_per_action().mean, "actions": int(self.told.mask().sum())}

    def growth(self, one: Contestant, length: int) -> dict[str, Any]:
        """What a prior's plans of `length` actions reach."""
        budget = self.settings.num_plans[0] if len(self.settings.num_plans) == 1 else JUDGED_WITH
        heat = self._heat(one, length)
        share = curve(self.starts_at[length], one.prior, [budget], self.generator, heat).share[0]
        named = {"prior": one.label, "sees": one.sees, "round": one.rounds}
        return named | {"length": length, "num_plans": budget, "share": share}

    def _heat(self, one: Contestant, length: int) -> float:
        """The temperature to sample plans of `length` actions at, chosen once; uniform plans are the same at all."""
        if one.label == "uniform":
            return 1.0
        key = one.label, one.sees, one.rounds, length
        if key not in self._heats:
            self._heats[key] = best_temperature(self.chosen_at[length], one.prior, JUDGED_WITH, self.generator)
        return self._heats[key]

    def exhaustive(self) -> dict[str, Any] | None:
        """What all short plans reach; None where longer ones cost more, which would favour the short."""
        if self.starts.reference < 0 or self.worlds.held_out.stochastic:
            return None
        planner = ExhaustivePlanner(self.task.depth, **self.task.scoring)
        begin = perf_counter()
        decision = planner.plan(self.worlds.held_out, self.starts.state, self.generator)
        seconds = (perf_counter() - begin) / self.settings.starts
        reached = float((decision.score >= self.starts.best - CLOSE).double().mean())
        entry: dict[str, Any] = {
            "planner": "exhaustive",
            "prior": None,
            "sees": "nothing",
            "rounds": 0,
            "depth": self.task.depth,
        }
        entry |= {"share": [self.starts.share(decision.score.double())], "at_oracle": [reached]}
        entry |= {"score": [float(decision.score.double().mean())], "model_steps": [decision.model_steps]}
        return entry | {"seconds": [seconds], "bits": None, "actions": 0}
