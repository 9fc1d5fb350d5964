"""The plans that a prior learns from, counts in or is chosen on: checked, and without a context it does not take."""

from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_same_names, is_integer, warn_caller
from neuroprior.plans import Plans, constant_context
from neuroprior.plans.folds import check_alike, fair_split, ungrouped
from neuroprior.plans.plans import AnyPlans
from neuroprior.priors.prior import Prior, check_actions

MOST_NEW, FEWEST_PLANS = 0.9, 20
"""A context is no category where so large a share of the actions has one that no other of so many plans has."""

MOST_HELD_OUT, LEAST_HELD_OUT, LARGEST_HELD_OUT = 0.1, 0.02, 5000
"""The share of plans that is held out to learn what experts do not: `LARGEST_HELD_OUT` actions, within these shares."""


def training_plans(prior: Prior, plans: Plans | Tensor, *, further: bool = False) -> Plans:
    """`plans` as `Plans` that a prior can learn from; it keeps their names, end and kind of context.

    Args:
        prior: what learns; its `fit` calls this.
        plans: `Plans`, or integers `[N, L]` for plans without context.
        further: whether it keeps what it learned before, so that the plans must have the same names.

    Raises:
        ValueError: another number of actions, other names than those from which it learns further, or a context of
            another kind than the prior takes.

    Warns:
        UserWarning: the prior ignores the context of the plans, or nearly every context occurs in one plan alone.
    """
    if isinstance(plans, Plans):
        _warn_of_context(prior, plans)
    plans = _trimmed_plans(prior, plans)
    check_actions(prior, plans)
    action_names = prior.action_names if further else None
    check_same_names("action_names", action_names, plans.action_names, "the plans", "this prior, which learns further")
    prior.check_context_of(plans)
    prior.end, prior.has_learned = plans.end, True
    prior.action_names = action_names if plans.action_names is None else tuple(plans.action_names)
    prior.context_names = None
    if prior.takes_context:
        prior.context_per = "step" if constant_context(plans) is None else "plan"
        if plans.context_names is not None and len(plans.context_names) <= (prior.num_contexts or 0):
            prior.context_names = tuple(plans.context_names)
    return plans


def validation_plans(prior: Prior, plans: Plans | Tensor) -> Plans:
    """As `training_plans`, of plans that the prior does not learn from: it keeps nothing of them.

    Their names are those of the plans that are learned from, which `check_alike` compares.

    Raises:
        ValueError: another number of actions, or a context of another kind than the prior takes.
    """
    plans = _trimmed_plans(prior, plans)
    check_actions(prior, plans)
    prior.check_context_of(plans)
    return plans


def pop_validation(prior: Prior, settings: dict[str, Any]) -> Plans | float | None:
    """Take what is held out from the settings of a `fit`: a share, or plans as `prior` can predict them."""
    validation: Plans | float | None = settings.pop("validation", None)
    return validation_plans(prior, validation) if isinstance(validation, Plans) else validation


def known_plans(prior: Prior, plans: Plans | Tensor) -> Plans:
    """`plans` with the actions and contexts that a prior knows, numbered alike; it keeps nothing of them.

    Raises:
        ValueError: another number of actions, other names, a context of another kind, or no action at all.
    """
    plans = _trimmed_plans(prior, plans)
    prior.check_plans(plans)
    if not bool(plans.mask().any()):
        raise ValueError("`plans` must have at least one plan with an action")
    return plans


def counted_plans(prior: Prior, plans: Plans | Tensor) -> Plans:
    """As `known_plans`, of plans in which `recount` counts: their ends are like those the prior learned from.

    A prior that has not learned yet keeps their names, end and kind of context, as `training_plans` says.

    Raises:
        ValueError: see `known_plans`; or plans with another end.
    """
    plans = known_plans(prior, plans)
    if not prior.has_learned:
        return training_plans(prior, plans)
    if plans.end != prior.end:
        raise ValueError(f"`plans` must have end={prior.end}, as those it learned from, got {plans.end}")
    return plans


def plans_for(prior: Prior, plans: AnyPlans) -> AnyPlans:
    """`plans` without a context that the prior does not take."""
    return plans if prior.takes_context else plans.without_context()


def _trimmed_plans(prior: Prior, plans: Plans | Tensor) -> Plans:
    """As `plans_for`, as `Plans` on the prior's device, as wide as the longest: padding changes nothing learned."""
    return plans_for(prior, prior.as_plans(plans)).trimmed()


def _warn_of_context(prior: Prior, plans: Plans) -> None:
    """Warn of a context that is ignored, or that can hardly be learned from."""
    if plans.context is None:
        return
    if not prior.takes_context:
        warn_caller(
            f"{type(prior).__name__}: it ignores the context of the plans; make it with num_contexts= or"
            " context_size=, if it takes these, or leave the context out (plans.without_context())"
        )
    elif prior.num_contexts is not None and is_integer(plans.context) and _seldom_repeats(prior, plans):
        warn_caller(
            f"{type(prior).__name__}: nearly every context occurs in one plan alone, so that nothing is learned from"
            " it; where it is no category, give features (a floating point context, or Features(size) in a world)"
        )


def _seldom_repeats(prior: Prior, plans: Plans) -> bool:
    """Whether nearly all actions are taken in contexts that occur in one plan alone."""
    assert plans.context is not None
    mask = plans.mask()
    number = torch.arange(len(plans), device=mask.device)[:, None].expand(mask.shape)[mask]
    context = plans.context[mask].long()
    if len(plans) < FEWEST_PLANS or 2 * (prior.num_contexts or 0) < len(context):
        return False
    pairs = torch.stack([context, number], 1).unique(dim=0)
    _, place, num_plans = pairs[:, 0].unique(return_inverse=True, return_counts=True)
    alone = torch.isin(context, pairs[num_plans[place] == 1, 0])
    return float(alone.double().mean()) > MOST_NEW


def split_validation(plans: Plans, validation: Plans | float | None, generator: torch.Generator) -> tuple[Plans, Plans]:
    """The plans that experts learn from, and those on which networks are stopped and weights are learned.

    Groups stay together where there are so many that few actions are lost; see `fair_split`.

    Raises:
        ValueError: there are too few plans, or the validation plans are not numbered alike.
    """
    if isinstance(validation, Plans):
        check_alike(plans, validation)
        if not bool(validation.mask().any()):
            raise ValueError("`validation` must have at least one plan with an action")
        return plans, validation
    plans = plans[plans.mask().any(1)]
    if validation is None:
        validation = min(MOST_HELD_OUT, max(LARGEST_HELD_OUT / max(int(plans.mask().sum()), 1), LEAST_HELD_OUT))
    if plans.group is not None and 1 / len(plans.group.unique()) > 2 * validation:
        plans = ungrouped(plans)
    return fair_split(plans, validation, generator, divide_groups=True)
