"""Priors compared on held-out plans: bits per action with intervals, and count-based baselines."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import inf, log2

import numpy as np
import torch
from torch import Tensor

from neuroprior._statistics import ENOUGH_UNITS, ROUNDING, Difference, ratio_difference
from neuroprior.plans import Plans
from neuroprior.plans.columns import SHOWN, Integers, listed, named
from neuroprior.plans.folds import BLOCKS, FEWEST_UNITS
from neuroprior.plans.plans import check_are_plans
from neuroprior.priors import ContextTreePrior, Prior, UniformPrior
from neuroprior.priors.counts import Chains, TooLargeError
from neuroprior.priors.ensembles.candidates import DEPTH, ORDERS
from neuroprior.priors.learning import plans_for
from neuroprior.priors.scoring import bits_after

ACTIONS, CONTEXT, DURATIONS = "behaviours", "behaviours and context", "behaviours and durations"
"""The input of a model, in the words of reports; durations are those of past actions."""


@dataclass(frozen=True)
class Score:
    """The negative log-likelihood of held-out plans under a prior, by independent unit.

    Attributes:
        model: the prior's name.
        inputs: what it predicts from, `ACTIONS` or `CONTEXT`.
        bits: `[G]`, float64: the negative log2-likelihood of each independent unit.
        actions: `[G]`, float64: the number of actions in each unit.
        digest: of the actions that were scored; scores of others are not compared.
    """

    model: str
    inputs: str
    bits: Tensor
    actions: Tensor
    digest: str = ""

    def bits_per_action(self) -> Difference:
        """Bits per action with its 95 % interval over units."""
        return ratio_difference(self.bits, self.actions)

    def minus(self, other: "Score") -> Difference:
        """Bits per action less those of `other` on the same plans, paired by unit; below 0 this prior is better.

        Raises:
            ValueError: the two were not scored on the same plans.
        """
        if self.digest != other.digest or not self.actions.equal(other.actions):
            raise ValueError(f"{self.model} and {other.model} must be scored on the same plans.")
        gap = self.bits - other.bits
        noise = gap.abs() <= ROUNDING * torch.maximum(self.bits.abs(), other.bits.abs())
        return ratio_difference(gap.masked_fill(noise, 0), self.actions)


def score(model: str, prior: Prior, plans: Plans) -> Score:
    """Score `prior` on plans that it was not fitted to; see `units` for what the interval is over.

    Args:
        model: the prior's name in tables.
        prior: any prior over the plans' actions; their context is only used by a prior that takes one.
        plans: held-out plans with at least two actions in all.

    Raises:
        ValueError: plans that the prior cannot score, or fewer than two actions.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2], [2, 1, 0]]), 3)
        >>> round(score("uniform", UniformPrior(3), plans).bits_per_action().mean, 3)
        1.585
    """
    bits = action_bits(prior, plans)
    inputs = CONTEXT if prior.takes_context else ACTIONS
    return score_bits(model, inputs, bits, plans)


def score_bits(model: str, inputs: str, bits: Tensor, plans: Plans, mask: Tensor | None = None) -> Score:
    """The score of a model from the bits of each action.

    Args:
        model: its name.
        inputs: `ACTIONS` or `CONTEXT`.
        bits: `[N, L]`, the negative log2-probability of each action.
        plans: the held-out plans, which define the units.
        mask: `[N, L]` bool: the actions that count; None: all.

    Raises:
        ValueError: fewer than two actions count, bits of another shape or that are NaN, or a mask of another shape or
            with actions behind the end of a plan.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2], [2, 1, 0]]), 3)
        >>> score_bits("uniform", "past actions", action_bits(UniformPrior(3), plans), plans).actions.tolist()
        [3.0, 3.0]
    """
    mask, within = (plans.mask() if mask is None else mask).cpu(), plans.mask().cpu()
    if mask.dtype != torch.bool or mask.shape != within.shape or bool((mask & ~within).any()):
        raise ValueError(f"`mask` must be bool of shape {list(within.shape)}, False behind the end of a plan.")
    if bits.shape != mask.shape or bool(bits[mask].isnan().any()):
        raise ValueError(f"`bits` must be numbers of shape {list(mask.shape)}, not NaN, got {list(bits.shape)}.")
    unit = units(plans, mask)[mask].unique(return_inverse=True)[1]
    size = int(unit.max()) + 1 if len(unit) else 0
    if size < FEWEST_UNITS:
        raise ValueError(f"`plans` must have at least two held-out actions, got {int(mask.sum())}.")
    totals = torch.zeros(size, dtype=torch.double).index_add_(0, unit, bits[mask].double())
    scored = hashlib.sha256()
    for values in (within.sum(1), plans.actions.cpu()[within].long(), mask[within]):
        scored.update(values.numpy().tobytes())
    return Score(model, inputs, totals, unit.bincount(minlength=size).double(), scored.hexdigest())


def action_bits(prior: Prior, plans: Plans) -> Tensor:
    """The surprisal of each action, its negative log2-probability under `prior`: `[N, L]`, float64, on the CPU.

    It is 0 beyond a plan's end. The context of the plans is only used by a prior that takes one.

    Args:
        prior: fitted.
        plans: N of them.

    Raises:
        ValueError: plans that the prior cannot score.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2]]), 3)
        >>> action_bits(UniformPrior(3), plans).round(decimals=2).tolist()
        [[1.58, 1.58, 1.58]]
    """
    if not isinstance(prior, Prior):
        raise ValueError(f"`prior` must be a fitted prior, got {type(prior).__name__}.")
    check_are_plans(plans)
    return bits_after(prior, plans)


def never_occur(occur: Integers, num_actions: int, names: Sequence[str] | None = None) -> str:
    """Which of the actions are none of those that `occur`, and that they never occur; "" where all do."""
    number = num_actions - len(occur)
    first = np.setdiff1d(np.arange(min(num_actions, len(occur) + SHOWN)), occur).tolist()  # at least `SHOWN`, or all
    verb = "occurs" if number == 1 else "occur"
    return f"{listed(named(first, names), number)} never {verb}" if number else ""


def never_taken(plans: Plans) -> str:
    """What to say beside the bits of the uniform prior where some actions never occur; "" where all do."""
    occur = plans.actions[plans.mask()].unique().cpu().numpy()
    never = never_occur(occur, plans.num_actions, plans.action_names)
    if not never or not len(occur):
        return ""
    others = f"without them it needs {log2(len(occur)):.4f} bits"
    return f"uniform counts all {plans.num_actions} actions, of which {never}; {others}"


def unit_name(plans: Plans, mask: Tensor | None = None) -> str:
    """Return the kind of `units` that intervals are over.

    "subjects" are groups; "sequences", "sequences of one subject" and "parts of the sequence" are of plans.

    Args:
        plans: the plans.
        mask: `[N, L]` bool: the actions that count; None: all.

    Example:
        >>> unit_name(Plans(torch.zeros(4, 3, dtype=torch.long), 2, group=torch.tensor([0, 0, 1, 1])))
        'subjects'
    """
    taken = (plans.mask() if mask is None else mask).any(1)
    if plans.group is not None and len(plans.group.to(taken.device)[taken].unique()) >= FEWEST_UNITS:
        return "subjects"
    if plans.group is not None and int(taken.sum()) >= FEWEST_UNITS:
        return "sequences of one subject"
    return "sequences" if int(taken.sum()) >= FEWEST_UNITS else "parts of the sequence"


def too_few(plans: Plans, mask: Tensor | None = None, cut: bool = False) -> str:
    """Why no verdict is drawn from plans, such as "3 subjects are too few for a verdict"; "" where one may be.

    Independent are groups; where there are none, plans. Plans of one group, and parts of one plan, are not.

    Args:
        plans: the plans.
        mask: `[N, L]` bool: the actions that count; None: all.
        cut: they are parts of a single plan.
    """
    taken = (plans.mask() if mask is None else mask).any(1)
    if plans.group is not None:
        what, number = "subject", len(plans.group.to(taken.device)[taken].unique())
    else:
        what, number = "sequence", 1 if cut else int(taken.sum())
    if number >= ENOUGH_UNITS:
        return ""
    return f"{number} {what}{'s' * (number != 1)} {'is' if number == 1 else 'are'} too few for a verdict"


@dataclass(frozen=True)
class Baseline:
    """A count-based prior that other priors are compared with.

    Attributes:
        model: its name, such as "markov-3".
        how: its settings, those with the highest likelihood of the validation plans (see `BACKOFFS_TRIED`).
        prior: the fitted prior; None if its tables would be too large.
        validation_bits: bits per action on the validation plans; infinite without a prior.
    """

    model: str
    how: str
    prior: Prior | None
    validation_bits: float


def baselines(
    training: Plans,
    validation: Plans,
    num_contexts: int | None = None,
    progress: Callable[[str], None] | None = None,
    always_context: bool = False,
) -> Iterator[Baseline]:
    """The uniform prior, Markov chains of all orders in `ORDERS`, and a context tree, each fitted when it is asked for.

    The back-off and smoothing of each Markov chain are those with the highest likelihood of the validation plans. So is
    whether a chain or the tree takes the context, if it is an index; features cannot be counted and are ignored.

    Args:
        training: the plans that baselines are fitted to.
        validation: the plans that settings are chosen on.
        num_contexts: number of context indices; None to ignore the context.
        progress: called with the name of the baseline that is fitted next.
        always_context: all take the context, whether or not it helps; the uniform prior, which cannot, is left out.

    Yields:
        One baseline after the other.

    Example:
        >>> plans = Plans(torch.randint(2, (40, 6), generator=torch.Generator().manual_seed(0)), 2)
        >>> [baseline.model for baseline in baselines(plans[:30], plans[30:])][:3]
        ['uniform', 'markov-0', 'markov-1']
    """
    contexts: list[int | None] = [num_contexts] if num_contexts is None or always_context else [None, num_contexts]
    if num_contexts is None or not always_context:
        yield _best("uniform", [("", UniformPrior(training.num_actions).fit(training.without_context()))], validation)
    for order in ORDERS:
        if progress is not None:
            progress(f"markov-{order}")
        yield best_chain(training, order, contexts, validation)
    if progress is not None:
        progress("context tree")
    trees = (ContextTreePrior(training.num_actions, DEPTH, num_contexts=num) for num in contexts)
    yield _best("context tree", ((f"depth {DEPTH}", tree.fit(plans_for(tree, training))) for tree in trees), validation)


def best_chain(training: Plans, order: int, contexts: list[int | None], validation: Plans) -> Baseline:
    """The Markov chain of an order whose context (one of these), back-off and smoothing predict `validation` best."""
    return _best(f"markov-{order}", _chains(training, order, contexts, validation), validation)


def _chains(training: Plans, order: int, contexts: list[int | None], validation: Plans) -> Iterator[tuple[str, Prior]]:
    """The Markov chain of an order, with each context, whose back-off makes `validation` likeliest."""
    for num_contexts in contexts:
        chains = Chains(training, order, num_contexts)
        prior = chains.chain(int(chains.log_likelihood(validation).argmax()))
        yield f"{prior.backoff} {prior.smoothing:g}", prior


def _best(model: str, candidates: Iterable[tuple[str, Prior]], validation: Plans) -> Baseline:
    """The one with the highest likelihood of `validation`; at most two are in memory at a time."""
    best = Baseline(model, "too large", None, inf)
    try:
        for how, prior in candidates:
            validation_score = score(model, prior, validation)
            bits = float(validation_score.bits.sum() / validation_score.actions.sum())
            if bits < best.validation_bits:
                best = Baseline(model, how, prior, bits)
    except TooLargeError:
        # Those that take a context come last and are the largest: what was found before them stands.
        pass
    return best


def units(plans: Plans, mask: Tensor) -> Tensor:
    """The independent unit of each action; the intervals of all statistics of plans are over these units.

    The groups; or the plans, if fewer than two groups have actions that count; or `BLOCKS` consecutive parts of the
    only plan that has any, which differ in size by one action at most.

    Args:
        plans: the plans.
        mask: `[N, L]` bool: the actions that count.

    Returns:
        `[N, L]` int64, on the device of `mask`: numbers from 0, ascending with the number of the group, of the plan or
        of the part. They are arbitrary outside `mask`, and the number of a group without actions is not used.

    Example:
        >>> plans = Plans(torch.zeros(4, 3, dtype=torch.long), 2, group=torch.tensor([0, 0, 1, 1]))
        >>> units(plans, plans.mask()).shape
        torch.Size([4, 3])
    """
    what = unit_name(plans, mask)
    if what == "subjects":
        assert plans.group is not None
        unit: Tensor = plans.group.to(mask.device).unique(return_inverse=True)[1]
        return unit[:, None].expand(mask.shape)
    if what.startswith("sequences"):
        taken = mask.any(1)
        return (taken.cumsum(0) - 1).clamp(min=0)[:, None].expand(mask.shape)
    place = mask.flatten().cumsum(0).view(mask.shape) - 1
    total = int(mask.sum())
    return (place * min(BLOCKS, total)).div(max(total, 1), rounding_mode="floor")
