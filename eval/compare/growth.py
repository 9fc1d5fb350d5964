"""`python -m eval grow`: how much priors gain by planning with them, learning from those plans, and planning longer."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from eval.compare import run as compare_cell
from eval.compare.command import KINDS, SEES, check, command
from eval.compare.growth_report import write_report
from eval.compare.jobs import Study, cells_of, run_cells
from eval.compare.settings import Settings
from eval.worlds.suite import TASKS

ROUNDS = 4
"""Of growth at most, where no lengths are given."""

LISTS: dict[str, dict[str, Any]] = {
    "worlds": {"default": list(TASKS), "choices": tuple(TASKS), "help": "worlds to plan in"},
    "lengths": {"type": int, "help": "actions in the plans of each round; those of the world by default"},
    "kinds": {"default": list(KINDS), "choices": KINDS, "help": "kinds of priors that grow"},
    "sees": {"default": ["nothing"], "choices": SEES, "help": "what priors see: nothing but the plan so far, or more"},
}
"""Options that take several words."""


def grow(
    worlds: list[str] = list(TASKS),  # noqa: B006
    lengths: Sequence[int] | None = None,
    seeds: int = 5,
    num_plans: int = 256,
    kinds: list[str] = list(KINDS),  # noqa: B006
    sees: list[str] = ["nothing"],  # noqa: B006
    steps: int = 600,
    starts: int = 32,
    training_starts: int = 1000,
    seed: int = 0,
    processes: int | None = None,
    out: str = "runs/grow",
) -> None:
    """How much do priors gain by planning with them, learning from those plans, and planning longer?

    All plans of a few actions can be tried; longer ones cannot. In each world, for each seed, priors learn from short
    plans, propose longer ones, learn from the best of these, and so on. Prints the share of the oracle after each
    round; writes tables (CSV), results.json and report.html to a folder. Interrupted, the same command goes on.

    Args:
        worlds: to plan in.
        lengths: actions in the plans of each round, each longer than the one before; by default those of the world.
        seeds: repeats in each world, each with worlds and priors of its own; intervals are over them.
        num_plans: candidate plans, a power of two.
        kinds: of priors: markov, gru, transformer.
        sees: what priors see: nothing but the plan so far, the start as well, or each step.
        steps: of training of each neural prior in a round, at most.
        starts: held-out starts to plan from.
        training_starts: from so many starts plans are collected to learn from, in each round; from several times as
            many in worlds where most starts lead nowhere.
        seed: of everything random.
        processes: how many cells, a world and a seed each, are done at a time; all cores by default, and a single one
            in each process that torchrun started.
        out: folder for the report, and for finished cells, from which an interrupted run goes on.
    """
    longer = tuple(lengths or ())
    for before, after in zip((0, *longer), longer, strict=False):
        if after <= before:
            raise ValueError(f"lengths: from 1, each longer than the one before, not {' '.join(map(str, longer))}")
    if too_deep := [world for world in worlds if longer and world in TASKS and TASKS[world].depth >= longer[0]]:
        depth = TASKS[too_deep[0]].depth
        raise ValueError(
            f"lengths: more than {depth} is expected first: in {too_deep[0]} all plans of {depth} are tried"
        )
    if not kinds:
        raise ValueError("kinds: at least one is expected")
    rounds = len(longer) or ROUNDS
    settings = Settings(
        (num_plans,), tuple(kinds), tuple(sees), rounds, steps, starts, training_starts, seed, lengths=longer
    )
    check(worlds, seeds, processes, settings)
    folder = Path(out)
    study = Study.prepare(folder, settings, compare_cell.run_growth)
    cells = run_cells(study, cells_of(worlds, seeds), processes)
    if cells is not None:
        told = {"worlds": list(worlds), "seeds": seeds} | asdict(settings)
        write_report(cells, told, folder, Console(), command("grow"))
