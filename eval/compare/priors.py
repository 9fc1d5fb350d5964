"""The priors of `python -m eval compare`: Markov chains with and without context, networks, and saved priors."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from eval.worlds.contexts import ContextIndex
from neuroprior import CombinedPrior, GRUPrior, MarkovPrior, Plans, Prior, TabularWorld, TransformerPrior, World, load
from neuroprior.behaviour.analysis.comparison import score
from neuroprior.priors.learning import plans_for, training_plans
from neuroprior.priors.matching import numbers
from neuroprior.priors.serialization import MODEL, digest

ORDERS = range(5)
"""Orders of the Markov chains."""

COMBINED = "combined"
"""The label of the combined prior."""


NEURAL: dict[str, Callable[..., Prior]] = {"gru": GRUPrior, "transformer": TransformerPrior}

RECIPE: dict[str, dict[str, Any]] = {"gru": {"lags": 1, "dropout": 0.2}, "transformer": {"dropout": 0.2}}
"""Arguments of networks. In plans this short a GRU does not need its last inputs shown again, and is far quicker."""

WIDE: dict[str, dict[str, Any]] = {"gru": {"hidden_size": 128}, "transformer": {"width": 128}}
"""Further arguments of networks whose context has at least `MANY` features."""

MANY = 50
"""Features."""

TRAINING = {"weight_decay": 0.3, "progress": False}
"""Settings of the training of networks: there are few plans, which are learned from again and again."""

VALIDATION = 0.2
"""Share of the plans on which `ContextMarkov` chooses its features."""


def chain(order: int, world: World, plans: Plans, feature_sets: Sequence[tuple[int, ...]]) -> Prior:
    """A Markov prior for plans like these, with their context if they have one."""
    sizes = context_sizes(world, plans)
    if sizes:
        return ContextMarkov(plans.num_actions, order, feature_sets, **sizes)
    return MarkovPrior(plans.num_actions, order)


def network(kind: str, world: World, plans: Plans, seed: int) -> Prior:
    """A network, one of `NEURAL`, for plans like these, with their context if they have one."""
    sizes = context_sizes(world, plans)
    wide = WIDE[kind] if sizes.get("context_size", 0) >= MANY else {}
    return NEURAL[kind](plans.num_actions, seed=seed, **sizes, **RECIPE[kind], **wide)


def combined(world: World, plans: Plans, feature_sets: Sequence[tuple[int, ...]], seed: int) -> CombinedPrior:
    """The combined prior of what it is compared with: chains of all orders, with the context and without, and a GRU."""
    sizes = context_sizes(world, plans)
    chains = [chain(order, world, plans, feature_sets) for order in ORDERS]
    chains += [MarkovPrior(plans.num_actions, order) for order in ORDERS if sizes]
    return CombinedPrior(plans.num_actions, [*chains, network("gru", world, plans, seed)], **sizes)


def context_sizes(world: World, plans: Plans) -> dict[str, Any]:
    """The arguments that let a prior take the context of `plans`, which was observed in `world`."""
    if plans.context is None:
        return {}
    if plans.context.is_floating_point():
        return {"context_size": plans.context.shape[-1]}
    assert isinstance(world, TabularWorld)
    return {"num_contexts": world.num_states}


class ContextMarkov(Prior):
    """A Markov prior for contexts with many values: each context of the training plans is counted apart.

    Of contexts with many features, most in held-out plans are new. So `fit` tries all features and each of
    `feature_sets`, and takes those with which the prior predicts validation plans best. In a context that is new, the
    prior predicts as a chain of the same order without context.

    Args:
        num_actions, order: see `MarkovPrior`.
        feature_sets: sets of features.
        num_contexts, context_size: see `Prior`.
    """

    def __init__(
        self, num_actions: int, order: int, feature_sets: Sequence[tuple[int, ...]] = (), **sizes: int
    ) -> None:
        super().__init__(num_actions, **sizes)
        self.order, self.feature_sets = order, tuple(feature_sets)
        self.chain, self.fallback = MarkovPrior(num_actions, order, num_contexts=1), MarkovPrior(num_actions, order)
        self.index = ContextIndex(torch.zeros(1, dtype=torch.long))

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Choose the features, number the contexts, and count; returns self."""
        plans = training_plans(self, plans)
        best: Sequence[int] | None = None
        if self.feature_sets:
            training, validation = plans.split(VALIDATION, torch.Generator().manual_seed(0))
            bits = {
                features: score("", self._count(training, features, settings), validation).bits_per_action().mean
                for features in (None, *self.feature_sets)
            }
            best = min(bits, key=lambda features: bits[features])
        return self._count(plans, best, settings)

    def _count(self, plans: Plans, features: Sequence[int] | None, settings: dict[str, Any]) -> Self:
        self.fallback.fit(plans_for(self.fallback, plans), **settings)
        context = plans.context
        assert context is not None
        flat = context.flatten(0, -2) if context.is_floating_point() else context.flatten()
        self.index = ContextIndex(flat, features)
        self.chain = MarkovPrior(self.num_actions, self.order, num_contexts=self.index.size)
        self.chain.fit(replace(plans, context=self.index(context), context_names=None), **settings)
        return self

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if context is None:
            raise ValueError("context: this prior takes a context, and none was given")
        return self._combine(self.chain.start(batch_size, self.index(context)), self.fallback.start(batch_size))

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        number = None if context is None else self.index(context)
        return self._combine(self.chain.step(action, state[:, 0], number), self.fallback.step(action, state[:, 1]))

    def _combine(self, chain: tuple[Tensor, Tensor], fallback: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """The logits of the chain where its last context is known, else of the fallback; and the states of both."""
        in_index = chain[1] % self.index.size < self.index.size - 1
        return torch.where(in_index[:, None], chain[0], fallback[0]), torch.stack([chain[1], fallback[1]], -1)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        if context is None:
            raise ValueError("context: this prior takes a context, and none was given")
        number = self.index(context)
        in_index = number < self.index.size - 1
        return torch.where(in_index[..., None], self.chain(plans, number), self.fallback(plans))


class Renumbered(Prior):
    """A saved prior whose actions have other numbers in a world: `number [A]`, of the world's action 0, 1, ..."""

    number: Tensor

    def __init__(self, prior: Prior, number: Tensor) -> None:
        super().__init__(prior.num_actions, prior.num_contexts, prior.context_size)
        self.prior, self.context_per, self.context_names = prior, prior.context_per, prior.context_names
        self.register_buffer("number", number)
        if prior.action_names is not None:
            self.action_names = tuple(prior.action_names[action] for action in number.tolist())

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        logits, state = self.prior.start(batch_size, context)
        return logits[:, self.number], state

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        logits, state = self.prior.step(self.number[action], state, context)
        return logits[:, self.number], state

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        return self.prior.forward(self.number[plans.long()], context)[..., self.number]

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Not possible: a saved prior is compared as it is."""
        raise NotImplementedError("a renumbered prior is not trained")


def load_for(folder: str, world: str, num_actions: int, action_names: Sequence[str] | None) -> Prior:
    """The prior saved in a folder, with its actions numbered as in a world: by name if both have names.

    Raises:
        ValueError: there is no such folder; the prior has other actions than the world, or samples an end symbol; or a
            file is damaged.
        OSError: a file in the folder is not there.
    """
    if not Path(folder).is_dir():
        raise ValueError(
            f"`priors` must be folders of saved priors, got {folder!r}; kinds that are fitted, such as markov, are"
            " named by --kinds"
        )
    prior = load(folder)
    if prior.end is not None:
        raise ValueError(f"{folder}: samples an end symbol, which is no action of a world; train without --end")
    if prior.num_actions != num_actions:
        raise ValueError(
            f"{folder}: {num_actions} actions, those of the world {world}, are expected, not {prior.num_actions}"
        )
    if action_names is None or prior.action_names is None:
        return prior
    of_world = f" of the world {world}; it knows"
    number = numbers(prior.action_names, action_names, f"{folder}: does not know the action", of_world)
    return prior if bool((number == torch.arange(num_actions)).all()) else Renumbered(prior, number)


def digests(folders: Sequence[str]) -> dict[str, str]:
    """A digest of each saved prior: results of another model in the same folder do not count."""
    return {folder: digest((Path(folder) / MODEL).read_bytes()) for folder in folders}
