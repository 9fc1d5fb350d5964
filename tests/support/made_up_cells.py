"""Cells that are made up, quickly, for tests of what runs and keeps them; and the program that makes them."""

import os
import random
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.compare.settings import Settings
from eval.worlds.suite import TASKS
from neuroprior._files import write_json
from neuroprior.report.processes import LAUNCHED

PRIORS = ("uniform", "markov-1", "gru")


def made_up(task: Any, seed: int, settings: Settings) -> dict[str, Any]:
    """A cell by the contract, the same for the same task and settings; slow where `SLOW` says how many seconds."""
    time.sleep(float(os.environ.get("SLOW", 0)))
    world = next(name for name, known in TASKS.items() if known is task)
    draw = random.Random(f"{world} {seed} {settings}").random
    budgets = [2**k for k in range(max(settings.num_plans).bit_length())]
    entries = [
        {"planner": "sampling", "prior": prior, "sees": "nothing", "rounds": 0, "bits": 1 + draw(), "actions": 100}
        | {name: [draw() for _ in budgets] for name in ("share", "at_oracle", "score", "seconds")}
        | {"model_steps": [8 * number for number in budgets]}
        for prior in PRIORS
    ]
    lengths = settings.lengths or (4, 8, 12)
    growth = [
        {"prior": prior, "sees": "nothing", "round": turn, "length": length, "num_plans": 64, "share": draw()}
        for prior in PRIORS[1:]
        for turn in range(settings.rounds + 1)
        for length in lengths
    ]
    return {
        "world": world,
        "seed": seed,
        "about": f"a world, {world}",
        "length": 8,
        "num_starts": settings.starts,
        "seconds": 1.5,
        "budgets": budgets,
        "entries": entries,
        "growth": growth,
        "action_names": None,
    }


def broken(task: Any, seed: int, settings: Settings) -> dict[str, Any]:
    """A cell that fails for seed 1."""
    if seed == 1:
        raise ValueError("no plan scored more than 0")
    return made_up(task, seed, settings)


def environment(task: Any, seed: int, settings: Settings) -> dict[str, Any]:
    """A cell that tells the process and what it knows of torchrun."""
    return {"process": os.getpid(), "launched": sorted(name for name in os.environ if name.startswith(LAUNCHED))}


def torn(task: Any, seed: int, settings: Settings) -> dict[str, Any]:
    """A cell whose process is killed for seed 1, as where memory runs out."""
    if seed == 1:
        os.kill(os.getpid(), 9)
    return made_up(task, seed, settings)


def quick_report(
    cells: Sequence[dict[str, Any]], num_plans: Sequence[int], settings: dict[str, Any], folder: Path, **more: Any
) -> None:
    """All that a report is made of, in one file."""
    write_json(folder / "results.json", {"cells": cells, "num_plans": num_plans, "settings": settings})


if __name__ == "__main__":
    from eval.__main__ import main
    from eval.compare import command as compare
    from eval.compare import run as compare_cell
    from tests.support import made_up_cells

    # A function of this very module would be looked for in the main module of the processes that are started.
    compare_cell.run_cell = getattr(made_up_cells, os.environ.get("CELL", "made_up"))
    compare.write_report = made_up_cells.quick_report
    sys.exit(main())
