"""The gates of a recurrent network in one pass by a compiled loop, for `gru_step`; importing this loads numba."""

from typing import Any

import numpy as np
import torch
from numba import float32, njit
from torch import Tensor

Array = np.ndarray[Any, Any]


def gates(given: Tensor, rows: Tensor, hidden: Tensor, before: Tensor) -> Tensor:
    """As `neuroprior.priors.neural.gru.gates`, of float32 on the CPU; columns of `before` must be contiguous."""
    after = torch.empty(before.shape)
    # rows of the hidden states may have other numbers behind them
    span = max((len(before) - 1) * before.stride(0) + before.shape[1], 0)
    flat = before.as_strided((span,), (1,)).numpy()
    _gates(given.numpy(), rows.numpy(), hidden.numpy(), flat, before.stride(0), after.numpy())
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


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _gates(given: Array, rows: Array, hidden: Array, before: Array, stride: int, after: Array) -> None:
    """`before` is flat, of rows at this `stride`."""
    width = after.shape[1]
    for n in range(len(after)):
        mine, own, last, new = given[rows[n]], hidden[n], before[n * stride : n * stride + width], after[n]
        for k in range(width):
            reset = sigmoid(mine[k] + own[k])
            update = sigmoid(mine[width + k] + own[width + k])
            fresh = tanh(mine[2 * width + k] + reset * own[2 * width + k])
            new[k] = fresh + update * (last[k] - fresh)
