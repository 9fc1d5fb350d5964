"""`python -m eval live`: agents that plan, execute and learn while food is eaten and grows elsewhere."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypeAlias

from jsonargparse.typing import PositiveInt, restricted_number_type

from eval.live.report import live_document
from eval.live.run import LEARN_EVERY, PARTS, REPLAN_EVERY, LiveSettings, run_live
from eval.live.worlds import FORAGING_WORLDS, ForagingWorldName
from eval.worlds import runs
from neuroprior._folders import claim_out
from neuroprior.behaviour.reporting.document import write_figures

Kind: TypeAlias = Literal[tuple(LEARN_EVERY)]  # type: ignore[valid-type]
Items: TypeAlias = restricted_number_type("Items", int, [(">=", 1), ("<=", 8)], docstring="More takes the oracle long.")  # type: ignore[valid-type]


@claim_out
def live(
    worlds: Sequence[ForagingWorldName] = tuple(FORAGING_WORLDS),
    kinds: Sequence[Kind] = tuple(LEARN_EVERY),
    seeds: PositiveInt = 10,
    seasons: PositiveInt = 4,
    period: PositiveInt = 512,
    agents: PositiveInt = 16,
    items: Items = 4,
    num_plans: PositiveInt = 32,
    length: Literal[4, 8, 16] = 16,
    seed: runs.Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/live",
) -> None:
    """Does it pay to learn a prior online, while food is eaten and grows elsewhere?

    Agents look for food, which grows again in a patch; the patch moves with every season. They differ in the prior that
    proposes their plans: none, one learned in a season before, one that learns online from what they execute; and in
    whether the rest of their last plan is a candidate. Prints rewards in 100 steps, and writes tables (CSV),
    results.json, report.html and a picture of rewards against time in each world to a folder. Interrupted, the same
    command goes on.

    Args:
        worlds: where the agents look for food.
        kinds: of priors that learn.
        seeds: repeats in each world, each with a world, food and priors of its own; intervals are over them.
        seasons: in each the food is in another patch.
        period: steps in a season, a multiple of 64.
        agents: in each world; they share a prior, so that all learn from what one of them did.
        items: of food, at most 8.
        num_plans: candidates of each decision.
        length: actions in a plan.
        seed: of everything random.
        processes: how many runs, a world and a seed each, are done at a time; all cores by default.
        dask: address of a Dask scheduler, tcp://host:port, whose workers do the runs.
        out: folder for the report and for finished runs.
    """
    runs.check_distinct(worlds=worlds, kinds=kinds)
    whole = max(*LEARN_EVERY.values(), PARTS * REPLAN_EVERY)
    if period % whole:
        raise ValueError(f"`period` must be a multiple of {whole}, got {period}")
    settings = LiveSettings(tuple(kinds), period, seasons, agents, items, num_plans, length, seed)
    document = runs.run_experiment("live", run_live, live_document, settings, worlds, seeds, out, processes, dask)
    write_figures(Path(out), {box.name: box.figure for box in document.sections[0].figures})
