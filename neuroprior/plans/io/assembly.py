"""Plans put together from columns of actions, contexts and groups; for the readers of files."""

from dataclasses import replace

import numpy as np
import torch

from neuroprior.plans.columns import Floats, Integers, Names, as_single, count_up_to, padded
from neuroprior.plans.plans import AnyPlans, Plans, action_dtype


def assembled(
    source: str,
    lengths: Integers,
    actions: Integers,
    num_actions: int | None = None,
    action_names: Names | None = None,
    context: Integers | Floats | None = None,
    per_step: bool = False,
    context_names: Names | None = None,
    group: Integers | None = None,
    group_names: Names | None = None,
    end: int | None = None,
) -> Plans:
    """`Plans` of N plans whose S actions stand end to end, padded to the longest.

    Args:
        source: the file, for messages.
        lengths: `[N]`.
        actions: `[S]`.
        num_actions: None for one more than the largest.
        action_names: None for none.
        context: `[N]` or `[N, C]`, or, if `per_step`, `[S]` or `[S, C]`; features are stored as float32.
        per_step: see `context`.
        context_names: None for none.
        group: `[N]`.
        group_names: None for none.
        end: the end symbol.

    Raises:
        ValueError: they are no `Plans`; the message names the source.
    """
    if action_names is not None:
        if num_actions not in (None, len(action_names)):
            raise ValueError(f"{source}: {len(action_names)} names of {num_actions} actions; give action_names")
        num_actions = len(action_names)
    if num_actions is None and not len(actions):
        raise ValueError(f"{source}: no plan has an action, so num_actions must be given")
    if num_actions is None:
        try:
            num_actions = count_up_to(int(actions.max()))
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from None
    dtype = torch.empty(0, dtype=action_dtype(num_actions)).numpy().dtype
    longest = int(lengths.max()) if len(lengths) else 0
    if context is not None:
        is_whole = context.dtype.kind in "iu"
        context = context.astype(np.int64) if is_whole else as_single(f"{source}: context", context)
        context = padded(context, lengths, source) if per_step else context
    wide = torch.from_numpy(padded(actions.astype(dtype), lengths, source))
    try:
        return Plans(
            wide,
            num_actions,
            None if end is None and (lengths == longest).all() else torch.from_numpy(lengths),
            action_names,
            None if context is None else torch.from_numpy(context),
            None if group is None else torch.from_numpy(group.astype(np.int64)),
            context_names,
            group_names,
            end,
        )
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error


def renamed(plans: AnyPlans, names: Names | None, source: str) -> AnyPlans:
    """The same plans with actions numbered as in `names`; those that have no names yet are given them.

    Raises:
        ValueError: an action's name is none of `names`, or their number is another.
    """
    if names is None or (plans.action_names is not None and tuple(plans.action_names) == names):
        return plans
    old = plans.action_names
    if old is None:
        if plans.num_actions != len(names):
            raise ValueError(f"{source}: {plans.num_actions} actions, but {len(names)} names of actions are given")
        return replace(plans, action_names=names)
    unknown = next((name for name in old if name not in names), None)
    if unknown is not None:
        raise ValueError(f"{source}: action {unknown!r} is none of {', '.join(names)}")
    number = torch.tensor([names.index(name) for name in old])
    return replace(
        plans,
        actions=number[plans.actions.long()],
        num_actions=len(names),
        lengths=plans.mask().sum(1) if plans.end is not None else plans.lengths,
        action_names=names,
        end=None if plans.end is None else int(number[plans.end]),
    )
