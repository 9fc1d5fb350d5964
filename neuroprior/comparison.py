"""Priors compared on held-out plans: bits per action with intervals, and the count-based rivals a prior must meet."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import log

import torch
from torch import Tensor

from neuroprior.plans import Plans
from neuroprior.priors import ContextTreePrior, MarkovPrior, Prior, UniformPrior
from neuroprior.priors.backoff import BACKOFFS
from neuroprior.statistics import Difference, ratio_difference

ORDERS = range(7)
"""Markov orders that a prior is compared with."""

DEPTH = 10
"""Depth of the context trees that a prior is compared with."""

FEWEST_UNITS = 2
"""Independent units without which there is no interval; below, a finer unit is taken."""

BLOCKS = 40
"""Parts into which a single held-out plan is cut, for an interval."""


@dataclass(frozen=True)
class Score:
    """What a prior paid for held-out plans.

    Attributes:
        model: its name.
        sees: "actions", or "actions and context".
        bits: `[G]`, float64: the bits that each independent unit cost.
        actions: `[G]`, float64: the actions of each unit.
    """

    model: str
    sees: str
    bits: Tensor
    actions: Tensor

    def bits_per_action(self) -> Difference:
        """Bits per action with its 95 % interval over units."""
        return ratio_difference(self.bits, self.actions)

    def minus(self, other: "Score") -> Difference:
        """Bits per action more than `other` took for the same plans, paired by unit."""
        return ratio_difference(self.bits - other.bits, self.actions)


def score(model: str, prior: Prior, plans: Plans) -> Score:
    """Score `prior` on plans that it has not learned from.

    The units of the interval are the groups of the plans, or the plans where there are no two groups, or `BLOCKS`
    consecutive parts of a single plan.

    Args:
        model: the prior's name in tables.
        prior: any prior over the plans' actions; one that sees nothing leaves their context aside.
        plans: held-out plans with at least two actions in all.

    Raises:
        ValueError: plans that the prior cannot score, or fewer than two actions.
    """
    seen = plans if prior.takes_context else replace(plans, context=None, context_names=None)
    with torch.no_grad():
        bits = -prior.action_log_probs(seen).double().cpu() / log(2)
    mask = plans.mask().cpu()
    unit = _units(plans, mask)[mask]
    size = int(unit.max()) + 1 if len(unit) else 0
    if size < FEWEST_UNITS:
        raise ValueError(f"plans: at least two held-out actions are needed for a comparison, not {int(mask.sum())}")
    totals = torch.zeros(size, dtype=torch.double).index_add_(0, unit, bits[mask])
    counts = unit.bincount(minlength=size).double()
    return Score(model, "actions and context" if prior.takes_context else "actions", totals, counts)


def unit_name(plans: Plans) -> str:
    """What the intervals of `score` go over: "groups", "plans" or "parts of the plan"."""
    if plans.group is not None and len(plans.group.unique()) >= FEWEST_UNITS:
        return "groups"
    return "plans" if int(plans.mask().any(1).sum()) >= FEWEST_UNITS else "parts of the plan"


@dataclass(frozen=True)
class Rival:
    """A count-based prior that another prior is compared with.

    Attributes:
        model: its name, such as "markov-3".
        how: the back-off or the depth.
        prior: fitted.
        validation_bits: bits per action on the validation plans.
    """

    model: str
    how: str
    prior: Prior
    validation_bits: float


def rivals(training: Plans, validation: Plans, tell: Callable[[str], object] = str) -> Iterator[Rival]:
    """The uniform prior and the count-based ones: Markov chains of every order in `ORDERS`, and a context tree.

    Each Markov order comes with the back-off, and where the plans have a context index with or without it, that tells
    the validation plans best; so does the context tree. Features cannot be counted and are left aside.

    Args:
        training: what they learn from.
        validation: what they are chosen on.
        tell: called with the name of what is fitted next.

    Yields:
        One rival after the other, each fitted when it is asked for.
    """
    actions = training.num_actions
    yield _best("uniform", {"": UniformPrior(actions)}, training, validation)
    seen: list[int | None] = [None]
    if training.context is not None and not training.context.is_floating_point():
        largest = max(int(plans.context.max()) for plans in (training, validation) if plans.context is not None)
        seen.append(max(largest + 1, len(training.context_names or ())))
    for order in ORDERS:
        tell(f"markov-{order}")
        made = {
            backoff + ("" if contexts is None else " "): MarkovPrior(
                actions, order, backoff=backoff, num_contexts=contexts
            )
            for contexts in seen
            for backoff in BACKOFFS
        }
        yield _best(f"markov-{order}", made, training, validation)
    tell("context tree")
    trees = {
        f"depth {DEPTH}" + ("" if contexts is None else " "): ContextTreePrior(actions, DEPTH, num_contexts=contexts)
        for contexts in seen
    }
    yield _best("context tree", trees, training, validation)


def _best(model: str, made: Mapping[str, Prior], training: Plans, validation: Plans) -> Rival:
    """The rival that tells `validation` best, of those that learn from `training`."""
    best = None
    for how, unfitted in made.items():
        prior = unfitted.fit(training)
        taken = score(model, prior, validation)
        bits = float(taken.bits.sum() / taken.actions.sum())
        if best is None or bits < best.validation_bits:
            best = Rival(model, how.strip(), prior, bits)
    assert best is not None
    return best


def _units(plans: Plans, mask: Tensor) -> Tensor:
    """The independent unit of each action, `[N, L]`."""
    what = unit_name(plans)
    if what == "groups":
        assert plans.group is not None
        unit: Tensor = plans.group.cpu().unique(return_inverse=True)[1]
        return unit[:, None].expand(mask.shape)
    if what == "plans":
        taken = mask.any(1)
        return (taken.cumsum(0) - 1).clamp(min=0)[:, None].expand(mask.shape)
    place = mask.flatten().cumsum(0).view(mask.shape) - 1
    total = int(mask.sum())
    return (place * min(BLOCKS, total)).div(max(total, 1), rounding_mode="floor")
