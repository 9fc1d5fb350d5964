"""The reports of experiments on runs that are made up: means over seeds, differences, corrections, tables, figures."""

import math

import numpy as np
import pandas as pd

from eval.compare.results import best_difference, chosen, needed
from eval.control.comparison import candidates_needed, differences, savings
from tests.support.unchanged import case


def noise(seed: int, number: int) -> list[float]:
    """Numbers from 0 to 1."""
    return [round(float(value), 6) for value in np.random.default_rng(seed).random(number)]


@case
def choices_among_seeds():
    draws = np.random.default_rng(0)
    first, second = draws.normal(0.5, 0.1, (3, 9)), draws.normal(0.45, 0.1, (4, 9))
    curve = np.array([0.1, 0.4, 0.3, 0.7, 0.75])
    return {
        "best": [
            best_difference(first, second),
            best_difference(first[:1], second[:1]),
            best_difference(first, second, 0.8),
        ],
        "alike": best_difference(np.ones((1, 4)), np.zeros((1, 4))),
        "chosen": [chosen(first), chosen(second), chosen(first[:1])],
        "needed": [needed(curve, [1, 2, 4, 8, 16], target) for target in (0.05, 0.35, 0.5, 0.72, 0.9)],
        "candidates": [
            candidates_needed(np.array([10.0, 20, 40]), np.array([0.1, 0.4, 0.9]), goal) for goal in (0, 0.3, 0.9, 2)
        ],
    }


@case
def continuous_control():
    place = {"world": "w", "task": "w", "condition": "same", "planner": "icem"}
    rows = [
        place
        | {"seed": seed, "prior": prior, "budget": budget}
        | {"return": math.log(budget) + gain + 0.4 * value, "seconds": budget * (1 if prior == "none" else 2)}
        for prior, gain in (("none", 0.0), ("good", 1.0), ("bad", -0.5))
        for number, budget in enumerate((25, 50, 100, 200))
        for seed, value in enumerate(noise(number + len(prior), 6))
    ]
    frame = pd.DataFrame(rows)
    return {"savings": savings(frame), "differences": differences(frame)}
