"""Runs of a comparison that are made up, quickly, for tests."""

import random
from typing import Any

from eval.compare.run import Settings
from eval.worlds.runs import Run

PRIORS = ("uniform", "markov-1", "gru")


def made_up(run: Run, settings: Settings) -> dict[str, Any]:
    """The same results for the same run and settings."""
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
