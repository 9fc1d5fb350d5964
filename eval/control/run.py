"""What `python -m eval control` does: tune on validation seeds, then learn and plan for one task and seed."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from statistics import median
from time import perf_counter
from typing import Any, Literal, NamedTuple

import torch

from eval.control.priors import CLONING, NONE, fitted, sees_state
from eval.control.tasks import CONDITIONS, TASKS, ControlTask
from eval.worlds.runs import Run
from neuroprior.planners import Control, ICEMPlanner, MPPIPlanner, ShootingPlanner, VectorPlanner, control
from neuroprior.priors import VectorPrior
from neuroprior.worlds.continuous import ContinuousWorld

Choices = Mapping[str, Mapping[str, Mapping[str, Sequence[Any]]]]
"""The numbers of a `Choice` by task, planner and prior."""

PlannerName = Literal["icem", "mppi", "shooting"]
PLANNERS: dict[str, type[ICEMPlanner] | type[MPPIPlanner] | type[ShootingPlanner]] = {
    "icem": ICEMPlanner,
    "mppi": MPPIPlanner,
    "shooting": ShootingPlanner,
}

NOISES = tuple(product((0.05, 0.12, 0.3, 0.6, 1.0), (0.0, 1.0, 2.5)))
"""Standard deviations and spectral exponents of the planner's own noise that validation tries."""

PROPOSALS: tuple[dict[str, Any], ...] = (
    {"share": 0.25},
    {"share": 0.5, "iterations": 1},
    {"share": 0.8, "iterations": 1},
    {"share": 0.5, "proposes": "noise"},
    {"share": 0.9, "proposes": "noise"},
)
"""What validation tries of a prior, as parts of a `Choice`."""

VALIDATION = 10_000
"""Added to the numbers of seeds for validation."""

VALIDATION_STARTS = 4
"""Runs of each setting on a validation seed."""

TIMED = 5
"""How often drawing a decision's candidates from a prior is timed; the median counts."""


@dataclass(frozen=True)
class ControlSettings:
    """How much is done; see `eval.control.command.control_experiment`."""

    planners: tuple[str, ...]
    priors: tuple[str, ...]
    budgets: tuple[int, ...]
    plain_budgets: tuple[int, ...]
    steps: int
    training_runs: int
    training_budget: int
    tuning_budget: int
    seed: int
    choices: Choices = field(default_factory=dict)

    def with_choices(self, choices: Choices) -> "ControlSettings":
        """The same, with what `chosen` found for each task."""
        return replace(self, choices=choices)


class Choice(NamedTuple):
    """The settings of a planner with a prior, chosen on validation seeds.

    Attributes:
        std, exponent: of the planner's own noise.
        share: of the prior's candidates; 0 for the plain planner.
        iterations: of iCEM in which the prior proposes; 0: all.
        proposes: "plans" or "noise", see `VectorPlanner`.
    """

    std: float
    exponent: float
    share: float = 0.0
    iterations: int = 0
    proposes: str = "plans"


def planner_of(name: str, horizon: int, budget: int, choice: Choice, prior: VectorPrior | None) -> VectorPlanner:
    """A planner by name, with what was chosen for it."""
    how: dict[str, Any] = {"std": choice.std, "noise_beta": choice.exponent, "prior": prior}
    how |= {"prior_share": choice.share if prior is not None else 0.0, "prior_as": choice.proposes}
    if name == "icem":
        how["prior_iterations"] = choice.iterations or None
    return PLANNERS[name](horizon, budget, **how)


def generator_of(settings: ControlSettings, seed: int, *place: object) -> torch.Generator:
    """The generator of one use of a seed: contestants of equal seeds meet equal starts, and are independent else."""
    number = (settings.seed * 1_000_003 + seed) * 1_000_003
    for part in place:
        for letter in str(part):
            number = (number * 31 + ord(letter)) % 2**61
    return torch.Generator().manual_seed(number)


def controlled(
    planner: VectorPlanner, world: ContinuousWorld, settings: ControlSettings, seed: int, starts: int, *place: object
) -> Control:
    """A run from each of the seed's starts."""
    state = world.reset(starts, generator_of(settings, seed, "starts"))
    return control(planner, world, state, settings.steps, generator_of(settings, seed, *place))


def training_plans(task: ControlTask, settings: ControlSettings, seed: int, choice: Choice) -> Control:
    """What the plain planner executed in the world before it changed, in runs from other starts."""
    world = task.make("same")
    state = world.reset(settings.training_runs, generator_of(settings, seed, "training starts"))
    planner = planner_of("icem", task.horizon, settings.training_budget, choice, None)
    return control(planner, world, state, settings.steps, generator_of(settings, seed, "training"))


def tuning_run(run: Run, settings: ControlSettings) -> dict[str, Any]:
    """The return of every setting on one validation seed, in the world before it changed.

    Returns:
        `plain`: of each planner the returns of `NOISES`; `with_prior`: of each planner and prior the returns of
        `PROPOSALS`, with the noise that was best for this seed.
    """
    task, seed, budget = TASKS[run.world], VALIDATION + run.seed, settings.tuning_budget
    world = task.make("same")

    def returned(name: str, choice: Choice, prior: VectorPrior | None = None) -> float:
        planner = planner_of(name, task.horizon, budget, choice, prior)
        return _return_of(controlled(planner, world, settings, seed, VALIDATION_STARTS))

    plain: dict[str, list[float]] = {}
    best: dict[str, Choice] = {}
    for name in dict.fromkeys(("icem", *settings.planners)):
        plain[name] = [returned(name, Choice(*noise)) for noise in NOISES]
        best[name] = Choice(*NOISES[_highest(plain[name])])
    plans = training_plans(task, settings, seed, best["icem"]).plans
    with_prior: dict[str, dict[str, list[float]]] = {name: {} for name in settings.planners}
    for prior_name in settings.priors:
        if prior_name == NONE:
            continue
        prior = fitted(prior_name, plans, task.horizon, generator_of(settings, seed, prior_name))
        for name in settings.planners:
            with_prior[name][prior_name] = [
                returned(name, best[name]._replace(**proposal), prior) for proposal in PROPOSALS
            ]
    return run._asdict() | {"plain": plain, "with_prior": with_prior}


def chosen(results: Sequence[dict[str, Any]], settings: ControlSettings) -> dict[str, dict[str, Choice]]:
    """For each planner and prior the settings with the highest mean return over validation seeds of a task."""
    found: dict[str, dict[str, Choice]] = {}
    for name in dict.fromkeys(("icem", *settings.planners)):
        means = torch.tensor([one["plain"][name] for one in results]).mean(0).tolist()
        plain = Choice(*NOISES[_highest(means)])
        found[name] = {NONE: plain}
        for prior in settings.priors if name in settings.planners else ():
            if prior != NONE:
                means = torch.tensor([one["with_prior"][name][prior] for one in results]).mean(0).tolist()
                found[name][prior] = plain._replace(**PROPOSALS[_highest(means)])
    return found


def control_run(run: Run, settings: ControlSettings) -> dict[str, Any]:
    """Collect plans, fit every prior to them, and plan in every condition.

    Returns:
        `entries`, one of each condition, planner, prior and budget: `return`, the sum of rewards, `seconds`, of a
        decision, and `sampling`, those of them in which the prior is drawn from; `alone`, the returns of behaviour
        cloning; `likelihoods`, one of each prior: held-out `nats` a vector, `fit_seconds`, and how many components
        explain 80 and 95 % of the variance.
    """
    task = TASKS[run.world]
    own = {
        planner: {prior: Choice._make(numbers) for prior, numbers in some.items()}
        for planner, some in settings.choices[run.world].items()
    }
    plans = training_plans(task, settings, run.seed, own["icem"][NONE]).plans
    held_out = training_plans(task, settings, run.seed + 2 * VALIDATION, own["icem"][NONE]).plans
    priors: dict[str, VectorPrior | None] = {}
    likelihoods = []
    for name in settings.priors:
        if name == NONE:
            priors[name] = None
            continue
        began = perf_counter()
        prior = fitted(name, plans, task.horizon, generator_of(settings, run.seed, name))
        seconds = perf_counter() - began
        some = held_out if sees_state(name) else held_out.without_context()
        nats = float(prior.action_log_probs(some).sum() / some.mask().sum())
        explained = getattr(prior, "explained", ())
        likelihoods.append(
            {"prior": name, "nats": nats, "fit_seconds": seconds}
            | {f"for_{share}": _components(explained, share / 100) for share in (80, 95)}
        )
        priors[name] = prior
    entries = list(_entries(run, settings, task, own, priors))
    alone = [] if CLONING not in priors else list(_alone(run, settings, task, priors[CLONING]))
    found = {"entries": entries, "likelihoods": likelihoods, "alone": alone}
    return run._asdict() | {"about": task.about} | found


def _alone(
    run: Run, settings: ControlSettings, task: ControlTask, prior: VectorPrior | None
) -> Iterator[dict[str, Any]]:
    """Behaviour cloning: the prior's first draw is executed at each step."""
    for condition in CONDITIONS:
        world = task.make(condition)
        done = controlled(
            ShootingPlanner(1, 1, prior=prior, prior_share=1.0, warm_start=False), world, settings, run.seed, 1, "alone"
        )
        yield {"condition": condition, "prior": CLONING, "return": _return_of(done)}


def _entries(
    run: Run,
    settings: ControlSettings,
    task: ControlTask,
    own: dict[str, dict[str, Choice]],
    priors: dict[str, VectorPrior | None],
) -> Iterator[dict[str, Any]]:
    for condition in CONDITIONS:
        world = task.make(condition)
        for name, (prior_name, prior) in product(settings.planners, priors.items()):
            choice = own[name][prior_name]
            for budget in (*settings.budgets, *(settings.plain_budgets if prior is None else ())):
                planner = planner_of(name, task.horizon, budget, choice, prior)
                done = controlled(planner, world, settings, run.seed, 1, name, prior_name, budget)
                yield {
                    "condition": condition,
                    "planner": name,
                    "prior": prior_name,
                    "budget": budget,
                    "return": _return_of(done),
                    "seconds": done.seconds / max(int(done.plans.mask().sum()), 1),
                    "sampling": sampling_seconds(planner, done),
                }


def sampling_seconds(planner: VectorPlanner, done: Control) -> float:
    """How long the planner's prior takes to draw what a decision needs, after all of a run; 0 without a prior."""
    number = round(planner.prior_share * planner.num_plans)
    if planner.prior is None or not number:
        return 0.0
    context = done.plans.context
    assert context is not None
    past, generator = done.plans.actions[:1, : int(done.plans.mask()[0].sum())], torch.Generator().manual_seed(0)
    # The observation before the next step is not among those of the run.
    seen = torch.cat([context[:1, : past.shape[1]], context[:1, :1]], 1) if planner.prior.takes_context else None
    times = []
    for _ in range(TIMED):
        began = perf_counter()
        drawn = number * (1 + (planner.prior_as == "noise"))
        planner.prior.sample(drawn, planner.length, seen, past=past, generator=generator)
        times.append(perf_counter() - began)
    return median(times)


def _return_of(done: Control) -> float:
    return float(done.rewards.sum(1).mean())


def _highest(values: Sequence[float]) -> int:
    return max(range(len(values)), key=lambda index: values[index])


def _components(explained: Sequence[float], share: float) -> int | None:
    """How many components explain at least this share; None where there are none."""
    return next((n for n, so_far in enumerate(explained, 1) if so_far >= share), None) if explained else None
