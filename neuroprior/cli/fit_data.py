"""Plans of `fit` in parts: to learn from, for validation, and held out."""

from typing import NamedTuple

import torch

from neuroprior.behaviour.durations.past_durations import PastDurations
from neuroprior.plans import Plans
from neuroprior.plans.folds import FOLDS, fair_split, longest_cut, num_units, ungrouped
from neuroprior.priors.construction import context_arguments

MIN_PARTS, MIN_ACTIONS = 3, 2
"""Parts that plans are split into, and the fewest actions of each."""

FEW_GROUPS = 50
"""Groups below which the comparison is a cross-validation, as a tenth of them would be few."""

MIN_ACTIONS_OF_TWO = 100
"""Two plans or groups are enough if each has so many actions; validation then takes some of the plans, or the end of
the longest.
"""


class Parts(NamedTuple):
    """Plans in parts.

    Attributes:
        plans: all of them.
        learned_from: by the prior.
        chosen_on: for early stopping, and to choose settings of baselines.
        held_out: for the table; all plans where `folds` is above 1.
        folds: of a cross-validation; 1: none.
        validation: share of the plans that a fold learns from which are for validation.
        seed: draws the parts.
        num_contexts: of baselines; None: they have no context.
        past_durations: that were added to the context.
    """

    plans: Plans
    learned_from: Plans
    chosen_on: Plans
    held_out: Plans
    folds: int
    validation: float
    seed: int
    num_contexts: int | None
    past_durations: PastDurations | None


def divide(
    plans: Plans,
    validation: float = 0.1,
    held_out: float = 0.1,
    num_folds: int | None = None,
    past_durations: int = 0,
    seed: int = 0,
) -> Parts:
    """Divide plans into those to learn from, for validation and held out; see `fit` for the arguments.

    Raises:
        ValueError: too few plans, or an argument out of range.
    """
    for name, value in (
        ("validation", validation),
        ("held_out", held_out),
        ("validation + held_out", validation + held_out),
    ):
        if not 0 < value < 1:
            raise ValueError(f"`{name}` must be above 0 and below 1, got {value}.")
    if past_durations < 0:
        raise ValueError(f"`past_durations` must be at least 0, got {past_durations}.")
    plans = _divisible(plans)
    generator = torch.Generator().manual_seed(seed)
    folds = _num_folds(plans, num_folds)
    rest, share, last = plans, validation, plans
    if folds == 1:
        rest, last = fair_split(plans, held_out, generator)
        share = validation / (1 - held_out)
    if num_units(plans) == 2 and rest is plans:  # one of the two would be half, so that less is for validation
        rest = ungrouped(plans[plans.mask().any(1)])
        parts = fair_split(rest, share, generator) if len(rest) > 2 else longest_cut(rest, share)
    else:
        parts = fair_split(rest, share, generator)
    for name, subset in (("validation", parts[1]), ("held_out", last)):
        if (count := int(subset.mask().sum())) < MIN_ACTIONS:
            raise ValueError(f"`{name}` must leave at least {MIN_ACTIONS} actions, got {count}; give more plans.")
    num_contexts, past = context_arguments(plans).get("num_contexts"), None
    if past_durations:
        past = PastDurations.of(parts[0], past_durations)
        plans, last, num_contexts = past.added_to(plans), past.added_to(last), None
        parts = past.added_to(parts[0]), past.added_to(parts[1])
    return Parts(plans, *parts, last, folds, validation, seed, num_contexts, past)


def _divisible(plans: Plans) -> Plans:
    """Plans that can be split in three, or in two folds; a single group is dropped, so that its plans can be split."""
    units, what = num_units(plans), _unit(plans)
    if units == 1:
        if plans.group is not None:
            return _divisible(ungrouped(plans))
        units, what = int(plans.mask().sum()), "actions"
    if units < MIN_PARTS and not (units == 2 and _fewest_actions(plans) >= MIN_ACTIONS_OF_TWO):
        raise ValueError(
            f"`plans` must have at least {MIN_PARTS} {what}, to learn from, for validation and held out, got {units}."
        )
    return plans


def _fewest_actions(plans: Plans) -> int:
    """Actions of the group with the fewest, or of the plan where there are no groups."""
    unit = torch.arange(len(plans)) if plans.group is None else plans.group.unique(return_inverse=True)[1].cpu()
    return int(unit.bincount(plans.mask().sum(1).cpu()).min())


def _unit(plans: Plans) -> str:
    """What `num_units` counts."""
    return "plans" if plans.group is None else "groups"


def _num_folds(plans: Plans, wanted: int | None) -> int:
    """How many folds; 1: a share of the plans is held out."""
    units = num_units(plans)
    if wanted is None:
        few = units == 2 or (plans.group is not None and units < FEW_GROUPS)
        return min(FOLDS, units) if few else 1
    if not 1 <= wanted <= units:
        raise ValueError(f"`folds` must be from 1 to {units}, the number of {_unit(plans)}, got {wanted}.")
    return wanted
