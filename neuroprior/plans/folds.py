"""Cross-validation: plans divided so that each is held out once."""

from dataclasses import replace

import torch
from torch import Tensor

from neuroprior.plans.plans import Plans, is_per_step

FEWEST_UNITS = 2
"""Independent units without which there is no interval; below, a finer unit is taken."""

BLOCKS = 40
"""Parts into which a single plan is cut."""


def divisible(plans: Plans) -> Plans:
    """Plans as they can be split: of fewer than two groups, without them, so that each stands alone."""
    few = plans.group is None or len(plans.group.unique()) < FEWEST_UNITS
    return replace(plans, group=None, group_names=None) if few else plans


def folds(plans: Plans, number: int, seed: int = 0) -> list[tuple[Tensor, Tensor]]:
    """Cross-validation over independent units: each action is held out once.

    Groups stay together where there are two or more; else plans are drawn. Single plans are not cut: see `in_parts`.

    Args:
        plans: N of them.
        number: of folds, at least 2 and at most the number of groups (of plans, where there are no two groups).
        seed: draws which unit is in which fold.

    Returns:
        For each fold the numbers of the plans to learn from and of those held out, int64, each in order.

    Raises:
        ValueError: fewer than two folds, or fewer units than folds.
    """
    grouped = plans.group is not None and len(plans.group.unique()) >= FEWEST_UNITS
    unit = plans.group.unique(return_inverse=True)[1].cpu() if grouped and plans.group is not None else None
    unit = torch.arange(len(plans)) if unit is None else unit
    count = int(unit.max()) + 1 if len(unit) else 0
    if not 2 <= number <= count:
        kind = "groups" if grouped else "plans"
        raise ValueError(f"folds: between 2 and the number of {kind}, {count}, are expected, not {number}")
    drawn = torch.randperm(count, generator=torch.Generator().manual_seed(seed)) % number
    return [((drawn[unit] != fold).nonzero()[:, 0], (drawn[unit] == fold).nonzero()[:, 0]) for fold in range(number)]


def in_parts(plans: Plans, number: int = BLOCKS) -> Plans:
    """A single plan cut into `number` consecutive plans of about the same length, for cross-validation in time.

    Raises:
        ValueError: not a single plan, fewer actions than parts, or no parts.
    """
    if number < 1:
        raise ValueError(f"number: at least 1 is expected, not {number}")
    length = int(plans.mask().sum())
    if len(plans) != 1 or length < number:
        raise ValueError(f"plans: a single one of at least {number} actions is expected, not {len(plans)} of {length}")
    size = -(-length // number)
    parts = -(-length // size)
    place = torch.arange(parts * size, device=plans.actions.device).view(parts, size)
    context = plans.context
    if context is not None:
        each = is_per_step(context)
        context = context[0][place.clamp(max=length - 1)] if each else context.expand(parts, *context.shape[1:])
    return replace(
        plans,
        actions=plans.actions[0][place.clamp(max=length - 1)],
        lengths=(length - place[:, 0]).clamp(max=size),
        context=context,
        group=None,
        group_names=None,
    )
