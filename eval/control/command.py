"""`python -m eval control`: do learned priors help planners of continuous actions?"""

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from jsonargparse.typing import PositiveInt

from eval.control.animation import animate
from eval.control.priors import NONE, check_prior_name, fitted
from eval.control.report import control_document
from eval.control.run import (
    Choice,
    ControlSettings,
    PlannerName,
    chosen,
    control_run,
    planner_of,
    training_plans,
    tuning_run,
)
from eval.control.tasks import TASKS, TaskName, check_there
from eval.worlds import runs
from neuroprior._jobs import JobRun
from neuroprior.report.document import write_figures

FEW = ("half_cheetah", "arm")
"""Tasks of the default, which takes about five minutes."""


def control_experiment(
    tasks: Sequence[TaskName] = FEW,
    priors: Sequence[str] = (NONE, "autoregressive", "synergies", "stored"),
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
    animation: TaskName | None = None,
) -> None:
    """Do learned priors help planners of continuous actions?

    A plain planner (iCEM) controls a simulator; priors learn from what it executed. Then planners draw a share of their
    candidates from each prior: in the same world, with all masses 1.4 times as large, and with a new goal. The noise of
    each planner, the share of each prior, and whether it proposes plans or noise are chosen on validation seeds. Prints
    tables; writes them (CSV), results.json, report.html and figures to a folder. Interrupted, the same command goes on.

    Args:
        tasks: simulators; all but the arm and the double integrator need the extra mujoco.
        priors: that propose candidates; "none" is the plain planner, to which the others are compared. synergies-4: of
            four components.
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
        processes: how many runs, a task and a seed each, are done at a time; all cores by default.
        dask: address of a Dask scheduler, tcp://host:port, whose workers do the runs.
        out: folder for the report and for finished runs.
        animation: draw a run in this task, with stored windows and the most candidates, as TASK.gif in the folder.
    """
    runs.check_distinct(tasks=tasks, priors=priors, planners=planners, budgets=budgets, plain_budgets=plain_budgets)
    for name in priors:
        check_prior_name(name)
    if NONE not in priors:
        raise ValueError('priors: "none", the plain planner, is needed to compare with')
    for task in (*tasks, *([] if animation is None else [animation])):
        check_there(task)
    numbers = tuple(map(int, sorted(budgets)))
    settings = ControlSettings(
        tuple(planners),
        tuple(priors),
        numbers,
        tuple(sorted(set(map(int, plain_budgets)) - set(numbers))),
        int(steps),
        int(training_runs),
        int(training_budget),
        int(tuning_budget),
        int(seed),
    )
    choices = _tuned(tasks, settings, tuning_seeds, out, processes, dask)
    settings = settings.with_choices(choices)
    how = tasks, seeds, out, processes, dask
    document = runs.run_experiment("control", control_run, control_document, settings, *how)
    write_figures(Path(out), document.figures)
    if animation is not None:
        _animated(animation, settings, Path(out))


def _animated(task: str, settings: ControlSettings, out: Path) -> None:
    """A moving picture of iCEM in the world before it changed; a line that says why, where there can be none."""
    one = TASKS[task]
    choice = Choice._make(settings.choices[task]["icem"][NONE]) if task in settings.choices else Choice(0.6, 1.0)
    path = out / f"{task}.gif"
    try:
        prior = fitted("stored", training_plans(one, settings, 0, choice).plans, one.horizon, torch.Generator())
        planner = planner_of(
            "icem", one.horizon, max(settings.budgets), choice._replace(share=0.5, iterations=1), prior
        )
        animate(task, "same", planner, settings.steps, path, torch.Generator().manual_seed(settings.seed))
        print(f"animation: {path}")
    except ValueError as error:
        print(f"no animation: {error}")


def _tuned(
    tasks: Sequence[str],
    settings: ControlSettings,
    seeds: int,
    out: str,
    processes: int | None,
    dask: str | None,
) -> dict[str, Any]:
    """The settings of each planner and prior in each task, chosen on validation seeds; see `chosen`."""
    asked = {"command": "control tuning", **asdict(settings)}
    work = partial(tuning_run, settings=settings)
    jobs = JobRun(work, Path(out) / "tuning", asked, name=attrgetter("name"), packages=runs.MAKERS)
    results = jobs.do(runs.runs_of(tasks, seeds), processes=processes, dask=dask, title="tuning")
    return {task: chosen([one for one in results if one["world"] == task], settings) for task in tasks}
