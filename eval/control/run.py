"""What `python -m eval control` does in its runs: tune on validation seeds, collect plans, score priors, and plan."""

from collections.abc import Sequence
from dataclasses import dataclass
from time import process_time
from typing import Any, Literal, NamedTuple

import torch

from eval.control.priors import CLONING, NONE, fit_prior
from eval.control.tasks import TASKS, Condition
from neuroprior.control import (
    ContinuousWorld,
    Control,
    ICEMPlanner,
    MPPIPlanner,
    ShootingPlanner,
    VectorPlanner,
    VectorPlans,
    VectorPrior,
    control,
)

PlannerName = Literal["icem", "mppi", "shooting"]
PLANNERS: dict[str, type[ICEMPlanner] | type[MPPIPlanner] | type[ShootingPlanner]] = {
    "icem": ICEMPlanner,
    "mppi": MPPIPlanner,
    "shooting": ShootingPlanner,
}

STDS = (0.05, 0.12, 0.3, 0.6, 1.0)
EXPONENTS = (1.0, 0.0, 2.5)
"""Standard deviations of the planner's own noise that validation tries with the first of the exponents of its spectrum,
and the exponents, tried with the best of these."""

PROPOSALS: tuple[dict[str, Any], ...] = (
    {"share": 0.0},
    {"share": 0.25},
    {"share": 0.6, "iterations": 1},
    {"share": 0.5, "proposes": "noise"},
)
"""What validation tries of a prior, as parts of a `Choice`; first the planner alone, to fall back to."""

VALIDATION_WORLDS: tuple[Condition, ...] = ("same", "validation")
"""Where settings are validated: in the world of the plans, and in one that changed in another way than those of the
results."""

VALIDATION = 10_000
"""Added to the numbers of seeds for validation."""

VALIDATION_STARTS = 2
"""Runs of each setting on a validation seed, in each world."""


@dataclass(frozen=True)
class ControlSettings:
    """What decides the result of each run; see `eval.control.command.control_experiment`."""

    budgets: tuple[int, ...]
    plain_budgets: tuple[int, ...]
    steps: int
    training_runs: int
    training_budget: int
    tuning_budget: int
    tuning_seeds: int
    seed: int


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


def make_planner(name: str, horizon: int, budget: int, choice: Choice, prior: VectorPrior | None) -> VectorPlanner:
    """A planner by name, with what was chosen for it."""
    how: dict[str, Any] = {"std": choice.std, "noise_beta": choice.exponent, "prior": prior}
    how |= {"prior_share": choice.share if prior is not None else 0.0, "prior_as": choice.proposes}
    if name == "icem":
        how["prior_iterations"] = choice.iterations or None
    return PLANNERS[name](horizon, budget, **how)


class Tuning(NamedTuple):
    """A search for the settings of a planner, alone or with a prior, in a task.

    Attributes:
        world: name of the task.
        planner, prior: their names; `NONE` for the planner alone.
        choices: what was chosen for iCEM alone, which collects plans, and for the planner alone; None: nothing yet.
    """

    world: str
    planner: str
    prior: str = NONE
    choices: tuple[Choice, Choice] | None = None

    @property
    def name(self) -> str:
        """Its name in messages and files."""
        return f"{self.world}-{self.planner}-{self.prior}"


class Collecting(NamedTuple):
    """Runs of the plain planner in a task, in the world before it changed.

    Attributes:
        world: name of the task.
        seed: of the runs.
        choice: the settings of iCEM.
        held_out: whether priors are scored on these runs, or learn from them.
    """

    world: str
    seed: int
    choice: Choice
    held_out: bool = False

    @property
    def name(self) -> str:
        """Its name in messages and files."""
        return f"{self.world}-{self.seed}" + "-held-out" * self.held_out


class Scoring(NamedTuple):
    """A prior in a task that is fitted to plans, and scored on others."""

    world: str
    seed: int
    prior: str
    plans: VectorPlans
    held_out: VectorPlans

    @property
    def name(self) -> str:
        """Its name in messages and files."""
        return f"{self.world}-{self.prior}-{self.seed}"


class Planning(NamedTuple):
    """A planner with a prior that is fitted to plans, or alone, in one condition of a task, with all budgets."""

    world: str
    seed: int
    condition: Condition
    planner: str
    prior: str
    choice: Choice
    plans: VectorPlans | None

    @property
    def name(self) -> str:
        """Its name in messages and files."""
        return f"{self.world}-{self.condition}-{self.planner}-{self.prior}-{self.seed}"


def generator_of(settings: ControlSettings, seed: int, *place: object) -> torch.Generator:
    """The generator of one use of a seed: contestants of equal seeds meet equal starts, and are independent else."""
    number = (settings.seed * 1_000_003 + seed) * 1_000_003
    for name in place:
        for letter in str(name):
            number = (number * 31 + ord(letter)) % 2**61
    return torch.Generator().manual_seed(number)


def control_starts(
    planner: VectorPlanner, world: ContinuousWorld, settings: ControlSettings, seed: int, starts: int, *place: object
) -> Control:
    """A run from each of the seed's starts."""
    state = world.reset(starts, generator_of(settings, seed, "starts"))
    return control(planner, world, state, settings.steps, generator_of(settings, seed, *place))


def collecting_run(run: Collecting, settings: ControlSettings) -> VectorPlans:
    """What the plain planner executed, in runs from starts of their own; half as many are held out as are learned from.

    The context is what was observed before each vector.
    """
    task, world, number = TASKS[run.world], TASKS[run.world].make("same"), settings.training_runs
    what = "held out" if run.held_out else "training"
    starts = max(number // 2, 1) if run.held_out else number
    state = world.reset(starts, generator_of(settings, run.seed, what, "starts"))
    planner = make_planner("icem", task.horizon, settings.training_budget, run.choice, None)
    return control(planner, world, state, settings.steps, generator_of(settings, run.seed, what)).plans


def tuning_run(run: Tuning, settings: ControlSettings) -> Choice:
    """The settings with the highest return in `VALIDATION_WORLDS`, over validation seeds.

    Returns of a world are divided by the mean size of those of all settings in it, so that both worlds count alike.
    """
    task, seeds = TASKS[run.world], range(VALIDATION, VALIDATION + settings.tuning_seeds)
    worlds = {name: task.make(name) for name in VALIDATION_WORLDS}
    priors: dict[int, VectorPrior | None] = dict.fromkeys(seeds)
    if run.prior != NONE:
        assert run.choices is not None
        for seed in seeds:
            plans = collecting_run(Collecting(run.world, seed, run.choices[0]), settings)
            priors[seed] = fit_prior(run.prior, plans, task.horizon, generator_of(settings, seed, run.prior))

    def best(choices: Sequence[Choice]) -> Choice:
        returns = torch.tensor(
            [
                [
                    sum(
                        _return_of(
                            control_starts(
                                make_planner(run.planner, task.horizon, settings.tuning_budget, choice, priors[seed]),
                                worlds[name],
                                settings,
                                seed,
                                VALIDATION_STARTS,
                            )
                        )
                        for seed in seeds
                    )
                    for name in worlds
                ]
                for choice in choices
            ]
        )
        shares = returns / returns.abs().mean(0)
        return choices[int(shares.sum(1).argmax())]

    if run.prior != NONE:
        assert run.choices is not None
        return best([run.choices[1]._replace(**proposal) for proposal in PROPOSALS])
    first = best([Choice(std, EXPONENTS[0]) for std in STDS])
    return best([first._replace(exponent=exponent) for exponent in EXPONENTS])


def scoring_run(run: Scoring, settings: ControlSettings) -> dict[str, Any]:
    """Fit a prior, and score held-out plans.

    Returns:
        `nats`, the log-density of a vector of held-out plans; `fit_seconds`.
    """
    task = TASKS[run.world]
    began = process_time()
    prior = fit_prior(run.prior, run.plans, task.horizon, generator_of(settings, run.seed, run.prior))
    seconds = process_time() - began
    held_out = run.held_out if run.prior == CLONING else run.held_out.without_context()
    with torch.no_grad():
        nats = float(prior.log_prob(held_out).sum() / held_out.mask().sum())
    return {"world": run.world, "seed": run.seed, "prior": run.prior, "nats": nats, "fit_seconds": seconds}


def planning_run(run: Planning, settings: ControlSettings) -> list[dict[str, Any]]:
    """Fit a prior, and control the world with it, once with each budget.

    Returns:
        A row for each budget: `return`, the sum of rewards; `seconds`, processor time of a decision, which other
        programs on the machine change less than wall-clock.
    """
    task = TASKS[run.world]
    world, place = task.make(run.condition), {"world": run.world, "seed": run.seed, "condition": run.condition}
    prior = None
    if run.prior != NONE:
        assert run.plans is not None
        prior = fit_prior(run.prior, run.plans, task.horizon, generator_of(settings, run.seed, run.prior))
    # Without a share of candidates it is the plain planner, and draws the same numbers: they do not differ by chance.
    drawn_as = run.prior if run.choice.share else NONE
    entries = []
    for budget in (*settings.budgets, *(settings.plain_budgets if prior is None else ())):
        planner = make_planner(run.planner, task.horizon, budget, run.choice, prior)
        began = process_time()
        done = control_starts(planner, world, settings, run.seed, 1, run.planner, drawn_as, budget)
        seconds, decisions = process_time() - began, max(int(done.plans.mask().sum()), 1)
        entries.append(
            place
            | {"planner": run.planner, "prior": run.prior, "budget": budget, "return": _return_of(done)}
            | {"seconds": seconds / decisions}
        )
    return entries


def _return_of(done: Control) -> float:
    return float(done.rewards.sum(1).mean())
