"""Comparisons in the results of `python -m eval control`, paired by seed: frames that the report shows."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from eval.control.priors import CLONING, NETWORK, NONE, SIMPLE
from eval.worlds import runs
from neuroprior._statistics import ENOUGH_UNITS

REFERENCE = 100
"""Candidates of the plain planner whose return is to be reached with fewer, or the nearest number that is tried."""

RESAMPLES = 1000
"""Of seeds, for the intervals of `savings`."""


def pair_by_seed(pairs: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """`runs.paired_differences`; no p-values, and so no verdict, from fewer than `ENOUGH_UNITS` seeds."""
    gaps = runs.paired_differences(pairs, by)
    if pairs["seed"].nunique() < ENOUGH_UNITS:
        gaps[["p_value", "p_holm"]] = float("nan")
    return gaps


def differences(frame: pd.DataFrame) -> pd.DataFrame:
    """The return with each prior minus that of the plain planner, paired by seed; see `runs.paired_differences`."""
    place = ["world", "condition", "planner", "budget"]
    plain = frame.loc[frame["prior"] == NONE, [*place, "seed", "return"]].rename(columns={"return": "second"})
    pairs = frame[frame["prior"] != NONE].rename(columns={"return": "first"}).merge(plain, on=[*place, "seed"])
    return pair_by_seed(pairs, [*place, "prior"])


def savings(frame: pd.DataFrame) -> pd.DataFrame:
    """How many candidates reach what the plain planner reaches with `REFERENCE`, and how much time that takes.

    Returns and times are interpolated between budgets, linearly in the logarithm of the budget. The interval is a
    bootstrap over seeds, of the prior and the plain planner together.

    Returns:
        A row for each task, condition, planner and prior: `reference`, candidates of the plain planner; `needed`, of
        the planner with the prior, infinite where the largest budget does not suffice; `low`, `high` (missing with
        fewer than five seeds); `faster`: the time of a decision of the plain planner with `reference` candidates over
        that of the planner with the prior and `needed`, missing where this is infinite.
    """
    rows = []
    for place, place_rows in frame.groupby(["task", "condition", "planner"], sort=False):
        curves = {
            prior: [prior_rows.pivot_table(name, "seed", "budget") for name in ("return", "seconds")]
            for prior, prior_rows in place_rows.groupby("prior", sort=False)
        }
        if NONE not in curves:
            continue
        plain_curve, plain_seconds = curves.pop(NONE)
        plain_budgets, plain = plain_curve.columns.to_numpy(float), plain_curve.to_numpy()
        reference, seeds = float(np.clip(REFERENCE, plain_budgets[0], plain_budgets[-1])), len(plain)
        draws = np.random.default_rng(0).integers(seeds, size=(RESAMPLES, seeds))
        seconds = interpolate(reference, plain_budgets, plain_seconds.to_numpy().mean(0))
        for prior, (returns, times) in curves.items():
            budgets, curve = returns.columns.to_numpy(float), returns.to_numpy()
            needed = candidates_needed(budgets, curve.mean(0), interpolate(reference, plain_budgets, plain.mean(0)))
            low = high = float("nan")
            if seeds >= 5:
                sampled = [
                    candidates_needed(
                        budgets, curve[draw].mean(0), interpolate(reference, plain_budgets, plain[draw].mean(0))
                    )
                    for draw in draws
                ]
                low, high = np.quantile(sampled, [0.025, 0.975], method="inverted_cdf")
            faster = float("nan")
            if np.isfinite(needed):
                faster = seconds / interpolate(needed, budgets, times.to_numpy().mean(0))
            rows.append((*place, prior, reference, needed, low, high, faster, seeds))
    names = ["task", "condition", "planner", "prior", "reference", "needed", "low", "high", "faster", "seeds"]
    return pd.DataFrame(rows, columns=names)


def interpolate(budget: float, budgets: NDArray[np.float64], values: NDArray[np.float64]) -> float:
    """A value between those of the neighbouring budgets, linear in the logarithm of the budget."""
    return float(np.interp(np.log(budget), np.log(budgets), values))


def candidates_needed(budgets: NDArray[np.float64], returns: NDArray[np.float64], goal: float) -> float:
    """The budget at which `returns` first reach `goal`; infinite if they never do.

    At the smallest budget already reached, it is that one: fewer candidates were not tried.
    """
    if returns[0] >= goal:
        return float(budgets[0])
    for k in range(1, len(budgets)):
        if returns[k] >= goal:
            share = (goal - returns[k - 1]) / (returns[k] - returns[k - 1])
            return float(budgets[k - 1] * (budgets[k] / budgets[k - 1]) ** share)
    return float("inf")


def against_simple(values: pd.DataFrame, by: Sequence[str], value: str) -> pd.DataFrame:
    """Networks minus the best prior that is none, in the mean over seeds; see `pair_by_seed`.

    Args:
        values: a row a seed of each group and prior, with the columns `by`, `prior`, `seed` and `value`.
        by: the columns that define the groups, `world` among them.
        value: the column that is compared.

    Returns:
        As `pair_by_seed`, by `by`, `prior`, the network, and `baseline`, what it is compared with.
    """
    parts = []
    for _, rows in values.groupby(list(by), sort=False):
        simple, networks = rows[rows["prior"].isin(SIMPLE)], rows[rows["prior"].isin([NETWORK, CLONING])]
        if len(simple):
            best = str(simple.groupby("prior", sort=False)[value].mean().idxmax())
            second = networks["seed"].map(simple[simple["prior"] == best].set_index("seed")[value])
            parts.append(networks.assign(first=networks[value], second=second, baseline=best))
    pairs = pd.concat(parts) if parts else values.assign(first=0.0, second=0.0, baseline="")[:0]
    return pair_by_seed(pairs, [*by, "prior", "baseline"])


def over_budgets(frame: pd.DataFrame) -> pd.DataFrame:
    """The mean return over the budgets that all priors have, a row a task, condition, planner, prior and seed."""
    common = set.intersection(*(set(rows["budget"]) for _, rows in frame.groupby("prior")))
    place = ["world", "condition", "planner", "prior", "seed"]
    means = frame[frame["budget"].isin(common)].groupby(place, sort=False)["return"].mean()
    per_seed: pd.DataFrame = means.reset_index()
    return per_seed
