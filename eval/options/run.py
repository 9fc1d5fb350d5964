"""What `python -m eval options` does for one world and one seed: fit priors to the same plans, and plan with them."""

from collections.abc import Iterator
from copy import copy
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from eval.options.priors import Entrant, entrants
from eval.worlds.contexts import ContextIndex
from eval.worlds.labyrinth import DATA, cut_plans, data_digest, dry_nodes, reaching_planner, shares_reached
from eval.worlds.runs import Run
from eval.worlds.starts import Starts, starts_of
from eval.worlds.suite import TASKS
from neuroprior import ExhaustivePlanner, Plans, SamplingPlanner, World, collect, read_plans
from neuroprior.planners.tuning import choices
from neuroprior.worlds import Categories, labyrinth

LABYRINTH = "labyrinth"
"""The world whose plans are the mice's; the others are those of `eval.worlds.suite`."""

HELD_OUT = 0.2
"""Share of the mice's sequences on which bits are measured."""

MICE_ORDERS, ORDERS = {"none": 4, "per-step": 1}, {"none": 2, "per-step": 1}
"""Orders of the chains of modes, by context: in the labyrinth, and in the other worlds."""

MORE_STARTS = 4
"""So many times as many starts in other worlds as in the labyrinth, where plans are longer."""

ROWS = 2**14
"""Candidates drawn together."""


@dataclass(frozen=True)
class OptionSettings:
    """How much is done; see `eval.options.command.options`."""

    num_plans: tuple[int, ...]
    lengths: tuple[int, ...]
    modes: tuple[int, ...]
    starts: int
    training_starts: int
    seed: int

    @property
    def asked(self) -> dict[str, Any]:
        """The settings, and the mice's moves: what distinguishes finished runs."""
        return asdict(self) | {"data": data_digest()}


def options_run(run: Run, settings: OptionSettings) -> dict[str, Any]:
    """Fit all priors, and plan with each.

    Returns:
        `entries`, one of each prior, context, length and number of candidates: `share`, what of the nodes (labyrinth)
        or of the optimum was reached; and `bits`.
    """
    generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + run.seed)
    if run.world == LABYRINTH:
        about, entries = "the mice's labyrinth: to pass the water", _labyrinth_entries(settings, generator)
    else:
        about, entries = TASKS[run.world].about, _world_entries(run, settings, generator)
    return run._asdict() | {"about": about, "entries": list(entries)}


def _labyrinth_entries(settings: OptionSettings, generator: torch.Generator) -> Iterator[dict[str, Any]]:
    world = labyrinth(absorbing=True)
    dry = dry_nodes(world)
    start = dry[torch.randperm(len(dry), generator=generator)[: settings.starts]]
    parts = cut_plans(read_plans(DATA), max(settings.lengths)).split(HELD_OUT, generator)
    for context, contexts in (("none", None), ("per-step", world.num_states)):
        training, held_out = parts if contexts else (plans.without_context() for plans in parts)
        for one in entrants(training, held_out, contexts, settings.modes, MICE_ORDERS[context], generator):
            most = max(settings.lengths), max(settings.num_plans)
            planner = reaching_planner(one.prior, *most, make=one.planner)
            shares = shares_reached(planner, world, start, settings.lengths, settings.num_plans, generator)
            for length, length_shares in zip(settings.lengths, shares.tolist(), strict=True):
                yield from _entries(one, context, length, settings.num_plans, length_shares)


def _world_entries(run: Run, settings: OptionSettings, generator: torch.Generator) -> Iterator[dict[str, Any]]:
    task = TASKS[run.world]
    worlds = task.worlds(settings.seed * 10_000 + run.seed)
    starts = starts_of(task, worlds.held_out, MORE_STARTS * settings.starts, task.length, generator)
    searching = ExhaustivePlanner(task.depth, **task.scoring)

    def searched(world: World, number: int) -> Plans:
        return collect(searching, world, number, context="step", min_score=task.min_score, generator=generator)

    number = settings.training_starts * task.start_factor
    training, held_out = searched(worlds.training, number), searched(worlds.held_out, number // 4)
    index = index_of(training, task.feature_sets)
    for context, contexts in (("none", None), ("per-step", index.size)):
        learned, others, world = training.without_context(), held_out.without_context(), worlds.held_out
        if contexts:
            learned, others, world = numbered(training, index), numbered(held_out, index), observed(world, index)
        for one in entrants(learned, others, contexts, settings.modes, ORDERS[context], generator):
            planner = one.planner(one.prior, task.length, max(settings.num_plans), **task.scoring)
            shares = scores_reached(planner, replace(starts, world=world), settings.num_plans, generator)
            yield from _entries(one, context, task.length, settings.num_plans, shares)


def _entries(
    one: Entrant, context: str, length: int, numbers: tuple[int, ...], shares: list[float]
) -> Iterator[dict[str, Any]]:
    named = {"prior": one.label, "context": context, "bits": one.bits, "length": length}
    for number, share in zip(numbers, shares, strict=True):
        yield named | {"num_plans": number, "share": share}


def index_of(plans: Plans, feature_sets: tuple[tuple[int, ...], ...]) -> ContextIndex:
    """Numbers of the contexts of plans; of features the smallest set counts, so that few held-out contexts are new."""
    assert plans.context is not None
    return ContextIndex(plans.context[plans.mask()], min(feature_sets, key=len, default=None))


def numbered(plans: Plans, index: ContextIndex) -> Plans:
    """Plans whose contexts are numbers."""
    assert plans.context is not None
    return replace(plans, context=index(plans.context), context_names=None)


def observed(world: World, index: ContextIndex) -> World:
    """A world in which numbers of contexts are observed."""
    copied, observe = copy(world), world.observe

    def number(state: Tensor) -> Tensor:
        return index(observe(state))

    copied.observe = number  # type: ignore[method-assign]
    copied.observation = Categories(index.size)
    return copied


def scores_reached(
    planner: SamplingPlanner, starts: Starts, num_plans: tuple[int, ...], generator: torch.Generator
) -> list[float]:
    """The normalised score of a planner with each number of candidates; fewer than its own are blocks of them."""
    parts = starts.state.split(max(ROWS // planner.num_plans, 1))
    score = torch.cat([planner.candidates(starts.world, state, generator)[1] for state in parts])
    shares = []
    for number in num_plans:
        best = score.gather(1, choices(score, planner.num_plans, number, 0.0))
        shares.append(starts.normalised(best.mean(1)))
    return shares
