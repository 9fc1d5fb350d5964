"""Exact inference over hidden modes: filtering, smoothing and the most probable path, batched over sequences.

Rabiner, *A tutorial on hidden Markov models*, Proceedings of the IEEE 77 (1989), section III. The passes run on the
CPU, whatever device the tensors are on: each step depends on the one before.

Throughout, of N sequences of L steps with K modes, `initial [K]` is the distribution of the first mode;
`steps [N, L, K, K]` leads from the mode before each action (row) to the mode of the action (column), the first of them
the identity; and `likelihood [N, L, K]` is that of each action in each mode, not 0 in all of them. Beyond the end of a
sequence likelihoods are 1 and steps the identity.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

TINY = 1e-300
"""The least likelihood that is divided by."""


class Smoothed(NamedTuple):
    """What N sequences of L steps say about K modes.

    Attributes:
        log_likelihood: `[N, L]`: of each action given those before it; nats.
        filtered: `[N, L, K]`: the modes given the actions so far, the present one among them.
        smoothed: `[N, L, K]`: the modes given the whole sequence.
        moved: `[N, L - 1, K, K]`: the modes of each action (row) and of the next (column), given the whole sequence.
    """

    log_likelihood: Tensor
    filtered: Tensor
    smoothed: Tensor
    moved: Tensor


def predict(initial: Tensor, steps: Tensor, likelihood: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Infers the modes before and after each action; see the module for the arguments.

    Returns:
        `[N, L, K]`: the modes given the actions before each; `[N, L, K]`: given this action, too; and `[N, L]`: the
        log-likelihood of each action given those before it, nats.
    """
    from neuroprior.priors.switching.compiled_smoothing import filter_modes

    inputs = [values.detach().double().cpu().contiguous() for values in (initial, steps, likelihood)]
    predicted, filtered = torch.empty_like(inputs[2]), torch.empty_like(inputs[2])
    totals = inputs[2].new_empty(inputs[2].shape[:2])
    run: Any = filter_modes
    run(*_arrays(*inputs), TINY, *_arrays(predicted, filtered, totals))
    return predicted.to(likelihood), filtered.to(likelihood), totals.log().to(likelihood)


def smooth(initial: Tensor, steps: Tensor, likelihood: Tensor) -> Smoothed:
    """Infers the modes given whole sequences; see the module for the arguments."""
    from neuroprior.priors.switching.compiled_smoothing import smooth_modes

    _, filtered, log_likelihood = predict(initial, steps, likelihood)
    num, length, modes = likelihood.shape
    inputs = [values.detach().double().cpu().contiguous() for values in (steps, likelihood, filtered)]
    smoothed, moved = torch.empty_like(inputs[2]), inputs[2].new_empty(num, max(length - 1, 0), modes, modes)
    run: Any = smooth_modes
    run(*_arrays(*inputs[:2]), TINY, *_arrays(inputs[2], smoothed, moved))
    return Smoothed(log_likelihood, filtered, smoothed.to(likelihood), moved.to(likelihood))


def most_probable_path(initial: Tensor, steps: Tensor, likelihood: Tensor) -> Tensor:
    """The most probable modes `[N, L]`, int64, given whole sequences (Viterbi); see the module for the arguments."""
    num, length, _ = likelihood.shape
    path = torch.zeros(num, length, dtype=torch.long, device=likelihood.device)
    if length == 0:
        return path
    best, origins = initial.log() + likelihood[:, 0].log(), []
    for t in range(1, length):
        best, origin = (best[:, :, None] + steps[:, t].log()).max(1)
        best = best + likelihood[:, t].log()
        origins.append(origin)
    path[:, -1] = best.argmax(-1)
    for t in range(length - 2, -1, -1):
        path[:, t] = origins[t].gather(1, path[:, t + 1, None])[:, 0]
    return path


def _arrays(*values: Tensor) -> tuple[Any, ...]:
    return tuple(value.numpy() for value in values)
