"""Compiled loops that draw plans of vectors on a CPU, for `LinearGaussianPrior` and `VectorGRU`."""

from typing import Any

import numpy as np
from numba import njit
from torch import Tensor

from neuroprior.priors.neural.compiled_gru import BLOCK, Network, advance

Array = np.ndarray[Any, Any]


def draw_linear(prior: Any, vectors: Tensor, num_past: int, noise: Tensor) -> None:
    """Fill scaled `vectors [N, num_past + L, D]` behind the first `num_past` by standard normal `noise [N, L, D]`."""
    weights, offset, std, coupling = (each.numpy() for each in (prior.weights, prior.offset, prior.std, prior.coupling))
    _linear(vectors.numpy(), num_past, prior.memory, weights, offset, std, coupling, noise.numpy())


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _linear(
    vectors: Array,
    num_past: int,
    depth: int,
    weights: Array,
    offset: Array,
    std: Array,
    coupling: Array,
    noise: Array,
) -> None:
    size = vectors.shape[2]
    mean = np.empty(size, np.float32)
    for n in range(len(vectors)):
        plan = vectors[n]
        for t in range(num_past, len(plan)):
            h = min(t, depth)
            for d in range(size):
                mean[d] = offset[h, d]
            for back in range(h):
                row = (depth - h + back) * size
                for j in range(size):
                    value = plan[t - h + back, j]
                    for d in range(size):
                        mean[d] += value * weights[h, row + j, d]
            for d in range(size):
                centre = mean[d] + noise[n, t - num_past, d] * std[h, d]
                for j in range(d):
                    centre += coupling[h, d, j] * (plan[t, j] - mean[j])
                plan[t, d] = min(max(centre, np.float32(-1)), np.float32(1))


def draw_recurrent(prior: Any, min_std: float, past: Tensor, uniform: Tensor, noise: Tensor) -> Tensor:
    """As `VectorGRU.draw`; `min_std` in units of half the range."""
    # numpy throughout: for these sizes a call of torch takes longer than what it computes.
    layers = [[each.detach().numpy() for each in layer] for layer in prior.gru.all_weights]
    into, recurrent, into_bias, recurrent_bias = (np.stack([layer[i] for layer in layers]) for i in range(4))
    width = prior.width
    biases = into_bias.copy()
    biases[:, : 2 * width] += recurrent_bias[:, : 2 * width]
    unused = np.empty((0, 3 * width), np.float32)
    network = Network(
        action=unused,
        past=unused[None],
        beyond=unused,
        recurrent=np.ascontiguousarray(recurrent.transpose(0, 2, 1)),
        bias=np.ascontiguousarray(recurrent_bias[:, 2 * width :]),
        above=np.ascontiguousarray(into[1:].transpose(0, 2, 1)),
        above_bias=biases[1:],
        head=np.ascontiguousarray(prior.head.weight.detach().numpy().T),
        head_bias=prior.head.bias.detach().numpy(),
    )
    # What the first layer is given is linear in the inputs: two matrices in one.
    gate_weights = prior.inputs.weight.detach().numpy().T @ into[0].T
    gate_bias = into[0] @ prior.inputs.bias.detach().numpy() + biases[0]
    inputs, skip = past.contiguous().numpy(), past.shape[2] - len(gate_weights)
    gates = inputs[:, :, skip:] @ gate_weights + gate_bias
    linear, share = prior.autoregression, prior.autoregressive_share
    bounds = np.stack([each.numpy() for each in (prior.middle, prior.half_range, prior.action_low, prior.action_high)])
    vectors = noise.new_empty(noise.shape)
    _recurrent(
        network,
        vectors.numpy(),
        inputs[:, -1],
        np.ascontiguousarray(gates),
        uniform.numpy(),
        noise.numpy(),
        gate_weights,
        gate_bias,
        prior.linear.weight.detach().numpy(),
        prior.first_log_std.detach().numpy(),
        linear.weights.numpy(),
        linear.offset.numpy(),
        linear.std.numpy(),
        linear.coupling.numpy() * (bounds[1][:, None] / bounds[1]),
        np.float32(share / (1 - share)),
        bounds,
        prior.num_components,
        prior.recent_size,
        np.float32(min_std),
    )
    return vectors


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _dot(start: Any, one: Array, other: Array) -> Any:
    total = np.float32(0)
    for k in range(len(one)):
        total += one[k] * other[k]
    return start + total


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _recurrent(
    network: Network,
    vectors: Array,
    last: Array,
    past_gates: Array,
    uniform: Array,
    noise: Array,
    gate_weights: Array,
    gate_bias: Array,
    direct: Array,
    first_log_std: Array,
    linear_weights: Array,
    linear_offset: Array,
    linear_std: Array,
    linear_coupling: Array,
    odds: Any,
    bounds: Array,
    num: int,
    recent: int,
    min_std: Any,
) -> None:
    """Read B pasts, and draw N / B plans after each, in blocks that stay in the cache.

    Args:
        network: the recurrent layers and the head; the rest of it is not used.
        vectors: `[N, L, D]`, which are written.
        last: `[B, E]`: the last input of each past, of which the first `recent` numbers are last vectors.
        past_gates: `[B, T, 3 H]`: what the inputs of the past add to the gates of the first layer, biases included.
        uniform: `[N, L]`, which choose the components, and standard normal `noise [N, L, D]`.
        gate_weights: `[E', 3 H]`: what the last E' numbers of an input add to these gates, and `gate_bias [3 H]`.
        direct: `[D, E]`: what an input adds to the means.
        first_log_std: `[D]`.
        linear_weights, linear_offset, linear_std, linear_coupling: the autoregression, see `Autoregression`.
        odds: of the autoregression, against the network's components together.
        bounds: `[4, D]`: centre, half the range, low, high.
        num: the network's components.
        recent: see `last`.
        min_std: the least standard deviation.
    """
    length, size, entry, one = vectors.shape[1], vectors.shape[2], vectors.shape[2] + 1, np.float32(1)
    batch, outputs, skip = len(last), len(network.head_bias), last.shape[1] - len(gate_weights)
    num_layers, width = network.recurrent.shape[:2]
    each = len(vectors) // max(batch, 1)
    past_states, first = np.empty((batch, num_layers, width), np.float32), np.empty((batch, outputs), np.float32)
    states, logits = np.zeros((num_layers, BLOCK, width), np.float32), np.empty((BLOCK, outputs), np.float32)
    gates, product = np.empty((BLOCK, 3 * width), np.float32), np.empty((BLOCK, 3 * width), np.float32)
    inputs, read = np.empty((BLOCK, last.shape[1]), np.float32), np.empty((BLOCK, len(gate_weights)), np.float32)
    weights, mean = np.empty(num + 1, np.float32), np.empty(size, np.float32)
    final = num if odds > 0 else num - 1
    centre, half, low, high = bounds[0], bounds[1], bounds[2], bounds[3]
    for begin in range(0, batch, BLOCK):
        rows = min(BLOCK, batch - begin)
        states[:] = 0
        for t in range(past_gates.shape[1]):
            gates[:rows] = past_gates[begin : begin + rows, t]
            advance(network, rows, states, gates, product, logits)
        for i in range(rows):
            first[begin + i] = logits[i]
            past_states[begin + i] = states[:, i]
    for begin in range(0, len(vectors), BLOCK):
        rows = min(BLOCK, len(vectors) - begin)
        for i in range(rows):
            start = (begin + i) // each
            inputs[i] = last[start]
            logits[i] = first[start]
            states[:, i] = past_states[start]
        for t in range(length):
            if t:
                for i in range(rows):
                    for j in range(recent - entry):
                        inputs[i, j] = inputs[i, j + entry]
                    for d in range(size):
                        inputs[i, recent - entry + d] = (vectors[begin + i, t - 1, d] - centre[d]) / half[d]
                    inputs[i, recent - 1] = one
                    for j in range(len(gate_weights)):
                        read[i, j] = inputs[i, skip + j]
                np.dot(read[:rows], gate_weights, gates[:rows])
                for i in range(rows):
                    for j in range(3 * width):
                        gates[i, j] += gate_bias[j]
                advance(network, rows, states, gates, product, logits)
            for i in range(rows):
                n = begin + i
                highest, total = np.float32(-np.inf), np.float32(0)
                for c in range(num):
                    highest = max(highest, logits[i, c])
                for c in range(num):
                    weights[c] = np.exp(logits[i, c] - highest)
                    total += weights[c]
                weights[num] = total * odds
                total += weights[num]
                chosen, so_far = 0, weights[0]
                while chosen < final and uniform[n, t] * total > so_far:
                    chosen += 1
                    so_far += weights[chosen]
                if chosen == num:
                    h = 0
                    for j in range(entry - 1, recent, entry):
                        h += int(inputs[i, j])
                    for d in range(size):
                        value = _dot(linear_offset[h, d], linear_weights[h, d], inputs[i, :recent])
                        mean[d] = centre[d] + half[d] * value
                        value = mean[d] + half[d] * linear_std[h, d] * noise[n, t, d]
                        for j in range(d):
                            value += linear_coupling[h, d, j] * (vectors[n, t, j] - mean[j])
                        vectors[n, t, d] = min(max(value, low[d]), high[d])
                    continue
                for d in range(size):
                    column = num + chosen * size + d
                    value = centre[d] + half[d] * _dot(logits[i, column], direct[d], inputs[i])
                    log_std = logits[i, column + num * size] + (one - inputs[i, recent - 1]) * first_log_std[d]
                    std = np.exp(min(max(log_std, np.float32(-9)), np.float32(3))) + min_std
                    value += half[d] * std * noise[n, t, d]
                    vectors[n, t, d] = min(max(value, low[d]), high[d])
