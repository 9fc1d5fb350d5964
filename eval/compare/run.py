"""What `python -m eval compare` does for one world and one seed: collect plans, fit priors, and plan with them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import Any, Literal, NamedTuple

import torch

from eval.compare.curves import (
    ROLLOUTS,
    Sampling,
    best,
    curve,
    seconds_per_decision,
    tried,
)
from eval.compare.priors import (
    COMBINED,
    NEURAL,
    ORDERS,
    TRAINING,
    chain,
    combined,
    digests,
    load_for,
    network,
)
from eval.worlds.macros import MacroPrior
from eval.worlds.runs import Run
from eval.worlds.starts import Starts, starts_of
from eval.worlds.suite import TASKS, Context, Task
from neuroprior import ExhaustivePlanner, Plans, Prior, UniformPrior, World, collect
from neuroprior._random import draw_seed
from neuroprior.behaviour.analysis.comparison import score
from neuroprior.planners import extend_horizon
from neuroprior.planners.tuning import TEMPERATURES, UNIFORM_SHARES
from neuroprior.sampling import sample_in_world
from neuroprior.worlds import GridWorld

CONTEXTS: dict[Context, Literal["plan", "step"] | None] = {"none": None, "initial": "plan", "per-step": "step"}
"""The context of a prior: its name in options and tables, and how `collect` calls it."""

CURRICULUM_PLANS = 64
"""Candidate plans in the rounds of the horizon curriculum."""

VALIDATION_PLANS = 256
"""Candidate plans with which rounds of the curriculum are compared; ways to sample are chosen with at most as many."""

VALIDATION_TIMES = 2
"""For each held-out start so many in the validation worlds, to choose there how to sample: differences are small."""

TIMED_STARTS = 4
"""Starts planned from together when a decision is timed."""

SAMPLED, DRAWN = 2000, 12
"""Plans in which transitions are counted, and plans that are drawn in a figure."""

SHOWN = ("uniform", "markov-2", "gru")
"""Priors whose plans are drawn in a figure."""


@dataclass(frozen=True)
class Settings:
    """All that decides the results of a run, beside its world and seed; see `eval.compare.command.compare`.

    `context` may be empty, for those of the world (`Task`), and so may `lengths`, the number of actions in a plan round
    by round of the horizon curriculum.
    """

    num_plans: tuple[int, ...]
    kinds: tuple[str, ...]
    context: tuple[Context, ...]
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

    @property
    def validated(self) -> list[int]:
        """The numbers of candidates over which the mean score decides how to sample: all that are not too many."""
        return [number for number in self.num_plans if number <= VALIDATION_PLANS] or [VALIDATION_PLANS]

    @property
    def asked(self) -> dict[str, Any]:
        """The settings with the digests of the files of saved priors, which distinguish finished runs."""
        return asdict(self) | {"digests": digests(self.priors)}


def compare_run(run: Run, settings: Settings, tasks: Mapping[str, Task] = TASKS) -> dict[str, Any]:
    """Collect plans, fit priors, extend their horizons and compare them, in the worlds of one seed.

    Returns:
        What `eval.compare.results` reads.

    Raises:
        ValueError: too few plans or starts lead anywhere, or a saved prior does not fit the world.
    """
    begin, task = perf_counter(), tasks[run.world]
    contest = Contest(run, task, settings)
    entries, rounds, last = contest.exhaustive(), [], {}
    for one in contest.contestants():
        if one.length is not None:
            rounds.append(contest.curriculum_entry(one, one.length))
        if one.rounds in (0, contest.rounds):
            entries.append(contest.entry(one))
        if one.context == "none":
            last[one.label] = one.prior  # the object goes on learning until all rounds are done
    world, generator = contest.worlds.held_out, contest.generator
    return run._asdict() | {
        "about": task.about,
        "length": task.length,
        "num_starts": settings.starts,
        "budgets": settings.budgets,
        "entries": entries,
        "curriculum": rounds,
        "action_names": task.action_names,
        "transitions": {label: transitions(prior, world, generator) for label, prior in last.items()},
        "plans": drawn_plans(last, contest.starts, generator) if run.seed == 0 else None,
        "seconds": perf_counter() - begin,
    }


def curriculum_run(run: Run, settings: Settings, tasks: Mapping[str, Task] = TASKS) -> dict[str, Any]:
    """Extend the horizons of all priors in one seed's worlds; after every round, plan with plans of every length."""
    contest = Contest(run, tasks[run.world], settings)
    curriculum = [
        contest.curriculum_entry(one, length)
        for one in contest.contestants()
        for length in (contest.lengths if one.length is not None else ())
    ]
    return run._asdict() | {"about": contest.task.about, "curriculum": curriculum}


def with_context(plans: Plans, context: Context) -> Plans:
    """Plans with a context at each step, as priors of another context take them (see `CONTEXTS`)."""
    assert plans.context is not None
    kept = {None: None, "plan": plans.context[:, 0], "step": plans.context}[CONTEXTS[context]]
    return replace(plans, context=kept)


class Contestant(NamedTuple):
    """A prior after some rounds of the horizon curriculum, the last of which had plans of `length` actions.

    `length` and `plans`, what it was fitted to last, are None for priors that do not take part in the curriculum.
    """

    label: str
    context: Context
    prior: Prior
    rounds: int
    length: int | None
    plans: Plans | None = None


class Contest:
    """The worlds of a seed, the plans that are collected there, and the starts from which priors are compared."""

    def __init__(self, run: Run, task: Task, settings: Settings, orders: Sequence[int] = ORDERS) -> None:
        self.run, self.task, self.settings, self.orders = run, task, settings, orders
        self.generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + run.seed)
        self.worlds = task.worlds(settings.seed * 10_000 + run.seed)
        self.longer = (settings.lengths or task.lengths)[: settings.rounds]
        self.rounds, self.lengths = len(self.longer), tuple(sorted({task.depth, *self.longer}))
        self.training_starts = settings.training_starts * task.start_factor
        self.starts_at, self.validation_at = (
            {
                length: starts_of(task, world, number, length, self.generator)
                for length in sorted({*self.lengths, task.length})
            }
            for world, number in (
                (self.worlds.held_out, settings.starts),
                (self.worlds.validation, VALIDATION_TIMES * settings.starts),
            )
        )
        self.starts = self.starts_at[task.length]
        self._samplings: dict[tuple[str, str, int, int], Sampling] = {}

    def contestants(self) -> Iterator[Contestant]:
        """All priors, each after every round of its curriculum; the object is the same, and goes on learning."""
        yield Contestant("uniform", "none", UniformPrior(self.worlds.training.num_actions), 0, None)
        for folder in self.settings.priors:
            prior = load_for(folder, self.run.world, self.task.num_actions, self.task.action_names)
            context = next(name for name, per in CONTEXTS.items() if per == prior.context_per)
            yield Contestant(folder, context, prior, 0, None)
        for context in self.settings.context or self.task.contexts:
            if self.task.offers(context):
                yield from self._learners(context)

    def after_curriculum(self) -> Iterator[Contestant]:
        """Each prior after its last round alone; saved priors and the uniform prior have none."""
        return (one for one in self.contestants() if one.rounds == (0 if one.length is None else self.rounds))

    def _learners(self, context: Context) -> Iterator[Contestant]:
        """The fitted priors with a context, after every round."""
        kinds, first, world = self.settings.kinds, with_context(self.first, context), self.worlds.training
        if "markov" in kinds:
            for order in self.orders:
                prior = chain(order, world, first, self.task.feature_sets)
                yield from self._curriculum(f"markov-{order}", context, prior, first)
        training = TRAINING | {"max_steps": self.settings.steps}
        for kind in (kind for kind in NEURAL if kind in kinds):
            prior = network(kind, world, first, draw_seed(self.generator))
            yield from self._curriculum(kind, context, prior, first, **training)
        if COMBINED in kinds:
            prior = combined(world, first, self.task.feature_sets, draw_seed(self.generator))
            yield from self._curriculum(COMBINED, context, prior, first, **training)
        if "macro" in kinds and context == "none":
            yield from self._curriculum("macro", context, MacroPrior(first.num_actions), first)

    def _curriculum(
        self, label: str, context: Context, prior: Prior, first: Plans, **training: Any
    ) -> Iterator[Contestant]:
        """A prior after every round of its curriculum."""
        rounds = extend_horizon(
            prior,
            first,
            self.worlds.training,
            self.longer,
            num_starts=self.training_starts,
            num_plans=CURRICULUM_PLANS,
            min_score=self.task.min_score,
            num_rollouts=ROLLOUTS,
            temperatures=TEMPERATURES,
            uniform_shares=UNIFORM_SHARES,
            generator=self.generator,
            **self.task.scoring,
            **training,
        )
        for number, turn in enumerate(rounds):
            length = (self.task.depth, *self.longer)[number]
            yield Contestant(label, context, prior, number, length, turn.plans)

    @cached_property
    def first(self) -> Plans:
        """What the planner that tries all short plans chooses in the training worlds."""
        return self._collect(self.worlds.training, self.training_starts)

    @cached_property
    def held_out_plans(self) -> Plans:
        """The same in the held-out worlds: the plans whose bits are computed."""
        return self._collect(self.worlds.held_out, self.training_starts // 4)

    def _collect(self, world: World, number: int) -> Plans:
        planner = ExhaustivePlanner(self.task.depth, num_rollouts=ROLLOUTS, **self.task.scoring)
        return collect(planner, world, number, context="step", min_score=self.task.min_score, generator=self.generator)

    def entry(self, one: Contestant) -> dict[str, Any]:
        """What a prior's plans reach in the held-out worlds, and how well it predicts those that were chosen there."""
        sampling, budgets = self.sampling(one, self.task.length), self.settings.budgets
        how = self.starts, one.prior, self.generator, sampling
        reached, timed = curve(*how, budgets), seconds_per_decision(*how, self.settings.num_plans, TIMED_STARTS)
        held_out = with_context(self.held_out_plans, one.context)
        return {
            "planner": "sampling",
            "prior": one.label,
            "context": one.context,
            "rounds": one.rounds,
            "temperature": sampling.temperature,
            "uniform_share": sampling.uniform_share,
            "alone": float(sampling.proposer > 0),
            **reached,
            "seconds": [timed[number][0] if number in timed else None for number in budgets],
            "model_steps": [timed[number][1] if number in timed else None for number in budgets],
            "bits": score(one.label, one.prior, held_out).bits_per_action().mean,
        }

    def curriculum_entry(self, one: Contestant, length: int) -> dict[str, Any]:
        """What a prior's plans of `length` actions reach."""
        number = self.settings.num_plans[0] if len(self.settings.num_plans) == 1 else VALIDATION_PLANS
        how = self.starts_at[length], one.prior, self.generator, self.sampling(one, length)
        share = curve(*how, [number])["share"][0]
        named = {"prior": one.label, "context": one.context, "round": one.rounds}
        return named | {"length": length, "num_plans": number, "share": share}

    def sampling(self, one: Contestant, length: int) -> Sampling:
        """How to sample plans of `length` actions, chosen once; uniform plans are the same however they are drawn."""
        if one.label == "uniform":
            return Sampling()
        key = one.label, one.context, one.rounds, length
        if key not in self._samplings:
            tables = tried(self.validation_at[length], one.prior, self.generator, self.settings.validated)
            self._samplings[key] = best(tables.values())
        return self._samplings[key]

    def exhaustive(self) -> list[dict[str, Any]]:
        """What all short plans reach, one entry; none where longer plans cost more, which would favour the short."""
        starts, world = self.starts, self.worlds.held_out
        if starts.reference < 0 or world.stochastic:
            return []
        begin = perf_counter()
        decision = ExhaustivePlanner(self.task.depth, **self.task.scoring).plan(world, starts.state, self.generator)
        seconds = (perf_counter() - begin) / self.settings.starts
        named = {"planner": "exhaustive", "prior": None, "context": "none", "rounds": 0}
        reached = {name: [value] for name, value in starts.reached(decision.score).items()}
        return [named | reached | {"model_steps": [decision.model_steps], "seconds": [seconds], "bits": None}]


def transitions(prior: Prior, world: World, generator: torch.Generator) -> list[list[float]]:
    """`A x A`: how often each action follows each in plans that are sampled from a prior."""
    state = world.reset(SAMPLED, generator)
    plans = sample_in_world(prior, world, state, 1, 16, generator=generator)[0][:, 0].long()
    pair = plans[:, :-1] * world.num_actions + plans[:, 1:]
    counts = pair.flatten().bincount(minlength=world.num_actions**2).view(world.num_actions, -1).double()
    shares: list[list[float]] = (counts / counts.sum(1, keepdim=True).clamp(min=1)).tolist()
    return shares


def drawn_plans(priors: dict[str, Prior], starts: Starts, generator: torch.Generator) -> dict[str, Any] | None:
    """The walls and rewards of a held-out grid, and plans of some priors from one start; None for other worlds."""
    world = starts.world
    if not isinstance(world, GridWorld) or world.edges == "torus":
        return None
    start = starts.state[:1]
    layout, squares = int(world.layout(start)), world.height * world.width
    rewards = world.reward[int(world.reward_map(start)), :: 4 if world.egocentric else 1]
    paths = {}
    for label in (label for label in SHOWN if label in priors):
        how: dict[str, Any] = {"generator": generator, "keep_states": True}
        rollout = sample_in_world(priors[label], world, start, DRAWN, starts.length, **how)[1]
        assert rollout.states is not None
        states = torch.cat([start.expand(DRAWN)[:, None], rollout.states[0]], 1)
        paths[label] = world.coordinates(states).tolist()
    return {
        "height": world.height,
        "width": world.width,
        "walls": world.walls[layout].tolist(),
        "reward": rewards[layout * squares : (layout + 1) * squares].view(world.height, world.width).tolist(),
        "start": world.coordinates(start)[0].tolist(),
        "paths": paths,
    }
