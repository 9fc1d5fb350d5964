"""Drift of rates: how much more, or less, often each behaviour begins at the end of a session than at its beginning."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import special

from neuroprior._statistics import Difference, holm
from neuroprior.behaviour.recordings import KEYS, Recordings
from neuroprior.plans.folds import FEWEST_UNITS
from neuroprior.plans.plans import Plans, check_are_plans

BINS = 50
"""Equal parts of each session in which bouts are counted."""

MAX_CHANGE = 20.0
"""The largest change of a logarithm that is estimated."""

NEWTON_STEPS = 50

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class RateDrift:
    """The change of the rates of A behaviours over a session.

    Attributes:
        behaviours: A names.
        bouts: int64 `[A]`: how many were counted.
        changes: A: of the natural logarithm of the rate from the beginning to the end of a session, with its 95 %
            interval over units and the p-value of 0; without bounds where fewer than two units have the behaviour.
        corrected: float64 `[A]`: the p-values, corrected for the number of behaviours (Holm).
        unit: what intervals are over, "subjects", "recordings" or "sequences".
        num_units: how many there are.
    """

    behaviours: Sequence[str]
    bouts: NDArray[np.int64]
    changes: Sequence[Difference]
    corrected: Array
    unit: str
    num_units: int

    def __repr__(self) -> str:
        """Return the behaviour that changes most clearly."""
        first = self.frame().iloc[0]
        return (
            f"RateDrift({len(self.behaviours)} behaviours, {self.num_units} {self.unit}; {first.behaviour}:"
            f" {first.times:.3g} times, p = {first.p_corrected:.2g})"
        )

    def frame(self) -> pd.DataFrame:
        """Return a row a behaviour, the clearest change first.

        The columns are `behaviour, bouts`, `times` (the rate at the end, divided by that at the beginning) with its
        95 % interval `low, high`, `p_value` and `p_corrected`.
        """
        values = np.array(self.changes)
        bounds = dict(zip(("times", "low", "high"), np.exp(values[:, :3].T), strict=True))
        columns = {"behaviour": list(self.behaviours), "bouts": self.bouts, **bounds}
        frame = pd.DataFrame(columns | {"p_value": values[:, 3], "p_corrected": self.corrected})
        order = np.lexsort((-np.abs(values[:, 0]), frame["p_value"]))
        return frame.iloc[order].reset_index(drop=True)


class _Counts(NamedTuple):
    """Bouts in R sessions and K = `BINS` bins."""

    names: Sequence[str]  # A
    bouts: Array  # [R, A, K]
    watched: Array  # [R, K]: the time that was watched, or the number of all bouts
    unit: NDArray[np.int64]  # [R]


def rate_drift(source: Recordings | Plans, per: Literal["bouts", "time"] = "bouts") -> RateDrift:
    """Return how the rate of each behaviour changes over a session, tested over subjects.

    A rate is the share of all bouts that begin, or the number of bouts by watched time. Of recordings both are by real
    time, whatever gaps they have; of plans the first, by the order of actions, fragments of a recording being joined.

    The logarithm of the rate is a line in the relative time of the session, with a slope that all sessions share and a
    level of each. Given how many bouts a session has, their times do not depend on its level: the slope is the maximum
    of that likelihood. Its error is that of the units' scores: it holds however bouts of a subject depend on one
    another. Units are subjects, or recordings where there are not two subjects.

    Rates by time vary more: whatever takes long changes those of all behaviours. Where watching is only known from the
    bouts, a fragment is watched between its first and last start, which do not count: rates would be too high.

    Args:
        source: recordings with known starts, or plans.
        per: what rates are by; plans have no watched time.

    Raises:
        ValueError: fewer than two units, or no time that was watched.

    Example:
        >>> import pandas as pd
        >>> table = {"animal": ["m1"] * 4 + ["m2"] * 4, "behaviour": ["rest", "run"] * 4, "start": [0, 2, 4, 9] * 2}
        >>> recordings = read(pd.DataFrame(table | {"stop": [2, 4, 9, 12] * 2}))
        >>> rate_drift(recordings).behaviours
        ('rest', 'run')
    """
    if per not in ("bouts", "time") or (per == "time" and not isinstance(source, Recordings)):
        raise ValueError(f"`per` must be bouts, or time for recordings, got {per!r}")
    if isinstance(source, Recordings):
        subjects = source.events["subject"].nunique() >= FEWEST_UNITS
        counts, unit = _count_in_time(source, subjects, per), "subjects" if subjects else "recordings"
    else:
        check_are_plans(source)
        counts, unit = _count_in_order(source)
    number = len(np.unique(counts.unit))
    if number < FEWEST_UNITS:
        raise ValueError(f"`source` must have at least {FEWEST_UNITS} subjects, recordings or plans, got {number}")
    bouts = counts.bouts * (counts.watched[:, None] > 0)  # at the only moment of a fragment there is no rate
    slope, score, information = _fit_slopes(bouts, counts.watched)
    unit_of = np.unique(counts.unit, return_inverse=True)[1]
    scores, sizes = np.zeros((2, number, len(slope)))
    np.add.at(scores, unit_of, score)
    np.add.at(sizes, unit_of, information)
    changes = [_change(*one) for one in zip(slope, scores.T, sizes.T, strict=True)]
    corrected = holm([one.p_value for one in changes])
    number_of = bouts.sum((0, 2)).astype(np.int64)
    return RateDrift(tuple(counts.names), number_of, changes, corrected, unit, number)


def overlap(start: Array, stop: Array, edges: Array) -> Array:
    """Return how much of each interval, from `start [n]` to `stop [n]`, lies between `edges [K + 1]`: `[n, K]`."""
    length: Array = (np.minimum(stop[:, None], edges[1:]) - np.maximum(start[:, None], edges[:-1])).clip(min=0)
    return np.where(np.isnan(length), 0, length)


def _count_in_time(recordings: Recordings, by_subject: bool, per: str) -> _Counts:
    kept = recordings.of_one_observer()
    watched, events = kept.watched, kept.events
    inside = events["start"].notna()
    if kept.spans is None and per == "time":
        low, high = (events["start"].groupby(kept.fragment).transform(end) for end in ("min", "max"))
        watched = events[KEYS].assign(start=low, stop=high)[np.diff(kept.fragment, prepend=-1) != 0]
        inside &= (events["start"] > low) & (events["start"] < high)
    events = events[inside]
    whole = watched.groupby(KEYS).agg(begin=("start", "min"), end=("stop", "max")).reset_index()
    whole = whole[whole["end"] > whole["begin"]].reset_index(drop=True)
    if not len(whole):
        raise ValueError("`source` must have recordings whose times are known, got none")
    whole["session"] = np.arange(len(whole))
    watched, events = (frame.merge(whole, on=KEYS) for frame in (watched, events))

    def place(frame: pd.DataFrame, column: str) -> Array:
        span = frame["end"] - frame["begin"]
        return np.asarray((frame[column] - frame["begin"]) / span, dtype=np.float64)

    edges = np.linspace(0, 1, BINS + 1)
    exposure = np.zeros((len(whole), BINS))
    np.add.at(exposure, watched["session"], overlap(place(watched, "start"), place(watched, "stop"), edges))
    behaviour, names = pd.factorize(events["behaviour"], sort=True)
    bouts = np.zeros((len(whole), len(names), BINS))
    time_bin = (place(events, "start") * BINS).astype(np.int64).clip(0, BINS - 1)
    np.add.at(bouts, (events["session"], behaviour, time_bin), 1)
    unit = pd.factorize(whole["subject"])[0] if by_subject else np.arange(len(whole))
    return _Counts([str(name) for name in names], bouts, exposure if per == "time" else bouts.sum(1), unit)


def _count_in_order(plans: Plans) -> tuple[_Counts, str]:
    from neuroprior.behaviour.analysis.comparison import unit_name, units
    from neuroprior.behaviour.recorded_plans import action_names, join_fragments

    plans = join_fragments(plans)[0]
    mask, unit = plans.mask(), unit_name(plans)
    plan, step = mask.nonzero().unbind(1)
    step_bin = ((step + 0.5) * BINS / mask.sum(1)[plan]).long()
    bouts = np.zeros((len(plans), plans.num_actions, BINS))
    np.add.at(bouts, tuple(index.cpu().numpy() for index in (plan, plans.actions[mask].long(), step_bin)), 1)
    acted = mask.any(1).cpu().numpy()
    alone = unit == "parts of the sequence"
    of_plan = np.zeros(len(plans)) if alone else units(plans, mask)[:, :1].flatten().cpu().numpy()
    return _Counts(action_names(plans), bouts[acted], bouts[acted].sum(1), of_plan[acted].astype(np.int64)), unit


def _fit_slopes(bouts: Array, watched: Array) -> tuple[Array, Array, Array]:
    """Return the slope of each behaviour `[A]`, and each session's score and information `[R, A]` (Newton's method)."""
    middle = (np.arange(BINS) + 0.5) / BINS
    number, total = bouts.sum(2), bouts @ middle
    slope = np.zeros(bouts.shape[1])
    for _ in range(NEWTON_STEPS):
        weight = watched[:, None] * np.exp(slope[:, None] * (middle - 0.5))
        whole = weight.sum(2).clip(min=np.finfo(float).tiny)
        mean = weight @ middle / whole
        information = number * (weight @ middle**2 / whole - mean**2).clip(min=0)
        score = total - number * mean
        step = score.sum(0) / information.sum(0).clip(min=1e-9)
        if np.abs(step).max(initial=0) < 1e-10:
            break
        slope = (slope + step.clip(-1, 1)).clip(-MAX_CHANGE, MAX_CHANGE)
    return slope, score, information


def _change(slope: float, scores: Array, information: Array) -> Difference:
    """Return a slope with its interval, from each unit's score and information `[G]`.

    The error leaves out a unit at a time, to first order; the degrees of freedom are those of units that inform so
    unequally.
    """
    informed = information > 1e-9
    if (number := int(informed.sum())) < FEWEST_UNITS or abs(slope) >= MAX_CHANGE:
        return Difference(float(slope), -np.inf, np.inf, 1.0)
    total = information[informed].sum()
    share = information[informed] / total
    error = float(np.sqrt((number - 1) / number * ((scores[informed] / (1 - share)) ** 2).sum()) / total)
    freedom = max(1 / float((share**2).sum()) - 1, 1.0)
    half = float(special.stdtrit(freedom, 0.975)) * error
    p_value = float(2 * special.stdtr(freedom, -abs(slope) / error)) if error > 1e-9 else 2.0 ** (1 - number)
    return Difference(float(slope), float(slope) - half, float(slope) + half, p_value)
