"""Made-up runs of a comparison, for tests, with known results."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

BUDGETS = [2**k for k in range(13)]
ACTIONS = ["up", "right", "down", "left"]
TIMES = {"uniform": 1.0, "markov-1": 4.0, "markov-2": 8.0, "gru": 16.0}
"""How many random plans one plan of each prior is worth."""


def curve(times: float, shift: float = 0.0, most: int = BUDGETS[-1]) -> list[float]:
    """Normalised scores that climb by as much with every doubling of the plans; `times` random plans are worth one."""
    return [(math.log2(budget) + math.log2(times)) / (2 * math.log2(most)) + shift for budget in BUDGETS]


def entry(prior: str | None, share: Sequence[float], context: str = "none", rounds: int = 0, **more: Any) -> dict:
    steps = [8 * budget for budget in BUDGETS[: len(share)]]
    seconds = [None if place % 2 else 0.001 * (place + 1) for place in range(len(share))]
    own = {"planner": "sampling", "prior": prior, "context": context, "rounds": rounds, "share": list(share)}
    own |= {"at_oracle": [one / 2 for one in share], "score": [0.5 * one for one in share], "model_steps": steps}
    return own | {"seconds": seconds, "bits": None, "actions": 0} | more


def run(world: str, seed: int, entries: Sequence[dict], **more: Any) -> dict[str, Any]:
    made = {"world": world, "seed": seed, "about": f"a made-up world called {world}", "length": 8, "num_starts": 32}
    made |= {"seconds": 1.5, "budgets": list(BUDGETS), "entries": list(entries), "curriculum": []}
    return made | {"action_names": ACTIONS, "plans": None} | more


def worlds(
    names: Sequence[str],
    seeds: int,
    times: Mapping[str, float] = TIMES,
    noise: float = 0.02,
    context: Sequence[str] = ("none",),
    rounds: int = 0,
) -> list[dict[str, Any]]:
    """Runs with everything there can be; with context, or after the curriculum, a plan is worth twice as many."""
    rng, made = np.random.default_rng(0), []
    for world in names:
        for seed in range(seeds):
            bumps = {prior: float(bump) for prior, bump in zip(times, rng.normal(0, noise, len(times)), strict=True)}
            entries = [entry(None, [0.6], planner="exhaustive", depth=4)]
            for prior, worth in times.items():
                for way in context if prior != "uniform" else ("none",):
                    for after in sorted({0, rounds}) if prior != "uniform" else (0,):
                        share = curve(worth * 2 ** ((way != "none") + (after > 0)), bumps[prior])
                        bits = 2.0 - math.log2(worth) / 8 - 0.1 * (way != "none") + bumps[prior]
                        entries.append(entry(prior, share, way, after, bits=bits, actions=4000))
            curriculum = [
                {"prior": prior, "context": way, "round": one, "length": 4 + 2 * one, "num_plans": 256, "share": share}
                for prior, worth in times.items()
                for way in context
                for one, share in enumerate(curve(worth, bumps[prior])[-rounds - 1 :])
            ]
            pictures = {"transitions": {prior: rng.dirichlet(np.ones(4), 4).tolist() for prior in times}}
            if seed == 0:
                pictures["plans"] = drawing(rng, list(times))
            made.append(run(world, seed, entries, curriculum=curriculum if rounds else [], **pictures))
    return made


def drawing(rng: np.random.Generator, priors: Sequence[str], side: int = 9) -> dict[str, Any]:
    """A world with a wall and random walks."""
    walls = np.zeros((side, side), dtype=bool)
    walls[2, 3:7] = True
    moves = np.array([[-1, 0], [0, 1], [1, 0], [0, -1]])
    paths = {}
    for prior in priors:
        walks = 4 + np.cumsum(moves[rng.integers(0, 4, (12, 8))], 1)
        walks = np.concatenate([np.full((12, 1, 2), 4), np.clip(walks, 0, side - 1)], 1)
        paths[prior] = walks.tolist()
    reward = rng.random((side, side)).tolist()
    return {
        "height": side,
        "width": side,
        "walls": walls.tolist(),
        "start": [4, 4],
        "paths": paths,
        "reward": reward,
    }
