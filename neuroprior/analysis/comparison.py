"""Priors compared on held-out plans: bits per action with intervals, and the count-based rivals a prior must meet."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import log

import torch
from torch import Tensor

from neuroprior.analysis.statistics import Difference, ratio_difference
from neuroprior.plans import Plans
from neuroprior.plans.folds import BLOCKS, FEWEST_UNITS
from neuroprior.priors import ContextTreePrior, MarkovPrior, Prior, UniformPrior
from neuroprior.priors.counts import Backoff, TooLargeError

ORDERS = range(7)
"""Markov orders that a prior is compared with."""

DEPTH = 10
"""Depth of the context trees that a prior is compared with."""

BACKOFFS_TRIED: list[tuple[Backoff, float]] = [
    ("kneser-ney", 1),
    ("kneser-ney", 0.5),
    ("witten-bell", 1),
    ("witten-bell", 4),
    ("dirichlet", 1),
    ("dirichlet", 8),
]
"""Back-offs and their smoothing of which each Markov order takes the best."""


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
        """Bits per action more than `other` took for the same plans, paired by unit.

        Raises:
            ValueError: the other was scored on other plans.
        """
        if not self.actions.equal(other.actions):
            raise ValueError(f"{self.model} and {other.model}: not scored on the same plans")
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
    sees = "actions and context" if prior.takes_context else "actions"
    return score_bits(model, sees, action_bits(prior, plans), plans)


def score_bits(model: str, sees: str, bits: Tensor, plans: Plans, mask: Tensor | None = None) -> Score:
    """The score of a model whose bits are known.

    Args:
        model: its name.
        sees: "actions", or "actions and context".
        bits: `[N, L]`, what each action cost.
        plans: held-out plans, of which the units come.
        mask: `[N, L]` bool: the actions that count; None: all.

    Raises:
        ValueError: fewer than two actions count.
    """
    mask = (plans.mask() if mask is None else mask).cpu()
    unit = units(plans, mask)[mask].unique(return_inverse=True)[1]
    size = int(unit.max()) + 1 if len(unit) else 0
    if size < FEWEST_UNITS:
        raise ValueError(f"plans: at least two held-out actions are needed for a comparison, not {int(mask.sum())}")
    totals = torch.zeros(size, dtype=torch.double).index_add_(0, unit, bits[mask].double())
    return Score(model, sees, totals, unit.bincount(minlength=size).double())


def action_bits(prior: Prior, plans: Plans) -> Tensor:
    """What each action costs under `prior`: `[N, L]` bits, float64, on the CPU; 0 beyond a plan's end.

    A prior that sees nothing leaves the context of the plans aside.

    Raises:
        ValueError: plans that the prior cannot score.
    """
    seen = plans if prior.takes_context else replace(plans, context=None, context_names=None)
    with torch.no_grad():
        return -prior.action_log_probs(seen).double().cpu() / log(2)


def unit_name(plans: Plans, mask: Tensor | None = None) -> str:
    """What intervals go over: "groups", "plans", "plans of one group" or "parts of the plan".

    Args:
        plans: the plans.
        mask: `[N, L]` bool: the actions that count; None: all.
    """
    taken = (plans.mask() if mask is None else mask).any(1)
    if plans.group is not None and len(plans.group.to(taken.device)[taken].unique()) >= FEWEST_UNITS:
        return "groups"
    if plans.group is not None and int(taken.sum()) >= FEWEST_UNITS:
        return "plans of one group"
    return "plans" if int(taken.sum()) >= FEWEST_UNITS else "parts of the plan"


@dataclass(frozen=True)
class Rival:
    """A count-based prior that another prior is compared with.

    Attributes:
        model: its name, such as "markov-3".
        how: the settings that tell the validation plans best, of those in `BACKOFFS_TRIED`.
        prior: fitted; None where its tables would be too large.
        validation_bits: bits per action on the validation plans; infinite without a prior.
    """

    model: str
    how: str
    prior: Prior | None
    validation_bits: float


def rivals(
    training: Plans,
    validation: Plans,
    num_contexts: int | None = None,
    tell: Callable[[str], None] | None = None,
    always_see: bool = False,
) -> Iterator[Rival]:
    """The uniform prior and the count-based ones: Markov chains of every order in `ORDERS`, and a context tree.

    Each Markov order comes with the back-off and smoothing, and where the plans have a context index with or without
    it, that tell the validation plans best; so does the context tree. Features cannot be counted and are left aside.

    Args:
        training: what they learn from.
        validation: what they are chosen on.
        num_contexts: number of context indices, where they may see one.
        tell: called with the name of what is fitted next.
        always_see: all see the context, whether or not it helps; the uniform prior, which cannot, is left out.

    Yields:
        One rival after the other, each fitted when it is asked for.
    """
    seen: list[int | None] = [None] if num_contexts is None else [num_contexts] if always_see else [None, num_contexts]
    if not (always_see and num_contexts is not None):
        yield _best("uniform", iter([("", UniformPrior(training.num_actions).fit(training))]), validation)
    for order in ORDERS:
        if tell is not None:
            tell(f"markov-{order}")
        yield _best(f"markov-{order}", _chains(training, order, seen), validation)
    if tell is not None:
        tell("context tree")
    trees = (ContextTreePrior(training.num_actions, DEPTH, num_contexts=contexts) for contexts in seen)
    yield _best("context tree", ((f"depth {DEPTH}", tree.fit(training)) for tree in trees), validation)


def _chains(training: Plans, order: int, seen: list[int | None]) -> Iterator[tuple[str, Prior]]:
    """Markov chains of an order with every back-off; what they count is counted once."""
    for contexts in seen:
        counted = None
        for backoff, smoothing in BACKOFFS_TRIED:
            prior = MarkovPrior(training.num_actions, order, smoothing, num_contexts=contexts, backoff=backoff)
            counted = prior.count(training) if counted is None else counted
            prior.training_plans(training)
            prior.learn(*counted)
            yield f"{backoff} {smoothing:g}", prior


def _best(model: str, made: Iterator[tuple[str, Prior]], validation: Plans) -> Rival:
    """The rival that tells `validation` best; at most two are held at a time."""
    best = Rival(model, "too large", None, float("inf"))
    try:
        for how, prior in made:
            taken = score(model, prior, validation)
            bits = float(taken.bits.sum() / taken.actions.sum())
            if bits < best.validation_bits:
                best = Rival(model, how, prior, bits)
    except TooLargeError:
        # Those that see a context come last and are the largest: what was found before them stands.
        pass
    return best


def units(plans: Plans, mask: Tensor) -> Tensor:
    """The independent unit of each action: what the interval of every statistic of plans goes over.

    The groups; or the plans, where no two groups have actions that count; or `BLOCKS` consecutive parts of the only
    plan that has any, alike in size but for one action.

    Args:
        plans: the plans.
        mask: `[N, L]` bool: the actions that count.

    Returns:
        `[N, L]` int64, on the device of `mask`: numbers from 0, ascending with the number of the group, of the plan or
        of the part. They mean nothing outside `mask`, and a group without actions leaves out its number.
    """
    what = unit_name(plans, mask)
    if what == "groups":
        assert plans.group is not None
        unit: Tensor = plans.group.to(mask.device).unique(return_inverse=True)[1]
        return unit[:, None].expand(mask.shape)
    if what.startswith("plans"):
        taken = mask.any(1)
        return (taken.cumsum(0) - 1).clamp(min=0)[:, None].expand(mask.shape)
    place = mask.flatten().cumsum(0).view(mask.shape) - 1
    total = int(mask.sum())
    return (place * min(BLOCKS, total)).div(max(total, 1), rounding_mode="floor")
