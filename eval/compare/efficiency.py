"""How many plans a prior needs for what random plans reach: the search efficiency of a comparison's priors."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import optimize, stats

from eval.compare.rows import UNIFORM, Array, Cells, Rows, by_world, number_or_none

CLOSE = 1e-9
"""Shares that differ by less are the same."""


def needed(curve: Array, budgets: Sequence[int], target: float) -> float:
    """The number of plans at which a curve `[budgets]` of shares reaches a target; infinite where it does not.

    Interpolated between budgets on a logarithmic axis. More plans are never worse, so that the curve is made to climb
    first (isotonic regression): else noise would cross the target too early.
    """
    climbing = optimize.isotonic_regression(curve).x
    reached = np.flatnonzero(climbing >= target - CLOSE)
    if not len(reached):
        return float("inf")
    place = int(reached[0])
    if place == 0:
        return float(budgets[0])
    low, high = climbing[place - 1], climbing[place]
    way = min(max((target - low) / (high - low), 0.0), 1.0)
    return float(2 ** (np.log2(budgets[place - 1]) * (1 - way) + np.log2(budgets[place]) * way))


def efficiency(cells: Cells) -> Rows:
    """How many plans each prior needs for what random plans reach at the largest number: medians over seeds.

    `factor` is how many times fewer that are than random plans need: these are as many as there are, unless fewer
    reach the same already. Intervals are those of the sign test, 95 % at least, which hold for any distribution and
    for seeds in which a prior does not get there; None for fewer than 6 seeds. A number of plans that is None, with
    `reached` in less than all seeds, is more than `most`.
    """
    found: Rows = []
    for world, results in by_world(cells).items():
        random = results.entries.get(UNIFORM, {})
        for key in results.priors("uniform", "markov", "neural", "other") if random else []:
            seeds = [seed for seed in results.entries[key] if seed in random]
            if not seeds:
                continue
            climbs = [optimize.isotonic_regression(random[seed]["share"]).x for seed in seeds]
            curves = [np.array(results.entries[key][seed]["share"], dtype=np.float64) for seed in seeds]
            own, others = (
                np.log2([needed(curve, results.budgets, climb[-1]) for curve, climb in zip(some, climbs, strict=True)])
                for some in (curves, climbs)
            )
            row = {"world": world} | key._asdict() | _median("needed", own) | _median("factor", others - own)
            row |= {"reached": int(np.isfinite(own).sum()), "seeds": len(own), "most": results.budgets[-1]}
            found.append(row)
    return found


def _median(name: str, logs: Array) -> dict[str, Any]:
    """The median of what has these logarithms, with the order statistics that hold the true one between them."""
    ordered = np.sort(logs)
    out = int(stats.binom.ppf(0.025, len(logs), 0.5)) - 1
    # Of two in the middle of which one is infinite, the median is on the safe side.
    middle = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    median = sum(middle) / 2 if np.isfinite(middle).all() else middle[int(np.isfinite(middle[0]))]
    ends = (ordered[out], ordered[-1 - out]) if out >= 0 else (np.nan, np.nan)
    values = (number_or_none(2.0**value) if value > -np.inf else None for value in (median, *ends))
    return dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))
