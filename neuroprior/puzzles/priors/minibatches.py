"""Training by minibatches of flat steps, stopped by steps that are held out."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from neuroprior._random import generator_on

PATIENCE = 2
"""Training stops after so many epochs without a lower held-out loss."""


@torch.enable_grad()
def train(
    parameters: Sequence[Tensor],
    optimisers: Sequence[torch.optim.Optimizer],
    loss_at: Callable[[Tensor], Tensor],
    held_out_loss: Callable[[], float] | None,
    num_steps: int,
    *,
    epochs: int,
    batch_size: int,
    generator: torch.Generator | None,
) -> None:
    """Minimise a loss; the parameters are left as they were where the loss on what is held out was least.

    Args:
        parameters: what the optimisers change.
        optimisers: step after each batch.
        loss_at: the loss, a scalar with a gradient, of the steps at `index [m]`.
        held_out_loss: computed before the first and after each epoch; None: training goes through all epochs.
        num_steps: M.
        epochs: at most so many times through all steps.
        batch_size: steps of a batch.
        generator: draws the order of the steps.
    """
    generator = generator_on(generator, "cpu")
    least = torch.inf if held_out_loss is None else held_out_loss()
    best, waited = [value.detach().clone() for value in parameters], 0
    for _ in range(epochs):
        for index in torch.randperm(num_steps, generator=generator).split(batch_size):
            for optimiser in optimisers:
                optimiser.zero_grad()
            loss_at(index).backward()
            for optimiser in optimisers:
                optimiser.step()
        now = -torch.inf if held_out_loss is None else held_out_loss()
        waited = 0 if now < least else waited + 1
        if held_out_loss is None or now < least:
            least, best = now, [value.detach().clone() for value in parameters]
        if held_out_loss is not None and waited >= PATIENCE:
            break
    with torch.no_grad():
        for value, kept in zip(parameters, best, strict=True):
            value.copy_(kept)
