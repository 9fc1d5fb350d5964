"""How far back dependence reaches: what each earlier action adds to the prediction from all later ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import special

from neuroprior._checks import check_count, check_sizes
from neuroprior._random import generator_on
from neuroprior._statistics import LEVEL, Difference, ratio_difference
from neuroprior.behaviour.analysis.comparison import too_few, unit_name, units
from neuroprior.plans import Plans
from neuroprior.plans.plans import check_are_plans

MAX_FOLDS = 20
"""Parts of the units, of which each is held out once; fewer where there are fewer units."""

PSEUDO_COUNTS = 4.0 ** np.arange(-6, 9)
"""Weights of a history without its oldest action; the likeliest is taken."""

MIN_GAIN = 5e-4
"""Bits of a gain that count as none: a longer history that says nothing still smooths a little better."""

FIRST_SHARE = 0.8
"""Share of the level that is spent on the first lag; the others share the rest."""

WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")
ORDINALS = ("the last", "a second", "a third", "a fourth", "a fifth", "a sixth", "a seventh", "an eighth")

Array = NDArray[Any]


@dataclass(frozen=True, eq=False, repr=False)
class HowFarBack:
    """What the action k = 1 to K steps back adds to the prediction from the k - 1 later ones.

    Attributes:
        gains: K: bits per held-out action, with the 95 % interval over units and the p-value of 0.
        corrected: float64 `[K]`: the p-value of a gain above `MIN_GAIN`, corrected for the number of lags by the
            fallback procedure (Wiens and Dmitrienko 2005): most of the level is spent on the first lag, and handed on
            from each lag that adds to the next. So a lag is found, too, that adds where nearer ones do not, such as one
            of two actions that matter only together.
        reach: the last lag whose corrected p-value is below `LEVEL`.
        unit: what intervals are over, such as "subjects".
        num_units: how many there are.
        few: why no verdict is drawn; "" where one is.
    """

    gains: Sequence[Difference]
    corrected: Array
    reach: int
    unit: str
    num_units: int
    few: str

    def __repr__(self) -> str:
        """Return the verdict."""
        return f"HowFarBack({self.num_units} {self.unit}: {self.verdict})"

    @property
    def verdict(self) -> str:
        """Return how far back actions matter, in a sentence."""
        if self.few:
            return f"How far back behaviour reaches is not said: {self.few}."
        reached = f"How far back: {_word(self.reach)} behaviour{'s' * (self.reach > 1)}"
        if self.reach == len(self.gains):
            return f"{reached} at least."
        gain, low, high, _ = self.gains[self.reach]
        bounds = f"{_digits(gain)} bits, {_digits(low)} to {_digits(high)}"
        next_one = ORDINALS[self.reach] if self.reach < len(ORDINALS) else f"lag {self.reach + 1}"
        return f"{reached}; {next_one} adds nothing ({bounds})."

    def frame(self) -> Any:
        """Return a row a lag, as a pandas frame: `lag, bits, low, high, p_value, p_corrected, units, significant`."""
        import pandas as pd

        frame = pd.DataFrame(self.gains).rename(columns={"mean": "bits"})
        frame.insert(0, "lag", np.arange(len(frame)) + 1)
        significant = (self.corrected < LEVEL) & (self.few == "")
        return frame.assign(p_corrected=self.corrected, units=self.num_units, significant=significant)


def _digits(value: float) -> str:
    text = f"{round(value, 4) + 0:.2g}"
    return text.replace("0.", ".", 1) if abs(value) < 1 else text


def _word(number: int) -> str:
    return WORDS[number] if number < len(WORDS) else str(number)


def how_far_back(plans: Plans, max_lag: int = 4, skip: int = 0) -> HowFarBack:
    """Return how many past actions help to predict the next one, tested over units.

    Chains of order 0 to K predict actions of units that they have not learned from. The probabilities after a history
    are those after the same without its oldest action, with so many pseudo-counts as make the training actions most
    probable (MacKay and Peto 1995): where the oldest action says nothing, nothing is lost. The gain of lag k is the
    difference between the bits of the chains of order k - 1 and k, on the same actions.

    Args:
        plans: at least two; for units see `neuroprior.behaviour.units`.
        max_lag: K; less where plans are shorter.
        skip: first actions of each plan that are not predicted.

    Raises:
        ValueError: a lag below 1, a negative `skip`, or fewer than two units with successive actions.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1] * 20]).repeat(6, 1), 2)
        >>> how_far_back(plans, max_lag=2).verdict
        'How far back: one behaviour; a second adds nothing (0 bits, 0 to 0).'
    """
    check_are_plans(plans)
    check_sizes(max_lag=max_lag)
    check_count("skip", skip, 0)
    mask = plans.mask().cpu()
    later = mask.clone()
    later[:, : max(1, skip)] = False
    if len(units(plans, later)[later].unique()) < 2 or unit_name(plans, later) == "parts of the sequence":
        raise ValueError(f"`plans` must have two units with successive actions after the first {skip}, got fewer")
    actions, step, unit = actions_in_a_row(plans)
    fold = unit % MAX_FOLDS
    history, bits = np.zeros(len(actions), np.int64), bits_of_shares(actions, fold, plans.num_actions)
    gains, above = list[Difference](), list[float]()
    for lag in range(1, max_lag + 1):
        has_history = step >= lag
        inside = has_history & (step >= skip)
        if len(np.unique(unit[inside])) < 2:
            break
        history = np.unique(history * plans.num_actions + np.roll(actions, lag), return_inverse=True)[1]
        better = bits_after(history, actions, fold, bits, has_history)
        gain, size = np.zeros(unit.max() + 1), np.bincount(unit[inside], minlength=unit.max() + 1)
        np.add.at(gain, unit[inside], (bits - better)[inside])
        gain, size = np.round(gain, 9)[size > 0], size[size > 0]
        gains.append(ratio_difference(gain, size))
        more = ratio_difference(gain - MIN_GAIN * size, size)
        above.append(more.p_value if more.mean > 0 else 1.0)
        bits = better
    corrected, few = _fallback(np.array(above)), too_few(plans, later)
    reach = int(np.flatnonzero(corrected < LEVEL).max(initial=-1)) + 1
    return HowFarBack(gains, corrected, reach, unit_name(plans, later), int(unit.max()) + 1, few)


def _fallback(p_values: Array) -> Array:
    """Return the p-values `[K]` corrected by the fallback procedure: the least overall levels at which they pass."""
    size = len(p_values)
    shares = np.full(size, (1 - FIRST_SHARE) / max(size - 1, 1))
    shares[0] = FIRST_SHARE if size > 1 else 1.0
    ends = [(first, last) for last in range(size) for first in range(last + 1)]
    levels = sorted(p_values[last] / shares[first : last + 1].sum() for first, last in ends)
    corrected = np.ones(size)
    for level in reversed(levels):
        spent = 0.0  # on a lag: its share of the level, and all that is handed on by those before it that pass
        for lag, p_value in enumerate(p_values):
            spent += level * shares[lag]
            passes = p_value <= spent * (1 + 1e-12)
            corrected[lag] = min(level, 1.0) if passes else corrected[lag]
            spent = spent if passes else 0.0
    return corrected


def actions_in_a_row(plans: Plans) -> tuple[Array, Array, Array]:
    """Return all actions `[M]`, plan after plan, the step of each from 0, and its unit from 0, int64."""
    mask = plans.mask().cpu()
    unit = np.unique(units(plans, mask)[mask].cpu().numpy(), return_inverse=True)[1]
    return plans.actions.cpu().long().numpy()[mask.numpy()], mask.nonzero()[:, 1].numpy(), unit


def bits_of_shares(actions: Array, fold: Array, size: int) -> Array:
    """Return the bits of each action `[M]` by the shares of all in the other folds, with one pseudo-count each."""
    counts = np.zeros((fold.max() + 1, size))
    np.add.at(counts, (fold, actions), 1)
    others = counts.sum(0) - counts + 1
    return np.asarray(-np.log2(others[fold, actions] / others.sum(1)[fold]))


def bits_after(history: Array, actions: Array, fold: Array, lower: Array, has_history: Array) -> Array:
    """Return the bits of each action `[M]` after its history, learned in the other folds.

    Args:
        history: `[M]`: its number.
        actions, fold: `[M]`.
        lower: `[M]`: the bits after the history without its oldest action; those of unknown histories remain.
        has_history: bool `[M]`: whether the history is there.
    """
    bits = lower.copy()
    for number in np.unique(fold):
        held_out = has_history & (fold == number)
        bits[held_out] = bits_held_out(history, actions, has_history & (fold != number), held_out, lower)
    return bits


def bits_held_out(history: Array, actions: Array, training: Array, held_out: Array, lower: Array) -> Array:
    """Return the bits of the actions that are `held_out`, bool `[M]`, learned from those in `training`."""
    prob, pair = np.exp2(-lower), np.unique(history * (actions.max() + 1) + actions, return_inverse=True)[1]
    of_pair, of_history = (np.bincount(code[training], minlength=code.max() + 1) for code in (pair, history))
    pairs, first = np.unique(pair[training], return_index=True)
    # The probability of each pair is that without its own fold for all of them: nearly the same in each.
    weight = max(PSEUDO_COUNTS, key=lambda one: _evidence(of_pair[pairs], prob[training][first], of_history, one))
    likely = (of_pair[pair] + weight * prob) / (of_history[history] + weight)
    return np.asarray(-np.log2(likely[held_out]))


def _evidence(counts: Array, lower: Array, totals: Array, weight: float) -> float:
    """Return the log-probability of counts under a Dirichlet prior of `weight` pseudo-counts, spread as `lower`."""
    of_pairs = special.gammaln(counts + weight * lower) - special.gammaln(weight * lower)
    return float(of_pairs.sum() + (special.gammaln(weight) - special.gammaln(totals + weight)).sum())


def pieces(plans: Plans, length: int, most: int, generator: torch.Generator | None = None) -> Plans:
    """Pieces of `length` consecutive actions, cut from plans at random places, as plans of their own.

    A prior that is fitted to them as to whole plans predicts the action j of a piece from exactly j past actions: one
    training gives the information in each past action. Pieces overlap: split plans between
    training and validation before they are cut.

    Args:
        plans: the plans.
        length: of each piece.
        most: how many are drawn, without replacement; all if there are fewer.
        generator: draws them.

    Returns:
        The pieces, in the order of the plans. A context per step is cut likewise. Their `group`
        is the independent unit (see `neuroprior.behaviour.units`): the group of the plan; or the number of the plan, if
        fewer than two groups have pieces; or one of `BLOCKS` consecutive parts, if only one plan has any.

    Raises:
        ValueError: no plan has that many actions, or `length` or `most` is below 1.
    """
    check_sizes(length=length, most=most)
    start_here = torch.zeros_like(plans.mask())
    if length <= plans.max_length:
        start_here[:, : plans.max_length - length + 1] = plans.mask()[:, length - 1 :]
    number = start_here.sum(1)
    last = number.cumsum(0)
    total = int(last[-1]) if len(plans) else 0
    if total == 0:
        longest = int(plans.mask().sum(1).max()) if len(plans) else 0
        raise ValueError(f"length: no plan has {length} actions; the longest has {longest}")
    device = number.device
    chosen = torch.arange(total, device=device)
    if total > most:
        chosen = torch.randperm(total, generator=generator_on(generator, device), device=device)[:most].sort().values
    plan = torch.searchsorted(last, chosen, right=True)
    start = chosen - (last - number)[plan]
    step = start[:, None] + torch.arange(length, device=device)
    context = plans.context
    if context is not None:
        context = context[plan[:, None], step]
    grouped = plans.group is not None and unit_name(plans, start_here) == "subjects"
    return Plans(
        plans.actions[plan[:, None], step],
        plans.num_actions,
        action_names=plans.action_names,
        context=context,
        group=plans.group[plan] if plans.group is not None and grouped else units(plans, start_here)[plan, start],
        context_names=plans.context_names,
        group_names=plans.group_names if grouped else None,
        end=plans.end,
    )
