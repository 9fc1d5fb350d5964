"""The experts of a combined prior: which are tried on plans of a kind, and what is spent on them."""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from copy import deepcopy
from math import inf
from time import monotonic
from typing import Any, Literal, NamedTuple

import torch

from neuroprior._jobs import saying
from neuroprior._random import draw_seed
from neuroprior.plans.folds import FOLDS, divisible, folds, in_parts, num_units, pieces, ungrouped
from neuroprior.plans.plans import Plans
from neuroprior.priors.adaptive import AdaptivePrior
from neuroprior.priors.construction import construct
from neuroprior.priors.counts import BACKOFFS_TRIED, Chains, ContextTreePrior, MarkovPrior, TooLargeError
from neuroprior.priors.ensembles.pooling import stack_forecasts
from neuroprior.priors.ensembles.screening import Screening, screen
from neuroprior.priors.ensembles.stacked import StackedPrior
from neuroprior.priors.learning import plans_for
from neuroprior.priors.neural import GRUPrior, TransformerPrior
from neuroprior.priors.prior import Prior
from neuroprior.priors.uniform import UniformPrior

Effort = Literal["fast", "standard", "full"]
"""What is spent: "fast" trains a GRU beside what counts where it promises to bring something, "standard" a stacked
prior as well, "full" these and a transformer in any case."""

NETWORKS: dict[str, Callable[..., Prior]] = {"gru": GRUPrior, "stacked": StackedPrior, "transformer": TransformerPrior}
"""The experts that are trained, in this order."""

OF_EFFORT: dict[Effort, tuple[str, ...]] = {
    "fast": ("gru",),
    "standard": ("gru", "stacked"),
    "full": ("gru", "stacked", "transformer"),
}

ORDERS = range(7)
"""Orders of the Markov chains that are tried: the best is an expert, and all are baselines in comparisons."""

ENOUGH, MOST = 1000, 20_000
"""Where fewer than `ENOUGH` actions are held out, what counts is chosen on the others as well, in `FOLDS` parts, if
these are at most `MOST`.
"""

LEAST_REST = 0.4
"""The share of all actions that is left to count in, at least, where a part is held out."""

PIECES = 10
"""Where some plans are too long for that, plans are cut into pieces of at most the actions divided by this."""

LONG = 100
"""Mean number of actions of plans from which on priors that follow the individual are tried."""

LEVELS = (10.0, 10.0, 10.0)
"""They count after histories of none, one and two actions; `fit` sets these concentrations."""

DEPTH = 10
"""Depth of the context trees among experts and baselines."""


def check_effort(effort: object) -> None:
    """Raise ValueError for what is no `Effort`."""
    if effort not in list(OF_EFFORT):
        raise ValueError(f"`effort` must be one of {', '.join(OF_EFFORT)}, got {effort!r}")


class Experts(NamedTuple):
    """Experts that are fitted.

    Attributes:
        counting: those that count.
        networks: those that are trained, by name.
        left_out: by name, what the network promised that was not trained for it; those behind it were not tried.
    """

    counting: list[Prior]
    networks: dict[str, Prior]
    left_out: dict[str, Screening]

    @property
    def fitted(self) -> list[Prior]:
        """All of them, networks last."""
        return [*self.counting, *self.networks.values()]


def fitted_experts(
    learned: Plans,
    held_out: Plans,
    contexts: dict[str, int],
    effort: Effort,
    generator: torch.Generator,
    settings: Mapping[str, Any],
    names: Sequence[str] | None = None,
) -> Experts:
    """Fit experts of every kind, one after the other.

    Args:
        learned: plans to learn from.
        held_out: plans on which orders of chains are chosen (see `counting_parts`), and networks are stopped.
        contexts: `num_contexts` or `context_size`, as experts take it that can, or none.
        effort: which networks there are.
        generator: draws their initial weights and the order of training.
        settings: of their training. Networks share the `seconds` that are left when all has been counted, if these are
            limited; those for which nothing is left are not trained. A quarter of the share of each is for screening.
        names: of the networks that are trained; None: those that promise to bring something beyond the experts that
            count, see `screen`, up to the first that does not; with the full effort all.
    """
    seconds = settings.get("seconds")
    until = inf if seconds is None else monotonic() + seconds
    shown = settings.get("progress", True)
    with saying("counting chains and trees") if shown else nullcontext():
        experts = Experts([*counted(learned, held_out, contexts)], {}, {})
    names = OF_EFFORT[effort] if names is None and effort == "full" else names
    untrained = networks(learned.num_actions, contexts, effort, draw_seed(generator) % 2**31)
    untrained = {name: prior for name, prior in untrained.items() if names is None or name in names}
    forecasts = stack_forecasts(experts.counting, held_out) if names is None else torch.empty(0)
    for others, (name, prior) in zip(range(len(untrained), 0, -1), untrained.items(), strict=True):
        how = {"validation": held_out, **settings}
        if names is None and until > monotonic():
            promise = screen(prior, forecasts, learned, held_out, _limit_seconds(how, until, 8 * others))
            if promise is not None and not promise.pays:
                experts.left_out[name] = promise
                if shown:
                    of_needed = f"{promise.gain:.4f} of {promise.needed:.4f} nats per action"
                    print(f"{name}: not trained, as it promises {of_needed}", file=sys.stderr, flush=True)
                break  # what a network that sees the whole past cannot find, those behind it cannot either
        if until <= monotonic():
            break
        prior.fit(plans_for(prior, learned), generator=generator, **_limit_seconds(how, until, others))
        experts.networks[name] = prior
    return experts


def _limit_seconds(settings: dict[str, Any], until: float, parts: int) -> dict[str, Any]:
    """The settings of a training that takes one of so many parts of the seconds that are left, if these are limited."""
    return settings if until == inf else {**settings, "seconds": max(until - monotonic(), 0.0) / parts}


def number_tried(experts: Iterable[Prior]) -> int:
    """How many experts there were to choose from: each chain is the best of many."""
    return sum(len(ORDERS) * len(BACKOFFS_TRIED) if isinstance(e, MarkovPrior) else 1 for e in experts)


def networks(num_actions: int, contexts: dict[str, int], effort: Effort, seed: int) -> dict[str, Prior]:
    """The networks of an effort by name, not trained yet, with the context where they can take it."""
    names = enumerate(OF_EFFORT[effort])
    return {name: construct(NETWORKS[name], num_actions, contexts | {"seed": seed + place}) for place, name in names}


def counted(learned: Plans, held_out: Plans, contexts: dict[str, int]) -> Iterator[Prior]:
    """The experts that count, fitted to `learned`: a uniform prior, and a chain and a context tree of each context.

    Where plans are long, a chain and a tree without context that follow the individual, too.

    Args:
        learned: plans to count in.
        held_out: plans on which the orders and back-offs of chains are chosen.
        contexts: `num_contexts`, for priors that take an index and as many that do not; features cannot be counted.
    """
    num_contexts, parts = contexts.get("num_contexts"), counting_parts(learned, held_out)
    yield UniformPrior(learned.num_actions).fit(learned.without_context())
    simple: list[Prior] = []
    for number in [None] if num_contexts is None else [None, num_contexts]:
        chain = best_chain(parts, number)
        if chain is not None:
            simple.append(chain)
        try:
            tree = ContextTreePrior(learned.num_actions, DEPTH, num_contexts=number)
            simple.append(tree.fit(plans_for(tree, learned)))
        except TooLargeError:
            continue
    yield from simple
    if int(learned.mask().sum()) >= LONG * len(learned):
        for base in simple:
            if not base.takes_context:
                yield AdaptivePrior(deepcopy(base), LEVELS).fit(learned.without_context())


def counting_parts(learned: Plans, held_out: Plans) -> list[tuple[Plans, Plans]]:
    """Plans to count in and plans to forecast from that: these two, and if the second are few, parts of the first.

    A chain is chosen of many, and a few plans say little of which is best. Groups stay together where they are so equal
    that enough is left to count in; where plans are not either, they are cut into pieces.
    """
    pairs, total = [(learned, held_out)], int(learned.mask().sum())
    if int(held_out.mask().sum()) >= ENOUGH or not 1 < total <= MOST:
        return pairs
    plans = divisible(learned[learned.mask().any(1)])
    if len(plans) == 1:
        plans = in_parts(plans, min(FOLDS, total))
    for units in (plans, ungrouped(plans), pieces(plans, -(-total // PIECES))):
        divisions = folds(units, min(FOLDS, num_units(units)))
        parts = [(units[rest], units[left_out]) for rest, left_out in divisions]
        if min(int(rest.mask().sum()) for rest, _ in parts) >= LEAST_REST * total:
            return pairs + parts
    return pairs


@torch.no_grad()
def best_chain(parts: Sequence[tuple[Plans, Plans]], num_contexts: int | None) -> MarkovPrior | None:
    """The Markov chain, of `ORDERS` and all back-offs, under which held-out plans are likeliest; None: all too large.

    Args:
        parts: plans to count in and those to choose on, each pair of them; the chain returned has counted in the first.
        num_contexts: of the chain's context, or None.
    """
    best: tuple[float, MarkovPrior | None] = (inf, None)
    try:
        for order in ORDERS:
            loss = torch.zeros(len(BACKOFFS_TRIED), dtype=torch.double)
            for learned, held_out in reversed(parts):  # the first pair last: one of its chains is kept
                chains = Chains(learned, order, num_contexts)
                loss -= chains.log_likelihood(held_out)
            if loss.min() < best[0]:
                best = (float(loss.min()), chains.chain(int(loss.argmin())))
    except TooLargeError:
        pass  # those of higher order are larger still
    return best[1]
