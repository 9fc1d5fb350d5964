"""How long bouts last where some were cut off: survival under each condition, and the log-rank test over subjects."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy import special

from neuroprior._statistics import Interval
from neuroprior.behaviour.analysis.comparison import units
from neuroprior.behaviour.analysis.permutation_design import PermutationDesign
from neuroprior.behaviour.analysis.permutation_tests import combine_tests
from neuroprior.behaviour.recorded_plans import RecordedPlans, action_names, durations_of, numbered_names

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


class Curve(NamedTuple):
    """The survival of bouts at T times at which some ended, each float64 `[T]`.

    Attributes:
        time: ascending, in the unit of the durations.
        survival: the share of bouts that last longer (Kaplan and Meier 1958).
        low, high: its 95 % interval over units; NaN where there is none.
        at_risk: how many bouts last at least so long.
    """

    time: Array
    survival: Array
    low: Array
    high: Array
    at_risk: Array

    @property
    def median(self) -> float:
        """Return the first time that at most half of the bouts survive; infinite where more do."""
        below = self.time[self.survival <= 0.5 + 1e-12]
        return float(below[0]) if len(below) else np.inf


@dataclass(frozen=True, eq=False, repr=False)
class DurationSurvival:
    """The survival of bouts of each behaviour under each condition.

    Attributes:
        curves: by behaviour and condition ("" without conditions).
        tests: by behaviour the log-rank test's p-value, and that corrected for the number of behaviours; empty where
            nothing can be tested.
        ratios: of two conditions, by behaviour: how many times as long its bouts last under the second as under the
            first, with its 95 % interval over units; empty where nothing can be tested.
        design: what was permuted; None without conditions.
    """

    curves: Mapping[tuple[str, str], Curve]
    tests: Mapping[str, tuple[float, float]]
    ratios: Mapping[str, Interval]
    design: PermutationDesign | None

    def __repr__(self) -> str:
        """Return the behaviour whose durations differ most clearly."""
        said = "; no test"
        if self.tests:
            name, (_, corrected) = min(self.tests.items(), key=lambda item: item[1])
            said = f"; {name}: p = {corrected:.2g}"
        return f"DurationSurvival({len({key[0] for key in self.curves})} behaviours{said})"

    def frame(self) -> pd.DataFrame:
        """Return a row a time: `behaviour, condition, time, survival, low, high, at_risk`."""
        parts = [
            pd.DataFrame({"behaviour": behaviour, "condition": level} | curve._asdict())
            for (behaviour, level), curve in self.curves.items()
        ]
        return pd.concat(parts, ignore_index=True)

    def medians(self) -> pd.DataFrame:
        """Return a row a behaviour: `behaviour`, medians by condition, `p_value, corrected, ratio, low, high`."""
        rows: dict[str, dict[str, object]] = {}
        for (behaviour, level), curve in self.curves.items():
            rows.setdefault(behaviour, {"behaviour": behaviour})[f"median, {level}".removesuffix(", ")] = curve.median
        frame = pd.DataFrame(list(rows.values()))
        for place, name in enumerate(("p_value", "p_corrected", "ratio", "low", "high")):
            of = {key: (*test, *self.ratios.get(key, [np.nan] * 3))[place] for key, test in self.tests.items()}
            frame[name] = frame["behaviour"].map(of).astype(float)
        return frame


def duration_survival(
    plans: RecordedPlans, permutations: int = 9999, generator: torch.Generator | None = None
) -> DurationSurvival:
    """Return how long bouts of each behaviour last, and whether that differs between conditions.

    A bout that was cut off counts as going on for as long as it was seen. Intervals leave out one unit at a time
    (jackknife), on the scale log(-log S). The test is the log-rank test (Mantel 1966): observed less expected ends,
    where what is expected is the hazard of the stratum, or in paired designs of the subject. Its null distribution is
    that of permuted conditions of whole units (see `PermutationDesign`), so that bouts of a subject may be alike.
    The ratio is of the areas below the two curves: of mean durations, up to the longest bout of a condition where this
    one was cut off. Its degrees of freedom are Welch's and Satterthwaite's, of as many units in each condition as
    there would be of equally many bouts (Kish 1965, section 11.7).
    Units count so that each stratum has the same weight under both conditions.

    Args:
        plans: with durations; a condition is compared within strata, where there are any.
        permutations: random ones at most; all where there are no more.
        generator: draws them.

    Raises:
        ValueError: plans without durations above 0.

    Example:
        >>> durations = torch.tensor([[1.0, 4.0, 1.2, 3.5]]).repeat(6, 1)
        >>> plans = RecordedPlans(torch.tensor([[0, 1, 0, 1]]).repeat(6, 1), 2, durations=durations)
        >>> duration_survival(plans).curves["0", ""].median
        1.0
    """
    times = durations_of(plans)
    timed = times > 0  # 0 beyond the end of a plan
    if not bool(timed.any()):
        raise ValueError("`plans` must have durations above 0, got none")
    time = times[timed].double().cpu().numpy()
    ended = np.ones(len(time), bool) if plans.cut_off is None else ~plans.cut_off[timed].cpu().numpy()
    action = plans.actions[timed].long().cpu().numpy()
    unit, plan = units(plans, timed)[timed].cpu().numpy(), timed.nonzero()[:, 0].cpu().numpy()
    levels, level = [""], np.zeros(len(time), np.int64)
    if plans.condition is not None:
        level = plans.condition.cpu().numpy()[plan]
        levels = numbered_names(plans.condition_names, torch.arange(int(plans.condition.max()) + 1), "condition")
    names, curves = action_names(plans), dict[tuple[str, str], Curve]()
    for number in np.flatnonzero(np.bincount(action[ended], minlength=len(names))):
        for place in np.unique(level[(action == number) & ended]):
            inside = (action == number) & (level == place)
            curves[names[number], levels[place]] = survival_curve(time[inside], ended[inside], unit[inside])
    if plans.condition is None:
        return DurationSurvival(curves, {}, {}, None)
    design = PermutationDesign.of(plans)
    if design.untestable:
        return DurationSurvival(curves, {}, {}, design)
    labels = design.labellings(permutations, generator)
    block = design.block.numpy()[plan]
    statistics, ratios = {}, dict[str, Interval]()
    for number in np.flatnonzero(np.bincount(action[ended & (block >= 0)], minlength=len(names))):
        inside = (action == number) & (block >= 0)
        ends, expected = _count_ends(time[inside], ended[inside], block[inside], design.cell.numpy())
        statistics[names[number]] = _log_rank(ends, expected, labels, len(design.conditions))
        if len(np.unique(level)) == 2 == len(np.unique(level[inside & ended])):
            ratios[names[number]] = _ratio_of_means(time[inside], ended[inside], block[inside], design)
    return DurationSurvival(curves, combine_tests(statistics)[0], ratios, design)


def survival_curve(time: Array, ended: NDArray[np.bool_], unit: Numbers) -> Curve:
    """Return the survival of bouts with its interval over units.

    Args:
        time: `[n]`: how long each lasted, or was seen.
        ended: bool `[n]`: whether it ended then.
        unit: int `[n]`.
    """
    of_unit, numbers = pd.factorize(unit)
    at, ends, at_risk = _count_by_unit(time, ended, of_unit, len(numbers))
    whole = _survive(ends.sum(0), at_risk.sum(0))
    low = high = np.full(len(at), np.nan)
    if len(numbers) > 1:
        with np.errstate(divide="ignore", invalid="ignore"):
            without = np.log(-np.log(_survive(ends.sum(0) - ends, at_risk.sum(0) - at_risk)))
            error = np.sqrt((len(numbers) - 1) * without.var(0))
            bounds = [whole ** np.exp(sign * special.stdtrit(len(numbers) - 1, 0.975) * error) for sign in (1, -1)]
        inside = np.isfinite(error)
        low, high = (np.where(inside, bound, np.nan) for bound in bounds)
    return Curve(at, whole, low, high, at_risk.sum(0))


def _count_by_unit(time: Array, ended: NDArray[np.bool_], unit: Numbers, units: int) -> tuple[Array, Array, Array]:
    """Return the times `[T]` at which bouts ended, and how many of each unit ended, and were at risk, then `[G, T]`."""
    at = np.unique(time[ended])
    ends, at_risk = np.zeros((2, units, len(at)))
    place = np.searchsorted(at, time, "right") - 1
    np.add.at(ends, (unit[ended], place[ended]), 1)
    seen = place >= 0
    np.add.at(at_risk, (unit[seen], place[seen]), 1)
    return at, ends, at_risk[:, ::-1].cumsum(1)[:, ::-1]


def _survive(ends: Array, at_risk: Array) -> Array:
    return np.asarray((1 - ends / np.where(at_risk > 0, at_risk, 1)).cumprod(-1))


def _count_ends(time: Array, ended: NDArray[np.bool_], block: Numbers, cell: Numbers) -> tuple[Array, Array]:
    """Return how many bouts of each block `[B]` ended, and how many were expected to by the hazard of its cell."""
    expected = np.zeros(len(time))
    for number in np.unique(cell[block]):
        in_cell = cell[block] == number
        place = np.unique(time[in_cell], return_inverse=True)[1]
        at_risk = np.bincount(place)[::-1].cumsum()[::-1]
        expected[in_cell] = (np.bincount(place, ended[in_cell]) / at_risk).cumsum()[place]
    ends, due = (np.asarray(np.bincount(block, one, len(cell)), np.float64) for one in (ended, expected))
    return ends, due


def _log_rank(ends: Array, expected: Array, labels: torch.Tensor, conditions: int) -> torch.Tensor:
    """Return the statistic of each labelling `[P]`: squares of observed less expected ends, by expected ones."""
    excess, due = torch.from_numpy(ends - expected), torch.from_numpy(expected)
    total = torch.zeros(labels.shape[1], dtype=torch.double)
    for condition in range(conditions):
        under = (labels == condition).double()
        total += (excess @ under).square() / (due @ under).clamp(min=1e-9)
    return total


def _ratio_of_means(time: Array, ended: NDArray[np.bool_], block: Numbers, design: PermutationDesign) -> Interval:
    """Return the ratio of mean durations, the second condition by the first; the interval leaves out one unit."""
    unit, label, cell = (one.numpy() for one in (design.unit, design.label, design.cell))
    units, under = len(design.units), label[block]
    # Up to the end, unless the longest bout of a condition was cut off: beyond it nothing is known of this condition.
    last = [time[under == condition].max() for condition in (0, 1)]
    last_ended = [ended[(under == condition) & (time == last[condition])].all() for condition in (0, 1)]
    limit = min((longest for longest, whole in zip(last, last_ended, strict=True) if not whole), default=max(last))
    kept = np.arange(units) != np.arange(-1, units)[:, None]  # [G + 1, G]: all, then without each unit
    logs = []
    for condition in (0, 1):
        inside, blocks = under == condition, np.flatnonzero(label == condition)
        at, ends, at_risk = _count_by_unit(time[inside], ended[inside], unit[block[inside]], units)
        remaining = kept[:, unit[blocks]].astype(np.float64)
        number = remaining @ (cell[blocks][:, None] == cell[blocks])
        weight = np.zeros(kept.shape)
        weight[:, unit[blocks]] = remaining * np.bincount(cell)[cell[blocks]] / number.clip(min=1)
        survival = _survive(weight @ ends, weight @ at_risk)[:, at < limit]
        widths = np.diff(at[at < limit], prepend=0, append=limit)
        logs.append(np.log(widths[0] + survival @ widths[1:]))
    change, group = logs[1] - logs[0], np.zeros(units, np.int64)  # of units that might exchange places
    if design.kind == "between":
        group[unit] = np.unique(cell * 2 + label, return_inverse=True)[1]
    size, bouts = np.bincount(group), np.bincount(unit[block], minlength=units).astype(np.float64)
    variance = np.bincount(group, (change[1:] - change[0]) ** 2) * (size.clip(min=2) - 1) / size
    of_group = np.bincount(group, bouts) ** 2 / np.bincount(group, bouts**2).clip(min=1) - 1
    with np.errstate(invalid="ignore"):  # 0 / 0 without spread
        freedom = variance.sum() ** 2 / (variance**2 / of_group.clip(min=1)).sum()
    half = special.stdtrit(freedom, 0.975) * np.sqrt(variance.sum())
    return Interval(*np.exp([change[0], change[0] - half, change[0] + half]).tolist())
