"""Compiled loops that draw plans of vectors, for `LinearGaussianPrior` and `VectorGRU`; importing this loads numba."""

from typing import Any

import numpy as np
from numba import njit
from torch import Tensor

from neuroprior.priors.neural.compiled_gru import sigmoid, tanh

Array = np.ndarray[Any, Any]


def draw_linear(prior: Any, vectors: Tensor, known: int, noise: Tensor) -> None:
    """As `neuroprior.control.priors.linear_gaussian.draw_linear`, of float32 on the CPU."""
    weights, offset, std, coupling = (each.numpy() for each in (prior.weights, prior.offset, prior.std, prior.coupling))
    _linear(vectors.numpy(), known, prior.memory, weights, offset, std, coupling, noise.numpy())


@njit(nogil=True, cache=True)
def _copy(into: Array, row: Array) -> None:
    """`into[:] = row`, which takes seconds to compile."""
    for k in range(len(into)):
        into[k] = row[k]


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _linear(
    vectors: Array,
    known: int,
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
        for t in range(known, len(plan)):
            h = min(t, depth)
            _copy(mean, offset[h])
            for back in range(h):
                row = (depth - h + back) * size
                for j in range(size):
                    value = plan[t - h + back, j]
                    for d in range(size):
                        mean[d] += value * weights[h, row + j, d]
            for d in range(size):
                centre = mean[d] + noise[n, t - known, d] * std[h, d]
                for j in range(d):
                    centre += coupling[h, d, j] * (plan[t, j] - mean[j])
                plan[t, d] = min(max(centre, np.float32(-1)), np.float32(1))


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _gated(into: Array, from_own: Array, state: Array) -> None:
    """Move on the `state` of a layer, by what its input and its own state give to the gates."""
    width = len(state)
    for k in range(width):
        reset = sigmoid(into[k] + from_own[k])
        update = sigmoid(into[width + k] + from_own[width + k])
        fresh = tanh(into[2 * width + k] + reset * from_own[2 * width + k])
        state[k] = fresh + update * (state[k] - fresh)


def draw_recurrent(prior: Any, least_std: float, inputs: Tensor, uniform: Tensor, noise: Tensor) -> Tensor:
    """As `VectorNetwork.draw`, for a `VectorGRU` of float32 on the CPU; `least_std` in units of half the range."""
    # numpy throughout: for these sizes a call of torch takes longer than what it computes.
    layers = [[each.detach().numpy() for each in layer] for layer in prior.gru.all_weights]
    inputs_weight, inputs_bias, head, head_bias, direct = (
        each.detach().numpy()
        for each in (prior.inputs.weight, prior.inputs.bias, prior.head.weight, prior.head.bias, prior.linear.weight)
    )
    bounds = np.stack([each.numpy() for each in (prior.middle, prior.half_range, prior.action_low, prior.action_high)])
    # What the first layer is given is linear in the inputs: two matrices in one.
    given = inputs_weight.T @ layers[0][0].T
    given_bias = layers[0][0] @ inputs_bias + layers[0][2]
    # Gates of higher layers are given what the layer below has found; the first layer's place is not read.
    above, own, above_bias, own_bias = (np.array([layer[i].T for layer in layers], order="C") for i in range(4))
    size = prior.action_size
    coupling, relative = np.zeros((size, size), np.float32), bounds[1][:, None] / bounds[1]
    if prior.coupling is not None:
        coupling = np.tril(prior.coupling.detach().numpy(), -1) * relative
    first_log_std = prior.first_log_std.detach().numpy()
    linear = prior.autoregression
    linear_coupling = linear.coupling.numpy() * relative
    share = prior.autoregressive_share
    vectors = noise.new_empty(noise.shape)
    _recurrent(
        vectors.numpy(),
        inputs.contiguous().numpy(),
        uniform.numpy(),
        noise.numpy(),
        above,
        above_bias,
        own,
        own_bias,
        given,
        given_bias,
        head,
        head_bias,
        direct,
        first_log_std,
        coupling,
        linear.weights.numpy(),
        linear.offset.numpy(),
        linear.std.numpy(),
        linear_coupling,
        np.float32(share / (1 - share)),
        bounds,
        prior.num_components,
        prior.recent_size,
        np.float32(least_std),
    )
    return vectors


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _add_product(total: Array, vector: Array, matrix: Array) -> None:
    """Add `vector @ matrix`, four rows at a time."""
    whole = len(vector) // 4 * 4
    for k in range(0, whole, 4):
        v0, v1, v2, v3 = vector[k], vector[k + 1], vector[k + 2], vector[k + 3]
        for j in range(len(total)):
            total[j] += v0 * matrix[k, j] + v1 * matrix[k + 1, j] + v2 * matrix[k + 2, j] + v3 * matrix[k + 3, j]
    for k in range(whole, len(vector)):
        value = vector[k]
        for j in range(len(total)):
            total[j] += value * matrix[k, j]


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _advance(
    hidden: Array,
    inputs: Array,
    given: Array,
    given_bias: Array,
    own: Array,
    own_bias: Array,
    above: Array,
    above_bias: Array,
    into: Array,
    from_own: Array,
) -> None:
    """Move on the hidden states `[num_layers, width]` by `inputs [E]`; `into` and `from_own` are room."""
    for layer in range(len(hidden)):
        before = hidden[layer]
        _copy(from_own, own_bias[layer])
        _add_product(from_own, before, own[layer])
        if layer:
            _copy(into, above_bias[layer])
            _add_product(into, hidden[layer - 1], above[layer])
        else:
            _copy(into, given_bias)
            _add_product(into, inputs, given)
        _gated(into, from_own, before)


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _dot(start: Any, one: Array, other: Array) -> Any:
    total = np.float32(0)
    for k in range(len(one)):
        total += one[k] * other[k]
    return start + total


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _recurrent(
    vectors: Array,
    past: Array,
    uniform: Array,
    noise: Array,
    above: Array,
    above_bias: Array,
    own: Array,
    own_bias: Array,
    given: Array,
    given_bias: Array,
    head: Array,
    head_bias: Array,
    direct: Array,
    first_log_std: Array,
    coupling: Array,
    linear_weights: Array,
    linear_offset: Array,
    linear_std: Array,
    linear_coupling: Array,
    odds: Any,
    bounds: Array,
    num: int,
    recent: int,
    least_std: Any,
) -> None:
    """`past [B, T, E]` begins with `recent` numbers of last vectors; `bounds`: centre, half the range, low, high.

    Of the inputs the network reads the last ones, as many as `given` has rows.
    `odds`: of the autoregression, against the network's components together.
    """
    length, size = vectors.shape[1], vectors.shape[2]
    num_layers, width, entry, one = own.shape[0], own.shape[1], size + 1, np.float32(1)
    into, from_own = np.empty(3 * width, np.float32), np.empty(3 * width, np.float32)
    known, hidden = np.empty((num_layers, width), np.float32), np.empty((num_layers, width), np.float32)
    inputs = np.empty(past.shape[2], np.float32)
    each, skip = len(vectors) // max(len(past), 1), past.shape[2] - len(given)
    weights, mean = np.empty(num + 1, np.float32), np.empty(size, np.float32)
    last = num if odds > 0 else num - 1
    centre, half, low, high = bounds[0], bounds[1], bounds[2], bounds[3]
    for n in range(len(vectors)):
        if n % each == 0:
            known[:] = 0
            for t in range(past.shape[1]):
                _advance(
                    known,
                    past[n // each, t, skip:],
                    given,
                    given_bias,
                    own,
                    own_bias,
                    above,
                    above_bias,
                    into,
                    from_own,
                )
        for layer in range(num_layers):
            _copy(hidden[layer], known[layer])
        _copy(inputs, past[n // each, past.shape[1] - 1])
        top = hidden[num_layers - 1]
        for t in range(length):
            if t:
                for j in range(recent - entry):
                    inputs[j] = inputs[j + entry]
                for d in range(size):
                    inputs[recent - entry + d] = (vectors[n, t - 1, d] - centre[d]) / half[d]
                inputs[recent - 1] = one
                _advance(hidden, inputs[skip:], given, given_bias, own, own_bias, above, above_bias, into, from_own)
            highest, total = np.float32(-np.inf), np.float32(0)
            for c in range(num):
                weights[c] = _dot(head_bias[c], head[c], top)
                highest = max(highest, weights[c])
            for c in range(num):
                weights[c] = np.exp(weights[c] - highest)
                total += weights[c]
            weights[num] = total * odds
            total += weights[num]
            chosen, so_far = 0, weights[0]
            while chosen < last and uniform[n, t] * total > so_far:
                chosen += 1
                so_far += weights[chosen]
            if chosen == num:
                h = 0
                for j in range(entry - 1, recent, entry):
                    h += int(inputs[j])
                for d in range(size):
                    mean[d] = centre[d] + half[d] * _dot(linear_offset[h, d], linear_weights[h, d], inputs[:recent])
                    value = mean[d] + half[d] * linear_std[h, d] * noise[n, t, d]
                    for j in range(d):
                        value += linear_coupling[h, d, j] * (vectors[n, t, j] - mean[j])
                    vectors[n, t, d] = min(max(value, low[d]), high[d])
                continue
            for d in range(size):
                row = num + chosen * size + d
                value = _dot(_dot(head_bias[row], head[row], top), direct[d], inputs)
                mean[d] = centre[d] + half[d] * value
                row += num * size
                log_std = _dot(head_bias[row], head[row], top) + (one - inputs[recent - 1]) * first_log_std[d]
                std = np.exp(min(max(log_std, np.float32(-9)), np.float32(3))) + least_std
                value = mean[d] + half[d] * std * noise[n, t, d]
                for j in range(d):
                    value += coupling[d, j] * (vectors[n, t, j] - mean[j])
                vectors[n, t, d] = min(max(value, low[d]), high[d])
