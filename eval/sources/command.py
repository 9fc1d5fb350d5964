"""`python -m eval sources`: several priors that share a planner's candidates, against each of them alone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypeAlias

from jsonargparse.typing import PositiveInt

from eval.sources.report import sources_document
from eval.sources.run import SOURCES, WORLDS, SourceSettings, run_sources
from eval.worlds import runs
from neuroprior._folders import claim_out
from neuroprior.behaviour.reporting.document import write_figures
from neuroprior.comparison.trial import MIN_LEARNED

SourceWorld: TypeAlias = Literal[tuple(WORLDS)]  # type: ignore[valid-type]


@claim_out
def sources(
    worlds: Sequence[SourceWorld] = tuple(WORLDS),
    plans: Sequence[PositiveInt] = (20, 100, 500),
    seeds: PositiveInt = 5,
    calls: PositiveInt = 24,
    starts: PositiveInt = 16,
    num_plans: PositiveInt = 32,
    seed: runs.Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/sources",
) -> None:
    """Are several priors that share a planner's candidates nowhere behind the best of them alone?

    Priors learn from the same plans. Then a planner makes decisions with candidates of uniform plans, of each prior
    alone, and of all together; these shares follow how often each had the best candidate. Prints tables; writes them
    (CSV), results.json and report.html to a folder. Interrupted, the same command goes on.

    Args:
        worlds: to plan in.
        plans: numbers of plans to learn from.
        seeds: repeats in each world, each with plans, priors and starts of its own; intervals are over them.
        calls: of the planner, after each of which the shares change.
        starts: decisions in each call.
        num_plans: candidates of each decision.
        seed: of everything random.
        processes: how many runs, a world and a seed each, are done at a time; all cores by default.
        dask: address of a Dask scheduler, tcp://host:port, whose workers do the runs.
        out: folder for the report and for finished runs.
    """
    runs.check_distinct(worlds=worlds, plans=plans)
    for name, least, number in (
        ("plans", MIN_LEARNED, min(plans)),
        ("calls", 2, calls),
        ("num_plans", len(SOURCES), num_plans),
    ):
        if number < least:
            raise ValueError(f"`{name}` must be at least {least}, got {number}")
    settings = SourceSettings(tuple(sorted(plans)), calls, starts, num_plans, seed)
    document = runs.run_experiment(
        "sources", run_sources, sources_document, settings, worlds, seeds, out, processes, dask
    )
    write_figures(Path(out), {box.name: box.figure for box in document.sections[0].figures})
