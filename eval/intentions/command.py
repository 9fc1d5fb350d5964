"""`python -m eval intentions`: do priors learned toward known goals predict another agent's goal?"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypeAlias

from jsonargparse.typing import PositiveFloat, PositiveInt

from eval.intentions.grid import FORECAST_AFTER, LONGEST, WORLDS, IntentionSettings
from eval.intentions.mice import BLOCKS, STRETCH
from eval.intentions.report import intentions_document
from eval.intentions.run import LABYRINTH, intentions_run
from eval.worlds import runs
from neuroprior._folders import claim_out
from neuroprior.behaviour.reporting.document import write_figures

OFFERED = (*WORLDS, LABYRINTH)
"""Two grids, and the mice's labyrinth."""

ObservedWorld: TypeAlias = Literal[OFFERED]  # type: ignore[valid-type]


@claim_out
def intentions(
    worlds: Sequence[ObservedWorld] = OFFERED,
    seeds: PositiveInt = 10,
    goals: PositiveInt = 6,
    num_plans: Sequence[PositiveInt] = (8, 32, 128, 512),
    agents: PositiveInt = 300,
    observed: Sequence[PositiveInt] = (2, 4, 8, 16),
    ahead: Sequence[PositiveInt] = (4, 8, 16),
    temperature: PositiveFloat = 0.5,
    seed: runs.Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/intentions",
) -> None:
    """Do priors learned toward known goals predict another agent's goal?

    Observers watch agents walk to one of some goals in a grid: one has a prior for each goal, learned from plans
    toward it; one knows how agents act (exact inverse planning). In the labyrinth the goal is the water. Prints
    tables; writes them (CSV), results.json, report.html and a figure. Interrupted, the same command goes on.

    Args:
        worlds: to observe agents in.
        seeds: repeats in each world, with a layout, goals, plans and agents of its own; intervals are over them. In the
            labyrinth the blocks of sequences that are held out, of 10.
        goals: in a grid, at least 2.
        num_plans: numbers of plans toward each goal that priors learn from, at least 2.
        agents: that are observed in each grid.
        observed: numbers of moves after which observers are asked; in the labyrinth, within which the water is reached.
        ahead: moves after which it is forecast where an agent will be.
        temperature: of the softmax by which agents choose moves; a move to the goal is worth 1 more than none.
        seed: of everything random.
        processes: how many runs, a world and a seed each, are done at a time; all cores by default.
        dask: address of a Dask scheduler, tcp://host:port, whose workers do the runs.
        out: folder for the report and for finished runs.
    """
    runs.check_distinct(worlds=worlds, num_plans=num_plans, observed=observed, ahead=ahead)
    limits = {
        "observed": (1, STRETCH),
        "ahead": (1, LONGEST - FORECAST_AFTER),
        "goals": (2, 32),
        "num_plans": (2, 4096),
    }
    for name, values in (("observed", observed), ("ahead", ahead), ("goals", [goals]), ("num_plans", num_plans)):
        low, high = limits[name]
        if wrong := [number for number in values if not low <= number <= high]:
            raise ValueError(f"`{name}` must be integers from {low} to {high}, got {wrong[0]}")
    if LABYRINTH in worlds and seeds > BLOCKS:
        raise ValueError(f"seeds: in the {LABYRINTH} at most {BLOCKS}, the blocks of sequences, not {seeds}")
    numbers, times, later = (tuple(sorted(values)) for values in (num_plans, observed, ahead))
    settings = IntentionSettings(goals, numbers, agents, times, later, temperature, seed)
    how = worlds, seeds, out, processes, dask
    document = runs.run_experiment("intentions", intentions_run, intentions_document, settings, *how)
    write_figures(Path(out), document.figures)
