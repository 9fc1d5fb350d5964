"""`python -m eval compare`: do neural priors help a planner more than Markov chains, in many worlds at equal budget?"""

import inspect
from collections.abc import Mapping, Sequence
from functools import partial, reduce
from typing import Any, Literal

import torch
from jsonargparse.typing import NonNegativeInt, PositiveInt, restricted_number_type

from eval.compare.any_world import compare_in
from eval.compare.beside import Result, finished_runs, put_beside
from eval.compare.planners import PlannerName, PlannerSettings, check_planners, planner_document, planner_run
from eval.compare.priors import COMBINED, NEURAL, load_for
from eval.compare.report import document
from eval.compare.results import Results
from eval.compare.run import Settings, compare_run
from eval.worlds.runs import PowerOfTwo, Seed, check_distinct, run_experiment, runs_of
from eval.worlds.suite import TASKS, Context, WorldName, check_contexts
from neuroprior._folders import claim_out
from neuroprior.behaviour.reporting.document import Document

KINDS = ("markov", "macro", *NEURAL, COMBINED)
"""Kinds of priors that can be fitted."""

Kind = Literal[KINDS]  # type: ignore[valid-type]
TrainingStarts = restricted_number_type("TrainingStarts", int, (">=", 8), docstring="Enough to validate on some.")


@claim_out
def compare(
    worlds: Sequence[WorldName] = tuple(TASKS),
    seeds: PositiveInt = 20,
    num_plans: Sequence[PowerOfTwo] = (16, 64, 256, 1024, 4096),
    priors: Sequence[str] | None = None,
    kinds: Sequence[Kind] | None = None,
    beside: Sequence[str] | None = None,
    planners: Sequence[PlannerName] | None = None,
    context: Sequence[Context] | None = None,
    rounds: NonNegativeInt = 4,
    steps: PositiveInt = 600,
    starts: PositiveInt = 32,
    training_starts: TrainingStarts = 1000,  # type: ignore[valid-type]
    seed: Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/compare",
    world: str | None = None,
    length: PositiveInt | None = None,
    seconds: PositiveInt = 120,
) -> None:
    """Do neural priors help a planner more than Markov chains, in many worlds at equal budget?

    In each world, for each seed: a planner without a prior plans in training worlds, priors learn from its plans, and
    planners sample candidate plans from each prior in held-out worlds. Prints tables; writes them (CSV), results.json
    and report.html to a folder. Interrupted, the same command goes on.

    Args:
        worlds: worlds to compare priors in.
        seeds: repeats in each world, each with worlds (training, validation, held-out) and priors of its own; intervals
            are over them.
        num_plans: numbers of candidate plans, powers of two.
        priors: model folders to compare, such as `neuroprior fit` writes.
        kinds: kinds of priors that are fitted: markov, macro (a chain of order 2 over actions and 16 macro-actions,
            without context), gru, transformer, combined (of the chains and a GRU); all by default, but none if there
            are saved ones.
        beside: folders (--out) of finished comparisons in the same worlds, with the same seeds and settings, whose
            other priors are put into the tables too. They should be of the same version of the code, which is not
            checked; that random plans reach the same is.
        planners: some of sampling, frontier, mcts, halving and replanning (these two in
            stochastic worlds): they are compared, not priors, at as many model steps, with uniform plans, a chain of
            order 3 and the networks of --kinds, after the horizon curriculum.
        context: contexts of priors: none (the plan so far alone), initial (the first observation too) or per-step; by
            default none and, in worlds where it could help, one or both of the others (with --planners the last alone).
        rounds: rounds of the horizon curriculum, at most (worlds have two or three): a prior learns from plans found
            with it, each time longer ones; 0: none.
        steps: steps of training of each neural prior, at most.
        starts: held-out starts to plan from.
        training_starts: from so many starts training plans are collected; from several times as many in worlds where
            most starts lead nowhere.
        seed: of everything random.
        processes: how many runs, a world and a seed each, are done at a time; all cores by default.
        dask: address of a Dask scheduler whose workers do the runs, such as tcp://host:8786.
        out: folder for the report, and for finished runs, from which an interrupted command goes on.
        world: a world of yours instead, made by a function without arguments: my_module:make_world. Priors and planners
            (all by default) are compared there by `neuroprior.compare`, for as many seeds as there is time for; the
            table and figure are written to --out. Of the options above, worlds, beside, context, rounds, steps and dask
            are not for it.
        length: with --world: actions in a plan.
        seconds: with --world: the time in which all should be done.
    """
    saved = tuple(priors or ())
    if world is not None:
        check_for_any_world(worlds=worlds, beside=beside, context=context, rounds=rounds, steps=steps, dask=dask)
        asked_for: dict[str, Any] = {"kinds": kinds, "planners": planners, "length": length, "processes": processes}
        sizes: dict[str, Any] = {"seeds": seeds, "starts": starts, "training_starts": training_starts}
        compare_in(world, num_plans=num_plans, priors=saved, seconds=seconds, seed=seed, out=out, **asked_for, **sizes)
        return
    if length is not None:
        raise ValueError("`length` is for --world alone; worlds of the comparison have lengths of their own")
    fitted = tuple(([] if saved else KINDS) if kinds is None else kinds)
    if not fitted and not saved:
        raise ValueError("`kinds` must have at least one prior, unless there are --priors")
    check_distinct(worlds=worlds, num_plans=num_plans)
    more = {"priors": saved, "kinds": fitted, "context": tuple(context or ())}
    check_distinct(**{name: values for name, values in more.items() if values})
    check_contexts(worlds, context or ())
    check_saved(saved, worlds)
    how = (tuple(num_plans), fitted, tuple(context or ()), rounds, steps, starts, training_starts, seed, saved)
    where = (worlds, seeds, out, processes, dask)
    if planners is None:
        settings = Settings(*how)
        if out in (beside or ()):
            raise ValueError(f"beside: {out} is the folder of this comparison (out); give those of others")
        others = {folder: finished_runs(folder, settings, runs_of(worlds, seeds)) for folder in beside or ()}
        run_experiment("compare", compare_run, partial(report, others=others), settings, *where)
    elif beside:
        raise ValueError("beside: priors are compared with those of another run, planners are not; leave it out")
    else:
        check_planners(planners, worlds)
        asked = PlannerSettings(*how, planners=tuple(planners))
        run_experiment("compare --planners", planner_run, planner_document, asked, *where)


def report(
    runs: Sequence[Result], settings: Mapping[str, Any], line: str, others: Mapping[str, Sequence[Result]] = {}
) -> Document:
    """The document of a comparison of priors, with those of other comparisons, by their folders."""
    results = Results(reduce(put_beside, others.values(), runs), settings["num_plans"])
    return document(results, {**settings, **({"beside": list(others)} if others else {})}, line)


def check_for_any_world(**options: object) -> None:
    """Raise ValueError for an option of `compare` that has another value than by default, and is not for --world."""
    defaults = inspect.signature(compare).parameters
    for name, value in options.items():
        if value is not None and (tuple(value) if isinstance(value, list) else value) != defaults[name].default:
            raise ValueError(f"`{name}` is not for --world; leave it out")


def check_saved(folders: Sequence[str], worlds: Sequence[str]) -> None:
    """Raise ValueError unless saved priors have the actions and contexts of all worlds; before hours of work."""
    observations: dict[str, torch.Tensor] = {}  # by world: some take long to make
    for folder in folders:
        if folder == "uniform" or folder in KINDS or folder.startswith("markov-"):
            raise ValueError(f"priors: {folder} is also the name of a fitted prior; give the folder as ./{folder}")
        for world in worlds:
            task = TASKS[world]
            prior = load_for(folder, world, task.num_actions, task.action_names)
            if prior.takes_context:
                if world not in observations:
                    held_out = task.worlds(0).held_out
                    observations[world] = held_out.context(held_out.reset(1, torch.Generator().manual_seed(0)))
                try:
                    prior.check_context_of(observations[world], 1)
                except ValueError as error:
                    raise ValueError(f"{folder}: its context is not what the world {world} offers ({error})") from error
