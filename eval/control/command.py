"""`python -m eval control`: do learned priors help planners of continuous actions?"""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from jsonargparse.typing import PositiveInt

from eval.control.priors import NONE, PriorName, ScoredName
from eval.control.report import Results, control_document
from eval.control.run import (
    Choice,
    Collecting,
    ControlSettings,
    PlannerName,
    Planning,
    Scoring,
    Tuning,
    collecting_run,
    planning_run,
    scoring_run,
    tuning_run,
)
from eval.control.tasks import CONDITIONS, TaskName, check_there
from eval.worlds import runs
from neuroprior._folders import claim_out
from neuroprior._jobs import JobRun
from neuroprior.behaviour.reporting.document import publish, write_figures
from neuroprior.control import VectorPlans, read_vector_plans, write_vector_plans

FEW = ("half_cheetah", "arm")
"""Tasks of the default, which takes about five minutes."""


@claim_out
def control_experiment(
    tasks: Sequence[TaskName] = FEW,
    priors: Sequence[PriorName] = (NONE, "autoregressive", "synergies", "stored"),
    planners: Sequence[PlannerName] = ("icem",),
    budgets: Sequence[PositiveInt] = (8, 16, 32),
    plain_budgets: Sequence[PositiveInt] = (100,),
    seeds: PositiveInt = 3,
    steps: PositiveInt = 60,
    training_runs: PositiveInt = 4,
    training_budget: PositiveInt = 100,
    tuning_budget: PositiveInt = 16,
    tuning_seeds: PositiveInt = 1,
    seed: runs.Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/control",
    scored: Sequence[ScoredName] = (),
    conditions: Sequence[Literal["same", "masses", "goal"]] = CONDITIONS,  # type: ignore[assignment]
) -> None:
    """Do learned priors help planners of continuous actions?

    A plain planner (iCEM) controls a simulator; priors learn from what it executed. Then planners draw a share of their
    candidates from each prior: in the same world, with all masses 1.4 times as large, and with a new goal. The noise of
    each planner, the share of each prior, and whether it proposes plans or noise are chosen on validation seeds, in the
    same world and in one with other masses and another goal than these. Prints tables; writes them (CSV), results.json,
    report.html and figures to a folder. Each prior, condition and seed is a run of its own: interrupted, or with more
    priors or seeds, the same command goes on.

    Args:
        tasks: simulators; all but the arm and the double integrator need the extra mujoco.
        priors: that propose candidates; "none" is the plain planner, to which the others are compared.
        planners: that are given the proposals.
        budgets: candidates that a decision simulates.
        plain_budgets: further ones, for the plain planner alone.
        seeds: repeats of each task, each with training plans, priors and starts of its own; intervals are over them.
        steps: that a run lasts.
        training_runs: runs of the plain planner that priors learn from.
        training_budget: candidates of the plain planner in these.
        tuning_budget: candidates with which settings are chosen.
        tuning_seeds: validation seeds of each task.
        seed: of everything random.
        processes: how many runs are done at a time; all cores by default.
        dask: address of a Dask scheduler, tcp://host:port, whose workers do the runs.
        out: folder for the report and for finished runs.
        scored: further priors that are only fitted and scored on held-out plans.
        conditions: worlds in which planners are tried.
    """
    runs.check_distinct(tasks=tasks, priors=priors, planners=planners, budgets=budgets, plain_budgets=plain_budgets)
    if scored:
        runs.check_distinct(scored=scored)
    runs.check_distinct(conditions=conditions)
    if NONE not in priors:
        raise ValueError(f'`priors` must have "none", the plain planner, to compare with, got {list(priors)}')
    for task in tasks:
        check_there(task)
    numbers = tuple(sorted(budgets))
    settings = ControlSettings(
        numbers,
        tuple(sorted(set(plain_budgets) - set(numbers))),
        steps,
        training_runs,
        training_budget,
        tuning_budget,
        tuning_seeds,
        seed,
    )

    def done(what: str, work: Callable[..., Any], jobs: Sequence[Any], **files: Any) -> list[Any]:
        asked = {"command": f"control {what}", **asdict(settings)}
        run: JobRun[Any, Any] = JobRun(
            partial(work, settings=settings),
            Path(out) / what,
            asked,
            name=attrgetter("name"),
            packages=runs.MAKERS,
            **files,
        )
        return run.do(jobs, processes=processes, dask=dask, title=what)

    def tuned(jobs: Sequence[Tuning]) -> dict[tuple[str, str, str], Choice]:
        chosen = done("tuning", tuning_run, jobs)
        return {(job.world, job.planner, job.prior): Choice(*each) for job, each in zip(jobs, chosen, strict=True)}

    alone = tuned([Tuning(task, planner) for task in tasks for planner in dict.fromkeys(("icem", *planners))])
    learned = [prior for prior in priors if prior != NONE]
    choices = alone | tuned(
        [
            Tuning(task, planner, prior, (alone[task, "icem", NONE], alone[task, planner, NONE]))
            for task in tasks
            for planner in planners
            for prior in learned
        ]
    )
    entries: list[Any] = []
    likelihoods: list[Any] = []
    how_kept = {"save": lambda path, plans: write_vector_plans(plans, path), "load": read_vector_plans}

    def collected(number: int, held_out: bool) -> dict[str, VectorPlans]:
        collecting = [Collecting(task, number, alone[task, "icem", NONE], held_out) for task in tasks]
        plans = done("plans", collecting_run, collecting, **how_kept, suffix=".npz")
        return dict(zip(tasks, plans, strict=True))

    # Seed by seed, so that an experiment that is cut off has all of some seeds.
    for number in range(seeds):
        plans = collected(number, False) if learned else {}
        planning = [
            Planning(task, number, condition, planner, prior, choices[task, planner, prior], plans.get(task))
            for task in tasks
            for condition in CONDITIONS
            if condition in conditions
            for planner in planners
            for prior in priors
        ]
        for rows in done("planning", planning_run, planning):
            entries += rows
    for number in range(seeds if learned or scored else 0):
        plans, held_out = collected(number, False), collected(number, True)
        scoring = [
            Scoring(task, number, prior, plans[task], held_out[task])
            for task in tasks
            for prior in dict.fromkeys((*learned, *scored))
        ]
        likelihoods += done("scoring", scoring_run, scoring)
    shown = {"tasks": list(tasks), "priors": list(priors), "planners": list(planners), "scored": list(scored)}
    shown |= {"conditions": list(conditions), "seeds": seeds} | asdict(settings)
    results = Results(pd.DataFrame(entries), pd.DataFrame(likelihoods))
    settled = {"/".join(place): choice._asdict() for place, choice in choices.items()}
    document = control_document(results, shown | {"choices": settled}, runs.command_line("control"))
    publish(document, Path(out))
    write_figures(Path(out), document.figures)
