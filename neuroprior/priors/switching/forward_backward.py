"""Exact inference over hidden modes: filtering, smoothing and the most probable path, batched over sequences.

Rabiner, *A tutorial on hidden Markov models*, Proceedings of the IEEE 77 (1989), section III. Long sequences are cut
into chunks that are walked through side by side: the product of a chunk's matrices says what the chunk does to any
distribution over modes.

Throughout, of N sequences of L steps with K modes, `initial [K]` is the distribution of the first mode;
`steps [N, L, K, K]` leads from the mode before each action (row) to the mode of the action (column), the first of them
the identity; and `likelihood [N, L, K]` is that of each action in each mode, not 0 in all of them. Beyond the end of a
sequence likelihoods are 1 and steps the identity.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuroprior._compiled import compiled

ROWS = 1024
"""Sequences are cut until about so many chunks are walked through side by side."""

TINY = 1e-300

COMPILE_FROM = 2**9
"""Elements of `steps` from which the compiled loop is taken: loading it pays for no fewer."""


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
    return _forward(initial, _cut(steps, likelihood), *likelihood.shape[:2])


def smooth(initial: Tensor, steps: Tensor, likelihood: Tensor) -> Smoothed:
    """The modes given whole sequences; see the module for the arguments."""
    if steps.numel() >= COMPILE_FROM and steps.device.type == "cpu" and steps.dtype == torch.double:
        module = compiled("neuroprior.priors.switching.compiled_smoothing")
        if module is not None:
            return _smooth_compiled(module, initial, steps, likelihood)
    chunks, (num, length) = _cut(steps, likelihood), likelihood.shape[:2]
    _, after, log_likelihood = _forward(initial, chunks, num, length)
    later = _backward(chunks, num, length)
    moved = after[:, :-1, :, None] * steps[:, 1:] * (likelihood[:, 1:] * later[:, 1:])[:, :, None]
    moved = moved / moved.sum((-1, -2), keepdim=True).clamp(min=TINY)
    return Smoothed(log_likelihood, after, _normalised(after * later), moved)


def _smooth_compiled(module: Any, initial: Tensor, steps: Tensor, likelihood: Tensor) -> Smoothed:
    num, length, modes = likelihood.shape
    after, smoothed = (likelihood.new_empty(likelihood.shape) for _ in range(2))
    totals, moved = likelihood.new_empty(num, length), steps.new_empty(num, length - 1, modes, modes)
    given = [values.contiguous().numpy() for values in (initial, steps, likelihood)]
    module.smooth(*given, TINY, *(values.numpy() for values in (totals, after, smoothed, moved)))
    return Smoothed(totals.log(), after, smoothed, moved)


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


class _Chunks(NamedTuple):
    """N sequences in C chunks of S steps each.

    Attributes:
        steps: `[N * C, S, K, K]`.
        likelihood: `[N * C, S, K]`.
        products: `[N, C, K, K]`: what each chunk does to distributions over modes, up to a factor; None: C is 1.
    """

    steps: Tensor
    likelihood: Tensor
    products: Tensor | None


def _cut(steps: Tensor, likelihood: Tensor) -> _Chunks:
    """Sequences in at most the square root of their length of chunks; steps beyond the end keep the mode."""
    num, length, modes = likelihood.shape
    chunks = max(min(int(length**0.5), -(-ROWS // max(num, 1))), 1)
    if chunks == 1:
        return _Chunks(steps, likelihood, None)
    size = -(-length // chunks)
    missing = chunks * size - length
    keep = torch.eye(modes, dtype=steps.dtype, device=steps.device).expand(num, missing, modes, modes)
    likelihood = torch.cat([likelihood, likelihood.new_ones(num, missing, modes)], 1).view(-1, size, modes)
    steps = torch.cat([steps, keep], 1).view(-1, size, modes, modes)
    return _Chunks(steps, likelihood, _products(steps, likelihood).unflatten(0, (num, chunks)))


def _forward(initial: Tensor, chunks: _Chunks, num: int, length: int) -> tuple[Tensor, Tensor, Tensor]:
    """What `predict` returns."""
    steps, likelihood, products = chunks
    before = initial.expand(num, likelihood.shape[-1])
    if products is not None:
        starts = [before]
        for chunk in range(products.shape[1] - 1):
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
    return _joined(predicted, num, length), _joined(after, num, length), _joined(totals.log(), num, length)


def _backward(chunks: _Chunks, num: int, length: int) -> Tensor:
    """`[N, L, K]`: what the actions behind each one say about its mode, up to a factor."""
    steps, likelihood, products = chunks
    behind = likelihood.new_ones(num, likelihood.shape[-1])
    if products is not None:
        ends = [behind]
        for chunk in range(products.shape[1] - 1, 0, -1):
            ends.append(_normalised((products[:, chunk] * ends[-1][:, None]).sum(-1)))
        behind = torch.stack(ends[::-1], 1).flatten(0, 1)
    later = torch.empty_like(likelihood)
    for t in range(likelihood.shape[1] - 1, -1, -1):
        later[:, t] = behind
        behind = _normalised((steps[:, t] * (likelihood[:, t] * behind)[:, None]).sum(-1))
    return _joined(later, num, length)


def _joined(values: Tensor, num: int, length: int) -> Tensor:
    """Values of chunks, `[N * C, S, ...]`, as those of sequences, `[N, L, ...]`."""
    return values.reshape(num, -1, *values.shape[2:])[:, :length]


def _products(steps: Tensor, likelihood: Tensor) -> Tensor:
    """What chunks do to distributions over modes: matrices `[R, K, K]`, up to a factor."""
    product = steps[:, 0] * likelihood[:, 0, None]
    for t in range(1, steps.shape[1]):
        product = torch.bmm(product, steps[:, t] * likelihood[:, t, None])
        product = product / product.sum((-1, -2), keepdim=True).clamp(min=TINY)
    return product


def _normalised(weights: Tensor) -> Tensor:
    return weights / weights.sum(-1, keepdim=True).clamp(min=TINY)
