"""The reports of experiments on runs that are made up: means over seeds, differences, corrections, tables, figures."""

import math
from typing import Any

import numpy as np
import pandas as pd

from eval.compare.curriculum import curriculum_document
from eval.compare.planners import planner_document
from eval.compare.report import FRAMES, document
from eval.compare.results import Results, best_difference, chosen, needed
from eval.control.comparison import candidates_needed, differences, savings
from eval.live.report import live_document, live_frame, live_pairs
from eval.live.run import PARTS, conditions
from eval.options.report import options_document
from eval.worlds.runs import across_worlds, paired_differences, plus_minus, seed_means, significance
from tests.support.compare_runs import TIMES, worlds
from tests.support.pinned.report import of_document
from tests.support.unchanged import case


def noise(seed: int, number: int) -> list[float]:
    """Numbers from 0 to 1."""
    return [round(float(value), 6) for value in np.random.default_rng(seed).random(number)]


@case(slow=True)
def comparison_of_priors():
    """Priors that are nearly alike, so that choices, corrections and intervals matter."""
    times = {**TIMES, "combined": 15.0, "transformer": 13.0, "runs/mine": 3.0}
    runs = worlds(["maze", "taxi"], 7, times, 0.05, context=("none", "initial"), rounds=1)
    made = Results(runs, (16, 256, 4096))
    found: dict[str, Any] = {name: getattr(made, name) for name in FRAMES.values()}
    shown = of_document(document(Results(runs, (16, 4096)), {"seeds": 7}, "python -m eval compare"), figures=False)
    return found | {"shown": made.shown, "document": shown | {"frames": None}}


@case(slow=True)
def figures_of_a_comparison():
    runs = worlds(["maze"], 6, {**TIMES, "combined": 3.0}, context=("none", "initial"), rounds=1)
    made = document(Results(runs, (16, 4096)), {}, "")
    return {section.title: [box.figure for box in section.figures] for section in made.sections}


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
def means_and_pairs():
    rows = [
        {
            "world": world,
            "prior": prior,
            "seed": seed,
            "share": value,
            "first": value,
            "second": 0.5 * value + 0.2,
            "seconds": seed,
        }
        for (world, prior, seed), value in zip(
            [(world, prior, seed) for world in ("a", "b", "c") for prior in ("p", "q") for seed in range(5)],
            noise(3, 30),
            strict=True,
        )
    ]
    frame = pd.DataFrame(rows)
    gaps = paired_differences(frame, ["world", "prior"])
    means = seed_means(frame, ["world", "prior"], "share", ["seconds"])
    return {
        "means": means,
        "pairs": gaps,
        "across": across_worlds(frame, ["prior"]),
        "said": [significance(gaps, "Scores"), significance(gaps[:0], "Scores")],
        "written": [plus_minus(row, "share", 100) for _, row in means.iterrows()],
    }


@case
def live_learning():
    results = []
    for world in ("forage_grid", "forage_maze"):
        for seed in range(4):
            own = [*conditions(("markov", "gru"))]
            values = noise(hash_of(world, seed), len(own))
            entries = [
                one._asdict()
                | {"model_steps": 10 + place, "seconds": 0.1}
                | {"rewards": [value + 0.01 * place + 0.02 * part for part in range(3 * PARTS)]}
                for place, (one, value) in enumerate(zip(own, values, strict=True))
            ]
            results.append(
                {"world": world, "seed": seed, "about": "made up", "period": 64, "places": 36, "entries": entries}
            )
    found = of_document(live_document(results, {"period": 64}, ""))
    return found | {"pairs": live_pairs(live_frame(results)).reset_index(drop=True)}


def hash_of(*parts: object) -> int:
    """A seed."""
    return sum(ord(letter) * (place + 1) for place, letter in enumerate(" ".join(map(str, parts))))


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


@case
def options_and_planners():
    results = []
    for seed in range(4):
        draws = iter(noise(seed, 200))
        labels = ["flat", "switching-2", "flat-2", "options-2", "kept-2", "uniform"]
        entries = [
            {
                "prior": label,
                "context": "none",
                "length": 8,
                "num_plans": number,
                "share": next(draws),
                "bits": next(draws),
            }
            for label in labels
            for number in (2, 8, 32)
        ]
        results.append({"world": "maze", "seed": seed, "about": "a maze", "entries": entries})
    found = {"options": of_document(options_document(results, {"modes": [2], "num_plans": [2, 8, 32]}, ""))}
    of_planners = [(planner, number) for planner in ("sampling", "mcts", "frontier") for number in (4, 16)]
    runs = [
        {"world": world, "seed": seed, "about": "a maze"}
        | {
            "entries": [
                {"planner": planner, "prior": "gru", "context": "initial", "num_plans": number, "share": value}
                | {"model_steps": 8 * number, "seconds": 0.01 * number}
                for (planner, number), value in zip(of_planners, noise(seed + len(world), 6), strict=True)
            ]
        }
        for world in ("maze", "grid")
        for seed in range(5)
    ]
    found["planners"] = of_document(planner_document(runs, {}, ""))
    of_rounds = [(prior, turn, length) for prior in ("gru", "markov-1") for turn in (0, 1, 2) for length in (4, 8)]
    curricula = [
        {"world": "maze", "seed": seed}
        | {
            "curriculum": [
                {"prior": prior, "round": turn, "length": length, "share": value, "context": "none", "num_plans": 64}
                for (prior, turn, length), value in zip(of_rounds, noise(seed, 12), strict=True)
            ]
        }
        for seed in range(5)
    ]
    return found | {"curriculum": of_document(curriculum_document(curricula, {}, ""))}
