"""Cross-validation: plans divided so that each is held out once."""

from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from neuroprior._checks import check_same_names, check_seed, check_sizes, is_whole
from neuroprior.plans.plans import AnyPlans, Plans
from neuroprior.plans.sequences import Sequences

FEWEST_UNITS = 2
"""Independent units that an interval needs; where there are fewer groups (or plans), a finer unit is taken."""

FOLDS = 5
"""Parts that are held out in turn, where their number is not given; fewer where there are fewer units."""

BLOCKS = 40
"""Parts into which a single plan is cut, so that there are units for intervals and folds."""

DRAWS = 8
"""How often plans that are held out are drawn, until they are a fair share of the actions."""

AnySequences = TypeVar("AnySequences", bound=Sequences)


def divisible(plans: AnySequences) -> AnySequences:
    """The same plans, without their group if they have fewer than two groups, so that they can be split.

    Args:
        plans: of actions or of vectors.

    Example:
        >>> divisible(Plans(torch.zeros(1, 1000, dtype=torch.long), 2)).actions.shape
        torch.Size([1, 1000])
    """
    return plans if plans.group is not None and num_units(plans) >= FEWEST_UNITS else ungrouped(plans)


def ungrouped(plans: AnySequences) -> AnySequences:
    """The same plans without their group."""
    names: dict[str, None] = {"group_names": None} if isinstance(plans, Plans) else {}
    return replace(plans, group=None, **names)  # type: ignore[type-var]


def longest_cut(plans: AnySequences, share: float) -> tuple[AnySequences, AnySequences]:
    """The plans, the longest without its end, and this end: a share of all actions, at most half of that plan.

    Args:
        plans: of actions or of vectors, at least one with two or more.
        share: between 0 and 1.
    """
    lengths = plans.mask().sum(1)
    row, longest = int(lengths.argmax()), int(lengths.max())
    cut = longest - max(min(round(share * int(lengths.sum())), longest // 2), 1)
    lengths[row] = cut
    return replace(plans, lengths=lengths), plans[row : row + 1].steps(cut, longest)  # type: ignore[type-var]


def fair_split(
    plans: AnySequences, share: float, generator: torch.Generator | None = None, *, divide_groups: bool = False
) -> tuple[AnySequences, AnySequences]:
    """Plans to learn from, and plans that are held out at random: about a share of all actions.

    A single group is none. Where groups, or plans without groups, are so unequal that those drawn are no such share,
    others are drawn. Where that does not help, of groups those are held out that came nearest; of plans the end of the
    longest.

    Args:
        plans: of actions or of vectors.
        share: between 0 and 1.
        generator: draws the plans.
        divide_groups: plans are drawn in place of groups where no groups are such a share.

    Raises:
        ValueError: `share` is not between 0 and 1, or the plans cannot be split, see `Plans.split`.
    """
    plans = divisible(plans)
    lengths, nearest = plans.mask().sum(1), None
    total, longest = int(lengths.sum()), int(lengths.max()) if len(lengths) else 0
    for _ in range(DRAWS):
        drawn = plans.split(share, generator)
        held_out = int(drawn[1].mask().sum())
        if share / 2 * total <= held_out <= (1 + share) / 2 * total:
            return drawn
        away = abs(held_out - share * total) if 0 < held_out < total else total
        if nearest is None or away < nearest[0]:
            nearest = away, drawn
    assert nearest is not None
    if plans.group is not None:
        return fair_split(ungrouped(plans), share, generator) if divide_groups else nearest[1]
    too_short = longest < 2 or (longest // 2 < share / 2 * total and nearest[0] < total)
    return nearest[1] if too_short else longest_cut(plans, share)


def check_alike(training: Sequences, validation: Sequences) -> None:
    """Raise ValueError unless the actions and contexts of both are the same ones, numbered alike."""
    if type(training) is not type(validation):
        raise ValueError(f"`validation` must be {type(training).__name__}, got {type(validation).__name__}")
    if isinstance(training, Plans) and isinstance(validation, Plans) and validation.num_actions != training.num_actions:
        raise ValueError(f"`validation` must have {training.num_actions} actions, got {validation.num_actions}")
    for what in ("action_names", "context_names"):
        names = getattr(training, what, None), getattr(validation, what, None)
        check_same_names(f"validation: {what}", *names, "these plans", "those that are learned from")


def num_units(plans: Sequences) -> int:
    """The number of groups, or of plans where there are none."""
    return len(plans) if plans.group is None else len(plans.group.unique())


def folds(plans: Sequences, number: int, seed: int = 0) -> list[tuple[Tensor, Tensor]]:
    """Cross-validation over independent units: each action is held out once.

    Where there are two or more groups these are divided into folds, else plans are. A single plan is not cut; see
    `in_parts`.

    Args:
        plans: N of them, of actions or of vectors.
        number: of folds, at least 2 and at most the number of groups (of plans, where there are no two groups).
        seed: of the random division into folds.

    Returns:
        For each fold the indices of the plans for training and of those held out, int64, ascending.

    Raises:
        ValueError: fewer than two folds, or fewer units than folds.

    Example:
        >>> plans = Plans(torch.zeros(6, 2, dtype=torch.long), 2, group=torch.tensor([0, 0, 1, 1, 2, 2]))
        >>> [(len(training), len(held_out)) for training, held_out in folds(plans, 3)]
        [(4, 2), (4, 2), (4, 2)]
    """
    if not isinstance(plans, Sequences):
        raise ValueError(f"`plans` must be Plans, got {type(plans).__name__}")
    grouped = plans.group is not None and len(plans.group.unique()) >= FEWEST_UNITS
    unit = plans.group.unique(return_inverse=True)[1].cpu() if grouped and plans.group is not None else None
    unit = torch.arange(len(plans)) if unit is None else unit
    count = int(unit.max()) + 1 if len(unit) else 0
    if not is_whole(number) or not 2 <= number <= count:
        kind = "groups" if grouped else "plans"
        raise ValueError(f"`folds` must be between 2 and the number of {kind}, {count}, got {number!r}")
    check_seed(seed)
    drawn = torch.randperm(count, generator=torch.Generator().manual_seed(seed)) % number
    return [((drawn[unit] != fold).nonzero()[:, 0], (drawn[unit] == fold).nonzero()[:, 0]) for fold in range(number)]


def in_parts(plans: AnyPlans, number: int = BLOCKS) -> AnyPlans:
    """A single plan cut into `number` consecutive plans of about the same length, for cross-validation in time.

    Args:
        plans: a single plan.
        number: how many parts.

    Raises:
        ValueError: not a single plan, fewer actions than parts, or no parts.

    Example:
        >>> in_parts(Plans(torch.arange(12)[None] % 3, 3), number=4).actions.tolist()
        [[0, 1, 2], [0, 1, 2], [0, 1, 2], [0, 1, 2]]
    """
    check_sizes(number=number)
    length = int(plans.mask().sum())
    if len(plans) != 1 or length < number:
        raise ValueError(f"`plans` must be a single one of at least {number} actions, got {len(plans)} of {length}")
    return pieces(plans, -(-length // number))


def pieces(plans: AnyPlans, most: int) -> AnyPlans:
    """Plans cut into consecutive parts of at most `most` actions, in order; the parts belong to no group.

    Example:
        >>> pieces(Plans(torch.arange(10).view(2, 5) % 3, 3, lengths=torch.tensor([5, 1])), 3).actions.tolist()
        [[0, 1, 2], [0, 1, 0], [2, 0, 0]]
    """
    check_sizes(most=most)
    lengths = plans.mask().sum(1)
    number = (-(-lengths // most)).clamp(min=1)
    row = torch.arange(len(plans), device=lengths.device).repeat_interleave(number)
    first = (torch.arange(len(row), device=lengths.device) - (number.cumsum(0) - number)[row]) * most
    place = first[:, None] + torch.arange(min(most, plans.max_length), device=lengths.device)
    place = place.minimum((lengths[row, None] - 1).clamp(min=0))
    parts = {name: getattr(plans, name) for name in plans.PER_ACTION}
    cut = {name: values[row[:, None], place] for name, values in parts.items() if values is not None}
    cut |= ungrouped(plans).select_rows(plans.PER_PLAN, row)
    return replace(ungrouped(plans), **cut | {"lengths": (lengths[row] - first).clamp(max=most)})
