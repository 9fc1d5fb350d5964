"""The switching network: hidden modes whose actions and transitions a recurrent network gives, trained by gradient."""

from typing import Any

import torch
from torch import Tensor, nn

from neuroprior._checks import check_memory, check_sizes
from neuroprior.priors.neural.gru import GRUPrior

STAY = 3.0
"""Logit of staying in a mode before training; the other transitions have 0."""


class SwitchingNetwork(GRUPrior):
    """K hidden modes; what each does, and how modes switch, depends on the hidden state of a gated recurrent network.

    Input-output hidden Markov model (Bengio and Frasconi 1995): from the hidden state before each action, one linear
    layer gives K distributions over actions and the transitions into the mode of the action. Trained like every
    network here, on the likelihood of the actions: the modes are summed over exactly, by filtering, and gradients pass
    through the filter.

    Args:
        num_actions: A.
        num_modes: K.
        hidden_size, window, lags, dropout, num_contexts, context_size, seed: see `GRUPrior`.
        num_layers: number of layers.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = SwitchingNetwork(2, num_modes=2, hidden_size=4)  # prior.fit(plans) trains it
        >>> prior.sample(2, 5).shape
        torch.Size([2, 5])
    """

    def __init__(
        self,
        num_actions: int,
        num_modes: int = 2,
        hidden_size: int | None = None,
        num_layers: int = 1,
        window: int | None = None,
        lags: int | None = None,
        dropout: float | None = None,
        num_contexts: int | None = None,
        context_size: int | None = None,
        seed: int = 0,
    ) -> None:
        check_sizes(num_modes=num_modes)
        check_memory(4 * (hidden_size or 256) * num_modes * (num_modes + num_actions), num_modes=num_modes)
        self.num_modes = num_modes
        super().__init__(num_actions, hidden_size, num_layers, window, lags, dropout, num_contexts, context_size, seed)

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"num_modes": self.num_modes}

    def build(self) -> None:
        super().build()
        modes = self.num_modes
        self.head = nn.Linear(self.hidden_size, modes * (self.num_actions + modes) + modes)
        with torch.no_grad():
            bias = self.head.bias[modes * self.num_actions : -modes].view(modes, modes)
            bias.zero_().fill_diagonal_(STAY)

    def encode(self, inputs: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
        modes, actions = self.num_modes, self.num_actions
        own = None if hidden is None else hidden[:, -modes * (actions + 1) :]
        network = None if hidden is None else hidden[:, : -modes * (actions + 1)]
        out, network = super().encode(inputs, network)
        emitted = out[..., : modes * actions].unflatten(-1, (modes, actions)).log_softmax(-1)
        moved = out[..., modes * actions : -modes].unflatten(-1, (modes, modes)).log_softmax(-1)
        first = out[..., -modes:].log_softmax(-1)
        action = inputs[..., 0].long()
        if own is not None:
            before, last = own[:, :modes], own[:, modes:].unflatten(-1, (modes, actions))
        else:
            before, last = first[:, 0], emitted[:, 0]
        taken = action.clamp(max=actions - 1)[:, :, None, None].expand(-1, -1, modes, 1)
        forecasts = []
        for t in range(inputs.shape[1]):
            # the mode after the action before, and then that of this one; at a plan's beginning the first
            known = before + last.gather(2, taken[:, t])[..., 0]
            after = (known[:, :, None] + moved[:, t]).logsumexp(1)
            before = torch.where((action[:, t] == actions)[:, None], first[:, t], after.log_softmax(-1))
            last = emitted[:, t]
            forecasts.append((before[..., None] + last).logsumexp(1))
        return torch.stack(forecasts, 1), torch.cat([network, before, last.flatten(1)], 1)
