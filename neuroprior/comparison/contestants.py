"""The priors and planners of a comparison: their names, and how they are made."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from typing import Any, TypeAlias

import torch

from neuroprior._checks import kind_of
from neuroprior.planners import FrontierPlanner, MCTSPlanner, Planner, SamplingPlanner
from neuroprior.plans import Plans
from neuroprior.priors import CombinedPrior, MarkovPrior, Prior, UniformPrior
from neuroprior.priors.construction import context_arguments
from neuroprior.priors.ensembles.candidates import best_chain, counting_parts
from neuroprior.priors.fitting import PRIORS, MakePrior, make_prior, name_of
from neuroprior.priors.learning import plans_for
from neuroprior.sampling import Steppable
from neuroprior.worlds import World

BASELINE = "uniform"
"""The prior that the others are compared with."""

VALIDATION = 0.2
"""Share of the plans on which the order of a Markov chain is chosen."""

PriorSource: TypeAlias = str | Steppable | MakePrior
"""A name in `neuroprior.priors.fitting.PRIORS`, a prior, or its class or a function that makes it."""

MakePlanner: TypeAlias = Callable[..., Planner]
"""A planner's class, or a function, called with a prior, `length` and `num_plans`."""

PLANNERS: dict[str, MakePlanner] = {"sampling": SamplingPlanner, "frontier": FrontierPlanner, "mcts": MCTSPlanner}
"""Planners by name."""

DETERMINISTIC = ("frontier", "mcts")
"""Those of them that plan in deterministic worlds alone."""


def name_priors(priors: object, world: World) -> dict[str, PriorSource]:
    """The priors by their names, the baseline first.

    Args:
        priors: names, priors, classes or functions in a list, or a mapping of names to these.
        world: where they propose actions.

    Raises:
        ValueError: one is unknown or does not fit the world, or two have the same name.
    """
    named = _by_name("priors", priors, _prior_name)
    baseline = named.get(BASELINE, BASELINE)
    if baseline not in (BASELINE, UniformPrior) and type(baseline) is not UniformPrior:
        raise ValueError(f"`priors` must be named otherwise than {BASELINE}, which all are compared with")
    named = {BASELINE: baseline} | named
    for name, source in named.items():
        _check_prior(name, source, world)
    return named


def name_planners(planners: object) -> dict[str, str | MakePlanner]:
    """The planners by their names; `planners`: names, classes or functions in a list, or a mapping of names to these.

    Raises:
        ValueError: one is unknown, or two have the same name.
    """
    named = _by_name("planners", planners, _planner_name)
    for source in named.values():
        if isinstance(source, str) and source not in PLANNERS:
            raise ValueError(f"`planners` must be among {', '.join(PLANNERS)}, got {source!r}")
        if not callable(source) and not isinstance(source, str):
            raise ValueError(f"`planners` must be names, classes or functions, got {kind_of(source)}")
    return named


def learns(source: PriorSource) -> bool:
    """Whether a prior is fitted anew to the plans of each seed: all but those that have learned already."""
    if isinstance(source, str | type):
        return source not in (BASELINE, UniformPrior)
    if isinstance(source, Prior):
        return not source.has_learned and not isinstance(source, UniformPrior)
    return not isinstance(source, Steppable)


def fit_prior(source: PriorSource, plans: Plans | None, num_actions: int, generator: torch.Generator) -> Steppable:
    """The prior after it learned from plans, if it learns at all.

    Args:
        source: what the prior is, or how it is made.
        plans: to learn from; None: there are none, and a prior that learns stays uniform.
        num_actions: A.
        generator: draws what learning draws.

    Raises:
        ValueError: plans that it cannot learn from.
    """
    if not learns(source):
        return source if isinstance(source, Steppable) and not isinstance(source, type) else UniformPrior(num_actions)
    if plans is None:
        return UniformPrior(num_actions)
    if source == "markov":
        return fit_markov(plans, generator)
    prior = deepcopy(source) if isinstance(source, Prior) else make_prior(plans, _maker(source))
    if not isinstance(prior, Prior):
        raise ValueError(f"a prior's function must return a Prior, got {kind_of(prior)}")
    settings: dict[str, Any] = {"progress": False} if "progress" in prior.fit_settings else {}
    return prior.fit(plans, generator=generator, **settings)


def fit_markov(plans: Plans, generator: torch.Generator) -> MarkovPrior:
    """The Markov chain, of several orders, with a context or without, under which held-out plans are likeliest.

    Raises:
        ValueError: fewer than two plans of a single action.
    """
    learned, held_out = plans.split(VALIDATION, generator)
    parts, num_contexts = counting_parts(learned, held_out), context_arguments(plans).get("num_contexts")
    tried = [best_chain(parts, number) for number in dict.fromkeys((None, num_contexts))]

    def log_likelihood(chain: MarkovPrior) -> float:
        return float(chain.log_prob(plans_for(chain, held_out)).sum())

    return max((chain for chain in tried if chain is not None), key=log_likelihood)


def make_planner(source: str | MakePlanner, prior: Steppable, length: int, budget: int) -> Planner:
    """A planner that takes at most `budget * length` simulator steps for each start."""
    make = PLANNERS[source] if isinstance(source, str) else source
    return make(prior, length=length, num_plans=budget)


def _by_name(argument: str, values: object, name: Callable[[Any], str]) -> dict[str, Any]:
    """The values by name."""
    if isinstance(values, Mapping):
        pairs = [(str(key), value) for key, value in values.items()]
    elif isinstance(values, Iterable) and not isinstance(values, str):
        pairs = [(name(value), value) for value in values]
    else:
        raise ValueError(f"`{argument}` must be a list, or a mapping of names to them, got {values!r}")
    if not pairs:
        raise ValueError(f"`{argument}` must have at least one, got an empty {kind_of(values)}")
    names = [key for key, _ in pairs]
    twice = [key for key in names if names.count(key) > 1]
    if twice:
        raise ValueError(
            f"`{argument}` must have different names, got {twice[0]} twice; use a mapping of names to them"
        )
    return dict(pairs)


def _prior_name(source: object) -> str:
    if isinstance(source, str):
        return source
    if isinstance(source, Prior):
        return name_of(source)
    of_class = [name for name, kind in PRIORS.items() if kind is source]
    return of_class[0] if of_class else _callable_name(source)


def _planner_name(source: object) -> str:
    of_class = [name for name, kind in PLANNERS.items() if kind is source]
    return source if isinstance(source, str) else of_class[0] if of_class else _callable_name(source)


def _callable_name(source: object) -> str:
    inner = source.func if isinstance(source, partial) else source
    return getattr(inner, "__name__", None) or type(inner).__name__


def _check_prior(name: str, source: object, world: World) -> None:
    if isinstance(source, str):
        if PRIORS.find(source) is None:
            raise ValueError(f"`priors` must be among {', '.join(PRIORS)}, got {source!r}")
    elif isinstance(source, Steppable) and not isinstance(source, type):
        if source.num_actions != world.num_actions:
            raise ValueError(
                f"`priors` must have the world's {world.num_actions} actions, got {name} with {source.num_actions}"
            )
        if getattr(source, "end", None) is not None:
            raise ValueError(f"`priors` must have no end symbol, which is no action of a world, got {name} with one")
    elif not callable(source):
        raise ValueError(f"`priors` must be names, priors, classes or functions, got {kind_of(source)}")


def _maker(source: PriorSource) -> MakePrior:
    """The function that makes a prior that is no prior yet; by its name the combined prior with the least effort."""
    if source == "combined":
        return partial(CombinedPrior, effort="fast")
    make = PRIORS.find(source) if isinstance(source, str) else source
    assert callable(make)
    return make


def suited(planners: Sequence[str], sources: Mapping[str, str | MakePlanner], world: World) -> list[str]:
    """Those of the planners that can plan in a world, as far as that is known."""
    return [name for name in planners if not (world.stochastic and sources[name] in DETERMINISTIC)]
