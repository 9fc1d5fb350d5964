"""`python -m eval compare --planners`: several planners with the same priors and as many model steps."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import torch

from eval.compare.curves import ROLLOUTS, TEMPERATURES, Starts, worth
from eval.compare.planner_report import planner_document
from eval.compare.run import Contest, Contestant, Settings
from eval.worlds.runs import MAKERS, Run, check_distinct, command_line, runs_of
from eval.worlds.suite import TASKS
from neuroprior._jobs import JobRun
from neuroprior.planners import (
    CrossEntropyPlanner,
    DistinctPlanner,
    FrontierPlanner,
    MCTSPlanner,
    Planner,
    SamplingPlanner,
    execute,
)
from neuroprior.report.document import publish
from neuroprior.worlds import World

ORDERS = (3,)
"""Orders of the Markov priors that planners are compared with."""

PLANNERS: dict[str, Callable[..., Planner]] = {
    "sampling": SamplingPlanner,
    "distinct": DistinctPlanner,
    "frontier": FrontierPlanner,
    "mcts": MCTSPlanner,
    "cross-entropy": CrossEntropyPlanner,
    "halving": partial(SamplingPlanner, halving=True),
    "replanning": partial(SamplingPlanner, halving=True),
}
"""By their names in tables; "replanning" is halving in a closed loop, planning anew after each action."""

PlannerName = Literal[tuple(PLANNERS)]  # type: ignore[valid-type]

STOCHASTIC, ONLY_STOCHASTIC = {"sampling", "cross-entropy", "halving", "replanning"}, {"halving", "replanning"}
"""Planners for stochastic worlds, and those that plan like another one in deterministic worlds."""

TRAJECTORIES = 8
"""From each start with "replanning", whose score is no single plan's and so cannot be computed."""


@dataclass(frozen=True)
class PlannerSettings(Settings):
    """All that decides the results of a run, beside its world and seed; no `context`: the last of each world's.

    Attributes:
        planners: some of `PLANNERS`.
    """

    planners: tuple[str, ...] = ()


def compare_planners(
    settings: PlannerSettings,
    worlds: Sequence[str],
    seeds: int,
    out: str,
    processes: int | None = None,
    dask: str | None = None,
) -> None:
    """Compare planners and publish the report; see `eval.compare.command.compare`.

    Raises:
        ValueError: a planner is given twice, or no planner suits one of the worlds.
    """
    check_distinct(planners=settings.planners)
    given = set(settings.planners)
    for world in worlds:
        if given & STOCHASTIC and given - ONLY_STOCHASTIC:
            continue  # whatever the world is: some take long to make
        held_out = TASKS[world].worlds(0).held_out
        if not any(suits(name, held_out) for name in settings.planners):
            names = " ".join(settings.planners)
            raise ValueError(f"planners: none of {names} is for {world}; leave it out, or add sampling")
    folder, asked = Path(out), {"command": "planners", **settings.asked}
    work = partial(planner_run, settings=settings)
    jobs = JobRun(work, folder / "runs", asked, name=attrgetter("name"), packages=MAKERS)
    results = jobs.do(runs_of(worlds, seeds), processes=processes, dask=dask, title="compare")
    told = {"worlds": list(worlds), "seeds": seeds} | asdict(settings)
    publish(planner_document(results, told, command_line("compare")), folder)


def planner_run(run: Run, settings: PlannerSettings) -> dict[str, Any]:
    """Collect plans, fit priors, extend their horizons, and plan with each planner and prior, in one seed's worlds.

    Returns:
        `entries`, one of each planner, prior and number of plans: `share` (the normalised score), the `model_steps`
        that were taken, and the `seconds` of a decision.

    Raises:
        ValueError: see `eval.compare.run.compare_priors`.
    """
    task = TASKS[run.world]
    contest = Contest(task, run.seed, replace(settings, context=settings.context or task.contexts[-1:]), ORDERS)
    entries = []
    for one in contest.after_curriculum():
        for name in settings.planners:
            if suits(name, contest.worlds.held_out):
                entries += _entries(contest, one, name)
    return {"world": run.world, "seed": run.seed, "about": task.about, "entries": entries}


def suits(name: str, world: World) -> bool:
    """Whether a planner can plan in a world, and is not there what another one is, too."""
    return name in STOCHASTIC if world.stochastic else name not in ONLY_STOCHASTIC


def _entries(contest: Contest, one: Contestant, name: str) -> list[dict[str, Any]]:
    """What a planner reaches with a prior; the temperature is chosen for both, in the validation worlds."""
    length, generator = contest.task.length, contest.generator

    def reached(starts: Starts, number: int, temperature: float) -> dict[str, Any]:
        how: dict[str, Any] = starts.task.scoring | {"temperature": temperature}
        if starts.world.stochastic:
            how["num_rollouts"] = ROLLOUTS
        if name != "replanning":
            return planned(starts, PLANNERS[name](one.prior, starts.length, number, **how), generator)
        # All decisions together take no more steps than one of the others, but for at least one plan each.
        planner = PLANNERS[name](one.prior, starts.length, max(number // starts.length, 1), **how)
        return replanned(starts, planner, generator)

    best = 1.0
    if one.label != "uniform":
        most = max(contest.settings.num_plans)
        shares = {t: reached(contest.validation_at[length], most, t)["share"] for t in TEMPERATURES}
        best = max(shares, key=lambda t: shares[t])
    label = {"planner": name, "prior": one.label, "sees": one.sees, "temperature": best}
    return [
        label | {"num_plans": number} | reached(contest.starts, number, best) for number in contest.settings.num_plans
    ]


def planned(starts: Starts, planner: Planner, generator: torch.Generator) -> dict[str, Any]:
    """The normalised score of a planner's decisions, and their model steps and seconds for each start."""
    begin = perf_counter()
    decision = planner.plan(starts.world, starts.state, generator)
    seconds = (perf_counter() - begin) / len(starts.state)
    score = decision.score
    if starts.world.stochastic:
        score = worth(starts.task, starts.world, starts.state, decision.plan[:, None].long())[:, 0]
    return {"share": starts.normalised(score), "model_steps": decision.model_steps, "seconds": seconds}


def replanned(starts: Starts, planner: Planner, generator: torch.Generator) -> dict[str, Any]:
    """As `planned`, of as many actions as a plan has, each the first of a new plan; the mean of `TRAJECTORIES`."""
    begin = perf_counter()
    state = starts.state.repeat_interleave(TRAJECTORIES, 0)
    done = execute(planner, starts.world, state, starts.length, 1, generator)
    seconds = (perf_counter() - begin) / len(state)
    score = planner.score(done.rewards.double(), done.states[:, -1]).view(-1, TRAJECTORIES).mean(1)
    return {"share": starts.normalised(score), "model_steps": done.model_steps, "seconds": seconds}
