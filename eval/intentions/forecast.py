"""Where observed agents will be, from samples of the prior of each of several intentions."""

from collections.abc import Sequence

import torch
from torch import Tensor

from neuroprior import Prior, World
from neuroprior.sampling import sample_in_world


@torch.no_grad()
def forecast(
    priors: Sequence[Prior],
    world: World,
    state: Tensor,
    probs: Tensor,
    length: int,
    num_plans: int,
    targets: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Estimates how probably agents will be in each of several states, `[B, S]`.

    The priors begin anew in `state`: one whose predictions depend on actions before it does not know these. The
    intention stays what it is.

    Args:
        priors: one fitted prior for each of K intentions.
        world: in which the agents act; its states are numbers.
        state: `[B]`: where they are.
        probs: `[B, K]`, float64: how probable each intention is.
        length: number of steps ahead.
        num_plans: samples for each agent and intention, P; a share of them has a standard error of at most
            1 / (2 sqrt(P)).
        targets: states `[S]`.
        generator: draws actions and the world's steps.
    """
    shares = []
    for prior in priors:
        _, rollout = sample_in_world(prior, world, state, num_plans, length, generator=generator)
        hits = rollout.final_state[:, :, None] == targets
        shares.append(hits.double().mean(1))
    return (torch.stack(shares, -1) * probs[:, None]).sum(-1)
