"""The plans that a prior learns from, counts in or is chosen on: checked, and without a context it does not take."""

from torch import Tensor

from neuroprior._checks import check_same_names
from neuroprior.plans import Plans, constant_context
from neuroprior.priors.prior import Prior, check_actions


def training_plans(prior: Prior, plans: Plans | Tensor, *, further: bool = False) -> Plans:
    """`plans` as `Plans` that a prior can learn from; it keeps their names, end and kind of context.

    Args:
        prior: what learns; its `fit` calls this.
        plans: `Plans`, or integers `[N, L]` for plans without context.
        further: whether it keeps what it learned before, so that the plans must have the same names.

    Raises:
        ValueError: another number of actions, other names than those from which it learns further, or a context of
            another kind than the prior takes.
    """
    plans = _as_taken(prior, plans)
    check_actions(prior, plans)
    known = prior.action_names if further else None
    check_same_names("action_names", known, plans.action_names, "the plans", "this prior, which learns further")
    prior.check_context_of(plans)
    prior.end, prior.has_learned = plans.end, True
    prior.action_names = known if plans.action_names is None else tuple(plans.action_names)
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
    plans = _as_taken(prior, plans)
    check_actions(prior, plans)
    prior.check_context_of(plans)
    return plans


def known_plans(prior: Prior, plans: Plans | Tensor) -> Plans:
    """`plans` with the actions and contexts that a prior knows, numbered alike; it keeps nothing of them.

    Raises:
        ValueError: another number of actions, other names, a context of another kind, or no action at all.
    """
    plans = _as_taken(prior, plans)
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


def _as_taken(prior: Prior, plans: Plans | Tensor) -> Plans:
    """`plans` as `Plans`, without a context that the prior does not take."""
    plans = prior.as_plans(plans)
    return plans if prior.takes_context else plans.without_context()
