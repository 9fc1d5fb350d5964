"""Priors made from a class, a function or a description, with the arguments that plans ask for."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from neuroprior.plans import Plans, has_patterns
from neuroprior.priors.prior import Prior
from neuroprior.priors.saved import SavedModule


def as_prior(prior: Prior | Mapping[str, Any]) -> Prior:
    """A prior that is given, or described as in the `config` of a prior made of priors: `prior` (its class), `config`.

    Raises:
        KeyError: the description lacks a key.
        ValueError: it describes no prior that is known.
    """
    if isinstance(prior, Prior):
        return prior
    if not isinstance(prior, Mapping):
        raise ValueError(f"`prior` must be a prior or its description, got {prior!r}")
    prior_class = SavedModule.known.find(prior["prior"])
    if prior_class is None or not issubclass(prior_class, Prior):
        raise ValueError(f"{prior['prior']}: not a prior over numbered actions")
    return prior_class(**prior["config"])


def described(prior: Prior) -> dict[str, Any]:
    """A prior as `as_prior` makes it again, without what it learned: `prior`, the name of its class, and `config`."""
    return {"prior": type(prior).__name__, "config": prior.config}


def construct(make: Callable[..., Prior], num_actions: int, contexts: Mapping[str, int]) -> Prior:
    """A prior from its class, or a function that makes it.

    Args:
        make: called with the number of actions, and those of `contexts` that it takes; of a `functools.partial`, what
            it was given itself stands: there may be more contexts than occur in some plans.
        num_actions: A.
        contexts: `num_contexts`, `context_size` or `num_patterns`, or none.
    """
    parameters = inspect.signature(make).parameters
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    fixed = {name for name, value in getattr(make, "keywords", {}).items() if value is not None}
    wanted = {name: c for name, c in contexts.items() if (takes_any or name in parameters) and name not in fixed}
    return make(num_actions, **wanted)


def context_arguments(*subsets: Plans) -> dict[str, int]:
    """The constructor's arguments for the context of plans: `num_contexts`, `context_size`, `num_patterns` or none.

    The number of contexts is that of their names, if these are more than occur.
    """
    contexts = [plans.context for plans in subsets if plans.context is not None]
    if not contexts:
        return {}
    if contexts[0].is_floating_point():
        return {"context_size": contexts[0].shape[-1]}
    if has_patterns(contexts[0]):
        return {"num_patterns": contexts[0].shape[-1]}
    most = max((int(context.max()) + 1 for context in contexts if context.numel()), default=1)
    return {"num_contexts": max(most, *(len(plans.context_names or ()) for plans in subsets))}
