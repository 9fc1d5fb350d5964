"""Order selection: on how many past actions the next one depends, as a Markov chain, by BIC and AIC."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_range, is_integer
from neuroprior.behaviour.analysis.flat import FlatPlans, ranks
from neuroprior.plans import Plans


@dataclass(frozen=True)
class OrderFit:
    """A Markov chain of one order, fitted by maximum likelihood and scored on the same actions.

    Attributes:
        order: the number of past actions that the next one may depend on.
        log_likelihood: of all scored actions given the past ones, nats; in sample.
        num_parameters: free parameters: (histories that occurred) x (A - 1).
        bic: -2 log-likelihood + parameters x log(scored actions) (Schwarz 1978); the lowest is best.
        aic: -2 log-likelihood + 2 x parameters (Akaike 1974); it tends to choose too high an order (Katz 1981).
        num_actions_scored: the same for all orders.
    """

    order: int
    log_likelihood: float
    num_parameters: int
    bic: float
    aic: float
    num_actions_scored: int


def order_selection(plans: Plans, max_order: int = 6, num_contexts: int | None = None) -> list[OrderFit]:
    """Markov chains of orders 0 to `max_order`, all scored on the same actions.

    The first `max_order` actions of each plan are not scored, as they have no history of that length. With enough data
    the order of the lowest BIC is the true one (Katz 1981; Csiszár and Shields 2000). These authors count the
    parameters of all A**k histories; here only those of histories that occurred count, as the others are not fitted.
    With enough data that is the same if all histories are possible, and does not penalise high orders for impossible
    ones.

    Args:
        plans: at least one has more than `max_order` actions.
        max_order: the highest order.
        num_contexts: number of context indices, if the next action may also depend on the context of its step (or of
            the plan); a history is then the past actions with that index. None to ignore the context.

    Returns:
        One fit for each order, from 0.

    Raises:
        ValueError: `max_order` is negative or no plan is longer, or the plans have no context indices that are all
            below `num_contexts`.

    Example:
        >>> plans = Plans(torch.randint(2, (50, 20), generator=torch.Generator().manual_seed(0)), 2)
        >>> fits = order_selection(plans, max_order=2)
        >>> min(fits, key=lambda fit: fit.bic).order
        0
    """
    check_count("max_order", max_order, 0)
    flat = FlatPlans.of(plans)
    scored = flat.starts(max_order + 1) + max_order
    if len(scored) == 0:
        longest = int(plans.mask().sum(1).max()) if len(plans) else 0
        raise ValueError(f"max_order: below {longest}, the actions of the longest plan, is expected, not {max_order}")
    following, history = flat.actions[scored], torch.zeros_like(scored)
    if num_contexts is not None:
        history = ranks(_context(plans, flat, num_contexts)[scored])
    fits = []
    for order in range(max_order + 1):
        if order:
            history = ranks(history * flat.num_actions + flat.actions[scored - order])
        fits.append(_fit(order, history, following, flat.num_actions))
    return fits


def _fit(order: int, history: Tensor, following: Tensor, num_actions: int) -> OrderFit:
    """The chain in which `following [M]` depends on `history [M]`, ranks from 0."""
    times = history.bincount()
    together = torch.unique(history * num_actions + following, return_counts=True)[1]
    log_likelihood = float(_sum_n_log_n(together) - _sum_n_log_n(times))
    scored, parameters = len(following), len(times) * (num_actions - 1)
    return OrderFit(
        order,
        log_likelihood,
        parameters,
        bic=-2 * log_likelihood + parameters * math.log(scored),
        aic=-2 * log_likelihood + 2 * parameters,
        num_actions_scored=scored,
    )


def _sum_n_log_n(counts: Tensor) -> Tensor:
    return torch.xlogy(counts.double(), counts.double()).sum()


def _context(plans: Plans, flat: FlatPlans, num_contexts: int) -> Tensor:
    """`[M]`: the context index of each action."""
    if plans.context is None or not is_integer(plans.context) or plans.context.dim() > 2:
        found = "none" if plans.context is None else str(plans.context.dtype).removeprefix("torch.")
        raise ValueError(f"context: indices below {num_contexts} are expected, not {found}")
    check_range("context", plans.context, num_contexts, "contexts")
    return plans.context.flatten()[flat.place].long()
