"""Runs of a comparison that are made up, quickly, for tests; as a program, the command with made-up runs."""

import os
import random
import sys
import time
from typing import Any

from eval.compare.run import Settings
from eval.worlds.runs import Run

PRIORS = ("uniform", "markov-1", "gru")


def made_up(run: Run, settings: Settings) -> dict[str, Any]:
    """The same results for the same run and settings; slow where `SLOW` says how many seconds."""
    time.sleep(float(os.environ.get("SLOW", 0)))
    draw = random.Random(f"{run.world} {run.seed} {settings}").random
    budgets = [2**k for k in range(max(settings.num_plans).bit_length())]
    entries = [
        {"planner": "sampling", "prior": prior, "context": "none", "rounds": 0, "bits": 1 + draw(), "actions": 100}
        | {name: [draw() for _ in budgets] for name in ("share", "at_oracle", "score", "seconds")}
        | {"model_steps": [8 * number for number in budgets]}
        for prior in PRIORS
    ]
    lengths = settings.lengths or (4, 8, 12)
    curriculum = [
        {"prior": prior, "context": "none", "round": number, "length": length, "num_plans": 64, "share": draw()}
        for prior in PRIORS[1:]
        for number in range(settings.rounds + 1)
        for length in lengths
    ]
    return {
        "world": run.world,
        "seed": run.seed,
        "about": f"a world, {run.world}",
        "length": 8,
        "num_starts": settings.starts,
        "seconds": 1.5,
        "budgets": budgets,
        "entries": entries,
        "curriculum": curriculum,
        "action_names": None,
    }


def broken(run: Run, settings: Settings) -> dict[str, Any]:
    """A run that fails for seed 1."""
    if run.seed == 1:
        raise ValueError("no plan scored more than 0")
    return made_up(run, settings)


def killed(run: Run, settings: Settings) -> dict[str, Any]:
    """A run whose process is killed for seed 1, as where memory runs out."""
    if run.seed == 1:
        os.kill(os.getpid(), 9)
    return made_up(run, settings)


if __name__ == "__main__":
    from eval.__main__ import main
    from eval.compare import command
    from tests.support import made_up_runs

    # A function of this very module would be looked for in the main module of the processes that are started.
    command.compare_run = made_up_runs.made_up
    sys.exit(main())
