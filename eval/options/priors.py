"""The priors of `python -m eval options`: chains, modes and macro-actions that learned from the same plans."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch

from eval.options.planner import OptionPlanner
from eval.worlds.macros import MacroPrior
from neuroprior import MarkovPrior, Plans, Prior, SamplingPlanner, UniformPrior
from neuroprior.behaviour.analysis.comparison import score
from neuroprior.priors import SwitchingPrior

ORDERS = range(8)
"""Orders of the flat chains."""

SMOOTHINGS = (1, 4, 16, 64, 256, 1024)
"""Pseudo-counts of the chains from which those of equal likelihood are chosen."""

VALIDATION = 0.1
"""Share of the training plans on which the order of the flat chain is chosen."""

EM: dict[str, Any] = {"restarts": 1, "max_iterations": 25, "folds": 3}
"""How the switching priors are fitted: fewer starts than by default, for time."""


class Entrant(NamedTuple):
    """What candidates are drawn from.

    Attributes:
        label: "uniform"; "flat", the chain of the best order; "macro"; and of K modes "switching-K", "constant-K"
            (whose modes switch the same everywhere), "options-K" (as many candidates begin in each mode), "kept-K" (and
            keep it to their end), and "flat-K", the chain whose likelihood is nearest to that of "switching-K".
        prior: the prior.
        bits: per action of held-out plans.
        planner: makes the planner that draws from it.
    """

    label: str
    prior: Prior
    bits: float
    planner: Callable[..., SamplingPlanner] = SamplingPlanner


def entrants(
    training: Plans, held_out: Plans, num_contexts: int | None, modes: Sequence[int], order: int, seed: torch.Generator
) -> list[Entrant]:
    """All priors, fitted to training plans.

    Args:
        training: plans to learn from.
        held_out: plans on which bits are measured, and chains of equal likelihood chosen.
        num_contexts: of contexts of these plans; None for plans without.
        modes: numbers of modes, K.
        order: of the chain of each mode.
        seed: draws the plans that the order of the flat chain is validated on, and what EM starts from.
    """
    actions = training.num_actions

    def bits(prior: Prior, plans: Plans = held_out) -> float:
        return float(score("", prior, plans).bits_per_action().mean)

    def entrant(label: str, prior: Prior) -> Entrant:
        return Entrant(label, prior, bits(prior))

    def switching(number: int, **how: Any) -> SwitchingPrior:
        prior = SwitchingPrior(actions, number, order, num_contexts, **EM | how)
        return prior.fit(training, generator=seed)

    def chain(order: int, plans: Plans, **how: Any) -> MarkovPrior:
        return MarkovPrior(actions, order, num_contexts=num_contexts, **how).fit(plans)

    train_plans, others = training.split(VALIDATION, seed)
    best = min(ORDERS, key=lambda order: bits(chain(order, train_plans), others))
    contestants = [entrant("flat", chain(best, training))]
    weaker = [
        entrant("", chain(order, training, backoff="dirichlet", smoothing=s)) for order in ORDERS for s in SMOOTHINGS
    ]
    for number in modes:
        one = entrant(f"switching-{number}", switching(number))
        near = min([*weaker, contestants[0]], key=lambda other: abs(other.bits - one.bits))
        contestants += [one, near._replace(label=f"flat-{number}")]
        contestants.append(one._replace(label=f"options-{number}", planner=OptionPlanner))
        contestants.append(one._replace(label=f"kept-{number}", planner=_mode_keeper))
        if num_contexts is not None:
            contestants.append(entrant(f"constant-{number}", switching(number, switching="constant")))
    if num_contexts is None:
        macro = entrant("macro", MacroPrior(actions).fit(training))
        contestants = [entrant("uniform", UniformPrior(actions)), *contestants, macro]
    return contestants


def _mode_keeper(*arguments: Any, **how: Any) -> OptionPlanner:
    return OptionPlanner(*arguments, terminations=False, **how)


def pairs(modes: Sequence[int]) -> list[tuple[str, str]]:
    """The labels of what is compared: the first minus the second."""
    of_equal_number = [("switching", "flat"), ("options", "switching"), ("kept", "options"), ("switching", "constant")]
    against = [("switching", "flat"), ("switching", "macro"), ("kept", "flat"), ("kept", "macro")]
    labels = [(f"{first}-{number}", f"{second}-{number}") for first, second in of_equal_number for number in modes]
    return labels + [(f"{first}-{number}", second) for first, second in against for number in modes]
