"""Fitting in one call: a prior is made for the plans, and learns from them."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from neuroprior._registry import Registry
from neuroprior.plans import Plans
from neuroprior.plans.columns import count_up_to
from neuroprior.plans.sequences import Sequences
from neuroprior.priors.adaptive import AdaptivePrior
from neuroprior.priors.construction import construct, context_arguments
from neuroprior.priors.counts import ContextTreePrior, MarkovPrior
from neuroprior.priors.ensembles import CombinedPrior, MixturePrior, StackedPrior
from neuroprior.priors.ensembles.candidates import Effort
from neuroprior.priors.neural import GRUPrior, TransformerPrior
from neuroprior.priors.prior import Prior, as_actions
from neuroprior.priors.switching import SwitchingPrior
from neuroprior.priors.uniform import UniformPrior

MakePrior = Callable[..., Prior]
"""A prior's class, or a function: of the number of actions, and perhaps of `num_contexts` or `context_size`."""


def fit(
    plans: Plans | Tensor,
    prior: MakePrior | str = CombinedPrior,
    *,
    effort: Effort | None = None,
    generator: torch.Generator | None = None,
    **settings: Any,
) -> Prior:
    """Make a prior for plans, and fit it to them.

    Args:
        plans: `Plans`, or integers `[N, L]` for plans without context, of as many actions as occur.
        prior: its class, such as `GRUPrior`; by default `CombinedPrior`, which combines priors of every kind. Or a
            function that makes it, such as `partial(GRUPrior, hidden_size=128)`, called with the number of actions and,
            where it takes it, `num_contexts` or `context_size`; or one of the names in `PRIORS`. A prior that cannot
            take the context of the plans ignores it.
        effort: how much the combined prior spends on networks: "fast", "standard" (default) or "full"; see
            `CombinedPrior`.
        generator: source of randomness; see `Prior.fit`.
        settings: of the prior's `fit`, such as `max_steps=500`; see `neuroprior.training.Settings`.

    Returns:
        The fitted prior.

    Raises:
        ValueError: an unknown name, plans without actions or that the prior cannot learn from, or a setting that
            it does not have.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2, 0, 1, 2]]).repeat(20, 1), 3)
        >>> fit(plans, "markov").order
        1
    """
    if isinstance(prior, Prior):
        raise ValueError(
            f"`prior` must be a class, a function or a name, got one {type(prior).__name__} that is made already; use"
            " its own fit(plans)"
        )
    argument: object = plans
    if isinstance(argument, Sequences) and not isinstance(argument, Plans):
        raise ValueError(f"`plans` must be Plans of numbered actions, got {type(argument).__name__}")
    if not isinstance(plans, Plans):
        actions = as_actions(plans)
        plans = Plans(actions, count_up_to(int(actions.max())) if actions.numel() else 1)
    if not plans.mask().any():
        raise ValueError(f"`plans` must have at least one action to learn from; these {len(plans)} have none")
    if isinstance(prior, str):
        kind = PRIORS.find(prior)
        if kind is None:
            raise ValueError(f"`prior` must be one of {', '.join(PRIORS)}, got {prior!r}")
        prior = kind
    if not callable(prior):
        raise ValueError(f"`prior` must be a class, a function or a name, got {prior!r}")
    if effort is not None:
        if prior is not CombinedPrior:
            raise ValueError("effort: for the combined prior alone; leave it out, or leave prior out")
        prior = partial(CombinedPrior, effort=effort)
    model = make_prior(plans, prior)
    fitted: object = model.fit(plans, generator=generator, **settings)
    if not isinstance(fitted, Prior):
        raise ValueError(
            f"prior: {type(model).__name__}.fit returned {type(fitted).__name__}; it must return the prior"
        )
    return fitted


def make_prior(plans: Plans, prior: MakePrior, use_context: bool = True) -> Prior:
    """A prior for plans: with their number of actions, and their kind of context where it can take one.

    Args:
        plans: that it is to learn from.
        prior: its class, or a function that makes it; see `fit`.
        use_context: False: the prior is made without context.
    """
    return construct(prior, plans.num_actions, context_arguments(plans) if use_context else {})


def _mixture(num_actions: int, num_contexts: int | None = None) -> MixturePrior:
    """Chains, a context tree and a network."""
    kinds = (MarkovPrior, ContextTreePrior, GRUPrior)
    return MixturePrior(num_actions, [kind(num_actions, num_contexts=num_contexts) for kind in kinds])


def _adaptive(num_actions: int, num_contexts: int | None = None) -> AdaptivePrior:
    """A context tree, drawn towards what the individual did."""
    return AdaptivePrior(ContextTreePrior(num_actions, num_contexts=num_contexts), [10.0, 10.0, 10.0])


_CORE: dict[str, MakePrior] = {
    "combined": CombinedPrior,
    "uniform": UniformPrior,
    "markov": MarkovPrior,
    "context-tree": ContextTreePrior,
    "gru": GRUPrior,
    "transformer": TransformerPrior,
    "stacked": StackedPrior,
    "adaptive": _adaptive,
    "mixture": _mixture,
    "switching": SwitchingPrior,
}

PRIORS: Registry[MakePrior] = Registry(**_CORE)
"""Priors that `fit` knows by name."""


def name_of(prior: Prior) -> str:
    """The name of a prior in tables: that in `PRIORS`, or of its class."""
    return next((name for name, kind in PRIORS.items() if kind is type(prior)), type(prior).__name__)
