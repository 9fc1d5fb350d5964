"""The priors that `python -m eval compare` fits: Markov chains of some orders, and networks."""

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from eval.compare.context_markov import ContextMarkov
from neuroprior import GRUPrior, MacroPrior, MarkovPrior, Plans, Prior, TabularWorld, TransformerPrior, World

ORDERS = range(5)
"""Of the Markov priors."""


MACROS, MACRO_ORDER = 16, 2
"""Macro-actions, and the order of the chain over actions and these; `VERSION` counts up with a change of them."""


class UnlimitedGRU(GRUPrior):
    """A GRU that goes on with its memory beyond the length that it was trained at.

    It tells longer plans as well as one that reads their last actions in a window, and far quicker.
    """

    def prepare(self, plans: Plans | Tensor, window: int) -> Plans:
        plans = super().prepare(plans, window)
        self.window = None
        return plans


NEURAL: dict[str, Any] = {"gru": UnlimitedGRU, "transformer": TransformerPrior}

RECIPE: dict[str, dict[str, Any]] = {"gru": {"lags": 1, "dropout": 0.2}, "transformer": {"dropout": 0.2}}
"""Of networks. In plans this short GRUs remember without being shown their last inputs again, and are far quicker."""

WIDE: dict[str, dict[str, Any]] = {"gru": {"hidden_size": 128}, "transformer": {"width": 128}}
"""Of networks that see at least `MANY` features."""

MANY = 50
"""Features."""

TRAINING = {"weight_decay": 0.3, "progress": False}
"""Of networks: few plans are learned from, again and again."""


def chain(order: int, world: World, plans: Plans, near: Sequence[tuple[int, ...]]) -> Prior:
    """A Markov prior for plans like these, which sees what they show; features, or sets of them, as one number."""
    sizes = sizes_of(world, plans)
    if sizes:
        return ContextMarkov(plans.num_actions, order, near, **sizes)
    return MarkovPrior(plans.num_actions, order)


def macro(plans: Plans) -> MacroPrior:
    """A chain over actions and macro-actions."""
    return MacroPrior(plans.num_actions, MarkovPrior(plans.num_actions + MACROS, MACRO_ORDER))


def network(kind: str, world: World, plans: Plans, seed: int) -> Prior:
    """A network for plans like these, which sees what they show; one of `NEURAL`."""
    sizes = sizes_of(world, plans)
    wide = WIDE[kind] if sizes.get("context_size", 0) >= MANY else {}
    prior = NEURAL[kind](plans.num_actions, seed=seed, **sizes, **RECIPE[kind], **wide)
    assert isinstance(prior, Prior)
    return prior


def sizes_of(world: World, plans: Plans) -> dict[str, Any]:
    """The arguments that let a prior see the context of `plans`, which is observed in `world`."""
    if plans.context is None:
        return {}
    if plans.context.is_floating_point():
        return {"context_size": plans.context.shape[-1]}
    assert isinstance(world, TabularWorld)
    return {"num_contexts": world.num_states}
