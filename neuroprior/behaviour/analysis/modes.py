"""Hidden modes: how many there are, whether they come back in other plans, and what they do."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from operator import le
from typing import Any

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.special import stdtrit
from torch import Tensor

from neuroprior._checks import as_list, check_sizes
from neuroprior._random import draw_seed, generator_on
from neuroprior.behaviour.analysis.comparison import ACTIONS, CONTEXT, Score, action_bits, score_bits
from neuroprior.plans import Plans, constant_context
from neuroprior.plans.folds import FEWEST_UNITS, FOLDS, divisible, folds, num_units
from neuroprior.plans.plans import AnyPlans, check_are_plans
from neuroprior.priors import SwitchingPrior
from neuroprior.priors.construction import context_arguments
from neuroprior.priors.fitting import make_prior
from neuroprior.priors.learning import plans_for
from neuroprior.priors.scoring import plan_frame

STABLE = 0.7
"""The least correlation at which a mode counts as found again in another fold."""

MIN_ENDS = 1e-6
"""Expected ends of a mode below which none is expected."""


@dataclass(frozen=True)
class ModeChoice:
    """Switching priors with different numbers of modes, cross-validated.

    Attributes:
        scores: of each number of modes, the held-out bits.
        chosen: the number of modes that the rule of `choose_modes` chooses.
        priors: of each number of modes, fitted to all plans.
        stability: `[F, K]` for each number of modes K: the correlation of each mode of the prior that was fitted to all
            plans with the corresponding one of each fold's prior.
    """

    scores: dict[int, Score]
    chosen: int
    priors: dict[int, SwitchingPrior]
    stability: dict[int, Tensor]

    @property
    def prior(self) -> SwitchingPrior:
        """That with the chosen number of modes, fitted to all plans."""
        return self.priors[self.chosen]

    def stable(self, number: int | None = None) -> Tensor:
        """`[K]` bool: which modes come back in all folds, with a correlation of at least `STABLE`.

        Args:
            number: K; None: the chosen one.
        """
        return (self.stability[self.chosen if number is None else number] >= STABLE).all(0)

    def frame(self) -> Any:
        """A row each number of modes, as a pandas frame.

        `modes`; `bits` per held-out action with their 95 % interval (`low`, `high`); `more` bits than the best, paired
        by unit, with their standard error `error`; `stable`, how many modes come back in all folds; `chosen`.
        """
        import pandas as pd

        best = _best(self.scores)
        rows = []
        for number, score in self.scores.items():
            bits, low, high, _ = score.bits_per_action()
            more, error = _excess(score, self.scores[best])
            row = {"modes": number, "bits": bits, "low": low, "high": high, "more": more, "error": error}
            rows.append(row | {"stable": int(self.stable(number).sum()), "chosen": number == self.chosen})
        return pd.DataFrame(rows)


def choose_modes(
    plans: Plans,
    num_modes: Sequence[int] = (1, 2, 3, 4),
    *,
    number_of_folds: int | None = None,
    use_context: bool = True,
    mask: Tensor | None = None,
    generator: torch.Generator | None = None,
    **arguments: Any,
) -> ModeChoice:
    """Choose the number of hidden modes by cross-validation, and see whether the modes come back in other plans.

    The rule is that of one standard error (Breiman, Friedman, Olshen and Stone 1984, section 3.4.3): the fewest modes
    whose held-out bits per action are at most one standard error above the fewest bits. The error is that of the
    difference, paired by unit (groups, or plans), which is far smaller than that of the bits themselves.

    Modes of two priors are matched so that their smoothed posteriors in all plans correlate most (the assignment of
    Kuhn 1955). Those that do not come back in all folds are an accident of the plans that they were learned from.

    Args:
        plans: at least two.
        num_modes: the numbers of modes that are tried.
        number_of_folds: F; at most as many as there are groups (plans, where there are no two groups); None: so many,
            but no more than `FOLDS`.
        use_context: whether the prior takes the context of the plans, if that is an index.
        mask: `[N, L]` bool: the actions that count in the bits; None: all.
        generator: draws the folds and what EM starts from.
        arguments: of `SwitchingPrior`, such as `order=2`.

    Raises:
        ValueError: an argument is out of range, or the plans cannot be divided.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1] * 10 + [2, 3] * 10]).repeat(12, 1), 4)
        >>> how = {"order": 0, "restarts": 1, "folds": 2, "generator": torch.Generator().manual_seed(0)}
        >>> choose_modes(plans, [1, 2], number_of_folds=2, **how).chosen
        2
    """
    numbers = sorted(set(as_list("num_modes", num_modes)))
    if not numbers:
        raise ValueError("`num_modes` must not be empty.")
    for number in numbers:
        check_sizes(num_modes=number)
    plans = divisible(plans)
    # Features and patterns cannot be counted.
    scored_plans = plans if use_context and "num_contexts" in context_arguments(plans) else plans.without_context()
    generator = generator_on(generator, "cpu")
    if num_units(scored_plans) < FEWEST_UNITS:
        raise ValueError(
            "`plans` must be at least two, to learn from some and hold out others; `in_parts` cuts a single one."
        )
    if number_of_folds is None:
        number_of_folds = min(FOLDS, num_units(scored_plans))
    parts = folds(scored_plans, number_of_folds, draw_seed(generator) % 2**31)
    if mask is not None and (mask.dtype != torch.bool or mask.shape != scored_plans.actions.shape):
        shape = list(scored_plans.actions.shape)
        raise ValueError(f"`mask` must be bool of shape {shape}, got {mask.dtype} {list(mask.shape)}.")
    mask = scored_plans.mask() if mask is None else scored_plans.mask() & mask
    scores, priors, stability = {}, {}, {}
    inputs = ACTIONS if scored_plans.context is None else CONTEXT
    for number in numbers:
        make = partial(SwitchingPrior, num_modes=number, **arguments)

        def fitted(train_plans: Plans, make: Any = make) -> SwitchingPrior:
            prior = make_prior(scored_plans, make)
            assert isinstance(prior, SwitchingPrior)
            return prior.fit(train_plans, generator=generator)

        whole = fitted(scored_plans)
        reference = whole.posterior(scored_plans).smoothed
        bits, agreement = torch.zeros(scored_plans.actions.shape, dtype=torch.double), []
        for learned, held_out in parts:
            prior = fitted(divisible(scored_plans[learned]))
            bits[held_out] = action_bits(prior, scored_plans[held_out])
            agreement.append(agreements(reference, prior.posterior(scored_plans).smoothed, scored_plans.mask()))
        scores[number] = score_bits(f"{number} modes", inputs, bits, scored_plans, mask)
        priors[number], stability[number] = whole, torch.stack(agreement)
    best = scores[_best(scores)]
    chosen = next(number for number in numbers if le(*_excess(scores[number], best)))
    return ModeChoice(scores, chosen, priors, stability)


def _best(scores: dict[int, Score]) -> int:
    return min(scores, key=lambda number: float(scores[number].bits.sum()))


def _excess(score: Score, best: Score) -> tuple[float, float]:
    """Bits per action more than the best, and the standard error of this difference; see `ratio_difference`."""
    mean, low, high, _ = score.minus(best)
    return mean, (high - low) / 2 / float(stdtrit(len(score.bits) - 1, 0.975))


def agreements(one: Tensor, other: Tensor, mask: Tensor) -> Tensor:
    """The correlation of each mode with its counterpart in another prior, matched so that their sum is largest.

    Args:
        one, other: `[N, L, K]`: posteriors of the modes behind the same actions.
        mask: `[N, L]` bool: the actions that count.

    Returns:
        float64 `[K]`.
    """
    correlations = _correlations(one, other, mask)
    return correlations[linear_sum_assignment(-correlations.numpy())]


def _correlations(one: Tensor, other: Tensor, mask: Tensor) -> Tensor:
    """`[K, K]`: correlations over actions; 1 between modes that are constant, as a single one is, else 0 for these."""
    first, second = (values[mask].cpu().double() for values in (one, other))
    first, second = first - first.mean(0), second - second.mean(0)
    sizes = [values.norm(dim=0) / max(len(values), 1) ** 0.5 for values in (first, second)]
    product = first.T @ second / max(len(first), 1)
    still = [size < 1e-6 for size in sizes]
    both, either = still[0][:, None] & still[1], still[0][:, None] | still[1]
    return torch.where(either, both.double(), product / (sizes[0][:, None] * sizes[1]).clamp(min=1e-12))


def mode_names(number: int) -> tuple[str, ...]:
    """What modes are called in tables and figures: "mode 1", which is the most common, and so on."""
    return tuple(f"mode {k + 1}" for k in range(number))


def _check_plans(prior: SwitchingPrior, plans: Plans) -> Plans:
    """The plans as the prior takes them."""
    if not isinstance(prior, SwitchingPrior):
        raise ValueError(f"`prior` must be a SwitchingPrior, got {type(prior).__name__}.")
    check_are_plans(plans)
    return plans_for(prior, plans)


def mode_plans(prior: SwitchingPrior, plans: AnyPlans) -> AnyPlans:
    """The most probable modes behind plans, as plans whose actions are modes.

    So all analyses of plans apply to modes: `transitions`, `compare_conditions`, the ethogram.

    Args:
        prior: fitted.
        plans: N of them, such as it was fitted to.

    Raises:
        ValueError: plans that the prior cannot score.

    Example:
        >>> from neuroprior.priors import SwitchingPrior
        >>> plans = Plans(torch.tensor([[0, 1] * 5 + [2, 3] * 5]).repeat(6, 1), 4)
        >>> prior = SwitchingPrior(4, num_modes=2, order=0, folds=2, restarts=1).fit(
        ...     plans, generator=torch.Generator().manual_seed(0)
        ... )
        >>> mode_plans(prior, plans).num_actions
        2
    """
    scored_plans = _check_plans(prior, plans)
    path = prior.posterior(scored_plans).path.cpu()
    return replace(plans, actions=path, num_actions=prior.num_modes, action_names=mode_names(prior.num_modes), end=None)


def mode_transitions(prior: SwitchingPrior, plans: Plans) -> Tensor:
    """How often each mode took each action after each, in expectation: `[K, A, A]`, float64, last by next action."""
    scored_plans, size = _check_plans(prior, plans), plans.num_actions
    both, actions = plans.mask()[:, 1:], plans.actions.long()
    pair = (actions[:, :-1] * size + actions[:, 1:])[both]
    weights = prior.posterior(scored_plans).smoothed.cpu()[:, 1:][both]
    counts = weights.new_zeros(prior.num_modes, size * size)
    return counts.index_add_(1, pair, weights.T).view(-1, size, size)


def mode_frame(prior: SwitchingPrior, plans: Plans) -> Any:
    """The modes behind each action, as a pandas frame with a row an action.

    `plan`, and `group` and whatever else a plan has one of (by name, or numbers); `step`, from 0; `context`, where it
    is an index; `action`; `mode`, the most probable path's, from 1; and for each mode k `filtered_k`, its probability
    given the actions so far, and `smoothed_k`, given the whole plan.

    Args:
        prior: fitted.
        plans: N of them, such as it was fitted to.

    Raises:
        ValueError: plans that the prior cannot score.

    Example:
        >>> from neuroprior.priors import SwitchingPrior
        >>> plans = Plans(torch.tensor([[0, 1] * 5 + [2, 3] * 5]).repeat(6, 1), 4)
        >>> prior = SwitchingPrior(4, num_modes=2, order=0, folds=2, restarts=1).fit(
        ...     plans, generator=torch.Generator().manual_seed(0)
        ... )
        >>> len(mode_frame(prior, plans))
        120
    """
    scored_plans = _check_plans(prior, plans)
    posterior, mask = prior.posterior(scored_plans), plans.mask()
    which, step = (index.numpy() for index in mask.nonzero(as_tuple=True))

    def named(names: Sequence[str] | None, numbers: Tensor) -> Any:
        return numbers.numpy() if names is None else np.asarray(names, dtype=object)[numbers.numpy()]

    columns: dict[str, Any] = {"step": step}
    context = plans.context
    if context is not None and "num_contexts" in context_arguments(plans):
        columns["context"] = named(plans.context_names, context[mask].long())
    columns["action"] = named(plans.action_names, plans.actions[mask].long())
    columns["mode"] = posterior.path.cpu()[mask].numpy() + 1
    for what, values in (("filtered", posterior.filtered), ("smoothed", posterior.smoothed)):
        columns |= {f"{what}_{k + 1}": values[..., k].cpu()[mask].numpy() for k in range(prior.num_modes)}
    return plan_frame(plans).iloc[which].assign(**columns).reset_index(drop=True)


def mode_table(prior: SwitchingPrior, plans: Plans) -> Any:
    """What each mode does, as a pandas frame with a row a mode.

    `mode`; `share` of the actions, by the smoothed posterior; `dwell`, the expected actions in it, with a next one, for
    each expected end of it (infinite where none is expected); `visits`, expected in a plan;
    `behaviours`, up to three that it takes more often than all modes together, by the difference (of a single mode, the
    most frequent), with their shares in the mode; `enters` and `leaves`, the three contexts in which the path most
    often changes to it and from it, where contexts are indices.

    Args:
        prior: fitted.
        plans: N of them, such as it was fitted to.

    Raises:
        ValueError: plans that the prior cannot score.

    Example:
        >>> from neuroprior.priors import SwitchingPrior
        >>> plans = Plans(torch.tensor([[0, 1] * 5 + [2, 3] * 5]).repeat(6, 1), 4)
        >>> prior = SwitchingPrior(4, num_modes=2, order=0, folds=2, restarts=1).fit(
        ...     plans, generator=torch.Generator().manual_seed(0)
        ... )
        >>> len(mode_table(prior, plans))
        2
    """
    import pandas as pd

    scored_plans = _check_plans(prior, plans)
    posterior, mask = prior.posterior(scored_plans), plans.mask()
    weights, actions = posterior.smoothed.cpu()[mask], plans.actions[mask].long()
    path = posterior.path.cpu()
    taken = torch.zeros(prior.num_modes, plans.num_actions, dtype=torch.double).index_add_(1, actions, weights.T)
    overall = taken.sum(0) / taken.sum() if prior.num_modes > 1 else taken.new_zeros(plans.num_actions)
    names = plans.action_names or tuple(map(str, range(plans.num_actions)))
    changed = (path[:, 1:] != path[:, :-1]) & mask[:, 1:]
    context = plans.context
    places = None
    varies = context is not None and constant_context(plans) is None
    if context is not None and varies and "num_contexts" in context_arguments(plans):
        places = plans.context_names or tuple(map(str, range(int(context.max()) + 1)))
    rows = []
    moves = posterior.moves.cpu().sum(0)
    leaves, enters = (moves.sum(by) - moves.diagonal() for by in (1, 0))
    begun = posterior.smoothed.cpu()[:, :1][mask[:, :1]].sum(0)
    for k in range(prior.num_modes):
        shares = taken[k] / taken[k].sum().clamp(min=1e-12)
        most = (shares - overall).argsort(descending=True, stable=True)[:3].tolist()
        row: dict[str, Any] = {
            "mode": k + 1,
            "share": float(weights[:, k].mean()),
            "dwell": float(moves[k].sum() / leaves[k]) if leaves[k] > MIN_ENDS else inf,
            "visits": float((begun[k] + enters[k]) / len(plans)),
            "behaviours": ", ".join(f"{names[a]} {shares[a]:.2f}" for a in most if shares[a] > overall[a]),
        }
        if places is not None and context is not None:
            for what, of in (("enters", path[:, 1:]), ("leaves", path[:, :-1])):
                where = context[:, 1:][changed & (of == k)].long().bincount(minlength=len(places))
                top = where.argsort(descending=True, stable=True)[:3].tolist()
                row[what] = ", ".join(f"{places[c]} {where[c] / where.sum():.2f}" for c in top if where[c])
        rows.append(row)
    return pd.DataFrame(rows)
