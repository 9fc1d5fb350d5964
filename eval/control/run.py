"""What `python -m eval control` does: tune on validation seeds, then learn and plan for one task and seed."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from time import perf_counter
from typing import Any, Literal, NamedTuple

import torch

from eval.control.priors import CLONING, NONE, fitted, sees_state
from eval.control.tasks import CONDITIONS, TASKS, ControlTask
from eval.worlds.runs import Run
from neuroprior.planners import Control, ICEMPlanner, MPPIPlanner, ShootingPlanner, VectorPlanner, control
from neuroprior.priors import VectorPrior
from neuroprior.worlds.continuous import ContinuousWorld

PlannerName = Literal["icem", "mppi", "shooting"]
PLANNERS: dict[str, type[ICEMPlanner] | type[MPPIPlanner] | type[ShootingPlanner]] = {
    "icem": ICEMPlanner,
    "mppi": MPPIPlanner,
    "shooting": ShootingPlanner,
}

NOISES = tuple(product((0.3, 0.6, 1.0), (0.0, 1.0, 2.5)))
"""Standard deviations and spectral exponents of the planner's own noise that validation tries."""

SHARES = ((0.25, 0), (0.5, 0), (0.5, 1), (0.8, 1))
"""Shares of the prior's candidates that validation tries, and in how many of iCEM's iterations; 0: in all."""

VALIDATION = 10_000
"""Added to the numbers of seeds for validation."""


@dataclass(frozen=True)
class ControlSettings:
    """How much is done; see `eval.control.command.control_experiment`."""

    planners: tuple[str, ...]
    priors: tuple[str, ...]
    budgets: tuple[int, ...]
    steps: int
    training_runs: int
    training_budget: int
    tuning_budget: int
    seed: int
    choices: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]] = field(default_factory=dict)

    def with_choices(self, choices: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]) -> "ControlSettings":
        """The same, with what `chosen` found for each task."""
        return replace(self, choices=choices)


class Choice(NamedTuple):
    """The settings of a planner with a prior, chosen on validation seeds.

    Attributes:
        std, exponent: of the planner's own noise.
        share: of the prior's candidates; 0 for the plain planner.
        iterations: of iCEM in which the prior proposes; 0: all.
    """

    std: float
    exponent: float
    share: float = 0.0
    iterations: int = 0


def planner_of(name: str, horizon: int, budget: int, choice: Choice, prior: VectorPrior | None) -> VectorPlanner:
    """A planner by name, with what was chosen for it."""
    how: dict[str, Any] = {"std": choice.std, "noise_beta": choice.exponent, "prior": prior}
    how["prior_share"] = choice.share if prior is not None else 0.0
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
        `plain`: of each planner the returns of `NOISES`; `shares`: of each planner and prior the returns of `SHARES`,
        with the noise that was best for this seed.
    """
    task, seed, budget = TASKS[run.world], VALIDATION + run.seed, settings.tuning_budget
    world = task.make("same")
    plain: dict[str, list[float]] = {}
    best: dict[str, Choice] = {}
    for name in dict.fromkeys(("icem", *settings.planners)):
        plain[name] = [
            _return_of(
                controlled(planner_of(name, task.horizon, budget, Choice(*noise), None), world, settings, seed, 1)
            )
            for noise in NOISES
        ]
        best[name] = Choice(*NOISES[_highest(plain[name])])
    plans = training_plans(task, settings, seed, best["icem"]).plans
    shares: dict[str, dict[str, list[float]]] = {name: {} for name in settings.planners}
    for prior_name in settings.priors:
        if prior_name == NONE:
            continue
        prior = fitted(prior_name, plans, task.horizon, generator_of(settings, seed, prior_name))
        for name in settings.planners:
            shares[name][prior_name] = [
                _return_of(
                    controlled(
                        planner_of(
                            name, task.horizon, budget, best[name]._replace(share=share, iterations=number), prior
                        ),
                        world,
                        settings,
                        seed,
                        1,
                    )
                )
                for share, number in SHARES
            ]
    return run._asdict() | {"plain": plain, "shares": shares}


def chosen(results: Sequence[dict[str, Any]], settings: ControlSettings) -> dict[str, dict[str, Choice]]:
    """For each planner and prior the settings with the highest mean return over validation seeds of a task."""
    found: dict[str, dict[str, Choice]] = {}
    for name in dict.fromkeys(("icem", *settings.planners)):
        means = torch.tensor([one["plain"][name] for one in results]).mean(0).tolist()
        plain = Choice(*NOISES[_highest(means)])
        found[name] = {NONE: plain}
        for prior in settings.priors if name in settings.planners else ():
            if prior != NONE:
                means = torch.tensor([one["shares"][name][prior] for one in results]).mean(0).tolist()
                share, number = SHARES[_highest(means)]
                found[name][prior] = plain._replace(share=share, iterations=number)
    return found


def control_run(run: Run, settings: ControlSettings) -> dict[str, Any]:
    """Collect plans, fit every prior to them, and plan in every condition.

    Returns:
        `entries`, one of each condition, planner, prior and budget: `return`, the sum of rewards, and `seconds`, of a
        decision; `alone`, the returns of behaviour cloning; `likelihoods`, one of each prior: held-out `nats` a vector,
        `fit_seconds`, and how many components explain 80 and 95 % of the variance.
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
        for name, (prior_name, prior), budget in product(settings.planners, priors.items(), settings.budgets):
            planner = planner_of(name, task.horizon, budget, own[name][prior_name], prior)
            done = controlled(planner, world, settings, run.seed, 1, name, prior_name, budget)
            decisions = int(done.plans.mask().sum())
            yield {
                "condition": condition,
                "planner": name,
                "prior": prior_name,
                "budget": budget,
                "return": _return_of(done),
                "seconds": done.seconds / max(decisions, 1),
            }


def _return_of(done: Control) -> float:
    return float(done.rewards.sum(1).mean())


def _highest(values: Sequence[float]) -> int:
    return max(range(len(values)), key=lambda index: values[index])


def _components(explained: Sequence[float], share: float) -> int | None:
    """How many components explain at least this share; None where there are none."""
    return next((n for n, so_far in enumerate(explained, 1) if so_far >= share), None) if explained else None
