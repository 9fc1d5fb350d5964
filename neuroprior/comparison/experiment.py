"""`compare`: whether priors help planners in a world, over independent repeats within a given time."""

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import inf, isfinite

import torch

from neuroprior._checks import check_flags, check_sizes, is_number
from neuroprior._jobs import each_result, sending_error
from neuroprior._random import draw_seed, generator_on
from neuroprior.comparison.contestants import (
    PLANNERS,
    MakePlanner,
    PriorSource,
    learns,
    name_planners,
    name_priors,
    suited,
)
from neuroprior.comparison.pacing import MIN_SEEDS, PLANNING_SHARE, Progress, fit_starts, seconds_per_step
from neuroprior.comparison.results import Comparison
from neuroprior.comparison.trial import MIN_LEARNED, Design, Outcome, collector_name, run_seed
from neuroprior.worlds import World
from neuroprior.worlds.world import check_is_world

DEFAULT_LENGTH = 10
"""Actions in a plan."""

DEFAULT_STARTS, DEFAULT_TRAINING_STARTS = 50, 500
"""Starts of a seed, if the world is fast enough."""

DEFAULT_TRAINING_BUDGET = 256
"""Plans that are tried from each training start, or as many as the largest budget."""

WORKER_SECONDS = 10.0
"""Work that takes less than this is not worth starting processes for."""

PROCESS_SECONDS = 5.0
"""About how long a process takes to start."""

SAFETY = 1.5
"""Seeds that are run side by side may take so many times as long as the first."""


def compare(
    world: World,
    priors: Sequence[PriorSource] | Mapping[str, PriorSource] = ("uniform", "markov", "gru", "combined"),
    planners: Sequence[str | MakePlanner] | Mapping[str, str | MakePlanner] = tuple(PLANNERS),
    budgets: Sequence[int] = (16, 64, 256),
    *,
    held_out: World | None = None,
    length: int | None = None,
    starts: int | None = None,
    training_starts: int | None = None,
    seeds: int = 12,
    seconds: float | None = 120.0,
    jobs: int | None = None,
    progress: bool = True,
    generator: torch.Generator | None = None,
) -> Comparison:
    """Compare priors and planners in a world: does a prior help there?

    In each of several repeats (seeds), starts are drawn by `world.reset`, and a planner without a prior plans from the
    training starts. Each prior learns from those of its plans that beat random ones. Then every planner plans from the
    held-out starts with every prior, and what the chosen plans really get is scored: exactly in deterministic worlds
    and in tables, else by fresh rollouts. Planners optimise the world's objective. Priors get the world's observations
    as context if it declares an `observation`.

    What is independent is the seed: starts and priors are drawn anew in each, and all priors and planners share them.
    So each seed counts once, with the means over its starts. A score is the ratio of two sums over seeds: what was
    gained over random plans, and what could be. Its interval and the paired test against uniform plans are Student's,
    on the residuals of the seeds from the ratio. With one seed they are over starts, and how much a prior varies from
    one training to another is not in them.

    Args:
        world: where plans are collected and, from other starts, priors are compared.
        priors: names ("uniform", "markov", the best of several orders, "gru", "combined" and others of
            `neuroprior.fit`), priors, and classes or functions that make one; or a mapping of names to these. A prior
            that has learned, such as a loaded one, is compared as it is; others are fitted anew in each seed. All are
            compared with "uniform".
        planners: names ("sampling", "frontier", "mcts"), and classes or functions that are called with a prior,
            `length` and `num_plans`; or a mapping of names to these. Those of the names that cannot plan in a
            stochastic world are left out there.
        budgets: numbers of candidate plans for each start. Every planner may take so many times `length` simulator
            steps. In a stochastic world the sampling planner tries fewer plans, each several times.
        held_out: another world of the same actions, where priors are compared; None: in `world`.
        length: actions in a plan; None: 10.
        starts: held-out starts of each seed; None: 50, or fewer where simulator steps are slow.
        training_starts: starts from which training plans are collected; None: 500, or fewer where steps are slow.
        seeds: independent repeats, at most.
        seconds: the time in which all should be done: no seed is begun that would end later if it took about as long as
            the first, which is always finished. None: no limit, so that the result does not depend on the machine.
        jobs: processes; None: one for each core. The results do not depend on it, unless the time is up.
        progress: print what is done to standard error.
        generator: source of randomness.

    Returns:
        The comparison: `frame()`, `figure()`, and `print` shows a summary. After Ctrl-C, that of the finished seeds.

    Raises:
        ValueError: an argument is out of range, no planner can plan in the world, or a prior cannot learn in it.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> comparison = compare(world, ["markov"], ["sampling"], [4], length=3, starts=8, training_starts=40, seeds=2)
        >>> comparison.rows[1].prior, comparison.rows[1].budget
        ('markov', 4)
    """
    begin = time.time()
    _check(world, held_out, budgets, starts, training_starts, length, seeds, seconds, jobs, progress)
    sources, makers = name_priors(priors, world), name_planners(planners)
    where, notes = held_out or world, []
    names = suited(list(makers), makers, where)
    if not names:
        raise ValueError(f"`planners` must have one for stochastic worlds, such as sampling, got {', '.join(makers)}")
    design = Design(
        world,
        held_out,
        sources,
        {name: makers[name] for name in names},
        tuple(sorted(set(budgets))),
        length or DEFAULT_LENGTH,
        starts or DEFAULT_STARTS,
        training_starts or DEFAULT_TRAINING_STARTS,
        max(*budgets, DEFAULT_TRAINING_BUDGET),
    )
    if length is None:
        notes.append(f"Plans have {DEFAULT_LENGTH} actions, as no `length` was given.")
    if len(names) < len(makers):
        left_out = ", ".join(name for name in makers if name not in names)
        notes.append(f"The world is stochastic, where {left_out} cannot plan.")
    generator = generator_on(generator, "cpu")
    numbers = [draw_seed(generator) for _ in range(seeds)]
    jobs = jobs or os.cpu_count() or 1
    with Progress(progress) as printer:
        printer.print(f"priors {', '.join(sources)}; planners {', '.join(names)}")
        if seconds is not None:
            design, cuts = _fit(design, seconds * jobs, starts, training_starts)
            notes += cuts
        outcomes, ends = _run(design, numbers, jobs, begin + (inf if seconds is None else seconds), printer)
    notes += ends + _describe(outcomes, design, where)
    return Comparison(tuple(outcomes), tuple(names), tuple(sources), design.budgets, design.length, tuple(notes))


def _run(
    design: Design, seeds: Sequence[int], jobs: int, deadline: float, printer: Progress
) -> tuple[list[Outcome], list[str]]:
    """The outcomes of the seeds that were finished, in order, and notes on what was not."""
    total, notes = len(seeds), []
    outcomes: dict[int, Outcome] = {}

    def name(number: int) -> str:
        return f"seed {number + 1}"

    def run_first(number: int) -> Outcome | None:
        return run_seed(seeds[number], design, lambda what: printer.tell(f"seed 1 of {total}: {what}"))

    for _, outcome in each_result(run_first, [0], 1, name=name):
        assert outcome is not None
        outcomes[0] = outcome
    longest = outcomes[0].seconds
    jobs, reason = _processes(design, (total - 1) * longest, jobs)
    notes += reason
    start_by = deadline - longest * (SAFETY if jobs > 1 else 1.0)
    if time.time() + (PROCESS_SECONDS if jobs > 1 else 0.0) > start_by:
        seeds = seeds[:1]  # no other would begin
    rest = partial(_run_numbered, seeds=tuple(seeds), design=design, start_by=start_by)
    printer.tell(f"1 of {total} seeds")
    try:
        for number, outcome in each_result(rest, range(1, len(seeds)), jobs, name=name):
            if outcome is not None:
                outcomes[number] = outcome
                printer.tell(f"{len(outcomes)} of {total} seeds")
        if len(outcomes) < total:
            notes.append(f"Time for {len(outcomes)} of {total} seeds; give more `seconds` for narrower intervals.")
    except KeyboardInterrupt:
        notes.append(f"Interrupted after {len(outcomes)} of {total} seeds.")
    printer.print(f"{len(outcomes)} of {total} seeds")
    return [outcomes[number] for number in sorted(outcomes)], notes


def _run_numbered(number: int, seeds: Sequence[int], design: Design, start_by: float) -> Outcome | None:
    return run_seed(seeds[number], design, start_by=start_by)


def _processes(design: Design, seconds: float, jobs: int) -> tuple[int, list[str]]:
    """How many processes are worth it for so many seconds of work, and possible; and why there is but one."""
    if jobs == 1 or seconds < WORKER_SECONDS:
        return 1, []
    error = sending_error(design)
    if error is None:
        return jobs, []
    return 1, [f"Seeds were run one after another: what is compared cannot be sent to other processes ({error})."]


def _fit(design: Design, seconds: float, starts: int | None, training_starts: int | None) -> tuple[Design, list[str]]:
    """The design with as many starts as there is time for, of those that were not asked for, and a note if fewer."""
    collector = collector_name(design.world)
    training = seconds_per_step(design.world, design.length, collector)
    planners = [collector if name == collector else "sampling" for name in design.planners]
    rates = {name: seconds_per_step(design.held_out or design.world, design.length, name) for name in set(planners)}
    each = sum(rates[name] for name in planners) / len(planners)
    cut = fit_starts(design, each, training, seconds * PLANNING_SHARE / MIN_SEEDS)
    cut = replace(cut, starts=starts or cut.starts, training_starts=training_starts or cut.training_starts)
    if all(getattr(cut, size) == getattr(design, size) for size in ("starts", "training_starts", "training_budget")):
        return design, []
    return cut, [
        f"A simulator step takes {1e6 * each:.0f} microseconds, so that each seed has {cut.starts} held-out and"
        f" {cut.training_starts} training starts, with {cut.training_budget} plans tried from each."
    ]


def _describe(outcomes: Sequence[Outcome], design: Design, where: World) -> list[str]:
    """Notes on what the outcomes rest on."""
    notes = []
    if any(outcome.same_starts for outcome in outcomes):
        notes.append("All starts are the same state: priors learned from plans that begin where they are compared.")
    idle = sum(outcome.num_learned == 0 for outcome in outcomes)
    if idle and any(map(learns, design.priors.values())):
        where_not = "" if idle == len(outcomes) else f" in {idle} of {len(outcomes)} seeds"
        notes.append(
            f"Priors learned nothing{where_not}: fewer than {MIN_LEARNED} of {design.training_starts} training plans"
            " scored more than random ones. Longer plans or larger budgets may help."
        )
    if where.stochastic and outcomes[0].best is not None:
        notes.append("The optimum is that of policies that see each state, which no plan may reach.")
    return notes


def _check(
    world: World,
    held_out: World | None,
    budgets: object,
    starts: int | None,
    training_starts: int | None,
    length: int | None,
    seeds: int,
    seconds: float | None,
    jobs: int | None,
    progress: bool,
) -> None:
    """Raise ValueError for an argument that is out of range."""
    check_is_world(world)
    if held_out is not None:
        check_is_world(held_out)
        if held_out.num_actions != world.num_actions:
            raise ValueError(
                f"`held_out` must have {world.num_actions} actions, as `world`, got {held_out.num_actions}"
            )
    if not isinstance(budgets, Sequence) or isinstance(budgets, str) or not budgets:
        raise ValueError(f"`budgets` must be a list of numbers of plans, got {budgets!r}")
    for budget in budgets:
        check_sizes(budgets=budget)
    optional = {"length": length, "starts": starts, "training_starts": training_starts, "jobs": jobs}
    check_sizes(seeds=seeds, **{name: size for name, size in optional.items() if size is not None})
    if training_starts is not None and training_starts < MIN_LEARNED:
        raise ValueError(f"`training_starts` must be at least {MIN_LEARNED}, got {training_starts}")
    if seconds is not None and not (is_number(seconds) and isfinite(seconds) and seconds > 0):
        raise ValueError(f"`seconds` must be above 0 or None, got {seconds!r}")
    check_flags(progress=progress)
