"""Plans in the numbers of a fitted prior: actions and contexts are matched by name."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neuroprior.plans import Plans
from neuroprior.plans.columns import listed
from neuroprior.plans.plans import AnyPlans, check_are_plans
from neuroprior.priors.learning import plans_for
from neuroprior.priors.prior import Prior, as_actions


def match_plans(plans: AnyPlans, prior: Prior, name: str = "prior") -> AnyPlans:
    """Plans as a prior that was fitted elsewhere can score them.

    Actions and contexts are renumbered by their names, where both the plans and the prior have names; the context is
    left out for a prior without one, and an end symbol is added for a prior that has one.

    Args:
        plans: N plans without an end symbol; or with that of the prior, whose actions are then numbered as the prior's.
        prior: the prior.
        name: of the prior, for messages.

    Raises:
        ValueError: the prior does not know one of the actions or contexts.

    Example:
        >>> prior = MarkovPrior(2, 0).fit(Plans(torch.tensor([[0, 1]]), 2, action_names=("rest", "walk")))
        >>> match_plans(Plans(torch.tensor([[0, 1]]), 2, action_names=("walk", "rest")), prior).actions.tolist()
        [[1, 0]]
    """
    check_are_plans(plans)
    if plans.end is not None and prior.end is not None:  # some may have been cut off before theirs: none is added
        if (plans.end, plans.num_actions) != (prior.end, prior.num_actions):
            raise ValueError(
                f"{name}: its end symbol is {prior.end} of {prior.num_actions} actions, and that of the plans"
                f" {plans.end} of {plans.num_actions}; give plans.without_end()"
            )
        return plans_for(prior, plans)
    num_actions = prior.num_actions - (prior.end is not None)
    if plans.num_actions > num_actions:
        raise ValueError(f"`{name}` must know at least the {plans.num_actions} actions of the plans, got {num_actions}")
    plans = renumbered(plans, num_actions, learned_names(prior), prior.context_names, name)
    plans = plans_for(prior, plans)
    return plans if prior.end is None else plans.with_end()


def decode(plans: Plans | Tensor, prior: Prior | None = None) -> list[list[str]]:
    """The names of the actions of each plan, up to its end.

    Args:
        plans: `Plans`; or integers `[N, L]`, such as a prior's samples.
        prior: of samples: its names, and its end symbol, before which each plan is cut. None for `Plans`, which have
            their own.

    Returns:
        N lists, each of up to L names; of actions without names, their numbers as text.

    Raises:
        ValueError: integers without a prior, a prior for `Plans`, or integers that are none of its actions.

    Example:
        >>> decode(Plans(torch.tensor([[0, 2], [1, 0]]), 3, torch.tensor([2, 1]), action_names=("eat", "rest", "walk")))
        [['eat', 'walk'], ['rest']]
    """
    if isinstance(plans, Plans) != (prior is None):
        raise ValueError("`decode` must be Plans, or samples and the prior that they are from")
    if not isinstance(plans, Plans):
        assert prior is not None
        plans = Plans(as_actions(plans), prior.num_actions, action_names=prior.action_names, end=prior.end)
    names = plans.action_names or [str(action) for action in range(plans.num_actions)]
    taken = zip(plans.actions.tolist(), plans.mask(end=False).sum(1).tolist(), strict=True)
    return [[names[action] for action in actions[:length]] for actions, length in taken]


def learned_names(prior: Prior) -> list[str] | None:
    """The names of the actions that a prior has learned, without that of its end symbol; None for numbers."""
    return None if prior.action_names is None else [n for a, n in enumerate(prior.action_names) if a != prior.end]


def renumbered(
    plans: AnyPlans, num_actions: int, names: Sequence[str] | None, context_names: Sequence[str] | None, where: str
) -> AnyPlans:
    """The plans with actions and contexts numbered as in these names; as they are where one side has no names.

    Raises:
        ValueError: a name is unknown, or there are too many actions; the message begins with `where`.
    """
    actions, context, unknown = plans.actions, plans.context, " is unknown; known are"
    if names is not None and plans.action_names is not None:
        actions = numbers(names, plans.action_names, f"{where}: the action", unknown)[actions.long()]
    if context is None or context_names is None or plans.context_names is None:
        context_names = plans.context_names
    else:
        context = numbers(context_names, plans.context_names, f"{where}: the context", unknown)[context.long()]
    plans = replace(plans, actions=actions, num_actions=num_actions, action_names=names)
    return replace(plans, context=context, context_names=context_names)


def numbers(vocabulary: Sequence[str], names: Sequence[str], before: str, after: str) -> Tensor:
    """The number under which each of the names is known.

    Raises:
        ValueError: a name is not known; the message has it between `before` and `after`, and then all known names.
    """
    if unknown := [name for name in names if name not in vocabulary]:
        raise ValueError(f"{before} {unknown[0]!r}{after} {', '.join(vocabulary)}")
    return torch.tensor([vocabulary.index(name) for name in names])


def with_contexts_of(prior: Prior, plans: AnyPlans, is_table: bool) -> tuple[AnyPlans, list[str]]:
    """The plans, whose contexts have names if they are numbers in a table that are names of the prior; and notes.

    Args:
        prior: that is to score them.
        plans: as they were read.
        is_table: whether they were read from a table (CSV), in which names may be numbers.
    """
    prior_names, names, context = prior.context_names, plans.context_names, plans.context
    if prior.num_contexts is None or context is None or (prior_names is None) == (names is None):
        return plans, []
    if prior_names is None:
        return plans, [numbered_note("contexts", names or ())]
    occurring = context[plans.mask()].unique()
    names = tuple(map(str, occurring.tolist()))
    if is_table and names and set(names) <= set(prior_names):
        # What stands behind the end of a plan is none of them.
        number = torch.searchsorted(occurring, context).clamp(max=len(names) - 1)
        return replace(plans, context=number, context_names=names), []
    return plans, [taken_note("contexts", prior_names)]


def numbered_note(what: str, names: Sequence[str]) -> str:
    """The note on actions or contexts of which the file alone has names."""
    order = listed([f"{name} = {number}" for number, name in enumerate(names)])
    return f"the prior knows {what} by number, so the file's were numbered: {order}"


def taken_note(what: str, names: Sequence[str]) -> str:
    """The note on actions or contexts of which the prior alone has names."""
    order = listed([f"{number} = {name}" for number, name in enumerate(names)])
    return f"the {what} are numbers, which are taken for those of the prior's names: {order}"
