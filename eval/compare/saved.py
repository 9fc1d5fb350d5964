"""Saved priors for a world: the actions that a prior has learned are told by their names from those of the world."""

from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor

from neuroprior import Plans, Prior, load
from neuroprior.report.scores import numbers


class Renumbered(Prior):
    """A prior whose actions have other numbers.

    Args:
        prior: any prior.
        number: `[A]`, int64: under which number it knows action 0, 1, ...; a permutation.
    """

    def __init__(self, prior: Prior, number: Tensor) -> None:
        super().__init__(prior.num_actions, prior.num_contexts, prior.context_size)
        self.prior, self.context_per, self.context_names = prior, prior.context_per, prior.context_names
        self.register_buffer("number", number)
        if prior.action_names is not None:
            self.action_names = tuple(prior.action_names[known] for known in number.tolist())

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        logits, state = self.prior.start(batch_size, context)
        return logits[:, self._number], state

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        logits, state = self.prior.step(self._number[action], state, context)
        return logits[:, self._number], state

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        logits = self.prior(self._number[plans.long()], context)
        assert isinstance(logits, Tensor)
        return logits[..., self._number]

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Not possible: a saved prior is taken as it is.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("a renumbered prior is not trained")

    @property
    def _number(self) -> Tensor:
        assert isinstance(self.number, Tensor)
        return self.number


def load_for(folder: str, world: str, num_actions: int, action_names: Sequence[str] | None) -> Prior:
    """The prior saved in a folder, with its actions numbered as in a world: by name where both have names.

    Args:
        folder: as `neuroprior.save` and `python -m train` write it.
        world: its name, for messages.
        num_actions: of the world.
        action_names: of the world; None: its actions are taken by number.

    Raises:
        ValueError: the prior knows other actions than the world has, or samples an end symbol; or a file is damaged.
        OSError: the folder, or a file in it, is not there.
    """
    prior = load(folder)
    if prior.end is not None:
        raise ValueError(f"{folder}: samples an end symbol, which is no action of a world; train without --data.end")
    if prior.num_actions != num_actions:
        raise ValueError(f"{folder}: knows {prior.num_actions} actions, the world {world} has {num_actions}")
    if action_names is None or prior.action_names is None:
        return prior
    of_world = f" of the world {world}; it knows"
    number = numbers(prior.action_names, action_names, f"{folder}: does not know the action", of_world)
    return prior if bool((number == torch.arange(num_actions)).all()) else Renumbered(prior, number)
