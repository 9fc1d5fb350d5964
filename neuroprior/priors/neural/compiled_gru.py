"""The cell of a gated recurrent network on a CPU, in float32, and the loops around it: single steps, sequences with
gradients, and plans that are drawn to their ends. Importing this loads numba; elsewhere torch's own cell is used."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numba import float32, njit
from torch import Tensor
from torch.autograd.function import once_differentiable

Array = np.ndarray[Any, Any]

BLOCK, ALONE = 40, 2**20
"""Rows of a matrix product, few enough to stay in the cache; and the most multiplications for which OpenBLAS takes one
thread: in larger products its threads, of which torch does not know, would wait for one another.
"""


def on_one_thread(width: int, num_actions: int) -> bool:
    """Whether OpenBLAS takes one thread for the products of a block of a network so wide."""
    return BLOCK * width * max(3 * width, num_actions) <= ALONE


def step(
    inputs: Tensor,
    rows: Tensor,
    hidden: Tensor,
    before: Tensor,
    bias: Tensor | None = None,
    after: Tensor | None = None,
) -> Tensor:
    """Returns the new hidden states `[N, width]` of one layer.

    Args:
        inputs: `[M, 3 * width]`: what distinct inputs add to the reset gate, the update gate and the new state.
        rows: int32 `[N]`: which of the inputs each row reads.
        hidden: `[N, 3 * width]`: what the hidden states add, of which the reset gate lets a share into the new state.
        before: `[N, width]`: the hidden states, with contiguous columns.
        bias: `[3 * width]`: added to `hidden`, which is left as it is; None for nothing.
        after: `[N, width]`: gets the new hidden states; None: they get memory of their own.
    """
    after = before.new_empty(before.shape) if after is None else after
    bias = hidden.new_zeros(hidden.shape[1]) if bias is None else bias
    # rows of the hidden states may have other numbers behind them
    span = max((len(before) - 1) * before.stride(0) + before.shape[1], 0)
    flat = before.as_strided((span,), (1,)).numpy()
    _step(inputs.numpy(), rows.numpy(), hidden.numpy(), bias.numpy(), flat, before.stride(0), after.numpy())
    return after


@njit(fastmath=True)
def tanh(x: Any) -> Any:
    """A rational approximation, as exact as float32 (the coefficients are those of Eigen, `generic_fast_tanh_float`).

    Unlike the system's own function it is computed for many numbers at once.
    """
    x = min(max(x, float32(-7.90531110763549805)), float32(7.90531110763549805))
    y = x * x
    p = float32(-2.76076847742355e-16) * y + float32(2.00018790482477e-13)
    p = p * y + float32(-8.60467152213735e-11)
    p = p * y + float32(5.12229709037114e-08)
    p = p * y + float32(1.48572235717979e-05)
    p = p * y + float32(6.37261928875436e-04)
    p = p * y + float32(4.89352455891786e-03)
    q = float32(1.19825839466702e-06) * y + float32(1.18534705686654e-04)
    q = q * y + float32(2.26843463243900e-03)
    q = q * y + float32(4.89352518554385e-03)
    return x * p / q


@njit(fastmath=True)
def sigmoid(x: Any) -> Any:
    half = float32(0.5)
    return half * tanh(half * x) + half


@njit(fastmath=True)
def cell(reset: Any, update: Any, new: Any, recurrent: Any, last: Any) -> Any:
    """Returns the gates, the candidate and the new state of one hidden unit (Cho et al. 2014).

    Args:
        reset, update: what inputs and hidden states add to the two gates.
        new: what inputs add to the candidate.
        recurrent: what hidden states add to it, of which the reset gate lets a share through.
        last: the state before.
    """
    reset, update = sigmoid(reset), sigmoid(update)
    new = tanh(new + reset * recurrent)
    return reset, update, new, new + update * (last - new)


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _step(inputs: Array, rows: Array, hidden: Array, bias: Array, before: Array, stride: int, after: Array) -> None:
    """`before` is flat, of rows at this `stride`."""
    width = after.shape[1]
    for n in range(len(after)):
        mine, recurrent, last, new = inputs[rows[n]], hidden[n], before[n * stride : n * stride + width], after[n]
        for k in range(width):
            reset = mine[k] + recurrent[k] + bias[k]
            update = mine[width + k] + recurrent[width + k] + bias[width + k]
            carried = recurrent[2 * width + k] + bias[2 * width + k]
            new[k] = cell(reset, update, mine[2 * width + k], carried, last[k])[3]


class Network(NamedTuple):
    """A gated recurrent network of float32, of K layers.

    Attributes:
        action: `[A + 1, 3 H]`: what the last action adds to the gates of the first layer, with their biases.
        past: `[taps, A + 2, 3 H]`: what each of the last actions adds; the last row, of no action, is 0.
        beyond: `[1, 3 H]`: what is added where there is an action before these; `[0, 3 H]`: nothing.
        recurrent: `[K, H, 3 H]`, and `bias [K, H]` of its last part.
        above: `[K - 1, H, 3 H]`: what the state of a layer adds to the gates of the next, and `above_bias [K - 1, 3 H]`
            with all their other biases.
        head: `[H, A]`, and `head_bias [A]`.
    """

    action: Array
    past: Array
    beyond: Array
    recurrent: Array
    bias: Array
    above: Array
    above_bias: Array
    head: Array
    head_bias: Array


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def advance(network: Network, number: int, states: Array, gates: Array, product: Array, logits: Array) -> None:
    """Step a block of so many plans, at most `BLOCK`.

    Args:
        network: the network.
        number: of plans, the first rows of the arrays.
        states: `[K, BLOCK, H]`: the hidden states, which are overwritten.
        gates: `[BLOCK, 3 H]`: what the inputs add to the gates of the first layer; overwritten where there are more.
        product: `[BLOCK, 3 H]`: room.
        logits: `[BLOCK, A]`: gets the logits of the next action.
    """
    (layers, _, size), actions = states.shape, logits.shape[1]
    # Single numbers are indexed, not rows: numba counts references to each row, which takes as long as all else here.
    for layer in range(layers):
        if layer > 0:
            np.dot(states[layer - 1][:number], network.above[layer - 1], gates[:number])
            for i in range(number):
                for j in range(3 * size):
                    gates[i, j] += network.above_bias[layer - 1, j]
        np.dot(states[layer][:number], network.recurrent[layer], product[:number])
        for i in range(number):
            for j in range(size):
                reset, update = gates[i, j] + product[i, j], gates[i, size + j] + product[i, size + j]
                recurrent = product[i, 2 * size + j] + network.bias[layer, j]
                states[layer, i, j] = cell(reset, update, gates[i, 2 * size + j], recurrent, states[layer, i, j])[3]
    np.dot(states[layers - 1][:number], network.head, logits[:number])
    for i in range(number):
        for a in range(actions):
            logits[i, a] += network.head_bias[a]


@njit(nogil=True, cache=True, error_model="numpy")
def draw_to_the_end(
    network: Network, context_gates: Array, hidden: Array, line: Array, uniform: Array, temperature: float
) -> None:
    """Draw the actions of N plans, in blocks that stay in the cache.

    But for rounding, they are those that `neuroprior.sampling.draws.Draw` takes with the same numbers.

    Args:
        network: the network.
        context_gates: float32 `[N, 3 H]`: what is added to the gates of the first layer at each step; no rows: nothing.
        hidden: `[N, K, H]`: before the last action is read.
        line: int64 `[N, before + T]`: the actions up to the last one, A + 1 where there was none; gets the drawn ones.
        uniform: float32 `[T, N]`: what they are drawn with.
        temperature: divides logits.
    """
    (number, layers, size), (steps, _), actions = hidden.shape, uniform.shape, len(network.head_bias)
    taps, nothing, before = len(network.past), actions + 1, line.shape[1] - len(uniform)
    states, logits = np.empty((layers, BLOCK, size), np.float32), np.empty((BLOCK, actions), np.float32)
    gates, product = np.empty((BLOCK, 3 * size), np.float32), np.empty((BLOCK, 3 * size), np.float32)
    scale = float32(temperature)
    for begin in range(0, number, BLOCK):
        rows = min(BLOCK, number - begin)
        for layer in range(layers):
            for i in range(rows):
                for j in range(size):
                    states[layer, i, j] = hidden[begin + i, layer, j]
        for t in range(steps):
            at = before + t - 1
            for i in range(rows):
                n = begin + i
                last = line[n, at]
                for j in range(3 * size):
                    gates[i, j] = network.action[last, j]
                if len(context_gates):
                    for j in range(3 * size):
                        gates[i, j] += context_gates[n, j]
                for lag in range(taps):
                    symbol = line[n, at - lag]
                    if symbol != nothing:  # it adds 0
                        for j in range(3 * size):
                            gates[i, j] += network.past[lag, symbol, j]
                if len(network.beyond) and line[n, at - taps] != nothing:
                    for j in range(3 * size):
                        gates[i, j] += network.beyond[0, j]
            advance(network, rows, states, gates, product, logits)
            for i in range(rows):
                top, total = logits[i, 0], 0.0  # float64, as torch sums
                for a in range(1, actions):
                    top = max(top, logits[i, a])
                for a in range(actions):
                    total += np.exp((logits[i, a] - top) / scale)
                    logits[i, a] = total
                whole = logits[i, actions - 1]
                mark, action = uniform[t, begin + i] * whole, 0
                while logits[i, action] <= mark and logits[i, action] < whole:
                    action += 1
                line[begin + i, at + 1] = action


class Sequence(torch.autograd.Function):
    """The hidden states `[T, N, width]` of one layer over a sequence, from what its inputs add to the gates.

    As `nn.GRU`'s, of float32 on the CPU: matrix products by torch, gates and their gradients by compiled loops.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, first: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """From `inputs [T, N, 3 * width]`, the state before `first [N, width]`, the recurrent weights and biases."""
        length, num, _ = inputs.shape
        states = inputs.new_empty(length + 1, num, first.shape[1])
        states[0] = first
        opened, hidden, turned = torch.empty_like(inputs), inputs.new_empty(inputs.shape), weight.T.contiguous()
        arrays = inputs.contiguous().numpy(), hidden.numpy(), states.numpy(), opened.numpy()
        for t in range(length):
            torch.addmm(bias, states[t], turned, out=hidden[t])
            _forward(*arrays, t)
        ctx.save_for_backward(states, opened, hidden, weight)
        return states[1:]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, after: Tensor) -> tuple[Tensor | None, ...]:
        states, opened, hidden, weight = ctx.saved_tensors
        length, num, width = after.shape
        to_inputs, to_hidden = torch.empty_like(opened), torch.empty_like(opened)
        carried = torch.zeros(num, width)
        arrays = after.contiguous().numpy(), carried.numpy(), states.numpy(), opened.numpy(), hidden.numpy()
        gradients = to_inputs.numpy(), to_hidden.numpy()
        for t in range(length - 1, -1, -1):
            _backward(*arrays, *gradients, t)
            carried.addmm_(to_hidden[t], weight)
        every = to_hidden.flatten(0, 1)
        return to_inputs, carried, every.T @ states[:-1].flatten(0, 1), every.sum(0)


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _forward(inputs: Array, hidden: Array, states: Array, opened: Array, t: int) -> None:
    """Step t: the gates and new states `opened [T, N, 3 * width]`, and the hidden states that follow."""
    width = states.shape[2]
    for n in range(states.shape[1]):
        mine, recurrent, gate, last, new = inputs[t, n], hidden[t, n], opened[t, n], states[t, n], states[t + 1, n]
        for k in range(width):
            reset, update = mine[k] + recurrent[k], mine[width + k] + recurrent[width + k]
            reset, update, fresh, after = cell(reset, update, mine[2 * width + k], recurrent[2 * width + k], last[k])
            gate[k], gate[width + k], gate[2 * width + k], new[k] = reset, update, fresh, after


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _backward(
    after: Array,
    carried: Array,
    states: Array,
    opened: Array,
    hidden: Array,
    to_inputs: Array,
    to_hidden: Array,
    t: int,
) -> None:
    """Step t: gradients of what the inputs and the hidden states add; `carried` becomes the direct one of the state."""
    width, one = states.shape[2], float32(1)
    for n in range(states.shape[1]):
        gate, recurrent, last, down, back = opened[t, n], hidden[t, n], states[t, n], to_inputs[t, n], to_hidden[t, n]
        out, past = after[t, n], carried[n]
        for k in range(width):
            reset, update, fresh = gate[k], gate[width + k], gate[2 * width + k]
            total = out[k] + past[k]
            new = total * (one - update) * (one - fresh * fresh)
            opens = new * recurrent[2 * width + k] * reset * (one - reset)
            keeps = total * (last[k] - fresh) * update * (one - update)
            down[k], down[width + k], down[2 * width + k] = opens, keeps, new
            back[k], back[width + k], back[2 * width + k] = opens, keeps, new * reset
            past[k] = total * update
