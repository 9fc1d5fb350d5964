"""Solve and learn: a prior learns from the problems that were solved with it, and solves the next ones faster."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._files import read_json, write_json, written_whole
from neuroprior._random import draw_seed
from neuroprior.planners.best_first import BestFirstPlanner, LevinPlanner, Search
from neuroprior.plans import Plans
from neuroprior.priors import Prior, load, save

ENOUGH = 0.8
"""Where this share of the problems tried is solved, more are tried in the next sweep."""

MORE = 4
"""So many times as many problems, then."""

NEW = 0.1
"""Where a sweep adds less than this share to the solved problems, and no further problems are left, the budget doubles."""


class Sweep(NamedTuple):
    """A sweep of `bootstrap`.

    Attributes:
        number: from 1.
        problems: how many were tried.
        max_nodes: the budget of each.
        solved: the share of them that this sweep solved.
        solutions: problems with a solution so far.
        mean_expansions: over the problems tried; an unsolved one counts with what was spent on it.
        actions: of the solutions that the prior then learned from, with their reflections and rotations.
        seconds: of this sweep: for solving, and for learning.
    """

    number: int
    problems: int
    max_nodes: int
    solved: float
    solutions: int
    mean_expansions: float
    actions: int
    seconds: tuple[float, float]


def bootstrap(
    world: Any,
    prior: Prior,
    problems: Tensor,
    *,
    max_nodes: int = 2000,
    sweeps: int = 10,
    first: int = 1000,
    symmetries: int | None = None,
    max_actions: int = 2_000_000,
    teacher: BestFirstPlanner | None = None,
    guided: bool = False,
    folder: str | Path | None = None,
    generator: torch.Generator | None = None,
    **settings: Any,
) -> Iterator[Sweep]:
    """Solve problems with a prior, fit it to the solutions, and again (Arfaee, Zilles and Holte 2011, *Learning
    heuristic functions for large state spaces*; with a prior Orseau and Lelis, AAAI 2021).

    The first `first` problems are tried first. When four fifths of them are solved, four times as many are tried; when
    all are tried and few more get solved, the budget doubles. A problem's latest solution counts. The prior learns from
    reflections and rotations of the solutions too, where the world has any.

    Args:
        world: with goals; see `LevinPlanner`.
        prior: fitted in place; count-based priors anew, others from their present weights.
        problems: `[N, ...]` starts.
        max_nodes: expansions for each problem in the first sweep.
        sweeps: at most so many; it ends before that when a sweep solves all problems.
        first: problems in the first sweep.
        symmetries: reflections and rotations of each solution to learn from, itself among them; None: as many as the
            world has and `max_actions` allows.
        max_actions: of all solutions with their symmetries together, about; bounds memory and time.
        teacher: solves the first sweep in the prior's place, such as an `AStarPlanner`; None: the prior as it is.
        guided: search with the world's heuristic (PHS*), not with the prior alone.
        folder: the prior, the solutions and the sweeps are kept there after each sweep, and an interrupted call goes on
            from them; None: nothing is kept.
        generator: draws symmetries, and what the prior's `fit` draws.
        **settings: passed on to the prior's `fit`.

    Yields:
        Each sweep, when the prior has learned from it; finished ones at once.

    Raises:
        ValueError: an argument is out of range; nothing is solved in the first sweep; or the folder is of another call.
    """
    check_sizes(max_nodes=max_nodes, sweeps=sweeps, first=first, max_actions=max_actions)
    if len(problems) == 0:
        raise ValueError("problems: at least one is expected")
    solutions = Solutions(problems)
    done: list[Sweep] = []
    kept = None if folder is None else Path(folder)
    asked = {"problems": len(problems), "max_nodes": max_nodes, "first": first, "guided": guided}
    if kept is not None and (kept / "sweeps.json").exists():
        done = _restore(kept, prior, solutions, asked)
    yield from done
    tried, budget = (min(first, len(problems)), max_nodes) if not done else _next(done[-1], done, len(problems))
    for number in range(len(done) + 1, sweeps + 1):
        begin = time.perf_counter()
        how = {"max_nodes": budget, "heuristic": world.lower_bound if guided else None}
        planner = teacher if teacher is not None and number == 1 else LevinPlanner(prior, **how)
        found = planner.search(world, problems[:tried])
        before = solutions.known
        solutions.take(found)
        if solutions.known == 0:
            raise ValueError(
                f"problems: none of {tried} was solved within {budget} expansions; give a larger budget, a teacher or"
                " easier problems"
            )
        middle = time.perf_counter()
        actions = solutions.teach(prior, world, symmetries, max_actions, generator, settings)
        seconds = middle - begin, time.perf_counter() - middle
        share, mean = float(found.solved.double().mean()), float(found.expansions.double().mean())
        done.append(Sweep(number, tried, budget, share, solutions.known, mean, actions, seconds))
        if kept is not None:
            _keep(kept, prior, solutions, done, asked)
        yield done[-1]
        if tried == len(problems) and share == 1:
            return
        gained = solutions.known - before
        tried, budget = _next_sweep(done[-1], gained, len(problems))
