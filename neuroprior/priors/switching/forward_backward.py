"""Exact inference over hidden modes: filtering, smoothing and the most probable path, batched over sequences.

Rabiner, *A tutorial on hidden Markov models*, Proceedings of the IEEE 77 (1989), section III. Long sequences are cut
into chunks that are walked through side by side: the product of a chunk's matrices says what the chunk does to any
distribution over modes.

Throughout, of N sequences of L steps with K modes, `initial [K]` is the distribution of the first mode;
`steps [N, L, K, K]` leads from the mode before each action (row) to the mode of the action (column), the first of them
the identity; and `likelihood [N, L, K]` is that of each action in each mode, not 0 in all of them. Beyond the end of a
sequence likelihoods are 1.
"""

from typing import NamedTuple

import torch
from torch import Tensor

ROWS = 1024
"""Sequences are cut until about so many chunks are walked through side by side."""

TINY = 1e-300


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
    """The modes before and after each action; see the module for the arguments.

    Returns:
        `[N, L, K]`: the modes given the actions before each; `[N, L, K]`: given this action, too; and `[N, L]`: the
        log-likelihood of each action given those before it, nats.
    """
    num, length, modes = likelihood.shape
    before, chunks = initial.expand(num, modes), _number_of_chunks(num, length)
    if chunks > 1:
        steps, likelihood = _cut(steps, likelihood, chunks)
        products, starts = _products(steps, likelihood).unflatten(0, (num, chunks)), [before]
        for chunk in range(chunks - 1):
            starts.append(_normalised((starts[-1][:, :, None] * products[:, chunk]).sum(1)))
        before = torch.stack(starts, 1).flatten(0, 1)
    predicted, after = torch.empty_like(likelihood), torch.empty_like(likelihood)
    totals = torch.empty_like(likelihood[..., 0])
    for t in range(likelihood.shape[1]):
        predicted[:, t] = (before[:, :, None] * steps[:, t]).sum(1)
        joint = predicted[:, t] * likelihood[:, t]
        totals[:, t] = joint.sum(-1).clamp(min=TINY)
        before = joint / totals[:, t, None]
        after[:, t] = before
    parts = predicted, after, totals.log()
    predicted, after, log_likelihood = (part.reshape(num, -1, *part.shape[2:])[:, :length] for part in parts)
    return predicted, after, log_likelihood


def smooth(initial: Tensor, steps: Tensor, likelihood: Tensor) -> Smoothed:
    """The modes given whole sequences; see the module for the arguments."""
    num, length, modes = likelihood.shape
    _, after, log_likelihood = predict(initial, steps, likelihood)
    cut_steps, cut, chunks = steps, likelihood, _number_of_chunks(num, length)
    behind = likelihood.new_ones(num, modes)
    if chunks > 1:
        cut_steps, cut = _cut(steps, likelihood, chunks)
        products, ends = _products(cut_steps, cut).unflatten(0, (num, chunks)), [behind]
        for chunk in range(chunks - 1, 0, -1):
            ends.append(_normalised((products[:, chunk] * ends[-1][:, None]).sum(-1)))
        behind = torch.stack(ends[::-1], 1).flatten(0, 1)
    # What the actions behind each one say about its mode, up to a factor.
    later = torch.empty_like(cut)
    for t in range(cut.shape[1] - 1, -1, -1):
        later[:, t] = behind
        behind = _normalised((cut_steps[:, t] * (cut[:, t] * behind)[:, None]).sum(-1))
    later = later.reshape(num, -1, modes)[:, :length]
    moved = after[:, :-1, :, None] * steps[:, 1:] * (likelihood[:, 1:] * later[:, 1:])[:, :, None]
    moved = moved / moved.sum((-1, -2), keepdim=True).clamp(min=TINY)
    return Smoothed(log_likelihood, after, _normalised(after * later), moved)


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


def _number_of_chunks(num: int, length: int) -> int:
    """Into how many chunks each sequence is cut: at most the square root of its length."""
    return max(min(int(length**0.5), -(-ROWS // max(num, 1))), 1)


def _cut(steps: Tensor, likelihood: Tensor, chunks: int) -> tuple[Tensor, Tensor]:
    """Sequences in chunks, `[N * chunks, S, ...]`; steps beyond the end keep the mode."""
    num, length, modes = likelihood.shape
    size = -(-length // chunks)
    missing = chunks * size - length
    keep = torch.eye(modes, dtype=steps.dtype, device=steps.device).expand(num, missing, modes, modes)
    likelihood = torch.cat([likelihood, likelihood.new_ones(num, missing, modes)], 1)
    return torch.cat([steps, keep], 1).view(-1, size, modes, modes), likelihood.view(-1, size, modes)


def _products(steps: Tensor, likelihood: Tensor) -> Tensor:
    """What chunks do to distributions over modes: matrices `[R, K, K]`, up to a factor."""
    product = steps[:, 0] * likelihood[:, 0, None]
    for t in range(1, steps.shape[1]):
        product = torch.bmm(product, steps[:, t] * likelihood[:, t, None])
        product = product / product.sum((-1, -2), keepdim=True).clamp(min=TINY)
    return product


def _normalised(weights: Tensor) -> Tensor:
    return weights / weights.sum(-1, keepdim=True).clamp(min=TINY)
