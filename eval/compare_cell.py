"""One cell of `python -m eval compare`: everything about one world and one seed."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from time import perf_counter
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from eval.compare_curves import (
    CLOSE,
    ROLLOUTS,
    TEMPERATURES,
    best_temperature,
    curve,
    planner_of,
    seconds_per_decision,
    starts_of,
)
from eval.compare_pictures import drawn_plans, transitions
from eval.compare_sight import best_counted, sizes_of
from eval.suite import TASKS, Pair, Task
from eval.world_priors import load_for
from neuroprior import (
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    Plans,
    Prior,
    TransformerPrior,
    UniformPrior,
    World,
    collect,
    grow,
)
from neuroprior.comparison import score
from neuroprior.randomness import draw_seed

ORDERS = range(5)
"""Of the Markov priors."""


class UnlimitedGRU(GRUPrior):
    """A GRU that goes on with its memory beyond the length that it was trained at.

    It tells longer plans as well as one that reads their last actions in a window, and far quicker.
    """

    def prepare(self, plans: Plans | Tensor, window: int) -> Plans:
        plans = super().prepare(plans, window)
        self.window = None
        return plans


NEURAL: dict[str, Any] = {"gru": UnlimitedGRU, "transformer": TransformerPrior}

LAGS = 1
"""Of GRUs: in plans this short they remember without being shown their last inputs again, and are far quicker."""

SEES: dict[str, Literal["plan", "step"] | None] = {"nothing": None, "start": "plan", "each step": "step"}
"""How a prior's context is called in tables, and by `collect`."""

GROWN_WITH = 256
"""Candidate plans in the rounds of growth."""

VERSION = 4
"""Of the way in which a cell is done; counts up with each change of it."""

TIMED_STARTS = 4
"""Starts planned from together when a decision is timed."""


@dataclass(frozen=True)
class Settings:
    """All that decides the results of a cell, beside its world and seed.

    Attributes:
        num_plans: numbers of candidate plans, powers of two.
        kinds: of fitted priors: "markov", "gru", "transformer".
        sees: what priors see: "nothing", "start", "each step".
        rounds: of horizon growth, at most; a world has as many as it has lengths.
        steps: of training of each neural prior in a round, at most.
        starts: held-out starts to plan from.
        training_starts: from so many starts plans are collected to learn from.
        seed: of everything random.
        priors: folders of saved priors.
        lengths: actions in a plan, round by round of horizon growth; none: those of the world.
    """

    num_plans: tuple[int, ...]
    kinds: tuple[str, ...]
    sees: tuple[str, ...]
    rounds: int
    steps: int
    starts: int
    training_starts: int
    seed: int
    priors: tuple[str, ...] = ()
    lengths: tuple[int, ...] = ()

    @property
    def budgets(self) -> list[int]:
        """All powers of two up to the most candidates."""
        return [2**k for k in range(max(self.num_plans).bit_length())]


def recipe() -> str:
    """All that decides a cell beside its settings; after a change of it, finished cells do not count."""
    worlds = [(task.name, task.about, task.depth, task.lengths, task.scoring, task.above) for task in TASKS.values()]
    return repr((worlds, ORDERS, [*NEURAL], GROWN_WITH, ROLLOUTS, TEMPERATURES, LAGS, TIMED_STARTS, VERSION))


def run_cell(task: Task, seed: int, settings: Settings) -> dict[str, Any]:
    """Collect, fit, grow and compare in the worlds of one seed.

    Args:
        task: the world.
        seed: of these worlds and of everything that is drawn in them.
        settings: how much is done.

    Returns:
        What `eval.compare_rows` reads.

    Raises:
        ValueError: too few plans or starts lead anywhere, or a saved prior does not fit the world.
    """
    begin = perf_counter()
    contest = _Contest(task, seed, settings)
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
    contest = _Contest(task, seed, settings)
    growth = [
        contest.growth(one, length)
        for one in contest.contestants()
        for length in (contest.lengths if one.length is not None else ())
    ]
    cell: dict[str, Any] = {"world": task.name, "seed": seed, "about": task.about, "growth": growth}
    return cell | {"seconds": perf_counter() - begin}


class _Contestant(NamedTuple):
    """A prior as it is after some rounds of growth, the plans of the last of which had `length` actions."""

    label: str
    sees: str
    prior: Prior
    rounds: int
    length: int | None
    worlds: Pair


class _Contest:
    """The worlds of a seed, what is learned from there, and where priors are compared."""

    def __init__(self, task: Task, seed: int, settings: Settings) -> None:
        self.task, self.settings = task, settings
        self.generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + seed)
        self.worlds = task.worlds(settings.seed * 10_000 + seed)
        self.longer = (settings.lengths or task.lengths)[: settings.rounds]
        self.rounds, self.lengths = len(self.longer), tuple(sorted({task.depth, *self.longer}))
        held_out = self.worlds.held_out
        self.starts = starts_of(task, held_out, settings.starts, task.length, self.generator)
        self.familiar = starts_of(task, self.worlds.training, settings.starts, task.length, self.generator)
        self.starts_at = {
            length: starts_of(task, held_out, settings.starts, length, self.generator) for length in self.lengths
        }

    def contestants(self) -> Iterator[_Contestant]:
        """All priors, each after every round of its growth; the object is the same, and goes on learning."""
        yield _Contestant("uniform", "nothing", UniformPrior(self.worlds.training.num_actions), 0, None, self.worlds)
        for folder in self.settings.priors:
            prior = load_for(folder, self.task.name, self.task.num_actions, self.task.action_names)
            sees = next(name for name, per in SEES.items() if per == prior.context_per)
            yield _Contestant(folder, sees, prior, 0, None, self.worlds)
        for sees in self.settings.sees:
            if sees == "nothing" or self._shows(sees):
                yield from self._learners(sees)

    def _shows(self, sees: str) -> bool:
        """Whether there is something to be seen that held-out worlds have in common with training worlds.

        Numbers of states to start from have nothing in common: other starts are held out.
        """
        if self.task.sees is None:
            return False
        return sees == "each step" or self.worlds.training.observe(self.familiar.state[:1]).is_floating_point()

    def _learners(self, sees: str) -> Iterator[_Contestant]:
        first = self.collected(self.worlds.training, sees, self.settings.training_starts)
        if "markov" in self.settings.kinds:
            for order in ORDERS:
                worlds, counted, sizes = best_counted(self.worlds, first, self.task.near, order, self.generator)
                prior = MarkovPrior(first.num_actions, order, **sizes)
                yield from self._grown(f"markov-{order}", sees, prior, counted, worlds, {})
        for kind in (kind for kind in NEURAL if kind in self.settings.kinds):
            how = sizes_of(self.worlds, first) | ({"lags": LAGS} if kind == "gru" else {})
            prior = NEURAL[kind](first.num_actions, seed=draw_seed(self.generator), **how)
            training = {"max_steps": self.settings.steps, "progress": False}
            yield from self._grown(kind, sees, prior, first, self.worlds, training)

    def _grown(
        self, label: str, sees: str, prior: Prior, first: Plans, worlds: Pair, training: dict[str, Any]
    ) -> Iterator[_Contestant]:
        growth = grow(
            prior,
            first,
            worlds.training,
            self.longer,
            num_starts=self.settings.training_starts,
            num_plans=GROWN_WITH,
            above=self.task.above,
            num_rollouts=ROLLOUTS,
            generator=self.generator,
            **self.task.scoring,
            **training,
        )
        for rounds, _ in enumerate(growth):
            yield _Contestant(label, sees, prior, rounds, (self.task.depth, *self.longer)[rounds], worlds)

    def collected(self, world: World, sees: str, number: int) -> Plans:
        """What the planner that tries all short plans chooses."""
        planner = ExhaustivePlanner(self.task.depth, num_rollouts=ROLLOUTS, **self.task.scoring)
        how: dict[str, Any] = {"context": SEES[sees], "above": self.task.above}
        return collect(planner, world, number, generator=self.generator, **how)

    def entry(self, one: _Contestant) -> dict[str, Any]:
        """What a prior's plans reach in the held-out worlds, and how well it tells those that were chosen there."""
        starts = replace(self.starts, world=one.worlds.held_out)
        # Chosen where it learned, for all alike; sampling them at a temperature changes nothing for uniform plans.
        familiar = replace(self.familiar, world=one.worlds.training)
        heat = 1.0 if one.label == "uniform" else best_temperature(familiar, one.prior, GROWN_WITH, self.generator)
        entry: dict[str, Any] = {"planner": "sampling", "prior": one.label, "sees": one.sees, "rounds": one.rounds}
        entry |= {"temperature": heat}
        entry |= asdict(curve(starts, one.prior, self.settings.budgets, self.generator, heat))
        timed = {
            budget: seconds_per_decision(
                starts, planner_of(starts, one.prior, budget, heat), TIMED_STARTS, self.generator
            )
            for budget in self.settings.num_plans
        }
        seconds, steps = ([timed[b][k] if b in timed else None for b in self.settings.budgets] for k in (0, 1))
        entry |= {"seconds": seconds, "model_steps": steps}
        plans = self.collected(one.worlds.held_out, one.sees, self.settings.training_starts // 4)
        told = score(one.label, one.prior, plans)
        return entry | {"bits": told.bits_per_action().mean, "actions": int(plans.mask().sum())}

    def growth(self, one: _Contestant, length: int) -> dict[str, Any]:
        """What a prior's plans of `length` actions reach."""
        starts = replace(self.starts_at[length], world=one.worlds.held_out)
        budget = self.settings.num_plans[0] if len(self.settings.num_plans) == 1 else GROWN_WITH
        share = curve(starts, one.prior, [budget], self.generator).share[0]
        named = {"prior": one.label, "sees": one.sees, "round": one.rounds}
        return named | {"length": length, "num_plans": budget, "share": share}

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
